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
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.system.hardware.device import pick_device, start_warp
from synpick_warp.views.layers import LAYER_TABLE

GREY = Material((0.7, 0.7, 0.7), None, 0.0, 0.6)
"""Material of arrays, and of files without one."""
Mesh = Path | str | tuple[np.ndarray, np.ndarray]


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
    start_warp()
    settings, on = replace(settings, render=replace(settings.render, layers=tuple(layers))), pick_device(device)
    meshes = {_key(mesh): mesh for mesh, _ in objects}
    catalog = Catalog(tuple(_entry(index + 1, mesh, unit) for index, mesh in enumerate(meshes.values())))
    fixtures = make_fixtures(make_bins(settings.cell.bins), settings.gripper)
    lights, looks = load_lights(settings.bake.lights)[:1], load_looks(settings.randomize, lambda line: None, strict=True)
    scene = build_render_scene(settings.render, 0.0, catalog, fixtures, tuple(cameras), lights, on, looks)
    sizes = view_buffer_sizes(len(cameras), *cameras[0].resolution, len(objects))
    images, extra = allocate(ViewBuffers, sizes, on), allocate(LayerBuffers, sizes, on, layers)
    world = _world([list(meshes).index(_key(mesh)) for mesh, _ in objects], [pose for _, pose in objects], on)
    shown = first_views(len(cameras), len(cameras), len(objects), on, scene.cameras)
    make_renderer(settings, scene, len(objects), len(cameras)).render(world, shown, images, extra if layers else None)
    return {"color": images.color, "depth": images.depth, "instance": images.instance} | {name: getattr(extra, name) for name in layers}


def _key(mesh: Mesh) -> object:
    """What equal meshes have in common: the path, or the arrays themselves."""
    return str(mesh) if isinstance(mesh, Path | str) else id(mesh)


def _world(rows: Sequence[int], poses: Sequence[Any], device: wp.Device) -> Snapshot:
    """One world with these objects and neither bin nor gripper."""
    world = allocate(Snapshot, {"world": 1, "instance": len(rows), "fixture": len(FIXTURES)}, device)
    matrices = np.stack([np.asarray(pose, float).reshape(4, 4) for pose in poses])
    placed = np.hstack([matrices[:, :3, 3], Rotation.from_matrix(matrices[:, :3, :3]).as_quat()]).astype(np.float32)
    for array in (world.catalog_index, world.last_catalog_index):
        array.assign(np.array([rows], np.int32))
    for array in (world.pose, world.last_pose):
        array.assign(placed[None])
    world.live.fill_(1)
    return world


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
