"""How an attempt to pick begins, goes on and ends; what leaves the scene."""

import warp as wp

from synpick_warp.codes import Mode, Outcome, Phase, Task
from synpick_warp.kernels.sim.arrangement import PARKED_HEIGHT, write_body
from synpick_warp.kernels.sim.gripper import place_gripper, task_target
from synpick_warp.kernels.sim.rest import is_outside, shape_place
from synpick_warp.kernels.structs import TILT, DropData, LayoutData, MoveData, PickData, SettleData

wp.set_module_options({"enable_backward": False})

# Why an instance has left the scene; 0: it has not.
PICKED = wp.constant(1)
LOST = wp.constant(2)
# Room between objects that have left and are parked, more than any two of them need [m].
PARKED_PITCH = wp.constant(5.0)
# A goal so near to its target has arrived [m]; two kernels may round the target differently.
ARRIVED = wp.constant(1.0e-4)


@wp.kernel
def begin_picking_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    phase: wp.array[int],
    mode: wp.array[int],
    frame: wp.array[int],
    # Out:
    task_out: wp.array[int],
    steps_out: wp.array[int],
    attempt_out: wp.array[int],
    outcome_out: wp.array[int],
    failures_out: wp.array[int],
    target_out: wp.array[int],
    yaw_out: wp.array[float],
    overflow_out: wp.array[int],
    removed_out: wp.array2d[int],
    tilt_out: wp.array[float],
):
    """Worlds that do not act have no task and a straight gripper; those that begin to act in a mode of picking LOOK."""
    world = wp.tid()
    outcome_out[world] = Outcome.NONE
    if phase[world] == Phase.ACT and frame[world] > 0:
        return
    task_out[world] = Task.NONE
    if phase[world] == Phase.ACT and mode[world] != Mode.MOVE:
        task_out[world] = Task.LOOK
    steps_out[world] = 0
    attempt_out[world] = -1
    failures_out[world] = 0
    target_out[world] = -1
    yaw_out[world] = 0.0
    overflow_out[world] = 0
    tilt_out[world * layout.coords + TILT] = 0.0
    for instance in range(layout.instances):
        removed_out[world, instance] = 0


@wp.kernel
def forget_seals_kernel(
    # State:
    phase: wp.array[int],
    # Out:
    held_out: wp.array2d[int],
):
    """Nothing hangs on the cup of a world that does not act: not even where the last episode broke off in a lift."""
    world, instance = wp.tid()
    if phase[world] != Phase.ACT:
        held_out[world, instance] = 0


@wp.kernel
def remove_lost_kernel(
    # Scene:
    layout: LayoutData,
    drop: DropData,
    settle: SettleData,
    pick: PickData,
    # State:
    phase: wp.array[int],
    slot: wp.array2d[int],
    shift: wp.array2d[float],
    body_q: wp.array[wp.transform],
    entry_inout: wp.array2d[int],
    # Out:
    removed_out: wp.array2d[int],
    held_out: wp.array2d[int],
):
    """What fell below the floor, or came to rest beside the tote, leaves the scene while the gripper acts."""
    world, instance = wp.tid()
    if phase[world] != Phase.ACT or entry_inout[world, instance] < 0:
        return
    position = wp.transform_get_translation(body_q[world * layout.bodies + layout.gripper_bodies + slot[world, instance]])
    beside = is_outside(position, drop) and shift[world, instance] < settle.last_shift
    if beside or position[2] < pick.floor:
        entry_inout[world, instance] = -1
        removed_out[world, instance] = LOST
        held_out[world, instance] = 0


@wp.kernel
def count_held_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    entry: wp.array2d[int],
    held: wp.array2d[int],
    # Out:
    hanging_out: wp.array[wp.uint32],
):
    """Bit i: instance i hangs on the cup."""
    world = wp.tid()
    bits = wp.uint32(0)
    for instance in range(layout.instances):
        if held[world, instance] != 0 and entry[world, instance] >= 0:
            bits = bits | (wp.uint32(1) << wp.uint32(instance))
    hanging_out[world] = bits


@wp.func
def judge_attempt(target: int, caught: wp.uint32, hanging: wp.uint32) -> int:
    """Outcome of an attempt from the target and from what was caught and what still hangs, as bits of instances."""
    if hanging != wp.uint32(0):
        if target >= 0 and (hanging & (wp.uint32(1) << wp.uint32(target))) != wp.uint32(0):
            return Outcome.TARGET_PICKED
        return Outcome.OTHER_PICKED
    if caught != wp.uint32(0):
        return Outcome.DROPPED
    return Outcome.NOTHING_CAUGHT


@wp.func
def failures_after(failures: int, outcome: int, mode: int, pick: PickData) -> int:
    """Count of failed attempts after one more has ended."""
    if outcome == Outcome.TARGET_PICKED or outcome == Outcome.OTHER_PICKED:
        if mode == Mode.TARGET and pick.forgive != 0:
            return 0
        return failures
    return failures + 1


