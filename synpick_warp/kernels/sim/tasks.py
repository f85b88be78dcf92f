"""State machine of picking: start, tasks and outcome of attempts, and the removal of objects that were picked or lost."""

import warp as wp

from synpick_warp.codes import Mode, Outcome, Phase, Removal, Task
from synpick_warp.kernels.bitsets import NO_MEMBERS, has_member, has_members, pack_word
from synpick_warp.kernels.sim.drop import PARKED_HEIGHT, write_body
from synpick_warp.kernels.sim.gripper import place_gripper, task_setpoint
from synpick_warp.kernels.sim.rest import is_outside, shape_pose
from synpick_warp.kernels.structs import TILT, BinData, DropData, LayoutData, MoveData, PickData, SettleData

wp.set_module_options({"enable_backward": False})

# Distance between parked objects, larger than any object [m].
PARKED_PITCH = wp.constant(5.0)
# Distance to the target at which a setpoint has arrived [m]; two kernels may round the target differently.
ARRIVED = wp.constant(1.0e-4)

# Weight of a failed attempt since the last success, against 1 for each in the episode: more than a world has instances.
SINCE_SUCCESS = wp.constant(1024)


@wp.kernel
def begin_picking_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    phase: wp.array[int],  # (world)
    mode: wp.array[int],  # (world)
    frame: wp.array[int],  # (world)
    # Out:
    task_out: wp.array[int],  # (world)
    steps_out: wp.array[int],  # (world)
    attempt_out: wp.array[int],  # (world)
    outcome_out: wp.array[int],  # (world)
    failures_out: wp.array[int],  # (world)
    target_out: wp.array[int],  # (world)
    yaw_out: wp.array[float],  # (world) [rad]
    overflow_out: wp.array[int],  # (world)
    removed_out: wp.array2d[int],  # (world, instance)
    tilt_out: wp.array[float],  # (coord) [rad]
):
    """Reset the attempt state of worlds outside of phase ACT or in its first frame, in which the picking modes begin with task LOOK.

    The outcome of every world becomes NONE: it is an event of one tick. `tilt_out` (drive target of the tilt joint) and `overflow_out` (a
    contour exceeds its capacity) become 0. Launched over world.
    """
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
    phase: wp.array[int],  # (world)
    # Out:
    attached_out: wp.array2d[int],  # (world, instance)
):
    """Release all seals of worlds outside of phase ACT: the last episode may have ended during a lift. Launched over world, instance."""
    world, instance = wp.tid()
    if phase[world] != Phase.ACT:
        attached_out[world, instance] = 0


@wp.kernel
def remove_lost_kernel(
    # Scene:
    layout: LayoutData,
    settle: SettleData,
    pick: PickData,
    bins: BinData,
    # State:
    phase: wp.array[int],  # (world)
    body_slot: wp.array2d[int],  # (world, instance)
    displacement: wp.array2d[float],  # (world, instance) [m]
    body_q: wp.array[wp.transform],  # (body) [m]
    catalog_index_inout: wp.array2d[int],  # (world, instance)
    # Out:
    removed_out: wp.array2d[int],  # (world, instance)
    attached_out: wp.array2d[int],  # (world, instance)
):
    """Remove objects in phase ACT that fell below `pick.floor`, or are at rest outside of the bin; `removed` becomes LOST.

    `displacement` is an object's motion in the last tick. Launched over world, instance.
    """
    world, instance = wp.tid()
    if phase[world] != Phase.ACT or catalog_index_inout[world, instance] < 0:
        return
    position = wp.transform_get_translation(body_q[world * layout.bodies + layout.gripper_bodies + body_slot[world, instance]])
    beside = is_outside(position, bins, world) and displacement[world, instance] < settle.relaxed_rest_threshold
    if beside or position[2] < pick.floor:
        catalog_index_inout[world, instance] = -1
        removed_out[world, instance] = Removal.LOST
        attached_out[world, instance] = 0


@wp.kernel
def pack_attached_kernel(
    # State:
    catalog_index: wp.array2d[int],  # (world, instance)
    attached: wp.array2d[int],  # (world, instance)
    # Out:
    attached_words_out: wp.array2d[wp.uint32],  # (world, word)
):
    """Pack the attached instances of each world into a bit set. Launched over world, word."""
    world, word = wp.tid()
    attached_words_out[world, word] = pack_word(attached, catalog_index, world, word)


