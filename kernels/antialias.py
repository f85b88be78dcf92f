"""Anti-aliasing of the fast picture's colour: pixels on edges, where surfaces meet, cast more rays.

A ray asks only which surface it meets. Its colour is that of the pixel next to it that shows this surface, so that it costs no light;
what textures show is filtered already.
"""

import warp as wp

from synpick_warp.kernels.camera_rays import Cameras, ImageGrid, camera_ray, tile_of, tile_pixel
from synpick_warp.kernels.hits import (
    NOTHING,
    RAY_REGISTERS,
    TABLE,
    Bodies,
    Hit,
    Hits,
    Meshes,
    Table,
    body_of,
    face_normal,
    hit_table,
    trace_candidates,
)
from synpick_warp.kernels.tangent import off_plane, pixel_plane

wp.set_module_options({"enable_backward": False})

SAMPLES = wp.constant(8)
"""Rays of a pixel on an edge."""
ROOKS = wp.constant(wp.types.matrix(shape=(8, 2), dtype=float)(
    0.0625, -0.1875, -0.0625, 0.1875, 0.3125, 0.0625, -0.1875, -0.3125,
    -0.3125, 0.3125, -0.4375, -0.0625, 0.1875, 0.4375, 0.4375, -0.4375,
))  # fmt: skip
"""Where they pass [px from the pixel's centre]: no two in one of eight rows or columns (Direct3D's standard pattern of eight)."""
BITS = wp.constant(4)
"""Of a sample in `Picture.mix`."""
LOWEST = wp.constant(wp.uint32(15))
"""The lowest BITS."""
AROUND = wp.constant(9)
"""Pixels of a square of 3 x 3."""
SEGMENT_TILES = wp.constant(32)
"""Tiles whose edges have a counter of their own: threads that count up the same number stand in line."""
CREASE = wp.constant(1.5)
"""Slopes [m/m] of a body's surface beside a pixel that differ by more are an edge: by 2 do those of a box's edge that points here."""
NEARNESS = wp.constant(0.1)
"""Being a pixel farther away counts against a neighbour like being so far off the sample's surface [widths of a pixel]."""


@wp.struct
class Picture:
    """A picture before development."""

    radiance: wp.array3d[wp.vec3]
    """Linear, before exposure; of an anti-aliased picture's edges, what the middle of the pixel shows."""
    mix: wp.array3d[wp.uint32]
    """0: the pixel shows its own radiance. Else it shows the mean over its samples, of each of which BITS name the pixel whose radiance it
    takes, see `neighbour`."""


