"""Exact nearest-vertex search for ADD-S over many poses: a hierarchical grid with a candidate list per leaf cell.

Built here on the host; `kernels/pose/nearest` searches it on the CPU or a GPU.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from synpick_warp.kernels.pose import nearest as device_code
from synpick_warp.stages.launch import launch_views

BRANCH, CHILDREN, ROOT, BLOCK = (int(getattr(device_code, name)) for name in ("BRANCH", "CHILDREN", "ROOT", "BLOCK"))
_ROOT_LEVELS = 3
"""Divisions of the whole cube down to the root grid: BRANCH³ = ROOT."""
_MAX_LEVELS = 5
"""Divisions down to the smallest cells, which are 0.6 mm for YCB objects: deeper ones would divide an axis of symmetry for ever."""
_MAX_LIST = 40
"""A cell with a longer list is divided. Shorter lists need more memory, and a cache that misses costs more than a comparison."""
_MAX_DIVIDED = 2**15
"""Largest number of cells that are divided once more, those with the longest lists: two million children, of some 100 MB."""
_CELLS, _TASKS = 4096, 512
"""Cells, and blocks of points, of one launch on the CPU: about a millisecond."""
_MARGIN = 1.001
"""Half edge of the cube relative to the reach, so that rounding leads nowhere outside."""
_SUMS = 2**20
"""Largest number of sums that are fetched at once: 8 MB."""


@dataclass(frozen=True, eq=False)
class _Level:
    """Cells of one size that are to be divided: lower corners [m], and the candidate vertices of each as ranges of a list."""

    corner: np.ndarray
    """Lower corners (C, 3) [m]."""
    start: np.ndarray
    """Start of each cell's list in `candidate` (C,)."""
    length: np.ndarray
    """Length of each cell's list (C,)."""
    candidate: np.ndarray
    """Indices of vertices (E,)."""


