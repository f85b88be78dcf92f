"""The reference picture by path tracing: host tables for drawing directions, and the launcher."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.kernels.camera_rays import TILE_PIXELS
from synpick_warp.kernels.paths import BOTH, PathRules, PathScene, trace_paths_kernel
from synpick_warp.kernels.sampling import Chances
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.light_tables import LUMINANCE, map_directions
from synpick_warp.stages.render_scene import RenderScene

ROULETTE = 2
"""Scatterings before dim paths may end early: the first ones carry most of the light."""


@dataclass(frozen=True, eq=False)
class ChanceTable:
    """Cumulative chances of one light map's texels; see `kernels.sampling.Chances`."""

    row: np.ndarray
    """(rows + 1) float32."""
    column: np.ndarray
    """(rows, columns + 1) float32."""


def chance_table(radiance: np.ndarray) -> ChanceTable:
    """Chances of a map's texels: luminance times solid angle, evenly where there is none.

    The map is seen through bilinear interpolation, which carries light half a texel beyond a lamp's edge: a texel counts
    with the mean of what is seen there, so that no light lies where the chance is 0.

    Args:
        radiance: (rows, 2 rows, 3).
    """
    rows, columns = radiance.shape[:2]
    _, solid = map_directions(rows)
    bright = radiance.astype(np.float64) @ LUMINANCE
    # The mean over a texel of what is interpolated linearly: 1/8, 3/4, 1/8.
    bright = 0.75 * bright + 0.125 * (np.roll(bright, 1, axis=1) + np.roll(bright, -1, axis=1))
    padded = np.pad(bright, ((1, 1), (0, 0)), mode="edge")
    weight = (0.75 * bright + 0.125 * (padded[:-2] + padded[2:])) * solid
    if weight.sum() <= 0.0:
        weight = solid
    column = np.zeros((rows, columns + 1))
    column[:, 1:] = np.cumsum(np.where(weight.sum(axis=1, keepdims=True) > 0.0, weight, 1.0), axis=1)
    row = np.concatenate([[0.0], np.cumsum(weight.sum(axis=1))])
    return ChanceTable((row / row[-1]).astype(np.float32), (column / column[:, -1:]).astype(np.float32))


def build_chances(background: np.ndarray, device: wp.Device) -> Any:
    """The struct `Chances` of light maps (map, rows, 2 rows, 3)."""
    tables = [chance_table(radiance) for radiance in background]
    chances = Chances()
    chances.row = wp.array(np.stack([table.row for table in tables]), dtype=wp.float32, device=device)
    chances.column = wp.array(np.stack([table.column for table in tables]), dtype=wp.float32, device=device)
    return chances


class ReferencePicture:
    """Renders linear radiance by path tracing. Owns its tables; `trace_paths` only launches."""

    def __init__(self, config: Config, scene: RenderScene, instances: int) -> None:
        """Make the tables.

        Args:
            config: All settings; `render.samples` and `render.bounces` count.
            scene: Constant data.
            instances: Room for instances of a world.
        """
        self.scene = scene
        self.paths = PathScene()
        self.paths.meshes = scene.meshes
        self.paths.table = scene.table
        self.paths.surfaces = scene.surfaces
        self.paths.lights = scene.lights
        self.paths.chances = build_chances(scene.lights.background.numpy(), scene.device)
        self.rules = PathRules()
        self.rules.samples = config.render.samples
        self.rules.bounces = config.render.bounces
        self.rules.roulette = ROULETTE
        self.rules.strategy = int(BOTH)
        self.rules.seed = config.bake.seed
        self.rules.instances = instances

    def trace_paths(
        self, snapshot: Snapshot, bodies: Any, view_world: wp.array, view_camera: wp.array, count: int, radiance: wp.array
    ) -> None:
        """Radiance of the first `count` views.

        Args:
            snapshot: The worlds.
            bodies: The struct `Bodies`, prepared for these views.
            view_world: World of each view (B) int32.
            view_camera: Camera of each view (B) int32.
            count: Views in use.
            radiance: Written (B, row, column) vec3.
        """
        scene = self.scene
        inputs = [self.paths, scene.cameras, scene.grid, snapshot.episode, snapshot.light, snapshot.light_turn]
        inputs += [bodies, view_world, view_camera, self.rules]
        launch_pixels(trace_paths_kernel, count * scene.grid.tiles * int(TILE_PIXELS), inputs, [radiance], scene.device)
