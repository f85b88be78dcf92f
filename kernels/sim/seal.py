"""Suction seals: breakable implicit spring-dampers between cups and the attached objects.

A cup has a seal with each object that it holds. The seals of an object act on two rigid bodies: together they are one spring-damper at the
middle of their cups, whose resistance to rotation grows with the distances of the cups from it. It is solved as one, then shared out.

Frames; `X_in_Y` is the pose of frame X in frame Y, so that `Z_in_Y = X_in_Y * Z_in_X`:

- world: z up.
- tcp: at the tool centre point (TCP), the middle of the plane of the cups' lips, with the head's axes; +z points into the gripper, +y is
  the wrist axis. Each cup has a TCP of its own there, the centre of its lip; one cup's is that of the tool.
- object: the object's body frame.
- grip: fixed to the object; coincides with tcp while the seals are at rest. `object_in_tcp`, stored when the seals engage, equals
  `object_in_grip` ever after, hence `grip_in_world = object_in_world * inverse(object_in_tcp)`.
"""

import warp as wp

from synpick_warp.kernels.sim.cup_rays import CUP, has_bit, tcp_pose
from synpick_warp.kernels.structs import TILT, LayoutData, SuctionData

wp.set_module_options({"enable_backward": False})


@wp.struct
class InverseMass:
    """Blocks of 3 x 3 of the inverse effective mass at the TCP: the symmetric 6 x 6 matrix W with acceleration = W wrench.

    The operational-space inverse inertia J M⁻¹ Jᵀ (Khatib, 1987).
    """

    linear: wp.mat33
    """Linear acceleration by a force [1/kg]."""
    mixed: wp.mat33
    """Linear acceleration by a torque; transposed, angular acceleration by a force [1/(kg·m)]."""
    angular: wp.mat33
    """Angular acceleration by a torque [1/(kg·m²)]."""


@wp.struct
class RotationError:
    """Elastic torque and rotational stiffness of a seal, for the rotation from the cup's axes to those of the grip frame."""

    torque: wp.vec3
    """Elastic torque on the object, without damping, in the world's axes [N·m]."""
    stiffness: wp.mat33
    """Derivative of the torque, negated [N·m/rad]."""


@wp.struct
class CupSpread:
    """Elastic torque of an object's cups beside their middle, and the second moment of their places."""

    torque: wp.vec3
    """Σ r x k (r - r_grip) about the middle, on the object [N·m]."""
    moment: wp.mat33
    """Σ |r|² 1 - r rᵀ, in the world's axes [m²]."""


@wp.struct
class Wrench:
    """Force [N] and torque [N·m] on the object at the TCP, in the world's axes."""

    force: wp.vec3
    """[N]"""
    torque: wp.vec3
    """[N·m]"""


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
    peak_force: float
    """Largest tension and shear of a seal, that of one that breaks included [N]."""
    force: wp.vec3
    """On the object, in the world's axes [N]."""
    torque: wp.vec3
    """[N·m]"""


@wp.struct
class TcpMotion:
    """Pose and velocity of a frame with the head's axes in the plane of the lips, and its arm from the wrist, in the world's axes."""

    position: wp.vec3
    """[m]"""
    rotation: wp.quat
    """From the tcp frame to the world."""
    axis: wp.vec3
    """Unit vector +z: the cup's axis."""
    wrist_axis: wp.vec3
    """Unit vector +y: the axis about which the cup tilts."""
    wrist_arm: wp.vec3
    """Moment arm from the wrist to the TCP [m]."""
    velocity: wp.vec3
    """[m/s]"""
    angular_velocity: wp.vec3
    """[rad/s]"""


@wp.func
def tcp_motion(head_in_world: wp.transform, head_velocity: wp.spatial_vector, head_com: wp.vec3, place: wp.vec3) -> TcpMotion:
    """Motion of the frame with the head's axes at `place` [m], from the head's: its centre of mass is at `head_com` in its frame [m]."""
    tcp_in_world = tcp_pose(head_in_world, place)
    result = TcpMotion()
    result.position = wp.transform_get_translation(tcp_in_world)
    result.rotation = wp.transform_get_rotation(tcp_in_world)
    result.axis = wp.transform_vector(tcp_in_world, wp.vec3(0.0, 0.0, 1.0))
    result.wrist_axis = wp.transform_vector(tcp_in_world, wp.vec3(0.0, 1.0, 0.0))
    result.wrist_arm = result.position - wp.transform_get_translation(head_in_world)
    result.angular_velocity = wp.spatial_bottom(head_velocity)
    com_arm = result.position - wp.transform_point(head_in_world, head_com)
    result.velocity = wp.spatial_top(head_velocity) + wp.cross(result.angular_velocity, com_arm)
    return result


