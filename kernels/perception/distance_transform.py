"""Exact Euclidean distance of the pixels of each instance's largest component to the nearest pixel that is not of it.

Separable, as all such transforms: d²(x, y) = min over x' of (x - x')² + g²(x', y), g the distance within column x'. A *patch* is the
largest component of an instance; one word a pixel holds which patch it is of and which of its neighbours are of the same.
"""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import ImageGrid, Views, in_image, tile_pixel

wp.set_module_options({"enable_backward": False})

EAST = wp.constant(0)
NORTH = wp.constant(2)
WEST = wp.constant(4)
SOUTH = wp.constant(6)
"""Directions count counter-clockwise in the image, from east (0) over north (2) and west (4) to south-east (7)."""
SEGMENT_BITS = wp.constant(8)
"""The low byte of a patch word is 1 + instance, 0: of no patch; bit 8 + d above it: the neighbour in direction d is of the same patch."""
SEGMENT_MASK = wp.constant(255)


@wp.func
def direction_column(direction: int) -> int:
    """Column of the neighbour in a direction, minus the pixel's own."""
    if direction == NORTH or direction == SOUTH:
        return 0
    if direction > NORTH and direction < SOUTH:
        return -1
    return 1


@wp.func
def direction_row(direction: int) -> int:
    """Row of the neighbour in a direction, minus the pixel's own."""
    if direction == EAST or direction == WEST:
        return 0
    if direction < WEST:
        return -1
    return 1


@wp.kernel
def mark_patches_kernel(
    # Scene:
    grid: ImageGrid,
    # In:
    views: Views,
    segment: wp.array2d[wp.uint8],
    component: wp.array2d[int],
    largest: wp.array2d[int],
    first: int,
    # Out:
    patch_out: wp.array2d[wp.uint16],
):
    """Patch word of each pixel: 1 + instance, and a bit for each of the 8 neighbours in the same component. Beyond the border: no."""
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column) or views.world[view] < 0:
        return
    pixel = row * grid.width + column
    name = component[view, pixel]
    word = int(0)
    if name >= 0:
        here = int(segment[view, pixel])
        if largest[view, here - 1] == name:
            word = here
            for direction in range(8):
                x = column + direction_column(direction)
                y = row + direction_row(direction)
                if x >= 0 and y >= 0 and x < grid.width and y < grid.height:
                    if component[view, y * grid.width + x] == name:
                        word = word | (1 << (direction + SEGMENT_BITS))
    patch_out[view, pixel] = wp.uint16(word)


@wp.kernel
def measure_columns_kernel(
    # Scene:
    grid: ImageGrid,
    # In:
    views: Views,
    patch: wp.array2d[wp.uint16],
    # Out:
    gap_out: wp.array2d[int],
):
    """256 g + (1 + instance) for pixels of a patch, else 0: g [px] the distance to the nearest pixel of the column that is not of it."""
    view, column = wp.tid()
    if views.world[view] < 0:
        return
    gap = int(0)
    for row in range(grid.height):
        pixel = row * grid.width + column
        word = int(patch[view, pixel])
        if word == 0:
            gap = 0
        elif (word >> (NORTH + SEGMENT_BITS)) & 1 != 0:
            gap += 1
        else:
            gap = 1
        gap_out[view, pixel] = (gap << SEGMENT_BITS) | (word & SEGMENT_MASK)
    gap = int(0)
    for i in range(grid.height):
        pixel = (grid.height - 1 - i) * grid.width + column
        word = int(patch[view, pixel])
        if word != 0:
            if (word >> (SOUTH + SEGMENT_BITS)) & 1 != 0:
                gap += 1
            else:
                gap = 1
            if gap < gap_out[view, pixel] >> SEGMENT_BITS:
                gap_out[view, pixel] = (gap << SEGMENT_BITS) | (word & SEGMENT_MASK)


@wp.func
def gap_in(gap: wp.array2d[int], view: int, row: int, column: int, width: int, segment: int) -> int:
    """Distance to the nearest pixel not of a patch, within a column and from a pixel; 0 if that pixel is not of it."""
    if column < 0 or column >= width:
        return 0
    word = gap[view, row * width + column]
    if word & SEGMENT_MASK != segment:
        return 0
    return word >> SEGMENT_BITS


@wp.kernel
def measure_rows_kernel(
    # Scene:
    grid: ImageGrid,
    # In:
    views: Views,
    gap: wp.array2d[int],
    first: int,
    # Out:
    distance_out: wp.array2d[float],
):
    """d = sqrt(min over x' of (x - x')² + g²(x')) [px], searched outwards until (x - x')² alone is as large; 0 outside of patches."""
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column) or views.world[view] < 0:
        return
    word = gap[view, row * grid.width + column]
    segment = word & SEGMENT_MASK
    least = word >> SEGMENT_BITS
    least = least * least
    offset = int(1)
    while offset * offset < least:
        left = gap_in(gap, view, row, column - offset, grid.width, segment)
        right = gap_in(gap, view, row, column + offset, grid.width, segment)
        nearer = wp.min(left, right)
        least = wp.min(least, offset * offset + nearer * nearer)
        offset += 1
    distance_out[view, row * grid.width + column] = wp.sqrt(float(least))
