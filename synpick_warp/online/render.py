"""Offscreen rendering of anyone's meshes at given poses: colour, depth, instance segmentation and layers, by the renderer of bakes."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.bins import make_bins, make_fixtures
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.looks import load_looks
from synpick_warp.scenes.modelling import Patch, make_mesh
from synpick_warp.scenes.types import Camera, Catalog, CatalogEntry, Material, TriangleMesh
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import FIXTURES, LayerBuffers, Snapshot, ViewBuffers, view_buffer_sizes
from synpick_warp.stages.render.scene import build_render_scene, with_cameras
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.system.hardware.device import pick_device, start_warp
from synpick_warp.views.layers import LAYER_TABLE

GREY = Material((0.7, 0.7, 0.7), None, 0.0, 0.6)
"""Material of arrays, and of files without one."""
Mesh = Path | str | tuple[np.ndarray, np.ndarray]


class SceneRenderer:
    """Renderer of meshes at poses that differ from call to call; models, textures and lights are prepared once."""

    def __init__(
        self, meshes: Sequence[Mesh], cameras: Sequence[Camera], layers: Sequence[str], unit: float, device: str, settings: Config
    ) -> None:
        """Prepare the scene of `meshes`; `cameras` are the first ones. Other arguments and errors: as of `synpick_warp.render`."""
        start_warp()
        self.layers, on = tuple(layers), pick_device(device)
        self.settings = settings = replace(settings, render=replace(settings.render, layers=self.layers))
        known = {_key(mesh): mesh for mesh in meshes}
        self._rows = {key: row for row, key in enumerate(known)}
        catalog = Catalog(tuple(_entry(index + 1, mesh, unit) for index, mesh in enumerate(known.values())))
        fixtures = make_fixtures(make_bins(settings.cell.bins), settings.gripper)
        lights, looks = load_lights(settings.bake.lights)[:1], load_looks(settings.randomize, lambda line: None, strict=True)
        self.scene = build_render_scene(settings.render, 0.0, catalog, fixtures, tuple(cameras), lights, on, looks)

    def render(self, worlds: Sequence[Sequence[tuple[Mesh, Any]]], cameras: Sequence[Camera]) -> dict[str, wp.array]:
        """Render worlds of (mesh, object to world) by cameras of one resolution, as many for each world, world by world. Returns arrays of
        `ViewBuffers` and layers, by name; a view does not depend on the other worlds, nor on meshes that are not in its own."""
        scene, count, most = with_cameras(self.scene, tuple(cameras)), len(cameras), max(map(len, worlds))
        sizes = view_buffer_sizes(count, *cameras[0].resolution, most)
        images, extra = allocate(ViewBuffers, sizes, scene.device), allocate(LayerBuffers, sizes, scene.device, self.layers)
        shown = first_views(count, count // len(worlds), most, scene.device, scene.cameras)
        shown.slot = wp.array(np.arange(count, dtype=np.int32), dtype=wp.int32, device=scene.device)
        renderer = make_renderer(self.settings, scene, most, count)
        renderer.render(self._place(worlds, most), shown, images, extra if self.layers else None)
        named = {name: getattr(extra, name) for name in self.layers}
        return {"color": images.color, "depth": images.depth, "instance": images.instance} | named

    def _place(self, worlds: Sequence[Sequence[tuple[Mesh, Any]]], most: int) -> Snapshot:
        """Worlds of at most `most` objects, and neither bin nor gripper."""
        sizes = {"world": len(worlds), "instance": most, "fixture": len(FIXTURES)}
        result = allocate(Snapshot, sizes, self.scene.device)
        rows, poses = np.full((len(worlds), most), -1, np.int32), np.tile(np.eye(4), (len(worlds), most, 1, 1))
        for world, objects in enumerate(worlds):
            rows[world, : len(objects)] = [self._rows[_key(mesh)] for mesh, _ in objects]
            poses[world, : len(objects)] = [np.asarray(pose, float).reshape(4, 4) for _, pose in objects]
        turned = Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(*rows.shape, 4)
        placed = np.concatenate([poses[..., :3, 3], turned], axis=-1).astype(np.float32)
        for array in (result.catalog_index, result.last_catalog_index):
            array.assign(rows)
        for array in (result.pose, result.last_pose):
            array.assign(placed)
        result.live.fill_(1)
        return result


def render_scene(
    objects: Sequence[tuple[Mesh, Any]], cameras: Sequence[Camera], layers: Sequence[str], unit: float, device: str, settings: Config
) -> dict[str, wp.array]:
    """Render a scene; arguments and errors as of `synpick_warp.render`. Returns arrays of `ViewBuffers` and layers, by name."""
    if not 1 <= len(objects) <= MAX_INSTANCES:
        raise ConfigError(f"render has {len(objects)} objects; allowed: 1 to {MAX_INSTANCES}")
    if len({each.resolution for each in cameras}) != 1:
        raise ConfigError("render needs cameras of one resolution; call it once for each resolution")
    if unknown := sorted(set(layers) - LAYER_TABLE.keys()):
        raise ConfigError(f"render has no layer {unknown[0]}; allowed: {', '.join(LAYER_TABLE)}")
    return SceneRenderer([mesh for mesh, _ in objects], cameras, layers, unit, device, settings).render([objects], cameras)


def _key(mesh: Mesh) -> object:
    """What equal meshes have in common: the path, or the arrays themselves."""
    return str(mesh) if isinstance(mesh, Path | str) else id(mesh)


def _entry(obj_id: int, mesh: Mesh, unit: float) -> CatalogEntry:
    if isinstance(mesh, Path | str):
        shape, found, _ = read_mesh(Path(mesh), unit)
        return _drawn(obj_id, Path(mesh).stem, shape, found.complete(GREY.metallic, GREY.roughness))
    vertices, faces = (np.asarray(array) for array in mesh)
    corners = vertices.astype(np.float64)[faces.astype(np.int64)] * unit
    return _drawn(obj_id, f"object_{obj_id}", make_mesh(Patch(corners, np.zeros((len(corners), 3, 2))), centered=False), GREY)


def _drawn(obj_id: int, name: str, mesh: TriangleMesh, material: Material) -> CatalogEntry:
    """Entry without mass and collision shape."""
    radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
    zero = np.zeros(3)
    return CatalogEntry(obj_id, name, mesh, material, (), 0.0, radius, 0.0, zero, np.zeros((3, 3)), 2 * radius, (), (), None)
