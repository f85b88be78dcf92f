"""The reference picture by path tracing."""

from __future__ import annotations

from typing import Any

import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.kernels.render.lighting.path_tracing import BOTH, PathRules, trace_paths_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.render.scene import RenderScene

ROULETTE = 2
"""Scatterings before dim paths may end early: the first ones carry most of the light."""


def path_rules(config: Config, instances: int, samples: int, roulette: int) -> Any:
    """The struct `PathRules`."""
    rules = PathRules()
    rules.samples = samples
    rules.bounces = config.render.bounces
    rules.roulette = roulette
    rules.strategy = int(BOTH)
    rules.seed = config.bake.seed
    rules.instances = instances
    return rules


class ReferencePicture:
    """Renders linear radiance by path tracing; `shade` only launches."""

    def __init__(self, config: Config, scene: RenderScene, instances: int) -> None:
        """
        Args:
            config: All settings; `render.samples` and `render.bounces` count.
            scene: Constant data.
            instances: Room for instances of a world.
        """
        self.scene = scene
        self.rules = path_rules(config, instances, config.render.samples, ROULETTE)

    def shade(
        self, snapshot: Snapshot, bodies: Any, hits: Any, view_world: wp.array, view_camera: wp.array, count: int, picture: Any
    ) -> None:
        """Pictures of the first `count` views.

        Args:
            snapshot: The worlds.
            bodies: The struct `Bodies`, prepared for these views.
            hits: Not read: each path has a hit of its own.
            view_world: World of each view (B) int32.
            view_camera: Camera of each view (B) int32.
            count: Views in use.
            picture: The struct `Picture`; its `radiance` is written, which is that of whole pixels.
        """
        scene = self.scene
        inputs = [scene.paths, scene.cameras, scene.grid, snapshot.episode, snapshot.light, snapshot.light_yaw]
        inputs += [bodies, view_world, view_camera, self.rules]
        launch_pixels(trace_paths_kernel, count * scene.grid.tiles * int(TILE_PIXELS), inputs, [picture.radiance], scene.device)
