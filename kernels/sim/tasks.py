"""How an attempt to pick begins, goes on and ends; what leaves the scene."""

import warp as wp

from synpick_warp.codes import Mode, Outcome, Phase, Task
from synpick_warp.kernels.sim.arrangement import PARKED_HEIGHT, write_body
from synpick_warp.kernels.sim.gripper import place_gripper, task_setpoint
from synpick_warp.kernels.sim.rest import is_outside, shape_pose
from synpick_warp.kernels.structs import TILT, DropData, LayoutData, MoveData, PickData, SettleData

wp.set_module_options({"enable_backward": False})

# Why an instance has left the scene; 0: it has not.
PICKED = wp.constant(1)
LOST = wp.constant(2)
# Room between objects that have left and are parked, more than any two of them need [m].
PARKED_PITCH = wp.constant(5.0)
# A setpoint so near to its target has arrived [m]; two kernels may round the target differently.
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
def clear_seals_kernel(
    # State:
    phase: wp.array[int],
    # Out:
    attached_out: wp.array2d[int],
):
    """Nothing hangs on the cup of a world that does not act: not even where the last episode broke off in a lift."""
    world, instance = wp.tid()
    if phase[world] != Phase.ACT:
        attached_out[world, instance] = 0


@wp.kernel
def remove_lost_kernel(
    # Scene:
    layout: LayoutData,
    drop: DropData,
    settle: SettleData,
    pick: PickData,
    # State:
    phase: wp.array[int],
    body_slot: wp.array2d[int],
    displacement: wp.array2d[float],
    body_q: wp.array[wp.transform],
    catalog_index_inout: wp.array2d[int],
    # Out:
    removed_out: wp.array2d[int],
    attached_out: wp.array2d[int],
):
    """What fell below the floor, or came to rest beside the tote, leaves the scene while the gripper acts."""
    world, instance = wp.tid()
    if phase[world] != Phase.ACT or catalog_index_inout[world, instance] < 0:
        return
    position = wp.transform_get_translation(body_q[world * layout.bodies + layout.gripper_bodies + body_slot[world, instance]])
    beside = is_outside(position, drop) and displacement[world, instance] < settle.relaxed_rest_threshold
    if beside or position[2] < pick.floor:
        catalog_index_inout[world, instance] = -1
        removed_out[world, instance] = LOST
        attached_out[world, instance] = 0


@wp.kernel
def pack_attached_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    catalog_index: wp.array2d[int],
    attached: wp.array2d[int],
    # Out:
    attached_bits_out: wp.array[wp.uint32],
):
    """Bit i: instance i hangs on the cup."""
    world = wp.tid()
    bits = wp.uint32(0)
    for instance in range(layout.instances):
        if attached[world, instance] != 0 and catalog_index[world, instance] >= 0:
            bits = bits | (wp.uint32(1) << wp.uint32(instance))
    attached_bits_out[world] = bits


@wp.func
def judge_attempt(target: int, engaged_bits: wp.uint32, attached_bits: wp.uint32) -> int:
    """Outcome of an attempt from the target and from what was engaged_bits and what still hangs, as bits of instances."""
    if attached_bits != wp.uint32(0):
        if target >= 0 and (attached_bits & (wp.uint32(1) << wp.uint32(target))) != wp.uint32(0):
            return Outcome.TARGET_PICKED
        return Outcome.OTHER_PICKED
    if engaged_bits != wp.uint32(0):
        return Outcome.DROPPED
    return Outcome.NOTHING_CAUGHT


@wp.func
def count_failures(failures: int, outcome: int, mode: int, pick: PickData) -> int:
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
    setpoint: wp.array[wp.vec3],
    point: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    target: wp.array[int],
    engaged_bits: wp.array[wp.uint32],
    attached_bits: wp.array[wp.uint32],
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
    elif (
        task == Task.LIFT
        and wp.length(setpoint[world] - task_setpoint(Task.LIFT, point[world], normal[world], pick, move.tcp_offset)) < ARRIVED
    ):
        outcome = judge_attempt(target[world], engaged_bits[world], attached_bits[world])
    elif task == Task.LOOK and target[world] < 0 and steps_inout[world] > 0:
        outcome = Outcome.NOTHING_SEEN
    if outcome != Outcome.NONE:
        outcome_out[world] = outcome
        failures_inout[world] = count_failures(failures_inout[world], outcome, mode[world], pick)
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
    attached_bits: wp.array[wp.uint32],
    # Out:
    catalog_index_out: wp.array2d[int],
    removed_out: wp.array2d[int],
    attached_out: wp.array2d[int],
    joint_q_out: wp.array[float],
    joint_qd_out: wp.array[float],
    tilt_out: wp.array[float],
):
    """Worlds that LOOK: what hangs on the cup leaves the scene, and the gripper waits at home, upright and out of the picture."""
    world = wp.tid()
    if phase[world] != Phase.ACT or task[world] != Task.LOOK:
        return
    for instance in range(layout.instances):
        if (attached_bits[world] & (wp.uint32(1) << wp.uint32(instance))) != wp.uint32(0):
            catalog_index_out[world, instance] = -1
            removed_out[world, instance] = PICKED
        attached_out[world, instance] = 0
    place_gripper(layout, world, drop.gripper_home, 0.0, joint_q_out, joint_qd_out)
    tilt_out[world * layout.coords + TILT] = 0.0


@wp.kernel
def park_removed_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    body_slot: wp.array2d[int],
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
    s = body_slot[world, instance]
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
    engaged_bits_out: wp.array[wp.uint32],
):
    """Worlds that have looked begin an attempt; with a target, they APPROACH it."""
    world = wp.tid()
    if phase[world] != Phase.ACT or task_inout[world] != Task.LOOK:
        return
    attempt_inout[world] = attempt_inout[world] + 1
    steps_out[world] = 0
    hits_out[world] = 0
    engaged_bits_out[world] = wp.uint32(0)
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
    setpoint_out: wp.array[wp.vec3],
    joint_q_out: wp.array[float],
    joint_qd_out: wp.array[float],
    tilt_out: wp.array[float],
):
    """Where an APPROACH begins, the gripper appears far above the grasp, its cup tilted."""
    world = wp.tid()
    if phase[world] != Phase.ACT or task[world] != Task.APPROACH or steps[world] != 0:
        return
    setpoint = point[world] + move.tcp_offset * normal[world] + wp.vec3(0.0, 0.0, pick.appear_height)
    setpoint_out[world] = setpoint
    place_gripper(layout, world, setpoint, tilt[world], joint_q_out, joint_qd_out)
    tilt_out[world * layout.coords + TILT] = tilt[world]


@wp.kernel
def set_shaft_collision_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    mode: wp.array[int],
    # Out:
    shape_transform_out: wp.array[wp.transform],
):
    """The finger collides when moving, where the gripper is one rigid body, and not when picking."""
    world = wp.tid()
    shape_transform_out[world * layout.shapes + layout.finger_shape] = shape_pose(mode[world] == Mode.MOVE)
