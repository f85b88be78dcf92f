"""Vectorized memory access: unchecked loads and stores of `wp.vec4` and `wp.uint64` at row-major indices of contiguous arrays.

Arrays of `wp.vec4` must be 16-byte aligned; those that Warp allocates are.
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
    """Load an element with one 16-byte instruction. Warp's indexing assumes 4-byte alignment and emits four."""
    ...


@wp.func_native("""
    struct alignas(16) Aligned { float x, y, z, w; };
    const Aligned aligned = { record[0], record[1], record[2], record[3] };
    reinterpret_cast<Aligned*>(records.data)[index] = aligned;
""")
def write_record(records: wp.array3d[wp.vec4], index: int, record: wp.vec4):
    """Store an element with one 16-byte instruction."""
    ...


@wp.func_native(_READ_RECORD)
def read_flat_record(records: wp.array[wp.vec4], index: int) -> wp.vec4:
    """Load a record of 16 bytes from a one-dimensional array by one instruction, as `read_record`."""
    ...


@wp.func_native("""
    return words.data[index];
""")
def read_uint64(words: wp.array3d[wp.uint64], index: int) -> wp.uint64:
    """Load the element at this flat index by one instruction."""
    ...


@wp.func_native("""
    words.data[index] = word;
""")
def write_uint64(words: wp.array3d[wp.uint64], index: int, word: wp.uint64):
    """Store an element at this flat index by one instruction."""
    ...
