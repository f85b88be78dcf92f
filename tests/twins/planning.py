"""Synthetic images of piles, segmented by OpenCV, and NumPy reference implementations of grasp planning."""

import itertools
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from synpick_warp.configs.schema import Perception
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.arrays import allocate, allocate_struct, count_words, unpack_words
from synpick_warp.stages.perception.images import Observation, PerceptionArrays, Plan
from synpick_warp.stages.perception.perceive import GraspPlanner
from synpick_warp.stages.render.cameras import build_cameras
from synpick_warp.stages.render.scene import build_grid
from synpick_warp.stages.render.view_setup import GBUFFER
from synpick_warp.stages.sim.worlds import AttemptState
from tests.harness.aimed_views import aimed_views
from tests.twins import perception
from tests.worlds import kernel_worlds

FOCAL = 100.0
CAPACITY = 1024
"""Capacity for contour points."""
SETTINGS = {
    "contour_offset": 3.0,
    "deep_distance": 0.02,
    "deep_weight": 0.1,
    "min_votes": 5.0,
    "reach": 1.2,
    "exact_cycle": 10,
    "normal_window": 10,
}


def paint(rectangles: list[tuple[float, ...]], height: int = 90, width: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Images of axis-aligned rectangles (left, top, right, bottom, depth): ids (H, W), -1 for none, and depths (H, W) [m]."""
    return paint_shapes([(np.array([(a, b), (c, b), (c, d), (a, d)]), (0.0, 0.0, z)) for a, b, c, d, z in rectangles], height, width)


def paint_shapes(shapes: list[tuple[np.ndarray, tuple[float, float, float]]], height: int = 90, width: int = 120):
    """As `paint`, for polygons (corners (n, 2), (slope along columns, slope along rows, depth at column 0 and row 0))."""
    ids, depth = np.full((height, width), -1), np.full((height, width), 2.5)
    rows, columns = np.mgrid[:height, :width]
    for i, (corners, (along, down, base)) in enumerate(shapes):
        mask = np.zeros((height, width), np.uint8)
        cv2.fillPoly(mask, [np.asarray(corners, np.int32)], 1)
        plane = base + along * columns + down * rows
        nearer = (mask == 1) & (plane < depth)
        ids[nearer], depth[nearer] = i, plane[nearer]
    return ids, depth.astype(np.float32)


def mosaic(count: int, width: int, height: int, seed: int) -> np.ndarray:
    """Voronoi cells of random points as ids (H, W), some of them in no place; -1: between them."""
    numbers = np.random.default_rng(seed)
    points = numbers.uniform((0, 0), (width, height), (count, 2))
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    away = np.hypot(columns[..., None] - points[:, 0], rows[..., None] - points[:, 1])
    nearest = np.argmin(away, axis=-1)
    return np.where(np.min(away, axis=-1) < 0.045 * width, numbers.permutation(count)[nearest], -1)


class PlannerHarness:
    """One view a world: a `GraspPlanner` and the segmentation of synthetic images, computed by OpenCV, that it reads."""

    def __init__(
        self,
        device: Any,
        ids: list[np.ndarray],
        depths: list[np.ndarray],
        instances: int,
        settings: dict | None = None,
        diagonal: float | np.ndarray = 10.0,
    ) -> None:
        ids, depths = np.stack(ids), np.stack(depths)
        self.views, height, width = ids.shape
        self.worlds = kernel_worlds.KernelWorlds(device, self.views, instances, radius=np.full(instances, diagonal))
        self.worlds.put(catalog_index=np.arange(instances))
        kernel_worlds.filled(self.worlds.scene.perception, {**SETTINGS, **(settings or {})})
        sizes = {"view": self.views, "world": self.views, "instance": instances, "row": height, "column": width, "point": CAPACITY}
        sizes["word"] = count_words(instances)
        self.arrays, self.observation = allocate(PerceptionArrays, sizes, device), allocate(Observation, sizes, device)
        self.grasp, self.attempts = allocate(Plan, sizes, device), allocate(AttemptState, sizes, device)
        self.gbuffer = allocate_struct(GBUFFER, sizes, device)
        self.gbuffer.segment.assign((ids + 1).astype(np.uint8))
        self.gbuffer.depth.assign(depths)
        camera = Camera(width, height, np.array([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1.0]]), np.eye(3), np.zeros(3))
        cameras = build_cameras((camera,), device)
        self.images: Any = SimpleNamespace(
            scene=SimpleNamespace(grid=build_grid(width, height)),
            views=aimed_views(range(self.views), [0] * self.views, instances, cameras, device),
            gbuffer=self.gbuffer,
        )
        self.expected = segment(ids, depths, instances)
        for name in ("component", "largest", "contour", "contour_length"):
            getattr(self.arrays, name).assign(self.expected[name])
        for name in ("visible", "grasp_pixel", "depth", "visible_fraction"):
            getattr(self.observation, name).assign(self.expected[name])
        self.scene = self.worlds.scene
        self.planner = GraspPlanner(Perception(exact_cycle=self.scene.perception.exact_cycle), self.images, self.arrays)

    @classmethod
    def unseen(cls, device: Any, views: int, instances: int, **options: Any) -> "PlannerHarness":
        """Views that show nothing, for tests that set the observation."""
        return cls(device, [np.full((4, 4), -1)] * views, [np.ones((4, 4))] * views, instances, **options)

    def votes(self) -> np.ndarray:
        """Occlusion votes (V, I, I)."""
        self.planner.bound_contours(self.scene, self.worlds.state, self.observation)
        self.planner.count_votes(self.scene, self.observation)
        self.planner.weigh_votes(self.scene, self.observation)
        return self.observation.votes.numpy()

    def graph(self, votes: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Edges and paths of the clutter graph (view, instance, instance) bool: [v, i, j] means j above i."""
        if votes is None:
            self.votes()
        else:
            self.observation.votes.assign(votes)
        self.planner.order_clutter(self.scene, self.observation)
        sets = (self.observation.above, self.observation.ancestors)
        return tuple(unpack_words(array.numpy(), self.arrays.largest.shape[1]) == 1 for array in sets)

    def choose(self, seed: int = 0) -> list[int]:
        """Target of each world."""
        worlds = self.worlds
        self.planner.choose_target(self.scene, worlds.state, self.attempts, self.observation, self.grasp, seed)
        return self.grasp.target.numpy().tolist()

    def choose_flat_points(self, seed: int) -> None:
        """Replace the grasp points of instance 0 of each world by points on flat surface."""
        self.grasp.target.zero_()
        self.planner.choose_flat_points(self.scene, self.worlds.state, self.attempts, self.observation, self.grasp, seed)


def segment(ids: np.ndarray, depths: np.ndarray, instances: int) -> dict[str, np.ndarray]:
    """Components, contours and grasp points (the poles) of images of ids (V, H, W), by OpenCV and SciPy."""
    views, height, width = ids.shape
    result = {
        "component": np.full(ids.shape, -1, np.int32),
        "largest": np.full((views, instances), -1, np.int32),
        "contour": np.zeros((views, instances, CAPACITY, 2), np.int32),
        "contour_length": np.zeros((views, instances), np.int32),
        "visible": np.zeros((views, instances), np.int32),
        "distance": np.zeros(ids.shape, np.float32),
        "grasp_pixel": np.zeros((views, instances, 2), np.int32),
        "depth": np.zeros((views, instances), np.float32),
    }
    for view in range(views):
        labels = result["component"][view] = perception.label_components(ids[view] + 1, instances)
        for i in range(instances):
            result["largest"][view, i] = largest = perception.largest_label(labels, ids[view] + 1, i)
            if largest < 0:
                continue
            mask = labels == largest
            points, distance = perception.contour(mask), np.sqrt(perception.squared_distance(mask))
            result["contour"][view, i, : len(points)], result["contour_length"][view, i] = points, len(points)
            result["distance"][view] += distance.astype(np.float32)
            row, column = np.unravel_index(np.argmax(distance), distance.shape)
            result["visible"][view, i] = mask.sum()
            result["grasp_pixel"][view, i], result["depth"][view, i] = (column, row), depths[view, row, column]
    return result | {"visible_fraction": (result["visible"] / (height * width)).astype(np.float32)}


def votes(harness: PlannerHarness, diagonal: float | np.ndarray) -> np.ndarray:
    """Occlusion votes (V, I, I) by definition; one diagonal for all instances or one each (I,) [m]."""
    rule, expected = SETTINGS, harness.expected
    with np.errstate(divide="ignore"):
        reach = rule["reach"] * np.asarray(diagonal) * FOCAL / expected["depth"]
    codes, depths = harness.gbuffer.segment.numpy().astype(int) - 1, harness.gbuffer.depth.numpy()
    result = np.zeros(harness.observation.votes.shape)
    for view, i in np.argwhere(expected["contour_length"] > 0):
        line = expected["contour"][view, i, : expected["contour_length"][view, i]].astype(float)
        tangent = np.roll(line, -3, axis=0) - np.roll(line, 3, axis=0)
        length = np.linalg.norm(tangent, axis=1)
        line, tangent, length = line[length > 0], tangent[length > 0], length[length > 0]
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) / length[:, None]
        inner, outer = (np.floor(line + s * rule["contour_offset"] * normal + 0.5).astype(int) for s in (-1, 1))
        size = np.array(codes.shape[:0:-1])
        fits = ((inner >= 0) & (outer >= 0) & (inner < size) & (outer < size)).all(axis=1)
        for a, b in zip(inner[fits], outer[fits], strict=True):
            j = codes[view, b[1], b[0]]
            nearer = depths[view, b[1], b[0]] < depths[view, a[1], a[0]]
            if expected["component"][view, a[1], a[0]] == expected["largest"][view, i] and j not in (-1, i) and nearer:
                other = expected["contour"][view, j, : expected["contour_length"][view, j]]
                if np.linalg.norm(other - b, axis=1).max() > reach[view, j]:
                    continue
                deep = depths[view, b[1], b[0]] > expected["depth"][view, i] + np.float32(rule["deep_distance"])
                result[view, i, j] += rule["deep_weight"] if deep else 1.0
    return result


