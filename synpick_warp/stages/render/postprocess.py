"""From linear radiance to the bytes of a picture: tone curve, and the camera's effects if the settings name any."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from synpick_warp.arrays import allocate, device_array
from synpick_warp.codes import Tone
from synpick_warp.configs.schema import Config
from synpick_warp.configs.sensors import effect_ranges
from synpick_warp.kernels.render.images.antialias import ShadedImage
from synpick_warp.kernels.render.images.camera_effects import EffectRules, Strengths, draw_effects_kernel
from synpick_warp.kernels.render.images.postprocess import DevelopRules, develop_effects_kernel, develop_kernel, spread_rows_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.stages.buffers import Snapshot, ViewBuffers
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.render.scene import RenderScene


@dataclass(frozen=True, eq=False)
class SpreadArrays:
    """Scratch of effects for which a pixel needs its neighbours."""

    radiance: wp.array = device_array("view", "row", "column", dtype=wp.vec3)
    """Of pixels as they show, after vignette, and after blur and chromatic aberration along the rows."""


def has_effects(config: Config) -> bool:
    """Whether the settings ask for any effect."""
    return any(any(strengths) for strengths in effect_ranges(config.effects).values())


def has_spread(config: Config) -> bool:
    """Whether they ask for one that needs a pixel's neighbours."""
    return any((*config.effects.blur, *config.effects.chromatic_aberration))


def effect_rules(config: Config) -> Any:
    """The struct `EffectRules`."""
    low, high = zip(*effect_ranges(config.effects).values(), strict=True)
    rules = EffectRules()
    rules.seed = config.bake.seed
    rules.low, rules.high = Strengths(*low), Strengths(*high)
    return rules


class PostProcessor:
    """Develops pictures. Owns its scratch; `develop` only launches, so a CUDA graph can capture it."""

    def __init__(self, config: Config, scene: RenderScene, views: int) -> None:
        """Allocate scratch, if an effect needs it.

        Args:
            config: All settings; `effects` and `render.tone` count.
            scene: Constant data.
            views: Most views of a batch.
        """
        self.scene = scene
        self.effects = effect_rules(config) if has_effects(config) else None
        self.rules = DevelopRules()
        self.rules.seed = config.bake.seed
        self.rules.tone = Tone[config.render.tone.upper()]
        self.rules.spread = int(has_spread(config))
        self.spread: wp.array | None = None
        if has_spread(config):
            sizes = {"view": views, "row": scene.height, "column": scene.width}
            self.spread = allocate(SpreadArrays, sizes, scene.device).radiance

    def process(self, snapshot: Snapshot, views: Any, image: Any, out: ViewBuffers) -> None:
        """Colour of the views.

        Args:
            snapshot: The worlds.
            views: The struct `Views`.
            image: The struct `ShadedImage`.
            out: `color` is written, and `effects` if there are any; else these stay zero.
        """
        scene = self.scene
        if self.effects is None:
            inputs = [scene.grid, scene.lights, snapshot.light, snapshot.light_exposure, views, image, self.rules.tone]
            self._launch(develop_kernel, views.count, inputs, out.color)
            return
        inputs = [snapshot.episode, snapshot.frame, self.effects, views]
        wp.launch(draw_effects_kernel, dim=views.count, inputs=inputs, outputs=[out.effects], device=scene.device)
        if self.spread is not None:
            inputs = [scene.cameras, scene.grid, out.effects, views, image]
            self._launch(spread_rows_kernel, views.count, inputs, self.spread)
            spread = ShadedImage()
            spread.radiance, spread.mix = self.spread, image.mix
            image = spread
        inputs = [scene.cameras, scene.grid, scene.lights, snapshot.episode, snapshot.frame, snapshot.light, snapshot.light_exposure]
        inputs += [self.rules, out.effects, views, image]
        self._launch(develop_effects_kernel, views.count, inputs, out.color)

    def _launch(self, kernel: wp.Kernel, count: int, inputs: list[Any], output: wp.array) -> None:
        launch_pixels(kernel, count * self.scene.grid.tiles * int(TILE_PIXELS), inputs, [output], self.scene.device)
