"""Attempts of the vector environment: suction grasps from actions (a pixel of the observed depth image, or a point with a direction), their
start, end and results; settling of piles."""

import warp as wp

from synpick_warp.codes import Ending, Outcome, Phase, Task
from synpick_warp.kernels.bitsets import NO_MEMBERS, has_member
from synpick_warp.kernels.perception.grasp import gripper_angles, limit_normal
from synpick_warp.kernels.render.visibility.camera import Views, camera_ray, hit_position
from synpick_warp.kernels.sim.trials import count_lost, measure_motion
from synpick_warp.kernels.state import Attempts, Motion, Plans, Seals, Worlds
from synpick_warp.kernels.structs import LayoutData, PickData

wp.set_module_options({"enable_backward": False})


@wp.struct
class Results:
    """Results of the last attempt of each world, and the poses and counts that they are measured against."""

    outcome: wp.array[int]
    """(world): `Outcome`; NONE if the episode failed first, with its `Ending`."""
    picked: wp.array[int]
    """(world): first instance attached at the end; -1: none."""
    hits: wp.array[wp.vec2i]
    """(world): number of suction rays that hit an object, and bit mask of cups with a good seal."""
    peak_force: wp.array[float]
    """(world): largest seal force, including seals that broke [N]."""
    ticks: wp.array[int]
    """(world): duration [ticks]."""
    moved: wp.array[int]
    """(world): number of objects other than the one picked that were displaced by more than a threshold."""
    farthest: wp.array[float]
    """(world): largest displacement of any object but the one picked [m]."""
    lost: wp.array[int]
    """(world): objects that left the bin without being picked."""
    lost_before: wp.array[int]
    """(world): objects lost in the episode before the attempt began."""
    pose: wp.array2d[wp.transform]
    """(world, instance): pose of each object when the attempt began [m]."""


@wp.func
def begin_attempt(attempts: Attempts, world: int):
    """Count an attempt that begins in a world, and forget the hits of the one before."""
    attempts.attempt[world] = attempts.attempt[world] + 1
    attempts.hits[world] = wp.vec2i(0, 0)
    for word in range(attempts.engaged_words.shape[1]):
        attempts.engaged_words[world, word] = NO_MEMBERS


@wp.kernel
def grasp_pixels_kernel(
    # Scene:
    window: int,
    # In:
    views: Views,
    pixel: wp.array[wp.vec2i],  # (world) [px]
    depth: wp.array3d[float],  # (world, row, column) [m]
    segment: wp.array3d[wp.uint8],  # (world, row, column)
    normal: wp.array3d[wp.vec3],  # (world, row, column)
    # Out:
    point_out: wp.array[wp.vec3],  # (world) [m]
    direction_out: wp.array[wp.vec3],  # (world)
    instance_out: wp.array[int],  # (world)
    running_inout: wp.array[int],  # (world)
):
    """Back-project a pixel (column, row) of each world's depth image: write surface point, smoothed normal and instance.

    `direction` is the sum of the normals of the same segment in a square of 2 `window` + 1 pixels; `instance` is -1 where none is shown.
    `running` becomes 0 where the pixel shows no surface. The camera is that of the first view.
    Launched over world.
    """
    world = wp.tid()
    if running_inout[world] == 0:
        return
    p = pixel[world]
    distance = depth[world, p[1], p[0]]
    if distance <= 0.0:
        running_inout[world] = 0
        return
    seen = segment[world, p[1], p[0]]
    total = wp.vec3(0.0, 0.0, 0.0)
    for row in range(wp.max(p[1] - window, 0), wp.min(p[1] + window + 1, depth.shape[1])):
        for column in range(wp.max(p[0] - window, 0), wp.min(p[0] + window + 1, depth.shape[2])):
            if segment[world, row, column] == seen:
                total += normal[world, row, column]
    instance = int(seen) - 1
    if instance >= views.instances:
        instance = -1
    ray = camera_ray(views.cameras, 0, p[1], p[0], wp.vec2(0.0, 0.0))
    point_out[world] = hit_position(views.cameras, 0, ray, distance)
    direction_out[world] = total
    instance_out[world] = instance


