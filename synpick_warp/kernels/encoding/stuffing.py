"""Byte stuffing of baseline JPEG (ITU-T T.81, F.1.2.3): a byte 0 after each byte 0xFF of coded data; joining of restart intervals.

Lanes (threads) share an interval in contiguous chunks: they count the bytes 0xFF, and prefix sums over lanes and intervals give the
position of each chunk in the file.
"""

import warp as wp

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
def count_stuffing_kernel(
    # In:
    slot: wp.array3d[wp.uint32],  # (view, interval, slot_word)
    coded: wp.array2d[int],  # (view, interval) [B]
    # Out:
    stuffing_out: wp.array3d[int],  # (view, interval, lane) [B]
    size_inout: wp.array2d[int],  # (view, interval) [B]
):
    """Count the bytes 0 to be stuffed into each lane's chunk of an interval of `coded` bytes: writes them to `stuffing_out`, and adds them
    to `size_inout`, the size of the interval with its marker. Launched over view, interval, lane.
    """
    view, interval, lane = wp.tid()
    chunk = chunk_words(coded[view, interval], slot.shape[2], stuffing_out.shape[2])
    # Behind the last byte of the bit string, its last word is 0.
    words = wp.min((coded[view, interval] + WORD_BYTES - 1) // WORD_BYTES, slot.shape[2])
    count = int(0)
    for word in range(lane * chunk, wp.min((lane + 1) * chunk, words)):
        count += count_ff_bytes(slot[view, interval, word])
    stuffing_out[view, interval, lane] = count
    if count > 0:
        wp.atomic_add(size_inout, view, interval, count)


@wp.kernel
def place_intervals_kernel(
    # In:
    coded: wp.array2d[int],  # (view, interval) [B]
    size: wp.array2d[int],  # (view, interval) [B]
    slot_bytes: int,
    header_bytes: int,
    capacity: int,
    # Out:
    begin_out: wp.array2d[int],  # (view, interval) [B]
    total_out: wp.array[int],  # (view) [B]
):
    """Place the restart intervals of each view in its file: prefix sum over `size`, the bytes of an interval with stuffing and closing
    marker.

    Writes `begin_out`, the first byte of each interval, and `total_out`, the size of the file: above `capacity` if the file does not fit,
    or if a bit string (`coded`) did not fit its slot. Launched over view.
    """
    view = wp.tid()
    begin = int(header_bytes)
    longest = int(0)
    for interval in range(size.shape[1]):
        begin_out[view, interval] = begin
        begin += size[view, interval]
        longest = wp.max(longest, coded[view, interval])
    if longest > slot_bytes:
        begin = wp.max(begin, capacity + 1)
    total_out[view] = begin


@wp.func
def put_byte(file: wp.array2d[wp.uint8], view: int, position: int, value: wp.uint32):
    """Write the low byte of a value, if the file has space for it."""
    if position < file.shape[1]:
        file[view, position] = wp.uint8(value & wp.uint32(MARKER))


@wp.kernel
def join_intervals_kernel(
    # In:
    slot: wp.array3d[wp.uint32],  # (view, interval, slot_word)
    coded: wp.array2d[int],  # (view, interval) [B]
    size: wp.array2d[int],  # (view, interval) [B]
    begin: wp.array2d[int],  # (view, interval) [B]
    stuffing: wp.array3d[int],  # (view, interval, lane) [B]
    quality: wp.array[int],  # (view)
    header: wp.array2d[wp.uint8],  # (quality, header_byte)
    # Out:
    file_out: wp.array2d[wp.uint8],  # (view, byte)
):
    """Write the file of each view: the header of its `quality` (row of `header`), then the intervals with stuffed bytes, each closed by a
    marker (RST, or EOI after the last one).

    Launched over view, interval, lane. Bytes beyond the capacity of `file_out` are left out.
    """
    view, interval, lane = wp.tid()
    lanes = stuffing.shape[2]
    if interval == 0:
        for k in range(lane, header.shape[1], lanes):
            file_out[view, k] = header[quality[view], k]
    chunk = chunk_words(coded[view, interval], slot.shape[2], lanes)
    position = begin[view, interval] + WORD_BYTES * lane * chunk
    for k in range(lane):
        position += stuffing[view, interval, k]
    last = wp.min(coded[view, interval], WORD_BYTES * slot.shape[2])
    for word in range(lane * chunk, (lane + 1) * chunk):
        value = wp.uint32(0)
        count = wp.min(last - WORD_BYTES * word, WORD_BYTES)
        if count > 0:
            value = slot[view, interval, word]
        for k in range(count):
            byte = (value >> wp.uint32(24 - 8 * k)) & wp.uint32(MARKER)
            put_byte(file_out, view, position, byte)
            position += 1
            if byte == wp.uint32(MARKER):
                put_byte(file_out, view, position, wp.uint32(0))
                position += 1
    if lane == 0:
        end = begin[view, interval] + size[view, interval]
        marker = wp.where(interval < size.shape[1] - 1, RESTART + interval % RESTARTS, END)
        put_byte(file_out, view, end - 2, wp.uint32(MARKER))
        put_byte(file_out, view, end - 1, wp.uint32(marker))
