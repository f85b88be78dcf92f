"""Grasp trials: pick attempts from saved states with given grasps, scheduled as a work queue: worlds that finish a trial take the next."""

import warp as wp

from synpick_warp.codes import Outcome, Phase, Removal, Task
from synpick_warp.kernels.bitsets import NO_MEMBERS, has_member, has_members
from synpick_warp.kernels.grasps import Grasps
from synpick_warp.kernels.sim.gripper import place_gripper, task_setpoint
from synpick_warp.kernels.sim.tasks import ARRIVED, judge_attempt
from synpick_warp.kernels.state import Attempts, Control, Motion, Plans, Seals, Worlds
from synpick_warp.kernels.structs import TILT, CatalogData, LayoutData, MoveData, PickData

wp.set_module_options({"enable_backward": False})

NO_FAILURES = wp.constant(-(2**30))
"""Initial count of failed attempts of a trial, so low that a failure never ends the episode."""
ATTEMPT = wp.constant(-1)
"""Value of `Progress.settling` while the attempt runs."""


@wp.struct
class TrialData:
    """Parameters of trials; see `configs.episodes.picks.Picks`."""

    repeats: int
    near: float
    """Distance from the grasp point, along the normal, at which the gripper appears [m]; 0: it approaches as in an attempt."""
    lift_steps: int
    """Duration of the lift [steps]."""
    hold_steps: int
    """Time between the end of the lift and the outcome [steps]."""
    settle_ticks: int
    """Time between the outcome and the measurement of the other objects [ticks]."""
    moved_distance: float
    """Displacement above which another object counts as moved [m]."""
    base_friction: float
    """Coefficient of friction of all shapes, before perturbation."""


@wp.struct
class Labels:
    """Labels of trials: outcome, suction seals, forces, picked instance, duration, and collateral motion of other objects."""

    outcome: wp.array[int]
    """(trial): `Outcome`; NONE: the episode ended first, as `ending` says."""
    ending: wp.array[int]
    """(trial): `Ending`; RUNNING: there is an outcome."""
    hits: wp.array[wp.vec2i]
    """(trial): number of suction rays that hit an object; bit set of cups with a good seal (bit k: cup k)."""
    picked: wp.array[int]
    """(trial): first instance attached at the end; -1: none."""
    peak_force: wp.array[float]
    """(trial): largest seal force, including seals that broke [N]."""
    load: wp.array[float]
    """(trial): largest force of a seal relative to its break force."""
    ticks: wp.array[int]
    """(trial): duration up to the outcome [ticks]."""
    held: wp.array[int]
    """(trial): time with an attached object [steps]."""
    moved: wp.array[int]
    """(trial): number of other objects displaced by more than `TrialData.moved_distance`."""
    farthest: wp.array[float]
    """(trial): largest displacement of another object [m]."""
    lost: wp.array[int]
    """(trial): number of objects that left the bin without being picked."""


@wp.struct
class Progress:
    """Running trial of each world, and what is accumulated for its labels."""

    trial: wp.array[int]
    """(world): index of the running trial; -1: none."""
    ticks: wp.array[int]
    """(world): ticks since the trial began."""
    settling: wp.array[int]
    """(world): remaining ticks until the other objects are measured; ATTEMPT: the attempt still runs."""
    held: wp.array[int]
    """(world): steps with an attached object."""
    peak_force: wp.array[float]
    """(world): largest seal force so far [N]."""
    load: wp.array[float]
    """(world): largest force of a seal relative to its break force so far."""
    lost: wp.array[int]
    """(world): number of objects that were lost when the trial began."""
    pose: wp.array2d[wp.transform]
    """(world, instance): pose of each object when the trial began [m]."""
    row: wp.array[int]
    """(world): row of the state in worlds that begin a trial, else -1."""
    next: wp.array[int]
    """(one): index of the next trial."""
    done: wp.array[int]
    """(one): number of trials that are done."""


@wp.func
def count_lost(removed: wp.array2d[int], world: int) -> int:
    """Number of a world's objects that left the bin without being picked."""
    lost = int(0)
    for instance in range(removed.shape[1]):
        if removed[world, instance] == Removal.LOST:
            lost += 1
    return lost


@wp.func
def measure_motion(
    layout: LayoutData, world: int, target: int, moved_distance: float, state: Worlds, motion: Motion, pose: wp.array2d[wp.transform]
):
    """Collateral motion: number of a world's present objects, except the target, whose origins are displaced from `pose` by more than
    `moved_distance`, and the largest displacement of any of them [m].
    """
    body = world * layout.bodies + layout.gripper_bodies
    moved = int(0)
    farthest = float(0.0)
    for instance in range(layout.instances):
        if state.catalog_index[world, instance] >= 0 and instance != target:
            now = wp.transform_get_translation(motion.body_q[body + state.body_slot[world, instance]])
            distance = wp.length(now - wp.transform_get_translation(pose[world, instance]))
            farthest = wp.max(farthest, distance)
            if distance > moved_distance:
                moved += 1
    return moved, farthest


