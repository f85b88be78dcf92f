"""The gripper: a cone-shaped finger and a suction cup with bellows. Both frames lie on the tilt axis, which is y; z up."""

from __future__ import annotations

import numpy as np

from synpick_warp.configs.schema import Gripper
from synpick_warp.scenes.collision.hulls import simplify_hull
from synpick_warp.scenes.embedded.meshes import join, lathe, make_mesh, solid
from synpick_warp.scenes.types import ConvexPiece, Fixture, Material

SIDES = 40
"""Points around the visible parts."""
FINGER_TIP = 0.03
"""Width of the finger at the tilt axis [m]; no wider than its top."""
COLLIDER_SIDES = 12
"""Points around the collision shapes: three rings of at most this many stay below 32 vertices."""
SHOULDER_SIDES = 8
LIP = 0.06
"""Height of the cup's lip, as a share of the cup's length."""
HINGE = 0.4
"""Radius of hinge and shaft, as a share of the cup's."""
FOLDS = 3
"""Folds of the bellows."""


def finger_fixture(gripper: Gripper) -> Fixture:
    """The finger, from the tilt axis (z = 0) up to its length."""
    low, high, length = *_finger_radii(gripper), gripper.finger_length

    def radius(share: float) -> float:
        return low + share * (high - low)

    profile = [(0.7 * low, 0.0), (low, 0.3 * low)]
    for share in (0.3, 0.6, 0.9):
        # A groove around the cone shows how it turns with the light.
        depth, half = 0.06 * radius(share), 0.004
        profile += [(radius(share - half), (share - half) * length), (radius(share) - depth, share * length)]
        profile += [(radius(share + half), (share + half) * length)]
    profile += [(high, 0.99 * length), (0.96 * high, length)]
    mesh = make_mesh(solid(lathe(profile, SIDES)), centered=False)
    return Fixture(mesh, Material(gripper.color, None, gripper.metallic, gripper.roughness))


def cup_fixture(gripper: Gripper) -> Fixture:
    """The cup, from its hinge down to the lip at z = -cup_length; hollow below."""
    radius, length = gripper.cup_width / 2, gripper.cup_length
    shaft = HINGE * radius
    profile = [(0.15 * radius, -0.84 * length), (0.55 * radius, -0.88 * length), (0.90 * radius, -length), (radius, -length)]
    profile += [(radius, -(1 - LIP) * length)]
    fold = 0.36 * length / FOLDS
    for index in range(FOLDS):
        base = -0.90 * length + index * fold
        bulge = (0.88 - 0.06 * index) * radius
        profile += [(0.62 * radius, base), (bulge, base + 0.4 * fold), (bulge, base + 0.6 * fold)]
    profile += [(0.62 * radius, -0.54 * length), (0.62 * radius, -0.46 * length), (shaft, -0.44 * length), (shaft, 0.0)]
    hinge = solid(lathe([(0.9 * shaft, -1.15 * shaft), (shaft, -1.05 * shaft), (shaft, 1.05 * shaft), (0.9 * shaft, 1.15 * shaft)], SIDES))
    mesh = make_mesh(join(solid(lathe(profile, SIDES)), hinge.turned("x", 90.0)), centered=False)
    return Fixture(mesh, Material(gripper.cup_color, None, gripper.metallic, gripper.roughness))


def finger_collider(gripper: Gripper) -> ConvexPiece:
    """The finger's cone."""
    low, high = _finger_radii(gripper)
    rings = lathe([(low, 0.0), (high, gripper.finger_length)], COLLIDER_SIDES)
    return simplify_hull(rings.reshape(-1, 3), 2 * COLLIDER_SIDES)


def cup_collider(gripper: Gripper) -> ConvexPiece:
    """The cup without its folds: lip, and a cone up to the shaft; at most 32 vertices."""
    radius, length = gripper.cup_width / 2, gripper.cup_length
    lip = lathe([(radius, -length), (radius, -(1 - LIP) * length)], COLLIDER_SIDES).reshape(-1, 3)
    shaft = lathe([(HINGE * radius, 0.0)], SHOULDER_SIDES)[0]
    points = np.concatenate([lip, shaft])
    return simplify_hull(points, len(points))


def rod_inertia(mass: float, length: float) -> tuple[float, float, float]:
    """Principal inertia [kg·m²] of a rod along z as thick as a quarter of its length: that of finger and cup."""
    radius = length / 8
    across = mass * (length**2 + 3 * radius**2) / 12
    return across, across, mass * radius**2 / 2


def _finger_radii(gripper: Gripper) -> tuple[float, float]:
    return min(FINGER_TIP, gripper.finger_width) / 2, gripper.finger_width / 2
