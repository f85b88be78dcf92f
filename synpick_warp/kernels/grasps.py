"""Grasp candidates of saved states, and random perturbations of their trials."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Grasps:
    """Grasp candidates: row of the saved state, index within the state, intended instance, and grasp pose (point, normal, yaw, tilt)."""

    row: wp.array[int]
    """(grasp): row of the saved state."""
    candidate: wp.array[int]
    """(grasp): index of the candidate within the state, part of the key of its random numbers."""
    target: wp.array[int]
    """(grasp): intended instance; -1: none."""
    point: wp.array[wp.vec3]
    """(grasp): grasp point in the world [m]."""
    normal: wp.array[wp.vec3]
    """(grasp): unit vector of the cup's axis in the world, out of the object."""
    yaw: wp.array[float]
    """(grasp): rotation of the gripper shaft about the vertical [rad]."""
    tilt: wp.array[float]
    """(grasp): rotation of the cup about the wrist axis [rad]."""


@wp.struct
class PerturbationData:
    """Uniform distributions of the perturbations; see `configs.episodes.picks.Picks`. The first trial of a grasp is not perturbed."""

    repeats: int
    offset: float
    """Half width of the offset of the grasp point along each axis [m]."""
    angle: float
    """Half width of the rotation of the cup about each axis [rad]."""
    friction: float
    """Half width of the factor on friction about 1."""
    seed: wp.uint64


@wp.struct
class Perturbations:
    """Sampled perturbation of each trial."""

    offset: wp.array[wp.vec3]
    """(trial): offset of the grasp point in the world [m]."""
    rotation: wp.array[wp.vec3]
    """(trial): rotation of the cup, a rotation vector in the world [rad]."""
    friction: wp.array[float]
    """(trial): factor on the coefficients of friction."""
