"""OpenEXR encoder: read back by a decoder written from the specification, and by the OpenEXR library if installed."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.exporters.usd.exr import encode_exr


def decode(data: bytes) -> np.ndarray:
    """Decode a file with 32-bit channels B, G, R and ZIP compression to (H, W, 3)."""
    assert struct.unpack_from("<2i", data) == (20000630, 2)
    at, attributes = 8, {}
    while data[at]:
        end = data.index(0, at)
        stop = data.index(0, end + 1)
        (size,) = struct.unpack_from("<i", data, stop + 1)
        attributes[data[at:end].decode()] = data[stop + 5 : stop + 5 + size]
        at = stop + 5 + size
    assert attributes["compression"] == b"\x03"
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    assert (left, top) == (0, 0)
    width, height = right + 1, bottom + 1
    assert attributes["channels"].count(struct.pack("<i", 2)) == 3
    image = np.zeros((height, width, 3), np.float32)
    for place in struct.unpack_from(f"<{-(-height // 16)}Q", data, at + 1):
        row, size = struct.unpack_from("<2i", data, place)
        rows = min(16, height - row)
        packed = data[place + 8 : place + 8 + size]
        if size < 12 * rows * width:
            steps = np.frombuffer(zlib.decompress(packed), np.uint8).astype(np.int64)
            steps[1:] -= 128
            flat = (np.cumsum(steps) % 256).astype(np.uint8)
            half = (len(flat) + 1) // 2
            plain = np.empty_like(flat)
            plain[0::2], plain[1::2] = flat[:half], flat[half:]
            packed = plain.tobytes()
        image[row : row + rows] = np.frombuffer(packed, "<f4").reshape(rows, 3, width).transpose(0, 2, 1)[..., ::-1]
    return image


def make_image(height: int, width: int, seed: int, noisy: bool) -> np.ndarray:
    """Image with values over several orders of magnitude, or with large even areas."""
    noise = np.exp(np.random.default_rng(seed).normal(0.0, 4.0, (height, width, 3))).astype(np.float32)
    return noise if noisy else np.round(np.log(noise)).astype(np.float32) ** 2


@given(st.integers(1, 40), st.integers(1, 20), st.integers(0, 1000), st.booleans())
def test_round_trip(height, width, seed, noisy):
    image = make_image(height, width, seed, noisy)
    data = encode_exr(image)
    np.testing.assert_array_equal(decode(data), image)
    assert encode_exr(image) == data


def test_even_areas_are_compressed():
    assert len(encode_exr(np.ones((64, 128, 3), np.float32))) < 2000


@pytest.mark.parametrize("noisy", [False, True])
def test_the_openexr_library_reads_it(tmp_path, noisy):
    library = pytest.importorskip("OpenEXR")
    image = make_image(37, 50, 1, noisy)
    (tmp_path / "map.exr").write_bytes(encode_exr(image))
    file = library.File(str(tmp_path / "map.exr"))
    np.testing.assert_array_equal(file.channels()["RGB"].pixels, image)
    assert "LATLONG" in str(file.header()["envmap"])


@pytest.mark.parametrize("shape", [(4, 4), (4, 4, 4), (0, 4, 3)])
def test_unsupported_images_are_refused(shape):
    with pytest.raises(ValueError, match="no EXR"):
        encode_exr(np.zeros(shape, np.float32))