@wp.kernel
def advance_tasks_kernel(
    # Scene:
    move: MoveData,
    pick: PickData,
    # State:
    phase: wp.array[int],
    mode: wp.array[int],
    goal: wp.array[wp.vec3],
    point: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    target: wp.array[int],
    caught: wp.array[wp.uint32],
    hanging: wp.array[wp.uint32],
    task_inout: wp.array[int],
    steps_inout: wp.array[int],
    failures_inout: wp.array[int],
    # Out:
    outcome_out: wp.array[int],
):
    """At the end of a tick: after PRESS, LIFT; after LIFT, or when a look has found nothing, the outcome, and LOOK again."""
    world = wp.tid()
    if phase[world] != Phase.ACT or mode[world] == Mode.MOVE:
        return
    task = task_inout[world]
    outcome = int(Outcome.NONE)
    if task == Task.PRESS and steps_inout[world] >= pick.press_steps:
        task_inout[world] = Task.LIFT
        steps_inout[world] = 0
    elif task == Task.LIFT and wp.length(goal[world] - task_target(Task.LIFT, point[world], normal[world], pick, move.tip)) < ARRIVED:
        outcome = judge_attempt(target[world], caught[world], hanging[world])
    elif task == Task.LOOK and target[world] < 0 and steps_inout[world] > 0:
        outcome = Outcome.NOTHING_SEEN
    if outcome != Outcome.NONE:
        outcome_out[world] = outcome
        failures_inout[world] = failures_after(failures_inout[world], outcome, mode[world], pick)
        task_inout[world] = Task.LOOK
        steps_inout[world] = 0


@wp.kernel
def end_attempts_kernel(
    # Scene:
    layout: LayoutData,
    drop: DropData,
    # State:
    phase: wp.array[int],
    task: wp.array[int],
    hanging: wp.array[wp.uint32],
    # Out:
    entry_out: wp.array2d[int],
    removed_out: wp.array2d[int],
    held_out: wp.array2d[int],
    joint_q_out: wp.array[float],
    joint_qd_out: wp.array[float],
    tilt_out: wp.array[float],
):
    """Worlds that LOOK: what hangs on the cup leaves the scene, and the gripper waits at home, upright and out of the picture."""
    world = wp.tid()
    if phase[world] != Phase.ACT or task[world] != Task.LOOK:
        return
    for instance in range(layout.instances):
        if (hanging[world] & (wp.uint32(1) << wp.uint32(instance))) != wp.uint32(0):
            entry_out[world, instance] = -1
            removed_out[world, instance] = PICKED
        held_out[world, instance] = 0
    place_gripper(layout, world, drop.gripper_home, 0.0, joint_q_out, joint_qd_out)
    tilt_out[world * layout.coords + TILT] = 0.0


@wp.kernel
def park_removed_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    slot: wp.array2d[int],
    removed: wp.array2d[int],
    # Out:
    joint_q_out: wp.array[float],
    joint_qd_out: wp.array[float],
    joint_f_out: wp.array[float],
):
    """Hold what has left the scene far below, each object in a place of its own; within a tick it falls by some centimetres."""
    world, instance = wp.tid()
    if removed[world, instance] == 0:
        return
    s = slot[world, instance]
    q = world * layout.coords + layout.gripper_dofs + 7 * s
    qd = world * layout.dofs + layout.gripper_dofs + 6 * s
    place = wp.vec3(PARKED_PITCH * float(s + 1), 0.0, PARKED_HEIGHT)
    write_body(joint_q_out, joint_qd_out, q, qd, wp.transform(place, wp.quat_identity()))
    for axis in range(6):
        joint_f_out[qd + axis] = 0.0


@wp.kernel
def begin_attempts_kernel(
    # State:
    phase: wp.array[int],
    target: wp.array[int],
    task_inout: wp.array[int],
    attempt_inout: wp.array[int],
    # Out:
    steps_out: wp.array[int],
    hits_out: wp.array[int],
    caught_out: wp.array[wp.uint32],
):
    """Worlds that have looked begin an attempt; with a target, they APPROACH it."""
    world = wp.tid()
    if phase[world] != Phase.ACT or task_inout[world] != Task.LOOK:
        return
    attempt_inout[world] = attempt_inout[world] + 1
    steps_out[world] = 0
    hits_out[world] = 0
    caught_out[world] = wp.uint32(0)
    if target[world] >= 0:
        task_inout[world] = Task.APPROACH


@wp.kernel
def place_grippers_kernel(
    # Scene:
    layout: LayoutData,
    move: MoveData,
    pick: PickData,
    # State:
    phase: wp.array[int],
    task: wp.array[int],
    steps: wp.array[int],
    point: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    tilt: wp.array[float],
    # Out:
    goal_out: wp.array[wp.vec3],
    joint_q_out: wp.array[float],
    joint_qd_out: wp.array[float],
    tilt_out: wp.array[float],
):
    """Where an APPROACH begins, the gripper appears far above the grasp, its cup tilted."""
    world = wp.tid()
    if phase[world] != Phase.ACT or task[world] != Task.APPROACH or steps[world] != 0:
        return
    goal = point[world] + move.tip * normal[world] + wp.vec3(0.0, 0.0, pick.appear_height)
    goal_out[world] = goal
    place_gripper(layout, world, goal, tilt[world], joint_q_out, joint_qd_out)
    tilt_out[world * layout.coords + TILT] = tilt[world]


@wp.kernel
def set_fingers_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    mode: wp.array[int],
    # Out:
    shape_transform_out: wp.array[wp.transform],
):
    """The finger collides when moving, where the gripper is one rigid body, and not when picking."""
    world = wp.tid()
    shape_transform_out[world * layout.shapes + layout.finger_shape] = shape_place(mode[world] == Mode.MOVE)
