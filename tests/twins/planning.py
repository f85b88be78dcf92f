"""Images of piles made by hand, looked at by OpenCV, and twins of what is planned from them, in NumPy."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from synpick_warp.arrays import allocate
from synpick_warp.configs.schema import Config, Sight
from synpick_warp.kernels.render.visibility.gbuffer import Hits
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.perception.arrays import LookArrays, Plan, Sighting
from synpick_warp.stages.perception.plan import Planner
from synpick_warp.stages.render.scene import build_cameras, build_grid
from synpick_warp.stages.render.view_setup import HitArrays, filled
from synpick_warp.stages.sim.worlds import AttemptState
from tests.worlds import kernel_worlds

FOCAL = 100.0
ROOM = 1024
"""Points of a contour."""
SIGHT = {
    "contour_offset": 3.0,
    "deep_distance": 0.02,
    "deep_weight": 0.1,
    "min_votes": 5.0,
    "reach": 1.2,
    "exact_cycle": 10,
    "normal_window": 10,
}


def paint(rectangles: list[tuple[float, ...]], height: int = 90, width: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Images of upright rectangles (left, top, right, bottom, depth): identities (H, W), -1 for none, and depths (H, W) [m]."""
    return paint_shapes([(np.array([(a, b), (c, b), (c, d), (a, d)]), (0.0, 0.0, z)) for a, b, c, d, z in rectangles], height, width)


def paint_shapes(shapes: list[tuple[np.ndarray, tuple[float, float, float]]], height: int = 90, width: int = 120):
    """As `paint`, of polygons (corners (n, 2), (slope along columns, slope along rows, depth at column 0 and row 0))."""
    ids, depth = np.full((height, width), -1), np.full((height, width), 2.5)
    rows, columns = np.mgrid[:height, :width]
    for i, (corners, (along, down, base)) in enumerate(shapes):
        mask = np.zeros((height, width), np.uint8)
        cv2.fillPoly(mask, [np.asarray(corners, np.int32)], 1)
        plane = base + along * columns + down * rows
        nearer = (mask == 1) & (plane < depth)
        ids[nearer], depth[nearer] = i, plane[nearer]
    return ids, depth.astype(np.float32)


