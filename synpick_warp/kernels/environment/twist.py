"""Twist control: commands drive the gripper's setpoint, yaw and tilt by velocity, and switch its suction, in place of a planned attempt."""

import warp as wp

from synpick_warp.codes import Mode, Phase, Task
from synpick_warp.kernels.bitsets import NO_MEMBERS, has_members
from synpick_warp.kernels.rng import TAU
from synpick_warp.kernels.sim.gripper import place_gripper
from synpick_warp.kernels.sim.tasks import judge_attempt
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
def start_twists_kernel(
    # Scene:
    layout: LayoutData,
    move: MoveData,
    bins: BinData,
    # State:
    phase: wp.array[int],  # (world)
    mode: wp.array[int],  # (world)
    task: wp.array[int],  # (world)
    # Out:
    attempt_inout: wp.array[int],  # (world)
    yaw_out: wp.array[float],  # (world) [rad]
    tilt_out: wp.array[float],  # (world) [rad]
    setpoint_out: wp.array[wp.vec3],  # (world) [m]
    hits_out: wp.array[wp.vec2i],  # (world)
    engaged_words_out: wp.array2d[wp.uint32],  # (world, word)
    joint_q_out: wp.array[float],  # (coord) [m, rad]
    joint_qd_out: wp.array[float],  # (dof) [m/s, rad/s]
):
    """Begin attempts of worlds at task LOOK: write the gripper's start pose above the middle of the bin. Launched over world."""
    world = wp.tid()
    if phase[world] != Phase.ACT or mode[world] == Mode.MOVE or task[world] > Task.LOOK:
        return
    setpoint = start_setpoint(bins, world, move.tcp_offset)
    setpoint_out[world] = setpoint
    place_gripper(layout, world, setpoint, 0.0, joint_q_out, joint_qd_out)
    attempt_inout[world] = attempt_inout[world] + 1
    yaw_out[world] = 0.0
    tilt_out[world] = 0.0
    hits_out[world] = wp.vec2i(0, 0)
    for word in range(engaged_words_out.shape[1]):
        engaged_words_out[world, word] = NO_MEMBERS


@wp.kernel
def begin_twists_kernel(
    # Scene:
    layout: LayoutData,
    pick: PickData,
    tick_time: float,
    # State:
    phase: wp.array[int],  # (world)
    mode: wp.array[int],  # (world)
    command: wp.array2d[float],  # (world, column)
    yaw_inout: wp.array[float],  # (world) [rad]
    tilt_inout: wp.array[float],  # (world) [rad]
    attached_inout: wp.array2d[int],  # (world, instance)
    # Out:
    task_out: wp.array[int],  # (world)
    steps_out: wp.array[int],  # (world)
    tilt_target_out: wp.array[float],  # (coord) [rad]
):
    """Apply the commands of a tick: integrate yaw and tilt, release objects if suction is off, and write the task.

    Task LIFT: an object hangs on the cup; PRESS: suction is on, and its rays are cast at the end of the tick; DESCEND: suction is off.
    Mode MOVE ignores these commands. Launched over world.
    """
    world = wp.tid()
    if phase[world] != Phase.ACT or mode[world] == Mode.MOVE:
        return
    yaw = yaw_inout[world] + command[world, YAW_RATE] * tick_time
    if yaw > 0.5 * TAU:
        yaw -= TAU
    elif yaw <= -0.5 * TAU:
        yaw += TAU
    yaw_inout[world] = yaw
    tilt = wp.clamp(tilt_inout[world] + command[world, TILT_RATE] * tick_time, -pick.tilt_limit, pick.tilt_limit)
    tilt_inout[world] = tilt
    tilt_target_out[world * layout.coords + TILT] = tilt
    task = int(Task.DESCEND)
    if command[world, SUCTION] > 0.0:
        task = int(Task.PRESS)
    for instance in range(layout.instances):
        if task == Task.DESCEND:
            attached_inout[world, instance] = 0
        elif attached_inout[world, instance] != 0:
            task = int(Task.LIFT)
    task_out[world] = task
    steps_out[world] = pick.press_steps


@wp.kernel
def follow_twists_kernel(
    # Scene:
    layout: LayoutData,
    move: MoveData,
    lower: wp.vec3,
    upper: wp.vec3,
    # State:
    phase: wp.array[int],  # (world)
    command: wp.array2d[float],  # (world, column)
    joint_q: wp.array[float],  # (coord) [m, rad]
    # Out:
    setpoint_inout: wp.array[wp.vec3],  # (world) [m]
):
    """Integrate the setpoints over a step of physics at the commanded velocity, clamped to a box and to LEAD from the wrist.

    Launched over world.
    """
    world = wp.tid()
    if phase[world] != Phase.ACT:
        return
    q = world * layout.coords
    wrist = wp.vec3(joint_q[q], joint_q[q + 1], joint_q[q + 2])
    velocity = wp.vec3(command[world, 0], command[world, 1], command[world, 2])
    lead = setpoint_inout[world] + velocity * move.step - wrist
    distance = wp.length(lead)
    if distance > LEAD:
        lead = lead * (LEAD / distance)
    setpoint_inout[world] = wp.max(wp.min(wrist + lead, upper), lower)


@wp.kernel
def end_twists_kernel(
    # Scene:
    layout: LayoutData,
    move: MoveData,
    bins: BinData,
    # State:
    phase: wp.array[int],  # (world)
    mode: wp.array[int],  # (world)
    catalog_index: wp.array2d[int],  # (world, instance)
    target: wp.array[int],  # (world)
    engaged_words: wp.array2d[wp.uint32],  # (world, word)
    attached_words: wp.array2d[wp.uint32],  # (world, word)
    joint_q: wp.array[float],  # (coord) [m, rad]
    # Out:
    task_inout: wp.array[int],  # (world)
    outcome_out: wp.array[int],  # (world)
):
    """End attempts (task LOOK) whose objects hang at the start height, writing `outcome`, or whose bin is empty. Launched over world."""
    world = wp.tid()
    if phase[world] != Phase.ACT or mode[world] == Mode.MOVE:
        return
    left = int(0)
    for instance in range(layout.instances):
        if catalog_index[world, instance] >= 0:
            left += 1
    if left == 0:
        task_inout[world] = Task.LOOK
        return
    start = start_setpoint(bins, world, move.tcp_offset)
    if has_members(attached_words, world) and joint_q[world * layout.coords + 2] >= start[2]:
        outcome_out[world] = judge_attempt(target[world], engaged_words, attached_words, world)
        task_inout[world] = Task.LOOK
