"""The suction gripper: a conical shaft, and a suction cup with bellows on a wrist joint.

The origins of both bodies' frames lie on the wrist axis, which is y; z up.
"""

from __future__ import annotations

import numpy as np

from synpick_warp.configs.schema import Gripper
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.modelling import join, lathe, make_mesh, solid
from synpick_warp.scenes.types import ConvexPiece, Fixture, Material

SIDES = 40
"""Points per ring of the visual meshes."""
FINGER_TIP = 0.03
"""Maximum diameter of the shaft at the wrist axis [m]; at most that of its top."""
COLLIDER_SIDES = 12
"""Points per ring of the collision shapes: the cup's rings, two of these and one of STEM_SIDES, have 32 vertices."""
STEM_SIDES = 8
"""Points of the ring at the top of the cup's collision shape."""
LIP = 0.06
"""Height of the cup's lip, as a fraction of the cup's length."""
HINGE = 0.4
"""Radius of wrist joint and cup stem, as a fraction of the cup's."""
FOLDS = 3
"""Folds of the bellows."""


def finger_fixture(gripper: Gripper) -> Fixture:
    """Build the visual mesh of the shaft, a surface of revolution from the wrist axis (z = 0) up to z = finger_length."""
    low, high, length = *_finger_radii(gripper), gripper.finger_length

    def radius(fraction: float) -> float:
        """Radius of the cone at a fraction of the length [m]."""
        return low + fraction * (high - low)

    profile = [(0.7 * low, 0.0), (low, 0.3 * low)]
    for height in (0.3, 0.6, 0.9):
        # Grooves around the cone make its shading vary.
        depth, half = 0.06 * radius(height), 0.004
        profile += [(radius(height - half), (height - half) * length), (radius(height) - depth, height * length)]
        profile += [(radius(height + half), (height + half) * length)]
    profile += [(high, 0.99 * length), (0.96 * high, length)]
    mesh = make_mesh(solid(lathe(profile, SIDES)), centered=False)
    return Fixture(mesh, Material(gripper.color, None, gripper.metallic, gripper.roughness))


def cup_fixture(gripper: Gripper) -> Fixture:
    """Build the visual mesh of the cup, a surface of revolution from the wrist axis down to the lip at z = -cup_length; hollow below."""
    radius, length = gripper.cup_width / 2, gripper.cup_length
    stem = HINGE * radius
    profile = [(0.15 * radius, -0.84 * length), (0.55 * radius, -0.88 * length), (0.90 * radius, -length), (radius, -length)]
    profile += [(radius, -(1 - LIP) * length)]
    fold = 0.36 * length / FOLDS
    for index in range(FOLDS):
        base = -0.90 * length + index * fold
        bulge = (0.88 - 0.06 * index) * radius
        profile += [(0.62 * radius, base), (bulge, base + 0.4 * fold), (bulge, base + 0.6 * fold)]
    profile += [(0.62 * radius, -0.54 * length), (0.62 * radius, -0.46 * length), (stem, -0.44 * length), (stem, 0.0)]
    hinge = solid(lathe([(0.9 * stem, -1.15 * stem), (stem, -1.05 * stem), (stem, 1.05 * stem), (0.9 * stem, 1.15 * stem)], SIDES))
    mesh = make_mesh(join(solid(lathe(profile, SIDES)), hinge.rotate("x", 90.0)), centered=False)
    return Fixture(mesh, Material(gripper.cup_color, None, gripper.metallic, gripper.roughness))


def finger_collider(gripper: Gripper) -> ConvexPiece:
    """Build the collision shape of the shaft: its cone."""
    low, high = _finger_radii(gripper)
    rings = lathe([(low, 0.0), (high, gripper.finger_length)], COLLIDER_SIDES)
    return simplify_hull(rings.reshape(-1, 3), 2 * COLLIDER_SIDES)


def cup_collider(gripper: Gripper) -> ConvexPiece:
    """Build the collision shape of the cup, without bellows: lip, and a cone up to the stem; at most 32 vertices."""
    radius, length = gripper.cup_width / 2, gripper.cup_length
    lip = lathe([(radius, -length), (radius, -(1 - LIP) * length)], COLLIDER_SIDES).reshape(-1, 3)
    stem = lathe([(HINGE * radius, 0.0)], STEM_SIDES)[0]
    points = np.concatenate([lip, stem])
    return simplify_hull(points, len(points))


def rod_inertia(mass: float, length: float) -> tuple[float, float, float]:
    """Principal moments of inertia [kg·m²] of a cylinder along z whose diameter is a quarter of its length, as for shaft and cup."""
    radius = length / 8
    across = mass * (length**2 + 3 * radius**2) / 12
    return across, across, mass * radius**2 / 2


def _finger_radii(gripper: Gripper) -> tuple[float, float]:
    """Radii of the gripper shaft [m]: at the wrist joint, and at its upper end."""
    return min(FINGER_TIP, gripper.finger_width) / 2, gripper.finger_width / 2
