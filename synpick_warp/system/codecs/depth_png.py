"""Depth images as PNG: 16-bit greyscale, "up" filter in every row, one deflate block with constant Huffman codes.

Here are the codes, and what precedes them in the file's data (IDAT); the encoder is `stages.encoding.png`. Matches reach back by whole
samples, at most eight, in the same row, so that segments of rows are coded in parallel.
"""

import numpy as np

MAX_RUN = 129
"""Samples in the longest match, of 258 bytes."""
MIN_RUN = 2
"""Samples in the shortest match, of 4 bytes."""
MAX_DISTANCE = 8
"""Longest distance of a match [samples]. Of twice as many, files would be 2.5 % smaller."""
END_OF_BLOCK = 256
"""Symbol that ends a deflate block (RFC 1951, section 3.2.5)."""
_CODE_LENGTHS = (
    "25567777788888889889999999999a9a999aa99a99999aaaaaabbbbbbbbbbbbb"
    "bbbbbcbbbbcbbbbbbccccccccccccccccccccccccccccccccdddcddddcdccddd"
    "ccdddccdddcdcccdcccdcccccdcdccccccdcccccccccccccccccccccccccccbc"
    "ccccccccbbbbbbbcbbbbbbbbbbbbbbaaabaaaaaaaa9a99999998888876776555"
    "d04040505667878888999999988986"
)
"""Bits of the code of each literal, of the end of the block, and of each length symbol, as hexadecimal digits; 0: not used.

Package-merge with at most 13 bits, over the symbols of 70 depth images: totes of YCB-Video objects at 1920x1080 (with twice the weight)
and 640x360, boxes at 320x180, and the first with 0.1 and 2.5 times their values. An image's own codes would make its file smaller, by
2 % at 1920x1080, 3 % at 640x360 and 4 to 6 % at 320x180.
"""
_DISTANCE_LENGTHS = "01043433"
"""The same of each distance symbol."""
_COMMON_LENGTH = 12
"""Commonest code length: the header has a code of one bit for it, and one of five for every other."""
_LENGTH_ORDER = (16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15)
"""Order of code lengths in the header (RFC 1951, section 3.2.7)."""
_LENGTHS = (3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258)
_LENGTH_BITS = (0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0)
"""Shortest match of each length symbol from 257 on [B], and bits that follow the symbol (RFC 1951, section 3.2.5)."""
_DISTANCES = (1, 2, 3, 4, 5, 7, 9, 13)
_DISTANCE_BITS = (0, 0, 0, 0, 1, 1, 2, 2)
"""Shortest distance of each distance symbol [B], and bits that follow the symbol."""
_ZLIB_HEADER = (0x0178, 16)
"""Header of a zlib stream (RFC 1950, section 2.2): deflate, window of 32 kB, fastest compression."""
_SAMPLE_BYTES = 2
_MIN_CAPACITY = 1 << 16
"""Constant part of the capacity of a file [B]; half a byte a pixel is added."""
_FRAME_BYTES, _PIXEL_BYTES = 256, 6
"""Header and end of the data [B], and two literals and a row's filter type [B], at most."""

Bits = tuple[int, int]
"""Value, whose lowest bit comes first, and number of bits."""


def code_lengths() -> list[int]:
    """Code lengths [bits] of the literal/length alphabet: the 256 bytes, the end of the block, the length symbols; 0: not used. Distance
    symbols are apart (`_DISTANCE_LENGTHS`)."""
    return [int(digit, 16) for digit in _CODE_LENGTHS]


def huffman_codes(lengths: list[int]) -> list[Bits]:
    """Canonical codes of deflate (RFC 1951, section 3.2.2) by symbol, as they stand in the data: the first bit lowest."""
    codes: list[Bits] = [(0, 0)] * len(lengths)
    code = 0
    for length in range(1, max(lengths) + 1):
        code <<= 1
        for symbol in (symbol for symbol, bits in enumerate(lengths) if bits == length):
            codes[symbol] = int(f"{code:0{length}b}"[::-1], 2), length
            code += 1
    return codes


