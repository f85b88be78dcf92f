"""Suction seals: breakable implicit spring-dampers between cups and the attached objects, which replace contacts between the two.

A cup has a seal with each object that it holds. Seals that pull at the same body share its mass (mass splitting; Tonge et al., 2012), and
those of an object have one inverse effective mass, so that they bear a load as springs of equal stiffness do.

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

# Gap of a contact that must not act [m]; stages.sim.physics makes the solver skip contacts with far smaller gaps.
APART = wp.constant(1.0)


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
class Wrench:
    """Force [N] and torque [N·m] on the object at the TCP, in the world's axes."""

    force: wp.vec3
    """[N]"""
    torque: wp.vec3
    """[N·m]"""


@wp.struct
class TcpMotion:
    """Pose and velocity of a cup's TCP frame, and its arm from the wrist, in the world's axes."""

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
    """Motion of the TCP frame of the cup at `place` [m], from the head's: its centre of mass is at `head_com` in its frame [m]."""
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
def gripper_inverse_mass(suction: SuctionData, wrist_axis: wp.vec3, arm: wp.vec3, seals: int) -> InverseMass:
    """Inverse effective mass of the gripper at `arm` [m] from the wrist, times the number of seals.

    The gripper translates as a whole and tilts about the wrist axis against its drive. With n seals that pull at the same mass, each
    is given an n-th of it (mass splitting). An approximation that shapes how a seal's oscillation decays, not the force that it bears:
    translation and tilt are taken as independent.
    """
    direction = wp.cross(wrist_axis, arm)
    slide = float(seals) / (suction.finger_mass + suction.cup_mass)
    tilt = float(seals) / suction.tilt_inertia
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
def seal_wrench(
    offset: wp.vec3, error: RotationError, velocity: wp.vec3, angular_velocity: wp.vec3, inverse_mass: InverseMass, suction: SuctionData
) -> Wrench:
    """Wrench w on the object of a spring-damper that is implicit in offset and velocity at the end of the step h.

    w = K (e + h u') + D u' with u' = u - h W w, hence (1 + h (h K + D) W) w = K e + (h K + D) u. Offset e and velocity u are those of the
    tcp frame relative to the grip frame, W is the sum of both inverse effective masses. Stable for every mass, stiffness and damping.
    """
    h = suction.step
    one = wp.identity(n=3, dtype=float)
    linear_gain = h * suction.stiffness + suction.damping
    angular_gain = h * error.stiffness + suction.twist_damping * one
    force = suction.stiffness * offset + linear_gain * velocity
    torque = error.torque + angular_gain * angular_velocity
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
def tension_and_shear(force: wp.vec3, axis: wp.vec3) -> float:
    """Seal force [N] that is compared with the break force: norm of the force on the object without compression along the cup's axis."""
    return wp.length(force - wp.min(wp.dot(force, axis), 0.0) * axis)


@wp.func
def count_seals(attached: int, suction: SuctionData) -> int:
    """Number of cups that hold an instance, from its bits in `attached`."""
    count = int(0)
    for cup in range(suction.cups):
        count += (attached >> cup) & 1
    return count


@wp.func
def scale_inverse_mass(inverse_mass: InverseMass, factor: float) -> InverseMass:
    """Inverse effective mass times a factor."""
    result = InverseMass()
    result.linear = factor * inverse_mass.linear
    result.mixed = factor * inverse_mass.mixed
    result.angular = factor * inverse_mass.angular
    return result


@wp.func
def shared_inverse_mass(
    held: int,
    seals: int,
    head_in_world: wp.transform,
    object_in_world: wp.transform,
    com: wp.vec3,
    inverse_mass: float,
    inverse_inertia: wp.mat33,
    suction: SuctionData,
) -> InverseMass:
    """Inverse effective mass of the relative motion of gripper and object, for each of the object's n seals: n times its mean over them.

    Args:
        held: Cups that hold the object, as bits.
        seals: Number of all seals of the gripper.
        head_in_world: Pose of the gripper head [m].
        object_in_world: Pose of the object [m].
        com: Its centre of mass in its frame [m].
        inverse_mass: Its inverse mass [1/kg].
        inverse_inertia: Its inverse inertia, in its axes [1/(kg·m²)].
        suction: Cups and masses.
    """
    of_object = InverseMass()
    of_gripper = InverseMass()
    rotation = wp.transform_get_rotation(object_in_world)
    wrist_axis = wp.transform_vector(head_in_world, wp.vec3(0.0, 1.0, 0.0))
    for cup in range(suction.cups):
        if has_bit(held, cup):
            tcp = wp.transform_get_translation(tcp_pose(head_in_world, suction.place[cup]))
            object_arm = tcp - wp.transform_point(object_in_world, com)
            of_object = add_inverse_masses(of_object, object_inverse_mass(rotation, inverse_mass, inverse_inertia, object_arm))
            wrist_arm = tcp - wp.transform_get_translation(head_in_world)
            of_gripper = add_inverse_masses(of_gripper, gripper_inverse_mass(suction, wrist_axis, wrist_arm, seals))
    return add_inverse_masses(of_object, scale_inverse_mass(of_gripper, 1.0 / float(count_seals(held, suction))))


