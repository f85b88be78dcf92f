"""Triangle rasterizer: a 64-bit visibility buffer (depth, body, triangle) by atomic min, with watertight ray tests at pixel centres.

Passes: clear, rasterize triangles, rasterize blocks of large triangles, resolve to the G-buffer. The result equals that of tracing each
pixel's ray (`bvh_rays`), and does not depend on the order of threads. The tote and the table, where they always stand, come from a cached
static background that is rendered once. Where nothing moved, the keys of the previous frame stay: only damaged tiles are cleared, and of
bodies at rest only the triangles in them are drawn again, which elsewhere change no minimum.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.visibility.bvh_rays import hit_table
from synpick_warp.kernels.render.visibility.camera import (
    TILE_WIDTH,
    AnyCameras,
    AnyViews,
    ImageGrid,
    camera_ray,
    in_image,
    loop_ray,
    tile_pixel,
)
from synpick_warp.kernels.render.visibility.damage import Damage, any_flagged, is_damaged
from synpick_warp.kernels.render.visibility.gbuffer import (
    FAR,
    MAX_COUNTS,
    GBuffer,
    Hit,
    Meshes,
    Table,
    ViewBodies,
    read_hit,
    segment_of,
    store_hit,
)
from synpick_warp.kernels.render.visibility.masks import InstanceMasks, KeptMasks, Mask, add_pixel, drawn_mask, is_kept
from synpick_warp.kernels.render.visibility.triangles import Footprint, Triangle, camera_triangle, find_footprint, ray_weights, row_span
from synpick_warp.kernels.render.visibility.variants import kernel_of_views

wp.set_module_options({"enable_backward": False})

EMPTY = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))
"""Cleared value of the visibility buffer: no triangle."""
DEPTH_BITS = wp.constant(wp.uint64(32))
"""Position of the depth in a visibility key: the upper half, so that the minimum is the nearest sample."""
TRIANGLE_BITS = wp.constant(wp.uint32(24))
"""Position of the row of `ViewBodies` in the lower half, above the triangle index: it breaks ties of depth. A row takes 8 bits: instances
and fixtures have an id each."""
MAX_TRIANGLES = 1 << int(TRIANGLE_BITS)
"""Maximum number of triangles of a mesh."""
SMALL_PIXELS = wp.constant(256)
"""Largest screen box [px] of a triangle in one thread; larger ones are split into blocks, since a warp waits for its largest."""
BLOCK_ROWS = wp.constant(32)
BLOCK_COLUMNS = wp.constant(256)
"""Size of a block [px]; each of its rows is one work item."""


@wp.struct
class VisibilityBuffer:
    """Visibility key of the nearest triangle of each pixel, and the work list of blocks of large triangles."""

    nearest: wp.array3d[wp.uint64]
    """(kept, row, column): key of the nearest triangle: depth's float32 bits, body, triangle; `kept` is the view's `Damage.kept_row`."""
    block: wp.array2d[wp.vec4i]
    """(view, block): rank of the body in `ViewBodies.order`, triangle, first row, first column."""
    blocks: wp.array[int]
    """(view): number of blocks requested; may exceed the capacity, the triangles without space are rasterized at once."""


@wp.func
def write_sample(
    visibility: VisibilityBuffer,
    masks: InstanceMasks,
    view: int,
    kept: int,
    row: int,
    column: int,
    triangle: Triangle,
    ray: wp.vec3,
    low_half: wp.uint64,
    mask: Mask,
):
    """Depth test by atomic min where a pixel's ray hits a triangle, and atomic or of the pixel's bit in the instance's amodal mask. `kept`
    is the view's row of the visibility buffer, `low_half` the lower half of the key."""
    weights = ray_weights(triangle, ray)
    if weights[0] >= 0.0:
        depth = triangle.near + wp.dot(weights, wp.vec3(triangle.a[2], triangle.b[2], triangle.c[2]))
        if depth > 0.0:
            key = (wp.uint64(wp.cast(depth, wp.uint32)) << DEPTH_BITS) | low_half
            # Reading first, to skip atomics that change nothing, costs more: a thread waits for reads, but not for atomics without result.
            wp.atomic_min(visibility.nearest, kept, row, column, key)
            add_pixel(masks, view, mask, row, column)


@wp.func
def pack_low_half(body: int, triangle: int) -> wp.uint64:
    """Lower half of a visibility key: body and triangle."""
    return wp.uint64((wp.uint32(body) << TRIANGLE_BITS) | wp.uint32(triangle))


