"""Cache of anti-aliasing: which pixels lend their radiance to the samples of a footprint, as found by coverage rays in an earlier frame."""

import warp as wp

from synpick_warp.kernels.render.lighting.tile_flags import DAMAGED, TileFlags, tile_corner
from synpick_warp.kernels.render.visibility.camera import TILE_WIDTH, ImageGrid

wp.set_module_options({"enable_backward": False})

SOURCE_BITS = wp.constant(2)
"""Bits of a sample in `ShadedImage.resolve`."""
WORD_SAMPLES = wp.constant(16)
"""Samples in a word of `KeptSources`."""


@wp.struct
class KeptSources:
    """Source bits of the samples of each footprint, which are kept as long as the footprint's tiles are not damaged."""

    word: wp.array2d[wp.uint32]
    """(row of the light history, word): SOURCE_BITS for each sample, of one footprint after the other; all 1: unknown. The samples of a
    footprint belong to one word. Empty: nothing is kept."""


@wp.func
def footprint_mask(samples: int) -> wp.uint32:
    """Bit mask of the source bits of one footprint."""
    return wp.uint32(0xFFFFFFFF) >> wp.uint32(SOURCE_BITS * (WORD_SAMPLES - samples))


@wp.func
def footprint_word(footprint: int, samples: int) -> int:
    """Word of `KeptSources` with the samples of a footprint."""
    return footprint // (WORD_SAMPLES // samples)


@wp.func
def footprint_shift(footprint: int, samples: int) -> int:
    """Place of the samples of a footprint in their word [bits]."""
    return SOURCE_BITS * samples * (footprint % (WORD_SAMPLES // samples))


@wp.func
def read_sources(kept: KeptSources, history: int, footprint: int, samples: int) -> wp.uint32:
    """Source bits of a footprint, all 1 if they are unknown."""
    shift = wp.uint32(footprint_shift(footprint, samples))
    return (kept.word[history, footprint_word(footprint, samples)] >> shift) & footprint_mask(samples)


@wp.func
def clear_sources(kept: KeptSources, history: int, footprint: int, samples: int):
    """Set the source bits of a footprint to 0: each sample takes the radiance of its own pixel."""
    bits = footprint_mask(samples) << wp.uint32(footprint_shift(footprint, samples))
    wp.atomic_and(kept.word, history, footprint_word(footprint, samples), ~bits)


@wp.kernel
def forget_sources_kernel(grid: ImageGrid, flags: TileFlags, samples: int, kept_inout: KeptSources):
    """Set the source bits of all footprints that have a corner in a damaged tile to unknown.

    The pixels of a tile are corners of one footprint more in each direction; in a row, their bits are consecutive. Launched over view,
    tile, row of footprints.
    """
    view, tile, down = wp.tid()
    if (int(flags.dirty[view, tile]) & DAMAGED) == 0:
        return
    top, left = tile_corner(grid, tile)
    history, share, width = flags.history_row[view], WORD_SAMPLES // samples, SOURCE_BITS * samples
    first = wp.min(top + down, grid.height) * (grid.width + 1) + left
    last = first + wp.min(TILE_WIDTH, grid.width - left)
    for word in range(first // share, last // share + 1):
        begin, end = wp.max(first - word * share, 0), wp.min(last - word * share + 1, share)
        bits = (wp.uint32(0xFFFFFFFF) >> wp.uint32(32 - width * (end - begin))) << wp.uint32(width * begin)
        if (kept_inout.word[history, word] & bits) != bits:
            wp.atomic_or(kept_inout.word, history, word, bits)
