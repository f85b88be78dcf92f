"""What tools/reports/render.py measures of objects whose picture is known: white ones in an even room, and a plane under a lamp."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh
import warp as wp

from synpick_warp.arrays import allocate
from synpick_warp.configs.schema import FAST, REFERENCE, Config
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.fixtures import make_fixtures
from synpick_warp.scenes.types import Camera, Catalog, CatalogEntry, EnvironmentMap, Material, TriangleMesh
from synpick_warp.stages.buffers import FIXTURES, Snapshot, ViewBuffers
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.render.view_setup import make_views
from tools.options import Row

MOST_FURNACE_ERROR = 1.0
"""Of a white object in an even room, and of a plane's irradiance [%]."""
ROUGHNESSES = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
LAMP_RADIUS = np.radians(6.0)
LAMP_ROWS = 256
LAMP_HEIGHTS = (90.0, 60.0, 30.0)
"""Above the plane [°]."""
QUADRATURE = 4
"""Cosines, and azimuths, from which a plane is seen."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture."""

    color: np.ndarray
    """(H, W, 3) uint8, sRGB, red first."""
    radiance: np.ndarray
    """(H, W, 3) float32, linear, before exposure."""
    instance: np.ndarray
    """(H, W) uint8."""
    seconds: float


class Studio:
    """A scene and a renderer for one view at a time."""

    def __init__(
        self, config: Config, catalog: Catalog, cameras: tuple[Camera, ...], lights: tuple[EnvironmentMap, ...], device: Any
    ) -> None:
        fixtures = make_fixtures(config.tote, config.gripper)
        scene = build_render_scene(config, catalog, fixtures, cameras, lights, device)
        self.device = device
        self.renderer = Renderer(config, scene, config.arrangement.max_objects, 1)
        sizes = {"view": 1, "row": scene.height, "column": scene.width, "instance": config.arrangement.max_objects}
        self.out = allocate(ViewBuffers, sizes | {"count": 3, "box": 2, "side": 4}, device)

    def shoot(self, snapshot: Snapshot, world: int, camera: int) -> Shot:
        """Picture of a world by a camera."""
        started = time.perf_counter()
        world_list, camera_list = (wp.array([number], dtype=wp.int32, device=self.device) for number in (world, camera))
        self.renderer.render(snapshot, make_views(world_list, camera_list, 1, self.renderer.instances), self.out)
        color = self.out.color.numpy()[0].copy()
        seconds = time.perf_counter() - started
        return Shot(color, self.renderer.image.radiance.numpy()[0].copy(), self.out.instance.numpy()[0].copy(), seconds)


def bounded(name: str, value: float, unit: str, most: float) -> Row:
    """A line whose number must lie within ±`most`."""
    return Row(name, value, unit, f"within {most:g}", bool(abs(value) < most))


def with_mode(config: Config, mode: str, **bake: object) -> Config:
    """The settings with another mode of rendering, and other values of the section bake."""
    return replace(config, render=replace(config.render, mode=mode), bake=replace(config.bake, **bake))  # pyright: ignore[reportArgumentType]


def furnaces(config: Config, device: Any) -> list[Row]:
    """White balls, dielectric and metal, in a room of radiance 1: how far their mean radiance is from 1, by roughness."""
    made = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    vertices = np.asarray(made.vertices, dtype=np.float32)
    flat = np.zeros((len(vertices), 2), np.float32)
    mesh = TriangleMesh(vertices, np.asarray(made.faces, dtype=np.int32), vertices / np.float32(0.1), flat)
    kinds = [(metallic, roughness) for metallic in (0.0, 1.0) for roughness in ROUGHNESSES]
    above = replace(
        config.cameras, resolution=(64, 64), fov=10.0, positions=((0.0, 0.0, 2.0),), target=(0.0, 0.0, 0.0), ups=((0.0, 1.0, 0.0),)
    )
    rows = []
    for mode in (REFERENCE, FAST):
        studio = _bare_studio(with_mode(config, mode), mesh, kinds, make_cameras(above), _even(), device)
        snapshot = _one_each(config, len(kinds), device)
        for world, (metallic, roughness) in enumerate(kinds):
            shot = studio.shoot(snapshot, world, 0)
            error = 100.0 * float(shot.radiance[shot.instance == 1].mean() - 1.0)
            name = f"{mode}: furnace, {'metal' if metallic else 'dielectric'}, roughness {roughness:g}"
            rows.append(bounded(name, error, "%", MOST_FURNACE_ERROR))
    return rows


