"""Depth PNGs from the device: bytes of the twin, read by the decoders of the field."""

from __future__ import annotations

import io
import zlib

import cv2
import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.png import frame_depth_png
from synpick_warp.kernels.encoding import png as kernels
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.encoding import png
from synpick_warp.stages.encoding.png import DepthBuffers, DepthEncoder, allocate_depth_scratch, depth_sizes
from synpick_warp.system.codecs import depth_png
from synpick_warp.system.inputs.image_files import decode_image
from tests.harness.fuzz import fuzz_examples
from tests.twins.depth_png import SEGMENT, encode_depth, filter_rows


def encode(images: np.ndarray, device) -> list[bytes | None]:
    """Data of images (view, row, column); None: it exceeds the capacity."""
    views, height, width = images.shape
    out = allocate(DepthBuffers, depth_sizes(views, width, height), device)
    encoder = DepthEncoder(allocate_depth_scratch(views, width, height, device), width, height)
    for _ in range(2):
        # Scratch is used again.
        encoder.encode(wp.array(images, dtype=wp.uint16, device=device), views, out)
    data, sizes = out.depth_idat.numpy(), out.depth_idat_size.numpy()
    return [part[:size].tobytes() if size <= len(part) else None for part, size in zip(data, sizes, strict=True)]


def surfaces(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Depth of inclined planes with edges and holes [0.1 mm]."""
    random = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width]
    image = 20000.0 - 0.3 * rows
    for _ in range(6):
        top, left = random.integers(0, height), random.integers(0, width)
        part = np.s_[top : top + height // 3 + 1, left : left + width // 3 + 1]
        image[part] = 15000.0 + random.uniform(-20, 20) * rows[part] + random.uniform(-20, 20) * columns[part]
    image[height // 2 :, : width // 5] = 0.0
    return np.clip(image, 0, 65535).astype(np.uint16)


def test_known_bytes_of_a_small_image(device):
    (data,) = encode(np.array([[[1, 2], [258, 2]]]), device)
    assert zlib.decompress(data) == bytes.fromhex("0200010002 0201010000")
    assert encode(np.array([[[0]]]), device) == [encode_depth(np.zeros((1, 1), np.uint16))]


SHAPES = [(1, 1), (1, 2), (5, 1), (3, 9), (2, 129), (2, 130), (3, 257), (3, 258), (3, 259), (4, 260), (2, 516), (3, 775), (70, 33)]


@pytest.mark.parametrize("shape", SHAPES)
def test_data_is_that_of_the_twin(device, shape):
    """Rows of one pixel, partial and whole segments, longest runs; few and many groups of slots."""
    random = np.random.default_rng(1)
    images = np.stack([
        surfaces(*shape),
        np.zeros(shape),
        np.full(shape, 65535),
        random.integers(0, 65536, shape),
        random.integers(0, 2, shape),
        np.arange(shape[1]) % 8 * random.integers(0, 300, (shape[0], 1)),
    ]).astype(np.uint16)  # fmt: skip
    found = encode(images, device)
    assert found == [encode_depth(image) for image in images]
    for data, image in zip(found, images, strict=True):
        assert zlib.decompress(data) == filter_rows(image).tobytes()


@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.integers(1, 300), st.integers(1, 65535), st.integers(1, 12))
@settings(max_examples=fuzz_examples(60))
def test_fuzz_any_image(seed, height, width, span, period):
    """Noise of any strength, partly repeated with a period, partly copied from the row above."""
    random = np.random.default_rng(seed)
    image = random.integers(0, span + 1, (height, width))
    repeat = random.random((height, width)) < random.random()
    image = np.where(repeat, image[:, np.arange(width) % period], image)
    image[1:] = np.where(random.random((height, 1))[1:] < 0.3, image[:-1] + 7, image[1:])
    image = (image % 65536).astype(np.uint16)
    (data,) = encode(image[None], wp.get_device("cpu"))
    assert data == encode_depth(image)
    assert zlib.decompress(data) == filter_rows(image).tobytes()


def test_decoders_read_it(device):
    image = surfaces(180, 640)
    (data,) = encode(image[None], device)
    file = frame_depth_png(data, 640, 180)
    assert file.endswith(b"IEND\xaeB`\x82")
    decoded = (
        cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED),
        np.asarray(Image.open(io.BytesIO(file))),
        decode_image(file, "depth.png", DatasetError, size=(640, 180)),
    )
    for found in decoded:
        np.testing.assert_array_equal(found, image)


def test_data_beyond_the_capacity_is_flagged_and_data_beside_it_stays(device):
    random = np.random.default_rng(2)
    images = np.stack([surfaces(300, 400), random.integers(0, 65536, (300, 400)), surfaces(300, 400, 1)]).astype(np.uint16)
    assert encode(images, device) == [encode_depth(images[0]), None, encode_depth(images[2])]


def test_the_longest_codes_fit_slots_and_those_of_small_images_the_capacity(device):
    lengths = depth_png.code_lengths()[:256]
    longest = [value for value, bits in enumerate(lengths) if bits == max(lengths)]
    for shape in ((40, 250), (10000, 1), (1, 10000)):
        size = shape[0] * shape[1]
        # No two samples in reach are equal.
        bytes_ = np.array([(longest[index % 7], longest[index % len(longest)]) for index in range(size)], np.uint8)
        residual = bytes_.reshape(shape[0], -1)
        image = np.add.accumulate(residual, axis=0, dtype=np.uint8).view(">u2").astype(np.uint16)
        (data,) = encode(image[None], device)
        assert data == encode_depth(image)


def test_codes_are_complete():
    for codes in (depth_png.code_lengths(), [int(digit) for digit in depth_png._DISTANCE_LENGTHS]):
        assert sum(2.0**-bits for bits in codes if bits) == 1.0
    assert max(depth_png.code_lengths()) == png.CODE_BITS
    assert max(depth_png.code_lengths()[: depth_png.END_OF_BLOCK]) == png.CODE_BITS
    assert png.SEGMENT == SEGMENT
    for name in ("MIN_RUN", "MAX_RUN", "MAX_DISTANCE"):
        assert getattr(kernels, name) == getattr(depth_png, name)
    # A match takes no more than the literals of two samples may.
    longest = max(bits for _, bits in depth_png.run_codes()) + max(bits for _, bits in depth_png.distance_codes())
    assert longest <= 4 * png.CODE_BITS


def test_files_of_scenes_are_no_larger_than_those_of_other_encoders():
    image = surfaces(360, 640)
    assert len(encode_depth(image)) < len(cv2.imencode(".png", image)[1])