@wp.kernel
def assign_trials_kernel(count: int, repeats: int, grasps: Grasps, progress_inout: Progress):
    """Work queue: assign the next of `count` trials to each world without one, in order of worlds. A single thread (dim 1)."""
    following = progress_inout.next[0]
    for world in range(progress_inout.row.shape[0]):
        progress_inout.row[world] = -1
        if progress_inout.trial[world] < 0 and following < count:
            progress_inout.trial[world] = following
            progress_inout.row[world] = grasps.row[following // repeats]
            following += 1
    progress_inout.next[0] = following


@wp.kernel
def begin_trials_kernel(layout: LayoutData, attempts_inout: Attempts, state: Worlds, motion: Motion, progress_inout: Progress):
    """Reset attempt state and `Progress` of worlds that begin a trial, with task APPROACH. Launched over world."""
    world = wp.tid()
    if progress_inout.row[world] < 0:
        return
    attempts_inout.task[world] = Task.APPROACH
    attempts_inout.steps[world] = 0
    attempts_inout.failures[world] = NO_FAILURES
    attempts_inout.hits[world] = wp.vec2i(0, 0)
    for word in range(attempts_inout.engaged_words.shape[1]):
        attempts_inout.engaged_words[world, word] = NO_MEMBERS
    progress_inout.ticks[world] = 0
    progress_inout.settling[world] = ATTEMPT
    progress_inout.held[world] = 0
    progress_inout.peak_force[world] = 0.0
    progress_inout.load[world] = 0.0
    progress_inout.lost[world] = count_lost(attempts_inout.removed, world)
    body = world * layout.bodies + layout.gripper_bodies
    for instance in range(layout.instances):
        progress_inout.pose[world, instance] = motion.body_q[body + state.body_slot[world, instance]]


@wp.kernel
def set_friction_kernel(
    # Scene:
    layout: LayoutData,
    course: TrialData,
    # State:
    progress: Progress,
    friction: wp.array[float],  # (trial)
    # Out:
    mu_out: wp.array[float],  # (shape)
):
    """Set friction in worlds that begin a trial: base coefficient times the trial's factor. Launched over world, shape within the world."""
    world, shape = wp.tid()
    if progress.row[world] >= 0:
        mu_out[world * layout.shapes + shape] = friction[progress.trial[world]] * course.base_friction


@wp.kernel
def place_near_kernel(
    layout: LayoutData,
    move: MoveData,
    course: TrialData,
    state_inout: Worlds,
    attempts_inout: Attempts,
    plan: Plans,
    motion_out: Motion,
    control_out: Control,
):
    """Place the gripper at distance `course.near` from the grasp point in worlds that begin a trial; DESCEND replaces task APPROACH.

    `tilt_out` is the drive target of the tilt joint. Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.ACT or attempts_inout.task[world] != Task.APPROACH or attempts_inout.steps[world] != 0:
        return
    attempts_inout.task[world] = Task.DESCEND
    setpoint = plan.point[world] + (move.tcp_offset + course.near) * plan.normal[world]
    state_inout.setpoint[world] = setpoint
    place_gripper(layout, world, setpoint, plan.tilt[world], motion_out.joint_q, motion_out.joint_qd)
    control_out.joint_target_q[world * layout.coords + TILT] = plan.tilt[world]


@wp.kernel
def watch_seals_kernel(seals: Seals, progress_inout: Progress):
    """Count the steps with an attached object in running attempts; once a step, after the seal forces. Launched over world."""
    world = wp.tid()
    if progress_inout.trial[world] < 0 or progress_inout.settling[world] != ATTEMPT:
        return
    for instance in range(seals.attached.shape[1]):
        if seals.attached[world, instance] != 0:
            progress_inout.held[world] = progress_inout.held[world] + 1
            return


@wp.kernel
def advance_trials_kernel(move: MoveData, pick: PickData, course: TrialData, state: Worlds, plan: Plans, attempts_inout: Attempts):
    """State machine of trials at the end of a tick: PRESS to LIFT by time; LIFT to LOOK after lift and hold, or once nothing is attached.

    The transition to LOOK writes `outcome`. Launched over world.
    """
    world = wp.tid()
    task = attempts_inout.task[world]
    if state.phase[world] != Phase.ACT or (task != Task.PRESS and task != Task.LIFT):
        return
    if task == Task.PRESS:
        if attempts_inout.steps[world] < pick.press_steps:
            return
        attempts_inout.task[world] = Task.LIFT
        attempts_inout.steps[world] = 0
    if has_members(attempts_inout.attached_words, world):
        goal = task_setpoint(Task.LIFT, plan.point[world], plan.normal[world], pick, move.tcp_offset)
        if task == Task.PRESS or wp.length(state.setpoint[world] - goal) >= ARRIVED:
            return
        if course.hold_steps > 0 and attempts_inout.steps[world] < course.lift_steps + course.hold_steps:
            return
    attempts_inout.outcome[world] = judge_attempt(plan.target[world], attempts_inout.engaged_words, attempts_inout.attached_words, world)
    attempts_inout.task[world] = Task.LOOK
    attempts_inout.steps[world] = 0


@wp.kernel
def judge_trials_kernel(
    layout: LayoutData,
    course: TrialData,
    grasps: Grasps,
    state: Worlds,
    attempts: Attempts,
    seals: Seals,
    motion: Motion,
    progress_inout: Progress,
    labels_out: Labels,
):
    """Write labels of trials at the end of a tick: of the attempt at its outcome, and of collateral motion `settle_ticks` later.

    The latter free the world for its next trial, and increment `done`. Before the outcome, duration, peak force and load are updated. An
    episode that ends also ends its trial. Launched over world.
    """
    world = wp.tid()
    trial = progress_inout.trial[world]
    if trial < 0:
        return
    settling = progress_inout.settling[world] - 1
    if progress_inout.settling[world] == ATTEMPT:
        progress_inout.ticks[world] = progress_inout.ticks[world] + 1
        progress_inout.peak_force[world] = wp.max(progress_inout.peak_force[world], seals.peak[world][0])
        progress_inout.load[world] = wp.max(progress_inout.load[world], seals.peak[world][1])
        if attempts.outcome[world] == Outcome.NONE and state.phase[world] == Phase.ACT:
            return
        picked = int(-1)
        for instance in range(layout.instances):
            if picked < 0 and has_member(attempts.attached_words, world, instance):
                picked = instance
        labels_out.outcome[trial] = attempts.outcome[world]
        labels_out.ending[trial] = wp.where(attempts.outcome[world] == Outcome.NONE, state.ending[world], 0)
        labels_out.hits[trial] = attempts.hits[world]
        labels_out.picked[trial] = picked
        labels_out.peak_force[trial] = progress_inout.peak_force[world]
        labels_out.load[trial] = progress_inout.load[world]
        labels_out.ticks[trial] = progress_inout.ticks[world]
        labels_out.held[trial] = progress_inout.held[world]
        settling = course.settle_ticks
    progress_inout.settling[world] = settling
    if settling > 0 and state.phase[world] == Phase.ACT:
        return
    target = grasps.target[trial // course.repeats]
    moved, farthest = measure_motion(layout, world, target, course.moved_distance, state, motion, progress_inout.pose)
    labels_out.moved[trial] = moved
    labels_out.farthest[trial] = farthest
    labels_out.lost[trial] = count_lost(attempts.removed, world) - progress_inout.lost[world]
    progress_inout.trial[world] = -1
    wp.atomic_add(progress_inout.done, 0, 1)


@wp.kernel
def list_choices_kernel(
    # Scene:
    catalog: CatalogData,
    states: int,
    # State:
    state: Worlds,
    attempts: Attempts,
    # Out:
    stride_inout: wp.array[int],  # (world)
    next_inout: wp.array[int],  # (one)
    world_out: wp.array[int],  # (row)
):
    """Write the worlds that planned an attempt in this tick, in order, to the next rows of a ring buffer; other rows become -1.

    Of an episode's attempts every `stride`-th counts, up to `states` of them, spread over as many attempts as it begins with labelled
    objects. `stride` is set at the first look of an episode, whether or not it sees a target. A single thread (dim 1).
    """
    rows = world_out.shape[0]
    for row in range(rows):
        world_out[row] = -1
    for world in range(state.phase.shape[0]):
        is_planned = attempts.task[world] == Task.APPROACH
        if state.phase[world] == Phase.ACT and attempts.steps[world] == 0 and (is_planned or attempts.task[world] == Task.LOOK):
            if attempts.attempt[world] == 0:
                objects = int(0)
                for instance in range(state.catalog_index.shape[1]):
                    if state.catalog_index[world, instance] >= 0 and state.catalog_index[world, instance] < catalog.count:
                        objects += 1
                stride_inout[world] = (objects + states - 1) // states
            stride = wp.max(stride_inout[world], 1)
            if is_planned and attempts.attempt[world] % stride == 0 and attempts.attempt[world] // stride < states:
                world_out[next_inout[0] % rows] = world
                next_inout[0] = next_inout[0] + 1
