"""Exact Euclidean distance transform of each instance's largest component: distance to the nearest pixel outside the component.

Separable (Meijster et al., 2000): d²(x, y) = min over x' of (x - x')² + g²(x', y), with the distance g within column x'. A *patch* is
the largest component of an instance; one word a pixel stores its patch and which of its 8 neighbours belong to the same patch.
"""

import warp as wp

from synpick_warp.kernels.perception.components import Segments
from synpick_warp.kernels.render.visibility.camera import ImageGrid, Views, in_image, tile_pixel

wp.set_module_options({"enable_backward": False})

EAST = wp.constant(0)
NORTH = wp.constant(2)
WEST = wp.constant(4)
SOUTH = wp.constant(6)
"""Chain-code directions, counter-clockwise in the image, from east (0) through north (2) and west (4) to south-east (7)."""
SEGMENT_BITS = wp.constant(8)
"""The low byte of a patch word is 1 + instance, 0: no patch; bit 8 + d: the neighbour in direction d belongs to the same patch."""
SEGMENT_MASK = wp.constant(255)


@wp.func
def direction_column(direction: int) -> int:
    """Column offset of the neighbour in a direction."""
    if direction == NORTH or direction == SOUTH:
        return 0
    if direction > NORTH and direction < SOUTH:
        return -1
    return 1


@wp.func
def direction_row(direction: int) -> int:
    """Row offset of the neighbour in a direction."""
    if direction == EAST or direction == WEST:
        return 0
    if direction < WEST:
        return -1
    return 1


@wp.kernel
def mark_patches_kernel(grid: ImageGrid, segments_inout: Segments, views: Views, first: int):
    """Patch word of each pixel: 1 + instance, and a bit for each of the 8 neighbours in the same component; none beyond the border.

    Launched over view, pixel (tile order, from flat index `first` on).
    """
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column) or views.world[view] < 0:
        return
    pixel = row * grid.width + column
    label = segments_inout.component[view, pixel]
    word = int(0)
    if label >= 0:
        here = int(segments_inout.segment[view, pixel])
        if segments_inout.largest[view, here - 1] == label:
            word = here
            for direction in range(8):
                x = column + direction_column(direction)
                y = row + direction_row(direction)
                if in_image(grid, y, x):
                    if segments_inout.component[view, y * grid.width + x] == label:
                        word = word | (1 << (direction + SEGMENT_BITS))
    segments_inout.patch[view, pixel] = wp.uint16(word)


@wp.kernel
def measure_columns_kernel(grid: ImageGrid, segments_inout: Segments, views: Views):
    """First pass, down and up each column: 256 g + (1 + instance) in patches, else 0.

    g [px] is the distance to the nearest pixel of the column outside the patch. Launched over view, column.
    """
    view, column = wp.tid()
    if views.world[view] < 0:
        return
    gap = int(0)
    for row in range(grid.height):
        pixel = row * grid.width + column
        word = int(segments_inout.patch[view, pixel])
        if word == 0:
            gap = 0
        elif (word >> (NORTH + SEGMENT_BITS)) & 1 != 0:
            gap += 1
        else:
            gap = 1
        segments_inout.gap[view, pixel] = (gap << SEGMENT_BITS) | (word & SEGMENT_MASK)
    gap = int(0)
    for i in range(grid.height):
        pixel = (grid.height - 1 - i) * grid.width + column
        word = int(segments_inout.patch[view, pixel])
        if word != 0:
            if (word >> (SOUTH + SEGMENT_BITS)) & 1 != 0:
                gap += 1
            else:
                gap = 1
            if gap < segments_inout.gap[view, pixel] >> SEGMENT_BITS:
                segments_inout.gap[view, pixel] = (gap << SEGMENT_BITS) | (word & SEGMENT_MASK)


@wp.func
def read_gap(gap: wp.array2d[int], view: int, row: int, column: int, width: int, segment: int) -> int:
    """Distance g within a column at a pixel; 0 if the pixel is outside the image or the patch `segment`."""
    if column < 0 or column >= width:
        return 0
    word = gap[view, row * width + column]
    if word & SEGMENT_MASK != segment:
        return 0
    return word >> SEGMENT_BITS


@wp.kernel
def measure_rows_kernel(grid: ImageGrid, segments_inout: Segments, views: Views, first: int):
    """Second pass: d = sqrt(min over x' of (x - x')² + g²(x')), searched outward until (x - x')² alone is as large; 0 outside patches.

    Launched over view, pixel (tile order, from flat index `first` on).
    """
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column) or views.world[view] < 0:
        return
    word = segments_inout.gap[view, row * grid.width + column]
    segment = word & SEGMENT_MASK
    square = word >> SEGMENT_BITS
    square = square * square
    offset = int(1)
    while offset * offset < square:
        left = read_gap(segments_inout.gap, view, row, column - offset, grid.width, segment)
        right = read_gap(segments_inout.gap, view, row, column + offset, grid.width, segment)
        nearer = wp.min(left, right)
        square = wp.min(square, offset * offset + nearer * nearer)
        offset += 1
    segments_inout.distance[view, row * grid.width + column] = wp.sqrt(float(square))
