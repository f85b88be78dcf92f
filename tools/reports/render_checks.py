"""Renderer tests with a known result: white furnace (white spheres under uniform light), and irradiance of a plane under a lamp."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh
import warp as wp

from synpick_warp.configs.cell.rig import Rig
from synpick_warp.configs.schema import FAST, REFERENCE, Cameras, Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.fixtures import make_fixtures
from synpick_warp.scenes.types import Camera, Catalog, CatalogEntry, EnvironmentMap, Material, TriangleMesh
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import FIXTURES, Snapshot, allocate_view_buffers
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.render.view_setup import make_views
from tools.options import Row

MAX_ENERGY_ERROR = 1.0
"""Bound of the relative error of the furnace's radiance and of the plane's irradiance [%]."""
ROUGHNESSES = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
LAMP_RADIUS = np.radians(6.0)
"""Angular radius of the lamp [rad]."""
LAMP_ROWS = 256
"""Rows of the lamp's light map."""
LAMP_HEIGHTS = (90.0, 60.0, 30.0)
"""Elevations of the lamp above the plane [°]."""
QUADRATURE = 4
"""Nodes of the quadrature over view directions: in the cosine, and in azimuth."""


@dataclass(frozen=True, eq=False)
class Shot:
    """Rendered view: sRGB image, linear radiance before exposure, segmentation ids, and time [s]."""

    color: np.ndarray
    """Image (H, W, 3) uint8, sRGB."""
    radiance: np.ndarray
    """Linear radiance before exposure (H, W, 3) float32."""
    instance: np.ndarray
    """Segmentation ids (H, W) uint8."""
    seconds: float
    """Time to render it [s]."""


class Studio:
    """Renderer of single views, with its buffers."""

    def __init__(self, renderer: Renderer) -> None:
        self.renderer, self.device = renderer, renderer.scene.device
        self.out = allocate_view_buffers(1, renderer.scene.width, renderer.scene.height, renderer.instances, self.device)

    def render(self, snapshot: Snapshot, world: int, camera: int) -> Shot:
        """Render one world by one camera."""
        started = time.perf_counter()
        world_list, camera_list = (wp.array([index], dtype=wp.int32, device=self.device) for index in (world, camera))
        self.renderer.render(snapshot, make_views(world_list, camera_list, 1, self.renderer.instances), self.out)
        color = self.out.color.numpy()[0].copy()
        seconds = time.perf_counter() - started
        return Shot(color, self.renderer.image.radiance.numpy()[0].copy(), self.out.instance.numpy()[0].copy(), seconds)


def make_studio(config: Config, catalog: Catalog, cameras: tuple[Camera, ...], lights: tuple[EnvironmentMap, ...], device: Any) -> Studio:
    """Build a scene and its renderer, without light histories."""
    fixtures = make_fixtures(make_bins(config.cell.bins), config.gripper)
    scene = build_render_scene(config.render, -config.tote.wall, catalog, fixtures, cameras, lights, device)
    return Studio(make_renderer(config, scene, config.arrangement.max_objects, 1))


def bounded_row(name: str, value: float, unit: str, bound: float) -> Row:
    """Row whose value must lie within ±`bound`."""
    return Row(name, value, unit, f"within {bound:g}", bool(abs(value) < bound))


def first_camera(cameras: Cameras) -> dict[str, object]:
    """Settings of the first camera alone."""
    return {"cameras.positions": cameras.positions[:1], "cameras.ups": cameras.ups[:1]}


