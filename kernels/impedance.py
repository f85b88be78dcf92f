"""The gripper's goal and the force that draws it there."""

import warp as wp

from synpick_warp.kernels.draws import CORNERS, stream_key, uniform_index
from synpick_warp.kernels.phases import ACT
from synpick_warp.kernels.structs import LayoutData, MoveData

wp.set_module_options({"enable_backward": False})

# The tote has four corners; each round visits all of them.
ROUND = wp.constant(4)


@wp.func
def corner_of(code: int, corner: wp.vec3) -> wp.vec3:
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
    address: wp.array[wp.vec2i],
    phase: wp.array[int],
    frame_inout: wp.array[int],
    joint_q_inout: wp.array[float],
    joint_qd_inout: wp.array[float],
    # Out:
    order_out: wp.array2d[int],
    goal_out: wp.array[wp.vec3],
    waypoint_out: wp.array[int],
):
    """When a world begins to act: draw the order of the corners, put the gripper above the first. Count its frames.

    Each round is a Fisher-Yates shuffle of the four corners.
    """
    world = wp.tid()
    if phase[world] != ACT:
        frame_inout[world] = -1
        return
    frame_inout[world] = frame_inout[world] + 1
    if frame_inout[world] > 0:
        return
    key = stream_key(seed, address[world][0], address[world][1], CORNERS)
    for visit in range(move.waypoints):
        order_out[world, visit] = visit % ROUND
    for visit in range(move.waypoints):
        left = ROUND - visit % ROUND
        other = visit + uniform_index(key, visit, left)
        kept = order_out[world, visit]
        order_out[world, visit] = order_out[world, other]
        order_out[world, other] = kept
    goal = corner_of(order_out[world, 0], move.corner)
    goal = wp.vec3(goal[0], goal[1], move.start_height + move.tip)
    goal_out[world] = goal
    waypoint_out[world] = 0
    for axis in range(3):
        joint_q_inout[world * layout.coords + axis] = goal[axis]
    for axis in range(layout.gripper_dofs):
        joint_qd_inout[world * layout.dofs + axis] = 0.0


@wp.func
def impedance_force(offset: wp.vec3, velocity: wp.vec3, stiffness: float, damping: float, limit: float, mass: float, dt: float) -> wp.vec3:
    """Force of a spring-damper, implicit in the velocity, at most `limit` in size.

    F = (k (x_goal - x - dt v) - d v) / (1 + (d dt + k dt²) / m): the force that k (x_goal - x') - d v' gives with the
    velocity v' = v + dt F / m and position x' = x + dt v' at the end of the step. Stable for every mass.
    """
    force = (stiffness * (offset - dt * velocity) - damping * velocity) / (1.0 + (damping * dt + stiffness * dt * dt) / mass)
    size = wp.length(force)
    if size > limit:
        force = force * (limit / size)
    return force


@wp.kernel
def drive_gripper_kernel(
    # Scene:
    layout: LayoutData,
    move: MoveData,
    # State:
    phase: wp.array[int],
    order: wp.array2d[int],
    joint_q: wp.array[float],
    joint_qd: wp.array[float],
    goal_inout: wp.array[wp.vec3],
    waypoint_inout: wp.array[int],
    # Out:
    joint_f_out: wp.array[float],
):
    """Move the goal on towards the next corner at constant speed, and pull the gripper after it. Gravity is fed forward."""
    world = wp.tid()
    q = world * layout.coords
    qd = world * layout.dofs
    force = wp.vec3(0.0, 0.0, 0.0)
    if phase[world] == ACT:
        if waypoint_inout[world] < move.waypoints:
            target = corner_of(order[world, waypoint_inout[world]], move.corner)
            target = wp.vec3(target[0], target[1], target[2] + move.tip)
            way = target - goal_inout[world]
            distance = wp.length(way)
            stride = move.speed * move.step
            if distance <= stride:
                goal_inout[world] = target
                waypoint_inout[world] = waypoint_inout[world] + 1
            else:
                goal_inout[world] = goal_inout[world] + way * (stride / distance)
        position = wp.vec3(joint_q[q], joint_q[q + 1], joint_q[q + 2])
        velocity = wp.vec3(joint_qd[qd], joint_qd[qd + 1], joint_qd[qd + 2])
        force = impedance_force(
            goal_inout[world] - position, velocity, move.stiffness, move.damping, move.force, move.mass, move.step
        )
    joint_f_out[qd] = force[0]
    joint_f_out[qd + 1] = force[1]
    joint_f_out[qd + 2] = force[2] + move.mass * move.gravity