@wp.kernel
def begin_attempts_kernel(
    # Scene:
    pick: PickData,
    keeps_target: int,
    # In:
    running: wp.array[int],  # (world)
    grasp_point: wp.array[wp.vec3],  # (world) [m]
    direction: wp.array[wp.vec3],  # (world)
    instance: wp.array[int],  # (world)
    # Out:
    plan_out: Plans,
    attempts_inout: Attempts,
):
    """Begin attempts of running worlds at task APPROACH, with a planned grasp: point, normal along `direction` (out of the surface, of any
    length), yaw and tilt.

    The normal is clamped to the tilt limit about the vertical. The target becomes `instance`, unless `keeps_target`. Launched over world.
    """
    world = wp.tid()
    if running[world] == 0:
        return
    normal = limit_normal(direction[world], pick.tilt_limit)
    angles = gripper_angles(normal)
    if keeps_target == 0:
        plan_out.target[world] = instance[world]
    plan_out.point[world] = grasp_point[world]
    plan_out.normal[world] = normal
    plan_out.yaw[world] = angles[0]
    plan_out.tilt[world] = angles[1]
    begin_attempt(attempts_inout, world)
    attempts_inout.task[world] = Task.APPROACH
    attempts_inout.steps[world] = 0


@wp.kernel
def begin_results_kernel(layout: LayoutData, state: Worlds, attempts: Attempts, motion: Motion, results_out: Results):
    """Reset the results, and write the references of their measurement: poses and number of lost objects. Launched over world."""
    world = wp.tid()
    results_out.outcome[world] = Outcome.NONE
    results_out.picked[world] = -1
    results_out.hits[world] = wp.vec2i(0, 0)
    results_out.peak_force[world] = 0.0
    results_out.ticks[world] = 0
    results_out.moved[world] = 0
    results_out.farthest[world] = 0.0
    results_out.lost[world] = 0
    results_out.lost_before[world] = count_lost(attempts.removed, world)
    body = world * layout.bodies + layout.gripper_bodies
    for instance in range(layout.instances):
        results_out.pose[world, instance] = motion.body_q[body + state.body_slot[world, instance]]


@wp.kernel
def judge_attempts_kernel(
    # Scene:
    layout: LayoutData,
    moved_distance: float,
    # State:
    state: Worlds,
    attempts: Attempts,
    seals: Seals,
    motion: Motion,
    # Out:
    running_inout: wp.array[int],  # (world)
    results_inout: Results,
    world_out: wp.array[int],  # (world)
    done_inout: wp.array[int],  # (one)
):
    """Write the results of running attempts after a tick. Those that ended in it get `running` 0, and `done` is incremented.

    `world` becomes the world's own index where its attempt ended in this tick, for a save; else -1. Launched over world.
    """
    world = wp.tid()
    world_out[world] = -1
    if running_inout[world] == 0:
        return
    picked = int(-1)
    for instance in range(layout.instances):
        if picked < 0 and has_member(attempts.attached_words, world, instance):
            picked = instance
    moved, farthest = measure_motion(layout, world, picked, moved_distance, state, motion, results_inout.pose)
    results_inout.outcome[world] = attempts.outcome[world]
    results_inout.picked[world] = picked
    results_inout.hits[world] = attempts.hits[world]
    results_inout.peak_force[world] = wp.max(results_inout.peak_force[world], seals.peak[world][0])
    results_inout.ticks[world] = results_inout.ticks[world] + 1
    results_inout.moved[world] = moved
    results_inout.farthest[world] = farthest
    results_inout.lost[world] = count_lost(attempts.removed, world) - results_inout.lost_before[world]
    if attempts.outcome[world] == Outcome.NONE and state.phase[world] == Phase.ACT:
        return
    world_out[world] = world
    running_inout[world] = 0
    wp.atomic_add(done_inout, 0, 1)


@wp.kernel
def start_piles_kernel(
    # In:
    episode: wp.array[int],  # (world)
    # Out:
    state_out: Worlds,
):
    """Assign an episode to each world, which starts in the next tick from its first arrangement; -1: the world becomes idle.

    Launched over world.
    """
    world = wp.tid()
    state_out.arrangement_id[world] = wp.vec2i(episode[world], 0)
    state_out.ending[world] = Ending.RUNNING
    state_out.phase[world] = Phase.IDLE
    if episode[world] >= 0:
        state_out.phase[world] = Phase.START


@wp.kernel
def list_settled_kernel(
    # State:
    state: Worlds,
    # Out:
    row_inout: wp.array[int],  # (world)
    world_out: wp.array[int],  # (row)
    done_inout: wp.array[int],  # (two)
):
    """List the piles that came to rest in this tick: write the world of each bank row, and -1 to that world's `row`.

    `done` counts the piles at rest, and the worlds whose episode has used up its arrangements. Launched over world.
    """
    world = wp.tid()
    row = row_inout[world]
    if row < 0:
        return
    if state.phase[world] == Phase.ACT and state.frame[world] == 0:
        world_out[row] = world
        row_inout[world] = -1
        wp.atomic_add(done_inout, 0, 1)
    elif state.phase[world] == Phase.IDLE:
        row_inout[world] = -1
        wp.atomic_add(done_inout, 1, 1)
