"""Mesh parts: geometry and material as read from a mesh file, before they are validated and merged; triangulation of polygons; and vertex
normals: smooth ones, and ones with creases, where vertices are split along sharp edges.

Convex polygons become fans, concave ones are triangulated by ear clipping (Meisters, "Polygons have ears", 1975).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from synpick_warp.errors import CatalogError

if TYPE_CHECKING:
    from synpick_warp.scenes.assets.appearance import FileMaterial

_FLAT = 1e-9
"""Sines of corners within this of zero are rounding."""
_MAX_WORK = 2**23
"""Largest sum of squared numbers of corners of all polygons that are clipped: at worst some minutes."""


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Part of a mesh file, not yet validated, in the file's unit; None: not stated."""

    vertices: np.ndarray
    """(V, 3) float64."""
    faces: np.ndarray
    """Vertex indices (F, 3) int64."""
    normals: np.ndarray | None
    """(V, 3)."""
    uv: np.ndarray | None
    """(V, 2)."""
    colors: np.ndarray | None
    """Vertex colours, sRGB in 0..1 (V, 3); multiply the material's base colour in linear light."""
    material: FileMaterial

    def take(self, source: np.ndarray, faces: np.ndarray, **changes: Any) -> MeshPart:
        """Part of the vertices `source` with other faces (F, 3), and with other changes."""
        rows = {name: None if (data := getattr(self, name)) is None else data[source] for name in ("vertices", "normals", "uv", "colors")}
        return replace(self, **{**rows, "faces": faces, **changes})


def check_indices(faces: np.ndarray, count: int, path: Path) -> None:
    """Raise CatalogError if a triangle (F, 3) refers to another vertex than the `count` that there are."""
    wrong = faces[(faces < 0) | (faces >= count)]
    if len(wrong):
        raise CatalogError(f"{path}: a triangle refers to vertex {wrong[0]}, but there are {count}; repair the mesh")


def find_concave(vertices: np.ndarray, flat: np.ndarray, lengths: np.ndarray, ignored: list[str]) -> np.ndarray:
    """Find concave polygons: those with a corner that turns against the polygon's normal (Newell's). `vertices`: positions (V, 3). `flat`:
    vertices of all polygons, one after another (C,). `lengths`: number of corners of each polygon (P,). `ignored`: what is left out is
    added to it: polygons with too many corners together. Returns indices of polygons (N,), in order."""
    starts, found = np.cumsum(lengths) - lengths, []
    for count in np.unique(lengths[lengths > 3]):
        index = np.flatnonzero(lengths == count)
        corners = vertices[flat[starts[index][:, None] + np.arange(count)]]
        edges = np.roll(corners, -1, axis=1) - corners
        turns = np.cross(edges, np.roll(edges, -1, axis=1))
        normals = np.cross(corners - corners[:, :1], np.roll(corners, -1, axis=1) - corners[:, :1]).sum(axis=1)
        length = np.linalg.norm(edges, axis=2)
        scale = length * np.roll(length, -1, axis=1) * np.linalg.norm(normals, axis=1)[:, None]
        found.append(index[(np.einsum("pci,pi->pc", turns, normals) < -_FLAT * scale).any(axis=1)])
    concave = np.concatenate([np.zeros(0, np.int64), *found])
    fits = np.cumsum(lengths[concave].astype(np.float64) ** 2) <= _MAX_WORK  # In order of their numbers of corners.
    ignored += [] if fits.all() else ["concavity of polygons with many corners"]
    return np.sort(concave[fits])


def clip_ears(corners: np.ndarray) -> list[tuple[int, int, int]]:
    """Triangulate a simple polygon of corners (C, 3) by ear clipping, in the plane of its normal. Returns C - 2
    triangles of corner indices. Of a polygon that crosses itself, the rest without ears is a fan."""
    first = corners - corners[0]
    normal = np.cross(first, np.roll(first, -1, axis=0)).sum(axis=0)
    keep = [axis for axis in range(3) if axis != int(np.abs(normal).argmax())]
    flat = corners[:, keep].astype(np.float64)
    x, y = flat.T
    if float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) < 0.0:
        flat = flat * (1.0, -1.0)
    left, triangles = list(range(len(flat))), []
    while len(left) > 3:
        at = next((place for place in range(len(left)) if _is_ear(flat, left, place)), None)
        if at is None:
            break
        triangles.append((left[at - 1], left[at], left[(at + 1) % len(left)]))
        del left[at]
    return triangles + [(left[0], left[place], left[place + 1]) for place in range(1, len(left) - 1)]


def _is_ear(flat: np.ndarray, left: list[int], place: int) -> bool:
    """Whether a corner turns left, and no other one lies in its triangle."""
    a, b, c = (flat[left[(place + step) % len(left)]] for step in (-1, 0, 1))
    if _cross(a, b, c) <= 0.0:
        return False
    others = flat[left]
    inside = (_cross(a, b, others) >= 0.0) & (_cross(b, c, others) >= 0.0) & (_cross(c, a, others) >= 0.0)
    own = np.any([(others == corner).all(axis=1) for corner in (a, b, c)], axis=0)
    return not np.any(inside & ~own)


