"""Gripper control: setpoint generation (corners of the bin, or approach and lift), impedance control, and the yaw of the shaft.

The gripper is a vertical shaft ("finger" in settings and data sets) with three prismatic joints, and a suction cup that tilts about the
wrist axis at the shaft's lower end. Setpoints are positions of the wrist; the TCP lies `tcp_offset` below it when the cup is upright.
"""

import warp as wp

from synpick_warp.codes import Mode, Phase, Stream, Task
from synpick_warp.kernels.rng import stream_key, uniform_index
from synpick_warp.kernels.state import Attempts, Control, Motion, Plans, Worlds
from synpick_warp.kernels.structs import TILT, BinData, LayoutData, MoveData, PickData

wp.set_module_options({"enable_backward": False})

# Waypoints of a round: the four corners of a compartment.
ROUND = wp.constant(4)
# Height above the rim in which the TCP passes from one compartment to the next [m].
PASS_HEIGHT = wp.constant(0.05)


@wp.func
def bin_corner(code: int, bins: BinData, world: int) -> wp.vec3:
    """TCP at the corner of a compartment that `code` names, in the frame of the world's bin [m].

    Bits 0 and 1 are the corner, the others the compartment.
    """
    return bins.waypoint[bins.first_compartment[bins.chosen[world]] + code // ROUND, code % ROUND]


@wp.kernel
def begin_moving_kernel(seed: wp.uint64, layout: LayoutData, move: MoveData, bins: BinData, state_inout: Worlds, motion_inout: Motion):
    """Count frames; in the first frame of mode MOVE, sample the order of the corners and place the gripper above the first one.

    The order is a Fisher-Yates shuffle of the four corners for each round; rounds take the compartments in turn, from a random one on.
    `corner_order` is the corner, 0 to 3, plus 4 times the compartment. `frame` is -1 outside of phase ACT, and counts from 0 in it.
    Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.ACT:
        state_inout.frame[world] = -1
        return
    state_inout.frame[world] = state_inout.frame[world] + 1
    if state_inout.frame[world] > 0 or state_inout.mode[world] != Mode.MOVE:
        return
    key = stream_key(seed, state_inout.arrangement_id[world][0], state_inout.arrangement_id[world][1], Stream.CORNERS)
    for visit in range(move.waypoints):
        state_inout.corner_order[world, visit] = visit % ROUND
    for visit in range(move.waypoints):
        left = ROUND - visit % ROUND
        other = visit + uniform_index(key, visit, left)
        kept = state_inout.corner_order[world, visit]
        state_inout.corner_order[world, visit] = state_inout.corner_order[world, other]
        state_inout.corner_order[world, other] = kept
    chosen = bins.chosen[world]
    compartments = bins.first_compartment[chosen + 1] - bins.first_compartment[chosen]
    first = uniform_index(key, move.waypoints, compartments)
    for visit in range(move.waypoints):
        state_inout.corner_order[world, visit] = state_inout.corner_order[world, visit] + ROUND * ((first + visit // ROUND) % compartments)
    corner = bin_corner(state_inout.corner_order[world, 0], bins, world)
    setpoint = wp.transform_point(bins.pose[world], wp.vec3(corner[0], corner[1], move.start_height))
    setpoint = wp.vec3(setpoint[0], setpoint[1], setpoint[2] + move.tcp_offset)
    state_inout.setpoint[world] = setpoint
    state_inout.waypoint[world] = 0
    place_gripper(layout, world, setpoint, 0.0, motion_inout.joint_q, motion_inout.joint_qd)


@wp.func
def place_gripper(layout: LayoutData, world: int, position: wp.vec3, tilt: float, joint_q: wp.array[float], joint_qd: wp.array[float]):
    """Write a world's gripper joints: wrist at `position` [m], cup at `tilt` [rad], velocities zero."""
    for axis in range(3):
        joint_q[world * layout.coords + axis] = position[axis]
    joint_q[world * layout.coords + TILT] = tilt
    for axis in range(layout.gripper_dofs):
        joint_qd[world * layout.dofs + axis] = 0.0


@wp.func
def step_towards(setpoint: wp.vec3, target: wp.vec3, stride: float) -> wp.vec3:
    """Setpoint moved by `stride` towards the target [m], without overshoot."""
    direction = target - setpoint
    distance = wp.length(direction)
    if distance <= stride:
        return target
    return setpoint + direction * (stride / distance)


@wp.func
def pass_over(setpoint: wp.vec3, target: wp.vec3, height: float) -> wp.vec3:
    """Next point of a path that leads up to `height`, over to the target, and down to it [m]."""
    if setpoint[0] == target[0] and setpoint[1] == target[1]:
        return target
    if setpoint[2] < height:
        return wp.vec3(setpoint[0], setpoint[1], height)
    return wp.vec3(target[0], target[1], setpoint[2])


@wp.func
def task_setpoint(task: int, point: wp.vec3, normal: wp.vec3, pick: PickData, tcp_offset: float) -> wp.vec3:
    """Wrist position at the end of a task [m]: with the TCP at the grasp point, before it (APPROACH), or above it (LIFT)."""
    wrist = point + tcp_offset * normal
    if task == Task.APPROACH:
        return wrist + pick.near * normal
    if task == Task.LIFT:
        return wrist + wp.vec3(0.0, 0.0, pick.lift_height)
    return wrist


@wp.kernel
def advance_setpoints_kernel(move: MoveData, pick: PickData, bins: BinData, state_inout: Worlds, plan: Plans, attempts_inout: Attempts):
    """Advance the setpoints by one step of physics, at constant speed.

    Mode MOVE: towards the next corner, over the rim into another compartment; a reached one increments `waypoint`. Picking: APPROACH to
    `near` before the grasp point, then DESCEND along the normal, then PRESS without motion. The ends of PRESS and LIFT are detected once a
    tick, by `tasks.advance_tasks_kernel`. Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.ACT:
        return
    setpoint = state_inout.setpoint[world]
    if state_inout.mode[world] == Mode.MOVE:
        waypoint = state_inout.waypoint[world]
        if waypoint < move.waypoints:
            code = state_inout.corner_order[world, waypoint]
            target = wp.transform_point(bins.pose[world], bin_corner(code, bins, world))
            target = wp.vec3(target[0], target[1], target[2] + move.tcp_offset)
            next = target
            if waypoint > 0 and state_inout.corner_order[world, wp.max(waypoint - 1, 0)] // ROUND != code // ROUND:
                height = (
                    wp.transform_get_translation(bins.pose[world])[2] + bins.rim_height[bins.chosen[world]] + PASS_HEIGHT + move.tcp_offset
                )
                next = pass_over(setpoint, target, height)
            setpoint = step_towards(setpoint, next, move.speed * move.step)
            state_inout.setpoint[world] = setpoint
            if setpoint == target:
                state_inout.waypoint[world] = waypoint + 1
        return
    task = attempts_inout.task[world]
    attempts_inout.steps[world] = attempts_inout.steps[world] + 1
    if task < Task.APPROACH:
        return
    speed = pick.speed
    if task == Task.DESCEND:
        speed = pick.near_speed
    elif task == Task.LIFT:
        speed = pick.lift_speed
    target = task_setpoint(task, plan.point[world], plan.normal[world], pick, move.tcp_offset)
    setpoint = step_towards(setpoint, target, speed * move.step)
    state_inout.setpoint[world] = setpoint
    if setpoint == target and (task == Task.APPROACH or task == Task.DESCEND):
        attempts_inout.task[world] = task + 1
        attempts_inout.steps[world] = 0


@wp.func
def impedance_force(
    offset: wp.vec3, velocity: wp.vec3, stiffness: float, damping: float, max_force: float, mass: float, dt: float
) -> wp.vec3:
    """Impedance control: force of a spring-damper from position to setpoint, implicit in the velocity, clamped to a norm of `max_force`.

    F = (k (x_setpoint - x - dt v) - d v) / (1 + (d dt + k dt²) / m): the force that k (x_setpoint - x') - d v' gives with the
    velocity v' = v + dt F / m and position x' = x + dt v' at the end of the step. Stable for every mass.
    """
    force = (stiffness * (offset - dt * velocity) - damping * velocity) / (1.0 + (damping * dt + stiffness * dt * dt) / mass)
    size = wp.length(force)
    if size > max_force:
        force = force * (max_force / size)
    return force


@wp.kernel
def drive_gripper_kernel(
    layout: LayoutData, move: MoveData, pick: PickData, state: Worlds, attempts: Attempts, motion: Motion, control_out: Control
):
    """Write the gripper's joint forces: impedance control plus gravity compensation m g; without a task, gravity compensation only.

    Of `joint_f`, the gripper's x, y, z and tilt are written; the tilt joint has a drive of its own and receives 0. Launched over world.
    """
    world = wp.tid()
    q = world * layout.coords
    qd = world * layout.dofs
    offset = state.setpoint[world] - wp.vec3(motion.joint_q[q], motion.joint_q[q + 1], motion.joint_q[q + 2])
    velocity = wp.vec3(motion.joint_qd[qd], motion.joint_qd[qd + 1], motion.joint_qd[qd + 2])
    force = wp.vec3(0.0, 0.0, 0.0)
    if state.phase[world] == Phase.ACT:
        if state.mode[world] == Mode.MOVE:
            force = impedance_force(offset, velocity, move.stiffness, move.damping, move.force, move.mass, move.step)
        elif attempts.task[world] >= Task.APPROACH:
            force = impedance_force(offset, velocity, pick.stiffness, pick.damping, pick.force, move.mass, move.step)
    control_out.joint_f[qd] = force[0]
    control_out.joint_f[qd + 1] = force[1]
    control_out.joint_f[qd + 2] = force[2] + move.mass * move.gravity
    control_out.joint_f[qd + TILT] = 0.0


@wp.kernel
def set_yaw_kernel(
    # Scene:
    finger_joint: wp.array[int],  # (world)
    # In:
    yaw: wp.array[float],  # (world) [rad]
    # Out:
    joint_child_out: wp.array[wp.transform],  # (joint) [m]
):
    """Set the yaw ψ of every gripper shaft about z: the child frame of its joint is R_z(-ψ) in the shaft's frame.

    Yaw is a property of the joint, not a degree of freedom, so that x, y and z of the joint stay the world's axes. Launched over world.
    """
    world = wp.tid()
    rotation = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), -yaw[world])
    joint_child_out[finger_joint[world]] = wp.transform(wp.vec3(0.0, 0.0, 0.0), rotation)
