"""Vertex normals: smooth ones, and ones with creases, where vertices are split along sharp edges."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

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
