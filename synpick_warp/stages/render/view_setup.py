"""Per-view setup of a batch: which camera shows which world, camera-space transforms of its bodies, and tile binning; props, which are
bodies appended to the instances of each world, with the segmentation id of the table; and the launcher of the triangle rasterizer.

The static background, tote and table, is cached: rendered once a camera. Single objects are rendered without light or surroundings, for
validation and pictures of estimated poses.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.errors import CatalogError
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS, TILE_WIDTH, LensCameras, LensViews, Views
from synpick_warp.kernels.render.visibility.damage import Damage
from synpick_warp.kernels.render.visibility.gbuffer import MASK_BITS, GBuffer, LensShot, ShotData, Table, ViewBodies
from synpick_warp.kernels.render.visibility.masks import KeptMasks, keep_masks_kernel, lay_out_masks_kernel, restore_masks_kernel
from synpick_warp.kernels.render.visibility.props import hide_props_kernel, place_props_kernel
from synpick_warp.kernels.render.visibility.raster import (
    MAX_TRIANGLES,
    VisibilityBuffer,
    clear_visibility_kernel,
    rasterize_blocks_kernel,
    rasterize_triangles_kernel,
    resolve_visibility_kernel,
)
from synpick_warp.kernels.render.visibility.ray_bodies import RAY_RECORDS
from synpick_warp.kernels.render.visibility.variants import kernel_for
from synpick_warp.kernels.render.visibility.view_setup import aim_cameras_kernel, bin_bodies_kernel, set_up_views_kernel, sort_bodies_kernel
from synpick_warp.kernels.tuning import BLOCK_THREADS, KEEP_THREADS, RESTORE_THREADS, TRIANGLE_THREADS
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.arrays import allocate, allocate_struct, struct_arrays
from synpick_warp.stages.buffers import FIXTURES, Snapshot, ViewBuffers, masks_of
from synpick_warp.stages.launch import launch, launch_pixels, launch_views
from synpick_warp.stages.render.cameras import allocate_view_cameras, build_cameras
from synpick_warp.stages.render.scene import RenderScene, blank_scene, build_grid
from synpick_warp.views.frames import most_words

VIEW_BODIES = struct_arrays(
    ViewBodies,
    "view",
    "body",
    ray_record=("view", "body", "record"),
    present=("view",),
    uses_background=("view",),
    body_mask=("view", "tile", "body_word"),
    units={"start": "m", "near": "m", "box": "px", "position": "m", "sphere": "m, m²"},
)
VIEWS = struct_arrays(Views, "view")
DAMAGE = struct_arrays(Damage, "view", moved=("view", "none"), touched=("view", "none"), dirty=("view", "none"))
GBUFFER = struct_arrays(GBuffer, "view", "row", "column", units={"depth": "m"})
BACKGROUND = struct_arrays(GBuffer, "camera", "row", "column", units={"depth": "m"})


def pair_views(worlds: np.ndarray, cameras: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World and camera of each view (view) int32 of all cameras in all worlds: world by world, and camera by camera in each."""
    return np.repeat(worlds, len(cameras)).astype(np.int32), np.tile(cameras, len(worlds)).astype(np.int32)


def make_views(world: wp.array, camera: wp.array, count: int, instances: int, cameras: Any = None, slot: wp.array | None = None) -> Any:
    """The struct `Views`, or `LensViews` if some cameras are distorted. `world`: world of each view (view) int32; -1: the view is not in
    use. `camera`: camera of each view (view) int32. `count`: views in the batch; arrays may be longer. `cameras`: the struct `CameraTable`
    or `LensCameras`; None: the renderer brings its own. `slot`: row of each view's camera in the scene (view) int32; None: that of its
    index."""
    views = LensViews() if isinstance(cameras, LensCameras.cls) else Views()
    views.world, views.camera, views.count, views.instances = world, camera, count, instances
    views.slot = camera if slot is None else slot
    if cameras is not None:
        views.cameras = cameras
    return views


def with_cameras(views: Any, cameras: Any) -> Any:
    """The same views with the cameras of a renderer: themselves, or the struct `LensViews` if these are the struct `LensCameras`."""
    if isinstance(cameras, LensCameras.cls):
        return make_views(views.world, views.camera, views.count, views.instances, cameras, views.slot)
    views.cameras = cameras
    return views


def whole_damage(views: int, device: wp.Device) -> Any:
    """The struct `Damage` of views without a previous frame: all is damaged."""
    damage = allocate_struct(DAMAGE, {"view": views, "none": 0}, device)
    damage.kept_row.assign(np.arange(views))
    return damage


def make_shot(scene: RenderScene, frames: Any, bodies: Any, gbuffer: Any, views: Any) -> Any:
    """The struct `ShotData`, or `LensShot` if some cameras are distorted, of the structs `Frames`, `ViewBodies`, `GBuffer` and `Views`."""
    shot = LensShot() if isinstance(views, LensViews.cls) else ShotData()
    shot.grid, shot.snapshot, shot.bodies, shot.gbuffer, shot.views = scene.grid, frames, bodies, gbuffer, views
    return shot


