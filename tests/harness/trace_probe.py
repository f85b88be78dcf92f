"""Test kernel that renders a G-buffer by ray tracing, the reference of the rasterizer."""

import warp as wp

from synpick_warp.kernels.render.visibility.bvh_rays import hit_table, trace_camera_ray
from synpick_warp.kernels.render.visibility.camera import Cameras, ImageGrid, Views, camera_ray, in_image, tile_of, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, Meshes, Table, ViewBodies, store_hit

wp.set_module_options({"enable_backward": False})


@wp.kernel
def trace_gbuffer_kernel(
    # Scene:
    meshes: Meshes,
    table: Table,
    cameras: Cameras,
    grid: ImageGrid,
    # In:
    bodies: ViewBodies,
    views: Views,
    offset: wp.vec2,
    first: int,
    # Out:
    gbuffer_out: GBuffer,
):
    """Render the G-buffer by ray tracing: one ray a pixel, `offset` [px] off its centre. Pixels of unused views (camera -1) stay.

    One thread a pixel from flat index `first` on, in tile order.
    """
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    camera = views.camera[view]
    if camera < 0:
        return
    ray = camera_ray(cameras.intrinsics[camera], row, column, offset)
    hit = trace_camera_ray(meshes, bodies, view, tile_of(grid, row, column), ray, views.instances)
    store_hit(gbuffer_out, view, row, column, hit_table(table, cameras, camera, ray, hit))
