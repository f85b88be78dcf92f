"""State machine of picking: start, tasks and outcome of attempts, and the removal of objects that were picked or lost."""

import warp as wp

from synpick_warp.codes import Mode, Outcome, Phase, Removal, Task
from synpick_warp.kernels.bitsets import NO_MEMBERS, has_member, has_members, pack_word
from synpick_warp.kernels.sim.drop import PARKED_HEIGHT, write_body
from synpick_warp.kernels.sim.gripper import place_gripper, task_setpoint
from synpick_warp.kernels.sim.rest import is_outside, shape_pose
from synpick_warp.kernels.state import Attempts, Control, Motion, Observations, Plans, Seals, Worlds
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
    layout: LayoutData, state: Worlds, attempts_out: Attempts, plan_out: Plans, observation_out: Observations, control_out: Control
):
    """Reset the attempt state of worlds outside of phase ACT or in its first frame, in which the picking modes begin with task LOOK.

    The outcome of every world becomes NONE: it is an event of one tick. `tilt_out` (drive target of the tilt joint) and `overflow_out` (a
    contour exceeds its capacity) become 0. Launched over world.
    """
    world = wp.tid()
    attempts_out.outcome[world] = Outcome.NONE
    if state.phase[world] == Phase.ACT and state.frame[world] > 0:
        return
    attempts_out.task[world] = Task.NONE
    if state.phase[world] == Phase.ACT and state.mode[world] != Mode.MOVE:
        attempts_out.task[world] = Task.LOOK
    attempts_out.steps[world] = 0
    attempts_out.attempt[world] = -1
    attempts_out.failures[world] = 0
    plan_out.target[world] = -1
    plan_out.yaw[world] = 0.0
    observation_out.overflow[world] = 0
    control_out.joint_target_q[world * layout.coords + TILT] = 0.0
    for instance in range(layout.instances):
        attempts_out.removed[world, instance] = 0


@wp.kernel
def clear_seals_kernel(state: Worlds, seals_out: Seals):
    """Release all seals of worlds outside of phase ACT: the last episode may have ended during a lift. Launched over world, instance."""
    world, instance = wp.tid()
    if state.phase[world] != Phase.ACT:
        seals_out.attached[world, instance] = 0


@wp.kernel
def remove_lost_kernel(
    layout: LayoutData,
    settle: SettleData,
    pick: PickData,
    bins: BinData,
    state_inout: Worlds,
    motion: Motion,
    attempts_out: Attempts,
    seals_out: Seals,
):
    """Remove objects in phase ACT that fell below `pick.floor`, or are at rest outside of the bin; `removed` becomes LOST.

    `displacement` is an object's motion in the last tick. Launched over world, instance.
    """
    world, instance = wp.tid()
    if state_inout.phase[world] != Phase.ACT or state_inout.catalog_index[world, instance] < 0:
        return
    position = wp.transform_get_translation(
        motion.body_q[world * layout.bodies + layout.gripper_bodies + state_inout.body_slot[world, instance]]
    )
    beside = is_outside(position, bins, world) and state_inout.displacement[world, instance] < settle.relaxed_rest_threshold
    if beside or position[2] < pick.floor:
        state_inout.catalog_index[world, instance] = -1
        attempts_out.removed[world, instance] = Removal.LOST
        seals_out.attached[world, instance] = 0


@wp.kernel
def pack_attached_kernel(state: Worlds, seals: Seals, attempts_out: Attempts):
    """Pack the attached instances of each world into a bit set. Launched over world, word."""
    world, word = wp.tid()
    attempts_out.attached_words[world, word] = pack_word(seals.attached, state.catalog_index, world, word)


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
def advance_tasks_kernel(move: MoveData, pick: PickData, state: Worlds, plan: Plans, attempts_inout: Attempts):
    """Task transitions at the end of a tick: PRESS to LIFT; end of an attempt after LIFT, or after a LOOK without target (NOTHING_SEEN).

    The end writes `outcome`, counts failures and starts LOOK; `kernels.sim.gripper` has the transitions between. Launched over world.
    """
    world = wp.tid()
    if state.phase[world] != Phase.ACT or state.mode[world] == Mode.MOVE:
        return
    task = attempts_inout.task[world]
    outcome = int(Outcome.NONE)
    if task == Task.PRESS and attempts_inout.steps[world] >= pick.press_steps:
        attempts_inout.task[world] = Task.LIFT
        attempts_inout.steps[world] = 0
    elif (
        task == Task.LIFT
        and wp.length(state.setpoint[world] - task_setpoint(Task.LIFT, plan.point[world], plan.normal[world], pick, move.tcp_offset))
        < ARRIVED
    ):
        outcome = judge_attempt(plan.target[world], attempts_inout.engaged_words, attempts_inout.attached_words, world)
    elif task == Task.LOOK and plan.target[world] < 0 and attempts_inout.steps[world] > 0:
        outcome = Outcome.NOTHING_SEEN
    if outcome != Outcome.NONE:
        attempts_inout.outcome[world] = outcome
        attempts_inout.failures[world] = count_failures(attempts_inout.failures[world], outcome, state.mode[world], pick)
        attempts_inout.task[world] = Task.LOOK
        attempts_inout.steps[world] = 0


