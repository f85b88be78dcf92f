"""Steep edges of lamp shadows: shadow rays from each pixel at them (adaptive sampling), to the lamps whose shadows are steep there.

Four passes, so that warps are full of pixels with the same work: list the pixels of the shadow grid near edges, list the pixels of the
image in them, trace their rays, and filter what these found.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.coarse_grid import CoarseGrid
from synpick_warp.kernels.render.lighting.environment import Lights, lamp_direction, unit_heading
from synpick_warp.kernels.render.lighting.moving_bodies import MovingBodies
from synpick_warp.kernels.render.lighting.paths.tracing import PathScene
from synpick_warp.kernels.render.lighting.plane_distance import Plane, tangent_plane
from synpick_warp.kernels.render.lighting.shadow_filter import STEEPNESS_BITS, STEEPNESS_LEVELS, LampShadows
from synpick_warp.kernels.render.lighting.shadow_upsampling import all_steepness, filter_edge, find_shadow_taps, pack_fractions
from synpick_warp.kernels.render.lighting.shadows import is_shadowed, may_change, point_direction, visible_normal
from synpick_warp.kernels.render.lighting.tile_flags import RELIT, TileFlags, needs
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS, AnyViews, camera_ray, hit_position, in_image, tile_of, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import EDGE_PASS, SHADE_PASS, AnyShot, Meshes, ShadedImage, read_hit
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.tuning import RAY_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})

CHUNK_TILES = wp.constant(32)
"""Maximum number of tiles of the shadow grid that share lists and their counters, as of anti-aliasing's footprints."""
MAX_CHUNK_PIXELS = 1 << 16
"""Maximum number of the image's pixels in a chunk: entries of `EdgeLists.pixel` have 16 bits."""
CELLS, PIXELS = wp.constant(0), wp.constant(1)
"""Counters of `EdgeLists`."""


@wp.struct
class EdgeLists:
    """Work lists of the shadow grid's pixels near shadow edges and of the image's pixels that trace rays, with their lengths. Scratch.

    A chunk is a run of tiles of the shadow grid with lists of its own, which hold all of its pixels.
    """

    cell: wp.array3d[int]
    """(view, edge_chunk, chunk_cell): row * columns + column of pixels of the shadow grid, in whose squares all pixels are examined."""
    pixel: wp.array3d[wp.uint16]
    """(view, edge_chunk, chunk_pixel): pixels of the image that trace rays, as `listed_pixel` reads them."""
    count: wp.array3d[int]
    """(view, edge_chunk, edge_counter): lengths of both lists, at CELLS and PIXELS."""


