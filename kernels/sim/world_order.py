"""List scheduling of worlds on a GPU: those with the most contact colors start first (longest processing time first, Graham 1969).

A GPU starts blocks in the order of their indices, and holds fewer worlds at a time than a large model has. If a world with many colors
started late, its block would still run when all others have ended.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

COLOR_BINS = wp.constant(128)
"""Bins of the counting sort, one for each number of colors; worlds with more share the last one. Of 2,048 piles of real objects half have
at most 28 colors, one in a hundred 90, none more than 108."""


@wp.func
def count_colors(offsets: wp.array[int], first: int, entries: int) -> int:
    """Number of colors of a world: the first entry that equals the last one, by binary search.

    Args:
        offsets: For each world and color the index of its first unit; the last entry of a world is its number of units.
        first: Index of the world's first entry.
        entries: Entries of a world.
    """
    units = offsets[first + entries - 1]
    low = int(0)
    high = entries - 1
    while low < high:
        middle = (low + high) // 2
        if offsets[first + middle] < units:
            low = middle + 1
        else:
            high = middle
    return low


@wp.kernel
def count_worlds_kernel(
    # In:
    color_offsets: wp.array[int],  # (world * entries)
    entries: int,
    # Out:
    bin_size_inout: wp.array[int],  # (bin), from zero
    bin_out: wp.array[int],  # (world)
    place_out: wp.array[int],  # (world)
):
    """Counting sort, first pass: bin of each world, its place in the bin, and the sizes of the bins. The most colors are in bin 0."""
    world = wp.tid()
    colors = wp.min(count_colors(color_offsets, world * entries, entries), COLOR_BINS - 1)
    bin = COLOR_BINS - 1 - colors
    bin_out[world] = bin
    place_out[world] = wp.atomic_add(bin_size_inout, bin, 1)


@wp.kernel
def order_worlds_kernel(
    # In:
    bin_size: wp.array[int],  # (bin)
    bin: wp.array[int],  # (world)
    place: wp.array[int],  # (world)
    # Out:
    order_out: wp.array[int],  # (rank)
):
    """Counting sort, second pass: the worlds in order. Within a bin the order varies between runs; no result depends on it."""
    world = wp.tid()
    rank = place[world]
    for before in range(bin[world]):
        rank += bin_size[before]
    order_out[rank] = world