@wp.func
def object_inverse_mass(object_rotation: wp.quat, inverse_mass: float, inverse_inertia: wp.mat33, arm: wp.vec3) -> InverseMass:
    """Inverse effective mass of a free body at a point with moment arm r = `arm` [m] from its centre of mass.

    A force F accelerates the point by F/m + (I⁻¹ (r x F)) x r, a torque T by (I⁻¹ T) x r, with the inverse inertia I⁻¹ in the world's
    axes. The argument `inverse_inertia` is in the body's axes.
    """
    rotation = wp.quat_to_matrix(object_rotation)
    cross = wp.skew(arm)
    result = InverseMass()
    result.angular = rotation * inverse_inertia * wp.transpose(rotation)
    result.mixed = -cross * result.angular
    result.linear = inverse_mass * wp.identity(n=3, dtype=float) + result.mixed * cross
    return result


@wp.func
def gripper_inverse_mass(suction: SuctionData, wrist_axis: wp.vec3, arm: wp.vec3, objects: int) -> InverseMass:
    """Inverse effective mass of the gripper at `arm` [m] from the wrist, times the number of objects that it holds.

    The gripper translates as a whole and tilts about the wrist axis against its drive. With n objects that pull at the same mass, each
    is given an n-th of it (mass splitting; Tonge et al., 2012). An approximation that shapes how a seal's oscillation decays, not the force
    that it bears: translation and tilt are taken as independent.
    """
    direction = wp.cross(wrist_axis, arm)
    slide = float(objects) / (suction.finger_mass + suction.cup_mass)
    tilt = float(objects) / suction.tilt_inertia
    result = InverseMass()
    result.linear = slide * wp.identity(n=3, dtype=float) + tilt * wp.outer(direction, direction)
    result.mixed = tilt * wp.outer(direction, wrist_axis)
    result.angular = tilt * wp.outer(wrist_axis, wrist_axis)
    return result


@wp.func
def add_inverse_masses(a: InverseMass, b: InverseMass) -> InverseMass:
    """Inverse effective mass of the relative motion of two bodies."""
    result = InverseMass()
    result.linear = a.linear + b.linear
    result.mixed = a.mixed + b.mixed
    result.angular = a.angular + b.angular
    return result


@wp.func
def rotation_error(cup: wp.quat, grip: wp.quat, suction: SuctionData) -> RotationError:
    """Swing-twist decomposition of the rotation from the cup's axes to those of the grip frame, and the elastic torque against it.

    With the relative rotation q: twist φ = 2 atan2(q_z, q_w) about the cup's axis z; swing θ between z and the turned z', about
    n = z x z' / |z x z'|. Torque -k_twist φ z - k_swing (θ - limit) n, the latter beyond the limit only. Both rotations lead to the world.
    """
    relative = wp.quat_inverse(cup) * grip
    if relative[3] < 0.0:
        relative = -relative
    axis = wp.quat_rotate(cup, wp.vec3(0.0, 0.0, 1.0))
    result = RotationError()
    result.torque = -suction.twist_stiffness * 2.0 * wp.atan2(relative[2], relative[3]) * axis
    result.stiffness = suction.twist_stiffness * wp.outer(axis, axis)
    turned = wp.quat_rotate(relative, wp.vec3(0.0, 0.0, 1.0))
    sine = wp.sqrt(turned[0] * turned[0] + turned[1] * turned[1])
    beyond = wp.atan2(sine, turned[2]) - suction.swing_limit
    if beyond > 0.0 and sine > 0.0:
        normal = wp.quat_rotate(cup, wp.vec3(-turned[1] / sine, turned[0] / sine, 0.0))
        result.torque = result.torque - suction.swing_stiffness * beyond * normal
        result.stiffness = result.stiffness + suction.swing_stiffness * wp.outer(normal, normal)
    return result


@wp.func
def count_seals(held: int, suction: SuctionData) -> int:
    """Number of cups that hold an object; `held`: its bits in `attached`."""
    count = int(0)
    for cup in range(suction.cups):
        count += (held >> cup) & 1
    return count


@wp.func
def middle_of_cups(held: int, suction: SuctionData) -> wp.vec3:
    """Middle of the cups that hold an object, in the head's frame [m]."""
    total = wp.vec3(0.0, 0.0, 0.0)
    for cup in range(suction.cups):
        if has_bit(held, cup):
            total += suction.place[cup]
    return total / float(count_seals(held, suction))


