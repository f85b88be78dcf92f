"""Gripper `suction_array`: suction cups at given places under a plate, whose middle is on the wrist's axis."""

from __future__ import annotations

import numpy as np

from synpick_warp.configs.cell.gripper import COMMON, Gripper
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.grippers.head import COLLIDER_SIDES, SIDES, Head
from synpick_warp.scenes.grippers.suction1 import HINGE, LIP, STEM_SIDES, cup_patch, hinge_patch
from synpick_warp.scenes.modelling import at_height, join, lathe, make_mesh, rounded_rectangle, solid
from synpick_warp.scenes.types import ConvexPiece, Fixture, Material

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


def make_head(gripper: Gripper) -> Head:
    """Build the head of the cups `gripper.cups`."""
    pieces = (_plate_collider(gripper), *(_cup_collider(gripper, x, y) for x, y in gripper.cups))
    return Head(_fixture(gripper), pieces, _inertia(gripper), gripper.cups, gripper.valve == COMMON)


def _sides(gripper: Gripper) -> tuple[float, float]:
    """Length and width of the plate, symmetric about the axis [m]."""
    x, y = (2 * np.abs(np.array(gripper.cups)).max(axis=0) + gripper.cup_width).tolist()
    return x, y


def _outline(gripper: Gripper, segments: int) -> np.ndarray:
    """Outline of the plate: a rounded rectangle (point, 2) [m]."""
    return rounded_rectangle(*_sides(gripper), CORNER * gripper.cup_width, segments)


def _fixture(gripper: Gripper) -> Fixture:
    """Build the visual mesh: plate, stem and hinge on the wrist axis, and a cup with bellows at each place."""
    ring, length = _outline(gripper, CORNER_SEGMENTS), gripper.cup_length
    low, high = PLATE
    heights = ((INSET, low), (1.0, low + BEVEL), (1.0, high - BEVEL), (INSET, high))
    plate = solid(np.stack([at_height(scale * ring, z * length) for scale, z in heights]))
    radius = HINGE * gripper.cup_width / 2
    stem = solid(lathe([(radius, (high - BEVEL) * length), (radius, 0.0)], SIDES))
    cups = [cup_patch(gripper, low + BEVEL).translate(x, y, 0.0) for x, y in gripper.cups]
    mesh = make_mesh(join(plate, stem, hinge_patch(gripper), *cups), centered=False)
    return Fixture(mesh, Material(gripper.cup_color, None, gripper.metallic, gripper.roughness))


def _plate_collider(gripper: Gripper) -> ConvexPiece:
    """Build the collision shape of the plate: at most 32 vertices."""
    points = np.concatenate([at_height(_outline(gripper, 2), z * gripper.cup_length) for z in PLATE])
    return simplify_hull(points, len(points))


def _cup_collider(gripper: Gripper, x: float, y: float) -> ConvexPiece:
    """Build the collision shape of the cup at (x, y) [m]: lip, and a cone up to the plate."""
    radius, length = gripper.cup_width / 2, gripper.cup_length
    lip = lathe([(radius, -length), (radius, -(1 - LIP) * length)], COLLIDER_SIDES).reshape(-1, 3)
    top = lathe([(TAPER * radius, PLATE[0] * length)], STEM_SIDES)[0]
    points = np.concatenate([lip, top]) + np.array([x, y, 0.0])
    return simplify_hull(points, len(points))


def _inertia(gripper: Gripper) -> tuple[float, float, float]:
    """Principal moments of inertia [kg·m²] of a box about plate and cups."""
    x, y, z = (*_sides(gripper), gripper.cup_length)
    share = gripper.cup_mass / 12
    return share * (y * y + z * z), share * (x * x + z * z), share * (x * x + y * y)
