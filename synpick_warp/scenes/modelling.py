"""Procedural modelling: closed surfaces from cross-sections (surfaces of revolution, sweeps, lofts, rounded boxes).

A cross-section is a ring of points. Vertices are snapped to a grid when a mesh is made, so patches that share a ring join watertight.
"""

from dataclasses import dataclass

import numpy as np

from synpick_warp.scenes.assets.mesh_parts import clip_ears
from synpick_warp.scenes.types import TriangleMesh
from synpick_warp.system.linear_algebra import DECIMALS, dot, matmul

Rect = tuple[float, float, float, float]
"""Rectangle of a texture atlas: u0, v0, u1, v1, with v upward."""

NO_TEXTURE: Rect = (0.0, 0.0, 0.0, 0.0)
"""Rectangle of surfaces without a texture."""
SNAP = 1e-6
"""Grid spacing to which vertices are snapped [m]: far above rounding errors, far below any detail."""
CREASE = 40.0
"""Crease angle: sharper edges are shaded hard [°]."""
BOX_FACES = ("+x", "+y", "-x", "-y", "+z", "-z")
"""Faces of a box; the four sides come first, in their order around it."""

# Texture axes (right, up) of each face as seen from outside: sides upright, top and bottom with +y up.
_FACE_AXES = {
    "+x": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "+y": ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "-x": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "-y": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "+z": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "-z": ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
}


@dataclass(frozen=True, eq=False)
class Patch:
    """Triangle soup before vertices are merged: corner positions [m], counter-clockwise from outside, and texture coordinates."""

    corners: np.ndarray
    """Positions (T, 3, 3) float64 [m], counter-clockwise as seen from outside."""
    uv: np.ndarray
    """Texture coordinates (T, 3, 2) float64."""

    def translate(self, x: float, y: float, z: float) -> "Patch":
        """Patch moved by (x, y, z) [m]."""
        return Patch(self.corners + np.array([x, y, z]), self.uv)

    def rotate(self, axis: str, angle: float) -> "Patch":
        """Rotate the patch about a coordinate axis through the origin [°]."""
        return Patch(matmul(self.corners, rotation(axis, angle).T), self.uv)


def rotation(axis: str, angle: float) -> np.ndarray:
    """Rotation matrix (3, 3) about x, y or z [°]; exact for multiples of 90."""
    radians = np.radians(angle)
    cosine, sine = (round(float(f(radians)), 15) for f in (np.cos, np.sin))
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = cosine
    matrix[second, first], matrix[first, second] = sine, -sine
    return matrix


def join(*patches: Patch) -> Patch:
    """Concatenate patches to one."""
    return Patch(np.concatenate([patch.corners for patch in patches]), np.concatenate([patch.uv for patch in patches]))


def ellipse(width: float, depth: float, points: int, exponent: float = 2.0) -> np.ndarray:
    """Ring (points, 2) of an ellipse, or with a larger exponent of a superellipse (rounded rectangle) [m].

    Like all rings here it starts at +y and runs counter-clockwise, so that a label's middle faces -y and its seam is at the back.
    """
    angles = np.pi / 2 + 2 * np.pi * np.arange(points) / points
    bend = 2.0 / exponent
    waves = np.stack([np.cos(angles), np.sin(angles)], axis=1).round(DECIMALS)
    return np.sign(waves) * (np.abs(waves) ** bend).round(DECIMALS) * np.array([width / 2, depth / 2])


def rounded_rectangle(width: float, depth: float, radius: float, segments: int) -> np.ndarray:
    """Ring (4 * (segments + 2), 2) of a rectangle with rounded corners [m]; it contains the midpoints of the sides."""
    quarter = np.pi / 2 * np.arange(segments + 1) / segments
    middles = ((0.0, depth / 2), (-width / 2, 0.0), (0.0, -depth / 2), (width / 2, 0.0))
    centers = ((-1, 1), (-1, -1), (1, -1), (1, 1))
    ring = []
    for side in range(4):
        center = np.array(centers[side]) * (width / 2 - radius, depth / 2 - radius)
        angles = np.pi / 2 * (side + 1) + quarter
        ring += [np.array([middles[side]]), center + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1).round(DECIMALS)]
    return np.concatenate(ring)


