"""Anti-aliasing of the fast picture's colour: where the pixels about a point show several surfaces, more rays are cast.

The unit is the square between the centres of four pixels. Where all four show one surface, so does all of the square; where they do
not, each pixel's rays that pass the square ask which surface they meet, and take the colour of the one of the four that shows it. So a
ray costs no light; what textures show is filtered already.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.plane_distance import Plane, plane_distance, tangent_plane
from synpick_warp.kernels.render.visibility.camera import Cameras, ImageGrid, Views, camera_ray, in_image, tile_of, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import (
    RAY_REGISTERS,
    GBuffer,
    Hit,
    Meshes,
    Table,
    ViewBodies,
    body_of,
    face_normal,
    hit_table,
    trace_bodies,
)

wp.set_module_options({"enable_backward": False})

SAMPLES = wp.constant(4)
"""Rays of a pixel: one in each quarter of it. Eight are nearer to the reference by 0.07 dB, and cost half as much again."""
ROOKS = wp.constant(wp.types.matrix(shape=(4, 2), dtype=float)(-0.125, -0.375, 0.375, -0.125, -0.375, 0.125, 0.125, 0.375))
"""Where they pass (x, y) [px from the pixel's centre], by quarters: upper left, upper right, lower left, lower right. No two are in one
of four rows or columns, so that edges of any direction are seen."""
CORNERS = wp.constant(4)
"""Pixels whose centres are a square's corners: upper left, upper right, lower left, lower right."""
BITS = wp.constant(2)
"""Of a sample in `ShadedImage.mix`."""
LOWEST = wp.constant(wp.uint32(3))
"""The lowest BITS."""
CHUNK_TILES = wp.constant(32)
"""Tiles of squares whose edges have a counter of their own: threads that count up the same number stand in line."""
CREASE = wp.constant(1.5)
"""Slopes [m/m] of a body's surface before and behind a square that differ by more are an edge: by 2 do those of a box's edge that points
here."""
LEAST_BEND = wp.constant(0.1)
JUMP = wp.constant(8.0)
"""A surface that seems to bend by more than JUMP [m/m], but from one side of a square by less than LEAST_BEND, ends at that side.
This spares rays, and changes no picture."""
CONTRAST = wp.constant(0.08)
"""Colours of which no channel differs by more than this share are not mixed: half of it, which is lost at most, is four grey levels."""
DIM = wp.constant(0.1)
"""What is darker than this share of the brightest channel counts as so bright: who looks at a colour sees little of its dark channels."""
NEARNESS = wp.constant(0.1)
"""Being a pixel farther away counts against a corner like being so far off the sample's surface [widths of a pixel]."""


@wp.struct
class ShadedImage:
    """A picture before development."""

    radiance: wp.array3d[wp.vec3]
    """Linear, before exposure; of an anti-aliased picture's edges, what the middle of the pixel shows."""
    mix: wp.array3d[wp.uint32]
    """0: the pixel shows its own radiance. Else it shows the mean over its samples, of each of which BITS name the pixel whose radiance it
    takes, see `sample_source`."""


@wp.func
def sample_source(mix: wp.uint32, sample: int) -> wp.vec2i:
    """(rows, columns) from a pixel to that whose radiance its sample takes: one of the corners of the square in which it lies."""
    choice = int((mix >> wp.uint32(BITS * sample)) & LOWEST)
    return wp.vec2i((choice // 2) * (2 * (sample // 2) - 1), (choice % 2) * (2 * (sample % 2) - 1))


@wp.func
def pixel_radiance(image: ShadedImage, view: int, row: int, column: int) -> wp.vec3:
    """What a pixel shows."""
    mix = image.mix[view, row, column]
    if mix == wp.uint32(0):
        return image.radiance[view, row, column]
    total = wp.vec3(0.0, 0.0, 0.0)
    for sample in range(SAMPLES):
        step = sample_source(mix, sample)
        total += image.radiance[view, row + step[0], column + step[1]]
    return total / float(SAMPLES)


@wp.func
def bends(gbuffer: GBuffer, grid: ImageGrid, focal: float, view: int, row: int, column: int, down: int, right: int) -> bool:
    """Whether a body's surface bends or ends between a pixel and the next one `down` or `right`: 1/z of a plane is linear in the image,
    so each two pixels on one side tell what the next should be. At the picture's rim one side speaks for both."""
    middle = 1.0 / gbuffer.depth[view, row, column]
    next = 1.0 / gbuffer.depth[view, row + down, column + right]
    before = float(0.0)
    behind = float(0.0)
    starts = row >= down and column >= right
    ends = row + 2 * down < grid.height and column + 2 * right < grid.width
    if starts:
        before = wp.abs(1.0 / gbuffer.depth[view, row - down, column - right] + next - 2.0 * middle)
    if ends:
        behind = wp.abs(1.0 / gbuffer.depth[view, row + 2 * down, column + 2 * right] + middle - 2.0 * next)
    if not starts:
        before = behind
    elif not ends:
        behind = before
    bend = focal * (before + behind) / middle
    return bend > CREASE and (bend < JUMP or focal * wp.min(before, behind) > LEAST_BEND * middle)


@wp.func
def differs(radiance: wp.array3d[wp.vec3], view: int, top: int, left: int, bottom: int, right: int) -> bool:
    """Whether the colours of a square's corners differ so much that mixing them shows."""
    a = radiance[view, top, left]
    b = radiance[view, top, right]
    c = radiance[view, bottom, left]
    d = radiance[view, bottom, right]
    most = wp.max(wp.max(a, b), wp.max(c, d))
    apart = most - wp.min(wp.min(a, b), wp.min(c, d))
    dim = DIM * wp.max(most)
    for channel in range(3):
        if apart[channel] > CONTRAST * wp.max(most[channel], dim):
            return True
    return False


@wp.func
def is_edge(gbuffer: GBuffer, grid: ImageGrid, intrinsics: wp.vec4, view: int, top: int, left: int, bottom: int, right: int) -> bool:
    """Whether several bodies, or a body's surface that bends or ends, show in the square between these rows and columns."""
    segment = gbuffer.segment[view, top, left]
    if (
        gbuffer.segment[view, top, right] != segment
        or gbuffer.segment[view, bottom, left] != segment
        or gbuffer.segment[view, bottom, right] != segment
    ):
        return True
    if int(segment) == Segment.NOTHING or int(segment) == Segment.TABLE:
        return False
    if left < right:
        if bends(gbuffer, grid, intrinsics[0], view, top, left, 0, 1) or bends(gbuffer, grid, intrinsics[0], view, bottom, left, 0, 1):
            return True
    if top < bottom:
        return bends(gbuffer, grid, intrinsics[1], view, top, left, 1, 0) or bends(gbuffer, grid, intrinsics[1], view, top, right, 1, 0)
    return False


@wp.kernel
def find_edges_kernel(
    # Scene:
    cameras: Cameras,
    grid: ImageGrid,
    squares: ImageGrid,
    # In:
    gbuffer: GBuffer,
    radiance: wp.array3d[wp.vec3],
    views: Views,
    # Out:
    mix_out: wp.array3d[wp.uint32],
    edge_out: wp.array3d[int],
    edges_inout: wp.array2d[int],
):
    """List the squares with edges in each segment of each view, in any order: their number and, in `edge_out`, row times columns plus
    column. Mixes are cleared.

    The square (row, column) has the pixel of the same place in its lower right corner; at the picture's rim it has two or one.
    """
    view, row, column = tile_pixel(squares, wp.tid())
    if not in_image(squares, row, column):
        return
    if row < grid.height and column < grid.width:
        mix_out[view, row, column] = wp.uint32(0)
    top = wp.max(row - 1, 0)
    left = wp.max(column - 1, 0)
    bottom = wp.min(row, grid.height - 1)
    right = wp.min(column, grid.width - 1)
    if is_edge(gbuffer, grid, cameras.intrinsics[views.camera[view]], view, top, left, bottom, right):
        if differs(radiance, view, top, left, bottom, right):
            chunk = tile_of(squares, row, column) // CHUNK_TILES
            edge_out[view, chunk, wp.atomic_add(edges_inout, view, chunk, 1)] = row * squares.width + column


@wp.func
def corner_row(row: int, corner: int) -> int:
    """Row of a corner of a square in this row."""
    return row - 1 + corner // 2


@wp.func
def corner_column(column: int, corner: int) -> int:
    return column - 1 + corner % 2


@wp.func
def seen_bodies(gbuffer: GBuffer, grid: ImageGrid, view: int, row: int, column: int, instances: int) -> wp.uint64:
    """Bits of the bodies that a square's corners show."""
    seen = wp.uint64(0)
    for corner in range(CORNERS):
        r = corner_row(row, corner)
        c = corner_column(column, corner)
        if in_image(grid, r, c):
            segment = int(gbuffer.segment[view, r, c])
            if segment != Segment.NOTHING and segment != Segment.TABLE:
                seen = seen | (wp.uint64(1) << wp.uint64(body_of(segment, instances)))
    return seen


@wp.func
def shown_bodies_mask(bodies: ViewBodies, view: int, tile: int, seen: wp.uint64) -> wp.uint64:
    """The tile's candidates, without bodies that have no bit in `seen`."""
    body_mask = bodies.body_mask[view, tile]
    kept = wp.uint64(0)
    number = int(0)
    while (body_mask >> wp.uint64(number)) != wp.uint64(0):
        bit = wp.uint64(1) << wp.uint64(number)
        if (body_mask & bit) != wp.uint64(0):
            if ((seen >> wp.uint64(bodies.order[view, number])) & wp.uint64(1)) != wp.uint64(0):
                kept = kept | bit
        number += 1
    return kept


@wp.func
def like_corner(
    gbuffer: GBuffer, grid: ImageGrid, view: int, row: int, column: int, own: int, offset: wp.vec2, hit: Hit, plane: Plane
) -> int:
    """Which corner of a square shows best what a ray `offset` [px] off the centre of its corner `own` hit: the same body, near the tangent
    plane there, close by. `own`, if none shows that body. `plane` is the hit's, as that pixel sees it."""
    best = own
    least = float(wp.inf)
    for corner in range(CORNERS):
        r = corner_row(row, corner)
        c = corner_column(column, corner)
        if in_image(grid, r, c):
            if int(gbuffer.segment[view, r, c]) == hit.segment:
                down = corner // 2 - own // 2
                right = corner % 2 - own % 2
                apart = NEARNESS * wp.length(wp.vec2(float(right) - offset[0], float(down) - offset[1]))
                if hit.segment != Segment.NOTHING:
                    apart += plane_distance(plane, down, right, gbuffer.depth[view, r, c]) / plane.width
                if apart < least:
                    least = apart
                    best = corner
    return best


@wp.kernel(cuda_max_registers=RAY_REGISTERS)
def mix_edges_kernel(
    # Scene:
    meshes: Meshes,
    table: Table,
    cameras: Cameras,
    grid: ImageGrid,
    squares: ImageGrid,
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    edge: wp.array3d[int],
    edges: wp.array2d[int],
    views: Views,
    threads: int,
    # Out:
    mix_inout: wp.array3d[wp.uint32],
):
    """Which pixels' radiance the pixels about each square with edges show in it. The host knows no number of squares, so `threads`
    threads take the samples of a segment in turn; neighbouring threads take one square's, whose rays meet the same bodies."""
    thread = wp.tid()
    chunks = edges.shape[1]
    view = thread // (chunks * threads)
    chunk = (thread // threads) % chunks
    camera = views.camera[view]
    intrinsics = cameras.intrinsics[camera]
    for number in range(thread % threads, SAMPLES * edges[view, chunk], threads):
        place = edge[view, chunk, number // SAMPLES]
        row = place // squares.width
        column = place % squares.width
        own = number % SAMPLES
        # The square is in the lower right quarter of its upper left corner, and so on.
        sample = SAMPLES - 1 - own
        r = corner_row(row, own)
        c = corner_column(column, own)
        if in_image(grid, r, c):
            offset = wp.vec2(ROOKS[sample, 0], ROOKS[sample, 1])
            ray = camera_ray(intrinsics, r, c, offset)
            seen = seen_bodies(gbuffer, grid, view, row, column, views.instances)
            body_mask = shown_bodies_mask(bodies, view, tile_of(grid, r, c), seen)
            hit = trace_bodies(meshes, bodies, view, body_mask, ray, views.instances)
            hit = hit_table(table, cameras, camera, ray, hit)
            normal = wp.vec3(0.0, 0.0, 0.0)
            if hit.segment != Segment.NOTHING:
                normal = wp.transpose(cameras.to_world[camera]) * face_normal(meshes, bodies, view, hit, views.instances)
            plane = tangent_plane(intrinsics, r, c, wp.uint8(hit.segment), hit.depth, normal)
            plane.height = hit.depth * wp.dot(normal, ray)
            best = like_corner(gbuffer, grid, view, row, column, own, offset, hit, plane)
            wp.atomic_or(mix_inout, view, r, c, wp.uint32(best ^ own) << wp.uint32(BITS * sample))
