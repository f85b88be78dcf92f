"""Grasp trials: pick attempts from saved states, each with a given grasp; worlds that finish a trial begin the next one."""

import warp as wp

from synpick_warp.codes import Outcome, Phase, Removal, Task
from synpick_warp.kernels.bitsets import NO_MEMBERS, has_member
from synpick_warp.kernels.structs import LayoutData

wp.set_module_options({"enable_backward": False})


@wp.struct
class Grasps:
    """Grasp candidates: row of the saved state, intended instance, grasp point and normal, and gripper angles."""

    row: wp.array[int]
    """(trial): row of the state."""
    target: wp.array[int]
    """(trial): intended instance; -1: none."""
    point: wp.array[wp.vec3]
    """(trial): grasp point in the world [m]."""
    normal: wp.array[wp.vec3]
    """(trial): outward unit normal."""
    yaw: wp.array[float]
    """(trial): rotation of the gripper shaft about the vertical [rad]."""
    tilt: wp.array[float]
    """(trial): rotation of the cup about the wrist axis [rad]."""


@wp.struct
class Labels:
    """Results of the trials: outcome, suction seals, picked instance, and collateral motion of other objects."""

    outcome: wp.array[int]
    """(trial): `Outcome`; NONE if the episode ended first, with `ending`."""
    ending: wp.array[int]
    """(trial): `Ending`."""
    hits: wp.array[wp.vec2i]
    """(trial): suction rays that hit an object, and the cups with a good seal: bit k, cup k."""
    picked: wp.array[int]
    """(trial): first instance attached at the end; -1: none."""
    peak_force: wp.array[float]
    """(trial): largest seal force, including seals that broke [N]."""
    ticks: wp.array[int]
    """(trial): duration [ticks]."""
    held: wp.array[int]
    """(trial): time with an attached object [ticks]."""
    moved: wp.array[int]
    """(trial): number of other objects displaced by more than a threshold."""
    farthest: wp.array[float]
    """(trial): largest displacement of another object [m]."""
    lost: wp.array[int]
    """(trial): number of objects that left the bin without being picked."""


@wp.struct
class Progress:
    """State of the trial that runs in each world."""

    trial: wp.array[int]
    """(world): index of the running trial; -1: none."""
    ticks: wp.array[int]
    """(world): ticks since the trial began."""
    held: wp.array[int]
    """(world): ticks with an attached object."""
    peak_force: wp.array[float]
    """(world): largest force of a seal [N]."""
    lost: wp.array[int]
    """(world): number of objects lost before the trial."""
    pose: wp.array2d[wp.transform]
    """(world, instance): pose of each object when the trial began [m]."""


@wp.func
def count_lost(removed: wp.array2d[int], world: int) -> int:
    """Number of a world's objects that left its bin, and were not picked."""
    lost = int(0)
    for instance in range(removed.shape[1]):
        if removed[world, instance] == Removal.LOST:
            lost += 1
    return lost


@wp.func
def measure_motion(
    layout: LayoutData,
    world: int,
    target: int,
    moved_distance: float,
    catalog_index: wp.array2d[int],
    body_slot: wp.array2d[int],
    body_q: wp.array[wp.transform],
    pose: wp.array2d[wp.transform],
):
    """Number of a world's objects, but for the target, whose origins are farther than `moved_distance` from `pose`, and the largest such
    distance [m].
    """
    body = world * layout.bodies + layout.gripper_bodies
    moved = int(0)
    farthest = float(0.0)
    for instance in range(layout.instances):
        if catalog_index[world, instance] >= 0 and instance != target:
            now = wp.transform_get_translation(body_q[body + body_slot[world, instance]])
            distance = wp.length(now - wp.transform_get_translation(pose[world, instance]))
            farthest = wp.max(farthest, distance)
            if distance > moved_distance:
                moved += 1
    return moved, farthest


@wp.kernel
def assign_trials_kernel(
    # In:
    grasps: Grasps,
    # Out:
    progress_inout: Progress,
    next_inout: wp.array[int],  # (one)
    row_out: wp.array[int],  # (world)
):
    """Give each world without a trial the next one, in order: `row` receives its row of the state, or -1. A single thread (dim 1)."""
    following = next_inout[0]
    for world in range(row_out.shape[0]):
        row_out[world] = -1
        if progress_inout.trial[world] < 0 and following < grasps.row.shape[0]:
            progress_inout.trial[world] = following
            row_out[world] = grasps.row[following]
            following += 1
    next_inout[0] = following


