"""Meshes of bins for tests: solids of boxes, with known floors, walls and dividers [m]."""

import itertools

import numpy as np
import trimesh

from synpick_warp.configs.cell.bins import Tote
from synpick_warp.scenes.bins import tote_fixture

Mesh = trimesh.Trimesh


def block(low, high) -> Mesh:
    """Box between two corners."""
    low, high = np.array(low, float), np.array(high, float)
    return trimesh.creation.box(high - low, trimesh.transformations.translation_matrix((low + high) / 2))


def wedge(low, high, rise: float) -> Mesh:
    """Box whose upper side rises by `rise` towards positive x."""
    mesh = block(low, high)
    top = mesh.vertices[:, 2] == mesh.vertices[:, 2].max()
    mesh.vertices[top & (mesh.vertices[:, 0] > np.mean((low[0], high[0]))), 2] += rise
    return mesh


def walls(length: float, width: float, height: float, thickness: float, low: float = 0.0) -> list[Mesh]:
    """Four upright walls about an inside of a length and width, centred."""
    x, y, t = length / 2, width / 2, thickness
    return [
        block((-x - t, -y - t, low), (-x, y + t, height)),
        block((x, -y - t, low), (x + t, y + t, height)),
        block((-x, -y - t, low), (x, -y, height)),
        block((-x, y, low), (x, y + t, height)),
    ]


def sloped_bin(rise: float = 0.04, divider: float = 0.1) -> Mesh:
    """Inside of 0.4 x 0.3 x 0.2 m whose floor rises along x; a divider, 6 mm thick, at x = 0.05."""
    floor = wedge((-0.2, -0.15, -0.004), (0.2, 0.15, 0.0), rise)
    parts = [floor, *walls(0.4, 0.3, 0.2, 0.004, -0.004)]
    if divider:
        parts.append(block((0.047, -0.15, -0.002), (0.053, 0.15, divider)))
    return trimesh.util.concatenate(parts)


def round_bin(radius: float = 0.15, height: float = 0.15, sections: int = 48) -> Mesh:
    """A cup: a disc of 5 mm with a ring of 5 mm."""
    ring = trimesh.creation.annulus(radius, radius + 0.005, height, sections=sections)
    ring.apply_translation((0, 0, height / 2))
    disc = trimesh.creation.cylinder(radius + 0.005, 0.005, sections=sections)
    disc.apply_translation((0, 0, -0.0025))
    return trimesh.util.concatenate([ring, disc])


def bracket(size: float = 60.0) -> Mesh:
    """An L-profile with a long leg of `size` and a hole's boss, in any unit; one solid of two boxes."""
    t = 0.15 * size
    return trimesh.util.concatenate([block((0, 0, 0), (size, 0.5 * size, t)), block((0, 0, t), (t, 0.5 * size, 0.6 * size))])


def low_front() -> Mesh:
    """Inside of 0.4 x 0.2 x 0.12 m, whose front wall, at negative x, is 0.05 m high; drain holes in its floor."""
    strips = [(-0.1, -0.045), (-0.035, 0.035), (0.045, 0.1)]
    floor = [block((-0.2, low, -0.004), (0.2, high, 0.0)) for low, high in strips]
    floor += [
        block((x - 0.055, low, -0.004), (x + 0.055, high, 0.0))
        for low, high in ((-0.045, -0.035), (0.035, 0.045))
        for x in (-0.12, 0.0, 0.12)
    ]
    front = block((-0.203, -0.103, 0.0), (-0.2, 0.103, 0.05))
    return trimesh.util.concatenate([*floor, front, *walls(0.4, 0.2, 0.12, 0.003)[1:]])


def stepped_bin() -> Mesh:
    """As `sloped_bin` with a level floor, and a step of 30 mm in a corner of it."""
    return trimesh.util.concatenate([sloped_bin(0.0, 0.0), block((0.1, -0.15, -0.002), (0.2, 0.0, 0.03))])


def bowl() -> Mesh:
    """Lower half of the surface of a sphere with a radius of 0.2 m."""
    mesh = trimesh.creation.icosphere(3, 0.2)
    return Mesh(mesh.vertices, mesh.faces[mesh.triangles_center[:, 2] < 0.0])


def tote() -> Mesh:
    """The tote's visual mesh: draft, rounded corners, flange, and ribs that end within its walls."""
    mesh = tote_fixture(Tote()).mesh
    return Mesh(mesh.vertices, mesh.faces)


def sheet_bin() -> Mesh:
    """Inside of 0.4 x 0.2 x 0.2 m, of sheets without thickness."""
    box = block((-0.2, -0.1, 0.0), (0.2, 0.1, 0.2))
    return Mesh(box.vertices, box.faces[box.triangles_center[:, 2] < 0.19])


def wall_of_floor() -> Mesh:
    """A block with a slot of 20 mm, too narrow for a compartment."""
    return trimesh.util.concatenate(
        [block((0.0, 0.0, -0.1), (0.4, 0.3, 0.0)), *(each.apply_translation((0.2, 0.15, 0)) for each in walls(0.02, 0.28, 0.1, 0.01))]
    )


