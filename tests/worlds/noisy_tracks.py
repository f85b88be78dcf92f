"""Synthetic estimates around analytic trajectories: rest, constant velocity, constant rotation rate; with noise, outliers and gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation.truth import PoseTable

FRAME = 1 / 15
"""Time from frame to frame [s]."""


@dataclass(frozen=True)
class Motion:
    """An instance that moves at constant velocity and rotation rate."""

    scene: int = 1
    object_id: int = 17
    start: tuple[float, float, float] = (0.0, 0.0, 1.9)
    """[m]"""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[m/s]"""
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector a second, in the camera frame [rad/s]."""
    first: tuple[float, float, float] = (0.3, -0.2, 0.5)
    """Rotation vector in image 0 [rad]."""
    images: int = 100
    instance: int = 0


def true_poses(*motions: Motion) -> PoseTable:
    """Poses of all images, sorted by scene, image and object."""
    parts = []
    for motion in motions:
        image = np.arange(motion.images)
        time = (image * FRAME)[:, None]
        rotation = Rotation.from_rotvec(time * motion.spin) * Rotation.from_rotvec(motion.first)
        full = np.full(motion.images, motion.scene), image, np.full(motion.images, motion.object_id)
        rest = np.ones(motion.images), np.full(motion.images, -1.0), np.full(motion.images, motion.instance)
        parts.append(PoseTable(*full, rotation.as_matrix(), motion.start + time * motion.velocity, *rest))
    return join_tables(*parts)


def join_tables(*tables: PoseTable) -> PoseTable:
    """Rows of several tables, sorted by scene, image and object."""
    names = PoseTable.__dataclass_fields__
    table = PoseTable(*(np.concatenate([getattr(one, name) for one in tables]) for name in names))
    return table.select(np.lexsort((table.object_id, table.image, table.scene)))


def estimates(
    truth: PoseTable,
    seed: int = 0,
    *,
    noise: float = 0.0,
    angle: float = 0.0,
    outliers: float = 0.0,
    jump: float = 0.2,
    missing: float = 0.0,
    known: bool = False,
) -> PoseTable:
    """Estimates of true poses.

    Args:
        truth: True poses.
        seed: Of the random numbers.
        noise: Standard deviation of each coordinate [m].
        angle: Standard deviation of each component of the rotation vector [rad].
        outliers: Fraction of estimates that are `jump` away and turned at random.
        jump: Distance of outliers [m].
        missing: Fraction of rows that are left out.
        known: Whether estimates know their instances.
    """
    rng = np.random.default_rng(seed)
    count = len(truth)
    far = rng.random(count) < outliers
    way = rng.normal(size=(count, 3))
    translation = truth.translation + noise * rng.normal(size=(count, 3))
    translation = translation + far[:, None] * jump * way / np.linalg.norm(way, axis=1, keepdims=True)
    rotation = Rotation.from_rotvec(angle * rng.normal(size=(count, 3))).as_matrix() @ truth.rotation
    rotation = np.where(far[:, None, None], Rotation.random(count, rng=rng).as_matrix(), rotation)
    instance = truth.instance if known else np.full(count, -1)
    table = PoseTable(truth.scene, truth.image, truth.object_id, rotation, translation, rng.random(count), truth.seconds, instance)
    return table.select(rng.random(count) >= missing)


@st.composite
def noisy_tables(draw: st.DrawFn) -> PoseTable:
    """Estimates of up to 5 instances, which may share scene and object, with noise, outliers and gaps."""
    motions = [
        Motion(
            scene=draw(st.integers(0, 2)),
            object_id=draw(st.integers(1, 2)),
            start=tuple(draw(st.floats(-0.3, 0.3)) for _ in range(3)),
            velocity=tuple(draw(st.floats(-0.5, 0.5)) for _ in range(3)),
            spin=tuple(draw(st.floats(-2.0, 2.0)) for _ in range(3)),
            images=draw(st.integers(1, 12)),
            instance=instance,
        )
        for instance in range(draw(st.integers(1, 5)))
    ]
    seed, known = draw(st.integers(0, 2**31)), draw(st.booleans())
    return estimates(true_poses(*motions), seed, noise=0.02, angle=0.3, outliers=0.1, missing=0.2, known=known)