@wp.func
def pull_object(
    tcp: TcpMotion,
    grip: wp.vec3,
    grip_rotation: wp.quat,
    object_velocity: wp.spatial_vector,
    object_arm: wp.vec3,
    inverse_mass: InverseMass,
    suction: SuctionData,
) -> Wrench:
    """Wrench of one seal on its object.

    Args:
        tcp: Motion of the cup's TCP.
        grip: Point of the object that coincides with it at rest, in the world [m].
        grip_rotation: From the grip frame to the world.
        object_velocity: Of the object [m/s, rad/s].
        object_arm: Moment arm from the object's centre of mass to the TCP [m].
        inverse_mass: Of the relative motion of both.
        suction: Stiffness and damping.
    """
    object_angular_velocity = wp.spatial_bottom(object_velocity)
    slip = tcp.velocity - wp.spatial_top(object_velocity) - wp.cross(object_angular_velocity, object_arm)
    error = rotation_error(tcp.rotation, grip_rotation, suction)
    return seal_wrench(tcp.position - grip, error, slip, tcp.angular_velocity - object_angular_velocity, inverse_mass, suction)


@wp.func
def pull_gripper(wrench: Wrench, tcp: TcpMotion, joint_f: wp.array[float], gripper_dof: int):
    """Subtract a seal's wrench from the gripper's joint forces: x, y, z and tilt.

    The torque about other axes than the wrist's is borne by the gripper's joint.
    """
    for axis in range(3):
        joint_f[gripper_dof + axis] = joint_f[gripper_dof + axis] - wrench.force[axis]
    torque = wrench.torque + wp.cross(tcp.wrist_arm, wrench.force)
    joint_f[gripper_dof + TILT] = joint_f[gripper_dof + TILT] - wp.dot(tcp.wrist_axis, torque)


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
    seals = int(0)
    for instance in range(layout.instances):
        seals += count_seals(attached_inout[world, instance], suction)
        seal_force_inout[world, instance] = 0.0
    for cup in range(suction.cups):
        cup_force_inout[world, cup] = 0.0
    if seals == 0:
        return
    head = world * layout.bodies + CUP
    gripper_dof = world * layout.dofs
    broken = int(0)
    for instance in range(layout.instances):
        held = attached_inout[world, instance]
        if held != 0:
            slot = body_slot[world, instance]
            body = world * layout.bodies + layout.gripper_bodies + slot
            grip_in_world = body_q[body] * wp.transform_inverse(object_in_tcp[world, instance])
            mass, inertia = body_inv_mass[body], body_inv_inertia[body]
            inverse_mass = shared_inverse_mass(held, seals, body_q[head], body_q[body], body_com[body], mass, inertia, suction)
            total = Wrench()
            for cup in range(suction.cups):
                if has_bit(held, cup):
                    place = suction.place[cup]
                    tcp = tcp_motion(body_q[head], body_qd[head], body_com[head], place)
                    grip = wp.transform_point(grip_in_world, wp.vec3(place[0], place[1], 0.0))
                    object_arm = tcp.position - wp.transform_point(body_q[body], body_com[body])
                    wrench = pull_object(
                        tcp, grip, wp.transform_get_rotation(grip_in_world), body_qd[body], object_arm, inverse_mass, suction
                    )
                    force = tension_and_shear(wrench.force, tcp.axis)
                    seal_force_inout[world, instance] = wp.max(seal_force_inout[world, instance], force)
                    cup_force_inout[world, cup] = cup_force_inout[world, cup] + force
                    peak_force_inout[world] = wp.max(peak_force_inout[world], force)
                    if force > break_force_inout[world, cup]:
                        broken += 1
                        attached_inout[world, instance] = attached_inout[world, instance] - (1 << cup)
                    else:
                        total.force += wrench.force
                        total.torque += wrench.torque + wp.cross(object_arm, wrench.force)
                        pull_gripper(wrench, tcp, joint_f_inout, gripper_dof)
            first_dof = gripper_dof + layout.gripper_dofs + 6 * slot
            for axis in range(3):
                joint_f_inout[first_dof + axis] = total.force[axis]
                joint_f_inout[first_dof + 3 + axis] = total.torque[axis]
    if suction.common_valve != 0 and broken > 0:
        for cup in range(suction.cups):
            break_force_inout[world, cup] = suction.poor_force


@wp.func
def is_attached(layout: LayoutData, world: int, body: int, body_slot: wp.array2d[int], attached: wp.array2d[int]) -> bool:
    """True if a seal holds the body, which must not be the gripper's."""
    result = bool(False)
    slot = body - world * layout.bodies - layout.gripper_bodies
    for instance in range(layout.instances):
        if attached[world, instance] != 0 and body_slot[world, instance] == slot:
            result = True
    return result


@wp.kernel
def ignore_attached_contacts_kernel(
    # Scene:
    layout: LayoutData,
    shape_body: wp.array[int],  # (shape)
    # State:
    contact_count: wp.array[int],  # (one)
    body_slot: wp.array2d[int],  # (world, instance)
    attached: wp.array2d[int],  # (world, instance)
    shape0: wp.array[int],  # (contact)
    shape1: wp.array[int],  # (contact)
    # Out:
    margin_out: wp.array[float],  # (contact) [m]
):
    """Disable contacts between a gripper head and its attached objects, which would fight the seal: set their margin to -APART.

    The solver makes no constraint rows for contacts that far apart. The collision pipeline writes all margins anew each time, after it has
    stored what it matches the next step's contacts with. Disabling the shapes instead would put all such contacts of all worlds into one
    pair of bodies, and the solver's time grows with the square of a pair's contacts. Launched over contact.
    """
    contact = wp.tid()
    if contact >= contact_count[0] or shape0[contact] < 0 or shape1[contact] < 0:
        return
    a = shape_body[shape0[contact]]
    b = shape_body[shape1[contact]]
    if a < 0 or b < 0:
        return
    cup = a
    other = b
    if b % layout.bodies == CUP:
        cup = b
        other = a
    if cup % layout.bodies != CUP:
        return
    if is_attached(layout, cup // layout.bodies, other, body_slot, attached):
        margin_out[contact] = -APART
