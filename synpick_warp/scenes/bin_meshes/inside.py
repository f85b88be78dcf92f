"""The inside of a bin's mesh: depression filling (priority-flood, Barnes et al. 2014) of its height field.

The height field is what is seen from above. Poured full, the bin holds what is in its depressions: they are its inside, and the rim is
where it would spill. Holes of the floor and of the walls do not matter, since nothing flows below the surface. Where it is floor and
where wall: `scenes.bin_meshes.compartments`.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

CELLS = 192
"""Cells of the height field along the longer side of the mesh."""
BORDER = 2
"""Cells around the mesh."""
MIN_DEPTH = 0.01
"""Least depth of an inside [m]: less is a groove or a tray's edge, from which objects roll."""
POOL_SHARE = 0.1
"""Least volume of a depression, as a fraction of the largest: smaller ones are grooves of a flange."""
HOLE = 0.015
"""Width of a hole that collision shapes may close [m]."""
BATCH = 1 << 14
"""Triangles that are bisected at a time."""
WIRES = 0.06
"""Largest gap between the wires of a basket [m]: wider gaps are holes."""
OPEN_SHARE = 0.5
"""Fraction of a floor that is holes wider than WIRES, from which on the bin has none and its contents lie on the table."""
STEEPEST_FLOOR, LEANING = np.cos(np.radians(30.0)), np.sin(np.radians(0.5))
"""z of a unit normal at the slope from which on a surface is a wall, near the angle of friction of parts, and of an upright one."""
LIMIT_CELLS = 128
"""Cells of the field of limits along each side."""
BELOW_FLOOR = 0.01
"""How far an object's origin is below the floor when it has left the bin [m]."""


@dataclass(frozen=True, eq=False)
class HeightField:
    """Field of limits over the inside of a bin, about the origin of its frame, for the kernels of the simulation."""

    limit: np.ndarray
    """Height below which an object's origin is outside (LIMIT_CELLS, LIMIT_CELLS), by x and y [m]."""
    pitch: tuple[float, float]
    """Sides of a cell [m]."""