def planes(config: Config, device: Any) -> list[Row]:
    """A white matt plane under a disc of radiance L and angular radius a, at the angle θ to the normal: E = π L sin² a cos θ.

    White sends back what it gets, though not evenly: the mean of its radiance over all directions, weighted by the cosine, is
    E / π. Cameras stand at the nodes of a quadrature.
    """
    corners = 20.0 * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], np.float32)
    up = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    mesh = TriangleMesh(corners, np.array([(0, 1, 2), (0, 2, 3)], np.int32), up, np.zeros((4, 2), np.float32))
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
    cosines = (nodes + 1.0) / 2.0
    azimuths = (np.arange(QUADRATURE) + 0.5) / QUADRATURE * 2.0 * np.pi
    places = [2.0 * np.array([np.sqrt(1 - c * c) * np.cos(a), np.sqrt(1 - c * c) * np.sin(a), c]) for c in cosines for a in azimuths]
    shares = np.repeat(weights * cosines, QUADRATURE) / QUADRATURE
    around = replace(
        config.cameras,
        resolution=(32, 32),
        fov=2.0,
        positions=tuple(map(tuple, places)),
        target=(0.0, 0.0, 0.0),
        ups=((0.0, 0.0, 1.0),) * len(places),
    )
    rows = []
    for height in LAMP_HEIGHTS:
        cosine = float(np.sin(np.radians(height)))
        studio = _bare_studio(with_mode(config, REFERENCE), mesh, [(0.0, 1.0)], make_cameras(around), _lamp(cosine), device)
        snapshot = _one_each(config, 1, device)
        radiance = [float(studio.shoot(snapshot, 0, camera).radiance.mean()) for camera in range(len(places))]
        error = 100.0 * (float(shares @ radiance) / (np.sin(LAMP_RADIUS) ** 2 * cosine) - 1.0)
        rows.append(bounded(f"reference: irradiance, lamp {height:g}° high", error, "%", MOST_FURNACE_ERROR))
    return rows


def _even() -> EnvironmentMap:
    return EnvironmentMap("even", np.ones((16, 32, 3), np.float32))


def _lamp(cosine: float) -> EnvironmentMap:
    """A disc of radiance 1, its edge one texel soft, in a black map."""
    directions, _ = map_directions(LAMP_ROWS)
    angle = np.arccos(np.clip(directions @ np.array([np.sqrt(1.0 - cosine**2), 0.0, cosine]), -1.0, 1.0))
    share = np.clip((LAMP_RADIUS - angle) / (np.pi / LAMP_ROWS) + 0.5, 0.0, 1.0)
    return EnvironmentMap("lamp", np.repeat(share[..., None], 3, axis=2).astype(np.float32))


def _bare_studio(
    config: Config, mesh: TriangleMesh, kinds: list[tuple[float, float]], cameras: tuple[Camera, ...], light: EnvironmentMap, device: Any
) -> Studio:
    """A studio for a white mesh, one catalog entry for each (metallic, roughness), with nothing around."""
    config = replace(config, render=replace(config.render, table=False))
    white = [Material((1.0, 1.0, 1.0), None, metallic, roughness) for metallic, roughness in kinds]
    # Volume, radius, mass and diameter do not show.
    entries = tuple(
        CatalogEntry(1, "probe", mesh, material, (), 1.0, 1.0, 1.0, np.zeros(3), np.eye(3), 1.0, (), (), None) for material in white
    )
    return Studio(config, Catalog(entries), cameras, (light,), device)


def _one_each(config: Config, worlds: int, device: Any) -> Snapshot:
    """World w holds catalog entry w at the origin, and nothing else."""
    room = config.arrangement.max_objects
    snapshot = allocate(Snapshot, {"world": worlds, "instance": room, "fixture": len(FIXTURES)}, device)
    entry = np.full((worlds, room), -1)
    entry[:, 0] = np.arange(worlds)
    snapshot.catalog_index.assign(entry)
    for poses in (snapshot.pose, snapshot.fixture_pose):
        poses.assign(np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (*poses.shape, 1)))
    return snapshot
