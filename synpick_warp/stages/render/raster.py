"""Launcher of the triangle rasterizer; the cached static background: tote and table, rendered once a camera; and single objects without
light or surroundings, for validation and pictures of estimated poses."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.errors import CatalogError
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS, TILE_WIDTH
from synpick_warp.kernels.render.visibility.gbuffer import Table
from synpick_warp.kernels.render.visibility.masks import KeptMasks, keep_masks_kernel, lay_out_masks_kernel, restore_masks_kernel
from synpick_warp.kernels.render.visibility.raster import (
    MAX_TRIANGLES,
    VisibilityBuffer,
    clear_visibility_kernel,
    rasterize_blocks_kernel,
    rasterize_triangles_kernel,
    resolve_visibility_kernel,
)
from synpick_warp.kernels.tuning import BLOCK_THREADS, KEEP_THREADS, RESTORE_THREADS, TRIANGLE_THREADS
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.arrays import allocate, allocate_struct, struct_arrays
from synpick_warp.stages.buffers import FIXTURES, Snapshot, ViewBuffers, masks_of
from synpick_warp.stages.launch import launch, launch_pixels, launch_views
from synpick_warp.stages.render.cameras import build_cameras
from synpick_warp.stages.render.scene import RenderScene, blank_scene
from synpick_warp.stages.render.view_setup import BACKGROUND, GBUFFER, VIEW_BODIES, body_sizes, first_views, set_up_views, whole_damage
from synpick_warp.views.frames import most_words

BLOCKS, INSTANCE_BLOCKS = 32768, 512
"""Capacity for pixel blocks of large triangles per view, at least, and for each instance. A full-HD view filled by thirteen low-polygon
objects (hundreds to thousands of triangles each, such as the embedded ones) needs 14,000 blocks, dense meshes a tenth of that; each of 128
or 251 brackets needs 320. If the capacity is exceeded, the remaining triangles are rasterized by one thread each, which is slow."""

KEPT_WORDS = 2
"""Room for the masks that are kept of a view, in full-image masks: those of a tote take a half. Larger ones are drawn anew."""

_BLOCKS: dict[str, tuple[str, ...]] = {"block": ("view", "block"), "blocks": ("view",)}
VISIBILITY_BUFFER = struct_arrays(VisibilityBuffer, "view", "row", "column", **_BLOCKS)
KEPT_VISIBILITY = struct_arrays(VisibilityBuffer, "kept", "row", "column", **_BLOCKS)
KEPT_MASKS = struct_arrays(KeptMasks, "kept", "instance", words=("kept", "kept_word"), length=("kept",))


class Rasterizer:
    """Renders G-buffers by rasterization. Owns its scratch; `rasterize` only launches kernels, so a CUDA graph can capture it.

    Attributes:
        background: Cached static background: the struct `GBuffer`, one view a camera, of the tote at its usual pose and the table.
    """

    def __init__(
        self, scene: RenderScene, counts_per_meter: float, views: int, instances: int = 0, background: Any = None, kept: int = 0
    ) -> None:
        """Allocate scratch. `counts_per_meter`: counts of the depth image per metre. `background`: as the attribute; None: it is rendered.
        `kept`: number of views whose visibility and masks are kept from frame to frame. Raises CatalogError: a mesh has more triangles than
        a visibility key can hold."""
        most = max((len(mesh.indices) // 3 for mesh in scene.keep), default=0)
        if most > MAX_TRIANGLES:
            raise CatalogError(f"a mesh has {most} triangles; at most {MAX_TRIANGLES} can be rendered")
        self.scene = scene
        self.counts_per_meter = counts_per_meter
        self.visibility = allocate_visibility(views, scene.width, scene.height, instances, scene.device, kept)
        words = KEPT_WORDS * most_words(scene.width, scene.height)
        self.kept_masks = allocate_struct(KEPT_MASKS, {"kept": kept, "instance": instances, "kept_word": words}, scene.device)
        self.whole = whole_damage(views, scene.device)
        self.background = background
        if background is None:
            self.background = allocate_background(scene.camera_count, scene.width, scene.height, scene.device)
            if scene.keep:
                render_background(scene, self.background)

    def rasterize(self, bodies: Any, views: Any, gbuffer: Any, out: ViewBuffers | None = None, damage: Any = None) -> None:
        """Render the G-buffer of a batch of views. `bodies`: the struct `ViewBodies` of these views. `views`: the struct `Views`.
        `gbuffer`: the struct `GBuffer`; written. `out`: `instance`, `depth` and the amodal masks are written; None: only the G-buffer is
        needed. `damage`: the struct `Damage`, if visibility and masks are kept; None: all is damaged."""
        scene, visibility, device, masks = self.scene, self.visibility, self.scene.device, masks_of(out)
        pixels = views.count * scene.grid.tiles * int(TILE_PIXELS)
        instance, depth = (None, None) if out is None else (out.instance, out.depth)
        damage, kept = self.whole if damage is None else damage, self.kept_masks
        launch_pixels(clear_visibility_kernel, pixels // int(TILE_WIDTH), [scene.grid, damage, views], [visibility], device)
        if out is not None:
            dim = (views.count, out.mask_first.shape[1])
            wp.launch(lay_out_masks_kernel, dim=dim, inputs=[scene.grid, bodies], outputs=[masks], device=device)
            given = {"damage": damage, "kept": kept, "masks": masks}
            launch(restore_masks_kernel, (*dim, RESTORE_THREADS), threads=RESTORE_THREADS, **given)
        inputs = [scene.meshes, scene.grid, bodies, views, damage, kept]
        per_body, per_view = (TRIANGLE_THREADS, BLOCK_THREADS) if device.is_cuda else (1, 1)
        threads = bodies.mesh.shape[1] * per_body
        launch_views(rasterize_triangles_kernel, views.count, threads, [*inputs, per_body], [visibility, masks], device)
        launch_views(rasterize_blocks_kernel, views.count, per_view, [*inputs, per_view], [visibility, masks], device)
        if out is not None and kept.length.size:
            launch(keep_masks_kernel, (views.count, KEEP_THREADS), threads=KEEP_THREADS, damage=damage, masks=masks, kept=kept)
        inputs = [scene.meshes, scene.table, scene.grid, self.background, bodies, visibility, damage, views, self.counts_per_meter]
        launch_pixels(resolve_visibility_kernel, pixels, inputs, [gbuffer, instance, depth], device)


def render_background(scene: RenderScene, gbuffer: Any) -> None:
    """Render the static background to the struct `GBuffer`, one view a camera, of a world that contains the tote alone."""
    device, cameras = scene.device, scene.camera_count
    sizes = {"view": cameras, "row": scene.height, "column": scene.width} | body_sizes(0, scene.width, scene.height)
    world = allocate(Snapshot, {"world": 1, "instance": 0, "fixture": len(FIXTURES)}, device)
    world.fixture_pose.fill_(wp.transform_identity())
    tote = wp.array([[1, 0, 0]], dtype=wp.int32, device=device)
    views = first_views(cameras, cameras, 0, device, scene.cameras)
    bodies = allocate_struct(VIEW_BODIES, sizes, device)
    set_up_views(scene, world, tote, views, bodies)
    # The background itself must be rasterized.
    bodies.uses_background.zero_()
    Rasterizer(scene, 1.0, cameras, background=gbuffer).rasterize(bodies, views, gbuffer)


def allocate_visibility(views: int, width: int, height: int, instances: int, device: wp.Device, kept: int = 0) -> Any:
    """Allocate the struct `VisibilityBuffer`; `kept`: as of `Rasterizer`."""
    sizes = {"view": views, "kept": kept, "row": height, "column": width, "block": max(BLOCKS, INSTANCE_BLOCKS * instances)}
    return allocate_struct(KEPT_VISIBILITY if kept else VISIBILITY_BUFFER, sizes, device)


def allocate_background(cameras: int, width: int, height: int, device: wp.Device) -> Any:
    """Allocate the struct `GBuffer` of a static background, one view a camera."""
    return allocate_struct(BACKGROUND, {"camera": cameras, "row": height, "column": width}, device)


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
