"""Grasp candidates of saved states, and the random perturbations of their trials."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Grasps:
    """Grasp candidates: row of the saved state, index in it, intended instance, grasp point and normal, and gripper angles."""

    row: wp.array[int]
    """(grasp): row of the state."""
    candidate: wp.array[int]
    """(grasp): index of the candidate within the state, which names its random numbers."""
    target: wp.array[int]
    """(grasp): intended instance; -1: none."""
    point: wp.array[wp.vec3]
    """(grasp): grasp point in the world [m]."""
    normal: wp.array[wp.vec3]
    """(grasp): unit vector against which the cup is pressed, out of the object."""
    yaw: wp.array[float]
    """(grasp): rotation of the gripper shaft about the vertical [rad]."""
    tilt: wp.array[float]
    """(grasp): rotation of the cup about the wrist axis [rad]."""


@wp.struct
class PerturbationData:
    """Distribution of perturbations, uniform about 0; see `configs.episodes.picks.Picks`. The first trial of a grasp has none."""

    repeats: int
    """Trials of each grasp."""
    offset: float
    """Half width of the offset of the grasp point along each axis [m]."""
    angle: float
    """Half width of the rotation of the cup about each axis [rad]."""
    friction: float
    """Half width of the change of friction, as a fraction."""
    seed: wp.uint64
    """Seed of the bake."""


@wp.struct
class Perturbations:
    """Perturbation of each trial."""

    offset: wp.array[wp.vec3]
    """(trial): of the grasp point [m]."""
    rotation: wp.array[wp.vec3]
    """(trial): of the cup's orientation, a rotation vector in the world [rad]."""
    friction: wp.array[float]
    """(trial): factor on the coefficients of friction."""
