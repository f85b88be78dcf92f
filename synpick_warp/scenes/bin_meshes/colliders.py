"""Collision shapes of a bin's mesh: convex prisms behind the faces that its inside shows.

Convex decompositions of thin walls close corners and openings, and pieces as thin as walls do not hold what is pressed against them. So
the visible faces are merged to nearly flat facets (region growing), each facet is cut into convex polygons that fill nothing free, and each
polygon is extruded into the solid: floors downward, walls outward, as deep as the faces on the other side of a divider allow.
"""

import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.meshes import merge_positions
from synpick_warp.scenes.bin_meshes.compartments import Compartment, enclose
from synpick_warp.scenes.bin_meshes.inside import BinSurface, subdivide
from synpick_warp.scenes.collision.simplification import hull_piece
from synpick_warp.scenes.types import ConvexPiece
from synpick_warp.system.linear_algebra import DECIMALS, dot, matmul, norm

FLOOR_DEPTH = 0.1
"""Thickness of the floor's collision shape [m]: more than any object moves in one step, so that none tunnels."""
MIN_WALL = 0.02
"""Minimum thickness of the walls' collision shapes at the rim [m], for the same reason."""
TOLERANCE = 2e-3
"""Distance of a facet's vertices from its plane [m], as of the tote's rounded corners; doubled until there are at most MAX_PIECES."""
MAX_TOLERANCE = 4e-3
MAX_PIECES = 64
"""Maximum number of collision shapes of a bin; the cost of the broad phase grows with the square of the shapes of a world."""
FACET_ANGLE = np.radians(30.0)
"""Largest angle of a face to the first face of its facet."""
STEEP = 0.7
"""z of a unit normal above which a facet is a floor."""
FREE = 3e-3
"""How far above the surface a point is free [m]."""
MAX_BLOCKED = 2.5e-5
"""Free area that the hull of a facet may cover [m²]; more cuts it."""
MIN_AREA = 4e-6
"""Facets of less area are left out [m²]: neighbours reach behind them."""
BURIED = 1e-4
"""Depth of a facet in a collision shape with which it is none of the surface [m]."""
CUTS = 48
"""Lines along the longest edges of a facet's border that are tried to cut it."""
RAY_GRID = 4
"""Points along each side of a polygon from which the depth of the solid is measured."""


@dataclass(frozen=True, eq=False)
class _Faces:
    """Triangles that bound the free space of a bin."""

    corners: np.ndarray
    """(F, 3, 3) [m]."""
    normal: np.ndarray
    """Unit normals towards the free space (F, 3)."""
    area: np.ndarray
    """(F) [m²]."""
    neighbors: list[list[int]]
    """Triangles beyond the edges of each."""


def make_colliders(vertices: np.ndarray, faces: np.ndarray, surface: BinSurface) -> tuple[ConvexPiece, ...]:
    """Build the collision shapes of a mesh, vertices (V, 3) [m], z up, and faces (F, 3), with the surface of its inside. Raises
    CatalogError: there are more than MAX_PIECES."""
    found = _visible_faces(vertices, faces, surface)
    tolerance = TOLERANCE
    while True:
        pieces: list[ConvexPiece] = []
        planes: list[np.ndarray] = []
        for facet in _grow_facets(found, tolerance):
            points = found.corners[facet].reshape(-1, 3)
            # Faces within a piece, as those of ribs that end in a wall, are none of the surface.
            if not any((matmul(points, each[:, :3].T) + each[:, 3]).max() < -BURIED for each in planes):
                fresh = _extrude(found, facet, surface)
                planes += [ConvexHull(piece.vertices.astype(np.float64)).equations for piece in fresh]
                pieces += fresh
        if len(pieces) <= MAX_PIECES:
            return tuple(pieces)
        tolerance *= 2.0
        if tolerance > MAX_TOLERANCE:
            raise CatalogError(
                f"the faces of its inside need {len(pieces)} convex collision shapes; allowed: {MAX_PIECES}; simplify the mesh"
            )


