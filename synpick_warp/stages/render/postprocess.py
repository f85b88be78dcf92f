"""Post-processing of shaded images to sRGB bytes: exposure, tone map, and camera effects if the settings ask for them."""

from dataclasses import dataclass
from typing import Any

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
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.kernels.render.visibility.gbuffer import ShadedImage
from synpick_warp.kernels.render.visibility.variants import kernel_for
from synpick_warp.stages.arrays import allocate, device_array
from synpick_warp.stages.buffers import ViewBuffers
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.render.scene import RenderScene


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