@wp.func
def judge_attempt(target: int, engaged: wp.array2d[wp.uint32], attached: wp.array2d[wp.uint32], world: int) -> int:
    """`Outcome` of an attempt from the instances that it engaged (hit by a ray) and those still attached after the lift, as bit sets."""
    if has_members(attached, world):
        if target >= 0 and has_member(attached, world, target):
            return Outcome.TARGET_PICKED
        return Outcome.OTHER_PICKED
    if has_members(engaged, world):
        return Outcome.DROPPED
    return Outcome.NOTHING_CAUGHT


@wp.func
def count_failures(failures: int, outcome: int, mode: int, pick: PickData) -> int:
    """Count of failed attempts after one more outcome; a success resets it where `forgive` has the mode's bit."""
    if outcome == Outcome.TARGET_PICKED or outcome == Outcome.OTHER_PICKED:
        if (pick.forgive >> mode) & 1 != 0:
            return 0
        return failures
    return failures + 1


@wp.kernel
def advance_tasks_kernel(
    # Scene:
    move: MoveData,
    pick: PickData,
    # State:
    phase: wp.array[int],  # (world)
    mode: wp.array[int],  # (world)
    setpoint: wp.array[wp.vec3],  # (world) [m]
    point: wp.array[wp.vec3],  # (world) [m]
    normal: wp.array[wp.vec3],  # (world)
    target: wp.array[int],  # (world)
    engaged_words: wp.array2d[wp.uint32],  # (world, word)
    attached_words: wp.array2d[wp.uint32],  # (world, word)
    task_inout: wp.array[int],  # (world)
    steps_inout: wp.array[int],  # (world)
    failures_inout: wp.array[int],  # (world)
    # Out:
    outcome_out: wp.array[int],  # (world)
):
    """Task transitions at the end of a tick: PRESS to LIFT; end of an attempt after LIFT, or after a LOOK without target (NOTHING_SEEN).

    The end writes `outcome`, counts failures and starts LOOK; `kernels.sim.gripper` has the transitions between. Launched over world.
    """
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
        outcome = judge_attempt(target[world], engaged_words, attached_words, world)
    elif task == Task.LOOK and target[world] < 0 and steps_inout[world] > 0:
        outcome = Outcome.NOTHING_SEEN
    if outcome != Outcome.NONE:
        outcome_out[world] = outcome
        failures_inout[world] = count_failures(failures_inout[world], outcome, mode[world], pick)
        task_inout[world] = Task.LOOK
        steps_inout[world] = 0


@wp.kernel
def count_target_failures_kernel(
    # State:
    phase: wp.array[int],  # (world)
    frame: wp.array[int],  # (world)
    outcome: wp.array[int],  # (world)
    target: wp.array[int],  # (world)
    # Out:
    target_failures_inout: wp.array2d[int],  # (world, instance)
):
    """Count the failed attempts at each instance where an attempt has ended in this tick; 0 before the second frame of phase ACT.

    1 for each in the episode, plus SINCE_SUCCESS for each since the world's last success. Launched over world, instance.
    """
    world, instance = wp.tid()
    if phase[world] != Phase.ACT or frame[world] == 0:
        target_failures_inout[world, instance] = 0
    elif outcome[world] >= Outcome.DROPPED and target[world] == instance:
        target_failures_inout[world, instance] = target_failures_inout[world, instance] + SINCE_SUCCESS + 1
    elif outcome[world] == Outcome.TARGET_PICKED or outcome[world] == Outcome.OTHER_PICKED:
        target_failures_inout[world, instance] = target_failures_inout[world, instance] % SINCE_SUCCESS


