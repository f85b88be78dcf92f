"""Where the gripper is to be: corners of the tote in turn when moving, a grasp and a lift when picking."""

import warp as wp

from synpick_warp.codes import Mode, Phase, Stream, Task
from synpick_warp.kernels.rng import stream_key, uniform_index
from synpick_warp.kernels.structs import TILT, LayoutData, MoveData, PickData

wp.set_module_options({"enable_backward": False})

# The tote has four corners; each round visits all of them.
ROUND = wp.constant(4)


@wp.func
def tote_corner(code: int, corner: wp.vec3) -> wp.vec3:
    """Corner 0 to 3: bit 0 is the sign of x, bit 1 that of y."""
    x = corner[0]
    y = corner[1]
    if (code & 1) == 1:
        x = -x
    if (code & 2) == 2:
        y = -y
    return wp.vec3(x, y, corner[2])


@wp.kernel
def begin_moving_kernel(
    # Scene:
    seed: wp.uint64,
    layout: LayoutData,
    move: MoveData,
    # State:
    arrangement_id: wp.array[wp.vec2i],
    mode: wp.array[int],
    phase: wp.array[int],
    frame_inout: wp.array[int],
    joint_q_inout: wp.array[float],
    joint_qd_inout: wp.array[float],
    # Out:
    corner_order_out: wp.array2d[int],
    setpoint_out: wp.array[wp.vec3],
    waypoint_out: wp.array[int],
):
    """Count frames. When a world of mode MOVE begins to act: draw the corner_order of the corners, put the gripper above the first.

    Each round is a Fisher-Yates shuffle of the four corners.
    """
    world = wp.tid()
    if phase[world] != Phase.ACT:
        frame_inout[world] = -1
        return
    frame_inout[world] = frame_inout[world] + 1
    if frame_inout[world] > 0 or mode[world] != Mode.MOVE:
        return
    key = stream_key(seed, arrangement_id[world][0], arrangement_id[world][1], Stream.CORNERS)
    for visit in range(move.waypoints):
        corner_order_out[world, visit] = visit % ROUND
    for visit in range(move.waypoints):
        left = ROUND - visit % ROUND
        other = visit + uniform_index(key, visit, left)
        kept = corner_order_out[world, visit]
        corner_order_out[world, visit] = corner_order_out[world, other]
        corner_order_out[world, other] = kept
    setpoint = tote_corner(corner_order_out[world, 0], move.corner)
    setpoint = wp.vec3(setpoint[0], setpoint[1], move.start_height + move.tcp_offset)
    setpoint_out[world] = setpoint
    waypoint_out[world] = 0
    place_gripper(layout, world, setpoint, 0.0, joint_q_inout, joint_qd_inout)


@wp.func
def place_gripper(layout: LayoutData, world: int, position: wp.vec3, tilt: float, joint_q: wp.array[float], joint_qd: wp.array[float]):
    """Put a world's gripper somewhere, at rest."""
    for axis in range(3):
        joint_q[world * layout.coords + axis] = position[axis]
    joint_q[world * layout.coords + TILT] = tilt
    for axis in range(layout.gripper_dofs):
        joint_qd[world * layout.dofs + axis] = 0.0


@wp.func
def step_towards(setpoint: wp.vec3, target: wp.vec3, stride: float) -> wp.vec3:
    """The setpoint, moved towards the target by a stride, and no farther than to it."""
    way = target - setpoint
    distance = wp.length(way)
    if distance <= stride:
        return target
    return setpoint + way * (stride / distance)


@wp.func
def task_setpoint(task: int, point: wp.vec3, normal: wp.vec3, pick: PickData, tcp_offset: float) -> wp.vec3:
    """Where the tilt axis is to be at the end of a task [m]: so that the cup's tip is at the grasp point, before it, or above it."""
    axis = point + tcp_offset * normal
    if task == Task.APPROACH:
        return axis + pick.near * normal
    if task == Task.LIFT:
        return axis + wp.vec3(0.0, 0.0, pick.lift_height)
    return axis


