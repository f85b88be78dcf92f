"""Renders single objects without light or surroundings, by the rasterizer, for validation and pictures of estimated poses."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.render.visibility.gbuffer import Table
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.arrays import allocate, allocate_struct
from synpick_warp.stages.buffers import FIXTURES, Snapshot
from synpick_warp.stages.render.cameras import build_cameras
from synpick_warp.stages.render.raster import Rasterizer
from synpick_warp.stages.render.scene import RenderScene, blank_scene
from synpick_warp.stages.render.view_setup import GBUFFER, VIEW_BODIES, body_sizes, first_views, set_up_views

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def object_scene(meshes: Any, keep: tuple[wp.Mesh, ...], cameras: Sequence[Camera], device: wp.Device) -> RenderScene:
    """Scene of objects alone, to rasterize. `meshes`: the struct `Meshes`. `keep`: their owners. `cameras`: cameras of one image size."""
    return replace(
        blank_scene(len(cameras), *cameras[0].resolution, device),
        meshes=meshes,
        cameras=build_cameras(cameras, device),
        table=Table(),
        obj_id=wp.zeros(len(keep), dtype=wp.int32, device=device),
        keep=keep,
    )


def render_object(scene: RenderScene, model: int, pose: Sequence[float] | np.ndarray = IDENTITY) -> Any:
    """Render a model from all cameras of a scene. `scene`: the scene; see `object_scene`. `model`: row of its meshes. `pose`: object to
    world: x, y, z [m] and quaternion x, y, z, w. Returns the struct `GBuffer`, one view a camera; segmentation id 1 and depth [m] where the
    object is, 0 and `FAR` elsewhere."""
    device, count = scene.device, scene.camera_count
    world = allocate(Snapshot, {"world": 1, "instance": 1, "fixture": len(FIXTURES)}, device)
    world.catalog_index.fill_(model)
    world.pose.fill_(wp.transform(*np.asarray(pose, np.float64).tolist()))
    sizes = {"view": count, "row": scene.height, "column": scene.width} | body_sizes(1, scene.width, scene.height)
    views = first_views(count, count, 1, device, scene.cameras)
    bodies, gbuffer = allocate_struct(VIEW_BODIES, sizes, device), allocate_struct(GBUFFER, sizes, device)
    set_up_views(scene, world, world.fixture_visible, views, bodies)
    Rasterizer(scene, 1.0, count, background=gbuffer).rasterize(bodies, views, gbuffer)
    return gbuffer
