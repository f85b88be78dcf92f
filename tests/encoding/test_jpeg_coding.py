"""Passes of the JPEG coder on the device: quantization, lengths and bits of blocks, stuffing, capacities; known answers, then the twin."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from synpick_warp.kernels.encoding import huffman, stuffing
from synpick_warp.kernels.encoding.dct import quantize
from synpick_warp.stages.encoding.jpeg import upload_huffman
from synpick_warp.system.codecs import jpeg
from tests.encoding.test_jpeg import encode
from tests.harness.probe import probe
from tests.twins.jpeg_entropy import code_blocks, code_interval

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
    coefficient, nonzero = wp.array(quads, dtype=wp.uint64, device=device), wp.array(masks, dtype=wp.uint64, device=device)
    tables = upload_huffman(device)
    bits, begin = (wp.empty((views, count), dtype=int, device=device) for _ in range(2))
    coded, size = (wp.empty((views, intervals), dtype=int, device=device) for _ in range(2))
    slot = wp.full((views, intervals, slot_words), 0xFFFFFFFF, dtype=wp.uint32, device=device)
    wp.launch(huffman.measure_blocks_kernel, (views, count), [tables, coefficient, nonzero, interval_blocks], [bits], device=device)
    outputs = [begin, slot, coded, size]
    wp.launch(huffman.place_blocks_kernel, (views, intervals), [bits, interval_blocks, 2], outputs, device=device)
    inputs = [tables, coefficient, nonzero, begin, interval_blocks]
    wp.launch(huffman.write_blocks_kernel, (views, count), inputs, [slot], device=device)
    arrays = {"bits": bits, "begin": begin, "slot": slot, "coded": coded, "size": size}
    return SimpleNamespace(**{name: array.numpy() for name, array in arrays.items()})


def data_of(result: SimpleNamespace, view: int, interval: int) -> bytes:
    """Bytes of a slot's bit string."""
    return result.slot[view, interval].astype(">u4").tobytes()[: result.coded[view, interval]]


def test_known_bits_of_blocks(device):
    """Y: nothing; DC 5; ZRL and a one at 17; a last coefficient, so no EOB. Cb: nothing. Cr: -1 at 63 after three ZRL."""
    blocks = np.zeros((1, 6, 64), int)
    blocks[0, 1, 0] = blocks[0, 2, 0] = blocks[0, 3, 0] = 5
    blocks[0, 2, 17] = 1
    blocks[0, 3, 1:] = 1
    blocks[0, 5, 63] = -1
    zrl = "11111111001"
    codes = ["00" + "1010", "100101" + "1010", "00" + zrl + "001" + "1010", "00" + 63 * "001", "00" + "00"]
    codes.append("00" + 3 * "1111111010" + "11111111100000" + "0")
    result = code(blocks, 6, device)
    assert code_blocks(blocks[0], 6) == codes
    assert result.bits[0].tolist() == [6, 10, 20, 191, 4, 47]
    assert result.begin[0].tolist() == [0, 6, 16, 36, 227, 231]
    assert data_of(result, 0, 0) == code_interval(codes)
    assert (result.coded.tolist(), result.size.tolist()) == ([[35]], [[37]])


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


def test_empty_blocks_share_words(device):
    """32 MCUs of zeros: 4 x 6 + 2 x 4 bits each, so that eight blocks can lie in a word."""
    result = code(np.zeros((1, 192, 64), int), 192, device)
    assert data_of(result, 0, 0) == bytes.fromhex("28a28a00") * 32
    assert result.begin[0, :8].tolist() == [0, 6, 12, 18, 24, 28, 32, 38]


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
    slot = wp.array(padded.view(">u4").astype(np.uint32), dtype=wp.uint32, device=device)
    coded = wp.array([[len(string) for string in strings]], dtype=int, device=device)
    size = wp.array([[len(string) + 2 for string in strings]], dtype=int, device=device)
    counts = wp.empty((1, len(strings), lanes), dtype=int, device=device)
    begin, total = wp.empty((1, len(strings)), dtype=int, device=device), wp.empty(1, dtype=int, device=device)
    file = wp.full((2, capacity), SENTINEL, dtype=wp.uint8, device=device)
    wp.launch(stuffing.count_stuffing_kernel, counts.shape, [slot, coded], [counts, size], device=device)
    inputs = [coded, size, 4 * slot_words, header.shape[1], capacity]
    wp.launch(stuffing.place_intervals_kernel, 1, inputs, [begin, total], device=device)
    inputs = [slot, coded, size, begin, counts, wp.zeros(1, dtype=int, device=device), wp.array(header, device=device)]
    wp.launch(stuffing.join_intervals_kernel, counts.shape, inputs, [file], device=device)
    assert (file.numpy()[1] == SENTINEL).all()
    return file.numpy()[0], int(total.numpy()[0])


def expected_file(strings: list[bytes]) -> bytes:
    """The same by `bytes.replace`."""
    parts = [bytes([1, 2, 3])]
    for interval, string in enumerate(strings):
        marker = 0xD0 + interval % 8 if interval < len(strings) - 1 else 0xD9
        parts.append(string.replace(b"\xff", b"\xff\x00") + bytes([0xFF, marker]))
    return b"".join(parts)


def test_stuffing_at_every_position(device):
    """One byte 0xFF anywhere in a string of 33 bytes, which four lanes share in chunks of 12; also none, all, and neighbours of 0xFF."""
    cases = [bytes(33), b"\xff" * 33, b"\xfe\x7f\x80" * 11]
    cases += [bytes(k) + b"\xff" + bytes(32 - k) for k in range(33)]
    for lanes in (1, 4, 32):
        file, size = join(cases, lanes, 4096, device)
        assert file[:size].tobytes() == expected_file(cases)


def test_strings_of_all_lengths(device):
    """1 to 64 bytes, a whole slot; the markers RST0 to RST7 in turn."""
    random = np.random.default_rng(0)
    cases = [random.choice([0, 1, 0xFF], n).astype(np.uint8).tobytes() for n in range(1, 65)]
    for lanes in (1, 3, 32):
        file, size = join(cases, lanes, 8192, device)
        assert file[:size].tobytes() == expected_file(cases)


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


@pytest.mark.parametrize(("quality", "step"), [(50, 1), (95, 1), (75, 3)])
def test_patterns_with_long_runs_of_zeros(device, quality, step):
    """Checkerboards, whose only AC coefficients are the last ones, beside grey: ZRL and blocks without any; a partial MCU at the border."""
    rows, columns = np.mgrid[:50, :70]
    image = np.full((50, 70, 3), 128, np.uint8)
    image[:, :35] = np.where((rows // step + columns // step) % 2, 90, 160)[:, :35, None]
    assert encode(image[None], [quality], device) == [jpeg.encode_jpeg(image, quality).tobytes()]
