"""Probe kernels of the path lists: append coarse pixels, and read the lists back."""

import warp as wp

from synpick_warp.kernels.render.lighting.paths.lists import PathLists, append_pixel, listed_pixel

wp.set_module_options({"enable_backward": False})


@wp.kernel
def append_kernel(
    # In:
    known: wp.array[int],  # (thread)
    bits: wp.array[int],  # (thread)
    threads: int,
    # Out:
    lists_inout: PathLists,
):
    """Append one coarse pixel per thread to the path lists of its view, unless `known` is negative. Each view has `threads` threads."""
    index = wp.tid()
    if known[index] >= 0:
        append_pixel(lists_inout, index // threads, index, known[index], bits[index])


@wp.kernel
def read_kernel(
    # In:
    lists: PathLists,
    # Out:
    listed_out: wp.array2d[int],  # (thread, 3)
):
    """Read the list entry of each thread: coarse pixel, paths of its history, and bits of its update period."""
    index = wp.tid()
    pixel, known, bits = listed_pixel(lists, index)
    listed_out[index, 0] = pixel
    listed_out[index, 1] = known
    listed_out[index, 2] = bits
