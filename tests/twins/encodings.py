"""Depth PNG data in NumPy and whole numbers, from the laws in `system.codecs.depth_png` and kernels.encoding.png's docstrings, and
entropy-coded segments of baseline JPEG, from ITU-T T.81, annex F, and the tables of `system.codecs.jpeg`."""

import zlib

import numpy as np

from synpick_warp.system.codecs.depth_png import (
    MAX_DISTANCE,
    MAX_RUN,
    MIN_RUN,
    Bits,
    distance_codes,
    end_code,
    join_bits,
    literal_codes,
    make_prefix,
    run_codes,
)
from synpick_warp.system.codecs.jpeg import huffman_codes

SEGMENT = 258
"""Samples that are coded on their own; matches do not cross their ends."""


def filter_rows(image: np.ndarray) -> np.ndarray:
    """Rows (H, 1 + 2 W) uint8 as PNG has them: filter type 2 ("up"), then each big-endian byte less the one above."""
    rows = np.ascontiguousarray(image.astype(">u2")).view(np.uint8).reshape(len(image), -1)
    above = np.concatenate((np.zeros_like(rows[:1]), rows[:-1]))
    return np.concatenate((np.full((len(rows), 1), 2, np.uint8), rows - above), axis=1)


def encode_depth(image: np.ndarray) -> bytes:
    """Data (IDAT) of a depth image (H, W) uint16."""
    literals, runs, distances = literal_codes(), run_codes(), distance_codes()
    filtered = filter_rows(image)
    parts = [make_prefix()]
    for row in filtered:
        parts.append(literals[row[0]])
        samples = row[1:].reshape(-1, 2).tolist()
        for begin in range(0, len(samples), SEGMENT):
            parts += _encode_segment(samples, begin, min(begin + SEGMENT, len(samples)), literals, runs, distances)
    value, count = join_bits([*parts, end_code()])
    return value.to_bytes(-(-count // 8), "little") + zlib.adler32(filtered.tobytes()).to_bytes(4, "big")


def _encode_segment(
    samples: list[list[int]], begin: int, end: int, literals: list[Bits], runs: list[Bits], distances: list[Bits]
) -> list[Bits]:
    """Greedy matches: at each sample the longest run, at its shortest distance; literals where it is shorter than two samples."""
    parts = []
    place = begin
    while place < end:
        found = [(_run_length(samples, place, end, distance), -distance) for distance in range(1, min(MAX_DISTANCE, place) + 1)]
        length, distance = max(found, default=(0, 0))
        if length >= MIN_RUN:
            parts += [runs[length], distances[-distance - 1]]
        else:
            parts += [literals[byte] for byte in samples[place]]
        place += max(length, 1)
    return parts


def _run_length(samples: list[list[int]], place: int, end: int, distance: int) -> int:
    length = 0
    while length < MAX_RUN and place + length < end and samples[place + length] == samples[place + length - distance]:
        length += 1
    return length


_DC, _AC = (list(zip(*tables, strict=True)) for tables in huffman_codes().values())
_COMPONENTS = (0, 0, 0, 0, 1, 2)


def code_blocks(blocks: np.ndarray, interval_blocks: int) -> list[str]:
    """Codes of blocks (N, 64) of whole MCUs in zigzag order, as strings of 0 and 1; the DC prediction restarts in each interval."""
    codes = []
    previous = [0, 0, 0]
    for index, block in enumerate(blocks.tolist()):
        if index % interval_blocks == 0:
            previous = [0, 0, 0]
        component = _COMPONENTS[index % 6]
        codes.append(_code_block(block, previous[component], min(component, 1)))
        previous[component] = block[0]
    return codes


def code_interval(codes: list[str]) -> bytes:
    """Bytes of an interval's codes, filled up with ones, not stuffed."""
    bits = "".join(codes)
    bits += "1" * (-len(bits) % 8)
    return int("1" + bits, 2).to_bytes(len(bits) // 8 + 1, "big")[1:]


def _code_block(block: list[int], previous: int, table: int) -> str:
    code = _code_value(_DC[table], 0, block[0] - previous)
    zeros = 0
    for value in block[1:]:
        if value == 0:
            zeros += 1
            continue
        code += _symbol(_AC[table], 0xF0) * (zeros // 16) + _code_value(_AC[table], zeros % 16, value)
        zeros = 0
    return code + (_symbol(_AC[table], 0) if zeros else "")


def _code_value(table: tuple[np.ndarray, np.ndarray], zeros: int, value: int) -> str:
    """Symbol of a run of zeros and a value's number of bits, and these bits; of a negative value those of its complement."""
    count = abs(value).bit_length()
    bits = f"{value if value > 0 else value + (1 << count) - 1:0{count}b}" if count else ""
    return _symbol(table, 16 * zeros + count) + bits


def _symbol(table: tuple[np.ndarray, np.ndarray], symbol: int) -> str:
    return f"{table[0][symbol]:0{table[1][symbol]}b}"