@wp.func
def spread_of_cups(held: int, middle: wp.vec3, head: wp.quat, grip: wp.quat, suction: SuctionData) -> CupSpread:
    """Spread of the cups that hold an object about their middle; rotations from the head's and from the grip's axes to the world."""
    result = CupSpread()
    for cup in range(suction.cups):
        if has_bit(held, cup):
            arm = wp.quat_rotate(head, suction.place[cup] - middle)
            stretch = arm - wp.quat_rotate(grip, suction.place[cup] - middle)
            result.torque += wp.cross(arm, suction.stiffness * stretch)
            result.moment += wp.dot(arm, arm) * wp.identity(n=3, dtype=float) - wp.outer(arm, arm)
    return result


@wp.func
def seal_wrench(
    offset: wp.vec3,
    error: RotationError,
    spread: CupSpread,
    seals: int,
    velocity: wp.vec3,
    angular_velocity: wp.vec3,
    inverse_mass: InverseMass,
    suction: SuctionData,
) -> Wrench:
    """Wrench w on an object of its n seals, a spring-damper that is implicit in offset and velocity at the end of the step h.

    w = K (e + h u') + D u' with u' = u - h W w, hence (1 + h (h K + D) W) w = K e + (h K + D) u. Offset e and velocity u are those of the
    tcp frame relative to the grip frame at the middle of the cups, W is the sum of both inverse effective masses. K is n times a seal's
    stiffness; against rotation, k Σ |r|² 1 - r rᵀ of the cups' places r is added, and the same to D. Stable for every mass, stiffness and
    damping.
    """
    h = suction.step
    n = float(seals)
    one = wp.identity(n=3, dtype=float)
    gain = h * suction.stiffness + suction.damping
    linear_gain = n * gain
    angular_gain = n * (h * error.stiffness + suction.twist_damping * one) + gain * spread.moment
    force = n * suction.stiffness * offset + linear_gain * velocity
    torque = n * error.torque + spread.torque + angular_gain * angular_velocity
    # Blocks of the 6 x 6 system, solved for the torque first (Schur complement).
    upper = wp.inverse(one + (h * linear_gain) * inverse_mass.linear)
    right = (h * linear_gain) * inverse_mass.mixed
    left = h * angular_gain * wp.transpose(inverse_mass.mixed) * upper
    lower = one + h * angular_gain * inverse_mass.angular - left * right
    result = Wrench()
    result.torque = wp.inverse(lower) * (torque - left * force)
    result.force = upper * (force - right * result.torque)
    return result


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
def tension_and_shear(force: wp.vec3, axis: wp.vec3) -> float:
    """Seal force [N] that is compared with the break force: norm of the force on the object without compression along the cup's axis."""
    return wp.length(force - wp.min(wp.dot(force, axis), 0.0) * axis)


