"""Stream compaction of the coarse path pass: lists of the coarse pixels that trace paths in a frame, so that warps are full of them.

A region is the coarse pixels of LANE_STRIDE² warps in interleaved order. Each region has a list of its own: neighbours in a list are
neighbours in the image, so that their rays stay nearly parallel, and few threads contend for a counter.
"""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.kernels.tuning import LANE_STRIDE

wp.set_module_options({"enable_backward": False})

REGION_PIXELS = wp.constant(int(LANE_STRIDE) * int(LANE_STRIDE) * int(TILE_PIXELS))
"""Coarse pixels of a region."""
FRESH, AGED = wp.constant(0), wp.constant(1)
"""Kinds of listed coarse pixels: without a valid history (`PathRules.samples` paths each), and with one (one path each)."""
KNOWN_BITS = wp.constant(8)
"""Bit width of the history length of a packed entry, as of `LightHistory.paths`."""
_PERIOD_BITS = wp.constant(3)
"""Bit width of the field `period_bits` (0 to 7) of a packed entry."""


@wp.struct
class PathLists:
    """Coarse pixels that trace paths in this frame, listed by region and kind, and the lengths of the lists. Scratch."""

    count: wp.array3d[int]
    """(view, region, path_kind): number of FRESH and of AGED coarse pixels."""
    listed: wp.array3d[wp.uint8]
    """(view, cell_row, cell_column): 1: the coarse pixel is in a list."""
    entry: wp.array3d[int]
    """(view, region, rank): see `pack_entry`. FRESH ones from the front, AGED ones from the back, so that most warps hold one kind."""


@wp.func
def pack_entry(offset: int, known: int, bits: int) -> int:
    """Entry of a coarse pixel: its index in the region, and `usable_paths` of its history."""
    return (((offset << KNOWN_BITS) | known) << _PERIOD_BITS) | bits


@wp.func
def unpack_entry(entry: int) -> tuple[int, int, int]:
    """(index in the region, valid paths of the history, period bits) of an entry of `pack_entry`."""
    offset = entry >> (KNOWN_BITS + _PERIOD_BITS)
    known = (entry >> _PERIOD_BITS) & ((1 << KNOWN_BITS) - 1)
    return offset, known, entry & ((1 << _PERIOD_BITS) - 1)


@wp.func
def append_pixel(lists: PathLists, view: int, index: int, known: int, bits: int):
    """List the coarse pixel of thread `index` in interleaved order. Which rank it gets may vary; its paths do not depend on it."""
    region = (index // REGION_PIXELS) % lists.count.shape[1]
    if known == 0:
        rank = wp.atomic_add(lists.count, view, region, FRESH, 1)
    else:
        rank = REGION_PIXELS - 1 - wp.atomic_add(lists.count, view, region, AGED, 1)
    lists.entry[view, region, rank] = pack_entry(index % REGION_PIXELS, known, bits)


@wp.func
def listed_pixel(lists: PathLists, index: int) -> tuple[int, int, int]:
    """(thread index in interleaved order, known, bits) of the coarse pixel that thread `index` traces; -1 as the first: none."""
    rank = index % REGION_PIXELS
    region = (index // REGION_PIXELS) % lists.count.shape[1]
    view = index // (REGION_PIXELS * lists.count.shape[1])
    if rank >= lists.count[view, region, FRESH] and REGION_PIXELS - 1 - rank >= lists.count[view, region, AGED]:
        return -1, 0, 0
    offset, known, bits = unpack_entry(lists.entry[view, region, rank])
    return index - rank + offset, known, bits