@wp.func
def rasterize_footprint(
    visibility: VisibilityBuffer,
    masks: InstanceMasks,
    cameras: AnyCameras,
    view: int,
    kept: int,
    triangle: Triangle,
    footprint: Footprint,
    low_half: wp.uint64,
    mask: Mask,
):
    """Scanline loop: `write_sample` for the pixels of a footprint within its box. Rows and columns share one loop, so that the threads of a
    warp stay together: their triangles differ in rows more than in pixels."""
    intrinsics = cameras.intrinsics[view]
    row = footprint.pixels[1] - 1
    column = int(0)
    last = int(-1)
    while True:
        while column > last and row < footprint.pixels[3]:
            row += 1
            span = row_span(footprint, row)
            column = span[0]
            last = span[1]
        if column > last:
            break
        ray = loop_ray(cameras, intrinsics, view, row, column, wp.vec2(0.0, 0.0))
        write_sample(visibility, masks, view, kept, row, column, triangle, ray, low_half, mask)
        column += 1


@wp.func
def list_blocks(visibility: VisibilityBuffer, view: int, rank: int, triangle: int, pixels: wp.vec4i) -> bool:
    """Append the blocks of a triangle's box to the work list; False: the capacity does not suffice for all of them."""
    across = (pixels[2] - pixels[0]) // BLOCK_COLUMNS + 1
    blocks = across * ((pixels[3] - pixels[1]) // BLOCK_ROWS + 1)
    place = wp.atomic_add(visibility.blocks, view, blocks)
    free = wp.min(visibility.block.shape[1] - place, blocks)
    for i in range(free):
        row = pixels[1] + i // across * BLOCK_ROWS
        visibility.block[view, place + i] = wp.vec4i(rank, triangle, row, pixels[0] + i % across * BLOCK_COLUMNS)
    return free == blocks


@kernel_of_views
def clear_visibility_kernel(grid: ImageGrid, damage: Damage, views: AnyViews, first: int, visibility_out: VisibilityBuffer):
    """Reset the visibility keys of damaged tiles, and empty the work list; nothing is written for unused views (camera -1). Launched over
    view, row of a tile (tile order, from flat index `first` on): with a thread a pixel, launching them would take most time."""
    view, row, column = tile_pixel(grid, (wp.tid() + first) * TILE_WIDTH)
    if not in_image(grid, row, column) or views.camera[view] < 0:
        return
    if is_damaged(damage, grid, view, row, column):
        for right in range(column, wp.min(column + TILE_WIDTH, grid.width)):
            visibility_out.nearest[damage.kept_row[view], row, right] = EMPTY
    if row == 0 and column == 0:
        visibility_out.blocks[view] = 0


@kernel_of_views
def rasterize_triangles_kernel(
    meshes: Meshes,
    grid: ImageGrid,
    bodies: ViewBodies,
    views: AnyViews,
    damage: Damage,
    kept_masks: KeptMasks,
    threads: int,
    first: int,
    visibility_inout: VisibilityBuffer,
    masks_inout: InstanceMasks,
):
    """Rasterize small triangles into visibility buffer and amodal masks, and list the blocks of large triangles.

    A tote whose pose is that of the static background is skipped, and so are bodies whose masks are kept where no tile is damaged. Launched
    over view, rank, thread (flat, from `first` on): the `threads` threads of a body stride over its triangles.
    """
    index = wp.tid() + first
    slots = bodies.mesh.shape[1]
    rank = (index // threads) % slots
    view = index // (threads * slots)
    if rank >= bodies.present[view]:
        return
    body, kept = bodies.order[view, rank], damage.kept_row[view]
    if body == views.instances and bodies.uses_background[view] != 0:
        return
    rests = is_kept(damage, kept_masks, view, body)
    if rests and damage.touched[view, body] == wp.uint8(0):
        return
    box = bodies.box[view, body]
    if box[2] < 0 or box[3] < 0 or box[0] >= grid.width or box[1] >= grid.height:
        return
    intrinsics = views.cameras.intrinsics[view]
    mesh = bodies.mesh[view, body]
    mask = drawn_mask(masks_inout, view, body, rests)
    for k in range(index % threads, meshes.first_triangle[mesh + 1] - meshes.first_triangle[mesh], threads):
        triangle = camera_triangle(meshes, bodies, view, body, k)
        footprint = find_footprint(grid, views.cameras, intrinsics, view, triangle)
        pixels = footprint.pixels
        columns = pixels[2] - pixels[0] + 1
        rows = pixels[3] - pixels[1] + 1
        if columns > 0 and rows > 0 and (not rests or any_flagged(damage.dirty, grid, view, pixels[1], pixels[0], pixels[3], pixels[2])):
            listed = False
            if columns * rows > SMALL_PIXELS:
                listed = list_blocks(visibility_inout, view, rank, k, pixels)
            if not listed:
                low_half = pack_low_half(body, k)
                rasterize_footprint(visibility_inout, masks_inout, views.cameras, view, kept, triangle, footprint, low_half, mask)


@kernel_of_views
def rasterize_blocks_kernel(
    meshes: Meshes,
    grid: ImageGrid,
    bodies: ViewBodies,
    views: AnyViews,
    damage: Damage,
    kept_masks: KeptMasks,
    threads: int,
    first: int,
    visibility_inout: VisibilityBuffer,
    masks_inout: InstanceMasks,
):
    """Rasterize the listed blocks of large triangles into visibility buffer and amodal masks. Launched over view, thread (flat, from
    `first` on): the `threads` threads of a view stride over the rows of its blocks, whose number the host does not know."""
    index = wp.tid() + first
    view = index // threads
    camera = views.camera[view]
    if camera < 0:
        return
    intrinsics, kept = views.cameras.intrinsics[view], damage.kept_row[view]
    blocks = wp.min(visibility_inout.blocks[view], visibility_inout.block.shape[1])
    for i in range(index % threads, BLOCK_ROWS * blocks, threads):
        block = visibility_inout.block[view, i // BLOCK_ROWS]
        row = block[2] + i % BLOCK_ROWS
        body = bodies.order[view, block[0]]
        triangle = camera_triangle(meshes, bodies, view, body, block[1])
        footprint = find_footprint(grid, views.cameras, intrinsics, view, triangle)
        last_row, right = footprint.pixels[3], wp.min(block[3] + BLOCK_COLUMNS - 1, footprint.pixels[2])
        rests = is_kept(damage, kept_masks, view, body)
        if row <= last_row and (not rests or any_flagged(damage.dirty, grid, view, row, block[3], row, right)):
            footprint.pixels = wp.vec4i(block[3], row, right, row)
            low_half = pack_low_half(body, block[1])
            mask = drawn_mask(masks_inout, view, body, rests)
            rasterize_footprint(visibility_inout, masks_inout, views.cameras, view, kept, triangle, footprint, low_half, mask)


@wp.func
def resolve_hit(meshes: Meshes, bodies: ViewBodies, view: int, instances: int, key: wp.uint64, ray: wp.vec3) -> Hit:
    """Hit of a visibility key: unpack segment, triangle and depth, and intersect the triangle again for barycentric weights."""
    low_half = wp.uint32(key)
    body = int(low_half >> TRIANGLE_BITS)
    hit = Hit()
    hit.segment = segment_of(body, instances)
    hit.triangle = int(low_half & ((wp.uint32(1) << TRIANGLE_BITS) - wp.uint32(1)))
    hit.depth = wp.cast(wp.uint32(key >> DEPTH_BITS), float)
    weights = ray_weights(camera_triangle(meshes, bodies, view, body, hit.triangle), ray)
    hit.barycentric = wp.vec2(weights[0], weights[1])
    return hit


@kernel_of_views
def resolve_visibility_kernel(
    # Scene:
    meshes: Meshes,
    table: Table,
    grid: ImageGrid,
    background: GBuffer,
    # In:
    bodies: ViewBodies,
    visibility: VisibilityBuffer,
    damage: Damage,
    views: AnyViews,
    counts_per_meter: float,
    first: int,
    # Out:
    gbuffer_out: GBuffer,
    instance_out: wp.array3d[wp.uint8],  # (view, row, column)
    depth_out: wp.array3d[wp.uint16],  # (view, row, column) [counts]
):
    """Resolve the visibility buffer: G-buffer, segmentation ids, and planar depth rounded to counts (0: no surface, or above 65,535).

    The nearest triangle competes with the cached static background, one G-buffer a camera (view: camera), or with the table where the tote
    has another pose. Null images are not written; unused views (camera -1) keep their content. Launched over view, pixel (tile order, from
    flat index `first` on).
    """
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    camera = views.camera[view]
    if camera < 0:
        return
    ray = camera_ray(views.cameras, view, row, column, wp.vec2(0.0, 0.0))
    hit = Hit()
    hit.segment = Segment.NOTHING
    hit.depth = FAR
    key = visibility.nearest[damage.kept_row[view], row, column]
    if key != EMPTY:
        hit = resolve_hit(meshes, bodies, view, views.instances, key, ray)
    if bodies.uses_background[view] != 0:
        static_hit = read_hit(background, views.slot[view], row, column)
        if static_hit.segment != Segment.NOTHING and static_hit.depth < hit.depth:
            hit = static_hit
    else:
        hit = hit_table(table, views.cameras, view, ray, hit)
    store_hit(gbuffer_out, view, row, column, hit)
    if instance_out:
        instance_out[view, row, column] = wp.uint8(hit.segment)
    if depth_out:
        counts = wp.rint(hit.depth * counts_per_meter)
        if counts > MAX_COUNTS:
            counts = 0.0
        depth_out[view, row, column] = wp.uint16(counts)