def net_weights(votes_: np.ndarray, least: float) -> np.ndarray:
    """Weights [i, j] of edges from j to i, from votes [i, j]."""
    kept = np.where(votes_ >= least, votes_, 0.0)
    return np.maximum(kept - kept.T, 0.0)


def heaviest_by_orders(weights: np.ndarray) -> float:
    """Weight of the heaviest acyclic subset, by enumerating every order of the objects."""
    ranks = (np.argsort(order) for order in itertools.permutations(range(len(weights))))
    return max(weights[rank[None, :] < rank[:, None]].sum() for rank in ranks)


def greedy_order(weights: np.ndarray) -> list[int]:
    """Order of a greedy feedback arc set, the uppermost first: sources first, sinks last, else the largest gain; ties by index."""
    left, first, last = list(range(len(weights))), [], []
    while left:
        inner = weights[np.ix_(left, left)]
        leaving, entering = inner.sum(axis=0), inner.sum(axis=1)
        gain = np.where((leaving == 0) | (entering == 0), np.inf, leaving - entering)
        place = int(np.argmax(gain))
        if entering[place] > 0 and leaving[place] == 0:
            last.insert(0, left.pop(place))
        else:
            first.append(left.pop(place))
    return first + last


def choose_target(visible: np.ndarray, fraction: np.ndarray, above: np.ndarray, targeted: bool) -> int:
    """Instance to pick, or -1. `above` is the number of ancestors of each."""
    sign = -1 if targeted else 1
    return min((i for i in range(len(visible)) if visible[i] > 0), key=lambda i: (sign * above[i], -sign * fraction[i], i), default=-1)


def gripper_angles(normal: np.ndarray) -> tuple[float, float]:
    """Yaw and tilt [rad] for a unit normal that is not vertical, by trying both directions of the wrist axis."""
    for tilt in (np.arccos(normal[2]), -np.arccos(normal[2])):
        yaw = np.arctan2(normal[1] / np.sin(tilt), normal[0] / np.sin(tilt))
        if -np.pi / 2 < yaw <= np.pi / 2:
            return yaw, tilt
    raise AssertionError(normal)
