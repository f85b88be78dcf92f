"""Annotation layers (AOVs) of a batch of views: those named in `render.layers`, computed from the G-buffer; active stereo cameras: the
infrared pair, and stereo matching, a few views at a time; and suctionable surface area of objects: low-discrepancy surface samples, each
scored as the layer of seals scores a pixel."""

import math
import pkgutil
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import MAX_DISPARITIES
from synpick_warp.configs.cell.cameras import DepthSensor
from synpick_warp.errors import CatalogError
from synpick_warp.kernels.render.images import layers
from synpick_warp.kernels.render.images.camera_effects import SensorParameters
from synpick_warp.kernels.render.images.clear_bodies import measure_behind_kernel, see_through_kernel
from synpick_warp.kernels.render.images.depth_sensor import find_nearest_kernel, render_depth_sensor_kernel
from synpick_warp.kernels.render.images.infrared import render_infrared_kernel
from synpick_warp.kernels.render.images.multipath import add_multipath_kernel
from synpick_warp.kernels.render.images.stereo_matching import (
    WARP,
    MatchingScratch,
    match_left_kernel,
    match_right_kernel,
    measure_depth_kernel,
    sum_path_costs_kernel,
    transform_census_kernel,
)
from synpick_warp.kernels.render.images.suction_map import render_suction_seal_kernel, render_suction_wrench_kernel, score_points_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_HEIGHT, TILE_PIXELS
from synpick_warp.kernels.render.visibility.gbuffer import FAR
from synpick_warp.kernels.render.visibility.variants import kernel_for
from synpick_warp.scenes.types import FIRST_DISTRACTOR, Catalog, TriangleMesh
from synpick_warp.stages.arrays import allocate, allocate_struct, device_array, struct_arrays
from synpick_warp.stages.buffers import FIXTURES, LayerBuffers, Snapshot
from synpick_warp.stages.launch import launch, launch_pixels, launch_views
from synpick_warp.stages.render.scene import RenderScene, build_meshes, face_normals
from synpick_warp.system.random_numbers import sample_triangles
from synpick_warp.views.layers import LAYER_TABLE

EYES = ("ir_left", "ir_right")
DEPTH = "depth_stereo"
STEREO_LAYERS = {*EYES, DEPTH}
"""Layers of an active stereo camera."""
DIRECTIONS = 4
"""Directions of paths: right, left, down and up."""
GPU_SLOTS, CPU_SLOTS = 8, 1
"""Views that are matched at a time: their paths, a warp each, fill the multiprocessors of a GPU."""
MAX_COSTS = 1 << 30
"""Elements of the cost volumes of these views together, 2 bytes each, above which fewer are matched at a time."""


@dataclass(frozen=True, eq=False)
class InfraredImages:
    """Infrared pair, where it is no layer itself."""

    ir_left: wp.array = device_array("view", "row", "column", dtype=wp.uint8)
    ir_right: wp.array = device_array("view", "row", "column", dtype=wp.uint8)


MATCHING = struct_arrays(
    MatchingScratch, "slot", "row", "column", census=("slot", "eye", "row", "column"), cost=("slot", "row", "column", "disparity")
)


def count_disparities(max_disparity: float) -> int:
    """Disparities that are searched, from that of the farthest depth on: up to `max_disparity` [px], if it is set, and MAX_DISPARITIES."""
    return min(math.ceil(max_disparity) + 2, MAX_DISPARITIES) if max_disparity > 0.0 else MAX_DISPARITIES


