"""Loads and stores of contiguous arrays by row-major indices, without a check: `wp.vec4` by one access of 16 bytes, and `wp.uint64`.

The data of arrays of `wp.vec4` must be aligned to 16 bytes, as all that Warp allocates are.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

_READ_RECORD = """
    struct alignas(16) Aligned { float x, y, z, w; };
    const Aligned record = reinterpret_cast<const Aligned*>(records.data)[index];
    return wp::vec4(record.x, record.y, record.z, record.w);
"""


@wp.func_native(_READ_RECORD)
def read_record(records: wp.array3d[wp.vec4], index: int) -> wp.vec4:
    """Load an element: Warp's own look-up assumes no alignment, and takes four loads."""
    ...


@wp.func_native("""
    struct alignas(16) Aligned { float x, y, z, w; };
    const Aligned aligned = { record[0], record[1], record[2], record[3] };
    reinterpret_cast<Aligned*>(records.data)[index] = aligned;
""")
def write_record(records: wp.array3d[wp.vec4], index: int, record: wp.vec4):
    """Store an element."""
    ...


@wp.func_native(_READ_RECORD)
def read_flat_record(records: wp.array[wp.vec4], index: int) -> wp.vec4:
    """As `read_record`, of a one-dimensional array."""
    ...


@wp.func_native("""
    return words.data[index];
""")
def read_uint64(words: wp.array3d[wp.uint64], index: int) -> wp.uint64:
    """Load an element."""
    ...


@wp.func_native("""
    words.data[index] = word;
""")
def write_uint64(words: wp.array3d[wp.uint64], index: int, word: wp.uint64):
    """Store an element."""
    ...