def frustum(
    floor: tuple[float, float] = (0.412, 0.262),
    drafts: tuple[float, float, float, float] = (12.0, 12.0, 12.0, 12.0),
    height: float = 0.176,
    wall: float = 0.004,
    radius: float = 0.0,
    hole: float = 0.0,
) -> Mesh:
    """An open box whose inner floor is about the origin.

    Args:
        floor: Length and width.
        drafts: Angles of the walls at negative x, positive x, negative y, positive y [°].
        height: Of the rim.
        wall: Thickness; 0: a surface alone.
        radius: Of the inner vertical edges.
        hole: Side of a square hole in the middle of the floor.
    """
    slopes, low = np.tan(np.radians(drafts)).reshape(2, 2), np.array(floor) / 2

    def ring(z: float, out: float = 0.0) -> np.ndarray:
        ends = np.array([-low, low]) + (np.array([[-1], [1]]) * (slopes.T * max(z, 0.0) + out))
        return _ring(ends, radius + out, z)

    inside = [ring(0.0), ring(height)]
    shells = [inside] if wall == 0.0 else [inside, [ring(height), ring(height, wall), ring(-wall, wall)]]
    pieces = [_loft(*pair) for shell in shells for pair in itertools.pairwise(shell)]
    for level, flip in ((0.0, True), (-wall, False))[: len(shells)]:
        edge = _ring(np.array([(-0.5, -0.5), (0.5, 0.5)]) * max(hole, 1e-9), 0.3 * hole * (radius > 0), level)
        pieces.append(_loft(*((ring(level, wall if level else 0.0), edge) if not flip else (edge, ring(level)))))
    if hole and wall:
        edges = [_ring(np.array([(-0.5, -0.5), (0.5, 0.5)]) * hole, 0.3 * hole * (radius > 0), level) for level in (-wall, 0.0)]
        pieces.append(_loft(*edges))
    result = trimesh.util.concatenate(pieces)
    result.merge_vertices()
    return result


def _ring(ends: np.ndarray, radius: float, z: float) -> np.ndarray:
    """Rectangle between two corners (2, 2) with rounded corners, counter-clockwise (36, 3)."""
    angles = np.radians(np.arange(0.0, 100.0, 11.25))
    centers = [
        (ends[i, 0] - s * radius, ends[j, 1] - t * radius) for i, j, s, t in ((1, 1, 1, 1), (0, 1, -1, 1), (0, 0, -1, -1), (1, 0, 1, -1))
    ]
    arcs = [
        np.array(center) + radius * np.column_stack([np.cos(angles + turn), np.sin(angles + turn)])
        for center, turn in zip(centers, np.arange(4) * np.pi / 2, strict=True)
    ]
    points = np.concatenate(arcs)
    return np.column_stack([points, np.full(len(points), z)])


def _loft(first: np.ndarray, second: np.ndarray) -> Mesh:
    """Quads between two rings, as triangles that face inward if the second is above the first."""
    count = len(first)
    here, there = np.arange(count), (np.arange(count) + 1) % count
    faces = np.concatenate([np.column_stack([here, here + count, there]), np.column_stack([there, here + count, there + count])])
    mesh = Mesh(np.concatenate([first, second]), faces, process=False)
    mesh.update_faces(mesh.area_faces > 1e-14)
    return mesh


def basket(draft: float = 0.0, gap: float = 0.03, wire: float = 0.004, sections: int = 8) -> Mesh:
    """Wire basket: 0.4 x 0.3 m between centre lines of the floor's wires, 0.15 m high, with a draft angle of its walls [°]."""
    half, rise = np.array((0.2, 0.15)), 0.15 * np.tan(np.radians(draft))
    lines = []
    for axis in (0, 1):
        for at in np.arange(-half[axis], half[axis] + gap / 2, gap):
            share = at / half[axis]
            ends = [
                (share * (half[axis] + up), side * (half[1 - axis] + up), z) for side in (-1, 1) for up, z in ((rise, 0.15), (0.0, 0.0))
            ]
            ends = [point if axis == 0 else (point[1], point[0], point[2]) for point in ends]
            lines += [(ends[0], ends[1]), (ends[1], ends[3]), (ends[3], ends[2])]
    for z in (0.05, 0.1, 0.15):
        x, y = half + rise * z / 0.15
        corners = [(x, y, z), (-x, y, z), (-x, -y, z), (x, -y, z)]
        lines += list(zip(corners, [*corners[1:], corners[0]], strict=True))
    return trimesh.util.concatenate([trimesh.creation.cylinder(wire / 2, segment=line, sections=sections) for line in lines])


def heights(mesh, points: np.ndarray) -> np.ndarray:
    """Largest height of a mesh over points (N, 2), by barycentric coordinates of all triangles."""
    corners = mesh.vertices[mesh.faces].astype(float)
    a, b, c = corners[:, 0, :2], corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2]
    area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    corners, a, b, c, area = (each[np.abs(area) > 1e-10] for each in (corners, a, b, c, area))
    result = np.full(len(points), -1.0)
    for part in np.array_split(np.arange(len(points)), 40):
        d = points[part][:, None] - a
        u, v = (d[..., 0] * c[:, 1] - d[..., 1] * c[:, 0]) / area, (d[..., 1] * b[:, 0] - d[..., 0] * b[:, 1]) / area
        z = corners[:, 0, 2] + u * (corners[:, 1, 2] - corners[:, 0, 2]) + v * (corners[:, 2, 2] - corners[:, 0, 2])
        result[part] = np.where((u >= 0) & (v >= 0) & (u + v <= 1), z, -1.0).max(axis=1)
    return result
