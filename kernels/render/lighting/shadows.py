"""How much of a map's main light reaches each hit: one ray for each cell of few pixels, shared by neighbours through a filter."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.coarse_grid import LEAST_WEIGHT, SAME_SURFACE, CellGrid, cell_number, cell_pixel, cell_place
from synpick_warp.kernels.render.lighting.environment import Lights, turned
from synpick_warp.kernels.render.lighting.plane_distance import Plane, off_plane, pixel_plane
from synpick_warp.kernels.render.lighting.sampling import around, sobol_point
from synpick_warp.kernels.render.visibility.camera import Cameras, Views, camera_ray, hit_position, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import (
    FAR,
    RAY_OFFSET,
    RAY_REGISTERS,
    GBuffer,
    Meshes,
    Table,
    ViewBodies,
    face_normal,
    is_blocked,
    read_hit,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.kernel(cuda_max_registers=RAY_REGISTERS)
def cast_shadow_rays_kernel(
    # Scene:
    meshes: Meshes,
    table: Table,
    cameras: Cameras,
    cells: CellGrid,
    lights: Lights,
    # State:
    light: wp.array[int],
    light_yaw: wp.array[float],
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    first: int,
    # Out:
    lit_out: wp.array3d[float],
):
    """1 where a ray from the middle of a cell to a point of the main light's disc meets nothing, else 0."""
    view, row, column = tile_pixel(cells.cells, wp.tid() + first)
    if not in_image(cells.cells, row, column):
        return
    which = light[views.world[view]]
    pixel = cell_pixel(cells, row, column)
    lit = float(1.0)
    if wp.max(lights.main_irradiance[which]) > 0.0 and int(gbuffer.segment[view, pixel[0], pixel[1]]) != Segment.NOTHING:
        camera = views.camera[view]
        ray = camera_ray(cameras.intrinsics[camera], pixel[0], pixel[1], wp.vec2(0.0, 0.0))
        normal = face_normal(meshes, bodies, view, read_hit(gbuffer, view, pixel[0], pixel[1]), views.instances)
        if wp.dot(normal, cameras.to_world[camera] * ray) > 0.0:
            normal = -normal
        middle = turned(lights.main_direction[which], light_yaw[views.world[view]])
        # A surface that faces away gets no main light anyhow; calling it lit keeps the filter from darkening edges.
        if wp.dot(normal, middle) > 0.0:
            point = sobol_point(cell_number(cells.window, row, column))
            radius = lights.main_spread[which] * wp.sqrt(point[0])
            angle = wp.TAU * point[1]
            direction = wp.normalize(around(middle, wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), 1.0)))
            origin = hit_position(cameras, camera, ray, gbuffer.depth[view, pixel[0], pixel[1]]) + RAY_OFFSET * normal
            if is_blocked(meshes, table, bodies, view, origin, direction, FAR):
                lit = 0.0
    lit_out[view, row, column] = lit


@wp.kernel
def filter_shadows_kernel(
    # Scene:
    meshes: Meshes,
    cameras: Cameras,
    cells: CellGrid,
    lights: Lights,
    # State:
    light: wp.array[int],
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    lit: wp.array3d[float],
    views: Views,
    first: int,
    # Out:
    lit_out: wp.array3d[float],
):
    """Mean over a window of cells on the same body and near the same plane."""
    view, row, column = tile_pixel(cells.cells, wp.tid() + first)
    if not in_image(cells.cells, row, column):
        return
    pixel = cell_pixel(cells, row, column)
    segment = gbuffer.segment[view, pixel[0], pixel[1]]
    if wp.max(lights.main_irradiance[light[views.world[view]]]) <= 0.0:
        return
    if int(segment) == Segment.NOTHING:
        # What is smaller than a cell may have no other about it.
        lit_out[view, row, column] = 1.0
        return
    camera = views.camera[view]
    normal = wp.transpose(cameras.to_world[camera]) * face_normal(
        meshes, bodies, view, read_hit(gbuffer, view, pixel[0], pixel[1]), views.instances
    )
    plane = pixel_plane(cameras.intrinsics[camera], pixel[0], pixel[1], segment, gbuffer.depth[view, pixel[0], pixel[1]], normal)
    tolerance = SAME_SURFACE * float(cells.size) * plane.width
    seen = float(0.0)
    total = float(0.0)
    for i in range(cells.window):
        r = row + i - cells.window // 2
        if r >= 0 and r < cells.cells.height:
            for j in range(cells.window):
                c = column + j - cells.window // 2
                if c >= 0 and c < cells.cells.width:
                    other = cell_pixel(cells, r, c)
                    if gbuffer.segment[view, other[0], other[1]] == segment:
                        if off_plane(plane, other[0] - pixel[0], other[1] - pixel[1], gbuffer.depth[view, other[0], other[1]]) < tolerance:
                            seen += lit[view, r, c]
                            total += 1.0
    if total > 0.0:
        lit_out[view, row, column] = seen / total
    else:
        lit_out[view, row, column] = lit[view, row, column]


@wp.func
def lit_share(gbuffer: GBuffer, lit: wp.array3d[float], cells: CellGrid, view: int, row: int, column: int, plane: Plane) -> float:
    """Share of the main light that reaches a pixel, from the four cells about it; `plane` is the pixel's."""
    y = cell_place(cells, row)
    x = cell_place(cells, column)
    top = int(wp.floor(y))
    left = int(wp.floor(x))
    tolerance = SAME_SURFACE * float(cells.size) * plane.width
    seen = float(0.0)
    total = float(0.0)
    for i in range(2):
        r = wp.clamp(top + i, 0, cells.cells.height - 1)
        vertical = 1.0 - wp.abs(y - float(top + i))
        for j in range(2):
            c = wp.clamp(left + j, 0, cells.cells.width - 1)
            weight = vertical * (1.0 - wp.abs(x - float(left + j))) + LEAST_WEIGHT
            pixel = cell_pixel(cells, r, c)
            apart = off_plane(plane, pixel[0] - row, pixel[1] - column, gbuffer.depth[view, pixel[0], pixel[1]])
            if gbuffer.segment[view, pixel[0], pixel[1]] != plane.segment or apart > tolerance:
                weight *= LEAST_WEIGHT
            seen += weight * lit[view, r, c]
            total += weight
    return seen / total
