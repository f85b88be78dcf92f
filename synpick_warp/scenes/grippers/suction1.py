"""Gripper `suction1`: one suction cup with bellows, on the wrist's axis."""

from __future__ import annotations

import functools

import numpy as np

from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.grippers.head import COLLIDER_SIDES, SIDES, Head, rod_inertia
from synpick_warp.scenes.modelling import Patch, join, lathe, make_mesh, solid
from synpick_warp.scenes.types import ConvexPiece, Fixture, Material

STEM_SIDES = 8
"""Points of the ring at the top of the cup's collision shape: with two rings of COLLIDER_SIDES, it has 32 vertices."""
LIP = 0.06
"""Height of the cup's lip, as a fraction of the cup's length."""
HINGE = 0.4
"""Radius of wrist joint and cup stem, as a fraction of the cup's."""
FOLDS = 3
"""Folds of the bellows."""


@functools.lru_cache(maxsize=16)
def make_head(gripper: Gripper) -> Head:
    """Build the head of one cup: plan, scene, physics and stages ask for the same one, and nobody changes it."""
    return Head(cup_fixture(gripper), (cup_collider(gripper),), rod_inertia(gripper.cup_mass, gripper.cup_length))


def cup_patch(gripper: Gripper, top: float = 0.0) -> Patch:
    """Surface of revolution of a cup, from z = `top` cup_length down to the lip at z = -cup_length; hollow below."""
    radius, length = gripper.cup_width / 2, gripper.cup_length
    stem = HINGE * radius
    profile = [(0.15 * radius, -0.84 * length), (0.55 * radius, -0.88 * length), (0.90 * radius, -length), (radius, -length)]
    profile += [(radius, -(1 - LIP) * length)]
    fold = 0.36 * length / FOLDS
    for index in range(FOLDS):
        base = -0.90 * length + index * fold
        bulge = (0.88 - 0.06 * index) * radius
        profile += [(0.62 * radius, base), (bulge, base + 0.4 * fold), (bulge, base + 0.6 * fold)]
    profile += [(0.62 * radius, -0.54 * length), (0.62 * radius, -0.46 * length), (stem, -0.44 * length), (stem, top * length)]
    return solid(lathe(profile, SIDES))


def hinge_patch(gripper: Gripper) -> Patch:
    """Cylinder about the wrist axis."""
    stem = HINGE * gripper.cup_width / 2
    hinge = solid(lathe([(0.9 * stem, -1.15 * stem), (stem, -1.05 * stem), (stem, 1.05 * stem), (0.9 * stem, 1.15 * stem)], SIDES))
    return hinge.rotate("x", 90.0)


def cup_fixture(gripper: Gripper) -> Fixture:
    """Build the visual mesh of the cup from the wrist axis down, with the hinge."""
    mesh = make_mesh(join(cup_patch(gripper), hinge_patch(gripper)), centered=False)
    return Fixture(mesh, Material(gripper.cup_color, None, gripper.metallic, gripper.roughness))


def cup_collider(gripper: Gripper) -> ConvexPiece:
    """Build the collision shape of the cup, without bellows: lip, and a cone up to the stem; at most 32 vertices."""
    radius, length = gripper.cup_width / 2, gripper.cup_length
    lip = lathe([(radius, -length), (radius, -(1 - LIP) * length)], COLLIDER_SIDES).reshape(-1, 3)
    stem = lathe([(HINGE * radius, 0.0)], STEM_SIDES)[0]
    points = np.concatenate([lip, stem])
    return simplify_hull(points, len(points))