@wp.kernel
def end_attempts_kernel(
    # Scene:
    layout: LayoutData,
    drop: DropData,
    # State:
    phase: wp.array[int],  # (world)
    task: wp.array[int],  # (world)
    attached_words: wp.array2d[wp.uint32],  # (world, word)
    # Out:
    catalog_index_out: wp.array2d[int],  # (world, instance)
    removed_out: wp.array2d[int],  # (world, instance)
    attached_out: wp.array2d[int],  # (world, instance)
    joint_q_out: wp.array[float],  # (coord) [m, rad]
    joint_qd_out: wp.array[float],  # (dof) [m/s, rad/s]
    tilt_out: wp.array[float],  # (coord) [rad]
):
    """At task LOOK: release and remove attached objects (`removed` becomes PICKED), and place the gripper at `gripper_home`, cup upright.

    Launched over world.
    """
    world = wp.tid()
    if phase[world] != Phase.ACT or task[world] != Task.LOOK:
        return
    for instance in range(layout.instances):
        if has_member(attached_words, world, instance):
            catalog_index_out[world, instance] = -1
            removed_out[world, instance] = Removal.PICKED
        attached_out[world, instance] = 0
    place_gripper(layout, world, drop.gripper_home, 0.0, joint_q_out, joint_qd_out)
    tilt_out[world * layout.coords + TILT] = 0.0


@wp.kernel
def park_removed_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    body_slot: wp.array2d[int],  # (world, instance)
    removed: wp.array2d[int],  # (world, instance)
    # Out:
    joint_q_out: wp.array[float],  # (coord) [m, rad]
    joint_qd_out: wp.array[float],  # (dof) [m/s, rad/s]
    joint_f_out: wp.array[float],  # (dof) [N, N·m]
):
    """Park removed objects far below, each at its own position; in every tick, since they are simulated on and fall some centimetres.

    Launched over world, instance.
    """
    world, instance = wp.tid()
    if removed[world, instance] == 0:
        return
    slot = body_slot[world, instance]
    q = world * layout.coords + layout.gripper_dofs + 7 * slot
    qd = world * layout.dofs + layout.gripper_dofs + 6 * slot
    position = wp.vec3(PARKED_PITCH * float(slot + 1), 0.0, PARKED_HEIGHT)
    write_body(joint_q_out, joint_qd_out, q, qd, wp.transform(position, wp.quat_identity()))
    for axis in range(6):
        joint_f_out[qd + axis] = 0.0


@wp.kernel
def begin_attempts_kernel(
    # State:
    phase: wp.array[int],  # (world)
    target: wp.array[int],  # (world)
    task_inout: wp.array[int],  # (world)
    attempt_inout: wp.array[int],  # (world)
    # Out:
    steps_out: wp.array[int],  # (world)
    hits_out: wp.array[wp.vec2i],  # (world)
    engaged_words_out: wp.array2d[wp.uint32],  # (world, word)
):
    """Begin an attempt in worlds at task LOOK after perception: no ray hits, no engaged instances; with a target, change to APPROACH.

    Launched over world.
    """
    world = wp.tid()
    if phase[world] != Phase.ACT or task_inout[world] != Task.LOOK:
        return
    attempt_inout[world] = attempt_inout[world] + 1
    steps_out[world] = 0
    hits_out[world] = wp.vec2i(0, 0)
    for word in range(engaged_words_out.shape[1]):
        engaged_words_out[world, word] = NO_MEMBERS
    if target[world] >= 0:
        task_inout[world] = Task.APPROACH


@wp.kernel
def place_grippers_kernel(
    # Scene:
    layout: LayoutData,
    move: MoveData,
    pick: PickData,
    # State:
    phase: wp.array[int],  # (world)
    task: wp.array[int],  # (world)
    steps: wp.array[int],  # (world)
    point: wp.array[wp.vec3],  # (world) [m]
    normal: wp.array[wp.vec3],  # (world)
    tilt: wp.array[float],  # (world) [rad]
    # Out:
    setpoint_out: wp.array[wp.vec3],  # (world) [m]
    joint_q_out: wp.array[float],  # (coord) [m, rad]
    joint_qd_out: wp.array[float],  # (dof) [m/s, rad/s]
    tilt_out: wp.array[float],  # (coord) [rad]
):
    """Place the gripper far above the grasp point, its cup tilted, where an APPROACH begins; the setpoint starts there.

    Launched over world.
    """
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
    mode: wp.array[int],  # (world)
    # Out:
    shape_transform_out: wp.array[wp.transform],  # (shape) [m]
):
    """Disable collisions of the gripper shaft in the picking modes, by moving its shape far away; in mode MOVE it is in place.

    Launched over world.
    """
    world = wp.tid()
    shape_transform_out[world * layout.shapes + layout.finger_shape] = shape_pose(mode[world] == Mode.MOVE)
