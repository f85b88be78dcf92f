"""Byte stuffing of baseline JPEG (ITU-T T.81, F.1.2.3): a byte 0 after each byte 0xFF of coded data; joining of restart intervals.

Lanes (threads) share an interval in contiguous chunks: they count the bytes 0xFF, and prefix sums over lanes and intervals give the
position of each chunk in the file.
"""

import warp as wp

from synpick_warp.kernels.encoding.dct import JpegData

wp.set_module_options({"enable_backward": False})

MARKER = wp.constant(0xFF)
"""First byte of a marker; in coded data a byte 0 follows it."""
RESTART, END = wp.constant(0xD0), wp.constant(0xD9)
"""Second bytes of the markers RST0 and EOI."""
RESTARTS = wp.constant(8)
"""Restart markers are numbered modulo this."""
MARKER_BYTES = wp.constant(2)
"""Size of a marker [B]."""
WORD_BYTES = wp.constant(4)
"""Bytes of a word of a slot, the first one the most significant."""
LOW_BITS = wp.constant(wp.uint32(0x7F7F7F7F))
"""All bits of each byte but the highest."""


@wp.struct
class JpegFiles:
    """JPEG files of a batch of views, and their sizes."""

    jpeg_size: wp.array[int]
    """(view): size of each file [B]; above the capacity of `jpeg`: the file is incomplete."""
    jpeg: wp.array2d[wp.uint8]
    """(view, byte): the files, from the first byte."""


@wp.func
def count_ff_bytes(word: wp.uint32) -> int:
    """Number of bytes 0xFF in a word: SWAR count of the zero bytes of its complement, whose additions never carry between bytes."""
    inverse = ~word
    return wp.bit_count(~(((inverse & LOW_BITS) + LOW_BITS) | inverse | LOW_BITS))


@wp.func
def chunk_words(coded: int, capacity: int, lanes: int) -> int:
    """Words per lane: those of an interval of `coded` bytes, at most the slot's `capacity` [words], over `lanes`, rounded up."""
    words = wp.min((coded + WORD_BYTES - 1) // WORD_BYTES, capacity)
    return (words + lanes - 1) // lanes


@wp.kernel
def count_stuffing_kernel(data_inout: JpegData):
    """Count the bytes 0 to be stuffed into each lane's chunk of an interval of `coded` bytes: writes them to `stuffing`, and adds them to
    `interval_size`. Launched over view, interval, lane.
    """
    view, interval, lane = wp.tid()
    slot, coded = data_inout.slot, data_inout.coded
    chunk = chunk_words(coded[view, interval], slot.shape[2], data_inout.stuffing.shape[2])
    # Behind the last byte of the bit string, its last word is 0.
    words = wp.min((coded[view, interval] + WORD_BYTES - 1) // WORD_BYTES, slot.shape[2])
    count = int(0)
    for word in range(lane * chunk, wp.min((lane + 1) * chunk, words)):
        count += count_ff_bytes(slot[view, interval, word])
    data_inout.stuffing[view, interval, lane] = count
    if count > 0:
        wp.atomic_add(data_inout.interval_size, view, interval, count)


@wp.kernel
def place_intervals_kernel(header_bytes: int, data_inout: JpegData, files_out: JpegFiles):
    """Place the restart intervals of each view in its file: prefix sum over `interval_size`.

    Writes `interval_begin`, and `jpeg_size`: above the capacity if the file, or a bit string its slot, does not fit. Launched over view.
    """
    view = wp.tid()
    begin = int(header_bytes)
    longest = int(0)
    for interval in range(data_inout.interval_size.shape[1]):
        data_inout.interval_begin[view, interval] = begin
        begin += data_inout.interval_size[view, interval]
        longest = wp.max(longest, data_inout.coded[view, interval])
    if longest > WORD_BYTES * data_inout.slot.shape[2]:
        begin = wp.max(begin, files_out.jpeg.shape[1] + 1)
    files_out.jpeg_size[view] = begin


@wp.func
def put_byte(file: wp.array2d[wp.uint8], view: int, position: int, value: wp.uint32):
    """Write the low byte of a value, if the file has space for it."""
    if position < file.shape[1]:
        file[view, position] = wp.uint8(value & wp.uint32(MARKER))


@wp.kernel
def join_intervals_kernel(
    # In:
    data: JpegData,
    quality: wp.array[int],  # (view)
    header: wp.array2d[wp.uint8],  # (quality, header_byte)
    # Out:
    files_out: JpegFiles,
):
    """Write the file of each view: the header of its `quality` (row of `header`), then the intervals with stuffed bytes, each closed by a
    marker (RST, or EOI after the last one).

    Launched over view, interval, lane. Bytes beyond the capacity of `jpeg` are left out.
    """
    view, interval, lane = wp.tid()
    slot, coded = data.slot, data.coded
    lanes = data.stuffing.shape[2]
    if interval == 0:
        for k in range(lane, header.shape[1], lanes):
            files_out.jpeg[view, k] = header[quality[view], k]
    chunk = chunk_words(coded[view, interval], slot.shape[2], lanes)
    position = data.interval_begin[view, interval] + WORD_BYTES * lane * chunk
    for k in range(lane):
        position += data.stuffing[view, interval, k]
    last = wp.min(coded[view, interval], WORD_BYTES * slot.shape[2])
    for word in range(lane * chunk, (lane + 1) * chunk):
        value = wp.uint32(0)
        count = wp.min(last - WORD_BYTES * word, WORD_BYTES)
        if count > 0:
            value = slot[view, interval, word]
        for k in range(count):
            byte = (value >> wp.uint32(24 - 8 * k)) & wp.uint32(MARKER)
            put_byte(files_out.jpeg, view, position, byte)
            position += 1
            if byte == wp.uint32(MARKER):
                put_byte(files_out.jpeg, view, position, wp.uint32(0))
                position += 1
    if lane == 0:
        end = data.interval_begin[view, interval] + data.interval_size[view, interval]
        marker = wp.where(interval < data.interval_size.shape[1] - 1, RESTART + interval % RESTARTS, END)
        put_byte(files_out.jpeg, view, end - 2, wp.uint32(MARKER))
        put_byte(files_out.jpeg, view, end - 1, wp.uint32(marker))
