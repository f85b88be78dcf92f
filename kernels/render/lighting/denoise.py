"""The filter of the fast picture: shares light among cells on the same surface, over windows as wide as the light is even."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.coarse_grid import LEAST_WEIGHT, SAME_SURFACE, CellGrid, Guide, cell_pixel, cell_place
from synpick_warp.kernels.render.lighting.coarse_paths import Gathered
from synpick_warp.kernels.render.lighting.color import LEAST_LIGHT, luminance
from synpick_warp.kernels.render.lighting.plane_distance import Plane, off_plane, pixel_plane
from synpick_warp.kernels.render.lighting.unoccluded import Light, ratio
from synpick_warp.kernels.render.visibility.camera import Cameras, Views, in_image, tile_pixel

wp.set_module_options({"enable_backward": False, "fast_math": True})

BLOCK = wp.constant(4)
"""Cells across a block: the narrowest window of the filter."""
BLOCKS = wp.constant(4)
"""Blocks across the widest window."""
MIDDLE_BLOCKS = wp.constant(4.0)
"""Blocks of the window between: 2 x 2."""
RING = wp.constant(1)
"""How many cells farther a pixel looks for its surface if none of the four about it is on it."""
BODY_WEIGHT = wp.constant(0.02)
"""Weight of a cell on the same body but another surface: it calms places that have few like them around."""


@wp.struct
class Shares:
    """Scratch, one a view and cell: what each pixel about it multiplies its own even light by, and what it adds."""

    diffuse: wp.array3d[wp.vec3]
    gloss: wp.array3d[wp.vec3]
    between: wp.array3d[wp.vec3]


@wp.func
def plane_at(cells: CellGrid, guide: Guide, intrinsics: wp.vec4, view: int, row: int, column: int) -> Plane:
    """The tangent plane of what a cell shows; rows and columns are of cells."""
    pixel = cell_pixel(cells, row, column)
    depth = guide.depth[view, row, column]
    made = pixel_plane(intrinsics, pixel[0], pixel[1], guide.segment[view, row, column], depth, guide.normal[view, row, column])
    size = float(cells.size)
    made.down = size * made.down
    made.right = size * made.right
    made.width = size * made.width
    return made


@wp.func
def likeness(guide: Guide, plane: Plane, view: int, row: int, column: int, down: int, right: int, stride: int) -> float:
    """Weight of the cell at (row, column), so many cells down and right of the plane's own; 0 on another body."""
    if guide.segment[view, row, column] != plane.segment:
        return 0.0
    weight = BODY_WEIGHT
    if off_plane(plane, down, right, guide.depth[view, row, column]) < SAME_SURFACE * plane.width * float(stride):
        cosine = wp.max(wp.dot(guide.normal[view, row, column], plane.normal), 0.0)
        square = cosine * cosine
        weight += square * square * square * square
    return weight


@wp.struct
class Window:
    """Weighted sums over a window."""

    diffuse: wp.vec3
    gloss: wp.vec3
    even_diffuse: wp.vec3
    even_gloss: wp.vec3
    between: wp.vec3
    weight: float


@wp.func
def widened(window: Window, gathered: Gathered, view: int, row: int, column: int, weight: float) -> Window:
    """`window` with one more cell."""
    made = Window()
    made.diffuse = window.diffuse + weight * gathered.diffuse[view, row, column]
    made.gloss = window.gloss + weight * gathered.gloss[view, row, column]
    made.even_diffuse = window.even_diffuse + weight * gathered.even_diffuse[view, row, column]
    made.even_gloss = window.even_gloss + weight * gathered.even_gloss[view, row, column]
    made.between = window.between + weight * gathered.between[view, row, column]
    made.weight = window.weight + weight
    return made


@wp.func
def bright_ratio(light: wp.vec3, even: wp.vec3) -> float:
    """Of luminances; even light is never 0 unless the whole map is."""
    return luminance(light) / wp.max(luminance(even), LEAST_LIGHT)


