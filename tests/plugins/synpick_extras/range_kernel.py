"""Kernel of the layer range."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import AnyViews, ImageGrid, camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer
from synpick_warp.kernels.render.visibility.variants import kernel_of_views


@kernel_of_views
def render_range_kernel(grid: ImageGrid, gbuffer: GBuffer, views: AnyViews, first: int, range_out: wp.array3d[wp.uint16]):
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if in_image(grid, row, column):
        ray = camera_ray(views.cameras, view, row, column, wp.vec2(0.0, 0.0))
        depth = wp.where(gbuffer.segment[view, row, column] != wp.uint8(0), gbuffer.depth[view, row, column], 0.0)
        range_out[view, row, column] = wp.uint16(1000.0 * wp.length(ray) * depth + 0.5)