@wp.kernel
def advance_setpoints_kernel(
    # Scene:
    move: MoveData,
    pick: PickData,
    # State:
    phase: wp.array[int],
    mode: wp.array[int],
    corner_order: wp.array2d[int],
    point: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    task_inout: wp.array[int],
    steps_inout: wp.array[int],
    waypoint_inout: wp.array[int],
    setpoint_inout: wp.array[wp.vec3],
):
    """Move the goals on by one step, at constant speed.

    Moving: towards the next corner. Picking: APPROACH to `near` before the grasp point, then DESCEND along the normal, then PRESS, where
    it waits, as after a LIFT; these two are ended by the tick.
    """
    world = wp.tid()
    if phase[world] != Phase.ACT:
        return
    setpoint = setpoint_inout[world]
    if mode[world] == Mode.MOVE:
        if waypoint_inout[world] < move.waypoints:
            target = tote_corner(corner_order[world, waypoint_inout[world]], move.corner)
            target = wp.vec3(target[0], target[1], target[2] + move.tcp_offset)
            setpoint = step_towards(setpoint, target, move.speed * move.step)
            setpoint_inout[world] = setpoint
            if setpoint == target:
                waypoint_inout[world] = waypoint_inout[world] + 1
        return
    task = task_inout[world]
    steps_inout[world] = steps_inout[world] + 1
    if task < Task.APPROACH:
        return
    speed = pick.speed
    if task == Task.DESCEND:
        speed = pick.near_speed
    elif task == Task.LIFT:
        speed = pick.lift_speed
    target = task_setpoint(task, point[world], normal[world], pick, move.tcp_offset)
    setpoint = step_towards(setpoint, target, speed * move.step)
    setpoint_inout[world] = setpoint
    if setpoint == target and (task == Task.APPROACH or task == Task.DESCEND):
        task_inout[world] = task + 1
        steps_inout[world] = 0


@wp.func
def impedance_force(
    offset: wp.vec3, velocity: wp.vec3, stiffness: float, damping: float, max_force: float, mass: float, dt: float
) -> wp.vec3:
    """Force of a spring-damper, implicit in the velocity, at most `max_force` in size.

    F = (k (x_goal - x - dt v) - d v) / (1 + (d dt + k dt²) / m): the force that k (x_goal - x') - d v' gives with the
    velocity v' = v + dt F / m and position x' = x + dt v' at the end of the step. Stable for every mass.
    """
    force = (stiffness * (offset - dt * velocity) - damping * velocity) / (1.0 + (damping * dt + stiffness * dt * dt) / mass)
    size = wp.length(force)
    if size > max_force:
        force = force * (max_force / size)
    return force


@wp.kernel
def drive_gripper_kernel(
    # Scene:
    layout: LayoutData,
    move: MoveData,
    pick: PickData,
    # State:
    phase: wp.array[int],
    mode: wp.array[int],
    task: wp.array[int],
    setpoint: wp.array[wp.vec3],
    joint_q: wp.array[float],
    joint_qd: wp.array[float],
    # Out:
    joint_f_out: wp.array[float],
):
    """Pull the gripper after its setpoint: F = impedance + m g. At home it only bears its weight."""
    world = wp.tid()
    q = world * layout.coords
    qd = world * layout.dofs
    offset = setpoint[world] - wp.vec3(joint_q[q], joint_q[q + 1], joint_q[q + 2])
    velocity = wp.vec3(joint_qd[qd], joint_qd[qd + 1], joint_qd[qd + 2])
    force = wp.vec3(0.0, 0.0, 0.0)
    if phase[world] == Phase.ACT:
        if mode[world] == Mode.MOVE:
            force = impedance_force(offset, velocity, move.stiffness, move.damping, move.force, move.mass, move.step)
        elif task[world] >= Task.APPROACH:
            force = impedance_force(offset, velocity, pick.stiffness, pick.damping, pick.force, move.mass, move.step)
    joint_f_out[qd] = force[0]
    joint_f_out[qd + 1] = force[1]
    joint_f_out[qd + 2] = force[2] + move.mass * move.gravity
    joint_f_out[qd + TILT] = 0.0


@wp.kernel
def set_yaw_kernel(
    # Scene:
    finger_joint: wp.array[int],
    # In:
    yaw: wp.array[float],
    # Out:
    joint_child_out: wp.array[wp.transform],
):
    """Turn each finger by its yaw ψ about z against the axes of its joint: the joint's frame lies in the finger's at R_z(-ψ)."""
    world = wp.tid()
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), -yaw[world])
    joint_child_out[finger_joint[world]] = wp.transform(wp.vec3(0.0, 0.0, 0.0), turn)