class StereoRenderer:
    """Renders infrared pairs and matches them. Owns its scratch; `render` only launches, so a CUDA graph can capture it."""

    def __init__(self, names: tuple[str, ...], sensor: Any, scene: RenderScene, views: int) -> None:
        """Allocate scratch. `names`: layers to render; those that are none of `STEREO_LAYERS` are ignored. `sensor`: the struct
        `SensorParameters`. `scene`: constant data. `views`: largest number of views in a batch."""
        self.scene, self.sensor = scene, sensor
        self.matches = DEPTH in names
        disparities = count_disparities(sensor.max_disparity)
        most = MAX_COSTS // (scene.height * scene.width * disparities)
        self.slots = max(1, min(views, GPU_SLOTS if scene.device.is_cuda else CPU_SLOTS, most))
        sizes = {"view": views, "slot": self.slots, "eye": len(EYES), "row": scene.height, "column": scene.width, "disparity": disparities}
        self.eyes = [eye for eye in EYES if eye in names or self.matches]
        self.images = allocate(InfraredImages, sizes, scene.device, set(self.eyes) - set(names))
        self.scratch: Any = allocate_struct(MATCHING, sizes, scene.device) if self.matches else None

    def render(self, shot: Any, out: LayerBuffers, behind: Any) -> None:
        """Render the infrared images of a batch of views, and match them; arguments as of `LayerRenderer.render`."""
        scene, views = self.scene, shot.views
        pixels = views.count * scene.grid.tiles * int(TILE_PIXELS)
        own = [getattr(self.images, eye) for eye in self.eyes]
        images = {eye: getattr(out, eye) if image is None else image for eye, image in zip(self.eyes, own, strict=True)}
        for eye, image in images.items():
            kernel, more = (render_infrared_kernel, ()) if behind is None else (see_through_kernel, (behind.bodies, behind.gbuffer))
            launch_pixels(kernel, pixels, [scene.paths, self.sensor, shot, *more, EYES.index(eye)], [image], scene.device)
        if self.scratch is not None:
            for first in range(0, views.count, self.slots):
                self.match(first, min(self.slots, views.count - first), views, list(images.values()), out.depth_stereo)

    def match(self, first_view: int, count: int, views: Any, images: list[wp.array], depth: wp.array) -> None:
        """Match the left and right images of `count` views, at most as many as there are slots."""
        grid, sensor, scratch, device = self.scene.grid, self.sensor, self.scratch, self.scene.device
        pixels = count * grid.tiles * int(TILE_PIXELS)
        launch_pixels(transform_census_kernel, len(EYES) * pixels, [grid, *images, first_view], [scratch.census], device)
        lanes = WARP if device.is_cuda else 1
        for direction in range(DIRECTIONS):
            lines = grid.height if direction < DIRECTIONS // 2 else grid.width
            inputs = [sensor, views, first_view, direction, lines, lanes]
            launch_views(sum_path_costs_kernel, count * lines, lanes, inputs, [scratch], device)
        for kernel in (match_right_kernel, match_left_kernel):
            launch_pixels(kernel, pixels, [grid, sensor, views, first_view], [scratch], device)
        launch_pixels(measure_depth_kernel, pixels, [grid, sensor, views, scratch.disparity, first_view], [depth], device)


MAX_CLASS = 65535
"""Largest obj_id that fits into the layer `classes`."""
MOTION_LAYERS = {"flow", "scene_flow"}
"""Layers computed from the motions of bodies."""
SENSOR = "depth_sensor"
KERNELS = {
    "normals": layers.render_normals_kernel,
    "albedo": layers.render_albedo_kernel,
    "nocs": layers.render_nocs_kernel,
    "classes": layers.render_classes_kernel,
    "flow": layers.render_flow_kernel,
    "scene_flow": layers.render_scene_flow_kernel,
    "suction_seal": render_suction_seal_kernel,
    "suction_wrench": render_suction_wrench_kernel,
}
"""Kernel of each layer of ours but SENSOR and those of `STEREO_LAYERS`."""
BODY_MOTIONS = struct_arrays(layers.BodyMotions, "view", "body", units={"origin": "m", "displacement": "m"})


@dataclass(frozen=True, eq=False)
class SensorScratch:
    """Least depths for the search of shadows, and the depth image of the scene behind transparent bodies."""

    nearest: wp.array = device_array("view", "tile_row", dtype=wp.float32, unit="m")
    behind: wp.array = device_array("view", "row", "column", dtype=wp.uint16)