def make_box(surface: BinSurface, compartments: Sequence[Compartment], opening: np.ndarray) -> tuple[ConvexPiece, ...]:
    """Build a closed box: floors, walls between floors and opening, whose corners at the rim are given (2, 2), and dividers."""
    low, high = np.stack([enclose([one.span]) for one in compartments], axis=1)
    inner = enclose([one.span for one in compartments])
    outer = opening + np.array([[-MIN_WALL], [MIN_WALL]])
    deep = surface.floor - FLOOR_DEPTH
    pieces = []
    for end, axis in ((0, 0), (1, 0), (0, 1), (1, 1)):
        profile = [(inner[end, axis], deep), (inner[end, axis], surface.floor), (opening[end, axis], surface.rim)]
        pieces.append(_prism([*profile, (outer[end, axis], surface.rim), (outer[end, axis], deep)], axis, outer[:, 1 - axis]))
    for index, (a, b, c) in enumerate(one.plane for one in compartments):
        ends = np.where(low[index] <= inner[0], outer[0], low[index]), np.where(high[index] >= inner[1], outer[1], high[index])
        ground = [(x, y, a * x + b * y + c) for x, y in itertools.product(*zip(*ends, strict=True))]
        pieces.append(hull_piece(np.array([*ground, *((x, y, deep) for x, y, _ in ground)])))
    for first, second in itertools.permutations(range(len(compartments)), 2):
        for axis in (0, 1):
            overlap = min(high[[first, second], 1 - axis]) - max(low[[first, second], 1 - axis])
            between = low[:, axis] < low[second, axis]
            if overlap <= 0.0 or high[first, axis] > low[second, axis] or (between & (low[:, axis] > high[first, axis])).any():
                continue
            tops, level = [enclose([compartments[k].opening]) for k in (first, second)], compartments[first].level
            edges, across = (tops[0][1, axis], tops[1][0, axis]), enclose([compartments[k].opening for k in (first, second)])[:, 1 - axis]
            profile = [(high[first, axis], deep), (high[first, axis], surface.floor), (edges[0], level), (edges[1], level)]
            profile += [(low[second, axis], surface.floor), (low[second, axis], deep)]
            pieces.append(_prism(profile, axis, across))
    return tuple(pieces)


def _prism(profile: Sequence[tuple[float, float]], axis: int, ends: Sequence[float] | np.ndarray) -> ConvexPiece:
    """Convex hull of a profile (position along an axis, z) between two ends along the other axis."""
    return hull_piece(np.array([(at, end, z) if axis == 0 else (end, at, z) for at, z in profile for end in ends]))