@wp.kernel
def begin_trials_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    row: wp.array[int],  # (world)
    grasps: Grasps,
    removed: wp.array2d[int],  # (world, instance)
    body_slot: wp.array2d[int],  # (world, instance)
    body_q: wp.array[wp.transform],  # (body) [m]
    # Out:
    progress_inout: Progress,
    target_out: wp.array[int],  # (world)
    point_out: wp.array[wp.vec3],  # (world) [m]
    normal_out: wp.array[wp.vec3],  # (world)
    yaw_out: wp.array[float],  # (world) [rad]
    tilt_out: wp.array[float],  # (world) [rad]
    task_out: wp.array[int],  # (world)
    steps_out: wp.array[int],  # (world)
    hits_out: wp.array[wp.vec2i],  # (world)
    engaged_words_out: wp.array2d[wp.uint32],  # (world, word)
):
    """Begin the trials of worlds with a row: their grasps become the plans, with task APPROACH. Launched over world."""
    world = wp.tid()
    if row[world] < 0:
        return
    trial = progress_inout.trial[world]
    target_out[world] = grasps.target[trial]
    point_out[world] = grasps.point[trial]
    normal_out[world] = grasps.normal[trial]
    yaw_out[world] = grasps.yaw[trial]
    tilt_out[world] = grasps.tilt[trial]
    task_out[world] = Task.APPROACH
    steps_out[world] = 0
    hits_out[world] = wp.vec2i(0, 0)
    for word in range(engaged_words_out.shape[1]):
        engaged_words_out[world, word] = NO_MEMBERS
    progress_inout.ticks[world] = 0
    progress_inout.held[world] = 0
    progress_inout.peak_force[world] = 0.0
    progress_inout.lost[world] = count_lost(removed, world)
    body = world * layout.bodies + layout.gripper_bodies
    for instance in range(layout.instances):
        progress_inout.pose[world, instance] = body_q[body + body_slot[world, instance]]


@wp.kernel
def judge_trials_kernel(
    # Scene:
    layout: LayoutData,
    moved_distance: float,
    # State:
    grasps: Grasps,
    phase: wp.array[int],  # (world)
    ending: wp.array[int],  # (world)
    outcome: wp.array[int],  # (world)
    hits: wp.array[wp.vec2i],  # (world)
    attached_words: wp.array2d[wp.uint32],  # (world, word)
    peak_force: wp.array[float],  # (world) [N]
    catalog_index: wp.array2d[int],  # (world, instance)
    removed: wp.array2d[int],  # (world, instance)
    body_slot: wp.array2d[int],  # (world, instance)
    body_q: wp.array[wp.transform],  # (body) [m]
    # Out:
    progress_inout: Progress,
    labels_out: Labels,
    done_inout: wp.array[int],  # (one)
):
    """Update duration and peak force of running trials; write the labels of finished ones, and free their worlds.

    An object other than the intended one has moved if its origin is farther than `moved_distance` from where it was [m]. `done` counts
    labelled trials. Launched over world, at the end of a tick.
    """
    world = wp.tid()
    trial = progress_inout.trial[world]
    if trial < 0:
        return
    picked = int(-1)
    for instance in range(layout.instances):
        if picked < 0 and has_member(attached_words, world, instance):
            picked = instance
    progress_inout.ticks[world] = progress_inout.ticks[world] + 1
    if picked >= 0:
        progress_inout.held[world] = progress_inout.held[world] + 1
    progress_inout.peak_force[world] = wp.max(progress_inout.peak_force[world], peak_force[world])
    if outcome[world] == Outcome.NONE and phase[world] == Phase.ACT:
        return
    moved, farthest = measure_motion(
        layout, world, grasps.target[trial], moved_distance, catalog_index, body_slot, body_q, progress_inout.pose
    )
    labels_out.outcome[trial] = outcome[world]
    labels_out.ending[trial] = ending[world]
    labels_out.hits[trial] = hits[world]
    labels_out.picked[trial] = picked
    labels_out.peak_force[trial] = progress_inout.peak_force[world]
    labels_out.ticks[trial] = progress_inout.ticks[world]
    labels_out.held[trial] = progress_inout.held[world]
    labels_out.moved[trial] = moved
    labels_out.farthest[trial] = farthest
    labels_out.lost[trial] = count_lost(removed, world) - progress_inout.lost[world]
    progress_inout.trial[world] = -1
    wp.atomic_add(done_inout, 0, 1)