def sensor_parameters(settings: DepthSensor, seed: int, depth_scale: float) -> Any:
    """The struct `SensorParameters`, for a bake's seed and its depth scale [mm per count]."""
    result = SensorParameters()
    same = ("baseline", "disparity_step", "disparity_noise", "max_disparity", "noise", "noise_growth", "noise_distance", "noise_angle")
    for name in (*same, "lateral_noise", "noise_width", "registration", "clear_reach"):
        setattr(result, name, getattr(settings, name))
    result.seed = seed
    result.near, result.far = settings.distances
    result.grazing_cosine = math.cos(math.radians(settings.grazing_angle))
    result.edge_width, result.edge_step = settings.edge_width, settings.edge_step
    result.shadows = int(settings.shadows)
    result.counts_per_meter = 1000.0 / depth_scale
    result.projector = settings.projector * settings.baseline
    for name in ("dot_spacing", "dot_brightness", "ambient", "infrared_noise"):
        setattr(result, name, getattr(settings, name))
    return result


def layer_scene(scene: RenderScene) -> Any:
    """The struct `LayerScene` without sensor and motions."""
    layer = layers.LayerScene()
    layer.obj_id, layer.suction = scene.obj_id, scene.suction_maps
    return layer


class LayerRenderer:
    """Renders annotation layers. Owns its scratch; `render` only launches, so a CUDA graph can capture it."""

    def __init__(self, names: tuple[str, ...], sensor: Any, scene: RenderScene, instances: int, views: int, multipath: float = 0.0) -> None:
        """Allocate scratch, if a layer needs motions. `names`: layers to render, from `layers.LAYER_TABLE`. `sensor`: the struct
        `SensorParameters`. `scene`: constant data. `instances`: instance capacity of a world. `views`: largest number of views in a batch.
        `multipath`: setting of the depth sensor, not in `sensor`, as only one kernel uses it. Raises CatalogError: `names` has classes, and
        an obj_id is 0 or does not fit into 16 bits."""
        self.scene = scene
        self.names = names
        self.sensor, self.multipath = sensor, multipath
        if "classes" in names:
            wrong = [obj_id for obj_id in scene.obj_id.numpy().tolist() if not 0 < obj_id <= MAX_CLASS and obj_id > FIRST_DISTRACTOR]
            if wrong:
                raise CatalogError(f"object {wrong[0]} has no place in the layer classes, which holds 1 to {MAX_CLASS}; renumber the model")
        self.motions = None
        if MOTION_LAYERS.intersection(names):
            self.motions = allocate_struct(BODY_MOTIONS, {"view": views, "body": instances + len(FIXTURES) + 1}, scene.device)
        sizes = {"view": views, "tile_row": -(-scene.height // int(TILE_HEIGHT)), "row": scene.height, "column": scene.width}
        wanted = {"nearest": SENSOR in names, "behind": SENSOR in names and scene.is_transparent and sensor.clear_reach > 0.0}
        self.scratch = allocate(SensorScratch, sizes, scene.device, {name for name in wanted if wanted[name]})
        self.stereo = StereoRenderer(names, sensor, scene, views) if STEREO_LAYERS.intersection(names) else None
        self.sees_through = wanted["behind"] or (self.stereo is not None and scene.is_transparent)

    def render(self, snapshot: Snapshot, shot: Any, out: LayerBuffers, last: Any, behind: Any = None) -> None:
        """Render the layers of a batch of views. `snapshot`: the worlds. `shot`: the struct `ShotData`. `out`: the arrays of the named
        layers are written. `last`: the cameras of the views in the frame before, as those of the views; the same if they do not move.
        `behind`: the struct `ShotData` of what is behind transparent bodies, where layers see through them."""
        scene, layer, views = self.scene, layer_scene(self.scene), shot.views
        layer.sensor, layer.follows = self.sensor, snapshot.follows
        if self.motions is not None:
            layer.motions = self.motions
            inputs = [snapshot.bundle, views, last.rotation, last.center]
            dim = (views.count, layer.motions.known.shape[1])
            wp.launch(
                kernel_for(layers.compute_motions_kernel, views), dim=dim, inputs=inputs, outputs=[layer.motions], device=scene.device
            )
        for name in self.names:
            if name == SENSOR:
                self.measure_depth(layer, shot, out.depth_sensor, behind)
            elif name not in STEREO_LAYERS:
                pixels = views.count * scene.grid.tiles * int(TILE_PIXELS)
                kernel = KERNELS.get(name) or pkgutil.resolve_name(LAYER_TABLE[name].kernel)
                launch_pixels(kernel, pixels, [scene.paths, layer, shot], [getattr(out, name)], scene.device)
        if self.stereo is not None:
            self.stereo.render(shot, out, behind)

    def measure_depth(self, layer: Any, shot: Any, image: wp.array, behind: Any) -> None:
        """Simulate the depth sensor; arguments as of `render`, and the struct `LayerScene`."""
        scene, pixels = self.scene, shot.views.count * self.scene.grid.tiles * int(TILE_PIXELS)
        layer.nearest, further = self.scratch.nearest, self.scratch.behind
        for seen, measured in ((shot, image),) if further is None else ((shot, image), (behind, further)):
            layer.nearest.fill_(FAR)
            dim, inputs = (shot.views.count, scene.grid.tiles), [scene.grid, seen.gbuffer]
            wp.launch(find_nearest_kernel, dim=dim, inputs=inputs, outputs=[layer.nearest], device=scene.device)
            launch_pixels(render_depth_sensor_kernel, pixels, [scene.paths, layer, seen], [measured], scene.device)
            if self.multipath > 0.0:
                launch_pixels(add_multipath_kernel, pixels, [scene.paths, layer, seen, self.multipath], [measured], scene.device)
        if further is not None:
            inputs = [scene.paths, layer, shot, behind.gbuffer.depth, further]
            launch_pixels(measure_behind_kernel, pixels, inputs, [image], scene.device)


SAMPLES = 1024
"""Sample points of an object: random ones would give the fraction a standard error of at most 1.6 %; these are more even."""
SUCTIONABLE_SEAL = 0.5
"""Least seal score of a suctionable point: the heights of the lip deviate by 2.6 mm (root mean square), exp(-1e5 · 0.0026²) = 0.5."""


def with_suctionable_area(catalog: Catalog, radius: float) -> Catalog:
    """Copy of a catalog with the area, and share of the surface, on which a cup of `radius` [m] seals: estimated on the CPU, so that no bit
    depends on the bake's device."""
    device = wp.get_device("cpu")
    meshes, keep = build_meshes([entry.mesh for entry in catalog.entries], len(catalog.entries), device)
    samples = [_sample(entry.mesh) for entry in catalog.entries]
    seal = wp.zeros(SAMPLES * len(samples), dtype=wp.float32, device=device)
    point, normal = (wp.array(np.concatenate(parts), dtype=wp.vec3, device=device) for parts in list(zip(*samples, strict=True))[:2])
    given = {"meshes": meshes, "radius": radius, "samples": SAMPLES, "point": point, "normal": normal, "seal_out": seal}
    launch(score_points_kernel, len(seal), **given)
    fractions = (seal.numpy().reshape(-1, SAMPLES) >= SUCTIONABLE_SEAL).mean(axis=1)
    del keep
    areas = [area for _, _, area in samples]
    rows = zip(catalog.entries, areas, fractions.tolist(), strict=True)
    return replace(catalog, entries=tuple(replace(entry, suctionable=(area * share, share)) for entry, area, share in rows))


def _sample(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray, float]:
    """Sample a mesh uniformly by area: points [m] and unit face normals, each (SAMPLES, 3) float32, and surface area [m²]."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face, weights = sample_triangles(areas, SAMPLES)
    return np.einsum("sk,skc->sc", weights, corners[face]).astype(np.float32), face_normals(mesh)[face], float(areas.sum())