@wp.func
def list_place(lists: EdgeLists, thread: int, threads: int) -> tuple[int, int, int]:
    """View, chunk and first list entry of a thread, of the `threads` threads that share the list of a chunk."""
    # Unsigned: cheaper to divide.
    place = wp.uint32(thread) // wp.uint32(threads)
    chunks = wp.uint32(lists.count.shape[1])
    return int(place // chunks), int(place % chunks), int(wp.uint32(thread) % wp.uint32(threads))


@wp.func
def listed_pixel(coarse: CoarseGrid, cell: wp.array3d[int], view: int, chunk: int, index: int) -> tuple[int, int]:
    """(row, column) of a pixel of the image, `index` in the squares of the pixels of the shadow grid that `cell` lists."""
    # Unsigned: cheaper to divide.
    square = wp.uint32(coarse.size * coarse.size)
    flat = wp.uint32(cell[view, chunk, int(wp.uint32(index) // square)])
    offset = wp.uint32(index) % square
    top, left = flat // wp.uint32(coarse.grid.width), flat % wp.uint32(coarse.grid.width)
    down, right = offset // wp.uint32(coarse.size), offset % wp.uint32(coarse.size)
    return int(top) * coarse.size + int(down), int(left) * coarse.size + int(right)


@kernel_of_views
def list_edge_cells_kernel(coarse: CoarseGrid, views: AnyViews, first: int, shadows_inout: LampShadows, lists_inout: EdgeLists):
    """Stream compaction: `cell` receives the pixels of the shadow grid that `near_edge` marks, in any order; the marks are cleared.

    `count`, 0 before, receives the number at CELLS. Launched over view, pixel of the shadow grid (tile order, from flat index `first` on).
    """
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if view < views.count and in_image(coarse.grid, row, column):
        if shadows_inout.near_edge[view, row, column] != wp.uint8(0):
            shadows_inout.near_edge[view, row, column] = wp.uint8(0)
            chunk = tile_of(coarse.grid, row, column) // (lists_inout.cell.shape[2] // TILE_PIXELS)
            rank = wp.atomic_add(lists_inout.count, view, chunk, CELLS, 1)
            lists_inout.cell[view, chunk, rank] = row * coarse.grid.width + column


@wp.func
def pixel_plane(meshes: Meshes, shot: AnyShot, view: int, row: int, column: int) -> Plane:
    """Tangent plane at a pixel that shows a surface."""
    gbuffer, cameras = shot.gbuffer, shot.views.cameras
    outward = cameras.to_world[view] * camera_ray(cameras, view, row, column, wp.vec2(0.0, 0.0))
    local = wp.transpose(cameras.to_world[view]) * visible_normal(meshes, shot, view, read_hit(gbuffer, view, row, column), outward)
    segment, depth = gbuffer.segment[view, row, column], gbuffer.depth[view, row, column]
    return tangent_plane(cameras, cameras.intrinsics[view], view, row, column, segment, depth, local)


@wp.func
def edges_may_change(
    lights: Lights, coarse: CoarseGrid, shot: AnyShot, moving: MovingBodies, steep: wp.uint32, view: int, row: int, column: int
) -> bool:
    """Whether a moving body may change a ray of a pixel to the lamps whose steepness, packed in `steep`, is above 0."""
    if moving.count[view] == 0:
        return False
    cameras, world = shot.views.cameras, shot.views.world[view]
    which, heading = shot.snapshot.light[world], unit_heading(shot.snapshot.light_yaw[world])
    ray = camera_ray(cameras, view, row, column, wp.vec2(0.0, 0.0))
    position = hit_position(cameras, view, ray, shot.gbuffer.depth[view, row, column])
    for lamp in range(lights.lamps[which]):
        if (steep >> wp.uint32(STEEPNESS_BITS * lamp)) & wp.uint32(STEEPNESS_LEVELS) != wp.uint32(0):
            for number in range(coarse.rays):
                direction = point_direction(lights, which, heading, lamp, coarse.rays, number, row, column)
                if may_change(moving, view, position, direction):
                    return True
    return False


@kernel_of_views
def list_edge_pixels_kernel(
    meshes: Meshes,
    coarse: CoarseGrid,
    lights: Lights,
    shot: AnyShot,
    moving: MovingBodies,
    threads: int,
    first: int,
    shadows_inout: LampShadows,
    lists_inout: EdgeLists,
    flags_inout: TileFlags,
):
    """Stream compaction: `pixel` receives the pixels at which a lamp's shadow is steep, in any order; `count` their number at PIXELS.

    The steepness at these pixels is written to `edge`, which must be 0. Their tile becomes dirty if a moving body may change their rays.
    Launched over view, chunk, thread (flat, from `first` on): the host
    does not read the counts, so a fixed number of `threads` strides over the listed pixels of the shadow grid of each chunk.
    """
    view, chunk, start = list_place(lists_inout, wp.tid() + first, threads)
    if view >= shot.views.count:
        return
    square = coarse.size * coarse.size
    for index in range(start, square * lists_inout.count[view, chunk, CELLS], threads):
        row, column = listed_pixel(coarse, lists_inout.cell, view, chunk, index)
        if in_image(coarse.image, row, column):
            if int(shot.gbuffer.segment[view, row, column]) != Segment.NOTHING:
                plane = pixel_plane(meshes, shot, view, row, column)
                steepness = all_steepness(find_shadow_taps(shadows_inout, coarse, view, row, column, plane))
                if steepness != wp.uint32(0):
                    shadows_inout.edge[view, row, column] = steepness
                    tile = tile_of(shot.grid, row, column)
                    if flags_inout.dirty[view, tile] == wp.uint8(0):
                        if edges_may_change(lights, coarse, shot, moving, steepness, view, row, column):
                            flags_inout.dirty[view, tile] = wp.uint8(RELIT)
                    rank = wp.atomic_add(lists_inout.count, view, chunk, PIXELS, 1)
                    lists_inout.pixel[view, chunk, rank] = wp.uint16(index)


@wp.func
def trace_pixel_edges(
    scene: PathScene, coarse: CoarseGrid, shot: AnyShot, which: int, heading: wp.vec2, steep: wp.uint32, view: int, row: int, column: int
) -> wp.uint32:
    """Trace the rays of a pixel to the lamps whose steepness, packed in `steep`, is above 0; packed as in `LampShadows.edge`."""
    lights, gbuffer, cameras = scene.lights, shot.gbuffer, shot.views.cameras
    direction_to_surface = camera_ray(cameras, view, row, column, wp.vec2(0.0, 0.0))
    outward = cameras.to_world[view] * direction_to_surface
    normal = visible_normal(scene.meshes, shot, view, read_hit(gbuffer, view, row, column), outward)
    position = hit_position(cameras, view, direction_to_surface, gbuffer.depth[view, row, column])
    result = wp.uint32(0)
    for lamp in range(lights.lamps[which]):
        if (steep >> wp.uint32(STEEPNESS_BITS * lamp)) & wp.uint32(STEEPNESS_LEVELS) != wp.uint32(0):
            free = coarse.rays
            if wp.dot(normal, lamp_direction(lights, which, lamp, heading)) > 0.0:
                for ray in range(coarse.rays):
                    direction = point_direction(lights, which, heading, lamp, coarse.rays, ray, row, column)
                    if is_shadowed(scene, shot, view, position, normal, direction):
                        free -= 1
            result |= wp.uint32(1 + free) << wp.uint32(4 * lamp)
    return result


@kernel_of_views(cuda_max_registers=RAY_REGISTERS)
def trace_shadow_edges_kernel(
    scene: PathScene,
    coarse: CoarseGrid,
    shot: AnyShot,
    lists: EdgeLists,
    image: ShadedImage,
    threads: int,
    first: int,
    shadows_inout: LampShadows,
):
    """Adaptive sampling: trace shadow rays from each listed pixel to each lamp whose shadow is steep; the results replace the steepness in
    `edge`.

    There are `CoarseGrid.rays` rays to a lamp. Where no pixel of the shadow grid around a pixel is on its surface, all lamps count as
    steep. Rays to lamps behind the surface count as unblocked, as on the shadow grid. Launched over view, chunk, thread (flat, from `first`
    on); `threads` as in `list_edge_pixels_kernel`.
    """
    view, chunk, start = list_place(lists, wp.tid() + first, threads)
    if view >= shot.views.count:
        return
    world = shot.views.world[view]
    which = shot.snapshot.light[world]
    heading = unit_heading(shot.snapshot.light_yaw[world])
    for index in range(start, lists.count[view, chunk, PIXELS], threads):
        row, column = listed_pixel(coarse, lists.cell, view, chunk, int(lists.pixel[view, chunk, index]))
        if not needs(shot.grid, image.passes, EDGE_PASS, view, row, column):
            continue
        steep = shadows_inout.edge[view, row, column]
        shadows_inout.edge[view, row, column] = trace_pixel_edges(scene, coarse, shot, which, heading, steep, view, row, column)


@kernel_of_views
def filter_shadow_edges_kernel(
    scene: PathScene,
    coarse: CoarseGrid,
    shot: AnyShot,
    lists: EdgeLists,
    shadows: LampShadows,
    threads: int,
    first: int,
    image_out: ShadedImage,
):
    """Filter the traced edges: each listed pixel of `radiance` receives the visible fractions of the lamps, see `filter_edge`, packed by
    `pack_fractions`; they lie there until the pixel is shaded, which saves memory.

    Launched over view, chunk, thread (flat, from `first` on); `threads` as in `list_edge_pixels_kernel`.
    """
    view, chunk, start = list_place(lists, wp.tid() + first, threads)
    if view >= shot.views.count:
        return
    lamps = scene.lights.lamps[shot.snapshot.light[shot.views.world[view]]]
    for index in range(start, lists.count[view, chunk, PIXELS], threads):
        row, column = listed_pixel(coarse, lists.cell, view, chunk, int(lists.pixel[view, chunk, index]))
        if not needs(shot.grid, image_out.passes, SHADE_PASS, view, row, column):
            continue
        plane = pixel_plane(scene.meshes, shot, view, row, column)
        fractions = filter_edge(shadows, coarse, shot.gbuffer, lamps, view, row, column, plane)
        image_out.radiance[view, row, column] = pack_fractions(fractions)