@wp.kernel
def count_target_failures_kernel(state: Worlds, attempts_inout: Attempts, plan: Plans):
    """Count the failed attempts at each instance where an attempt has ended in this tick; 0 before the second frame of phase ACT.

    1 for each in the episode, plus SINCE_SUCCESS for each since the world's last success. Launched over world, instance.
    """
    world, instance = wp.tid()
    if state.phase[world] != Phase.ACT or state.frame[world] == 0:
        attempts_inout.target_failures[world, instance] = 0
    elif attempts_inout.outcome[world] >= Outcome.DROPPED and plan.target[world] == instance:
        attempts_inout.target_failures[world, instance] = attempts_inout.target_failures[world, instance] + SINCE_SUCCESS + 1
    elif attempts_inout.outcome[world] == Outcome.TARGET_PICKED or attempts_inout.outcome[world] == Outcome.OTHER_PICKED:
        attempts_inout.target_failures[world, instance] = attempts_inout.target_failures[world, instance] % SINCE_SUCCESS


@wp.kernel
def end_attempts_kernel(
    layout: LayoutData,
    drop: DropData,
    state_inout: Worlds,
    attempts_inout: Attempts,
    seals_out: Seals,
    motion_out: Motion,
    control_out: Control,
):
    """At task LOOK: release and remove attached objects (`removed` becomes PICKED), and place the gripper at `gripper_home`, cup upright.

    Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.ACT or attempts_inout.task[world] != Task.LOOK:
        return
    for instance in range(layout.instances):
        if has_member(attempts_inout.attached_words, world, instance):
            state_inout.catalog_index[world, instance] = -1
            attempts_inout.removed[world, instance] = Removal.PICKED
        seals_out.attached[world, instance] = 0
    place_gripper(layout, world, drop.gripper_home, 0.0, motion_out.joint_q, motion_out.joint_qd)
    control_out.joint_target_q[world * layout.coords + TILT] = 0.0


@wp.kernel
def park_removed_kernel(layout: LayoutData, state: Worlds, attempts: Attempts, motion_out: Motion, control_out: Control):
    """Park removed objects far below, each at its own position; in every tick, since they are simulated on and fall some centimetres.

    Launched over world, instance.
    """
    world, instance = wp.tid()
    if attempts.removed[world, instance] == 0:
        return
    slot = state.body_slot[world, instance]
    q = world * layout.coords + layout.gripper_dofs + 7 * slot
    qd = world * layout.dofs + layout.gripper_dofs + 6 * slot
    position = wp.vec3(PARKED_PITCH * float(slot + 1), 0.0, PARKED_HEIGHT)
    write_body(motion_out.joint_q, motion_out.joint_qd, q, qd, wp.transform(position, wp.quat_identity()))
    for axis in range(6):
        control_out.joint_f[qd + axis] = 0.0


@wp.kernel
def begin_attempts_kernel(state: Worlds, plan: Plans, attempts_inout: Attempts):
    """Begin an attempt in worlds at task LOOK after perception: no ray hits, no engaged instances; with a target, change to APPROACH.

    Launched over world.
    """
    world = wp.tid()
    if state.phase[world] != Phase.ACT or attempts_inout.task[world] != Task.LOOK:
        return
    attempts_inout.attempt[world] = attempts_inout.attempt[world] + 1
    attempts_inout.steps[world] = 0
    attempts_inout.hits[world] = wp.vec2i(0, 0)
    for word in range(attempts_inout.engaged_words.shape[1]):
        attempts_inout.engaged_words[world, word] = NO_MEMBERS
    if plan.target[world] >= 0:
        attempts_inout.task[world] = Task.APPROACH


@wp.kernel
def place_grippers_kernel(
    layout: LayoutData,
    move: MoveData,
    pick: PickData,
    state_inout: Worlds,
    attempts: Attempts,
    plan: Plans,
    motion_out: Motion,
    control_out: Control,
):
    """Place the gripper far above the grasp point, its cup tilted, where an APPROACH begins; the setpoint starts there.

    Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.ACT or attempts.task[world] != Task.APPROACH or attempts.steps[world] != 0:
        return
    setpoint = plan.point[world] + move.tcp_offset * plan.normal[world] + wp.vec3(0.0, 0.0, pick.appear_height)
    state_inout.setpoint[world] = setpoint
    place_gripper(layout, world, setpoint, plan.tilt[world], motion_out.joint_q, motion_out.joint_qd)
    control_out.joint_target_q[world * layout.coords + TILT] = plan.tilt[world]


@wp.kernel
def set_shaft_collision_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    state: Worlds,
    # Out:
    shape_transform_out: wp.array[wp.transform],  # (shape) [m]
):
    """Disable collisions of the gripper shaft in the picking modes, by moving its shape far away; in mode MOVE it is in place.

    Launched over world.
    """
    world = wp.tid()
    shape_transform_out[world * layout.shapes + layout.finger_shape] = shape_pose(state.mode[world] == Mode.MOVE)
