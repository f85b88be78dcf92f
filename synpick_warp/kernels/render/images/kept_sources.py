"""Cache of coverage sampling for anti-aliasing: the source pixel of each coverage sample, from an earlier frame of the same geometry."""

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
    """Source pixels of the coverage samples of each footprint, valid until a tile of the footprint is damaged."""

    word: wp.array2d[wp.uint32]
    """(kept, word): SOURCE_BITS per sample, footprints in row-major order; a footprint's samples share a word. All bits
    of a footprint are 1 if its sources are unknown. Empty: nothing is kept."""


@wp.func
def footprint_mask(samples: int) -> wp.uint32:
    """Bit mask of a footprint's samples at bit 0 of a word; also the value of unknown sources."""
    return wp.uint32(0xFFFFFFFF) >> wp.uint32(SOURCE_BITS * (WORD_SAMPLES - samples))


@wp.func
def locate_sources(footprint: int, samples: int) -> tuple[int, wp.uint32]:
    """Index of the word that holds a footprint's samples, and of their lowest bit in it."""
    share = WORD_SAMPLES // samples
    return footprint // share, wp.uint32(SOURCE_BITS * samples * (footprint % share))


@wp.func
def read_sources(kept: KeptSources, row: int, footprint: int, samples: int) -> wp.uint32:
    """Read the source bits of a footprint; `footprint_mask` if they are unknown."""
    word, shift = locate_sources(footprint, samples)
    return (kept.word[row, word] >> shift) & footprint_mask(samples)


@wp.func
def clear_sources(kept: KeptSources, row: int, footprint: int, samples: int):
    """Set the source bits of a footprint to 0, so that each sample takes the radiance of its own pixel."""
    word, shift = locate_sources(footprint, samples)
    wp.atomic_and(kept.word, row, word, ~(footprint_mask(samples) << shift))


@wp.kernel
def forget_sources_kernel(grid: ImageGrid, flags: TileFlags, samples: int, kept_inout: KeptSources):
    """Cache invalidation: set the sources of all footprints with a corner pixel in a damaged tile to unknown. A tile of H x W pixels
    touches (H + 1) x (W + 1) footprints; the bits of those in one row are consecutive. Launched over view, tile, row of footprints."""
    view, tile, down = wp.tid()
    if (int(flags.dirty[view, tile]) & DAMAGED) == 0:
        return
    top, left = tile_corner(grid, tile)
    row, share, width = flags.kept_row[view], WORD_SAMPLES // samples, SOURCE_BITS * samples
    first = wp.min(top + down, grid.height) * (grid.width + 1) + left
    last = first + wp.min(TILE_WIDTH, grid.width - left)
    for word in range(first // share, last // share + 1):
        begin, end = wp.max(first - word * share, 0), wp.min(last - word * share + 1, share)
        bits = (wp.uint32(0xFFFFFFFF) >> wp.uint32(32 - width * (end - begin))) << wp.uint32(width * begin)
        if (kept_inout.word[row, word] & bits) != bits:
            wp.atomic_or(kept_inout.word, row, word, bits)
