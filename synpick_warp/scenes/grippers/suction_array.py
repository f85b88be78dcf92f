"""Gripper `suction_array`: suction cups at given places under a body, a plate whose middle is on the wrist's axis or a mesh."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from synpick_warp.configs.cell.gripper import COMMON, Gripper
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.grippers.head import COLLIDER_SIDES, SIDES, Head
from synpick_warp.scenes.grippers.suction1 import HINGE, LIP, STEM_SIDES, cup_patch, hinge_patch
from synpick_warp.scenes.grippers.tool_mesh import read_body
from synpick_warp.scenes.modelling import Patch, at_height, join, lathe, make_mesh, rounded_rectangle, solid
from synpick_warp.scenes.types import ConvexPiece, Fixture, Material, TriangleMesh

PLATE = (-0.42, -0.22)
"""Lower and upper side of the plate, as fractions of the cup's length."""
BEVEL = 0.02
"""Height of its bevelled edges, as fraction of the cup's length; cups and stem end this deep in it."""
CORNER = 0.45
"""Radius of its rounded corners, in widths of a cup: less than a half, so that its sides keep a length about a single row of cups."""
INSET = 0.98
"""Outline of its upper and lower side, relative to that between the bevels."""
CORNER_SEGMENTS = 6
"""Segments of a rounded corner of the plate."""
TAPER = 0.5
"""Radius of a cup's collision shape at the plate, as a fraction of the cup's."""
HULL_VERTICES = 32
"""Vertices of the collision shape of a mesh."""


def make_head(gripper: Gripper) -> Head:
    """Build the head of the cups `gripper.cups`, with a plate or the body of `gripper.mesh`.

    Raises:
        ConfigError: The mesh cannot be used, or is not the one that was measured.
    """
    if gripper.mesh:
        return _mesh_head(gripper)
    top, sides = PLATE[0], _sides(gripper)
    pieces = (_plate_collider(gripper), *(_cup_collider(gripper, place, top) for place in gripper.cups))
    patches = (*_plate(gripper), *_cup_patches(gripper, [top] * len(gripper.cups)))
    return _head(gripper, make_mesh(join(*patches), centered=False), pieces, (*sides, gripper.cup_length))


def _mesh_head(gripper: Gripper) -> Head:
    """Build the head whose body is a mesh; its collision shape is the convex hull."""
    body = read_body(gripper)
    if gripper.mesh_checksum not in ("", body.checksum):
        raise ConfigError(f"gripper.mesh: {gripper.mesh} is not the mesh that was measured; restore it, or bake again into another folder")
    tops = [height / gripper.cup_length - 1.0 for height in body.undersides]
    cups = make_mesh(join(*_cup_patches(gripper, tops)), centered=False)
    names = ("vertices", "normals", "uv")
    arrays = {name: np.concatenate([getattr(body.mesh, name), getattr(cups, name)]) for name in names}
    mesh = TriangleMesh(faces=np.concatenate([body.mesh.faces, cups.faces + len(body.mesh.vertices)]), **arrays)
    hull = simplify_hull(body.mesh.vertices.astype(np.float64), HULL_VERTICES)
    pieces = (hull, *(_cup_collider(gripper, *cup) for cup in zip(gripper.cups, tops, strict=True)))
    x, y, z = np.ptp(mesh.vertices, axis=0).tolist()
    return _head(gripper, mesh, pieces, (x, y, z))


def _head(gripper: Gripper, mesh: TriangleMesh, pieces: tuple[ConvexPiece, ...], box: tuple[float, float, float]) -> Head:
    """Head of a mesh and collision shapes, with the inertia of a box of these sides [m]."""
    x, y, z = box
    share = gripper.cup_mass / 12
    inertia = share * (y * y + z * z), share * (x * x + z * z), share * (x * x + y * y)
    fixture = Fixture(mesh, Material(gripper.cup_color, None, gripper.metallic, gripper.roughness))
    return Head(fixture, pieces, inertia, gripper.cups, gripper.valve == COMMON)


def _sides(gripper: Gripper) -> tuple[float, float]:
    """Length and width of the plate, symmetric about the axis [m]."""
    x, y = (2 * np.abs(np.array(gripper.cups)).max(axis=0) + gripper.cup_width).tolist()
    return x, y


def _outline(gripper: Gripper, segments: int) -> np.ndarray:
    """Outline of the plate: a rounded rectangle (point, 2) [m]."""
    return rounded_rectangle(*_sides(gripper), CORNER * gripper.cup_width, segments)


def _plate(gripper: Gripper) -> tuple[Patch, Patch, Patch]:
    """Surfaces of plate, stem and hinge on the wrist axis."""
    ring, length = _outline(gripper, CORNER_SEGMENTS), gripper.cup_length
    low, high = PLATE
    heights = ((INSET, low), (1.0, low + BEVEL), (1.0, high - BEVEL), (INSET, high))
    plate = solid(np.stack([at_height(scale * ring, z * length) for scale, z in heights]))
    radius = HINGE * gripper.cup_width / 2
    stem = solid(lathe([(radius, (high - BEVEL) * length), (radius, 0.0)], SIDES))
    return plate, stem, hinge_patch(gripper)


def _cup_patches(gripper: Gripper, tops: Sequence[float]) -> list[Patch]:
    """Surface of each cup, which ends in the body whose lower side is at `tops` [cup lengths]."""
    places = zip(gripper.cups, tops, strict=True)
    return [cup_patch(gripper, top + BEVEL).translate(x, y, 0.0) for (x, y), top in places]


def _plate_collider(gripper: Gripper) -> ConvexPiece:
    """Build the collision shape of the plate: at most 32 vertices."""
    points = np.concatenate([at_height(_outline(gripper, 2), z * gripper.cup_length) for z in PLATE])
    return simplify_hull(points, len(points))


def _cup_collider(gripper: Gripper, place: tuple[float, float], top: float) -> ConvexPiece:
    """Build the collision shape of the cup at a place [m]: lip, and a cone up to the body at `top` [cup lengths]."""
    radius, length = gripper.cup_width / 2, gripper.cup_length
    lip = lathe([(radius, -length), (radius, -(1 - LIP) * length)], COLLIDER_SIDES).reshape(-1, 3)
    cone = lathe([(TAPER * radius, top * length)], STEM_SIDES)[0]
    points = np.concatenate([lip, cone]) + np.array([*place, 0.0])
    return simplify_hull(points, len(points))
