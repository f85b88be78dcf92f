"""Kernel of the layer range."""

import warp as wp

from synpick_warp.kernels.render.images.layers import LayerScene, kernel_of_layer
from synpick_warp.kernels.render.lighting.paths.tracing import AnyScene
from synpick_warp.kernels.render.visibility.camera import camera_ray
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot


@wp.func
def range_at(scene: AnyScene, layer: LayerScene, shot: AnyShot, view: int, row: int, column: int) -> wp.uint16:
    ray = camera_ray(shot.views.cameras, view, row, column, wp.vec2(0.0, 0.0))
    depth = wp.where(shot.gbuffer.segment[view, row, column] != wp.uint8(0), shot.gbuffer.depth[view, row, column], 0.0)
    return wp.uint16(1000.0 * wp.length(ray) * depth + 0.5)


render_range_kernel = kernel_of_layer(range_at, "range", wp.uint16)