@wp.kernel
def sum_blocks_kernel(
    # Scene:
    cameras: Cameras,
    cells: CellGrid,
    # In:
    guide: Guide,
    gathered: Gathered,
    views: Views,
    first: int,
    # Out:
    gathered_out: Gathered,
):
    """Weighted mean over the block about each cell, and its variance: that of what it averages, over the effective number of cells."""
    view, row, column = tile_pixel(cells.cells, wp.tid() + first)
    if not in_image(cells.cells, row, column):
        return
    if int(guide.segment[view, row, column]) == Segment.NOTHING:
        return
    plane = plane_at(cells, guide, cameras.intrinsics[views.camera[view]], view, row, column)
    window = Window()
    share = wp.vec2(0.0, 0.0)
    square = wp.vec2(0.0, 0.0)
    squared_weight = float(0.0)
    for i in range(BLOCK):
        down = i - BLOCK // 2
        r = row + down
        if r >= 0 and r < cells.cells.height:
            for j in range(BLOCK):
                right = j - BLOCK // 2
                c = column + right
                if c >= 0 and c < cells.cells.width:
                    weight = likeness(guide, plane, view, r, c, down, right, 1)
                    if weight > 0.0:
                        window = widened(window, gathered, view, r, c, weight)
                        d = bright_ratio(gathered.diffuse[view, r, c], gathered.even_diffuse[view, r, c])
                        g = bright_ratio(gathered.gloss[view, r, c], gathered.even_gloss[view, r, c])
                        share += weight * wp.vec2(d, g)
                        square += weight * wp.vec2(d * d, g * g)
                        squared_weight += weight * weight
    total = window.weight
    gathered_out.diffuse[view, row, column] = window.diffuse / total
    gathered_out.gloss[view, row, column] = window.gloss / total
    gathered_out.even_diffuse[view, row, column] = window.even_diffuse / total
    gathered_out.even_gloss[view, row, column] = window.even_gloss / total
    gathered_out.between[view, row, column] = window.between / total
    share = share / total
    spread = square / total - wp.cw_mul(share, share)
    count = total * total / squared_weight
    gathered_out.variance[view, row, column] = wp.vec2(wp.max(spread[0], 0.0), wp.max(spread[1], 0.0)) / count


@wp.func
def narrowed(wide: wp.vec3, narrow: wp.vec3, variance: float) -> wp.vec3:
    """`wide`, moved towards `narrow` as far as their difference is more than the noise of `narrow`, of this variance."""
    difference = luminance(narrow) - luminance(wide)
    square = difference * difference
    if square <= variance:
        return wide
    return wide + (1.0 - variance / square) * (narrow - wide)


@wp.kernel
def choose_windows_kernel(
    # Scene:
    cameras: Cameras,
    cells: CellGrid,
    # In:
    guide: Guide,
    gathered: Gathered,
    views: Views,
    doubt: float,
    first: int,
    # Out:
    shares_out: Shares,
):
    """Shares of even light from the widest window that tells no other than the narrower ones: 4 x 4 blocks, 2 x 2 or one about each cell.
    Blocks of a window do not overlap, so that a mean over n of them has an n-th of a block's variance, which is `doubt` times the found.
    """
    view, row, column = tile_pixel(cells.cells, wp.tid() + first)
    if not in_image(cells.cells, row, column):
        return
    if int(guide.segment[view, row, column]) == Segment.NOTHING:
        return
    plane = plane_at(cells, guide, cameras.intrinsics[views.camera[view]], view, row, column)
    wide = Window()
    middle = Window()
    variance = wp.vec2(0.0, 0.0)
    for i in range(BLOCKS):
        down = i * BLOCK - BLOCK * (BLOCKS - 1) // 2
        r = row + down
        if r >= 0 and r < cells.cells.height:
            for j in range(BLOCKS):
                right = j * BLOCK - BLOCK * (BLOCKS - 1) // 2
                c = column + right
                if c >= 0 and c < cells.cells.width:
                    weight = likeness(guide, plane, view, r, c, down, right, BLOCK)
                    if weight > 0.0:
                        wide = widened(wide, gathered, view, r, c, weight)
                        variance += weight * gathered.variance[view, r, c]
                        if (i == 1 or i == 2) and (j == 1 or j == 2):
                            middle = widened(middle, gathered, view, r, c, weight)
    own_diffuse = ratio(gathered.diffuse[view, row, column], gathered.even_diffuse[view, row, column])
    own_gloss = ratio(gathered.gloss[view, row, column], gathered.even_gloss[view, row, column])
    if wide.weight <= 0.0:
        # None of the blocks may have its middle on the body.
        shares_out.diffuse[view, row, column] = own_diffuse
        shares_out.gloss[view, row, column] = own_gloss
        shares_out.between[view, row, column] = gathered.between[view, row, column]
        return
    variance = doubt * variance / wide.weight
    diffuse = ratio(wide.diffuse, wide.even_diffuse)
    gloss = ratio(wide.gloss, wide.even_gloss)
    if middle.weight > 0.0:
        diffuse = narrowed(diffuse, ratio(middle.diffuse, middle.even_diffuse), variance[0] / MIDDLE_BLOCKS)
        gloss = narrowed(gloss, ratio(middle.gloss, middle.even_gloss), variance[1] / MIDDLE_BLOCKS)
    shares_out.diffuse[view, row, column] = narrowed(diffuse, own_diffuse, variance[0])
    shares_out.gloss[view, row, column] = narrowed(gloss, own_gloss, variance[1])
    shares_out.between[view, row, column] = wide.between / wide.weight


