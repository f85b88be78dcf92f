"""Crops of greyscale PNG files: equal to OpenCV's decoding, or refused."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
import pytest

from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.png import encode_mask_png, encode_png
from synpick_warp.exporters.writing.rle import find_run_boundaries
from synpick_warp.system.inputs.image_files import decode_image
from synpick_warp.system.inputs.png_crop import _WIDE, decode_grey_crop
from tests.worlds.model_files import pack_png

SIZE = 70, 50
"""Width and height."""
ROWS, COLUMNS = slice(7, 40), slice(11, 70)
MASK = (np.hypot(*np.mgrid[-20:30, -30:40]) < 18).astype(np.uint8)
IMAGE = np.random.default_rng(0).integers(0, 256, SIZE[::-1], dtype=np.uint8)


def png(rows: bytes, header: tuple[int, ...] = (*SIZE, 8, 0, 0, 0, 0)) -> bytes:
    width, height, depth, kind, *rest = header
    parts = ((b"tEXt", b"note"), (b"IDAT", zlib.compress(rows)[:30]), (b"IDAT", zlib.compress(rows)[30:]))
    return pack_png(width, height, *parts, depth=depth, kind=kind, rest=tuple(rest))


def lines(kind: int, image: np.ndarray) -> bytes:
    return b"".join(bytes([kind]) + row.tobytes() for row in image)


def test_crops_equal_the_whole_image():
    mask = encode_mask_png(find_run_boundaries(MASK, 0, 0).runs_of(1), *SIZE[::-1])
    np.testing.assert_array_equal(decode_grey_crop(mask, SIZE, ROWS, COLUMNS), 255 * MASK[ROWS, COLUMNS])
    np.testing.assert_array_equal(decode_grey_crop(encode_png(IMAGE), SIZE, ROWS, COLUMNS), IMAGE[ROWS, COLUMNS])
    np.testing.assert_array_equal(decode_grey_crop(png(lines(0, IMAGE)), SIZE, ROWS, COLUMNS), IMAGE[ROWS, COLUMNS])
    mixed = b"".join(bytes([kind]) + row.tobytes() for kind, row in zip((2, 2, 0, 2, 0) * 10, IMAGE, strict=True))
    decoded = cv2.imdecode(np.frombuffer(png(mixed), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(decode_grey_crop(png(mixed), SIZE, ROWS, COLUMNS), decoded[ROWS, COLUMNS])
    crop = decode_grey_crop(encode_png(IMAGE), SIZE, slice(0, 0), slice(3, 3))
    assert crop is not None
    assert crop.shape == (0, 0)


def test_images_of_16_bits_equal_opencv():
    depth = np.random.default_rng(1).integers(0, 1 << 16, SIZE[::-1], dtype=np.uint16)
    data = encode_png(depth)
    np.testing.assert_array_equal(decode_grey_crop(data, SIZE, ROWS, COLUMNS, bits=16), depth[ROWS, COLUMNS])
    for each in (data, png(lines(0, depth.astype(">u2")), (*SIZE, 16, 0, 0, 0, 0)), cv2.imencode(".png", depth)[1].tobytes()):
        image = decode_image(each, "depth.png", DatasetError, size=SIZE)
        assert image.dtype == np.dtype("=u2")
        np.testing.assert_array_equal(image, depth)
    assert decode_grey_crop(encode_png(IMAGE), SIZE, ROWS, COLUMNS, bits=16) is None


@pytest.mark.parametrize("width", [_WIDE // 2 - 1, _WIDE // 2, _WIDE])
def test_narrow_and_wide_crops_are_the_same(width):
    depth = np.random.default_rng(2).integers(0, 1 << 16, (9, width), dtype=np.uint16)
    np.testing.assert_array_equal(decode_image(encode_png(depth), "depth.png", DatasetError), depth)


def test_what_opencv_writes_is_equal_or_left_to_it():
    encoded = cv2.imencode(".png", 255 * MASK)[1].tobytes()
    crop = decode_grey_crop(encoded, SIZE, ROWS, COLUMNS)
    assert crop is None or (crop == 255 * MASK[ROWS, COLUMNS]).all()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xd8\xff",
        png(lines(1, IMAGE)),
        png(lines(0, IMAGE)[:-1]),
        png(lines(0, IMAGE), (*SIZE, 8, 0, 0, 0, 1)),
        png(lines(0, IMAGE), (*SIZE, 4, 0, 0, 0, 0)),
        png(lines(0, IMAGE), (*SIZE, 8, 3, 0, 0, 0)),
        png(lines(0, IMAGE), (SIZE[1], SIZE[0], 8, 0, 0, 0, 0)),
        png(lines(0, IMAGE)).replace(b"IDAT", b"IDAX"),
        png(lines(0, IMAGE))[:-20],
        png(lines(0, IMAGE))[:40],
        png(lines(0, IMAGE)).replace(b"tEXt", b"eXIf"),
        png(lines(0, IMAGE)).replace(b"tEXt", b"tRNS"),
        png(lines(0, IMAGE))[:29] + bytes(4) + png(lines(0, IMAGE))[33:],
        png(lines(0, IMAGE)).replace(zlib.crc32(b"IDAT" + zlib.compress(lines(0, IMAGE))[30:]).to_bytes(4, "big"), bytes(4)),
        encode_png(IMAGE.astype(np.uint16)),
        encode_png(np.zeros((*IMAGE.shape, 3), np.uint8)),
    ],
)
def test_other_files_are_refused(data):
    assert decode_grey_crop(data, SIZE, ROWS, COLUMNS) is None


def test_damaged_streams_are_refused_and_bombs_stay_small():
    data = bytearray(encode_png(IMAGE))
    for place in range(41, len(data) - 20, 97):
        broken = bytes(data[:place]) + bytes([data[place] ^ 0x5A]) + bytes(data[place + 1 :])
        assert decode_grey_crop(broken, SIZE, ROWS, COLUMNS) is None
    bomb = png(lines(0, IMAGE) + bytes(10**7))
    np.testing.assert_array_equal(decode_grey_crop(bomb, SIZE, ROWS, COLUMNS), IMAGE[ROWS, COLUMNS])
