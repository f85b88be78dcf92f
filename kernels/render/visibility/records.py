"""Packed records: elements of contiguous arrays, addressed by flat indices and read or written by one memory access each."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
    struct alignas(16) Aligned { float x, y, z, w; };
    const Aligned record = reinterpret_cast<const Aligned*>(records.data)[index];
    return wp::vec4(record.x, record.y, record.z, record.w);
""")
def read_record(records: wp.array3d[wp.vec4], index: int) -> wp.vec4:
    """Read the element of a contiguous array at a `flat_index` by one load: Warp's own look-up assumes no alignment, and takes four."""
    ...


@wp.func_native("""
    struct alignas(16) Aligned { float x, y, z, w; };
    const Aligned aligned = { record[0], record[1], record[2], record[3] };
    reinterpret_cast<Aligned*>(records.data)[index] = aligned;
""")
def write_record(records: wp.array3d[wp.vec4], index: int, record: wp.vec4):
    """Write the element of a contiguous array at a `flat_index` by one store."""
    ...


@wp.func_native("""
    struct alignas(16) Aligned { float x, y, z, w; };
    const Aligned record = reinterpret_cast<const Aligned*>(records.data)[index];
    return wp::vec4(record.x, record.y, record.z, record.w);
""")
def read_flat_record(records: wp.array[wp.vec4], index: int) -> wp.vec4:
    """As `read_record`, of a one-dimensional array."""
    ...


@wp.func_native("""
    return words.data[index];
""")
def read_word(words: wp.array3d[wp.uint64], index: int) -> wp.uint64:
    """Read the element of a contiguous array at a `flat_index`."""
    ...


@wp.func_native("""
    words.data[index] = word;
""")
def write_word(words: wp.array3d[wp.uint64], index: int, word: wp.uint64):
    """Write the element of a contiguous array at a `flat_index`."""
    ...
