"""Post-processing of shaded images to sRGB bytes: exposure, tone map, and camera effects if the settings ask for them; motion blur and
rolling shutter: sub-frames over the exposure of a picture, and their mean in linear radiance."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Tone
from synpick_warp.configs.cell.cameras import Effects, effect_ranges
from synpick_warp.kernels.render.images.camera_effects import EffectParameters, EffectRanges, sample_effects_kernel
from synpick_warp.kernels.render.images.postprocess import (
    PostProcessSettings,
    filter_lens_rows_kernel,
    gather_images_kernel,
    postprocess_effects_kernel,
    postprocess_kernel,
)
from synpick_warp.kernels.render.images.shutter import SubFrame, expose_kernel, move_bodies_kernel, move_cameras_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS, CameraTable, LensCameras
from synpick_warp.kernels.render.visibility.gbuffer import ShadedImage
from synpick_warp.kernels.render.visibility.variants import kernel_for
from synpick_warp.stages.arrays import allocate, allocate_struct, bundle, device_array, struct_arrays
from synpick_warp.stages.buffers import FIXTURES, Snapshot, ViewBuffers
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.render.view_setup import make_views


@dataclass(frozen=True, eq=False)
class LensArrays:
    """Radiance between the two passes of the lens filter. Scratch."""

    radiance: wp.array = device_array("view", "row", "column", dtype=wp.vec3)
    """Resolved radiance after vignette, and after blur and chromatic aberration along rows."""


@dataclass(frozen=True, eq=False)
class KeptColors:
    """Colour images of the last frame of each world and camera."""

    color: wp.array = device_array("kept", "row", "column", dtype=wp.vec3ub)
    """sRGB, red first."""


def has_effects(effects: Effects) -> bool:
    """True if any camera effect is on."""
    return any(any(bounds) for bounds in effect_ranges(effects).values())


def has_lens_filter(effects: Effects) -> bool:
    """True if an effect that reads neighbouring pixels is on: blur or chromatic aberration."""
    return any((*effects.blur, *effects.chromatic_aberration))


def make_effect_ranges(effects: Effects, seed: int) -> Any:
    """Build the struct `EffectRanges`: lowest and highest value of each camera effect, and the seed."""
    low, high = zip(*effect_ranges(effects).values(), strict=True)
    result = EffectRanges()
    result.seed = seed
    result.low, result.high = EffectParameters(*low), EffectParameters(*high)
    return result


def as_words(images: wp.array) -> wp.array:
    """View of an array of images as (image, word), in the largest words into which an image can be divided."""
    size = images.shape[1] * images.shape[2] * wp.types.type_size_in_bytes(images.dtype)
    dtype, width = next((dtype, width) for dtype, width in ((wp.vec4ui, 16), (wp.uint32, 4), (wp.uint8, 1)) if size % width == 0)
    return wp.array(ptr=images.ptr, shape=(images.shape[0], size // width), dtype=dtype, device=images.device)


class PostProcessor:
    """Turns radiance into sRGB images. Owns its scratch; `process` only launches, so a CUDA graph can capture it."""

    def __init__(
        self, effects: Effects, tone: str, seed: int, scene: RenderScene, views: int, kept_row: wp.array | None = None, kept: int = 0
    ) -> None:
        """Allocate scratch, if an effect needs it. `effects`: ranges of the camera effects. `tone`: tone curve, a setting of `render.tone`.
        `seed`: seed of the bake. `views`: largest number of views in a batch. `kept_row`: (view) int32: indices of the kept images of a
        batch's views; None: nothing is kept. `kept`: number of images that are kept from frame to frame, for tiles that are not computed
        anew."""
        self.scene = scene
        sizes = {"kept": kept, "row": scene.height, "column": scene.width}
        self.kept, self.rows = allocate(KeptColors, sizes, scene.device).color, kept_row if kept else None
        self.effects = make_effect_ranges(effects, seed) if has_effects(effects) else None
        self.settings = PostProcessSettings()
        self.settings.seed = seed
        self.settings.tone = Tone[tone.upper()]
        self.settings.lens_filter = int(has_lens_filter(effects))
        self.filtered: wp.array | None = None
        if has_lens_filter(effects):
            sizes = {"view": views, "row": scene.height, "column": scene.width}
            self.filtered = allocate(LensArrays, sizes, scene.device).radiance

    def process(self, shot: Any, image: Any, out: ViewBuffers) -> None:
        """Compute the colour images of a batch of views. `shot`: the struct `ShotData`. `image`: the struct `ShadedImage`. `out`: `color`
        is written, and `effects` if any effect is on; else it stays zero."""
        scene, count = self.scene, shot.views.count
        if self.effects is None:
            color = self.kept if self.kept.size else out.color
            self._launch(postprocess_kernel, count, [scene.lights, shot, image, self.settings.tone, self.rows], color)
            if self.kept.size:
                kept, written = (as_words(array) for array in (self.kept, out.color))
                dim = count, kept.shape[1]
                wp.launch(gather_images_kernel, dim=dim, inputs=[self.rows, kept], outputs=[written], device=scene.device)
            return
        inputs = [self.effects, shot]
        wp.launch(kernel_for(sample_effects_kernel, shot), dim=count, inputs=inputs, outputs=[out.effects], device=scene.device)
        if self.filtered is not None:
            self._launch(filter_lens_rows_kernel, count, [out.effects, shot, image], self.filtered)
            filtered = ShadedImage()
            filtered.radiance, filtered.resolve, filtered.samples = self.filtered, image.resolve, image.samples
            image = filtered
        self._launch(postprocess_effects_kernel, count, [scene.lights, self.settings, out.effects, shot, image], out.color)

    def _launch(self, kernel: wp.Kernel, count: int, inputs: list[Any], output: wp.array) -> None:
        """Launch a kernel over all pixels of `count` views."""
        launch_pixels(kernel, count * self.scene.grid.tiles * int(TILE_PIXELS), inputs, [output], self.scene.device)


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
