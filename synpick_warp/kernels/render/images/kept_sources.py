"""Cache of anti-aliasing: which pixels lend their radiance to the samples of a footprint, as found by coverage rays in an earlier frame."""

import warp as wp

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
def recall_sources(kept: KeptSources, history: int, footprint: int, samples: int, damaged: bool) -> wp.uint32:
    """Source bits of a footprint, all 1 if they are unknown; those of a `damaged` footprint are forgotten."""
    mask = footprint_mask(samples)
    word, shift = footprint_word(footprint, samples), wp.uint32(footprint_shift(footprint, samples))
    sources = (kept.word[history, word] >> shift) & mask
    if damaged and sources != mask:
        sources = mask
        wp.atomic_or(kept.word, history, word, mask << shift)
    return sources


@wp.func
def clear_sources(kept: KeptSources, history: int, footprint: int, samples: int):
    """Set the source bits of a footprint to 0: each sample takes the radiance of its own pixel."""
    bits = footprint_mask(samples) << wp.uint32(footprint_shift(footprint, samples))
    wp.atomic_and(kept.word, history, footprint_word(footprint, samples), ~bits)
