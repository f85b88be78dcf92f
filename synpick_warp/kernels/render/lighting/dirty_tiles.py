"""Damage tracking: dirty tiles, which may differ from the previous frame, by bodies, light and shadows; and the passes that tiles need.

The pixels of a tile depend on the bodies whose boxes its rays may hit, and on the denoised light and the shadow rays around. If all of
these are identical to those of the previous frame, the tile keeps its colours of that frame.
"""

import warp as wp

from synpick_warp.kernels.bitsets import lowest_bit
from synpick_warp.kernels.render.lighting.coarse_grid import CoarseGrid
from synpick_warp.kernels.render.lighting.moving_bodies import MovingBodies
from synpick_warp.kernels.render.lighting.shadow_filter import FILTER_RADIUS, STEEPNESS_DISTANCE
from synpick_warp.kernels.render.lighting.tile_flags import DAMAGED, RELIT, TileFlags, tile_corner
from synpick_warp.kernels.render.lighting.upsampling import RING
from synpick_warp.kernels.render.visibility.camera import TILE_HEIGHT, TILE_WIDTH, ImageGrid, clamp_index
from synpick_warp.kernels.render.visibility.damage import any_flagged
from synpick_warp.kernels.render.visibility.gbuffer import COLOR_PASS, EDGE_PASS, MASK_BITS, SHADE_PASS, AnyShot, ShadedImage, ViewBodies
from synpick_warp.kernels.render.visibility.variants import kernel_of_views

wp.set_module_options({"enable_backward": False})

LIGHT_REACH = wp.constant(1 + int(RING))
"""Largest distance of the coarse pixels whose light a pixel interpolates [coarse pixels]."""
SHADOW_REACH = wp.constant(1 + int(STEEPNESS_DISTANCE) + int(FILTER_RADIUS))
"""Largest distance of the shadow rays that a pixel's shadows depend on [pixels of the shadow grid]: it reads its neighbours and their
marks of edges, which depend on the steepness, and that on filtered rays."""


@wp.func
def tile_word(bodies: ViewBodies, view: int, tile: int, word: int) -> wp.uint64:
    """Word of the bit set, by body, of the bodies that rays through a tile can hit; `ViewBodies.body_mask` has them by place in `order`."""
    result = wp.uint64(0)
    for source in range(bodies.body_mask.shape[2]):
        left = bodies.body_mask[view, tile, source]
        while left != wp.uint64(0):
            body = bodies.order[view, source * MASK_BITS + lowest_bit(left)]
            if body // MASK_BITS == word:
                result = result | (wp.uint64(1) << wp.uint64(body % MASK_BITS))
            left = left & (left - wp.uint64(1))
    return result


@wp.func
def any_moved(moving: MovingBodies, view: int, word: int, members: wp.uint64) -> bool:
    """Whether any body of word `word` of a bit set moved since the previous frame."""
    left = members
    while left != wp.uint64(0):
        if moving.moved[view, word * MASK_BITS + lowest_bit(left)] != wp.uint8(0):
            return True
        left = left & (left - wp.uint64(1))
    return False


@wp.func
def any_near(flags: wp.array2d[wp.uint8], coarse: CoarseGrid, view: int, row: int, column: int, reach: int) -> bool:
    """Whether any tile of a coarse grid is flagged that has pixels within `reach` of those below an image tile at (row, column)."""
    bottom, right = (row + TILE_HEIGHT - 1) // coarse.size + reach, (column + TILE_WIDTH - 1) // coarse.size + reach
    return any_flagged(flags, coarse.grid, view, row // coarse.size - reach, column // coarse.size - reach, bottom, right)


@wp.func
def touch_bodies(moving: MovingBodies, view: int, word: int, members: wp.uint64):
    """Mark the bodies of word `word` of a bit set as touched."""
    left = members
    while left != wp.uint64(0):
        moving.touched[view, word * MASK_BITS + lowest_bit(left)] = wp.uint8(1)
        left = left & (left - wp.uint64(1))


@wp.kernel
def mark_damaged_tiles_kernel(bodies: ViewBodies, moving_inout: MovingBodies, flags_inout: TileFlags):
    """Mark the tiles whose bodies changed since the previous frame, and the bodies in them; all if that frame is not kept. Writes `dirty`,
    `bodies` and, where that frame is kept, `touched`. Launched over view, tile."""
    view, tile = wp.tid()
    kept = flags_inout.kept_row[view]
    dirty = flags_inout.holds[view] == 0
    for word in range(flags_inout.bodies.shape[2]):
        members = tile_word(bodies, view, tile, word)
        if members != flags_inout.bodies[kept, tile, word]:
            dirty = True
            flags_inout.bodies[kept, tile, word] = members
        elif not dirty:
            dirty = any_moved(moving_inout, view, word, members)
    flags_inout.dirty[view, tile] = wp.uint8(wp.where(dirty, DAMAGED, 0))
    if dirty and flags_inout.holds[view] != 0:
        for word in range(flags_inout.bodies.shape[2]):
            touch_bodies(moving_inout, view, word, flags_inout.bodies[kept, tile, word])


@kernel_of_views
def mark_relit_tiles_kernel(coarse: CoarseGrid, shadow_grid: CoarseGrid, shot: AnyShot, flags_inout: TileFlags):
    """Mark the tiles whose light or shadows changed since the previous frame, beside those that are dirty. Launched over view, tile."""
    view, tile = wp.tid()
    if flags_inout.dirty[view, tile] == wp.uint8(0):
        row, column = tile_corner(shot.grid, tile)
        dirty = bool(False)
        if coarse.size > 0:
            dirty = any_near(flags_inout.due, coarse, view, row, column, LIGHT_REACH)
        if not dirty:
            dirty = any_near(flags_inout.shadowed, shadow_grid, view, row, column, SHADOW_REACH)
        flags_inout.dirty[view, tile] = wp.uint8(wp.where(dirty, RELIT, 0))


@wp.func
def distance_to_dirty(grid: ImageGrid, dirty: wp.array2d[wp.uint8], view: int, tile: int, most: int) -> int:
    """Chebyshev distance of a tile from the nearest dirty one [tiles], `most` + 1 beyond `most`."""
    row, column = tile // grid.tile_columns, tile % grid.tile_columns
    last_row = (grid.height - 1) // TILE_HEIGHT
    nearest = most + 1
    for down in range(-most, most + 1):
        r = clamp_index(row + down, last_row + 1)
        for right in range(-most, most + 1):
            c = clamp_index(column + right, grid.tile_columns)
            if dirty[view, r * grid.tile_columns + c] != wp.uint8(0):
                nearest = wp.min(nearest, wp.max(wp.abs(r - row), wp.abs(c - column)))
    return nearest


@wp.kernel
def plan_passes_kernel(grid: ImageGrid, flags: TileFlags, image_inout: ShadedImage):
    """Plan `ShadedImage.passes` of each tile, by its distance from the dirty ones.

    Colours change in dirty tiles and their neighbours, since anti-aliasing and the filter of shadow edges read up to 4 pixels around. Their
    colours need the radiance of the next ring of tiles, too, and that from the shadow edges of one more ring. Launched over view, tile.
    """
    view, tile = wp.tid()
    distance = distance_to_dirty(grid, flags.dirty, view, tile, 3)
    passes = int(0)
    if distance <= 1:
        passes = passes | COLOR_PASS
    if distance <= 2:
        passes = passes | SHADE_PASS
    if distance <= 3:
        passes = passes | EDGE_PASS
    image_inout.passes[view, tile] = wp.uint8(passes)
