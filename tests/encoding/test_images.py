"""Images encoded on the device: JPEGs are those of libjpeg, depth PNGs those of the twin, read by the decoders of the field."""

import io
import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import scipy.fft
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.png import frame_depth_png
from synpick_warp.kernels.encoding import huffman, stuffing
from synpick_warp.kernels.encoding import png as kernels
from synpick_warp.kernels.encoding.dct import JpegData, quantize, transform_block
from synpick_warp.kernels.encoding.stuffing import JpegFiles
from synpick_warp.stages import encoding
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.encoding import (
    DepthBuffers,
    DepthEncoder,
    JpegBuffers,
    JpegEncoder,
    JpegScratch,
    allocate_depth_scratch,
    depth_sizes,
    jpeg_sizes,
    upload_huffman,
)
from synpick_warp.system.codecs import depth_png, jpeg
from synpick_warp.system.inputs.image_files import decode_image
from tests.harness.hostile import fuzz_examples
from tests.harness.probe import probe
from tests.twins.encodings import SEGMENT, code_blocks, code_interval, encode_depth, filter_rows

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


def checkerboard(step: int) -> np.ndarray:
    """Squares of `step` px, whose only AC coefficients are the last ones, beside grey; a partial MCU at the border."""
    rows, columns = np.mgrid[:50, :70]
    image = np.full((50, 70, 3), 128, np.uint8)
    image[:, :35] = np.where((rows // step + columns // step) % 2, 90, 160)[:, :35, None]
    return image


@pytest.mark.parametrize(
    ("images", "qualities"),
    [
        # Whole and partial blocks and MCUs; up to several restart intervals.
        *[
            pytest.param([picture(*shape)], [95], id="{} x {}".format(*shape))
            for shape in ((1, 1), (8, 8), (9, 16), (16, 17), (17, 33), (40, 64), (41, 63), (90, 160), (100, 530))
        ],
        pytest.param([picture(50, 70, seed) for seed in range(7)], [1, 10, 49, 50, 75, 90, 96], id="a quality a view"),
        *[pytest.param([checkerboard(step)], [quality], id=f"runs of zeros {quality}") for quality, step in ((50, 1), (95, 1), (75, 3))],
    ],
)
def test_files_are_those_of_libjpeg(device, images, qualities):
    expected = [jpeg.encode_jpeg(*pair).tobytes() for pair in zip(images, qualities, strict=True)]
    assert encode(np.stack(images), qualities, device) == expected


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


@pytest.mark.parametrize("quality", [1, 25, 50, 95, 100])
def test_quantization_and_header_are_those_of_libjpeg(quality):
    file = jpeg.encode_jpeg(np.zeros((20, 30, 3), np.uint8), quality).tobytes()
    header = jpeg.make_header(30, 20, quality)
    assert file.startswith(header)
    assert len(header) == len(jpeg.make_header(1920, 1080, 95))
    # Tables K.1 and K.2 are those of quality 50.
    assert jpeg.quantization(50)[:, :6].tolist() == [[16, 11, 12, 14, 12, 10], [17, 18, 18, 24, 21, 24]]


# ---- passes of the coder ----


wp.set_module_options({"enable_backward": False})

SENTINEL = 0xA5


@wp.func
def quantize_all(reciprocal: wp.uint32, quotient: wp.array2d[int], row: int):
    """Quotients (row, magnitude) of negative coefficients."""
    for magnitude in range(quotient.shape[1]):
        quotient[row, magnitude] = quantize(-magnitude, reciprocal)


quotients = probe(quantize_all)


def test_reciprocals_divide_exactly(device):
    """Exact division by reciprocals: all divisors of all qualities, all 16-bit magnitudes."""
    divisors = jpeg.DIVISOR_SCALE * np.arange(1, 256)
    magnitudes = np.arange(1 << 16)
    out = wp.empty((len(divisors), len(magnitudes)), dtype=int, device=device)
    quotients(jpeg.reciprocals(divisors), out, np.arange(len(divisors)), device=device)
    assert all(np.array_equal(row, -((magnitudes + d // 2) // d)) for row, d in zip(out.numpy(), divisors, strict=True))


def code(blocks: np.ndarray, interval_blocks: int, device, slot_words: int = 4096) -> SimpleNamespace:
    """Lengths, offsets, slots and sizes of blocks (view, N, 64) in zigzag order; slots are full of ones before."""
    views, count = blocks.shape[:2]
    intervals = -(-count // interval_blocks)
    quads = np.ascontiguousarray(blocks.astype("<i2")).view(np.uint64).transpose(0, 2, 1)
    masks = ((blocks != 0) << np.arange(64, dtype=np.uint64)).sum(axis=2, dtype=np.uint64)
    tables, data = upload_huffman(device), JpegData()
    data.coefficient, data.nonzero = (wp.array(values, dtype=wp.uint64, device=device) for values in (quads, masks))
    data.block_bits, data.block_begin = (wp.empty((views, count), dtype=int, device=device) for _ in range(2))
    data.coded, data.interval_size = (wp.empty((views, intervals), dtype=int, device=device) for _ in range(2))
    data.slot = wp.full((views, intervals, slot_words), 0xFFFFFFFF, dtype=wp.uint32, device=device)
    wp.launch(huffman.measure_blocks_kernel, (views, count), [tables, interval_blocks], [data], device=device)
    wp.launch(huffman.place_blocks_kernel, (views, intervals), [interval_blocks, 2], [data], device=device)
    wp.launch(huffman.write_blocks_kernel, (views, count), [tables, interval_blocks], [data], device=device)
    arrays = {"bits": data.block_bits, "begin": data.block_begin, "slot": data.slot, "coded": data.coded, "size": data.interval_size}
    return SimpleNamespace(**{name: array.numpy() for name, array in arrays.items()})


def data_of(result: SimpleNamespace, view: int, interval: int) -> bytes:
    """Bytes of a slot's bit string."""
    return result.slot[view, interval].astype(">u4").tobytes()[: result.coded[view, interval]]


def random_blocks(views: int, mcus: int, seed: int = 0) -> np.ndarray:
    """Blocks (view, block, 64) of all densities, from none to 64 coefficients, of 1 to 10 bits."""
    random = np.random.default_rng(seed)
    shape = (views, 6 * mcus, 64)
    values = random.integers(-1, 2, shape) * random.integers(1, 2 ** random.integers(1, 11, shape))
    values[random.random(shape) > random.choice([0.0, 0.02, 0.1, 0.5, 1.0], (*shape[:2], 1))] = 0
    return values


@pytest.mark.parametrize(("mcus", "interval_mcus"), [(1, 32), (1, 1), (7, 1), (9, 4), (64, 32), (65, 32)])
def test_lengths_and_bits_are_those_of_the_twin(device, mcus, interval_mcus):
    """Restart intervals of one and of several MCUs, incomplete last intervals, and batches of several views."""
    blocks = random_blocks(2, mcus, mcus)
    interval_blocks = 6 * interval_mcus
    result = code(blocks, interval_blocks, device, slot_words=10_000)
    for view in range(len(blocks)):
        codes = code_blocks(blocks[view], interval_blocks)
        assert result.bits[view].tolist() == [len(part) for part in codes]
        for interval in range(result.slot.shape[1]):
            part = codes[interval * interval_blocks : (interval + 1) * interval_blocks]
            assert data_of(result, view, interval) == code_interval(part)


def test_a_slot_is_never_exceeded(device):
    """Words within the slot are the same as in a larger one; those of the next slot are its own."""
    blocks = random_blocks(1, 8)
    whole, cut = code(blocks, 24, device), code(blocks, 24, device, slot_words=20)
    assert whole.coded.tolist() == cut.coded.tolist()
    assert whole.coded.min() > 80
    assert np.array_equal(whole.slot[:, :, :20], cut.slot)


def join(strings: list[bytes], lanes: int, capacity: int, device, slot_words: int = 16) -> tuple[np.ndarray, int]:
    """File (capacity) of a view with a header of 3 bytes and intervals of these bit strings, and its size; view 1 is left out."""
    header = np.array([[1, 2, 3]], np.uint8)
    padded = np.zeros((1, len(strings), 4 * slot_words), np.uint8)
    for interval, string in enumerate(strings):
        padded[0, interval, : len(string)] = list(string[: 4 * slot_words])
    data, files, shape = JpegData(), JpegFiles(), (1, len(strings))
    data.slot = wp.array(padded.view(">u4").astype(np.uint32), dtype=wp.uint32, device=device)
    sizes = [[len(string) for string in strings]]
    data.coded, data.interval_size = (wp.array(np.add(sizes, more), dtype=int, device=device) for more in (0, 2))
    data.stuffing, data.interval_begin = (wp.empty(extents, dtype=int, device=device) for extents in ((*shape, lanes), shape))
    files.jpeg_size, files.jpeg = wp.empty(1, dtype=int, device=device), wp.full((2, capacity), SENTINEL, dtype=wp.uint8, device=device)
    wp.launch(stuffing.count_stuffing_kernel, (*shape, lanes), [], [data], device=device)
    wp.launch(stuffing.place_intervals_kernel, 1, [header.shape[1]], [data, files], device=device)
    inputs = [data, wp.zeros(1, dtype=int, device=device), wp.array(header, device=device)]
    wp.launch(stuffing.join_intervals_kernel, (*shape, lanes), inputs, [files], device=device)
    file = files.jpeg
    assert (file.numpy()[1] == SENTINEL).all()
    return file.numpy()[0], int(files.jpeg_size.numpy()[0])


def expected_file(strings: list[bytes]) -> bytes:
    """The same by `bytes.replace`."""
    parts = [bytes([1, 2, 3])]
    for interval, string in enumerate(strings):
        marker = 0xD0 + interval % 8 if interval < len(strings) - 1 else 0xD9
        parts.append(string.replace(b"\xff", b"\xff\x00") + bytes([0xFF, marker]))
    return b"".join(parts)


@pytest.mark.parametrize("lanes", [1, 3, 4, 32])
@pytest.mark.parametrize(
    "strings",
    [
        # One byte 0xFF anywhere in a string of 33 bytes, which four lanes share in chunks of 12; also none, all, and neighbours of 0xFF.
        [bytes(33), b"\xff" * 33, b"\xfe\x7f\x80" * 11, *(bytes(k) + b"\xff" + bytes(32 - k) for k in range(33))],
        # 1 to 64 bytes, a whole slot; the markers RST0 to RST7 in turn.
        [np.random.default_rng(n).choice([0, 1, 0xFF], n).astype(np.uint8).tobytes() for n in range(1, 65)],
    ],
    ids=["stuffing at every position", "all lengths"],
)
def test_strings_are_joined(device, strings, lanes):
    file, size = join(strings, lanes, 8192, device)
    assert file[:size].tobytes() == expected_file(strings)


def test_capacities_of_files_and_slots(device):
    """The size of a file that is exceeded is true; one whose slot is exceeded has a size above the capacity. Nothing is written beyond."""
    cases = [b"\xff\xff", b"\x01" * 64]
    whole = expected_file(cases)
    file, size = join(cases, 4, len(whole), device)
    assert file[:size].tobytes() == whole
    for capacity in range(3, len(whole)):
        file, size = join(cases, 4, capacity, device)
        assert (size, file.tobytes()) == (len(whole), whole[:capacity])
    file, size = join([b"\xff\xff", b"\x01" * 65], 4, 200, device)
    assert size == 201
    assert (file[len(whole) + 1 :] == SENTINEL).all()


# ---- depth PNGs ----


def encode_depths(images: np.ndarray, device) -> list[bytes | None]:
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
    found = encode_depths(images, device)
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
    (data,) = encode_depths(image[None], wp.get_device("cpu"))
    assert data == encode_depth(image)
    assert zlib.decompress(data) == filter_rows(image).tobytes()


def test_decoders_read_depth(device):
    image = surfaces(180, 640)
    (data,) = encode_depths(image[None], device)
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
    assert encode_depths(images, device) == [encode_depth(images[0]), None, encode_depth(images[2])]


def test_the_longest_codes_fit_slots_and_those_of_small_images_the_capacity(device):
    lengths = depth_png.code_lengths()[:256]
    longest = [value for value, bits in enumerate(lengths) if bits == max(lengths)]
    for shape in ((40, 250), (10000, 1), (1, 10000)):
        size = shape[0] * shape[1]
        # No two samples in reach are equal.
        bytes_ = np.array([(longest[index % 7], longest[index % len(longest)]) for index in range(size)], np.uint8)
        residual = bytes_.reshape(shape[0], -1)
        image = np.add.accumulate(residual, axis=0, dtype=np.uint8).view(">u2").astype(np.uint16)
        (data,) = encode_depths(image[None], device)
        assert data == encode_depth(image)


def test_codes_are_complete():
    for codes in (depth_png.code_lengths(), [int(digit) for digit in depth_png._DISTANCE_LENGTHS]):
        assert sum(2.0**-bits for bits in codes if bits) == 1.0
    assert max(depth_png.code_lengths()) == encoding.CODE_BITS
    assert max(depth_png.code_lengths()[: depth_png.END_OF_BLOCK]) == encoding.CODE_BITS
    assert encoding.SEGMENT == SEGMENT
    for name in ("MIN_RUN", "MAX_RUN", "MAX_DISTANCE"):
        assert getattr(kernels, name) == getattr(depth_png, name)
    # A match takes no more than the literals of two samples may.
    longest = max(bits for _, bits in depth_png.run_codes()) + max(bits for _, bits in depth_png.distance_codes())
    assert longest <= 4 * encoding.CODE_BITS


def test_files_of_scenes_are_no_larger_than_those_of_other_encoders():
    image = surfaces(360, 640)
    assert len(encode_depth(image)) < len(cv2.imencode(".png", image)[1])
