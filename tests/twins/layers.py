"""Layers of toy scenes: a way to draw them, and motion from poses in float64."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import warp as wp

from synpick_warp.arrays import allocate
from synpick_warp.configs.schema import LAYERS
from synpick_warp.scenes.types import Camera, Catalog
from synpick_warp.stages.buffers import LayerBuffers, ViewBuffers
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.render.view_setup import make_views
from tests.twins.raycast import rotation_of
from tests.worlds.toy_scene import ToyScene, snapshot


@dataclass
class Before:
    """The frame before, of every world: what a toy scene has there, and whether there was one."""

    placed: list[list[tuple[int, tuple[float, ...]]]]
    follows: list[int]
    fixture_poses: tuple[tuple[float, ...], ...] | None = None
    """None: those of the toy scene."""
    fixtures_visible: tuple[int, int, int] | None = None


@dataclass(frozen=True)
class Drawn:
    """Layers by name, beside the G-buffer that they are computed from: segmentation ids and planar depth [m]."""

    layers: dict[str, np.ndarray]
    segment: np.ndarray
    depth: np.ndarray
    names: tuple[str, ...] = field(default=LAYERS)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.layers[name]


def draw(toy: ToyScene, device: wp.Device, before: Before | None = None, names: tuple[str, ...] = LAYERS) -> Drawn:
    """Draw layers of every world by every camera: view = world x cameras + camera."""
    config = replace(toy.settings(), render=replace(toy.settings().render, layers=names))
    scene = build_render_scene(config, Catalog(tuple(toy.entries)), toy.fixtures, toy.cameras, toy.lights, device)
    worlds, cameras = len(toy.placed), len(toy.cameras)
    views = worlds * cameras
    made = snapshot(toy, device)
    if before is not None:
        poses, visible = before.fixture_poses or toy.fixture_poses, before.fixtures_visible or toy.fixtures_visible
        last = snapshot(replace(toy, placed=before.placed, fixture_poses=poses, fixtures_visible=visible), device)
        for name in ("catalog_index", "pose", "fixture_pose", "fixture_visible"):
            wp.copy(getattr(made, f"last_{name}"), getattr(last, name))
        made.follows.assign(np.array(before.follows))
    renderer = Renderer(config, scene, toy.room, views)
    sizes = {"view": views, "row": scene.height, "column": scene.width, "instance": toy.room, "count": 3, "box": 2, "side": 4}
    out = allocate(LayerBuffers, sizes, device, names)
    view_world = wp.array(np.repeat(np.arange(worlds), cameras), dtype=wp.int32, device=device)
    view_camera = wp.array(np.tile(np.arange(cameras), worlds), dtype=wp.int32, device=device)
    renderer.render(made, make_views(view_world, view_camera, views, toy.room), allocate(ViewBuffers, sizes, device), out)
    layers = {name: getattr(out, name).numpy() for name in names}
    return Drawn(layers, renderer.gbuffer.segment.numpy(), renderer.gbuffer.depth.numpy(), names)


def points(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Surface points in the camera's axes (H, W, 3) float64 [m], from planar depth (H, W) [m]."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    matrix = camera.matrix
    rays = np.stack([(columns - matrix[0, 2]) / matrix[0, 0], (rows - matrix[1, 2]) / matrix[1, 1], np.ones_like(rows)], axis=-1)
    return rays * np.asarray(depth, np.float64)[..., None]


def pixels(place: np.ndarray, camera: Camera) -> np.ndarray:
    """Where points in the camera's axes are seen: column, row [px]."""
    image = place @ camera.matrix.T
    return image[..., :2] / image[..., 2:]


def pose_in(camera: Camera, pose: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation from a body to the camera, of a body's pose in the world as float32 has it."""
    exact = np.asarray(pose, np.float32).astype(np.float64)
    return camera.rotation @ rotation_of(exact[3:]), camera.rotation @ exact[:3] + camera.translation


def moved(place: np.ndarray, now: tuple[np.ndarray, np.ndarray], then: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Where points of a body were (..., 3), given where they are, and the body's rotation and translation now and then."""
    own = (place - now[1]) @ now[0]
    return own @ then[0].T + then[1]