@dataclass(frozen=True, eq=False)
class BinSurface:
    """Upper envelope of a mesh on a grid, and its inside; z up, in the mesh's own frame [m]."""

    low: np.ndarray
    """Corner of the grid (2)."""
    cell: float
    """Side of a cell."""
    height: np.ndarray
    """Largest height of the mesh over each cell (nx, ny); where there is no mesh, that of its underside."""
    inside: np.ndarray
    """Cells of the inside (nx, ny) bool."""
    ground: np.ndarray
    """As `height`, with gaps between wires closed (nx, ny)."""
    solid: np.ndarray
    """Cells over which there is mesh (nx, ny) bool."""
    wall: np.ndarray
    """Cells whose highest point lies on a leaning wall (nx, ny) bool."""
    walls: np.ndarray
    """Triangles of walls, leaning or upright (F, 3, 3)."""
    feet: np.ndarray
    """Sample points of these, less than a cell apart (N, 3)."""
    rim: float
    """Height of the rim."""
    floor: float
    """Height of the lowest inner point; of the underside if there is no floor."""
    has_floor: bool
    """Whether its contents lie on the mesh."""

    def index(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cells of points (..., 2 or 3), the nearest for points beside the grid."""
        cells = np.floor((points[..., :2] - self.low) / self.cell).astype(int)
        cells = np.clip(cells, 0, np.array(self.height.shape) - 1)
        return cells[..., 0], cells[..., 1]

    @cached_property
    def closed(self) -> np.ndarray:
        """Height field without holes narrower than HOLE, by a morphological closing (nx, ny)."""
        return ndimage.grey_closing(self.height, round(HOLE / self.cell) // 2 * 2 + 1, mode="nearest")

    @cached_property
    def near_inside(self) -> np.ndarray:
        """Cells of the inside, and two around it (nx, ny) bool."""
        return ndimage.binary_dilation(self.inside, iterations=2)

    def centers(self, cells: np.ndarray) -> np.ndarray:
        """Middle of cells (..., 2) in the mesh's frame [m]."""
        return self.low + (cells + 0.5) * self.cell


def subdivide(corners: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Longest-edge bisection of triangles (F, 3, 3) until no edge exceeds `longest`: the triangles, and the input triangle of each (N,)."""
    parts = _bisect(corners, longest, left=True)
    return np.concatenate([part for part, _ in parts], axis=2).transpose(2, 0, 1), np.concatenate([owner for _, owner in parts])


def spread_points(corners: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Sample points (N, 3): triangle corners, midpoints of the edges that `subdivide` splits; and the triangle of each point (N,)."""
    parts = _bisect(corners, longest)
    points = np.concatenate([corners.reshape(-1, 3).T, *(middle for middle, _ in parts)], axis=1).T
    return points, np.concatenate([np.repeat(np.arange(len(corners)), 3), *(owner for _, owner in parts)])


def _bisect(corners: np.ndarray, longest: float, left: bool = False) -> list[tuple[np.ndarray, np.ndarray]]:
    """Longest-edge bisection (Rivara, 1984), in batches that fit into the processor's cache. Returns for each batch midpoints of edges that
    are split (3, N), or with `left` triangles that are not (corner, coordinate, N); and the indices of their input triangles (N)."""
    a, b, c = np.ascontiguousarray(corners.transpose(1, 2, 0))
    parts, waiting, found = [(a, b, c, _distance(a, b), _distance(b, c), _distance(c, a), np.arange(len(corners)))], [], []
    while True:
        long = [np.maximum(np.maximum(ab, bc), ca) > longest for _, _, _, ab, bc, ca, _ in parts]
        if left:
            found += [(np.stack(part[:3])[..., ~mask], part[6][~mask]) for part, mask in zip(parts, long, strict=True)]
        rows = [np.flatnonzero(mask) for mask in long]
        fields = [np.concatenate([part[k].take(row, -1) for part, row in zip(parts, rows, strict=True)], -1) for k in range(7)]
        waiting += [[field[..., first : first + BATCH] for field in fields] for first in range(0, len(fields[6]), BATCH)]
        if not waiting:
            return found
        *points, ab, bc, ca, owner = waiting.pop()
        other, last, parts = (bc > ab) | (ca > ab), ca > bc, []
        # From the longest edge on: its ends a and b, the third corner c, and the lengths of the other edges.
        for k, mask in enumerate((~other, other & ~last, other & last)):
            row = np.flatnonzero(mask)
            a, b, c = (points[(k + j) % 3].take(row, axis=1) for j in range(3))
            near, far = ((ab, bc, ca)[(k + j) % 3].take(row) for j in (1, 2))
            middle, cut = (a + b) / 2.0, owner.take(row)
            across = _distance(middle, c)
            parts += [(a, middle, c, _distance(a, middle), across, far, cut), (middle, b, c, _distance(middle, b), near, across, cut)]
            found += [] if left else [(middle, cut)]


def _distance(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Distances (N) between points (3, N)."""
    squares = (one - other) ** 2
    return np.sqrt(squares[0] + squares[1] + squares[2])


def find_inside(corners: np.ndarray, count: int = CELLS) -> BinSurface | None:
    """Height field and inside of triangles (F, 3, 3) [m]; None: they have none. `count`: cells along the longer side."""
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    # Not whole, so that no side of the mesh is on the border of cells: symmetric meshes get symmetric cells.
    cell = float((high - low)[:2].max()) / (count + 0.371)
    if cell <= 0.0 or high[2] - low[2] < MIN_DEPTH:
        return None
    shape = tuple(np.ceil((high - low)[:2] / cell).astype(int) + 1 + 2 * BORDER)
    start = (low + high)[:2] / 2.0 - np.array(shape) * cell / 2.0
    points, owner = spread_points(corners, 0.9 * cell)
    height, solid = np.full(shape, low[2]), np.zeros(shape, bool)
    x, y = ((points[:, :2] - start) / cell).astype(int).T
    np.maximum.at(height, (x, y), points[:, 2])
    solid[x, y] = True
    level = _flood(height)
    labels, pools = ndimage.label(level > height + 1e-9)
    if pools == 0:
        return None
    each = np.arange(1, pools + 1)
    volumes = ndimage.sum_labels(level - height, labels, each)
    depths = ndimage.maximum(level - height, labels, each)
    kept = each[(volumes >= POOL_SHARE * volumes.max()) & (depths >= MIN_DEPTH)]
    if not len(kept):
        return None
    inside = np.isin(labels, kept)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    steepness = normal[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
    steep = np.abs(steepness) < STEEPEST_FLOOR
    top, wall = points[:, 2] > height[x, y] - 1e-7, np.zeros(shape, bool)
    for faces, value in ((steep & (np.abs(steepness) > LEANING), True), (~steep, False)):
        wall[x[top & faces[owner]], y[top & faces[owner]]] = value
    ground = _close_gaps(height, solid, inside, cell)
    floor = float(height[inside & solid].min(initial=np.inf))
    low_cells = inside & (ground < floor + MIN_DEPTH)
    has_floor = (low_cells & ~solid & (ground <= low[2])).sum() <= OPEN_SHARE * low_cells.sum()
    if not has_floor:
        floor = float(low[2])
    # Walls raise the cells at the edges of the floor, where a slope is lowest: points of upper sides on these count, too.
    near = (steepness > 0.5)[owner] & ndimage.binary_dilation(inside)[x, y] & (points[:, 2] >= floor - cell)
    floor = float(points[near, 2].min(initial=floor))
    rim = float(level[inside].max())
    return BinSurface(start, cell, height, inside, ground, solid, wall, corners[steep], points[steep[owner]], rim, floor, bool(has_floor))


def _close_gaps(height: np.ndarray, solid: np.ndarray, inside: np.ndarray, cell: float) -> np.ndarray:
    """Height field (nx, ny) with small gaps filled: those narrower than WIRES and than half of the inside."""
    narrowest = int(np.ptp(np.argwhere(inside), axis=0).min()) + 1
    size = min(round(WIRES / cell), narrowest // 2) // 2 * 2 + 1
    return np.where(solid, height, ndimage.grey_closing(height, size, mode="nearest"))


def _flood(height: np.ndarray) -> np.ndarray:
    """Depression filling (Planchon and Darboux, 2001): water level of each cell (nx, ny), if water drains off at the border."""
    level = height.copy()
    level[1:-1, 1:-1] = np.inf
    before = np.empty_like(level)
    while not np.array_equal(level, before):
        before[:] = level
        for turns in range(4):
            filled, ground = np.rot90(level, turns), np.rot90(height, turns)
            for row in range(1, len(filled)):
                np.minimum(filled[row], np.maximum(ground[row], filled[row - 1]), out=filled[row])
    return level


def make_limits(surface: BinSurface, origin: np.ndarray) -> HeightField:
    """Field of limits of a surface in the frame at `origin` (3) [m].

    Beside the inside, widened by two cells, the limit is the rim; within, BELOW_FLOOR below the lowest surface nearby.
    """
    near, floor = surface.near_inside, np.where(surface.inside, surface.height, np.inf)
    floor = ndimage.minimum_filter(floor, 5, mode="nearest")
    limit = np.where(near, floor - BELOW_FLOOR, surface.rim) - origin[2]
    cells = np.argwhere(near)
    reach = np.abs(np.stack([surface.centers(cells.min(axis=0)), surface.centers(cells.max(axis=0))]) - origin[:2]).max(axis=0)
    pitch = 2.0 * (reach + surface.cell) / LIMIT_CELLS
    places = (np.arange(LIMIT_CELLS) - LIMIT_CELLS // 2 + 0.5)[:, None] * pitch + origin[:2]
    x = surface.index(np.column_stack([places[:, 0], places[:, 0]]))[0]
    y = surface.index(np.column_stack([places[:, 1], places[:, 1]]))[1]
    return HeightField(limit[np.ix_(x, y)].astype(np.float32), (float(pitch[0]), float(pitch[1])))
