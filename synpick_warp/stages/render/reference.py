"""The reference picture by path tracing."""

from __future__ import annotations

from typing import Any

from synpick_warp.configs.schema import Config
from synpick_warp.kernels.render.lighting.path_tracing import BOTH, PathRules, trace_paths_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.render.scene import RenderScene

ROULETTE = 2
"""Scatterings before dim paths may end early: the first ones carry most of the light."""


def path_rules(config: Config, samples: int, roulette: int) -> Any:
    """The struct `PathRules`."""
    rules = PathRules()
    rules.samples = samples
    rules.bounces = config.render.bounces
    rules.roulette = roulette
    rules.strategy = int(BOTH)
    rules.seed = config.bake.seed
    return rules


class ReferenceRenderer:
    """Renders linear radiance by path tracing; `shade` only launches."""

    def __init__(self, config: Config, scene: RenderScene) -> None:
        """
        Args:
            config: All settings; `render.samples` and `render.bounces` count.
            scene: Constant data.
        """
        self.scene = scene
        self.rules = path_rules(config, config.render.samples, ROULETTE)

    def shade(self, snapshot: Snapshot, bodies: Any, gbuffer: Any, views: Any, image: Any) -> None:
        """Pictures of the views.

        Args:
            snapshot: The worlds.
            bodies: The struct `ViewBodies`, prepared for these views.
            gbuffer: Not read: each path has a hit of its own.
            views: The struct `Views`.
            image: The struct `ShadedImage`; its `radiance` is written, which is that of whole pixels.
        """
        scene = self.scene
        inputs = [scene.paths, scene.cameras, scene.grid, snapshot.episode, snapshot.light, snapshot.light_yaw]
        inputs += [bodies, views, self.rules]
        launch_pixels(trace_paths_kernel, views.count * scene.grid.tiles * int(TILE_PIXELS), inputs, [image.radiance], scene.device)
