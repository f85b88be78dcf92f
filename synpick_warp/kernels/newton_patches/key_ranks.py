"""Rank sort (enumeration sort, Muller and Preparata, 1975) of contact keys on a GPU, for few contacts.

A radix sort launches twelve dependent kernels, however few keys there are: 63 us of a substep of 8 worlds on an H200, 9 us by ranks. The
rank of a key is the number of keys that precede it; a warp counts them for each key.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

UNUSED = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
"""Sort key of Newton's unused contact slots, larger than that of any contact."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int distance = 16; distance > 0; distance /= 2) value += __shfl_xor_sync(~0u, value, distance);
#endif
    return value;
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
    """Rank sort, stable: write the sorted keys and their original indices to the second half of the arrays. `lanes`: threads of a key.

    The first half has the keys of all contacts, then `UNUSED`. Launched over key, lane; a warp is the lanes of one key."""
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
    """Copy the result of `rank_keys_kernel` from the second half of the arrays to the first. Launched over key."""
    place = wp.tid()
    if key_inout[place] != UNUSED:
        key_inout[place] = key_inout[capacity + place]
        index_inout[place] = index_inout[capacity + place]