def measure_furnaces(config: Config, device: Any) -> list[Row]:
    """White furnace test: error of the mean radiance of white spheres under uniform light of radiance 1, by metallic and roughness."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    vertices = np.asarray(sphere.vertices, dtype=np.float32)
    uv = np.zeros((len(vertices), 2), np.float32)
    mesh = TriangleMesh(vertices, np.asarray(sphere.faces, dtype=np.int32), vertices / np.float32(0.1), uv)
    surfaces = [(metallic, roughness) for metallic in (0.0, 1.0) for roughness in ROUGHNESSES]
    above = replace(
        config.cameras, resolution=(64, 64), fov=10.0, positions=((0.0, 0.0, 2.0),), target=(0.0, 0.0, 0.0), ups=((0.0, 1.0, 0.0),)
    )
    rows = []
    for mode in (REFERENCE, FAST):
        probe = config.with_values({"render.table": False, "render.mode": mode})
        studio = make_studio(probe, _white_catalog(mesh, surfaces), make_cameras(Rig.of(above)), (_uniform_light(),), device)
        snapshot = _probe_snapshot(config.arrangement.max_objects, len(surfaces), device)
        for world, (metallic, roughness) in enumerate(surfaces):
            shot = studio.render(snapshot, world, 0)
            error = 100.0 * float(shot.radiance[shot.instance == 1].mean() - 1.0)
            name = f"{mode}: furnace, {'metal' if metallic else 'dielectric'}, roughness {roughness:g}"
            rows.append(bounded_row(name, error, "%", MAX_ENERGY_ERROR))
    return rows


def measure_planes(config: Config, device: Any) -> list[Row]:
    """Irradiance test: a white diffuse plane under a disc of radiance L and angular radius a, at the angle θ to the normal.

    The irradiance is E = π L sin² a cos θ. A white surface reflects all of it, so the cosine-weighted mean of its radiance over all
    directions is E / π. The mean is a quadrature, with a camera at each node.
    """
    corners = 20.0 * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], np.float32)
    up = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    mesh = TriangleMesh(corners, np.array([(0, 1, 2), (0, 2, 3)], np.int32), up, np.zeros((4, 2), np.float32))
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
    cosines = (nodes + 1.0) / 2.0
    azimuths = (np.arange(QUADRATURE) + 0.5) / QUADRATURE * 2.0 * np.pi
    positions = [2.0 * np.array([np.sqrt(1 - c * c) * np.cos(a), np.sqrt(1 - c * c) * np.sin(a), c]) for c in cosines for a in azimuths]
    node_weights = np.repeat(weights * cosines, QUADRATURE) / QUADRATURE
    around = replace(
        config.cameras,
        resolution=(32, 32),
        fov=2.0,
        positions=tuple(map(tuple, positions)),
        target=(0.0, 0.0, 0.0),
        ups=((0.0, 0.0, 1.0),) * len(positions),
    )
    rows, probe = [], config.with_values({"render.table": False, "render.mode": REFERENCE})
    for height in LAMP_HEIGHTS:
        cosine = float(np.sin(np.radians(height)))
        studio = make_studio(probe, _white_catalog(mesh, [(0.0, 1.0)]), make_cameras(Rig.of(around)), (_lamp_light(cosine),), device)
        snapshot = _probe_snapshot(config.arrangement.max_objects, 1, device)
        radiance = [float(studio.render(snapshot, 0, camera).radiance.mean()) for camera in range(len(positions))]
        error = 100.0 * (float(node_weights @ radiance) / (np.sin(LAMP_RADIUS) ** 2 * cosine) - 1.0)
        rows.append(bounded_row(f"reference: irradiance, lamp at {height:g}°", error, "%", MAX_ENERGY_ERROR))
    return rows


def _uniform_light() -> EnvironmentMap:
    """Light map of radiance 1 from all directions."""
    return EnvironmentMap("uniform", np.ones((16, 32, 3), np.float32))


def _lamp_light(cosine: float) -> EnvironmentMap:
    """Light map of a disc of radiance 1 with a one-texel soft border at elevation asin(`cosine`), black elsewhere."""
    directions, _ = map_directions(LAMP_ROWS)
    angle = np.arccos(np.clip(directions @ np.array([np.sqrt(1.0 - cosine**2), 0.0, cosine]), -1.0, 1.0))
    coverage = np.clip((LAMP_RADIUS - angle) / (np.pi / LAMP_ROWS) + 0.5, 0.0, 1.0)
    return EnvironmentMap("lamp", np.repeat(coverage[..., None], 3, axis=2).astype(np.float32))


def _white_catalog(mesh: TriangleMesh, surfaces: list[tuple[float, float]]) -> Catalog:
    """Catalog of a white mesh, with one entry per surface (metallic, roughness)."""
    white = [Material((1.0, 1.0, 1.0), None, metallic, roughness) for metallic, roughness in surfaces]
    # Volume, radius, mass and diameter do not affect rendering.
    numbers = (1.0, 1.0, 1.0, np.zeros(3), np.eye(3), 1.0)
    return Catalog(tuple(CatalogEntry(1, "probe", mesh, material, (), *numbers, (), (), None) for material in white))


def _probe_snapshot(capacity: int, worlds: int, device: Any) -> Snapshot:
    """Snapshot in which world w contains catalog entry w at the origin alone."""
    snapshot = allocate(Snapshot, {"world": worlds, "instance": capacity, "fixture": len(FIXTURES)}, device)
    catalog_index = np.full((worlds, capacity), -1)
    catalog_index[:, 0] = np.arange(worlds)
    snapshot.catalog_index.assign(catalog_index)
    for poses in (snapshot.pose, snapshot.fixture_pose):
        poses.assign(np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (*poses.shape, 1)))
    return snapshot
