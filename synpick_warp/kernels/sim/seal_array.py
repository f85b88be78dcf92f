"""Seals of several cups with an object: together one spring-damper at the middle of the cups, shared out to them.

The seals of an object act on two rigid bodies. Their resistance to rotation grows with the distances of the cups from the middle. They are
solved as one spring-damper, then shared out. Frames are those of `kernels.sim.seal`. One cup has a kernel of its own there: sums over cups
change which products the compiler fuses with sums, and so the last bits of every pick.
"""

import warp as wp

from synpick_warp.kernels.sim.cup_rays import CUP, has_bit
from synpick_warp.kernels.sim.seal import (
    InverseMass,
    RotationError,
    TcpMotion,
    Wrench,
    add_inverse_masses,
    gripper_inverse_mass,
    object_inverse_mass,
    pull_gripper,
    push_object,
    rotation_error,
    solve_wrench,
    tcp_motion,
    tension_and_shear,
)
from synpick_warp.kernels.state import Control, Motion, Seals, Worlds
from synpick_warp.kernels.structs import CupData, LayoutData, SuctionData

wp.set_module_options({"enable_backward": False})


@wp.struct
class CupSpread:
    """Elastic torque of an object's cups beside their middle, and the second moment of their places."""

    torque: wp.vec3
    """Σ r x k (r - r_grip) about the middle, on the object [N·m]."""
    moment: wp.mat33
    """Σ |r|² 1 - r rᵀ, in the world's axes [m²]."""


@wp.struct
class SolvedSeals:
    """Wrench of an object's seals at the middle of their cups, and what it takes to share it out."""

    whole: Wrench
    """Of all seals, on the object."""
    grip_rotation: wp.quat
    """From the grip frame to the world."""
    object_arm: wp.vec3
    """From the object's centre of mass to the middle of the cups [m]."""
    spin: wp.vec3
    """Angular velocity of the head relative to the object at the end of the step [rad/s]."""


@wp.struct
class HeldObject:
    """What the seals of an object do in a step: cups that hold on, and their wrench about the object's centre of mass."""

    cups: int
    """Bits of the cups whose seals did not break."""
    peak: wp.vec2
    """Largest tension and shear of a seal, that of one that breaks included [N], and largest relative to its break force."""
    force: wp.vec3
    """On the object, in the world's axes [N]."""
    torque: wp.vec3
    """[N·m]"""


@wp.func
def count_seals(held: int, cups: CupData) -> int:
    """Number of cups that hold an object; `held`: its bits in `attached`."""
    count = int(0)
    for cup in range(cups.count):
        count += (held >> cup) & 1
    return count


@wp.func
def middle_of_cups(held: int, cups: CupData) -> wp.vec3:
    """Middle of the cups that hold an object, in the head's frame [m]."""
    total = wp.vec3(0.0, 0.0, 0.0)
    for cup in range(cups.count):
        if has_bit(held, cup):
            total += cups.place[cup]
    return total / float(count_seals(held, cups))


@wp.func
def spread_of_cups(held: int, middle: wp.vec3, head: wp.quat, grip: wp.quat, suction: SuctionData, cups: CupData) -> CupSpread:
    """Spread of the cups that hold an object about their middle; rotations from the head's and from the grip's axes to the world."""
    result = CupSpread()
    for cup in range(cups.count):
        if has_bit(held, cup):
            arm = wp.quat_rotate(head, cups.place[cup] - middle)
            stretch = arm - wp.quat_rotate(grip, cups.place[cup] - middle)
            result.torque += wp.cross(arm, suction.stiffness * stretch)
            result.moment += wp.dot(arm, arm) * wp.identity(n=3, dtype=float) - wp.outer(arm, arm)
    return result


@wp.func
def wrench_of_seals(
    offset: wp.vec3,
    error: RotationError,
    spread: CupSpread,
    seals: int,
    velocity: wp.vec3,
    angular_velocity: wp.vec3,
    inverse_mass: InverseMass,
    suction: SuctionData,
) -> Wrench:
    """Wrench of an object's n seals on it; offset and velocities are those at the middle of the cups.

    The stiffness is n times a seal's; against rotation, k Σ |r|² 1 - r rᵀ of the cups' places r is added. So is the damping.
    """
    h = suction.step
    n = float(seals)
    gain = h * suction.stiffness + suction.damping
    linear_gain = n * gain
    angular_gain = n * (h * error.stiffness + suction.twist_damping * wp.identity(n=3, dtype=float)) + gain * spread.moment
    force = n * suction.stiffness * offset + linear_gain * velocity
    torque = n * error.torque + spread.torque + angular_gain * angular_velocity
    return solve_wrench(force, torque, linear_gain, angular_gain, inverse_mass, h)