class Looks:
    """One view a world: what looking would have found in the images, and a planner for it."""

    def __init__(
        self,
        device: Any,
        ids: list[np.ndarray],
        depths: list[np.ndarray],
        instances: int,
        sight: dict | None = None,
        diagonal: float | np.ndarray = 10.0,
    ) -> None:
        ids, depths = np.stack(ids), np.stack(depths)
        self.views, height, width = ids.shape
        self.worlds = kernel_worlds.KernelWorlds(
            device,
            self.views,
            volume=np.full(instances, 0.1),
            compound=np.zeros(instances, int),
            radius=np.full(instances, diagonal),
            instances=instances,
            single_slots=instances,
            compound_slots=0,
        )
        self.worlds.set(self.worlds.state.entry, np.arange(instances))
        kernel_worlds.filled(self.worlds.scene.sight, {**SIGHT, **(sight or {})})
        sizes = {"view": self.views, "world": self.views, "instance": instances, "row": height, "column": width, "point": ROOM}
        self.look, self.sighting = allocate(LookArrays, sizes, device), allocate(Sighting, sizes, device)
        self.target, self.attempts = allocate(Plan, sizes, device), allocate(AttemptState, sizes, device)
        self.hits = allocate(HitArrays, sizes, device)
        self.hits.code.assign((ids + 1).astype(np.uint8))
        self.hits.depth.assign(depths)
        camera = Camera(width, height, np.array([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1.0]]), np.eye(3), np.zeros(3))
        self.seen: Any = SimpleNamespace(
            scene=None,
            look=self.look,
            hits=filled(Hits, self.hits),
            bodies=None,
            cameras=build_cameras((camera,), device),
            grid=build_grid(width, height),
        )
        self.found = look_at(ids, depths, instances)
        self.look.world.assign(np.arange(self.views))
        for name in ("component", "largest", "contour", "contour_length"):
            getattr(self.look, name).assign(self.found[name])
        for name in ("visible", "suction", "depth", "share"):
            getattr(self.sighting, name).assign(self.found[name])
        self.scene = self.worlds.scene
        self.planner = Planner(Config(sight=Sight(exact_cycle=self.scene.sight.exact_cycle)), self.seen, device)

    def votes(self) -> np.ndarray:
        self.planner.bound_contours(self.scene, self.seen, self.worlds.state, self.sighting)
        self.planner.count_votes(self.scene, self.seen, self.sighting)
        self.planner.weigh_votes(self.scene, self.seen, self.sighting)
        return self.sighting.votes.numpy()

    def graph(self, votes: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Edges and paths (view, instance, instance) bool: [v, i, j] means j above i."""
        if votes is None:
            self.votes()
        else:
            self.sighting.votes.assign(votes)
        self.planner.order_clutter(self.scene, self.seen, self.sighting)
        bits = np.arange(self.look.largest.shape[1])
        return tuple((array.numpy()[..., None] >> bits) & 1 == 1 for array in (self.sighting.above, self.sighting.all_above))

    def choose(self, seed: int = 0) -> list[int]:
        self.planner.choose_target(self.scene, self.seen, self.worlds.state, self.attempts, self.sighting, self.target, seed)
        return self.target.target.numpy().tolist()


def look_at(ids: np.ndarray, depths: np.ndarray, instances: int) -> dict[str, np.ndarray]:
    """Components, contours and suction points (the poles) of images (V, H, W), by OpenCV."""
    views, height, width = ids.shape
    found = {
        "component": np.full(ids.shape, -1, np.int32),
        "largest": np.full((views, instances), -1, np.int32),
        "contour": np.zeros((views, instances, ROOM, 2), np.int32),
        "contour_length": np.zeros((views, instances), np.int32),
        "visible": np.zeros((views, instances), np.int32),
        "suction": np.zeros((views, instances, 2), np.int32),
        "depth": np.zeros((views, instances), np.float32),
        "share": np.zeros((views, instances), np.float32),
    }
    for view, i in itertools.product(range(views), range(instances)):
        count, labels = cv2.connectedComponents((ids[view] == i).astype(np.uint8), connectivity=8)
        best = 0
        for label in range(1, count):
            mask = labels == label
            name = np.flatnonzero(mask)[0]
            found["component"][view][mask] = name
            if mask.sum() > best:
                best = mask.sum()
                found["largest"][view, i] = name
        if best == 0:
            continue
        mask = (found["component"][view] == found["largest"][view, i]).astype(np.uint8)
        outer, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        points = outer[0][:, 0]
        found["contour"][view, i, : len(points)], found["contour_length"][view, i] = points, len(points)
        distance = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        row, column = np.unravel_index(np.argmax(distance), distance.shape)
        found["visible"][view, i], found["share"][view, i] = best, best / (height * width)
        found["suction"][view, i], found["depth"][view, i] = (column, row), depths[view, row, column]
    return found


def votes(looks: Looks, diagonal: float | np.ndarray) -> np.ndarray:
    """Votes (V, I, I), from the rule; diagonals of all instances or of each (I,) [m]."""
    rule, found = {**SIGHT}, looks.found
    with np.errstate(divide="ignore"):
        reach = rule["reach"] * np.asarray(diagonal) * FOCAL / found["depth"]
    codes, depths = looks.hits.code.numpy().astype(int) - 1, looks.hits.depth.numpy()
    made = np.zeros(looks.sighting.votes.shape)
    for view, i in np.argwhere(found["contour_length"] > 0):
        line = found["contour"][view, i, : found["contour_length"][view, i]].astype(float)
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
            if found["component"][view, a[1], a[0]] == found["largest"][view, i] and j not in (-1, i) and nearer:
                other = found["contour"][view, j, : found["contour_length"][view, j]]
                if np.linalg.norm(other - b, axis=1).max() > reach[view, j]:
                    continue
                deep = depths[view, b[1], b[0]] > found["depth"][view, i] + np.float32(rule["deep_distance"])
                made[view, i, j] += rule["deep_weight"] if deep else 1.0
    return made


def net_weights(votes_: np.ndarray, least: float) -> np.ndarray:
    """Weights [i, j] of edges from j to i, from votes [i, j]."""
    kept = np.where(votes_ >= least, votes_, 0.0)
    return np.maximum(kept - kept.T, 0.0)


def is_acyclic(edges: np.ndarray) -> bool:
    """Whether no power of the adjacency matrix has a diagonal."""
    power = edges.astype(int)
    for _ in range(len(edges)):
        if np.trace(power) > 0:
            return False
        power = ((power @ edges) > 0).astype(int)
    return True


def closure(edges: np.ndarray) -> np.ndarray:
    paths = edges.astype(int)
    for _ in range(len(edges)):
        paths = ((paths + paths @ edges) > 0).astype(int)
    return paths > 0


def heaviest_by_orders(weights: np.ndarray) -> tuple[float, set[bytes]]:
    """Weight of the heaviest acyclic subset, and all subsets that weigh so much, by trying every order of the objects."""
    best, sets = -1.0, set()
    for order in itertools.permutations(range(len(weights))):
        rank = np.argsort(order)
        kept = (weights > 0) & (rank[None, :] < rank[:, None])
        weight = weights[kept].sum()
        if weight > best:
            best, sets = weight, set()
        if weight == best:
            sets.add(kept.tobytes())
    return best, sets


def heaviest_by_subsets(weights: np.ndarray) -> tuple[float, set[bytes]]:
    """The same, by trying every subset of the edges."""
    edges = np.argwhere(weights > 0)
    best, sets = -1.0, set()
    for chosen in itertools.product((False, True), repeat=len(edges)):
        kept = np.zeros(weights.shape, bool)
        kept[tuple(edges[list(chosen)].T)] = True
        weight = weights[kept].sum()
        if weight >= best and is_acyclic(kept):
            sets = {kept.tobytes()} | (sets if weight == best else set())
            best = weight
    return best, sets


def choice(visible: np.ndarray, share: np.ndarray, above: np.ndarray, targeted: bool) -> int:
    """The instance to pick, or -1. above: objects above each."""
    sign = -1 if targeted else 1
    return min((i for i in range(len(visible)) if visible[i] > 0), key=lambda i: (sign * above[i], -sign * share[i], i), default=-1)


def angles_of(normal: np.ndarray) -> tuple[float, float]:
    """Yaw and tilt for a unit normal that is not vertical, by trying both ways to lay the axis."""
    for tilt in (np.arccos(normal[2]), -np.arccos(normal[2])):
        yaw = np.arctan2(normal[1] / np.sin(tilt), normal[0] / np.sin(tilt))
        if -np.pi / 2 < yaw <= np.pi / 2:
            return yaw, tilt
    raise AssertionError(normal)