def at_height(ring: np.ndarray, z: float) -> np.ndarray:
    """Lift a planar ring (n, 2) to height z: (n, 3)."""
    return np.column_stack([ring, np.full(len(ring), z)])


def lathe(profile: list[tuple[float, float]], points: int) -> np.ndarray:
    """Rings (m, points, 3) of a surface of revolution about z; its profile of (radius, z) has the outside at its right."""
    circle = ellipse(2.0, 2.0, points)
    return np.stack([at_height(radius * circle, z) for radius, z in profile])


def sweep(path: np.ndarray, section: np.ndarray, scales: np.ndarray, hint: tuple[float, float, float]) -> np.ndarray:
    """Rings (m, n, 3) of a swept surface: a cross-section that follows a path. `path`: (m, 3) [m]. `section`: counter-clockwise ring (n, 2)
    [m]; its first axis is aligned with `hint`. `scales`: scale of the section at each point of the path: (m, 1), or (m, 2) for each of its
    axes. `hint`: reference direction, nowhere parallel to the path."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    first = np.asarray(hint) - tangent * dot(tangent, np.asarray(hint))[:, None]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(tangent, first)
    flat = section[None] * np.broadcast_to(scales, (len(path), 2))[:, None]
    return path[:, None] + flat[..., :1] * first[:, None] + flat[..., 1:] * second[:, None]


def loft(rings: np.ndarray, rect: Rect = NO_TEXTURE) -> Patch:
    """Loft: surface through rings (m, n, 3) that are counter-clockwise as seen from the last; open at both ends.

    The texture rectangle wraps around once, parameterized by arc length, with its upper edge at the last ring.
    """
    closed = np.concatenate([rings, rings[:, :1]], axis=1)
    return _grid(closed, _texture_grid(_arc_lengths(closed, 1), _arc_lengths(closed, 0), rect))


def cap(ring: np.ndarray, rect: Rect = NO_TEXTURE, *, below: bool = False) -> Patch:
    """Triangle fan that closes a ring (n, 3); `below` for the first ring of a loft. The texture is projected along z."""
    following = np.roll(ring, -1, axis=0)
    center = np.broadcast_to(ring.mean(axis=0), ring.shape)
    corners = np.stack([center, following, ring] if below else [center, ring, following], axis=1)
    low, high = ring[:, :2].min(axis=0), ring[:, :2].max(axis=0)
    uv = (corners[..., :2] - low) / np.maximum(high - low, SNAP)
    if below:
        uv = uv * (-1, 1) + (1, 0)
    return Patch(corners, np.array(rect[:2]) + uv * (rect[2] - rect[0], rect[3] - rect[1]))


def face(outline: np.ndarray, *holes: np.ndarray) -> Patch:
    """Triangulate a planar polygon (n, 3), counter-clockwise as seen from outside, with holes (m, 3) of either direction.

    Each hole is joined to the outline by a bridge, the shortest one; then ears are clipped.
    """
    first = outline - outline[0]
    normal = np.cross(first, np.roll(first, -1, axis=0)).sum(axis=0)
    for hole in holes:
        turn = np.cross(hole - hole[0], np.roll(hole, -1, axis=0) - hole[0]).sum(axis=0)
        ring = hole[::-1] if dot(turn, normal) > 0.0 else hole
        near, to = np.unravel_index(np.linalg.norm(outline[:, None] - ring[None], axis=2).argmin(), (len(outline), len(ring)))
        bridged = [outline[: near + 1], np.roll(ring, -to, axis=0), ring[to : to + 1], outline[near:]]
        outline = np.concatenate(bridged)
    triangles = outline[np.array(clip_ears(outline))]
    return Patch(triangles, np.zeros((*triangles.shape[:2], 2)))


def strips(ring: np.ndarray, *, below: bool = False) -> Patch:
    """Close a ring (n, 3) as `cap` does, by strips along x: their bounding boxes overlap less than a fan's, so that rays are faster.

    The ring must be symmetric in x, with its first point and the opposite one in the middle of sides, as `rounded_rectangle` makes it.
    """
    half = len(ring) // 2
    left, right = ring[: half + 1], ring[-np.arange(half + 1)]
    corners = [(left[0], left[1], left[2]), (left[0], left[2], right[2]), (left[0], right[2], right[1])]
    for k in range(2, half - 2):
        corners += [(left[k], left[k + 1], right[k + 1]), (left[k], right[k + 1], right[k])]
    end = half - 2
    corners += [(left[end], left[end + 1], left[half]), (left[end], left[half], right[end]), (right[end], left[half], right[end + 1])]
    triangles = np.array(corners)[:, ::-1] if below else np.array(corners)
    return Patch(triangles, np.zeros((*triangles.shape[:2], 2)))


def solid(rings: np.ndarray, rect: Rect = NO_TEXTURE) -> Patch:
    """Closed solid: a loft with caps at both ends."""
    return sections((rings, rect), ends=(rect, rect))


def block(low: tuple[float, float, float], high: tuple[float, float, float], rect: Rect = NO_TEXTURE) -> Patch:
    """Box between two corners."""
    ring = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])
    return solid(np.stack([at_height(ring, low[2]), at_height(ring, high[2])]), rect)


def sections(*parts: tuple[np.ndarray, Rect], ends: tuple[Rect, Rect]) -> Patch:
    """Closed solid of lofts, each of rings and a texture rectangle, the first and the last with a cap in the rectangles `ends`."""
    lofts = [loft(*part) for part in parts]
    return join(cap(parts[0][0][0], ends[0], below=True), *lofts, cap(parts[-1][0][-1], ends[1]))


def torus(rings: np.ndarray, rect: Rect = NO_TEXTURE) -> Patch:
    """Closed torus: a loft whose last ring is joined to its first."""
    return loft(np.concatenate([rings, rings[:1]]), rect)


def rounded_box(size: tuple[float, float, float], radius: float, rects: dict[str, Rect], segments: int = 3) -> Patch:
    """Box about the origin with rounded edges [m]; `rects`: texture rectangle of each of `BOX_FACES`."""
    angles = np.tan(np.pi / 4 * np.arange(segments + 1) / segments).round(DECIMALS)
    slopes = np.concatenate([-angles[::-1], angles])
    sides = np.concatenate([-np.ones(segments + 1), np.ones(segments + 1)])
    half = np.array(size) / 2
    patches = []
    for name in BOX_FACES:
        right, up = np.array(_FACE_AXES[name])
        out = np.cross(right, up)
        bulge = slopes[None, :, None] * right + slopes[:, None, None] * up + out
        bulge /= np.linalg.norm(bulge, axis=2, keepdims=True)
        inner = sides[None, :, None] * right + sides[:, None, None] * up + out
        points = inner * (half - radius) + radius * bulge
        across, along = (0.5 + dot(points, axis) / (2 * dot(half, np.abs(axis))) for axis in (right, up))
        patches.append(_grid(points, _texture_grid(across[0], along[:, 0], rects[name])))
    return join(*patches)


def make_mesh(patch: Patch, *, centered: bool) -> TriangleMesh:
    """Merge vertices, drop degenerate triangles, and compute vertex normals that stay hard at edges above `CREASE`. `centered`: translate
    the centre of the bounding box to the origin."""
    corners = patch.corners.reshape(-1, 3)
    if centered:
        corners = corners - (corners.min(axis=0) + corners.max(axis=0)) / 2
    cells, point = np.unique(np.rint(corners / SNAP).astype(np.int64), axis=0, return_inverse=True)
    point = point.reshape(-1, 3)
    valid = (point[:, 0] != point[:, 1]) & (point[:, 1] != point[:, 2]) & (point[:, 2] != point[:, 0])
    point, uv = point[valid], patch.uv[valid].reshape(-1, 2)
    points = cells * SNAP
    normals = _corner_normals(points, point)
    keys = np.column_stack([point.reshape(-1, 1), np.rint(normals * 1e4), np.rint(uv * 1e6)]).astype(np.int64)
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return TriangleMesh(
        vertices=points[point.reshape(-1)[first]].astype(np.float32),
        faces=index.reshape(-1, 3).astype(np.int32),
        normals=normals[first].astype(np.float32),
        uv=np.clip(uv[first], 0.0, 1.0).astype(np.float32),
    )


def _arc_lengths(points: np.ndarray, axis: int) -> np.ndarray:
    """Normalized mean arc length along an axis of a grid of points, from 0 to 1."""
    steps = np.linalg.norm(np.diff(points, axis=axis), axis=2).mean(axis=1 - axis)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    return length / max(length[-1], SNAP)


def _texture_grid(across: np.ndarray, along: np.ndarray, rect: Rect) -> np.ndarray:
    """Texture coordinates of a grid (rows, columns, 2) from its parameters in 0..1 along columns and rows."""
    u = rect[0] + across * (rect[2] - rect[0])
    v = rect[1] + along * (rect[3] - rect[1])
    return np.stack(np.meshgrid(u, v), axis=2)


def _grid(points: np.ndarray, uv: np.ndarray) -> Patch:
    """Triangulate a grid of points (rows upward, columns to the right): two triangles per cell."""

    def triangles(grid: np.ndarray) -> np.ndarray:
        """Two triangles for each cell of a grid of values (rows, columns, n): (2 cells, 3, n)."""
        a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
        cells = np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2)
        return cells.reshape(-1, 3, grid.shape[2])

    return Patch(triangles(points), triangles(uv))


def _corner_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Corner normals (3F, 3): angle-weighted means over the faces at a vertex within the crease angle."""
    triangle = points[faces]
    edges = np.roll(triangle, -1, axis=1) - triangle
    edges /= np.linalg.norm(edges, axis=2, keepdims=True)
    flat = np.cross(edges[:, 0], edges[:, 1])
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), SNAP)
    angle = np.arccos(np.clip(-dot(edges, np.roll(edges, 1, axis=1)), -1.0, 1.0)).reshape(-1).round(DECIMALS)
    normal = np.repeat(flat, 3, axis=0)

    order = np.argsort(faces.reshape(-1), kind="stable")
    counts = np.bincount(faces.reshape(-1), minlength=len(points))
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    group = faces.reshape(-1)[order]
    own = np.repeat(np.arange(len(order)), counts[group])
    ends = np.cumsum(counts[group])
    other = np.arange(len(own)) - np.repeat(ends - counts[group], counts[group]) + np.repeat(starts[group], counts[group])
    own, other = order[own], order[other]
    near = dot(normal[own], normal[other]) > round(float(np.cos(np.radians(CREASE))), DECIMALS)
    total = np.stack(
        [np.bincount(own[near], weights=(normal[other, axis] * angle[other])[near], minlength=len(normal)) for axis in range(3)], axis=1
    )
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), SNAP)


def project_from_box(mesh: TriangleMesh) -> TriangleMesh:
    """Cube projection of texture coordinates: each triangle takes the two axes [m] across the one that its normal is closest to.

    Triangles get vertices of their own, since neighbours may take other axes.
    """
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across = np.array([(1, 2), (0, 2), (0, 1)])[np.abs(normal).argmax(axis=1)]
    uv = np.take_along_axis(corners, across[:, None, :], axis=2)
    faces = np.arange(3 * len(mesh.faces), dtype=np.int32).reshape(-1, 3)
    return TriangleMesh(corners.reshape(-1, 3), faces, mesh.normals[mesh.faces].reshape(-1, 3), uv.reshape(-1, 2).astype(np.float32))
