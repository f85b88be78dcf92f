"""Rendering of a G-buffer by ray tracing, the reference of the rasterizer."""

import numpy as np
import warp as wp

from synpick_warp.kernels.render.visibility.bvh_rays import hit_table, trace_camera_ray
from synpick_warp.kernels.render.visibility.camera import (
    TILE_PIXELS,
    AnyViews,
    ImageGrid,
    LensViews,
    Views,
    camera_ray,
    in_image,
    tile_of,
    tile_pixel,
)
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, Meshes, Table, ViewBodies, store_hit
from synpick_warp.stages.render.scene import RenderScene
from tests.harness.probe import probe


@wp.func
def trace_pixel(meshes: Meshes, table: Table, grid: ImageGrid, bodies: ViewBodies, views: AnyViews, gbuffer: GBuffer, index: int):
    """Trace the ray through the centre of a pixel, by its index in tile order. Pixels of unused views (camera -1) stay."""
    view, row, column = tile_pixel(grid, index)
    camera = -1
    if in_image(grid, row, column):
        camera = views.camera[view]
    if camera >= 0:
        ray = camera_ray(views.cameras, view, row, column, wp.vec2(0.0, 0.0))
        hit = trace_camera_ray(meshes, bodies, view, tile_of(grid, row, column), ray, views.instances)
        store_hit(gbuffer, view, row, column, hit_table(table, views.cameras, view, ray, hit))


_trace_pixels = {kind.cls: probe(trace_pixel, views=kind) for kind in (Views, LensViews)}


def trace_gbuffer(scene: RenderScene, bodies: ViewBodies, views: AnyViews, gbuffer: GBuffer, count: int) -> None:
    """Render the G-buffer of `count` views by one ray a pixel."""
    pixels = np.arange(count * scene.grid.tiles * int(TILE_PIXELS))
    trace = next(trace for kind, trace in _trace_pixels.items() if isinstance(views, kind))
    trace(scene.meshes, scene.table, scene.grid, bodies, views, gbuffer, pixels, device=scene.device)