def _visible_faces(vertices: np.ndarray, faces: np.ndarray, surface: BinSurface) -> _Faces:
    """Triangles in front of which there is the inside of the bin. The rim is the upper side of the prisms behind walls."""
    vertices, faces = merge_positions(vertices.astype(np.float64).round(7), faces)
    corners = vertices[faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(doubled, axis=1)
    normal = doubled / np.maximum(length, 1e-30)[:, None]
    small, owner = subdivide(corners, 4.0 * surface.cell)
    middle, count = small.mean(axis=1), np.bincount(owner, minlength=len(faces))

    def share_in_front(direction: np.ndarray) -> np.ndarray:
        """Fraction of each triangle before which there is free space."""
        points = middle + 1.5 * surface.cell * direction[owner]
        cells = surface.index(points)
        return np.bincount(owner, surface.inside[cells] & (points[:, 2] > surface.height[cells] + 1e-4), len(faces)) / count

    shown = share_in_front(normal) > 0.01
    # Sheets without thickness are seen from both sides.
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    if (uses == 1).any():
        behind = ~shown & (share_in_front(-normal) > 0.01)
        normal = np.where(behind[:, None], -normal, normal)
        shown |= behind
    kept = np.flatnonzero(shown & (length > 1e-12))
    return _Faces(corners[kept], normal[kept], length[kept] / 2.0, _list_neighbors(faces[kept]))


def _list_neighbors(faces: np.ndarray) -> list[list[int]]:
    """Triangles that share an edge with each triangle (F, 3)."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    index = np.unique(edges, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(index, kind="stable")
    result: list[list[int]] = [[] for _ in faces]
    for group in np.split(order // 3, np.flatnonzero(np.diff(index[order])) + 1):
        for face in group:
            result[face] += [int(other) for other in group if other != face]
    return result


def _grow_facets(faces: _Faces, tolerance: float) -> list[list[int]]:
    """Connected triangles within a tolerance [m] of the plane of the largest of them."""
    facets, free = [], np.ones(len(faces.area), bool)
    for first in np.argsort(-faces.area, kind="stable"):
        if not free[first]:
            continue
        normal, point = faces.normal[first], faces.corners[first, 0]
        flat = (np.abs(dot(faces.corners - point, normal)) <= tolerance).all(axis=1)
        flat &= dot(faces.normal, normal) > np.cos(FACET_ANGLE).round(DECIMALS)
        facet, waiting = [], deque([int(first)])
        free[first] = False
        while waiting:
            here = waiting.popleft()
            facet.append(here)
            for other in faces.neighbors[here]:
                if free[other] and flat[other]:
                    free[other] = False
                    waiting.append(other)
        if faces.area[facet].sum() >= MIN_AREA:
            facets.append(facet)
    return facets


def _extrude(faces: _Faces, facet: list[int], surface: BinSurface) -> list[ConvexPiece]:
    """Prisms behind a facet."""
    normal = dot(faces.normal[facet].T, faces.area[facet])
    normal /= norm(normal)
    frame = _plane_axes(normal)
    pieces = []
    for polygons in _cut([*faces.corners[facet]], normal, frame, surface):
        points = np.concatenate(polygons)
        if normal[2] > STEEP:
            move = np.array([0.0, 0.0, -FLOOR_DEPTH])
        else:
            out = -normal[:2] / max(float(norm(normal[:2])), 1e-9)
            move = np.array([*out, 0.0])
            move *= min(MIN_WALL, _solid_depth(points, normal, frame, move, faces) / 2.0)
        try:
            pieces.append(hull_piece(np.concatenate([points, points + move])))
        except (QhullError, ValueError):
            continue  # Degenerate: a sliver beside others.
    return pieces


def _plane_axes(normal: np.ndarray) -> np.ndarray:
    """Two unit vectors (2, 3) perpendicular to a normal."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= norm(first)
    return np.stack([first, np.cross(normal, first)])


def _hull_corners(flat: np.ndarray) -> np.ndarray | None:
    """Corners of the convex hull of points in a plane (N, 2), counter-clockwise; None: they are on a line."""
    try:
        hull = ConvexHull(flat)
    except QhullError:
        return None
    return flat[hull.vertices] if hull.volume > 1e-9 else None


def _cut(polygons: list[np.ndarray], normal: np.ndarray, frame: np.ndarray, surface: BinSurface) -> list[list[np.ndarray]]:
    """Cut a facet, given as polygons (n, 3), until the hull of each part covers no free space."""
    done, waiting = [], [polygons]
    while waiting:
        part = waiting.pop()
        hull = _hull_corners(matmul(np.concatenate(part), frame.T))
        if hull is None:
            continue
        if len(part) == 1 or _blocked_area(part, hull, normal, frame, surface) <= MAX_BLOCKED:
            done.append(part)
            continue
        parts = _best_cut(part, frame)
        if parts is None:
            waiting += [[one] for one in part]
        else:
            waiting += parts
    return done


def _blocked_area(part: list[np.ndarray], hull: np.ndarray, normal: np.ndarray, frame: np.ndarray, surface: BinSurface) -> float:
    """Area [m²] of a facet's hull that is no part of the facet, and in free space."""
    step = max(surface.cell / 2.0, float(np.ptp(hull, axis=0).max()) / 200.0)
    low, high = hull.min(axis=0), hull.max(axis=0)
    axes = [np.arange(low[axis] + step / 2.0, high[axis], step) for axis in (0, 1)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    open_points = points[_in_polygon(points, hull)]
    for polygon in part:
        open_points = open_points[~_in_polygon(open_points, matmul(polygon, frame.T), step / 2.0)]
    where = float(dot(np.concatenate(part), normal).mean())
    space = matmul(open_points, frame) + where * normal
    cells = surface.index(space)
    free = surface.near_inside[cells] & (space[:, 2] > surface.closed[cells] + FREE)
    return float(free.sum()) * step * step


def _in_polygon(points: np.ndarray, polygon: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Whether points (N, 2) lie in a convex polygon of any direction, widened by a margin."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    length = np.maximum(np.linalg.norm(edges, axis=1), 1e-12)
    outward = np.column_stack([edges[:, 1], -edges[:, 0]]) / length[:, None]
    if ((polygon.mean(axis=0) - polygon) * outward).sum() > 0.0:
        outward = -outward
    return ((matmul(points, outward.T) - dot(polygon, outward)) <= margin).all(axis=1)


def _best_cut(part: list[np.ndarray], frame: np.ndarray) -> list[list[np.ndarray]] | None:
    """Cut along a border edge, such that the hulls of both sides cover least beyond the facet; None: no edge does."""
    best, found = np.inf, None
    for point, along in _border_edges(part, frame):
        across = np.array([along[1], -along[0]])
        sides: list[list[np.ndarray]] = [[], []]
        for polygon in part:
            distance = dot(matmul(polygon, frame.T) - point, across)
            for side, sign in enumerate((1.0, -1.0)):
                clipped = _clip(polygon, sign * distance)
                if clipped is not None:
                    sides[side].append(clipped)
        hulls = [_hull_corners(matmul(np.concatenate(side), frame.T)) if side else None for side in sides]
        if hulls[0] is None or hulls[1] is None:
            continue
        size = sum(_polygon_area(hull) for hull in hulls if hull is not None)
        if size < best:
            best, found = size, sides
    return found


def _border_edges(part: list[np.ndarray], frame: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Point and direction in the plane of the longest edges of polygons that no other polygon shares."""
    starts = np.concatenate([matmul(polygon, frame.T) for polygon in part])
    ends = np.concatenate([matmul(np.roll(polygon, -1, axis=0), frame.T) for polygon in part])
    keys = np.sort(np.stack([starts, ends], axis=1).round(6).view(), axis=1).reshape(-1, 4)
    _, index, uses = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    border = np.flatnonzero(uses[index.reshape(-1)] == 1)
    lengths = np.linalg.norm(ends - starts, axis=1)
    border = border[np.argsort(-lengths[border], kind="stable")]
    border = border[lengths[border] > 1e-6][:CUTS]
    return [(starts[edge], (ends[edge] - starts[edge]) / lengths[edge]) for edge in border]


def _clip(polygon: np.ndarray, distance: np.ndarray) -> np.ndarray | None:
    """Part of a convex polygon (n, 3) where a linear function, given at its corners, is positive (Sutherland-Hodgman); None: nothing."""
    if (distance <= 1e-9).all():
        return None
    if (distance >= -1e-9).all():
        return polygon
    result = []
    for index in range(len(polygon)):
        here, there = distance[index - 1], distance[index]
        if here * there < 0.0:
            share = here / (here - there)
            result.append(polygon[index - 1] + share * (polygon[index] - polygon[index - 1]))
        if there >= 0.0:
            result.append(polygon[index])
    return np.array(result) if len(result) >= 3 else None


def _polygon_area(corners: np.ndarray) -> float:
    """Area of a polygon (n, 2), counter-clockwise."""
    x, y = corners.T
    return float(dot(x, np.roll(y, -1)) - dot(y, np.roll(x, -1))) / 2.0


def _solid_depth(points: np.ndarray, normal: np.ndarray, frame: np.ndarray, direction: np.ndarray, faces: _Faces) -> float:
    """Least distance behind a polygon at which there is free space again, by rays against the visible faces [m].

    Möller-Trumbore intersection; the rays start on a grid in the hull of the points.
    """
    hull = _hull_corners(matmul(points, frame.T))
    if hull is None:
        return np.inf
    low, high = hull.min(axis=0), hull.max(axis=0)
    shares = (np.arange(RAY_GRID) + 0.5) / RAY_GRID
    grid = low + np.stack(np.meshgrid(shares, shares), axis=-1).reshape(-1, 2) * (high - low)
    grid = np.concatenate([grid[_in_polygon(grid, hull)], hull.mean(axis=0)[None], 0.95 * hull + 0.05 * hull.mean(axis=0)])
    starts = matmul(grid, frame) + float(dot(points, normal).mean()) * normal
    toward = dot(faces.normal, direction) > 0.1
    corners = faces.corners[toward]
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(direction, edge2)
    determinant = np.einsum("fi,fi->f", edge1, cross)
    usable = np.abs(determinant) > 1e-14
    inverse = 1.0 / np.where(usable, determinant, 1.0)
    nearest = np.inf
    for start in starts:
        offset = start - corners[:, 0]
        u = np.einsum("fi,fi->f", offset, cross) * inverse
        other = np.cross(offset, edge1)
        v, distance = dot(other, direction) * inverse, np.einsum("fi,fi->f", edge2, other) * inverse
        hit = usable & (u >= -1e-6) & (v >= -1e-6) & (u + v <= 1.0 + 1e-6) & (distance > 1e-4)
        nearest = min(nearest, float(distance[hit].min(initial=np.inf)))
    return nearest