class NearestVertices:
    """Hierarchical grid over a model's vertices that finds the exact nearest vertex of a point, with a candidate list per leaf cell."""

    def __init__(self, vertices: np.ndarray, center: np.ndarray, reach: float, device: wp.Device) -> None:
        """Build the structure: about a second and 30 MB for 8,500 vertices on a CPU core.

        Args:
            vertices: Vertices of the model (V, 3) [m]; equal ones are allowed.
            center: Centre of the cube that is divided (3,) [m].
            reach: Half of its edge [m]: the largest distance of a query, and of a vertex, from the centre along an axis.
            device: Where to search.
        """
        self._device = device
        self._half = _MARGIN * max(reach, 1e-6)
        self._corner = center - self._half
        unique, counts = np.unique(vertices, axis=0, return_counts=True)
        # Points in the order of a space-filling curve find what their neighbours have put into the cache.
        order = _morton_order(unique)
        self._query, self._vertex = self._upload(unique[order], wp.vec3d), self._upload(unique[order] - self._corner, wp.vec3d)
        self._weight = self._upload(counts[order] / len(vertices), wp.float64)
        nodes, candidates = self._build(len(unique))
        self._node, self._candidate = self._upload(nodes, wp.int32), self._upload(candidates, wp.int32)

    def mean_distances(self, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """Mean distance from the vertices, moved by each pose, to the nearest vertex of the model in its own frame (ADD-S).

        Args:
            rotation: (P, 3, 3).
            translation: (P, 3) [m]; all moved vertices must lie in the cube of the constructor's `center` and `reach`.

        Returns:
            (P,) [m].
        """
        blocks = -(-self._query.shape[0] // BLOCK)
        result = np.empty(len(rotation))
        step = max(1, _SUMS // blocks)
        for start in range(0, len(rotation), step):
            rows = slice(start, start + step)
            shift = translation[rows] - self._corner
            sums = wp.empty((len(shift), blocks), dtype=wp.float64, device=self._device)
            inputs = [self._upload(rotation[rows], wp.mat33d), self._upload(shift, wp.vec3d), self._query, self._weight, self._vertex]
            inputs += [self._node, self._candidate, ROOT / (2.0 * self._half)]
            pieces = -(-len(shift) * blocks // _TASKS)
            launch_views(device_code.sum_distances_kernel, pieces, _TASKS, inputs, [sums], self._device)
            result[rows] = sums.numpy().sum(axis=1)
        return result

    def _build(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Arrays (nodes, candidates) of the grid, as the kernel reads them, for `count` distinct vertices."""
        level = _Level(np.zeros((1, 3)), np.zeros(1, np.int64), np.full(1, count), np.arange(count))
        edge = 2.0 * self._half
        nodes, candidates, nodes_before, entries_before = [], [], 0, 0
        for depth in range(_MAX_LEVELS):
            edge /= BRANCH
            level = self._divide(level, edge)
            if depth < _ROOT_LEVELS - 1:
                continue
            if depth == _ROOT_LEVELS - 1:
                level = _rows_first(level, edge)
            divided = _longest(level.length) if depth < _MAX_LEVELS - 1 else np.zeros(len(level.length), bool)
            kept = np.where(divided, 0, level.length)
            own = level.candidate[np.repeat(~divided, level.length)]
            ends = np.cumsum(kept)
            last = ends[~divided] - 1
            own[last] = ~own[last]
            nodes_before += len(kept)
            children = nodes_before + CHILDREN * (np.cumsum(divided) - 1)
            nodes.append(np.where(divided, children, ~(entries_before + ends - kept)))
            candidates.append(own)
            entries_before += len(own)
            level = _Level(level.corner[divided], level.start[divided], level.length[divided], level.candidate)
            if not len(level.corner):
                break
        return np.concatenate(nodes), np.concatenate(candidates)

    def _divide(self, level: _Level, edge: float) -> _Level:
        """The BRANCH³ children of each cell, of edge `edge` [m], each with its list, in the order of their parents."""
        cells = CHILDREN * len(level.corner)
        inputs = [self._vertex, self._upload(level.corner, wp.vec3d)]
        inputs += [self._upload(part, wp.int32) for part in (level.start, level.length, level.candidate)]
        length = wp.empty(cells, dtype=wp.int32, device=self._device)
        numbers = [edge, 2.0 * self._half]
        nothing = wp.empty(1, dtype=wp.int32, device=self._device)
        kernel, pieces = device_code.list_candidates_kernel, -(-cells // _CELLS)
        launch_views(kernel, pieces, _CELLS, [*inputs, length, *numbers, 0], [length, nothing], self._device)
        lengths = length.numpy().astype(np.int64)
        starts = np.cumsum(lengths) - lengths
        candidate = wp.empty(int(lengths.sum()), dtype=wp.int32, device=self._device)
        launch_views(kernel, pieces, _CELLS, [*inputs, self._upload(starts, wp.int32), *numbers, 1], [length, candidate], self._device)
        place = np.arange(CHILDREN)
        offset = np.stack((place % BRANCH, place // BRANCH % BRANCH, place // BRANCH**2), axis=1)
        corner = (level.corner[:, None] + edge * offset).reshape(-1, 3)
        return _Level(corner, starts, lengths, candidate.numpy())

    def _upload(self, values: np.ndarray, dtype: type) -> wp.array:
        """Copy an array to the device."""
        return wp.array(values, dtype=dtype, device=self._device)


def _longest(length: np.ndarray) -> np.ndarray:
    """Mask of the cells to divide (C,) bool: with lists longer than _MAX_LIST, but of these only the longest, at most _MAX_DIVIDED."""
    limit = _MAX_LIST
    if len(length) > _MAX_DIVIDED:
        limit = max(limit, int(np.partition(length, -_MAX_DIVIDED)[-_MAX_DIVIDED]))
    return length > limit


def _rows_first(level: _Level, edge: float) -> _Level:
    """Root cells and their lists sorted by z, y and x, so that a cell's index follows from its position."""
    place = np.rint(level.corner / edge).astype(np.int64)
    order = np.lexsort(place.T)
    length = level.length[order]
    start = np.cumsum(length) - length
    entries = np.repeat(level.start[order] - start, length) + np.arange(len(level.candidate))
    return _Level(level.corner[order], start, length, level.candidate[entries])


def _morton_order(points: np.ndarray) -> np.ndarray:
    """Order of points (N, 3) along the Morton curve (N,)."""
    bits = 10
    span = max(float(np.ptp(points, axis=0).max()), 1e-12)
    cell = ((points - points.min(axis=0)) / span * (2**bits - 1)).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(bits):
        for axis in range(3):
            code |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")
