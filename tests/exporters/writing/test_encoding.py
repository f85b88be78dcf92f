"""PNG encoder: OpenCV and Pillow decode the pixels that were encoded. Its deflate does not depend on the stream's address. Run-length
encoding: runs of masks from run boundaries of images, and COCO's counts."""

import hashlib
import io
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image
from pycocotools import mask as coco

from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.exporters.writing import png, rle
from synpick_warp.exporters.writing.png import HEAD, Deflater, encode_mask_png, encode_png, hashed_mask_png
from synpick_warp.exporters.writing.rle import RunBoundaries, Runs, find_run_boundaries, find_runs, split_listed_runs
from synpick_warp.testing.box_views import pack_masks
from synpick_warp.views.frames import most_words, unpack_mask

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


COLOR = st.tuples(SIDE, SIDE, st.just(3))
IMAGES = ((np.uint8, GREY), (np.uint16, GREY), (np.dtype(">u2"), GREY), (np.uint8, COLOR), (np.uint16, COLOR))


@given(st.one_of(hnp.arrays(*each) for each in IMAGES))
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


def test_known_bytes():
    """A 2 x 2 greyscale image decoded by hand: signature, header, then rows with the filter "up". Views are encoded as their copies."""
    ring = np.arange(4 * 6 * 8 * 3, dtype=np.uint8).reshape(4, 6, 8, 3)
    assert encode_png(ring[2, ::2, 1:-1]) == encode_png(ring[2, ::2, 1:-1].copy())
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


@pytest.mark.parametrize("size", [1, 3, 100])
def test_cached_files_are_those_of_the_encoder_whatever_came_before(size, monkeypatch):
    """Masks of several episodes in turns, of images of two sizes, with and without room for all."""
    monkeypatch.setattr(rle, "_CACHED_MASKS", size)
    encoded: list[Runs] = []
    monkeypatch.setattr(png, "encode_mask_png", lambda runs, *size: encoded.append(runs) or encode_mask_png(runs, *size))
    draw = np.random.default_rng(0).integers
    masks = [find_runs(mask) for mask in draw(0, 2, (8, 5, 4), np.uint8)] + [find_runs(np.zeros((5, 4), np.uint8))]
    calls = [
        (masks[index], 5 + taller, 4 + taller) for index, taller in zip(draw(0, 9, 200).tolist(), draw(0, 2, 200).tolist(), strict=True)
    ]
    for call in calls:
        data = encode_mask_png(*call)
        assert hashed_mask_png(*call) == (data, hashlib.sha256(data).hexdigest())
    assert len(encoded) > 18 if size < 18 else len(encoded) <= 18


UNSUPPORTED = (np.zeros((2, 2)), np.zeros((2, 2, 2), np.uint16), np.zeros((2, 2, 4), np.uint8), np.zeros((0, 3), np.uint8))


@pytest.mark.parametrize("image", UNSUPPORTED)
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


def test_arrays_of_any_shape_are_compressed_as_bytes_of_which_the_first_are_flushed_separately():
    for shape in ((300,), (20, 15), (4, 5, 5, 3)):
        data = np.arange(300, dtype=np.uint16).astype(np.uint8).reshape(shape)
        assert zlib.decompress(deflate(data)) == data.tobytes()
    rows = flow_rows()
    reader, packed = zlib.decompressobj(), deflate(rows.tobytes())
    first = next(got for got in (reader.decompress(packed[place : place + 1]) for place in range(len(packed))) if got)
    assert first == rows.tobytes()[: len(first)]
    assert len(first) <= HEAD


def test_bytes_do_not_depend_on_the_stream_address():
    data = flow_rows()
    streams = [Deflater() for _ in range(STREAMS)]
    assert len({stream.compress(data) + stream.flush() for stream in streams}) == 1


SHORT = st.integers(1, 12)


def decode(counts: list[int], height: int, width: int) -> np.ndarray:
    """Decode COCO's uncompressed RLE: column-major runs that alternate between 0 and 1, starting with 0."""
    values = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    return values.reshape(width, height).T


def paint(runs: Runs, height: int, width: int) -> np.ndarray:
    full = np.zeros((height, width), bool)
    for column, first, past in zip(runs.column, runs.first, runs.past, strict=True):
        assert not full[first:past, column].any()
        full[first:past, column] = True
    return full


def place_randomly(image: np.ndarray, data: st.DataObject) -> tuple[np.ndarray, int, int, int, int]:
    """A crop, its first row and column, and height and width of an image that contains it."""
    rows, columns = image.shape
    height, width = rows + data.draw(st.integers(0, 3)), columns + data.draw(st.integers(0, 3))
    return image, data.draw(st.integers(0, height - rows)), data.draw(st.integers(0, width - columns)), height, width


