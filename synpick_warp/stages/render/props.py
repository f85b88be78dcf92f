"""Props in the renderer: bodies appended to the instances of each world, with the segmentation id of the table."""

from dataclasses import replace
from typing import Any

import warp as wp

from synpick_warp.kernels.render.visibility.props import hide_props_kernel, place_props_kernel
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.render.view_setup import make_views

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
