"""PNG encoder: OpenCV and Pillow decode the pixels that were encoded. Its deflate does not depend on the stream's address."""

from __future__ import annotations

import io
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from synpick_warp.exporters.writing import png
from synpick_warp.exporters.writing.png import HEAD, Deflater, encode_mask_png, encode_png
from synpick_warp.exporters.writing.rle import find_run_boundaries

SIDE = st.integers(1, 40)
GREY = st.tuples(SIDE, SIDE)
STREAMS = 200
"""Number of streams, at different addresses. Without our workaround, one in 36 differs from the others for `flow_rows`."""


def deflate(data: bytes | np.ndarray) -> bytes:
    stream = Deflater()
    return stream.compress(data) + stream.flush()


def read(data: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return image[..., ::-1] if image.ndim == 3 else image


@given(
    st.one_of(
        hnp.arrays(np.uint8, GREY),
        hnp.arrays(np.uint16, GREY),
        hnp.arrays(np.dtype(">u2"), GREY),
        hnp.arrays(np.uint8, st.tuples(SIDE, SIDE, st.just(3))),
        hnp.arrays(np.uint16, st.tuples(SIDE, SIDE, st.just(3))),
    )
)
def test_round_trip_by_opencv(image):
    back = read(encode_png(image))
    assert back.dtype == image.dtype.newbyteorder("=")
    np.testing.assert_array_equal(back, image)


@pytest.mark.parametrize("strip_bytes", [0, 30, 45, 1 << 20])
def test_strip_size_does_not_matter(strip_bytes, monkeypatch):
    monkeypatch.setattr(png, "_STRIP_BYTES", strip_bytes)
    for shape, dtype in (((7, 5), np.uint16), ((7, 5, 3), np.uint8), ((1, 1), np.uint8)):
        image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype)
        np.testing.assert_array_equal(read(encode_png(image)), image)


def test_array_views_are_encoded_like_copies():
    ring = np.arange(4 * 6 * 8 * 3, dtype=np.uint8).reshape(4, 6, 8, 3)
    image = ring[2, ::2, 1:-1]
    assert encode_png(image) == encode_png(image.copy())
    np.testing.assert_array_equal(read(encode_png(image)), image)


def test_known_bytes():
    """A 2 x 2 greyscale image decoded by hand: signature, header, then rows with the filter "up"."""
    data = encode_png(np.array([[1, 2], [4, 2]], np.uint8))
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert data[8:33] == b"\x00\x00\x00\rIHDR" + bytes([0, 0, 0, 2, 0, 0, 0, 2, 8, 0, 0, 0, 0]) + zlib.crc32(data[12:29]).to_bytes(4)
    length = int.from_bytes(data[33:37])
    assert zlib.decompress(data[41 : 41 + length]) == bytes([2, 1, 2, 2, 3, 0])
    assert data[-12:] == b"\x00\x00\x00\x00IEND\xaeB`\x82"


@given(st.data())
def test_masks_are_encoded_at_their_place(data):
    height, width = data.draw(GREY)
    top, left = data.draw(st.integers(0, height)), data.draw(st.integers(0, width))
    rows, columns = data.draw(st.integers(0, height - top)), data.draw(st.integers(0, width - left))
    mask = data.draw(hnp.arrays(bool, (rows, columns)))
    full = np.zeros((height, width), np.uint8)
    full[top : top + rows, left : left + columns] = np.where(mask, 255, 0)
    runs = find_run_boundaries(mask.view(np.uint8), top, left).runs_of(1)
    stream = encode_mask_png(runs, height, width)
    np.testing.assert_array_equal(read(stream), full)
    # OpenCV ignores wrong checksums; zlib and Pillow do not.
    length = int.from_bytes(stream[33:37])
    assert len(zlib.decompress(stream[41 : 41 + length])) == height * (1 + width)
    with Image.open(io.BytesIO(stream)) as image:
        image.load()
        np.testing.assert_array_equal(np.asarray(image), full)


@pytest.mark.parametrize(
    "image", [np.zeros((2, 2)), np.zeros((2, 2, 2), np.uint16), np.zeros((2, 2, 4), np.uint8), np.zeros((0, 3), np.uint8)]
)
def test_unsupported_images_are_refused(image):
    with pytest.raises(ValueError, match="no PNG for an image of shape"):
        encode_png(image)


def flow_rows() -> np.ndarray:
    """PNG-filtered rows of an optical-flow image of a moving disc (720, 7680) uint8."""
    row, column = np.mgrid[0:720, 0:1280]
    inside = (column - 640) ** 2 + (row - 360) ** 2 < 60000
    codes = np.zeros((720, 1280, 3), ">u2")
    codes[inside, 0] = (32768 + 0.3 * column + 0.1 * row)[inside]
    codes[inside, 1] = (32768 + 0.3 * column - 0.2 * row)[inside]
    codes[inside, 2] = 1
    rows = codes.view(np.uint8).reshape(720, -1)
    return np.diff(rows, axis=0, prepend=np.zeros((1, rows.shape[1]), np.uint8))


@given(st.binary(max_size=5000), st.integers(0, 5000))
@settings(max_examples=50, deadline=None)
def test_round_trip_by_zlib(data, cut):
    assert zlib.decompress(deflate(data)) == data
    stream = Deflater(-zlib.MAX_WBITS)
    parts = stream.compress(data[:cut]), stream.compress(data[cut:]), stream.flush()
    assert zlib.decompress(b"".join(parts), -zlib.MAX_WBITS) == data


@pytest.mark.parametrize("shape", [(300,), (20, 15), (4, 5, 5, 3)])
def test_arrays_of_any_shape_are_compressed_as_bytes(shape):
    data = np.arange(300, dtype=np.uint16).astype(np.uint8).reshape(shape)
    assert zlib.decompress(deflate(data)) == data.tobytes()


def test_first_bytes_are_flushed_separately():
    data = flow_rows().tobytes()
    packed = deflate(data)
    reader = zlib.decompressobj()
    first = next(got for got in (reader.decompress(packed[place : place + 1]) for place in range(len(packed))) if got)
    assert first == data[: len(first)]
    assert len(first) <= HEAD


def test_bytes_do_not_depend_on_the_stream_address():
    data = flow_rows()
    streams = [Deflater() for _ in range(STREAMS)]
    assert len({stream.compress(data) + stream.flush() for stream in streams}) == 1
