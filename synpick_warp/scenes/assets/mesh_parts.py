"""Mesh parts: geometry and material as read from a mesh file, before they are validated and merged; and triangulation of polygons.

Convex polygons become fans, concave ones are triangulated by ear clipping (Meisters, "Polygons have ears", 1975).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
