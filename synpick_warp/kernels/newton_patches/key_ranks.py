"""Rank sort (enumeration sort, Muller and Preparata, 1975) of contact keys on a GPU, for few contacts.

A radix sort takes twelve dependent kernels however few keys there are: 63 us of a substep of 8 worlds on an H200. Here each key counts
those before it, with a warp for each key, and goes to its place.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

UNUSED = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
"""Newton's key of slots without a contact, which are behind all others."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __reduce_add_sync(~0u, value);
#else
    return value;
#endif
""")
def sum_lanes(value: int) -> int:
    """Sum of `value` over the lanes of a warp. On the CPU a warp has one lane."""
    ...


@wp.kernel
def rank_keys_kernel(
    # In:
    capacity: int,
    lanes: int,
    # Out:
    key_inout: wp.array[wp.int64],  # (2 * capacity)
    index_inout: wp.array[int],  # (2 * capacity)
):
    """Write keys and their indices in ascending order behind the `capacity` unsorted ones; of equal keys, the first comes first.

    Launched over key, lane; on a CPU there is one lane."""
    place, lane = wp.tid()
    key = key_inout[place]
    if key == UNUSED:
        return
    before = int(0)
    other = lane
    while other < capacity:
        found = key_inout[other]
        if found == UNUSED:
            break
        if found < key or (found == key and other < place):
            before += 1
        other += lanes
    rank = sum_lanes(before)
    if lane == 0:
        key_inout[capacity + rank] = key
        index_inout[capacity + rank] = place


@wp.kernel
def take_sorted_kernel(
    # In:
    capacity: int,
    # Out:
    key_inout: wp.array[wp.int64],  # (2 * capacity)
    index_inout: wp.array[int],  # (2 * capacity)
):
    """Copy the keys and indices that `rank_keys_kernel` has sorted to the first `capacity`. Launched over key."""
    place = wp.tid()
    if key_inout[place] != UNUSED:
        key_inout[place] = key_inout[capacity + place]
        index_inout[place] = index_inout[capacity + place]
