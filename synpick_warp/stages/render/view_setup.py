"""Per-view setup of a batch: which camera shows which world, camera-space transforms of its bodies, and tile binning; and props, which are
bodies appended to the instances of each world, with the segmentation id of the table."""

from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.render.visibility.camera import LensCameras, LensViews, Views
from synpick_warp.kernels.render.visibility.damage import Damage
from synpick_warp.kernels.render.visibility.gbuffer import MASK_BITS, GBuffer, LensShot, ShotData, ViewBodies
from synpick_warp.kernels.render.visibility.props import hide_props_kernel, place_props_kernel
from synpick_warp.kernels.render.visibility.ray_bodies import RAY_RECORDS
from synpick_warp.kernels.render.visibility.variants import kernel_for
from synpick_warp.kernels.render.visibility.view_setup import aim_cameras_kernel, bin_bodies_kernel, set_up_views_kernel, sort_bodies_kernel
from synpick_warp.stages.arrays import allocate, allocate_struct, struct_arrays
from synpick_warp.stages.buffers import FIXTURES, Snapshot
from synpick_warp.stages.render.cameras import allocate_view_cameras
from synpick_warp.stages.render.scene import RenderScene, build_grid

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