def _cross(a: np.ndarray, b: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Twice the signed area of the triangle (a, b, point), for each of `point`: positive if counter-clockwise (orientation test)."""
    return (b[0] - a[0]) * (point[..., 1] - a[1]) - (b[1] - a[1]) * (point[..., 0] - a[0])


DEFAULT_CREASE = 35.0
"""Crease angle [°]: the default of objects.crease_angle. Between the 30° of a cylinder of 12 sides and the 45° of a chamfer."""

# Positions closer than this fraction of the mesh's extent are one: rounding errors of transforms, not features.
_SAME = 1e-6
# Triangles at a position that are compared with each other: all of up to 32; of more, each with the next 32 in the order of their normals.
_REACH = 32


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute smooth normals of vertices (V, 3) and faces (F, 3): area-weighted means over all triangles at a position, so that texture
    seams do not show. Returns unit normals (V, 3) float32. Where the triangles at a position cancel out, those of the vertex alone are
    used, or +z."""
    doubled = _doubled_areas(vertices, faces)
    own = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(own, faces[:, corner], doubled)
    _, position = np.unique(vertices, axis=0, return_inverse=True)
    shared = np.zeros((position.max() + 1, 3))
    np.add.at(shared, position, own)
    return _unit((own, shared[position]), doubled)


def crease_normals(vertices: np.ndarray, faces: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute vertex normals with creases: at each position the triangles form smoothing groups, each with an area-weighted mean.

    Two triangles at a position are in one group if their normals differ by at most the crease angle, or by a chain of such. Vertices are
    matched by position, so that texture seams do not show; a vertex in several groups is split. `vertices`: (V, 3). `faces`: (F, 3); each
    vertex is used. `angle`: crease angle [°]. Returns the vertex that each new vertex is a copy of (W,), the first V being 0 to V - 1;
    faces (F, 3) of new vertices; and their unit normals (W, 3) float32."""
    doubled = _doubled_areas(vertices, faces)
    group = _smoothing_groups(_positions(vertices)[faces.reshape(-1)], doubled, angle)
    sums = np.stack([np.bincount(group, np.repeat(doubled[:, axis], 3)) for axis in range(3)], axis=1)
    pairs, index = np.unique(faces.reshape(-1) * np.int64(len(sums)) + group, return_inverse=True)
    source, groups = np.divmod(pairs, len(sums))
    # The first copy of each vertex keeps its place, further ones are appended: an order that files define is kept.
    further = np.diff(source, prepend=-1) == 0
    order = np.concatenate([np.flatnonzero(~further), np.flatnonzero(further)])
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return source[order], place[index].reshape(-1, 3), _unit((sums[groups[order]],), doubled)


def _smoothing_groups(position: np.ndarray, doubled: np.ndarray, angle: float) -> np.ndarray:
    """Number the smoothing groups: a group for each corner of the triangles (3 F); those of triangles without an area join any."""
    length = np.linalg.norm(doubled, axis=1)
    flat = length <= 1e-12 * length.max()
    unit = doubled / np.where(flat, 1.0, length)[:, None]
    corner_face = np.repeat(np.arange(len(doubled)), 3)
    order = np.lexsort((unit[corner_face, 2], unit[corner_face, 1], unit[corner_face, 0], flat[corner_face], position))
    place, face = position[order], corner_face[order]
    # Rounding of a mesh whose edges have the angle itself does not decide.
    least = np.cos(np.radians(min(angle, 180.0))) - 1e-6
    links = []
    first = np.arange(len(order) - 1)
    for reach in range(1, _REACH + 1):
        first = first[first + reach < len(order)]
        first = first[place[first] == place[first + reach]]
        one, two = face[first], face[first + reach]
        close = np.einsum("li,li->l", unit[one], unit[two]) >= least
        # Corners without an area come last at their position: each joins the one before it.
        close = np.where(flat[two], reach == 1, close)
        links.append((first[close], first[close] + reach))
        if not len(first):
            break
    rows, columns = (np.concatenate(side) for side in zip(*links, strict=True))
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(len(order), len(order)))
    group = np.empty(len(order), np.int64)
    group[order] = connected_components(graph, directed=False)[1]
    return group


def _positions(vertices: np.ndarray) -> np.ndarray:
    """Number the positions of vertices (V); equal ones, up to rounding, have one number."""
    grid = np.rint((vertices - vertices.min(axis=0)) / max(_SAME * float(np.ptp(vertices, axis=0).max()), 1e-30)).astype(np.int64)
    order = np.lexsort(grid.T)
    first = np.any(np.diff(grid[order], axis=0, prepend=-1) != 0, axis=1)
    position = np.empty(len(vertices), np.int64)
    position[order] = np.cumsum(first)
    return position


def _doubled_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals of triangles (F, 3), with twice the area as length."""
    corners = vertices[faces].astype(np.float64)
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _unit(candidates: tuple[np.ndarray, ...], doubled: np.ndarray) -> np.ndarray:
    """Unit vectors float32 of the last candidate that has a direction, else +z."""
    normals = np.broadcast_to((0.0, 0.0, 1.0), candidates[0].shape)
    # Sums within the rounding error of the areas have no direction.
    min_length = 1e-9 * np.linalg.norm(doubled, axis=1).max()
    for candidate in candidates:
        length = np.linalg.norm(candidate, axis=1, keepdims=True)
        normals = np.where(length > min_length, candidate / np.where(length > min_length, length, 1.0), normals)
    return normals.astype(np.float32)
