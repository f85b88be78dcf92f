"""Twist control: commands drive the gripper's setpoint, yaw and tilt by velocity, and switch its suction, in place of a planned attempt."""

import warp as wp

from synpick_warp.codes import Mode, Phase, Task
from synpick_warp.kernels.bitsets import has_members
from synpick_warp.kernels.environment.attempts import begin_attempt
from synpick_warp.kernels.rng import TAU
from synpick_warp.kernels.sim.gripper import place_gripper
from synpick_warp.kernels.sim.tasks import judge_attempt
from synpick_warp.kernels.state import Attempts, Control, Motion, Plans, Seals, Worlds
from synpick_warp.kernels.structs import TILT, BinData, LayoutData, MoveData, PickData

wp.set_module_options({"enable_backward": False})

# Height of the cup's lip above the rim where an attempt begins, and beyond which an object that hangs on it counts as picked [m].
START_HEIGHT = wp.constant(0.15)
# Largest distance of the setpoint from the wrist [m], which bounds the force of the position controller.
LEAD = wp.constant(0.05)
# Columns of a command: linear velocity (3) [m/s], rates of yaw and tilt [rad/s], suction (on above 0).
YAW_RATE = wp.constant(3)
TILT_RATE = wp.constant(4)
SUCTION = wp.constant(5)


@wp.func
def start_setpoint(bins: BinData, world: int, tcp_offset: float) -> wp.vec3:
    """Start position of the wrist, above the middle of a world's bin with the cup pointing down [m]."""
    height = bins.rim_height[bins.chosen[world]] + START_HEIGHT + tcp_offset
    return wp.transform_point(bins.pose[world], wp.vec3(0.0, 0.0, height))


@wp.kernel
def begin_twists_kernel(
    # Scene:
    layout: LayoutData,
    move: MoveData,
    pick: PickData,
    bins: BinData,
    tick_time: float,
    # State:
    command: wp.array2d[float],  # (world, column)
    state_inout: Worlds,
    attempts_inout: Attempts,
    plan_inout: Plans,
    seals_inout: Seals,
    # Out:
    motion_out: Motion,
    control_out: Control,
):
    """Begin attempts of worlds at task LOOK, with the gripper above the middle of the bin. Then apply the commands of a tick: integrate yaw
    and tilt, release objects if suction is off, and write the task.

    Task LIFT: an object hangs on the cup; PRESS: suction is on, and its rays are cast at the end of the tick; DESCEND: suction is off.
    Mode MOVE ignores these commands. Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.ACT or state_inout.mode[world] == Mode.MOVE:
        return
    if attempts_inout.task[world] <= Task.LOOK:
        setpoint = start_setpoint(bins, world, move.tcp_offset)
        state_inout.setpoint[world] = setpoint
        place_gripper(layout, world, setpoint, 0.0, motion_out.joint_q, motion_out.joint_qd)
        begin_attempt(attempts_inout, world)
        plan_inout.yaw[world] = 0.0
        plan_inout.tilt[world] = 0.0
    yaw = plan_inout.yaw[world] + command[world, YAW_RATE] * tick_time
    if yaw > 0.5 * TAU:
        yaw -= TAU
    elif yaw <= -0.5 * TAU:
        yaw += TAU
    plan_inout.yaw[world] = yaw
    tilt = wp.clamp(plan_inout.tilt[world] + command[world, TILT_RATE] * tick_time, -pick.tilt_limit, pick.tilt_limit)
    plan_inout.tilt[world] = tilt
    control_out.joint_target_q[world * layout.coords + TILT] = tilt
    task = int(Task.DESCEND)
    if command[world, SUCTION] > 0.0:
        task = int(Task.PRESS)
    for instance in range(layout.instances):
        if task == Task.DESCEND:
            seals_inout.attached[world, instance] = 0
        elif seals_inout.attached[world, instance] != 0:
            task = int(Task.LIFT)
    attempts_inout.task[world] = task
    attempts_inout.steps[world] = pick.press_steps


@wp.kernel
def follow_twists_kernel(
    # Scene:
    layout: LayoutData,
    move: MoveData,
    lower: wp.vec3,
    upper: wp.vec3,
    # State:
    command: wp.array2d[float],  # (world, column)
    motion: Motion,
    # Out:
    state_inout: Worlds,
):
    """Integrate the setpoints over a step of physics at the commanded velocity, clamped to a box and to LEAD from the wrist.

    Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.ACT:
        return
    q = world * layout.coords
    wrist = wp.vec3(motion.joint_q[q], motion.joint_q[q + 1], motion.joint_q[q + 2])
    velocity = wp.vec3(command[world, 0], command[world, 1], command[world, 2])
    lead = state_inout.setpoint[world] + velocity * move.step - wrist
    distance = wp.length(lead)
    if distance > LEAD:
        lead = lead * (LEAD / distance)
    state_inout.setpoint[world] = wp.max(wp.min(wrist + lead, upper), lower)


@wp.kernel
def end_twists_kernel(
    layout: LayoutData, move: MoveData, bins: BinData, state: Worlds, plan: Plans, motion: Motion, attempts_inout: Attempts
):
    """End attempts (task LOOK) whose objects hang at the start height, writing `outcome`, or whose bin is empty. Launched over world."""
    world = wp.tid()
    if state.phase[world] != Phase.ACT or state.mode[world] == Mode.MOVE:
        return
    left = int(0)
    for instance in range(layout.instances):
        if state.catalog_index[world, instance] >= 0:
            left += 1
    if left == 0:
        attempts_inout.task[world] = Task.LOOK
        return
    start = start_setpoint(bins, world, move.tcp_offset)
    if has_members(attempts_inout.attached_words, world) and motion.joint_q[world * layout.coords + 2] >= start[2]:
        words = attempts_inout.attached_words
        attempts_inout.outcome[world] = judge_attempt(plan.target[world], attempts_inout.engaged_words, words, world)
        attempts_inout.task[world] = Task.LOOK
