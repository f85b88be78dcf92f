"""What the rays through the pixels' centres meet: all triangles leave marks at the rays that they meet, and the nearest mark is the hit."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.visibility.camera import Cameras, ImageGrid, Views, camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import (
    FAR,
    MAX_COUNTS,
    GBuffer,
    Hit,
    Meshes,
    Table,
    ViewBodies,
    hit_table,
    read_hit,
    segment_of,
    store_hit,
)
from synpick_warp.kernels.render.visibility.triangles import Footprint, Triangle, camera_triangle, find_footprint, ray_weights, row_span

wp.set_module_options({"enable_backward": False})

EMPTY = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))
"""Mark of a ray that meets no triangle."""
DEPTH_BITS = wp.constant(wp.uint64(32))
TRIANGLE_BITS = wp.constant(wp.uint32(26))
"""A mark is a ray's planar depth, the row in `ViewBodies` and the triangle's number: the least is the nearest hit."""
MAX_TRIANGLES = 1 << int(TRIANGLE_BITS)
"""Most triangles of a mesh."""
SMALL = wp.constant(256)
"""Triangles whose box has no more pixels than these are done at once, others block by block: neighbours differ little in size."""
BLOCK_ROWS = wp.constant(32)
BLOCK_COLUMNS = wp.constant(256)
"""Size of such a block [px]; each row is a thread's."""


@wp.struct
class VisibilityBuffer:
    """Scratch, a row a view."""

    nearest: wp.array3d[wp.uint64]
    """Mark of the nearest hit of each pixel's ray."""
    block: wp.array2d[wp.vec4i]
    """Blocks of large triangles: number of the body in `ViewBodies.order`, triangle, first row, first column."""
    blocks: wp.array[int]
    """How many these would be; those that there is no room for are done at once."""


@wp.func
def write_sample(
    visibility: VisibilityBuffer,
    amodal: wp.array3d[wp.uint32],
    view: int,
    row: int,
    column: int,
    triangle: Triangle,
    ray: wp.vec3,
    name: wp.uint64,
    bit: wp.uint32,
):
    """Leave a triangle's mark, and its instance's bit, where it meets a pixel's ray. Neither depends on the order of threads."""
    weights = ray_weights(triangle, ray)
    if weights[0] >= 0.0:
        depth = triangle.near + wp.dot(weights, wp.vec3(triangle.a[2], triangle.b[2], triangle.c[2]))
        if depth > 0.0:
            mark = (wp.uint64(wp.cast(depth, wp.uint32)) << DEPTH_BITS) | name
            # To look first whether that changes anything costs more: a thread waits for what it reads, but not for what it merges.
            wp.atomic_min(visibility.nearest, view, row, column, mark)
            if bit != wp.uint32(0):
                wp.atomic_or(amodal, view, row, column, bit)


@wp.func
def sample_id(body: int, triangle: int) -> wp.uint64:
    return wp.uint64((wp.uint32(body) << TRIANGLE_BITS) | wp.uint32(triangle))


@wp.func
def amodal_bit(body: int, instances: int) -> wp.uint32:
    """An instance's bit; fixtures have none."""
    if body < instances:
        return wp.uint32(1) << wp.uint32(body)
    return wp.uint32(0)


@wp.func
def rasterize_footprint(
    visibility: VisibilityBuffer,
    amodal: wp.array3d[wp.uint32],
    intrinsics: wp.vec4,
    view: int,
    pixels: wp.vec4i,
    triangle: Triangle,
    footprint: Footprint,
    name: wp.uint64,
    bit: wp.uint32,
):
    """`write_sample` for the pixels of a footprint within a range. One loop for rows and columns: neighbouring threads, whose triangles
    have other rows but about as many pixels, stay together."""
    row = pixels[1] - 1
    column = int(0)
    last = int(-1)
    while True:
        while column > last and row < pixels[3]:
            row += 1
            span = row_span(footprint, row, pixels[0], pixels[2])
            column = span[0]
            last = span[1]
        if column > last:
            break
        ray = camera_ray(intrinsics, row, column, wp.vec2(0.0, 0.0))
        write_sample(visibility, amodal, view, row, column, triangle, ray, name, bit)
        column += 1


