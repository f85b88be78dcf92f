"""Entropy-coded segments of baseline JPEG in whole numbers, from ITU-T T.81, annex F, and the tables of `system.codecs.jpeg`."""

from __future__ import annotations

import numpy as np

from synpick_warp.system.codecs.jpeg import huffman_codes

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