@wp.func
def neighbour(number: int) -> wp.vec2i:
    """(rows, columns) from a pixel to one of the AROUND pixels about it; 0: itself."""
    place = (number + AROUND // 2) % AROUND
    return wp.vec2i(place // 3 - 1, place % 3 - 1)


@wp.func
def pixel_radiance(picture: Picture, view: int, row: int, column: int) -> wp.vec3:
    """What a pixel shows."""
    mix = picture.mix[view, row, column]
    if mix == wp.uint32(0):
        return picture.radiance[view, row, column]
    total = wp.vec3(0.0, 0.0, 0.0)
    for sample in range(SAMPLES):
        step = neighbour(int((mix >> wp.uint32(BITS * sample)) & LOWEST))
        total += picture.radiance[view, row + step[0], column + step[1]]
    return total / float(SAMPLES)


@wp.func
def bend(near: float, middle: float, far: float, focal: float) -> float:
    """By how much a surface's slope changes at a pixel, from planar depths there and beside it: 1/z of a plane is linear in the image."""
    return wp.abs(1.0 / near + 1.0 / far - 2.0 / middle) * middle * focal


@wp.func
def is_edge(hits: Hits, grid: ImageGrid, intrinsics: wp.vec4, view: int, row: int, column: int) -> bool:
    """Whether a pixel lies where two bodies meet, or a body's surface bends or ends."""
    code = hits.code[view, row, column]
    above = wp.max(row - 1, 0)
    below = wp.min(row + 1, grid.height - 1)
    left = wp.max(column - 1, 0)
    right = wp.min(column + 1, grid.width - 1)
    if hits.code[view, above, column] != code or hits.code[view, below, column] != code:
        return True
    if hits.code[view, row, left] != code or hits.code[view, row, right] != code:
        return True
    if int(code) == NOTHING or int(code) == TABLE:
        return False
    depth = hits.depth[view, row, column]
    if below - above == 2 and bend(hits.depth[view, above, column], depth, hits.depth[view, below, column], intrinsics[1]) > CREASE:
        return True
    return right - left == 2 and bend(hits.depth[view, row, left], depth, hits.depth[view, row, right], intrinsics[0]) > CREASE


@wp.kernel
def find_edges_kernel(
    # Scene:
    cameras: Cameras,
    grid: ImageGrid,
    # In:
    hits: Hits,
    view_camera: wp.array[int],
    # Out:
    mix_out: wp.array3d[wp.uint32],
    edge_out: wp.array3d[int],
    edges_inout: wp.array2d[int],
):
    """List the pixels on edges in each segment of each view, in any order: their number and, in `edge_out`, row times width plus column.
    Mixes are cleared."""
    pixel = tile_pixel(grid, wp.tid())
    view = pixel[0]
    row = pixel[1]
    column = pixel[2]
    if row >= grid.height or column >= grid.width:
        return
    mix_out[view, row, column] = wp.uint32(0)
    if is_edge(hits, grid, cameras.intrinsics[view_camera[view]], view, row, column):
        segment = tile_of(grid, row, column) // SEGMENT_TILES
        edge_out[view, segment, wp.atomic_add(edges_inout, view, segment, 1)] = row * grid.width + column


@wp.func
def seen_bodies(hits: Hits, grid: ImageGrid, view: int, row: int, column: int, instances: int) -> wp.uint64:
    """Bits of the bodies that the AROUND pixels about a pixel show."""
    seen = wp.uint64(0)
    for number in range(AROUND):
        step = neighbour(number)
        r = wp.clamp(row + step[0], 0, grid.height - 1)
        c = wp.clamp(column + step[1], 0, grid.width - 1)
        code = int(hits.code[view, r, c])
        if code != NOTHING and code != TABLE:
            seen = seen | (wp.uint64(1) << wp.uint64(body_of(code, instances)))
    return seen


@wp.func
def seen_candidates(bodies: Bodies, view: int, tile: int, seen: wp.uint64) -> wp.uint64:
    """The tile's candidates, without bodies that have no bit in `seen`."""
    candidates = bodies.candidates[view, tile]
    kept = wp.uint64(0)
    number = int(0)
    while (candidates >> wp.uint64(number)) != wp.uint64(0):
        bit = wp.uint64(1) << wp.uint64(number)
        if (candidates & bit) != wp.uint64(0):
            if ((seen >> wp.uint64(bodies.order[view, number])) & wp.uint64(1)) != wp.uint64(0):
                kept = kept | bit
        number += 1
    return kept


@wp.func
def like_pixel(
    hits: Hits, grid: ImageGrid, intrinsics: wp.vec4, view: int, row: int, column: int, offset: wp.vec2, hit: Hit, normal: wp.vec3
) -> int:
    """Number of the pixel about (row, column) that shows best what a ray `offset` [px] off its centre hit: the same body, near the tangent
    plane there, close by. The pixel itself, if none shows that body."""
    plane = pixel_plane(intrinsics, row, column, wp.uint8(hit.code), hit.depth, normal)
    plane.height = hit.depth * (plane.facing + offset[1] * plane.down + offset[0] * plane.right)
    best = int(0)
    least = float(1.0e30)
    for number in range(AROUND):
        step = neighbour(number)
        r = row + step[0]
        c = column + step[1]
        if r >= 0 and r < grid.height and c >= 0 and c < grid.width:
            if int(hits.code[view, r, c]) == hit.code:
                apart = NEARNESS * wp.length(wp.vec2(float(step[1]) - offset[0], float(step[0]) - offset[1]))
                if hit.code != NOTHING:
                    apart += off_plane(plane, step[0], step[1], hits.depth[view, r, c]) / plane.width
                if apart < least:
                    least = apart
                    best = number
    return best


@wp.kernel(cuda_max_registers=RAY_REGISTERS)
def mix_edges_kernel(
    # Scene:
    meshes: Meshes,
    table: Table,
    cameras: Cameras,
    grid: ImageGrid,
    # In:
    bodies: Bodies,
    hits: Hits,
    edge: wp.array3d[int],
    edges: wp.array2d[int],
    view_camera: wp.array[int],
    instances: int,
    threads: int,
    first: int,
    # Out:
    mix_inout: wp.array3d[wp.uint32],
):
    """Which pixels' radiance each pixel on an edge shows. The host knows no number of edges, so `threads` threads take the samples of a
    segment in turn; neighbouring threads take one pixel's, whose rays meet the same bodies."""
    thread = wp.tid() + first
    segments = edges.shape[1]
    view = thread // (segments * threads)
    segment = (thread // threads) % segments
    camera = view_camera[view]
    intrinsics = cameras.intrinsics[camera]
    for number in range(thread % threads, SAMPLES * edges[view, segment], threads):
        place = edge[view, segment, number // SAMPLES]
        sample = number % SAMPLES
        row = place // grid.width
        column = place % grid.width
        offset = wp.vec2(ROOKS[sample, 0], ROOKS[sample, 1])
        ray = camera_ray(intrinsics, row, column, offset)
        seen = seen_bodies(hits, grid, view, row, column, instances)
        candidates = seen_candidates(bodies, view, tile_of(grid, row, column), seen)
        hit = trace_candidates(meshes, bodies, view, candidates, ray, instances, False)
        hit = hit_table(table, cameras, camera, ray, hit)
        normal = wp.vec3(0.0, 0.0, 0.0)
        if hit.code != NOTHING:
            normal = wp.transpose(cameras.to_world[camera]) * face_normal(meshes, bodies, view, hit, instances)
        best = like_pixel(hits, grid, intrinsics, view, row, column, offset, hit, normal)
        wp.atomic_or(mix_inout, view, row, column, wp.uint32(best) << wp.uint32(BITS * sample))
