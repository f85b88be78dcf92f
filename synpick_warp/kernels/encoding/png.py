"""Depth PNG encoder: "up" filter (PNG specification, section 9.2), LZ77 matches and Huffman codes of deflate (RFC 1951), all in integers.

Rows are cut into segments. Each is coded by one thread into a slot of its own, a bit string stored least significant bit first; a prefix
sum over the sizes of slots gives the bit offsets at which they are joined. Matches begin at most `MAX_DISTANCE` samples back in the same
row; they may reach into the segment before.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

UP = wp.constant(2)
"""Filter type "up": difference to the byte above."""
MIN_RUN, MAX_RUN = wp.constant(2), wp.constant(129)
"""Shortest and longest match length [samples]."""
MAX_DISTANCE = wp.constant(8)
"""Longest distance of a match [samples]."""
ADLER = wp.constant(65521)
ADLER_LONG = wp.constant(wp.int64(65521))
"""Modulus of Adler-32 (RFC 1950, section 8.2)."""
WORD_BITS = wp.constant(32)
WORD_SHIFT = wp.constant(wp.uint64(32))
"""Bits of a word of a slot."""
GROUP = wp.constant(64)
"""Slots of one group of the two-level prefix sum; one thread adds them up."""
CODE_BITS = wp.constant(24)
"""Position of the length in a packed code: the code is in bits 0 to 23, its number of bits in bits 24 to 31."""


history_vec = wp.types.vector(length=8, dtype=wp.int32)
"""The `MAX_DISTANCE` filtered samples before, the last one first; -1: there is none in the row."""


@wp.struct
class Codes:
    """Deflate codes, packed: the value, in the highest byte the number of bits."""

    literal: wp.array[wp.uint32]
    """(byte): packed code of a literal."""
    run: wp.array[wp.uint32]
    """(length): packed code of a match length [samples]."""
    distance: wp.array[wp.uint32]
    """(distance - 1): packed code of a match distance [samples]."""


@wp.struct
class SlotWriter:
    """Bit writer of one slot: view and slot, unfinished word with its number of bits (below WORD_BITS), and number of words written."""

    view: int
    slot: int

    pending: wp.uint64
    """Bits that do not fill a word yet."""
    bits: int
    words: int


@wp.struct
class SlotSums:
    """Size, and sums for Adler-32, of each slot or group of slots."""

    bits: wp.array2d[int]
    """(view, slot): size [bits]."""
    total: wp.array2d[int]
    """(view, slot): sum of the filtered bytes."""
    moment: wp.array2d[int]
    """(view, slot): sum of position in the filtered image times byte, modulo `ADLER`; of a group: sum of up to `GROUP` of these."""


@wp.struct
class Slots:
    """Bit strings (slots) of the segments of a batch of images, and positions of these. Scratch."""

    slot: wp.array3d[wp.uint32]
    """(view, slot, slot_word): bit strings of the header, of each segment of a row, and of the trailer; least significant bit first."""
    begin: wp.array2d[int]
    """(view, slot): first bit of each slot in the data of its group."""
    group_begin: wp.array2d[int]
    """(view, group): first bit of each group of slots."""


@wp.struct
class DepthFiles:
    """Compressed data (IDAT) of the depth PNGs of a batch of views, and their sizes."""

    depth_idat_size: wp.array[int]
    """(view): size of each stream [B]; above the capacity of `depth_idat`: the stream is incomplete."""
    depth_idat: wp.array2d[wp.uint8]
    """(view, depth_byte): zlib streams, from the first byte."""


@wp.func
def put_bits(writer: SlotWriter, slot: wp.array3d[wp.uint32], value: wp.uint32, count: int) -> SlotWriter:
    """Append the low `count` bits of `value`, at most 32; writes a word to the slot whenever 32 bits are complete."""
    writer.pending = writer.pending | (wp.uint64(value) << wp.uint64(writer.bits))
    writer.bits += count
    if writer.bits >= WORD_BITS:
        slot[writer.view, writer.slot, writer.words] = wp.uint32(writer.pending & wp.uint64(0xFFFFFFFF))
        writer.words += 1
        writer.bits -= WORD_BITS
        writer.pending = writer.pending >> WORD_SHIFT
    return writer


@wp.func
def put_code(writer: SlotWriter, slot: wp.array3d[wp.uint32], code: wp.uint32) -> SlotWriter:
    """Append a packed code: its value in the low 24 bits, its number of bits in the highest byte."""
    return put_bits(writer, slot, code & wp.uint32((1 << CODE_BITS) - 1), int(code >> wp.uint32(CODE_BITS)))


@wp.func
def put_sample(writer: SlotWriter, slot: wp.array3d[wp.uint32], codes: Codes, sample: int) -> SlotWriter:
    """Append a filtered sample as two literals, the high byte first."""
    writer = put_code(writer, slot, codes.literal[sample >> 8])
    return put_code(writer, slot, codes.literal[sample & 0xFF])


@wp.func
def put_run(writer: SlotWriter, slot: wp.array3d[wp.uint32], codes: Codes, count: int, matches: int, last: int) -> SlotWriter:
    """Append a run of `count` samples that repeat earlier ones: none (0); one, as the literals of `last`, the newest sample; or more, as a
    match at the shortest distance in `matches` (bit d - 1 is set if all samples equal those at distance d).
    """
    if count == 1:
        return put_sample(writer, slot, codes, last)
    if count >= MIN_RUN:
        distance = int(0)
        while ((matches >> distance) & 1) == 0:
            distance += 1
        writer = put_code(writer, slot, codes.run[count])
        writer = put_code(writer, slot, codes.distance[distance])
    return writer


@wp.func
def finish_slot(writer: SlotWriter, slot: wp.array3d[wp.uint32]) -> int:
    """Write the last word; returns the number of bits in the slot."""
    if writer.bits > 0:
        slot[writer.view, writer.slot, writer.words] = wp.uint32(writer.pending)
    return writer.words * WORD_BITS + writer.bits


@wp.func
def filter_sample(image: wp.array3d[wp.uint16], view: int, row: int, column: int) -> int:
    """16-bit sample after the PNG filter "up": each byte minus the one above, modulo 256. Above the image there is 0."""
    value, above = int(image[view, row, column]), int(0)
    if row > 0:
        above = int(image[view, row - 1, column])
    return ((value & 0xFF00) - (above & 0xFF00)) & 0xFF00 | (value - above) & 0xFF


@wp.func
def find_matches(history: history_vec, sample: int) -> int:
    """Bit field of the distances at which the history has the same sample: bit d - 1 is set if the sample d places back equals this one."""
    matches = int(0)
    for k in range(MAX_DISTANCE):
        matches = matches | wp.where(history[k] == sample, 1 << k, 0)
    return matches


@wp.func
def push_sample(history: history_vec, sample: int) -> history_vec:
    """History shifted by one place, with this sample as the newest."""
    for k in range(MAX_DISTANCE - 1):
        history[MAX_DISTANCE - 1 - k] = history[MAX_DISTANCE - 2 - k]
    history[0] = sample
    return history


@wp.func
def modulo_product(a: int, b: int) -> int:
    """a · b modulo `ADLER`, for numbers that are not negative."""
    return int((wp.int64(a % ADLER) * wp.int64(b % ADLER)) % ADLER_LONG)


@wp.kernel
def encode_segments_kernel(
    # In:
    image: wp.array3d[wp.uint16],  # (view, row, column)
    codes: Codes,
    segment: int,
    # Out:
    strings_out: Slots,
    sums_out: SlotSums,
):
    """Filter and code segments of `segment` pixels of the rows. Launched over view, row, part of the row.

    Slot 0 is not written: it holds what precedes all segments. The first segment of a row begins with the filter's type. Matches are
    greedy: the longest one that begins at a sample, at the shortest distance that it has.
    """
    view, row, part = wp.tid()
    width = image.shape[2]
    begin, end = part * segment, wp.min((part + 1) * segment, width)
    writer = SlotWriter()
    writer.view = view
    writer.slot = 1 + row * ((width + segment - 1) // segment) + part
    total, moment, position = int(0), int(0), int(0)
    if part == 0:
        writer = put_code(writer, strings_out.slot, codes.literal[UP])
        total, position = int(UP), int(1)
    history = history_vec()
    for k in range(MAX_DISTANCE):
        history[k] = -1
    for column in range(wp.max(begin - MAX_DISTANCE, 0), begin):
        history = push_sample(history, filter_sample(image, view, row, column))
    run, matches = int(0), int(0)
    for column in range(begin, end):
        sample = filter_sample(image, view, row, column)
        high, low = sample >> 8, sample & 0xFF
        total += high + low
        moment += position * high + (position + 1) * low
        position += 2
        here = find_matches(history, sample)
        if run > 0 and run < MAX_RUN and (matches & here) != 0:
            matches = matches & here
            run += 1
        else:
            writer = put_run(writer, strings_out.slot, codes, run, matches, history[0])
            matches = here
            run = wp.where(here != 0, 1, 0)
            if here == 0:
                writer = put_sample(writer, strings_out.slot, codes, sample)
        history = push_sample(history, sample)
    writer = put_run(writer, strings_out.slot, codes, run, matches, history[0])
    first = modulo_product(row, 2 * width + 1) + wp.where(part == 0, 0, 1 + 2 * begin)
    sums_out.bits[view, writer.slot] = finish_slot(writer, strings_out.slot)
    sums_out.total[view, writer.slot] = total
    sums_out.moment[view, writer.slot] = (moment + modulo_product(first, total)) % ADLER


@wp.kernel
def sum_groups_kernel(slots: SlotSums, strings_out: Slots, groups_out: SlotSums):
    """Prefix sum, level 1: bit offset of each slot within its group, and the sums of each group of `GROUP` slots.

    The last slot of a view is left out: `close_streams_kernel` writes it. Launched over view, group.
    """
    view, group = wp.tid()
    bits, total, moment = int(0), int(0), int(0)
    for slot in range(group * GROUP, wp.min((group + 1) * GROUP, strings_out.begin.shape[1])):
        strings_out.begin[view, slot] = bits
        if slot < strings_out.begin.shape[1] - 1:
            bits += slots.bits[view, slot]
            total += slots.total[view, slot]
            moment += slots.moment[view, slot]
    groups_out.bits[view, group] = bits
    groups_out.total[view, group] = total
    groups_out.moment[view, group] = moment


@wp.kernel
def close_streams_kernel(
    groups: SlotSums, end_code: wp.uint32, rows: int, columns: int, strings_out: Slots, slots_inout: SlotSums, files_out: DepthFiles
):
    """Prefix sum, level 2, and end of the stream, in the last slot: end-of-block code, padding to a byte, Adler-32 of the filtered rows.

    Launched over view.
    """
    view = wp.tid()
    bits, total, moment = int(0), int(0), int(0)
    for group in range(groups.bits.shape[1]):
        strings_out.group_begin[view, group] = bits
        bits += groups.bits[view, group]
        total = (total + groups.total[view, group]) % ADLER
        moment = (moment + groups.moment[view, group]) % ADLER
    count = modulo_product(rows, 2 * columns + 1)
    high = (count + modulo_product(count, total) + ADLER - moment) % ADLER
    low = (1 + total) % ADLER
    writer = SlotWriter()
    writer.view = view
    writer.slot = strings_out.slot.shape[1] - 1
    writer = put_code(writer, strings_out.slot, end_code)
    end = bits + int(end_code >> wp.uint32(CODE_BITS))
    writer = put_bits(writer, strings_out.slot, wp.uint32(0), (8 - end % 8) % 8)
    # The checksum's highest byte comes first.
    for value in range(2):
        half = wp.where(value == 0, high, low)
        writer = put_bits(writer, strings_out.slot, wp.uint32((half >> 8) | ((half & 0xFF) << 8)), 16)
    slots_inout.bits[view, writer.slot] = finish_slot(writer, strings_out.slot)
    files_out.depth_idat_size[view] = (bits + slots_inout.bits[view, writer.slot]) // 8


@wp.func
def read_bits(slot: wp.array3d[wp.uint32], view: int, index: int, first: int) -> wp.uint32:
    """32 bits of a slot from bit `first` on, which need not begin a word; 0 beyond the end of the array."""
    word, shift = first // WORD_BITS, first % WORD_BITS
    value = slot[view, index, word] >> wp.uint32(shift)
    if shift > 0 and word + 1 < slot.shape[2]:
        value = value | (slot[view, index, word + 1] << wp.uint32(WORD_BITS - shift))
    return value


@wp.kernel
def join_slots_kernel(strings: Slots, slots: SlotSums, lanes: int, files_out: DepthFiles):
    """Concatenate the bit strings of a view's slots to its stream. Launched over view, slot, lane: `lanes` threads write the words of the
    data that begin in a slot.

    Bytes beyond the capacity are left out.
    """
    view, index, lane = wp.tid()
    slot = strings.slot
    first = strings.group_begin[view, index // GROUP] + strings.begin[view, index]
    end = first + slots.bits[view, index]
    for word in range((first + WORD_BITS - 1) // WORD_BITS + lane, (end + WORD_BITS - 1) // WORD_BITS, lanes):
        source, offset, count = int(index), word * WORD_BITS - first, int(0)
        value = wp.uint32(0)
        while count < WORD_BITS and source < slot.shape[1]:
            bits = wp.min(slots.bits[view, source] - offset, WORD_BITS - count)
            part = read_bits(slot, view, source, offset)
            if bits < WORD_BITS:
                part = part & ((wp.uint32(1) << wp.uint32(bits)) - wp.uint32(1))
            value = value | (part << wp.uint32(count))
            count += bits
            source += 1
            offset = int(0)
        for k in range(4):
            byte = 4 * word + k
            if 8 * k < count and byte < files_out.depth_idat.shape[1]:
                files_out.depth_idat[view, byte] = wp.uint8((value >> wp.uint32(8 * k)) & wp.uint32(0xFF))
