"""Steep edges of lamp shadows: shadow rays from each pixel at them (adaptive sampling), to the lamps whose shadows are steep there."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.coarse_grid import CoarseGrid
from synpick_warp.kernels.render.lighting.environment import Lights, lamp_direction, unit_heading
from synpick_warp.kernels.render.lighting.plane_distance import tangent_plane
from synpick_warp.kernels.render.lighting.shadow_filter import STEEPNESS_BITS, STEEPNESS_LEVELS, LampShadows
from synpick_warp.kernels.render.lighting.shadow_upsampling import all_steepness, find_shadow_taps
from synpick_warp.kernels.render.lighting.shadows import is_shadowed, point_direction, visible_normal
from synpick_warp.kernels.render.visibility.camera import Cameras, Views, camera_ray, hit_position, in_image, tile_of, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, Meshes, Table, ViewBodies, read_hit
from synpick_warp.kernels.tuning import RAY_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})


CHUNK_TILES = wp.constant(32)
"""Tiles of the shadow grid that share a list and its counter, as of anti-aliasing's footprints."""


@wp.kernel
def list_edges_kernel(
    # Scene:
    coarse: CoarseGrid,
    # In:
    views: Views,
    # Out:
    shadows_inout: LampShadows,
    cell_out: wp.array3d[int],  # (view, edge_chunk, chunk_cell)
    count_inout: wp.array2d[int],  # (view, edge_chunk)
):
    """List the pixels of the shadow grid that `near_edge` marks, by chunk of tiles, in any order (stream compaction), and clear the marks.

    `cell_out` receives row * columns + column, and `count_inout` is increased by their number.
    """
    view, row, column = tile_pixel(coarse.grid, wp.tid())
    if view < views.count and in_image(coarse.grid, row, column):
        if shadows_inout.near_edge[view, row, column] != wp.uint8(0):
            shadows_inout.near_edge[view, row, column] = wp.uint8(0)
            chunk = tile_of(coarse.grid, row, column) // CHUNK_TILES
            cell_out[view, chunk, wp.atomic_add(count_inout, view, chunk, 1)] = row * coarse.grid.width + column


@wp.func
def trace_pixel_edges(
    meshes: Meshes,
    table: Table,
    cameras: Cameras,
    coarse: CoarseGrid,
    lights: Lights,
    which: int,
    heading: wp.vec2,
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    shadows: LampShadows,
    view: int,
    row: int,
    column: int,
) -> wp.uint32:
    """Trace the rays of a pixel that shows a surface; packed as in `LampShadows.edge`."""
    camera = views.camera[view]
    depth = gbuffer.depth[view, row, column]
    camera_direction = camera_ray(cameras.intrinsics[camera], row, column, wp.vec2(0.0, 0.0))
    outward = cameras.to_world[camera] * camera_direction
    normal = visible_normal(meshes, bodies, view, read_hit(gbuffer, view, row, column), views.instances, outward)
    local = wp.transpose(cameras.to_world[camera]) * normal
    plane = tangent_plane(cameras.intrinsics[camera], row, column, gbuffer.segment[view, row, column], depth, local)
    steepness = all_steepness(find_shadow_taps(shadows, coarse, view, row, column, plane))
    result = wp.uint32(0)
    if steepness == wp.uint32(0):
        return result
    position = hit_position(cameras, camera, camera_direction, depth)
    for lamp in range(lights.lamps[which]):
        if (steepness >> wp.uint32(STEEPNESS_BITS * lamp)) & wp.uint32(STEEPNESS_LEVELS) != wp.uint32(0):
            free = coarse.rays
            if wp.dot(normal, lamp_direction(lights, which, lamp, heading)) > 0.0:
                for ray in range(coarse.rays):
                    direction = point_direction(lights, which, heading, lamp, coarse.rays, ray, row, column)
                    if is_shadowed(meshes, table, bodies, view, views.instances, position, normal, direction):
                        free -= 1
            result |= wp.uint32(1 + free) << wp.uint32(4 * lamp)
    return result


@wp.kernel(cuda_max_registers=RAY_REGISTERS)
def trace_shadow_edges_kernel(
    # Scene:
    meshes: Meshes,
    table: Table,
    cameras: Cameras,
    coarse: CoarseGrid,
    lights: Lights,
    # State: worlds
    light: wp.array[int],  # (world)
    light_yaw: wp.array[float],  # (world) [rad]
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    cell: wp.array3d[int],  # (view, edge_chunk, chunk_cell)
    count: wp.array2d[int],  # (view, edge_chunk)
    views: Views,
    threads: int,
    first: int,
    # Out:
    shadows_inout: LampShadows,
):
    """Trace `CoarseGrid.rays` rays from a pixel to each lamp whose shadow is steep, to all if no pixel of the shadow grid
    around it is on its surface. `edge`, which must be 0, is written in the listed pixels of the shadow grid.

    The host does not read the counts, so a fixed number of `threads` strides over the pixels of a chunk. Rays to lamps behind the surface
    count as free, as on the shadow grid.
    """
    # Unsigned: cheaper to divide.
    thread = wp.uint32(wp.tid() + first)
    place = thread // wp.uint32(threads)
    chunks = wp.uint32(count.shape[1])
    view = int(place // chunks)
    if view >= views.count:
        return
    chunk = int(place % chunks)
    world = views.world[view]
    size = wp.uint32(coarse.size)
    for index in range(int(thread % wp.uint32(threads)), coarse.size * coarse.size * count[view, chunk], threads):
        item = wp.uint32(index)
        place_in_grid = wp.uint32(cell[view, chunk, int(item // (size * size))])
        inside = item % (size * size)
        row = int((place_in_grid // wp.uint32(coarse.grid.width)) * size + inside // size)
        column = int((place_in_grid % wp.uint32(coarse.grid.width)) * size + inside % size)
        if in_image(coarse.image, row, column):
            if int(gbuffer.segment[view, row, column]) != Segment.NOTHING:
                which = light[world]
                heading = unit_heading(light_yaw[world])
                shadows_inout.edge[view, row, column] = trace_pixel_edges(
                    meshes, table, cameras, coarse, lights, which, heading, bodies, gbuffer, views, shadows_inout, view, row, column
                )
