"""Plans of grasp trials: grasp candidates, with random perturbations of point, rotation and friction (counter-based) in repeats."""

import warp as wp

from synpick_warp.codes import Stream
from synpick_warp.kernels.grasps import Grasps, PerturbationData, Perturbations
from synpick_warp.kernels.perception.cup_alignment import HeadFrame, head_frame
from synpick_warp.kernels.perception.grasp import gripper_angles, limit_normal
from synpick_warp.kernels.rng import pixel_key, stream_key, uniform
from synpick_warp.kernels.state import Attempts, Plans, Worlds
from synpick_warp.kernels.structs import CupData, PickData

wp.set_module_options({"enable_backward": False})

SAMPLES = wp.constant(7)
"""Random samples of a perturbation: three for the point, three for the rotation, one for friction."""


@wp.func
def symmetric_vector(key: wp.uint64, first: int, half_width: float) -> wp.vec3:
    """Point uniform in the cube [-half_width, half_width]³, from samples `first` to `first` + 2 of a stream."""
    x = 2.0 * uniform(key, first) - 1.0
    y = 2.0 * uniform(key, first + 1) - 1.0
    z = 2.0 * uniform(key, first + 2) - 1.0
    return half_width * wp.vec3(x, y, z)


@wp.func
def turn_head(frame: HeadFrame, rotation: wp.vec3, pick: PickData, cups: CupData) -> HeadFrame:
    """Frame of the head turned by a rotation vector in the world [rad], as near as its two joints allow.

    One cup: yaw and tilt follow from the turned axis; several cups: yaw changes by the vertical component, and tilt follows.
    """
    normal = wp.quat_rotate(wp.quat_from_axis_angle(wp.normalize(rotation), wp.length(rotation)), frame.axis)
    if cups.count > 1:
        return head_frame(normal, frame.yaw + rotation[2])
    result = HeadFrame()
    result.axis = limit_normal(normal, pick.tilt_limit)
    angles = gripper_angles(result.axis)
    result.yaw = angles[0]
    result.tilt = angles[1]
    return result


@wp.kernel
def plan_trials_kernel(
    # Scene:
    pick: PickData,
    cups: CupData,
    spread: PerturbationData,
    # State:
    row: wp.array[int],  # (world)
    trial: wp.array[int],  # (world)
    grasps: Grasps,
    state: Worlds,
    attempts: Attempts,
    # Out:
    perturbations_out: Perturbations,
    plan_out: Plans,
):
    """Write the plans of worlds that begin a trial (`row` is not -1): its grasp, perturbed unless it is the grasp's first trial (repeat 0).

    Also writes the perturbation, by trial. Samples depend on (seed, episode, arrangement, attempt, candidate, repeat). Launched over world.
    """
    world = wp.tid()
    if row[world] < 0:
        return
    grasp = trial[world] // spread.repeats
    repeat = trial[world] % spread.repeats
    point = grasps.point[grasp]
    frame = HeadFrame()
    frame.axis = grasps.normal[grasp]
    frame.yaw = grasps.yaw[grasp]
    frame.tilt = grasps.tilt[grasp]
    offset = wp.vec3(0.0, 0.0, 0.0)
    rotation = wp.vec3(0.0, 0.0, 0.0)
    friction = float(1.0)
    if repeat > 0:
        key = pixel_key(
            stream_key(spread.seed, state.arrangement_id[world][0], state.arrangement_id[world][1], Stream.TRIALS), attempts.attempt[world]
        )
        key = pixel_key(key, grasps.candidate[grasp])
        offset = symmetric_vector(key, SAMPLES * repeat, spread.offset)
        rotation = symmetric_vector(key, SAMPLES * repeat + 3, spread.angle)
        friction = 1.0 + spread.friction * (2.0 * uniform(key, SAMPLES * repeat + 6) - 1.0)
        point = point + offset
        frame = turn_head(frame, rotation, pick, cups)
    perturbations_out.offset[trial[world]] = offset
    perturbations_out.rotation[trial[world]] = rotation
    perturbations_out.friction[trial[world]] = friction
    plan_out.target[world] = grasps.target[grasp]
    plan_out.point[world] = point
    plan_out.normal[world] = frame.axis
    plan_out.yaw[world] = frame.yaw
    plan_out.tilt[world] = frame.tilt
