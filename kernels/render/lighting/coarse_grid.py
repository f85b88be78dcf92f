"""Cells of pixels, of which one pixel casts rays for all: where they are, what surface is in their middle, which points they take."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS, ImageGrid

wp.set_module_options({"enable_backward": False})

SPREAD = wp.constant(4)
"""The threads of a warp take cells so far apart, by row and by column."""
LANES_ACROSS = wp.constant(8)
"""So many of a warp's threads take cells of one row."""
SAME_SURFACE = wp.constant(1.0)
"""Cells count as one surface up to this distance from its tangent plane, in widths of a cell at their depth, times the stride."""
LEAST_WEIGHT = wp.constant(1.0e-4)
"""Weight, when a pixel looks for cells, of one on another surface: it serves where there is no other."""


@wp.struct
class CellGrid:
    """Cells of pixels, and which pixel stands for each: the one in its middle."""

    size: int
    """Width of a cell [px]."""
    window: int
    """Width of the window that shares shadow rays among cells, a power of two. A square so wide holds each of window² points once,
    wherever it lies, so that they leave no pattern."""
    image: ImageGrid
    cells: ImageGrid


@wp.struct
class Guide:
    """Scratch, one a view and cell: the surface in the cell's middle."""

    normal: wp.array3d[wp.vec3]
    """In the camera's axes."""
    depth: wp.array3d[float]
    """Planar depth [m]."""
    segment: wp.array3d[wp.uint8]
    """As in `GBuffer`."""


@wp.func
def cell_pixel(cells: CellGrid, row: int, column: int) -> wp.vec2i:
    """(row, column) of the pixel that stands for a cell."""
    middle = cells.size // 2
    return wp.vec2i(wp.min(row * cells.size + middle, cells.image.height - 1), wp.min(column * cells.size + middle, cells.image.width - 1))


@wp.func
def cell_number(period: int, row: int, column: int) -> int:
    """Which of period² points a cell takes: bits of row and column in turn, so that aligned squares hold aligned runs of numbers."""
    number = int(0)
    for bit in range(4):
        if (1 << bit) < period:
            number += ((column >> bit) & 1) << (2 * bit)
            number += ((row >> bit) & 1) << (2 * bit + 1)
    return number


@wp.func
def cell_place(cells: CellGrid, pixel: int) -> float:
    """A pixel's row or column in cells, from the middle of the first one's window, which is half a cell before its own."""
    return float(pixel - cells.size // 2) / float(cells.size) + 0.5


@wp.func
def spread_cell(cells: CellGrid, index: int) -> tuple[int, int, int]:
    """(view, row, column) of a flat index. The threads of a warp take cells SPREAD apart, whose points are alike: their rays are nearly
    parallel, and visit the same nodes of a mesh's tree."""
    across = SPREAD * LANES_ACROSS
    down = SPREAD * (TILE_PIXELS // LANES_ACROSS)
    regions_across = (cells.cells.width + across - 1) // across
    regions = regions_across * ((cells.cells.height + down - 1) // down)
    lane = index % TILE_PIXELS
    place = (index // TILE_PIXELS) % (SPREAD * SPREAD)
    region = index // (TILE_PIXELS * SPREAD * SPREAD)
    view = region // regions
    region = region - view * regions
    row = (region // regions_across) * down + (lane // LANES_ACROSS) * SPREAD + place // SPREAD
    column = (region % regions_across) * across + (lane % LANES_ACROSS) * SPREAD + place % SPREAD
    return view, row, column