@wp.func
def force_of_cup(whole: Wrench, seals: int, arm: wp.vec3, grip_arm: wp.vec3, spin: wp.vec3, suction: SuctionData) -> wp.vec3:
    """Force of one cup's seal on the object, a share of that of its n seals: F / n + k (r - r_grip) + (h k + d) ω' x r [N].

    Args:
        whole: Wrench of all seals of the object at the middle of their cups.
        seals: Their number.
        arm: From the middle to the cup, r [m].
        grip_arm: The same on the object, r_grip [m].
        spin: Angular velocity of the head relative to the object at the end of the step, ω' [rad/s].
        suction: Stiffness and damping.
    """
    gain = suction.step * suction.stiffness + suction.damping
    return whole.force / float(seals) + suction.stiffness * (arm - grip_arm) + gain * wp.cross(spin, arm)


@wp.func
def solve_seals(
    held: int,
    objects: int,
    tcp: TcpMotion,
    object_in_world: wp.transform,
    velocity: wp.spatial_vector,
    com: wp.vec3,
    inverse_mass: float,
    inverse_inertia: wp.mat33,
    object_in_tcp: wp.transform,
    suction: SuctionData,
    cups: CupData,
) -> SolvedSeals:
    """Wrench of an object's seals in this step.

    Args:
        held: Cups that hold it, as bits.
        objects: Number of objects on the gripper.
        tcp: Motion at the middle of these cups.
        object_in_world: Pose of the object [m].
        velocity: Of the object [m/s, rad/s].
        com: Its centre of mass in its frame [m].
        inverse_mass: Its inverse mass [1/kg].
        inverse_inertia: Its inverse inertia, in its axes [1/(kg·m²)].
        object_in_tcp: Its pose in the tool's TCP frame at rest [m].
        suction: Stiffness and damping of a seal.
        cups: Places of the cups.
    """
    result = SolvedSeals()
    middle = middle_of_cups(held, cups)
    grip_in_world = object_in_world * wp.transform_inverse(object_in_tcp)
    result.grip_rotation = wp.transform_get_rotation(grip_in_world)
    result.object_arm = tcp.position - wp.transform_point(object_in_world, com)
    rotation = wp.transform_get_rotation(object_in_world)
    of_object = object_inverse_mass(rotation, inverse_mass, inverse_inertia, result.object_arm)
    both = add_inverse_masses(of_object, gripper_inverse_mass(suction, tcp.wrist_axis, tcp.wrist_arm, objects))
    slip = tcp.velocity - wp.spatial_top(velocity) - wp.cross(wp.spatial_bottom(velocity), result.object_arm)
    spin = tcp.angular_velocity - wp.spatial_bottom(velocity)
    offset = tcp.position - wp.transform_point(grip_in_world, wp.vec3(middle[0], middle[1], 0.0))
    error = rotation_error(tcp.rotation, result.grip_rotation, suction)
    spread = spread_of_cups(held, middle, tcp.rotation, result.grip_rotation, suction, cups)
    result.whole = wrench_of_seals(offset, error, spread, count_seals(held, cups), slip, spin, both, suction)
    result.spin = spin - suction.step * (wp.transpose(both.mixed) * result.whole.force + both.angular * result.whole.torque)
    return result


