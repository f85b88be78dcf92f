"""Meshes of bins for tests: solids of boxes, with known floors, walls and dividers [m]."""

from __future__ import annotations

import numpy as np
import trimesh

from synpick_warp.configs.cell.bins import Tote
from synpick_warp.scenes.tote import tote_fixture

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
    mesh = trimesh.creation.icosphere(4, 0.2)
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