def first_views(count: int, cameras: int, instances: int, device: wp.Device, lenses: Any = None) -> Any:
    """The struct `Views` of the first views, world by world and camera by camera; arguments as of `make_views`, number of cameras, and the
    scene's struct `CameraTable` if some are distorted."""
    view = np.arange(count, dtype=np.int32)
    world, camera = (wp.array(values, dtype=wp.int32, device=device) for values in (view // cameras, view % cameras))
    return make_views(world, camera, count, instances, allocate_view_cameras(count, device, lenses))


def body_sizes(instances: int, width: int, height: int) -> dict[str, int]:
    """Extents of the dimensions that `VIEW_BODIES` names beside the view, for images of `width` x `height` px."""
    bodies = instances + len(FIXTURES)
    # The highest bit of the only word stays free: anti-aliasing shifts past the last body.
    words = bodies // int(MASK_BITS) + 1
    return {"body": bodies, "tile": build_grid(width, height).tiles, "body_word": words, "record": int(RAY_RECORDS)}


def set_up_views(
    scene: RenderScene,
    snapshot: Snapshot,
    fixture_visible: wp.array,
    views: Any,
    bodies: Any,
    placed: bool = False,
) -> None:
    """Set each view's camera, transform the bodies into its axes, sort them front to back and bin them into tiles. `fixture_visible`: which
    fixtures are visible (world, fixture) int32. `views`: the struct `Views`; its cameras are written. `bodies`: the struct `ViewBodies`;
    written. `placed`: whether the views' cameras are set already. The static background is then of no use."""
    if not placed:
        wp.launch(kernel_for(aim_cameras_kernel, views), dim=views.count, inputs=[scene.cameras], outputs=[views], device=scene.device)
    dim = (views.count, bodies.mesh.shape[1])
    worlds = [snapshot.bin, snapshot.catalog_index, snapshot.pose, snapshot.fixture_pose, fixture_visible]
    inputs = [scene.meshes, scene.grid, *worlds, views]
    wp.launch(kernel_for(set_up_views_kernel, views), dim=dim, inputs=inputs, outputs=[bodies], device=scene.device)
    if placed:
        bodies.uses_background.zero_()
    wp.launch(sort_bodies_kernel, dim=dim, inputs=[scene.meshes], outputs=[bodies], device=scene.device)
    bin_bodies(scene, views, bodies)


def bin_bodies(scene: RenderScene, views: Any, bodies: Any) -> None:
    """Bin the bodies of the struct `ViewBodies` into tiles, in their order."""
    inputs = [scene.meshes, scene.grid, views]
    wp.launch(
        kernel_for(bin_bodies_kernel, views), dim=(views.count, scene.grid.tiles), inputs=inputs, outputs=[bodies], device=scene.device
    )


PLACED = ("catalog_index", "pose", "last_catalog_index", "last_pose")
"""Arrays of a snapshot to which props are appended."""


def allocate_placed(worlds: int, instances: int, props: int, device: wp.Device) -> Snapshot | None:
    """Allocate the arrays of a snapshot with props; None: there are none."""
    return allocate(Snapshot, {"world": worlds, "instance": instances + props}, device, PLACED) if props else None


class PropPlacer:
    """Appends a scene's props to the instances of snapshots and views, and returns these unchanged in a scene without props. Allocates its
    scratch for the number of worlds of the first snapshot.

    Attributes:
        bodies: Number of instances and props of a world.
    """

    def __init__(self, scene: RenderScene, instances: int) -> None:
        """Create a placer. `scene`: has the props. `instances`: instance capacity of a world."""
        self.scene, self.instances, self.bodies = scene, instances, instances + scene.prop_count
        self._placed: Snapshot | None = None

    def place(self, snapshot: Snapshot, fixture_visible: wp.array) -> Snapshot:
        """Copy of a snapshot with props as instances. `fixture_visible`: as of `set_up_views`; hidden grippers hide what follows them."""
        if not self.scene.prop_count:
            return snapshot
        device, worlds = self.scene.device, snapshot.pose.shape[0]
        if self._placed is None or self._placed.pose.shape[0] != worlds:
            self._placed = allocate_placed(worlds, self.instances, self.scene.prop_count, device)
        placed = replace(snapshot, **{name: getattr(self._placed, name) for name in PLACED})
        inputs = [self.scene.props, fixture_visible, snapshot.bundle]
        wp.launch(place_props_kernel, dim=placed.pose.shape, inputs=inputs, outputs=[placed.bundle], device=device)
        return placed

    def widen(self, views: Any) -> Any:
        """Copy the struct `Views` or `LensViews`, with the props counted among the instances."""
        if not self.scene.prop_count:
            return views
        return make_views(views.world, views.camera, views.count, self.bodies, views.cameras, views.slot)

    def hide(self, segment: wp.array, views: int) -> None:
        """Replace the ids of props by the table's in the first `views` segmentation images (view, row, column)."""
        if self.scene.prop_count:
            dim = (views, *segment.shape[1:])
            wp.launch(hide_props_kernel, dim=dim, inputs=[self.instances], outputs=[segment], device=self.scene.device)


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
