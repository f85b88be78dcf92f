"""Entropy coding of baseline JPEG (ITU-T T.81, annex F): Huffman codes of quantized coefficients, a thread for each block.

A prefix sum over the lengths of the blocks' codes gives the bit offset of each block in its restart interval, so that all blocks write
to the interval's slot at the same time. Slots hold bit strings in 32-bit words, the first bit the most significant; `stuffing` makes
files of them.
"""

import warp as wp

from synpick_warp.kernels.encoding.dct import BLOCK_SIZE, BLOCKS_PER_MCU, LUMA_BLOCKS, JpegData

wp.set_module_options({"enable_backward": False})

ZERO_RUN = wp.constant(0xF0)
"""Symbol (ZRL) of sixteen zeros."""
RUN_BITS = wp.constant(4)
"""Bits of a run of zeros in a symbol, above the number of magnitude bits."""
LONGEST_RUN = wp.constant(15)
"""Most zeros before a coefficient in one symbol."""
CODE_BITS = wp.constant(24)
"""Position of the length in a packed code: the code is in bits 0 to 23, its number of bits in bits 24 to 31."""
WORD_BITS = wp.constant(32)
"""Bits of a word of a slot."""
WORD_SHIFT = wp.constant(5)
"""2^5 bits are a word."""
ONE = wp.constant(wp.uint64(1))


@wp.struct
class HuffmanTables:
    """Huffman codes of the DC and the AC symbols, packed (`CODE_BITS`), by component (0: Y, 1: Cb and Cr) and symbol: of DC the number of
    bits of the difference, of AC 16 x zeros before the coefficient + its number of bits.
    """

    dc: wp.array2d[wp.uint32]
    """(component, symbol): code of a difference's number of bits."""
    ac: wp.array2d[wp.uint32]
    """(component, symbol): code of 16 x zeros before a coefficient + its number of bits."""


@wp.struct
class WordWriter:
    """Bit writer of one block: its position in the slot of the restart interval, and the bits of the unfinished word."""

    view: int
    interval: int
    """Restart interval, which is the index of the slot."""

    pending: wp.uint64
    """Bits that do not fill a word yet, at the low end; bits of earlier blocks in the word are 0."""
    bits: int
    """Number of pending bits, with those of earlier blocks, below `WORD_BITS`."""
    word: int
    """Index in the slot of the word that the pending bits belong to."""
    shared: bool
    """Whether the word begins with bits of an earlier block."""


@wp.func
def lowest_bit(mask: wp.uint64) -> int:
    """Index of the lowest set bit (count trailing zeros) of a mask that is not 0."""
    return wp.bit_count((mask - ONE) & ~mask)


@wp.func
def bit_length(value: int) -> int:
    """Number of bits of a magnitude below 2^16; 0 has none."""
    ones = value | (value >> 1)
    ones = ones | (ones >> 2)
    ones = ones | (ones >> 4)
    ones = ones | (ones >> 8)
    return wp.bit_count(ones)


@wp.func
def signed_bits(value: int, count: int) -> wp.uint32:
    """Magnitude bits of a value (T.81, F.1.2.1): its `count` low bits; for negative ones those of value - 1."""
    bits = wp.where(value < 0, value - 1, value)
    return wp.uint32(bits & ((1 << count) - 1))


@wp.func
def code_length(code: wp.uint32) -> int:
    """Number of bits of a packed code."""
    return int(code >> wp.uint32(CODE_BITS))


@wp.func
def component_of(block: int) -> int:
    """Index of a block's Huffman tables: 0 (Y) or 1 (Cb and Cr)."""
    return wp.where(block % BLOCKS_PER_MCU < LUMA_BLOCKS, 0, 1)


@wp.func
def read_coefficient(data: JpegData, view: int, block: int, k: int) -> int:
    """Coefficient k of a block, in zigzag order."""
    return int(wp.int16(data.coefficient[view, k >> 2, block] >> wp.uint64(16 * (k & 3))))


@wp.func
def dc_difference(data: JpegData, view: int, block: int, interval_blocks: int) -> int:
    """DC coefficient of a block minus that of the block before it of the same component in the restart interval; minus 0 for
    the first one.
    """
    part = block % BLOCKS_PER_MCU
    previous = block - BLOCKS_PER_MCU
    if part == 0:
        # The last block of Y in the MCU before.
        previous += LUMA_BLOCKS - 1
    elif part < LUMA_BLOCKS:
        previous = block - 1
    value = read_coefficient(data, view, block, 0)
    if previous >= block - block % interval_blocks:
        value -= read_coefficient(data, view, previous, 0)
    return value


@wp.kernel
def measure_blocks_kernel(tables: HuffmanTables, interval_blocks: int, data_inout: JpegData):
    """Measure the bit string of each block: Huffman codes and magnitude bits. Launched over view, block."""
    view, block = wp.tid()
    component = component_of(block)
    bits = bit_length(wp.abs(dc_difference(data_inout, view, block, interval_blocks)))
    length = code_length(tables.dc[component, bits]) + bits
    long_run = code_length(tables.ac[component, ZERO_RUN])
    last = int(0)
    mask = data_inout.nonzero[view, block] & ~ONE
    while mask != wp.uint64(0):
        k = lowest_bit(mask)
        mask = mask & (mask - ONE)
        zeros = k - last - 1
        bits = bit_length(wp.abs(read_coefficient(data_inout, view, block, k)))
        symbol = ((zeros & LONGEST_RUN) << RUN_BITS) + bits
        length += (zeros >> RUN_BITS) * long_run + code_length(tables.ac[component, symbol]) + bits
        last = k
    if last < BLOCK_SIZE - 1:
        # End of block (EOB).
        length += code_length(tables.ac[component, 0])
    data_inout.block_bits[view, block] = length