@wp.func
def pull_gripper(force: wp.vec3, torque: wp.vec3, arm: wp.vec3, wrist_axis: wp.vec3, joint_f: wp.array[float], gripper_dof: int):
    """Subtract a seal's wrench, at `arm` [m] from the wrist, from the gripper's joint forces: x, y, z and tilt.

    The torque about other axes than the wrist's is borne by the gripper's joint.
    """
    for axis in range(3):
        joint_f[gripper_dof + axis] = joint_f[gripper_dof + axis] - force[axis]
    joint_f[gripper_dof + TILT] = joint_f[gripper_dof + TILT] - wp.dot(wrist_axis, torque + wp.cross(arm, force))


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
        suction: Cups, stiffness and damping.
    """
    result = SolvedSeals()
    middle = middle_of_cups(held, suction)
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
    spread = spread_of_cups(held, middle, tcp.rotation, result.grip_rotation, suction)
    result.whole = seal_wrench(offset, error, spread, count_seals(held, suction), slip, spin, both, suction)
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
    break_force: wp.array2d[float],  # (world, cup) [N]
    cup_force: wp.array2d[float],  # (world, cup) [N]
    joint_f: wp.array[float],  # (dof) [N, N·m]
) -> HeldObject:
    """Share the wrench of an object's seals out to its cups, and break those whose force exceeds the break force.

    Adds the forces to `cup_force`, and those that hold on to the gripper's `joint_f`.
    """
    middle = middle_of_cups(held, suction)
    seals = count_seals(held, suction)
    # What the forces of the cups do not explain of the torque is twist and swing of the seals, the same of each.
    rest = solved.whole.torque
    for cup in range(suction.cups):
        if has_bit(held, cup):
            arm = wp.quat_rotate(tcp.rotation, suction.place[cup] - middle)
            grip_arm = wp.quat_rotate(solved.grip_rotation, suction.place[cup] - middle)
            rest -= wp.cross(arm, force_of_cup(solved.whole, seals, arm, grip_arm, solved.spin, suction))
    torque = rest / float(seals)
    result = HeldObject()
    result.cups = held
    for cup in range(suction.cups):
        if has_bit(held, cup):
            arm = wp.quat_rotate(tcp.rotation, suction.place[cup] - middle)
            grip_arm = wp.quat_rotate(solved.grip_rotation, suction.place[cup] - middle)
            force = force_of_cup(solved.whole, seals, arm, grip_arm, solved.spin, suction)
            borne = tension_and_shear(force, tcp.axis)
            result.peak_force = wp.max(result.peak_force, borne)
            cup_force[world, cup] = cup_force[world, cup] + borne
            if borne > break_force[world, cup]:
                result.cups -= 1 << cup
            else:
                result.force += force
                result.torque += torque + wp.cross(solved.object_arm + arm, force)
                pull_gripper(force, torque, tcp.wrist_arm + arm, tcp.wrist_axis, joint_f, gripper_dof)
    return result


@wp.kernel
def apply_seal_forces_kernel(
    # Scene:
    layout: LayoutData,
    suction: SuctionData,
    body_com: wp.array[wp.vec3],  # (body) [m]
    body_inv_mass: wp.array[float],  # (body) [1/kg]
    body_inv_inertia: wp.array[wp.mat33],  # (body) [1/(kg·m²)]
    # State:
    body_slot: wp.array2d[int],  # (world, instance)
    object_in_tcp: wp.array2d[wp.transform],  # (world, instance) [m]
    body_q: wp.array[wp.transform],  # (body) [m]
    body_qd: wp.array[wp.spatial_vector],  # (body) [m/s, rad/s]
    attached_inout: wp.array2d[int],  # (world, instance)
    break_force_inout: wp.array2d[float],  # (world, cup) [N]
    seal_force_inout: wp.array2d[float],  # (world, instance) [N]
    cup_force_inout: wp.array2d[float],  # (world, cup) [N]
    peak_force_inout: wp.array[float],  # (world) [N]
    joint_f_inout: wp.array[float],  # (dof) [N, N·m]
):
    """Apply every seal's wrench to its object and the opposite to the gripper; break seals whose force exceeds the cup's break force.

    `seal_force` receives the largest force of an instance's seals in this step, that of a breaking one included, and 0 without a seal;
    `cup_force` the sum over a cup's seals; `peak_force` the maximum over seals and steps since it was cleared. Where a seal of a common
    valve breaks, the others are poor from the next step on. Launched over world.
    """
    world = wp.tid()
    objects = int(0)
    for instance in range(layout.instances):
        objects += wp.where(attached_inout[world, instance] != 0, 1, 0)
        seal_force_inout[world, instance] = 0.0
    for cup in range(suction.cups):
        cup_force_inout[world, cup] = 0.0
    if objects == 0:
        return
    head = world * layout.bodies + CUP
    gripper_dof = world * layout.dofs
    broken = int(0)
    for instance in range(layout.instances):
        held = attached_inout[world, instance]
        if held != 0:
            slot = body_slot[world, instance]
            body = world * layout.bodies + layout.gripper_bodies + slot
            tcp = tcp_motion(body_q[head], body_qd[head], body_com[head], middle_of_cups(held, suction))
            pose, grip = body_q[body], object_in_tcp[world, instance]
            mass, inertia = body_inv_mass[body], body_inv_inertia[body]
            seals = solve_seals(held, objects, tcp, pose, body_qd[body], body_com[body], mass, inertia, grip, suction)
            shared = share_wrench(held, seals, tcp, world, gripper_dof, suction, break_force_inout, cup_force_inout, joint_f_inout)
            seal_force_inout[world, instance] = shared.peak_force
            peak_force_inout[world] = wp.max(peak_force_inout[world], shared.peak_force)
            broken += held - shared.cups
            attached_inout[world, instance] = shared.cups
            first_dof = gripper_dof + layout.gripper_dofs + 6 * slot
            for axis in range(3):
                joint_f_inout[first_dof + axis] = shared.force[axis]
                joint_f_inout[first_dof + 3 + axis] = shared.torque[axis]
    if suction.common_valve != 0 and broken > 0:
        for cup in range(suction.cups):
            break_force_inout[world, cup] = suction.poor_force
