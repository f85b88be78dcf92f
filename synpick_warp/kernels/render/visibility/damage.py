"""Damage tracking: which bodies and tiles of a view may differ from the previous frame; visibility and masks of all others are kept."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import TILE_HEIGHT, TILE_WIDTH, ImageGrid, tile_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class Damage:
    """Damage of the views of a batch since the previous frame, and the rows at which that frame is kept."""

    kept_row: wp.array[int]
    """(view): row of everything that is kept from frame to frame; the view itself if nothing is."""
    holds: wp.array[int]
    """(view): 1: what is kept is the previous frame of the same episode; 0: all is damaged, and the other arrays are not read."""
    moved: wp.array2d[wp.uint8]
    """(view, body): 1: the body moved, appeared or disappeared."""
    touched: wp.array2d[wp.uint8]
    """(view, body): 1: rays through a damaged tile can hit the body."""
    dirty: wp.array2d[wp.uint8]
    """(view, tile): 1: rays through the tile can hit a body that moved, or could before."""


@wp.func
def has_moved(damage: Damage, view: int, body: int) -> bool:
    """Whether a body may have moved since the frame that is kept."""
    return damage.holds[view] == 0 or damage.moved[view, body] != wp.uint8(0)


@wp.func
def any_flagged(flags: wp.array2d[wp.uint8], grid: ImageGrid, view: int, top: int, left: int, bottom: int, right: int) -> bool:
    """Whether any tile of a grid is flagged that overlaps the pixels from (top, left) to (bottom, right), which may exceed the grid."""
    for row in range(wp.max(top, 0) // TILE_HEIGHT, wp.min(bottom, grid.height - 1) // TILE_HEIGHT + 1):
        for column in range(wp.max(left, 0) // TILE_WIDTH, wp.min(right, grid.width - 1) // TILE_WIDTH + 1):
            if flags[view, row * grid.tile_columns + column] != wp.uint8(0):
                return True
    return False


@wp.func
def is_damaged(damage: Damage, grid: ImageGrid, view: int, row: int, column: int) -> bool:
    """Whether a pixel may show another surface than in the frame that is kept."""
    return damage.holds[view] == 0 or damage.dirty[view, tile_of(grid, row, column)] != wp.uint8(0)