@wp.kernel
def place_blocks_kernel(interval_blocks: int, marker_bytes: int, data_inout: JpegData):
    """Prefix sum over the blocks of a restart interval: `block_begin` receives their bit offsets. Launched over view, interval.

    Also clears the words of the slot that blocks share. `coded` receives the bytes of the bit string, which may be more than the slot has,
    `interval_size` the same with the closing marker.
    """
    view, interval = wp.tid()
    begin = int(0)
    for block in range(interval * interval_blocks, wp.min((interval + 1) * interval_blocks, data_inout.block_bits.shape[1])):
        data_inout.block_begin[view, block] = begin
        if begin >> WORD_SHIFT < data_inout.slot.shape[2]:
            data_inout.slot[view, interval, begin >> WORD_SHIFT] = wp.uint32(0)
        begin += data_inout.block_bits[view, block]
    if begin >> WORD_SHIFT < data_inout.slot.shape[2]:
        data_inout.slot[view, interval, begin >> WORD_SHIFT] = wp.uint32(0)
    data_inout.coded[view, interval] = (begin + 7) // 8
    data_inout.interval_size[view, interval] = (begin + 7) // 8 + marker_bytes


@wp.func
def put_bits(writer: WordWriter, slot: wp.array3d[wp.uint32], value: wp.uint32, count: int) -> WordWriter:
    """Append `count` bits, at most 32; returns the writer. Full words are written, if the slot has space for them."""
    writer.pending = (writer.pending << wp.uint64(count)) | wp.uint64(value)
    writer.bits += count
    if writer.bits >= WORD_BITS:
        writer.bits -= WORD_BITS
        word = wp.uint32(writer.pending >> wp.uint64(writer.bits))
        if writer.word < slot.shape[2]:
            if writer.shared:
                wp.atomic_or(slot, writer.view, writer.interval, writer.word, word)
            else:
                slot[writer.view, writer.interval, writer.word] = word
        writer.word += 1
        writer.shared = False
    return writer


@wp.func
def finish_words(writer: WordWriter, slot: wp.array3d[wp.uint32]):
    """Flush the incomplete last word by atomic "or": the next block writes its other bits."""
    if writer.bits > 0 and writer.word < slot.shape[2]:
        word = wp.uint32(writer.pending << wp.uint64(WORD_BITS - writer.bits))
        wp.atomic_or(slot, writer.view, writer.interval, writer.word, word)


@wp.func
def put_value(writer: WordWriter, slot: wp.array3d[wp.uint32], code: wp.uint32, value: int, count: int) -> WordWriter:
    """Append a packed code of at most 16 bits and the `count` magnitude bits of a value, at most 11; returns the writer."""
    symbol = (code & wp.uint32((1 << CODE_BITS) - 1)) << wp.uint32(count)
    return put_bits(writer, slot, symbol | signed_bits(value, count), code_length(code) + count)


@wp.kernel
def write_blocks_kernel(tables: HuffmanTables, interval_blocks: int, data_inout: JpegData):
    """Write the bit string of each block at its bit offset: DC difference, then zero runs and AC coefficients. Launched over view, block.

    Words shared by neighbouring blocks are combined by atomic "or", whose result does not depend on the order. The last block of an
    interval pads the last byte with ones.
    """
    view, block = wp.tid()
    slot = data_inout.slot
    component = component_of(block)
    offset = data_inout.block_begin[view, block]
    writer = WordWriter()
    writer.view = view
    writer.interval = block // interval_blocks
    writer.word = offset >> WORD_SHIFT
    writer.bits = offset & (WORD_BITS - 1)
    writer.shared = writer.bits > 0
    value = dc_difference(data_inout, view, block, interval_blocks)
    bits = bit_length(wp.abs(value))
    writer = put_value(writer, slot, tables.dc[component, bits], value, bits)
    last = int(0)
    mask = data_inout.nonzero[view, block] & ~ONE
    while mask != wp.uint64(0):
        k = lowest_bit(mask)
        mask = mask & (mask - ONE)
        zeros = k - last - 1
        while zeros > LONGEST_RUN:
            writer = put_value(writer, slot, tables.ac[component, ZERO_RUN], 0, 0)
            zeros -= LONGEST_RUN + 1
        value = read_coefficient(data_inout, view, block, k)
        bits = bit_length(wp.abs(value))
        writer = put_value(writer, slot, tables.ac[component, (zeros << RUN_BITS) + bits], value, bits)
        last = k
    if last < BLOCK_SIZE - 1:
        # End of block (EOB).
        writer = put_value(writer, slot, tables.ac[component, 0], 0, 0)
    if (block + 1) % interval_blocks == 0 or block == data_inout.block_begin.shape[1] - 1:
        padding = (WORD_BITS - writer.bits) & 7
        writer = put_bits(writer, slot, wp.uint32((1 << padding) - 1), padding)
    finish_words(writer, slot)
