"""JPEG on the device: the bytes of libjpeg, read by the decoders of the field."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
import scipy.fft
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from synpick_warp.kernels.encoding.dct import ZIGZAG, transform_block
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.encoding.jpeg import JpegBuffers, JpegEncoder, JpegScratch, jpeg_sizes
from synpick_warp.system.codecs import jpeg
from tests.harness.probe import probe

transform = probe(transform_block)


def encode(images: np.ndarray, qualities: list[int], device) -> list[bytes | None]:
    """Files of images (view, row, column, channel); None: it exceeds the capacity."""
    views, height, width = images.shape[:3]
    out = allocate(JpegBuffers, jpeg_sizes(views, width, height), device)
    image, quality = wp.array(images, dtype=wp.vec3ub, device=device), wp.array(qualities, dtype=wp.int32, device=device)
    JpegEncoder(allocate(JpegScratch, jpeg_sizes(views, width, height), device), width, height).encode(image, quality, views, out)
    files, sizes = out.jpeg.numpy(), out.jpeg_size.numpy()
    return [data[:size].tobytes() if size <= len(data) else None for data, size in zip(files, sizes, strict=True)]


def picture(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Smooth colours with noise, edges and saturated areas."""
    random = np.random.default_rng(seed)
    coarse = random.integers(-60, 316, (2 + height // 9, 2 + width // 9, 3)).astype(np.float32)
    image = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC) + random.normal(0.0, 2.0, (height, width, 1))
    image[height // 3 : height // 2, width // 4 :] = random.integers(0, 256, 3)
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("shape", [(1, 1), (8, 8), (9, 16), (16, 17), (17, 33), (40, 64), (41, 63), (90, 160), (100, 530)])
def test_files_are_those_of_libjpeg(device, shape):
    """Sizes with whole and partial blocks and MCUs; up to several restart intervals."""
    image = picture(*shape)
    assert encode(image[None], [95], device) == [jpeg.encode_jpeg(image, 95).tobytes()]


def test_each_view_has_its_quality(device):
    images = np.stack([picture(50, 70, seed) for seed in range(7)])
    qualities = [1, 10, 49, 50, 75, 90, 96]
    assert encode(images, qualities, device) == [jpeg.encode_jpeg(*pair).tobytes() for pair in zip(images, qualities, strict=True)]


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 40), st.integers(1, 100), st.integers(0, 2))
def test_fuzz_any_image_and_quality(seed, height, width, quality, kind):
    """Noise, noise of black and white, and constant images, which have the longest runs of zeros."""
    random = np.random.default_rng(seed)
    image = random.integers(0, 256, (height, width, 3), dtype=np.uint8)
    image = (image, image // 128 * 255, np.full_like(image, image[0, 0]))[kind]
    (file,) = encode(image[None], [quality], wp.get_device("cpu"))
    assert file is None or file == jpeg.encode_jpeg(image, quality).tobytes()


def test_a_file_beyond_the_capacity_is_flagged(device):
    noise = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8)
    noise[1] = 128
    assert encode(noise, [100, 100], device) == [None, jpeg.encode_jpeg(noise[1], 100).tobytes()]


def test_decoders_read_it(device):
    image = picture(90, 160)
    (file,) = encode(image[None], [95], device)
    by_opencv = cv2.cvtColor(cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    by_pillow = np.asarray(Image.open(io.BytesIO(file)))
    assert np.abs(by_opencv.astype(int) - by_pillow).max() <= 2
    # Chroma has half the resolution.
    assert np.abs(by_pillow.astype(int) - image).mean() < 5.0


def test_the_transform_is_a_dct(device):
    samples = np.random.default_rng(1).integers(-128, 128, (50, 8, 8))
    found = transform(samples.reshape(50, 64), device=device)
    expected = jpeg.DIVISOR_SCALE * scipy.fft.dctn(samples, axes=(1, 2), norm="ortho")
    assert np.abs(found.reshape(50, 8, 8) - expected).max() < 4.0


def test_zigzag_order():
    order = jpeg.zigzag_order()
    assert order[:10].tolist() == [0, 1, 8, 16, 9, 2, 3, 10, 17, 24]
    assert sorted(order.tolist()) == list(range(64))
    assert order[-1] == 63
    assert tuple(order) == ZIGZAG


@pytest.mark.parametrize("quality", [1, 25, 50, 95, 100])
def test_quantization_and_header_are_those_of_libjpeg(quality):
    file = jpeg.encode_jpeg(np.zeros((20, 30, 3), np.uint8), quality).tobytes()
    header = jpeg.make_header(30, 20, quality)
    assert file.startswith(header)
    assert len(header) == len(jpeg.make_header(1920, 1080, 95))
