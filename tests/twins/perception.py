"""NumPy and OpenCV reference implementations of segmentation and grasp points, and a harness that feeds synthetic images of ids."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import warp as wp
from scipy.ndimage import distance_transform_edt

from synpick_warp.configs.cell.cameras import Rig
from synpick_warp.configs.schema import Config, Perception
from synpick_warp.kernels import structs
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.perception.images import Observation, allocate_batch
from synpick_warp.stages.perception.perceive import Segmenter
from synpick_warp.stages.render.cameras import build_cameras
from synpick_warp.stages.render.scene import build_grid
from synpick_warp.stages.sim.worlds import world_sizes


class SegmenterHarness:
    """A `Segmenter` that gets synthetic images of segmentation ids in place of a rendered G-buffer. Instance i is catalog entry i."""

    def __init__(self, device: wp.Device, width: int, height: int, worlds: int = 1, instances: int = 4, **settings) -> None:
        config = Config()
        self.config = replace(
            config,
            perception=replace(config.perception, resolution=(width, height), **settings),
            bake=replace(config.bake, worlds=worlds),
            arrangement=replace(config.arrangement, max_objects=instances),
        )
        camera = make_cameras(Rig.of(replace(config.cameras, resolution=(width, height))))[0]
        self.focal = camera.matrix[[0, 1], [0, 1]]
        views, _, gbuffer, arrays, scratch = allocate_batch(self.config.perception, instances, worlds, device)
        self.images: Any = SimpleNamespace(
            scene=SimpleNamespace(device=device, cameras=build_cameras((camera,), device), grid=build_grid(width, height)),
            views=views,
            gbuffer=gbuffer,
            arrays=arrays,
            scratch=scratch,
        )
        self.images.views.count, self.images.views.instances = worlds, instances
        self.segmenter = Segmenter(self.images)
        self.mass, self.area = np.full(instances, 0.1), np.full(instances, 0.01)
        catalog, rules = structs.CatalogData(), structs.PerceptionData()
        catalog.count = instances
        catalog.mass = wp.zeros(instances, dtype=float, device=device)
        catalog.area = wp.zeros(instances, dtype=float, device=device)
        for name in ("center_fraction", "heavy_mass", "heavy_center_fraction"):
            setattr(rules, name, getattr(self.config.perception, name))
        self.scene: Any = SimpleNamespace(catalog=catalog, perception=rules)
        self.catalog_index = wp.array(np.tile(np.arange(instances), (worlds, 1)), dtype=wp.int32, device=device)
        self.observation = allocate(
            Observation, world_sizes(self.config.bake.worlds, self.config.arrangement.max_objects, self.config.move.rounds, 0, 1), device
        )

    def observe(self, *segments: np.ndarray, depth: np.ndarray | float = 2.0, worlds: list[int] | None = None) -> None:
        """Process images of segmentation ids (H, W), one a view, with a depth image or one depth [m]; by default of worlds 0, 1, ..."""
        views, gbuffer = self.images.views, self.images.gbuffer
        images = gbuffer.segment.numpy()
        for view, image in enumerate(segments):
            images[view] = image
        gbuffer.segment.assign(images)
        gbuffer.depth.assign(np.broadcast_to(np.float32(depth), images.shape))
        world = list(range(len(segments))) if worlds is None else worlds
        views.world.assign(np.array(world + [-1] * (views.count - len(world))))
        self.scene.catalog.mass.assign(self.mass)
        self.scene.catalog.area.assign(self.area)
        self.segmenter.find_grasp_points(self.scene, self.catalog_index, self.observation)

    def image(self, name: str, view: int = 0) -> np.ndarray:
        """A scratch array of one view."""
        return getattr(self.segmenter.arrays, name).numpy()[view]

    def result(self, name: str, instance: int = 0, world: int = 0) -> np.ndarray:
        """A field of an instance's observation."""
        return getattr(self.observation, name).numpy()[world, instance]

    def contour(self, instance: int = 0, view: int = 0) -> np.ndarray:
        """Points (n, 2) of an instance's contour."""
        return self.image("contour", view)[instance, : self.image("contour_length", view)[instance]]


def label_components(segments: np.ndarray, instances: int) -> np.ndarray:
    """Connected-component label of each pixel (H, W): the smallest row-major index of the component's pixels; -1: no instance."""
    result = np.full(segments.shape, -1)
    for instance in range(instances):
        count, labels = cv2.connectedComponents((segments == instance + 1).astype(np.uint8), connectivity=8)
        for label in range(1, count):
            result[labels == label] = np.flatnonzero(labels == label)[0]
    return result


def largest_label(labels: np.ndarray, segments: np.ndarray, instance: int) -> int:
    """Label of an instance's largest component; ties go to the smallest label; -1: not visible."""
    names, sizes = np.unique(labels[segments == instance + 1], return_counts=True)
    return int(names[np.argmax(sizes)]) if len(names) else -1


def squared_distance(mask: np.ndarray) -> np.ndarray:
    """Squared distance transform [px²] of a mask (H, W), beyond whose border all pixels are outside; 0 outside the mask."""
    return np.rint(distance_transform_edt(np.pad(mask, 1)) ** 2).astype(int)[1:-1, 1:-1]


def contour(mask: np.ndarray) -> np.ndarray:
    """Outer contour (n, 2) of a mask with one component."""
    (points,) = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    return points.reshape(-1, 2)


def centroid(points: np.ndarray) -> np.ndarray:
    """Centroid (2) of the polygon of a contour; the mean of its points where the area is zero."""
    moments = cv2.moments(points.reshape(-1, 1, 2).astype(np.int32))
    if moments["m00"] == 0.0:
        return points.mean(axis=0)
    return np.array([moments["m10"], moments["m01"]]) / moments["m00"]


def choose_grasp_point(mask: np.ndarray, mass: float, rules: Perception) -> dict[str, np.ndarray]:
    """Pole, centroid, midpoint, their distances to the contour, and the chosen pixel, of a mask with one component."""
    squared = squared_distance(mask)
    row, column = np.unravel_index(np.argmax(squared), mask.shape)
    pole = np.array([column, row], dtype=np.float32)
    center = centroid(contour(mask)).astype(np.float32)
    points = [pole, center, np.float32(0.5) * (pole + center)]
    pixels = np.rint(points).astype(int)
    distances = np.sqrt(squared[pixels[:, 1], pixels[:, 0]]).astype(np.float32)
    threshold = np.float32(rules.heavy_center_fraction if mass > rules.heavy_mass else rules.center_fraction)
    best = 1 if distances[1] >= distances[2] else 2
    chosen = pixels[best if distances[best] / distances[0] > threshold else 0]
    return {"pole": pole, "centroid": center, "midpoint": points[2], "distances": distances, "grasp_pixel": chosen}
