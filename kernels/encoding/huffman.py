"""Entropy coding of baseline JPEG (ITU-T T.81, annex F): Huffman codes of quantized coefficients, in restart intervals of a few MCUs.

Restart intervals do not depend on each other: each is written by a thread into a slot of its own, then the slots are joined.
"""

import warp as wp

from synpick_warp.kernels.encoding.tables import BLOCK_SIZE, BLOCKS_PER_MCU

wp.set_module_options({"enable_backward": False})

MARKER = wp.constant(0xFF)
"""First byte of a marker; in coded data a byte 0 follows it."""
RESTART, END = wp.constant(0xD0), wp.constant(0xD9)
"""Second bytes of the markers RST0 and EOI."""
RESTARTS = wp.constant(8)
"""Restart markers are numbered modulo this."""
ZERO_RUN = wp.constant(0xF0)
"""Symbol (ZRL) of sixteen zeros."""
LONGEST_RUN = wp.constant(15)
"""Most zeros before a coefficient in one symbol."""


@wp.struct
class HuffmanTables:
    """Huffman codes by component (0: Y, 1: Cb and Cr) and symbol."""

    dc_code: wp.array2d[wp.uint32]
    """(component, symbol): code of a difference's number of bits."""
    dc_length: wp.array2d[int]
    """(component, symbol): bits of the code."""
    ac_code: wp.array2d[wp.uint32]
    """(component, symbol): code of 16 x zeros before a coefficient + its number of bits."""
    ac_length: wp.array2d[int]
    """(component, symbol): bits of the code."""


@wp.struct
class BitWriter:
    """State of a writer of bits to a slot, the first bit the most significant of its byte."""

    view: int
    interval: int
    """Slot."""

    pending: wp.uint32
    """Bits that do not fill a byte yet, at the low end."""
    bits: int
    """Their number, below 8."""
    size: int
    """Bytes so far, also those beyond the capacity."""


@wp.func
def put_byte(writer: BitWriter, slot: wp.array3d[wp.uint8], value: wp.uint32) -> BitWriter:
    """Append a byte if the slot has space for it; the size counts it in any case."""
    if writer.size < slot.shape[2]:
        slot[writer.view, writer.interval, writer.size] = wp.uint8(value)
    writer.size += 1
    return writer


@wp.func
def put_bits(writer: BitWriter, slot: wp.array3d[wp.uint8], value: wp.uint32, count: int) -> BitWriter:
    """Append `count` bits, at most 16; after a byte 0xFF a byte 0 follows, so that it is no marker."""
    writer.pending = (writer.pending << wp.uint32(count)) | value
    writer.bits += count
    while writer.bits >= 8:
        writer.bits -= 8
        byte = (writer.pending >> wp.uint32(writer.bits)) & wp.uint32(0xFF)
        writer = put_byte(writer, slot, byte)
        if byte == wp.uint32(MARKER):
            writer = put_byte(writer, slot, wp.uint32(0))
    writer.pending = writer.pending & wp.uint32(0xFF)
    return writer


@wp.func
def bit_length(value: int) -> int:
    """Number of bits of a magnitude; 0 has none."""
    count = int(0)
    while value > 0:
        value = value >> 1
        count += 1
    return count


@wp.func
def signed_bits(value: int, count: int) -> wp.uint32:
    """Magnitude bits of a value (T.81, F.1.2.1): its `count` low bits; for negative ones those of value - 1."""
    bits = wp.where(value < 0, value - 1, value)
    return wp.uint32(bits & ((1 << count) - 1))


