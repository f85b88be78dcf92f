"""Tile flags: which tiles of an image, and of coarse grids, are recomputed in a frame; all others keep the values of the previous frame."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import TILE_HEIGHT, TILE_WIDTH, ImageGrid, in_image, tile_of

wp.set_module_options({"enable_backward": False})

RATIO_STAGE, CHOICE_STAGE, BLOCK_STAGE, LIGHT_STAGE = wp.constant(1), wp.constant(2), wp.constant(4), wp.constant(8)
"""Bits of the stages that a tile of coarse pixels needs in a frame: its ratios, its choice of kernels, its block means, its light."""
ALL_STAGES = int(RATIO_STAGE) | int(CHOICE_STAGE) | int(BLOCK_STAGE) | int(LIGHT_STAGE)

DAMAGED, RELIT = wp.constant(1), wp.constant(2)
"""Reasons why a tile is dirty: its bodies changed; only its light or shadows changed."""


@wp.struct
class TileFlags:
    """Flags of tiles that may differ from the previous frame, and what each tile showed in it."""

    history_row: wp.array[int]
    """(view): row of the light history; the view itself without histories."""
    kept_row: wp.array[int]
    """(view): row of everything else that is kept from frame to frame."""
    holds: wp.array[int]
    """(view): 1 if `kept_row` contains the previous frame of the same episode; 0: all tiles are dirty."""
    stages: wp.array2d[wp.uint8]
    """(view, cell_tile): stages of the denoiser that the tile needs, bits as RATIO_STAGE."""
    due: wp.array2d[wp.uint8]
    """(view, cell_tile): 1: the denoised light of the tile's coarse pixels is new."""
    shadowed: wp.array2d[wp.uint8]
    """(view, shadow_tile): 1: a shadow ray of the tile's pixels of the shadow grid changed."""
    dirty: wp.array2d[wp.uint8]
    """(view, tile): why pixels of the tile may differ from the previous frame: DAMAGED or RELIT; 0: all are equal."""
    bodies: wp.array3d[wp.uint64]
    """(kept, tile, word): bit k of word w: rays through the tile could hit body 64 w + k in the previous frame."""


@wp.func
def tile_corner(grid: ImageGrid, tile: int) -> tuple[int, int]:
    """Row and column of the first pixel of a tile."""
    return (tile // grid.tile_columns) * TILE_HEIGHT, (tile % grid.tile_columns) * TILE_WIDTH


@wp.func
def skips(grid: ImageGrid, flags: TileFlags, stage: int, view: int, row: int, column: int) -> bool:
    """Whether a coarse pixel lies outside the image, or its tile does not need a stage."""
    return not in_image(grid, row, column) or (int(flags.stages[view, tile_of(grid, row, column)]) & stage) == 0


@wp.func
def needs(grid: ImageGrid, passes: wp.array2d[wp.uint8], which: int, view: int, row: int, column: int) -> bool:
    """Whether the tile of a pixel needs a pass of `ShadedImage.passes` in this frame."""
    return (int(passes[view, tile_of(grid, row, column)]) & which) != 0