def paste(part: np.ndarray, top: int, left: int, height: int, width: int) -> np.ndarray:
    full = np.zeros((height, width), part.dtype)
    full[top : top + part.shape[0], left : left + part.shape[1]] = part
    return full


@pytest.mark.parametrize("shape", [(0, 3), (3, 0), (0, 0), (2, 3)])
def test_an_empty_crop_has_no_runs(shape):
    runs = find_run_boundaries(np.zeros(shape, np.uint8), 2, 1).split_by_value([MAX_INSTANCES - 1])[0]
    assert runs.counts(4, 5).tolist() == [20]
    assert runs.box() is None
    assert runs.count == 0


@given(hnp.arrays(np.uint8, st.tuples(SHORT, SHORT), elements=st.integers(0, 3)), st.integers(1, 4), st.data())
def test_values_become_runs_and_run_lengths(image, value, data):
    part, top, left, height, width = place_randomly(image, data)
    expected = paste(part, top, left, height, width) == value
    runs = find_run_boundaries(part, top, left).runs_of(value)
    np.testing.assert_array_equal(paint(runs, height, width), expected)
    counts = runs.counts(height, width).tolist()
    assert sum(counts) == height * width
    assert all(counts[1:])
    np.testing.assert_array_equal(decode(counts, height, width), expected)
    assert runs.count == expected.sum()
    ys, xs = np.nonzero(expected)
    assert runs.box() == ((xs.min(), ys.min(), xs.max(), ys.max()) if expected.any() else None)


@given(hnp.arrays(bool, st.tuples(st.integers(1, 5), st.integers(1, 70), SHORT)), st.sampled_from([[0], [4, 1], range(5)]))
def test_packed_and_listed_masks_become_the_same_runs(masks, instances):
    """Words as the renderer packs them, and positions as it lists them."""
    _, height, width = masks.shape
    packed = pack_masks(masks)
    assert packed["mask_length"] <= len(masks) * most_words(width, height)
    crops = [unpack_mask(packed["mask_words"], *place) for place in zip(packed["mask_first"], packed["mask_box"], strict=True)]
    edges = [np.diff(np.pad(mask, ((1, 1), (0, 0))).astype(int), axis=0).T.ravel().nonzero()[0] for mask in masks]
    chosen = [instance for instance in instances if instance < len(masks)]
    listed = split_listed_runs(np.concatenate(edges).astype(np.uint32), np.array(list(map(len, edges))), height, chosen)
    for instance, runs in zip(chosen, listed, strict=True):
        left, top = packed["mask_box"][instance, :2]
        for one in (runs, find_runs(crops[instance], top, left)):
            np.testing.assert_array_equal(paint(one, height, width), masks[instance])
            assert one.count == masks[instance].sum()
            assert (one.top, one.bottom) == (runs.top, runs.bottom)
            same = [np.array_equal(masks[instance], masks[other]) for other in chosen]
            assert [one.key == other.key for other in listed] == same


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
@given(hnp.arrays(bool, st.tuples(SHORT, SHORT)))
def test_pycocotools_decodes_and_encodes_the_same_run_lengths(mask):
    height, width = mask.shape
    runs = find_runs(mask.astype(np.uint8))
    record = {"counts": runs.counts(height, width).tolist(), "size": [height, width]}
    theirs = coco.frPyObjects(record, height, width)
    np.testing.assert_array_equal(coco.decode(theirs), mask)
    assert coco.encode(np.asfortranarray(mask, np.uint8)) == theirs
    assert coco.area(theirs) == runs.count


@given(hnp.arrays(np.uint8, st.tuples(SHORT, SHORT), elements=st.sampled_from([0, 1, 2, 32, 251, 252, 255])), st.data())
def test_several_values_at_once_become_runs(image, data):
    part, top, left, height, width = place_randomly(image, data)
    for index, runs in zip((0, 1, 7, 250), find_run_boundaries(part, top, left).split_by_value((0, 1, 7, 250)), strict=True):
        np.testing.assert_array_equal(paint(runs, height, width), paste(image == 1 + index, top, left, height, width))


def test_images_with_more_positions_than_32_bits_are_split():
    place = np.array([5, 2**12, 2**35, 2**35 + 1], np.uint64)
    boundaries = RunBoundaries(place, 2**13, np.array([0, 9, 0, 9], np.uint32), np.array([9, 0, 9, 0], np.uint32))
    for runs in (boundaries.runs_of(9), boundaries.split_by_value([3, 8])[1]):
        assert [part.tolist() for part in (runs.column, runs.first, runs.past)] == [[0, 2**22], [5, 0], [2**12, 1]]
        assert (runs.count, runs.top, runs.bottom) == (2**12 - 4, 0, 2**12)
