"""Mechanism that all grippers share: a conical shaft on three prismatic axes, and a wrist joint that tilts the head about y.

The origins of both bodies' frames lie on the wrist axis, which is y; z up.
"""

from __future__ import annotations

import newton
import numpy as np
import warp as wp

from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.grippers.head import COLLIDER_SIDES, SIDES, Head, rod_inertia
from synpick_warp.scenes.modelling import lathe, make_mesh, solid
from synpick_warp.scenes.types import ConvexPiece, Fixture, Material

GRIPPER_BODIES = 2
GRIPPER_DOFS = 4
FINGER_TIP = 0.03
"""Maximum diameter of the shaft at the wrist axis [m]; at most that of its top."""
# Armature (rotor inertia) of the wrist joint [kg·m²], which keeps the stiff drive well conditioned at 2 ms.
CUP_ARMATURE = 1e-3


def add_gripper(
    world: newton.ModelBuilder, gripper: Gripper, head: Head, shape: newton.ModelBuilder.ShapeConfig
) -> tuple[int, tuple[int, ...]]:
    """Add shaft (three prismatic axes) and head (revolute wrist about y); returns the indices of the shaft's shape and of the head's.

    The impedance controller compensates their weight.
    """
    dof = newton.ModelBuilder.JointDofConfig
    finger = world.add_link(
        mass=gripper.finger_mass,
        inertia=wp.mat33(np.diag(rod_inertia(gripper.finger_mass, gripper.finger_length))),
        com=wp.vec3(0.0, 0.0, gripper.finger_length / 2),
        lock_inertia=True,
        label="finger",
    )
    cup = world.add_link(
        mass=gripper.cup_mass,
        inertia=wp.mat33(np.diag(head.inertia)),
        com=wp.vec3(0.0, 0.0, -gripper.cup_length / 2),
        lock_inertia=True,
        label="cup",
    )
    axes = [dof(axis=axis, limit_lower=-np.inf, limit_upper=np.inf, armature=0.0) for axis in (newton.Axis.X, newton.Axis.Y, newton.Axis.Z)]
    slide = world.add_joint_d6(-1, finger, linear_axes=axes)
    limit = np.radians(gripper.tilt_limit)
    wrist = world.add_joint_revolute(
        finger,
        cup,
        axis=newton.Axis.Y,
        target_ke=gripper.tilt_stiffness,
        target_kd=gripper.tilt_damping,
        limit_lower=-limit,
        limit_upper=limit,
        effort_limit=gripper.tilt_torque,
        armature=CUP_ARMATURE,
    )
    world.add_articulation([slide, wrist], label="gripper")
    finger_shape = world.add_shape_convex_hull(finger, mesh=hull_mesh(finger_collider(gripper)), cfg=shape)
    head_shapes = tuple(world.add_shape_convex_hull(cup, mesh=hull_mesh(piece), cfg=shape) for piece in head.pieces)
    for each in head_shapes:
        world.add_shape_collision_filter_pair(finger_shape, each)
    return finger_shape, head_shapes


def hull_mesh(piece: ConvexPiece) -> newton.Mesh:
    """Newton's mesh of a convex piece."""
    return newton.Mesh(piece.vertices, piece.faces.reshape(-1), compute_inertia=False)


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


def finger_collider(gripper: Gripper) -> ConvexPiece:
    """Build the collision shape of the shaft: its cone."""
    low, high = _finger_radii(gripper)
    rings = lathe([(low, 0.0), (high, gripper.finger_length)], COLLIDER_SIDES)
    return simplify_hull(rings.reshape(-1, 3), 2 * COLLIDER_SIDES)


def _finger_radii(gripper: Gripper) -> tuple[float, float]:
    """Radii of the gripper shaft [m]: at the wrist joint, and at its upper end."""
    return min(FINGER_TIP, gripper.finger_width) / 2, gripper.finger_width / 2