@wp.func
def list_blocks(visibility: VisibilityBuffer, view: int, number: int, triangle: int, pixels: wp.vec4i) -> bool:
    """List the blocks of a triangle's pixels; False: there is no room for all of them."""
    across = (pixels[2] - pixels[0]) // BLOCK_COLUMNS + 1
    blocks = across * ((pixels[3] - pixels[1]) // BLOCK_ROWS + 1)
    place = wp.atomic_add(visibility.blocks, view, blocks)
    room = wp.min(visibility.block.shape[1] - place, blocks)
    for i in range(room):
        row = pixels[1] + i // across * BLOCK_ROWS
        visibility.block[view, place + i] = wp.vec4i(number, triangle, row, pixels[0] + i % across * BLOCK_COLUMNS)
    return room == blocks


@wp.kernel
def clear_visibility_kernel(
    # Scene:
    grid: ImageGrid,
    # In:
    first: int,
    # Out:
    visibility_out: VisibilityBuffer,
    amodal_out: wp.array3d[wp.uint32],
):
    """No marks, no bits, no blocks."""
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    visibility_out.nearest[view, row, column] = EMPTY
    amodal_out[view, row, column] = wp.uint32(0)
    if row == 0 and column == 0:
        visibility_out.blocks[view] = 0


@wp.kernel
def rasterize_triangles_kernel(
    # Scene:
    meshes: Meshes,
    cameras: Cameras,
    grid: ImageGrid,
    # In:
    bodies: ViewBodies,
    views: Views,
    threads: int,
    first: int,
    # Out:
    visibility_inout: VisibilityBuffer,
    amodal_inout: wp.array3d[wp.uint32],
):
    """Small triangles leave their marks, large ones list their blocks. The triangles of each body of a view, in the bodies' order, go
    round among `threads` threads; a tote that stands as in the backdrop is left out."""
    index = wp.tid() + first
    slots = bodies.mesh.shape[1]
    number = (index // threads) % slots
    view = index // (threads * slots)
    if number >= bodies.present[view]:
        return
    body = bodies.order[view, number]
    if body == views.instances and bodies.uses_background[view] != 0:
        return
    box = bodies.box[view, body]
    if box[2] < 0 or box[3] < 0 or box[0] >= grid.width or box[1] >= grid.height:
        return
    intrinsics = cameras.intrinsics[views.camera[view]]
    mesh = bodies.mesh[view, body]
    bit = amodal_bit(body, views.instances)
    for k in range(index % threads, meshes.first_triangle[mesh + 1] - meshes.first_triangle[mesh], threads):
        triangle = camera_triangle(meshes, bodies, view, body, k)
        footprint = find_footprint(grid, intrinsics, triangle)
        found = footprint.pixels
        columns = found[2] - found[0] + 1
        rows = found[3] - found[1] + 1
        if columns > 0 and rows > 0:
            listed = False
            if columns * rows > SMALL:
                listed = list_blocks(visibility_inout, view, number, k, found)
            if not listed:
                rasterize_footprint(visibility_inout, amodal_inout, intrinsics, view, found, triangle, footprint, sample_id(body, k), bit)


@wp.kernel
def rasterize_blocks_kernel(
    # Scene:
    meshes: Meshes,
    cameras: Cameras,
    grid: ImageGrid,
    # In:
    bodies: ViewBodies,
    views: Views,
    threads: int,
    first: int,
    # Out:
    visibility_inout: VisibilityBuffer,
    amodal_inout: wp.array3d[wp.uint32],
):
    """Large triangles leave their marks in their blocks. The host knows no number of blocks, so `threads` threads a view take rows of them
    in turn."""
    index = wp.tid() + first
    view = index // threads
    intrinsics = cameras.intrinsics[views.camera[view]]
    blocks = wp.min(visibility_inout.blocks[view], visibility_inout.block.shape[1])
    for i in range(index % threads, BLOCK_ROWS * blocks, threads):
        block = visibility_inout.block[view, i // BLOCK_ROWS]
        row = block[2] + i % BLOCK_ROWS
        body = bodies.order[view, block[0]]
        triangle = camera_triangle(meshes, bodies, view, body, block[1])
        footprint = find_footprint(grid, intrinsics, triangle)
        if row <= footprint.pixels[3]:
            pixels = wp.vec4i(block[3], row, wp.min(block[3] + BLOCK_COLUMNS - 1, footprint.pixels[2]), row)
            name = sample_id(body, block[1])
            bit = amodal_bit(body, views.instances)
            rasterize_footprint(visibility_inout, amodal_inout, intrinsics, view, pixels, triangle, footprint, name, bit)


@wp.func
def resolve_hit(meshes: Meshes, bodies: ViewBodies, view: int, instances: int, mark: wp.uint64, ray: wp.vec3) -> Hit:
    """The hit that left a mark, whose lower half is a name."""
    name = wp.uint32(mark)
    body = int(name >> TRIANGLE_BITS)
    hit = Hit()
    hit.segment = segment_of(body, instances)
    hit.triangle = int(name & ((wp.uint32(1) << TRIANGLE_BITS) - wp.uint32(1)))
    hit.depth = wp.cast(wp.uint32(mark >> DEPTH_BITS), float)
    weights = ray_weights(camera_triangle(meshes, bodies, view, body, hit.triangle), ray)
    hit.barycentric = wp.vec2(weights[0], weights[1])
    return hit


@wp.kernel
def resolve_visibility_kernel(
    # Scene:
    meshes: Meshes,
    table: Table,
    cameras: Cameras,
    grid: ImageGrid,
    background: GBuffer,
    # In:
    bodies: ViewBodies,
    visibility: VisibilityBuffer,
    views: Views,
    counts_per_meter: float,
    first: int,
    # Out:
    gbuffer_out: GBuffer,
    instance_out: wp.array3d[wp.uint8],
    depth_out: wp.array3d[wp.uint16],
):
    """The nearest hit of each pixel: that of its mark, or what the backdrop, a row a camera, shows if that is nearer.

    Depth is planar, in counts rounded to nearest, 0 where nothing is hit or the count does not fit.
    """
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    camera = views.camera[view]
    ray = camera_ray(cameras.intrinsics[camera], row, column, wp.vec2(0.0, 0.0))
    hit = Hit()
    hit.segment = Segment.NOTHING
    hit.depth = FAR
    mark = visibility.nearest[view, row, column]
    if mark != EMPTY:
        hit = resolve_hit(meshes, bodies, view, views.instances, mark, ray)
    if bodies.uses_background[view] != 0:
        behind = read_hit(background, camera, row, column)
        if behind.segment != Segment.NOTHING and behind.depth < hit.depth:
            hit = behind
    else:
        hit = hit_table(table, cameras, camera, ray, hit)
    store_hit(gbuffer_out, view, row, column, hit)
    instance_out[view, row, column] = wp.uint8(hit.segment)
    counts = wp.rint(hit.depth * counts_per_meter)
    if counts > MAX_COUNTS:
        counts = 0.0
    depth_out[view, row, column] = wp.uint16(counts)
