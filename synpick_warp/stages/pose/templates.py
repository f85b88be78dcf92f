"""Depth templates of objects, rendered by the rasterizer, and the search over them that starts single-frame estimates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.kernels.pose.templates import (
    EMPTY,
    TEMPLATE,
    TEMPLATE_MARGIN,
    Probes,
    Search,
    Templates,
    choose_placements_kernel,
    sample_probes_kernel,
    search_templates_kernel,
)
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.pose.models import PoseModels
from synpick_warp.stages.pose.observe import Observer
from synpick_warp.stages.pose.render import object_scene, render_object
from synpick_warp.stages.render.scene import build_meshes

DISTANCE = 8.0
"""Distance of template cameras from an object's origin, in diameters: large bin objects are seen from seven, small ones from twenty."""

TEMPLATES = struct_arrays(
    Templates, "direction", depth=("model", "direction", "row", "column"), width=("model",), units={"depth": "m", "width": "m"}
)
PROBES = struct_arrays(
    Probes, "instance", inside=("instance", "inside"), outside=("instance", "outside"), units={"inside": "m", "outside": "m"}
)


@dataclass(frozen=True)
class SearchSettings:
    """Settings of the template search: directions, rotations and shifts, compared points, tolerances in depth."""

    directions: int = 96
    """Viewing directions, spread over the sphere: 20° apart."""
    rotations: int = 18
    """Number of in-plane rotations, about the optical axis: 20° apart."""
    shifts: int = 3
    """Shifts to each side along either axis."""
    shift: float = 0.09
    """Step of the shifts relative to the diameter."""
    inside: int = 48
    """Observed points that are compared."""
    outside: int = 256
    """Capacity for pixels beside the mask that are compared; a square number."""
    truncation: float = 0.02
    """Depth difference at which a point counts as unexplained [m]."""
    margin: float = 0.02
    """Depth by which the template may lie in front of what is seen beside the mask [m]."""


class TemplateSearch:
    """Finds starting poses in single views. Owns its scratch; `search` only launches kernels."""

    def __init__(self, templates: Any, observer: Observer, hypotheses: int, settings: SearchSettings) -> None:
        """
        Args:
            templates: The struct `Templates`, of as many directions as the settings name.
            observer: Observes the instances.
            hypotheses: Poses found per instance.
            settings: Grid and costs.
        """
        self.observer, self.hypotheses, self.settings, self.device = observer, hypotheses, settings, observer.device
        self.templates = templates
        n = observer.instances
        self.probes = allocate_struct(PROBES, {"instance": n, "inside": settings.inside, "outside": settings.outside}, self.device)
        shape = (n, settings.directions, settings.rotations)
        self.cost = wp.zeros(shape, dtype=float, device=self.device)
        self.offset = wp.zeros(shape, dtype=wp.vec3, device=self.device)
        self.parameters = Search()
        for name in ("rotations", "shifts", "shift", "truncation", "margin"):
            setattr(self.parameters, name, getattr(settings, name))

    def search(self, pose: wp.array) -> None:
        """Write the best poses (pose): `hypotheses` for each instance."""
        observer, device = self.observer, self.device
        inputs = [observer.images, observer.targets, observer.observation]
        wp.launch(sample_probes_kernel, dim=observer.instances, inputs=inputs, outputs=[self.probes], device=device)
        inputs = [self.templates, self.parameters, observer.targets, self.probes]
        outputs = [self.cost, self.offset]
        wp.launch(search_templates_kernel, dim=self.cost.shape, inputs=inputs, outputs=outputs, device=device)
        inputs = [self.templates, self.parameters, observer.observation, self.probes, self.offset, self.hypotheses]
        outputs = [self.cost, pose]
        wp.launch(choose_placements_kernel, dim=observer.instances, inputs=inputs, outputs=outputs, device=device)


def sphere_directions(count: int) -> np.ndarray:
    """Rotations object to camera (D, 4) float32, x y z w, whose viewing directions are spread over the sphere (Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * index / count), np.pi * (1.0 + np.sqrt(5.0)) * index
    return Rotation.from_euler("ZX", np.stack([azimuth, polar], axis=1)).inv().as_quat().astype(np.float32)


def render_templates(models: PoseModels, directions: int, device: wp.Device) -> Any:
    """Render the struct `Templates`: depth images of every object alone, from all directions."""
    size = int(TEMPLATE)
    rotation = sphere_directions(directions)
    result = allocate_struct(TEMPLATES, {"model": len(models.objects), "direction": directions, "row": size, "column": size}, device)
    result.rotation.assign(rotation)
    result.width.assign((models.diameters * float(TEMPLATE_MARGIN) / size).astype(np.float32))
    meshes, keep = build_meshes([item.mesh for item in models.objects], len(models.objects), device)
    depth = np.empty(result.depth.shape, np.float32)
    for row, diameter in enumerate(models.diameters):
        cameras = tuple(template_camera(matrix, diameter) for matrix in Rotation.from_quat(rotation).as_matrix())
        scene = object_scene(meshes, keep, cameras, device)
        depth[row] = render_object(scene, row).depth.numpy() - np.float32(DISTANCE * diameter)
    depth[depth > DISTANCE * models.diameters.max()] = float(EMPTY)
    result.depth.assign(depth)
    return result


def template_camera(rotation: np.ndarray, diameter: float) -> Camera:
    """Camera with a rotation from the object (3, 3) that looks at its origin, and whose image is as wide as the object with its margin."""
    size, distance = int(TEMPLATE), DISTANCE * diameter
    focal = size * DISTANCE / float(TEMPLATE_MARGIN)
    matrix = np.array([[focal, 0.0, size / 2.0], [0.0, focal, size / 2.0], [0.0, 0.0, 1.0]])
    return Camera(size, size, matrix, rotation, np.array([0.0, 0.0, distance]))