@wp.kernel
def soften_shares_kernel(
    # Scene:
    cameras: Cameras,
    cells: CellGrid,
    # In:
    guide: Guide,
    shares: Shares,
    views: Views,
    first: int,
    # Out:
    shares_out: Shares,
):
    """Weighted mean over 3 x 3 cells: windows have no edges then."""
    view, row, column = tile_pixel(cells.cells, wp.tid() + first)
    if not in_image(cells.cells, row, column):
        return
    if int(guide.segment[view, row, column]) == Segment.NOTHING:
        return
    plane = plane_at(cells, guide, cameras.intrinsics[views.camera[view]], view, row, column)
    diffuse = wp.vec3(0.0, 0.0, 0.0)
    gloss = wp.vec3(0.0, 0.0, 0.0)
    between = wp.vec3(0.0, 0.0, 0.0)
    total = float(0.0)
    for down in range(-1, 2):
        r = row + down
        if r >= 0 and r < cells.cells.height:
            for right in range(-1, 2):
                c = column + right
                if c >= 0 and c < cells.cells.width:
                    weight = likeness(guide, plane, view, r, c, down, right, 1)
                    diffuse += weight * shares.diffuse[view, r, c]
                    gloss += weight * shares.gloss[view, r, c]
                    between += weight * shares.between[view, r, c]
                    total += weight
    shares_out.diffuse[view, row, column] = diffuse / total
    shares_out.gloss[view, row, column] = gloss / total
    shares_out.between[view, row, column] = between / total


@wp.func
def cell_likeness(guide: Guide, cells: CellGrid, plane: Plane, view: int, row: int, column: int, r: int, c: int) -> float:
    """1 if the cell (r, c) is on the surface that the pixel (row, column) shows, LEAST_WEIGHT if on another, 0 if on none."""
    segment = guide.segment[view, r, c]
    if int(segment) == Segment.NOTHING:
        return 0.0
    pixel = cell_pixel(cells, r, c)
    apart = off_plane(plane, pixel[0] - row, pixel[1] - column, guide.depth[view, r, c])
    if segment != plane.segment or apart > SAME_SURFACE * float(cells.size) * plane.width:
        return LEAST_WEIGHT
    return 1.0


@wp.func
def with_cell(light: Light, shares: Shares, view: int, row: int, column: int, weight: float) -> Light:
    """`light` with the shares of one more cell."""
    made = Light()
    made.diffuse = light.diffuse + weight * shares.diffuse[view, row, column]
    made.gloss = light.gloss + weight * shares.gloss[view, row, column]
    made.between = light.between + weight * shares.between[view, row, column]
    return made


@wp.func
def gathered_share(guide: Guide, shares: Shares, cells: CellGrid, view: int, row: int, column: int, plane: Plane) -> Light:
    """Shares of even light at a pixel, from the four cells about it; those on other surfaces count next to nothing.

    If all four are on other surfaces, those around them are looked at too: light changes less along a surface than from one to another.
    `plane` is the pixel's.
    """
    y = cell_place(cells, row)
    x = cell_place(cells, column)
    top = int(wp.floor(y))
    left = int(wp.floor(x))
    made = Light()
    total = float(0.0)
    most = float(0.0)
    for i in range(2):
        r = wp.clamp(top + i, 0, cells.cells.height - 1)
        vertical = 1.0 - wp.abs(y - float(top + i))
        for j in range(2):
            c = wp.clamp(left + j, 0, cells.cells.width - 1)
            like = cell_likeness(guide, cells, plane, view, row, column, r, c)
            if like > 0.0:
                weight = like * (vertical * (1.0 - wp.abs(x - float(left + j))) + LEAST_WEIGHT)
                made = with_cell(made, shares, view, r, c, weight)
                total += weight
                most = wp.max(most, like)
    if most < 1.0:
        # Not unrolled: few pixels come here.
        ring = int(RING)
        for i in range(-ring, 2 + ring):
            r = wp.clamp(top + i, 0, cells.cells.height - 1)
            for j in range(-ring, 2 + ring):
                c = wp.clamp(left + j, 0, cells.cells.width - 1)
                if cell_likeness(guide, cells, plane, view, row, column, r, c) == 1.0:
                    made = with_cell(made, shares, view, r, c, 1.0)
                    total += 1.0
    if total <= 0.0:
        # Nothing but background around: as if nothing stood in the way.
        made.diffuse = wp.vec3(1.0, 1.0, 1.0)
        made.gloss = wp.vec3(1.0, 1.0, 1.0)
        return made
    made.diffuse = made.diffuse / total
    made.gloss = made.gloss / total
    made.between = made.between / total
    return made