def literal_codes() -> list[Bits]:
    """Huffman codes of the 256 byte values, in their order."""
    return huffman_codes(code_lengths())[:END_OF_BLOCK]


def end_code() -> Bits:
    """Huffman code of the end of the block."""
    return huffman_codes(code_lengths())[END_OF_BLOCK]


def run_codes() -> list[Bits]:
    """Length codes of matches of 0, 1, 2, ... `MAX_RUN` samples; there are none of fewer than `MIN_RUN`."""
    codes = huffman_codes(code_lengths())[END_OF_BLOCK + 1 :]
    lengths = range(_SAMPLE_BYTES * MIN_RUN, _SAMPLE_BYTES * MAX_RUN + 1, _SAMPLE_BYTES)
    return [(0, 0)] * MIN_RUN + [_with_extra(length, _LENGTHS, _LENGTH_BITS, codes) for length in lengths]


def distance_codes() -> list[Bits]:
    """Codes of the distances 1, 2, ... `MAX_DISTANCE` samples."""
    codes = huffman_codes(list(map(int, _DISTANCE_LENGTHS)))
    distances = range(_SAMPLE_BYTES, _SAMPLE_BYTES * MAX_DISTANCE + 1, _SAMPLE_BYTES)
    return [_with_extra(distance, _DISTANCES, _DISTANCE_BITS, codes) for distance in distances]


def _with_extra(value: int, bases: tuple[int, ...], extra: tuple[int, ...], codes: list[Bits]) -> Bits:
    """Code of a length or distance: that of the last symbol whose base is no larger, and the difference to the base."""
    index = max(index for index, base in enumerate(bases) if base <= value)
    return join_bits([codes[index], (value - bases[index], extra[index])])


def join_bits(parts: list[Bits]) -> Bits:
    """Concatenate strings of bits in their order."""
    value, count = 0, 0
    for part, bits in parts:
        value |= part << count
        count += bits
    return value, count


def make_prefix() -> Bits:
    """All that precedes the first code: zlib's header, and the header of the block with all code lengths."""
    lengths, distances = code_lengths(), list(map(int, _DISTANCE_LENGTHS))
    bits = [1 if length == _COMMON_LENGTH else 5 for length in range(17)] + [0, 0]
    codes = huffman_codes(bits)
    # Final block; type 2, own codes; numbers of length symbols, of distance symbols, and of lengths of the lengths' own codes.
    header = [(1, 1), (2, 2), (len(lengths) - END_OF_BLOCK - 1, 5), (len(distances) - 1, 5), (len(_LENGTH_ORDER) - 4, 4)]
    header += [(bits[length], 3) for length in _LENGTH_ORDER]
    return join_bits([_ZLIB_HEADER, *header, *(codes[length] for length in lengths + distances)])


def pack_words(bits: Bits) -> np.ndarray:
    """String of bits as words (N) uint32, the first bit lowest."""
    value, count = bits
    return np.frombuffer(value.to_bytes(4 * -(-count // 32), "little"), "<u4")


def pack_codes(codes: list[Bits]) -> np.ndarray:
    """Codes of at most 24 bits as numbers (N) uint32: the value, and in the highest byte the number of bits."""
    return np.array([value | bits << 24 for value, bits in codes], np.uint32)


def max_data_bytes(width: int, height: int) -> int:
    """Capacity of the compressed data (IDAT) of an image [B]: 64 KiB and half a byte a pixel, at most the largest size that is possible.

    Full HD: 1.1 MB, nearly four times the mean of views of a tote. Noise fits only up to some 10,000 pixels.
    """
    return min(_MIN_CAPACITY + width * height // 2, _FRAME_BYTES + _PIXEL_BYTES * width * height)