@wp.func
def share_wrench(
    held: int,
    solved: SolvedSeals,
    tcp: TcpMotion,
    world: int,
    gripper_dof: int,
    suction: SuctionData,
    cups: CupData,
    break_force: wp.array2d[float],  # (world, cup) [N]
    cup_force: wp.array2d[float],  # (world, cup) [N]
    joint_f: wp.array[float],  # (dof) [N, N·m]
) -> HeldObject:
    """Share the wrench of an object's seals out to its cups, and break those whose force exceeds the break force.

    Adds the forces to `cup_force`, and those that hold on to the gripper's `joint_f`.
    """
    middle = middle_of_cups(held, cups)
    seals = count_seals(held, cups)
    # What the forces of the cups do not explain of the torque is twist and swing of the seals, the same of each.
    rest = solved.whole.torque
    for cup in range(cups.count):
        if has_bit(held, cup):
            arm = wp.quat_rotate(tcp.rotation, cups.place[cup] - middle)
            grip_arm = wp.quat_rotate(solved.grip_rotation, cups.place[cup] - middle)
            rest -= wp.cross(arm, force_of_cup(solved.whole, seals, arm, grip_arm, solved.spin, suction))
    torque = rest / float(seals)
    result = HeldObject()
    result.cups = held
    for cup in range(cups.count):
        if has_bit(held, cup):
            arm = wp.quat_rotate(tcp.rotation, cups.place[cup] - middle)
            grip_arm = wp.quat_rotate(solved.grip_rotation, cups.place[cup] - middle)
            force = force_of_cup(solved.whole, seals, arm, grip_arm, solved.spin, suction)
            borne = tension_and_shear(force, tcp.axis)
            result.peak = wp.max(result.peak, wp.vec2(borne, borne / break_force[world, cup]))
            cup_force[world, cup] = cup_force[world, cup] + borne
            if borne > break_force[world, cup]:
                result.cups -= 1 << cup
            else:
                result.force += force
                result.torque += torque + wp.cross(solved.object_arm + arm, force)
                pull_gripper(force, torque, tcp.wrist_arm + arm, tcp.wrist_axis, joint_f, gripper_dof)
    return result


@wp.kernel
def apply_array_forces_kernel(
    # Scene:
    layout: LayoutData,
    suction: SuctionData,
    cups: CupData,
    body_com: wp.array[wp.vec3],  # (body) [m]
    body_inv_mass: wp.array[float],  # (body) [1/kg]
    body_inv_inertia: wp.array[wp.mat33],  # (body) [1/(kg·m²)]
    # State:
    state: Worlds,
    seals_inout: Seals,
    motion: Motion,
    control_inout: Control,
):
    """Apply every seal's wrench to its object and the opposite to the gripper; break seals whose force exceeds the cup's break force.

    `seal_force` receives the largest force of an instance's seals in this step, that of a breaking one included, and 0 without a seal;
    `cup_force` the sum over a cup's seals; `peak` the maximum over seals and steps since it was cleared, of forces, and of forces relative
    to the break force. Where a seal of a common valve breaks, the others are poor from the next step on. Launched over world.
    """
    world = wp.tid()
    objects = int(0)
    for instance in range(layout.instances):
        objects += wp.where(seals_inout.attached[world, instance] != 0, 1, 0)
        seals_inout.seal_force[world, instance] = 0.0
    for cup in range(cups.count):
        seals_inout.cup_force[world, cup] = 0.0
    if objects == 0:
        return
    head = world * layout.bodies + CUP
    gripper_dof = world * layout.dofs
    broken = int(0)
    for instance in range(layout.instances):
        held = seals_inout.attached[world, instance]
        if held != 0:
            slot = state.body_slot[world, instance]
            body = world * layout.bodies + layout.gripper_bodies + slot
            tcp = tcp_motion(motion.body_q[head], motion.body_qd[head], body_com[head], middle_of_cups(held, cups))
            pose, grip = motion.body_q[body], seals_inout.object_in_tcp[world, instance]
            mass, inertia = body_inv_mass[body], body_inv_inertia[body]
            seals = solve_seals(held, objects, tcp, pose, motion.body_qd[body], body_com[body], mass, inertia, grip, suction, cups)
            shared = share_wrench(
                held, seals, tcp, world, gripper_dof, suction, cups, seals_inout.break_force, seals_inout.cup_force, control_inout.joint_f
            )
            seals_inout.seal_force[world, instance] = shared.peak[0]
            seals_inout.peak[world] = wp.max(seals_inout.peak[world], shared.peak)
            broken += held - shared.cups
            seals_inout.attached[world, instance] = shared.cups
            first_dof = gripper_dof + layout.gripper_dofs + 6 * slot
            push_object(shared.force, shared.torque, control_inout.joint_f, first_dof)
    if cups.common_valve != 0 and broken > 0:
        for cup in range(cups.count):
            seals_inout.break_force[world, cup] = suction.poor_force
