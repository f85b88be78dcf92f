"""Motion blur and rolling shutter: sub-frames over the exposure of a picture, and their mean in linear radiance."""

from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.render.images.shutter import SubFrame, expose_kernel, move_bodies_kernel, move_cameras_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS, CameraTable, LensCameras
from synpick_warp.kernels.render.visibility.variants import kernel_for
from synpick_warp.stages.arrays import allocate_struct, bundle, struct_arrays
from synpick_warp.stages.buffers import FIXTURES, Snapshot
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.render.view_setup import make_views

SUB_FRAME = struct_arrays(
    SubFrame,
    "view",
    pose=("world", "instance"),
    fixture_pose=("world", "fixture"),
    world_moves=("world",),
    weight=("sub_frame", "row"),
    units={"pose": "m", "fixture_pose": "m", "center": "m"},
)
SEED_STEP = 0x9E3779B97F4A7C15
"""Difference of the seeds of successive sub-frames, so that their paths differ: 2^64 over the golden ratio (Knuth, TAOCP 3, 6.4)."""


def plan_sub_frames(exposure: float, readout: float, count: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Sampling times of `count` sub-frames (sub_frame), relative to the middle row's mid-exposure, in the unit of `exposure` and `readout`,
    and the averaging weights of each row (sub_frame, row), which sum to 1 over the sub-frames.

    Sub-frames are the midpoints of equal intervals from the first row's start to the last row's end of exposure. The exposure of a row is
    at least one interval."""
    exposure = max(exposure, readout / (count - 1))
    part = (exposure + readout) / count
    times = (np.arange(count) + 0.5 - count / 2) * part
    middle = readout * (np.linspace(-0.5, 0.5, rows) if rows > 1 else np.zeros(1))
    away = np.abs(times[:, None] - middle)
    shared = np.clip((exposure + part) / 2 - away, 0.0, part)
    return times, (shared / shared.sum(axis=0)).astype(np.float32)


class Shutter:
    """Exposes pictures: renders sub-frames by a renderer of their own. `expose` only launches kernels, but for its first call, which
    allocates scratch for the number of worlds of its snapshot."""

    def __init__(self, renderer: Any, exposure: float, readout: float, count: int) -> None:
        """`renderer`: the `Renderer` of sub-frames, without effects, layers and histories. `exposure`, `readout`: times [frames], one of
        them above 0. `count`: number of sub-frames, at least 2."""
        self.renderer, self.seed = renderer, int(renderer.shading.rules.seed)
        self.times, self.weights = plan_sub_frames(exposure, readout, count, renderer.scene.height)
        self._scratch: Any = None

    def expose(self, snapshot: Snapshot, views: Any, last: Any, image: Any) -> None:
        """Replace the radiance of views in which anything moves by the mean over sub-frames. `snapshot`: the worlds, without props.
        `views`: the struct `Views`. `last`: the views' cameras in the frame before. `image`: the struct `ShadedImage`."""
        scene, device = self.renderer.scene, self.renderer.scene.device
        scratch = self._allocate(*snapshot.pose.shape)
        cameras = bundle(LensCameras if isinstance(views.cameras, LensCameras.cls) else CameraTable, scratch, views.cameras)
        moved = make_views(views.world, views.camera, views.count, views.instances, cameras, views.slot)
        then = replace(snapshot, pose=scratch.pose, fixture_pose=scratch.fixture_pose)
        scratch.world_moves.zero_()
        dim = snapshot.pose.shape[0], snapshot.pose.shape[1] + len(FIXTURES)
        pixels = views.count * scene.grid.tiles * int(TILE_PIXELS)
        for index, time in enumerate(self.times.tolist()):
            wp.launch(move_bodies_kernel, dim=dim, inputs=[snapshot.bundle, time], outputs=[scratch], device=device)
            inputs = [snapshot.bundle, views, last.rotation, last.center, time]
            wp.launch(kernel_for(move_cameras_kernel, views), dim=views.count, inputs=inputs, outputs=[scratch], device=device)
            shown = self.renderer.render_radiance(then, moved, (self.seed + SEED_STEP * (index + 1)) % 2**64)
            launch_pixels(expose_kernel, pixels, [scene.grid, shown, scratch, index], [image], device)

    def _allocate(self, worlds: int, instances: int) -> Any:
        """The struct `SubFrame` for a number of worlds and instances of each."""
        if self._scratch is None or self._scratch.pose.shape != (worlds, instances):
            sizes = {"world": worlds, "instance": instances, "fixture": len(FIXTURES), "view": self.renderer.views}
            sizes |= dict(zip(("sub_frame", "row"), self.weights.shape, strict=True))
            self._scratch = allocate_struct(SUB_FRAME, sizes, self.renderer.scene.device)
            self._scratch.weight.assign(self.weights)
        return self._scratch