@wp.func
def encode_block(
    tables: HuffmanTables,
    coefficient: wp.array4d[wp.int16],  # (view, mcu, block, coefficient)
    mcu: int,
    block: int,
    previous: int,
    writer: BitWriter,
    slot: wp.array3d[wp.uint8],  # (view, interval, byte)
) -> BitWriter:
    """Append a block: its DC coefficient less the `previous` one of its component, then runs of zeros and AC coefficients."""
    component = wp.where(block < BLOCKS_PER_MCU - 2, 0, 1)
    difference = int(coefficient[writer.view, mcu, block, 0]) - previous
    bits = bit_length(wp.abs(difference))
    writer = put_bits(writer, slot, tables.dc_code[component, bits], tables.dc_length[component, bits])
    writer = put_bits(writer, slot, signed_bits(difference, bits), bits)
    zeros = int(0)
    for k in range(1, BLOCK_SIZE):
        value = int(coefficient[writer.view, mcu, block, k])
        if value == 0:
            zeros += 1
        else:
            while zeros > LONGEST_RUN:
                writer = put_bits(writer, slot, tables.ac_code[component, ZERO_RUN], tables.ac_length[component, ZERO_RUN])
                zeros -= LONGEST_RUN + 1
            bits = bit_length(wp.abs(value))
            symbol = 16 * zeros + bits
            writer = put_bits(writer, slot, tables.ac_code[component, symbol], tables.ac_length[component, symbol])
            writer = put_bits(writer, slot, signed_bits(value, bits), bits)
            zeros = 0
    if zeros > 0:
        # End of block (EOB).
        writer = put_bits(writer, slot, tables.ac_code[component, 0], tables.ac_length[component, 0])
    return writer


@wp.kernel
def encode_intervals_kernel(
    # In:
    tables: HuffmanTables,
    coefficient: wp.array4d[wp.int16],  # (view, mcu, block, coefficient)
    interval_mcus: int,
    # Out:
    slot_out: wp.array3d[wp.uint8],  # (view, interval, byte)
    size_out: wp.array2d[int],  # (view, interval)
):
    """Entropy-coded data of each restart interval with its closing marker (RST, or EOI after the last one). Launched over view, interval.

    `size_out` receives the bytes that it takes, which may be more than the slot has.
    """
    view, interval = wp.tid()
    writer = BitWriter()
    writer.view = view
    writer.interval = interval
    previous = wp.vec3i(0, 0, 0)
    for mcu in range(interval * interval_mcus, wp.min((interval + 1) * interval_mcus, coefficient.shape[1])):
        for block in range(BLOCKS_PER_MCU):
            component = wp.max(block - (BLOCKS_PER_MCU - 3), 0)
            writer = encode_block(tables, coefficient, mcu, block, previous[component], writer, slot_out)
            previous[component] = int(coefficient[view, mcu, block, 0])
    if writer.bits > 0:
        # The last byte is filled up with ones.
        writer = put_bits(writer, slot_out, wp.uint32((1 << (8 - writer.bits)) - 1), 8 - writer.bits)
    marker = wp.where(interval < size_out.shape[1] - 1, RESTART + interval % RESTARTS, END)
    writer = put_byte(writer, slot_out, wp.uint32(MARKER))
    writer = put_byte(writer, slot_out, wp.uint32(marker))
    size_out[view, interval] = writer.size


@wp.kernel
def join_intervals_kernel(
    # In:
    slot: wp.array3d[wp.uint8],  # (view, interval, byte)
    size: wp.array2d[int],  # (view, interval)
    quality: wp.array[int],  # (view)
    header: wp.array2d[wp.uint8],  # (quality, header_byte)
    lanes: int,
    # Out:
    file_out: wp.array2d[wp.uint8],  # (view, byte)
    total_out: wp.array[int],  # (view)
):
    """Join header and intervals to a file for each view. Launched over view, interval, lane: `lanes` threads copy an interval.

    `total_out` receives the size of the file [B]. If it or an interval exceeds its capacity, the file is incomplete, and the size is
    above the capacity.
    """
    view, interval, lane = wp.tid()
    begin = int(header.shape[1])
    if interval == 0:
        for k in range(lane, header.shape[1], lanes):
            file_out[view, k] = header[quality[view], k]
    for k in range(interval):
        begin += size[view, k]
    count = wp.min(size[view, interval], slot.shape[2])
    for k in range(lane, wp.min(count, file_out.shape[1] - begin), lanes):
        file_out[view, begin + k] = slot[view, interval, k]
    if lane == 0 and interval == size.shape[1] - 1:
        total = begin + size[view, interval]
        for k in range(size.shape[1]):
            if size[view, k] > slot.shape[2]:
                total = wp.max(total, file_out.shape[1] + 1)
        total_out[view] = total
