"""Seal of one cup: a breakable implicit spring-damper between the cup and each attached object; what seals of several cups share with it.

Frames; `X_in_Y` is the pose of frame X in frame Y, so that `Z_in_Y = X_in_Y * Z_in_X`:

- world: z up.
- tcp: at the tool centre point (TCP), the middle of the plane of the cups' lips, with the head's axes; +z points into the gripper, +y is
  the wrist axis. Each cup has a TCP of its own there, the centre of its lip; one cup's is that of the tool.
- object: the object's body frame.
- grip: fixed to the object; coincides with tcp while the seals are at rest. `object_in_tcp`, stored when the seals engage, equals
  `object_in_grip` ever after, hence `grip_in_world = object_in_world * inverse(object_in_tcp)`.
"""

import warp as wp

from synpick_warp.kernels.sim.cup_rays import CUP, tcp_pose
from synpick_warp.kernels.state import Contacts, Control, Motion, Seals, Worlds
from synpick_warp.kernels.structs import TILT, LayoutData, SuctionData

wp.set_module_options({"enable_backward": False})

# Gap that disables a contact [m]: ten times CONTACT_GAP of stages.sim.physics, beyond which the solver skips contacts.
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
    torque: wp.vec3


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
def solve_wrench(
    force: wp.vec3, torque: wp.vec3, linear_gain: float, angular_gain: wp.mat33, inverse_mass: InverseMass, h: float
) -> Wrench:
    """Wrench w on the object of a spring-damper that is implicit in offset and velocity at the end of the step h [s].

    w = K (e + h u') + D u' with u' = u - h W w, hence (1 + h (h K + D) W) w = K e + (h K + D) u. Offset e and velocity u are those of the
    tcp frame relative to the grip frame, W is the sum of both inverse effective masses. The arguments are K e + (h K + D) u as force [N]
    and torque [N·m], and h K + D of both [N·s/m, N·m·s/rad]. Stable for every mass, stiffness and damping.
    """
    one = wp.identity(n=3, dtype=float)
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
def seal_wrench(
    offset: wp.vec3, error: RotationError, velocity: wp.vec3, angular_velocity: wp.vec3, inverse_mass: InverseMass, suction: SuctionData
) -> Wrench:
    """Wrench of the seal of one cup on the object; offset and velocities are those of the tcp frame relative to the grip frame."""
    h = suction.step
    linear_gain = h * suction.stiffness + suction.damping
    angular_gain = h * error.stiffness + suction.twist_damping * wp.identity(n=3, dtype=float)
    force = suction.stiffness * offset + linear_gain * velocity
    torque = error.torque + angular_gain * angular_velocity
    return solve_wrench(force, torque, linear_gain, angular_gain, inverse_mass, h)


@wp.func
def tension_and_shear(force: wp.vec3, axis: wp.vec3) -> float:
    """Seal force [N] that is compared with the break force: norm of the force on the object without compression along the cup's axis."""
    return wp.length(force - wp.min(wp.dot(force, axis), 0.0) * axis)


@wp.func
def push_object(force: wp.vec3, torque: wp.vec3, joint_f: wp.array[float], first_dof: int):
    """Write a wrench about the centre of mass to the six joint forces of an object, which begin at `first_dof`."""
    for axis in range(3):
        joint_f[first_dof + axis] = force[axis]
        joint_f[first_dof + 3 + axis] = torque[axis]


@wp.func
def pull_gripper(force: wp.vec3, torque: wp.vec3, arm: wp.vec3, wrist_axis: wp.vec3, joint_f: wp.array[float], gripper_dof: int):
    """Subtract a seal's wrench, at `arm` [m] from the wrist, from the gripper's joint forces: x, y, z and tilt.

    The torque about other axes than the wrist's is borne by the gripper's joint.
    """
    for axis in range(3):
        joint_f[gripper_dof + axis] = joint_f[gripper_dof + axis] - force[axis]
    joint_f[gripper_dof + TILT] = joint_f[gripper_dof + TILT] - wp.dot(wrist_axis, torque + wp.cross(arm, force))


@wp.kernel
def apply_seal_forces_kernel(
    # Scene:
    layout: LayoutData,
    suction: SuctionData,
    body_com: wp.array[wp.vec3],  # (body) [m]
    body_inv_mass: wp.array[float],  # (body) [1/kg]
    body_inv_inertia: wp.array[wp.mat33],  # (body) [1/(kg·m²)]
    # State:
    state: Worlds,
    seals_inout: Seals,
    motion: Motion,
    control_inout: Control,
):
    """Apply every seal's wrench to its object and the opposite to the gripper; break seals whose force exceeds the break force.

    `seal_force` receives this step's force of each seal, that of a breaking one included, and 0 without a seal; `cup_force` their sum;
    `peak` the maximum over seals and steps since it was cleared, of forces, and of forces relative to the break force. Launched over world.
    """
    world = wp.tid()
    seals = int(0)
    for instance in range(layout.instances):
        seals += seals_inout.attached[world, instance]
        seals_inout.seal_force[world, instance] = 0.0
    seals_inout.cup_force[world, 0] = 0.0
    if seals == 0:
        return
    cup = world * layout.bodies + CUP
    tcp = tcp_motion(motion.body_q[cup], motion.body_qd[cup], body_com[cup], wp.vec3(0.0, 0.0, -suction.tcp_offset))
    gripper_inverse = gripper_inverse_mass(suction, tcp.wrist_axis, tcp.wrist_arm, seals)
    gripper_dof = world * layout.dofs
    for instance in range(layout.instances):
        if seals_inout.attached[world, instance] != 0:
            body = world * layout.bodies + layout.gripper_bodies + state.body_slot[world, instance]
            grip_in_world = motion.body_q[body] * wp.transform_inverse(seals_inout.object_in_tcp[world, instance])
            object_arm = tcp.position - wp.transform_point(motion.body_q[body], body_com[body])
            rotation = wp.transform_get_rotation(motion.body_q[body])
            object_inverse = object_inverse_mass(rotation, body_inv_mass[body], body_inv_inertia[body], object_arm)
            object_angular_velocity = wp.spatial_bottom(motion.body_qd[body])
            slip = tcp.velocity - wp.spatial_top(motion.body_qd[body]) - wp.cross(object_angular_velocity, object_arm)
            error = rotation_error(tcp.rotation, wp.transform_get_rotation(grip_in_world), suction)
            offset = tcp.position - wp.transform_get_translation(grip_in_world)
            spin = tcp.angular_velocity - object_angular_velocity
            wrench = seal_wrench(offset, error, slip, spin, add_inverse_masses(object_inverse, gripper_inverse), suction)
            force = tension_and_shear(wrench.force, tcp.axis)
            first_dof = gripper_dof + layout.gripper_dofs + 6 * state.body_slot[world, instance]
            seals_inout.seal_force[world, instance] = force
            seals_inout.cup_force[world, 0] = seals_inout.cup_force[world, 0] + force
            seals_inout.peak[world] = wp.max(seals_inout.peak[world], wp.vec2(force, force / seals_inout.break_force[world, 0]))
            if force > seals_inout.break_force[world, 0]:
                seals_inout.attached[world, instance] = 0
                push_object(wp.vec3(), wp.vec3(), control_inout.joint_f, first_dof)
            else:
                push_object(wrench.force, wrench.torque + wp.cross(object_arm, wrench.force), control_inout.joint_f, first_dof)
                pull_gripper(wrench.force, wrench.torque, tcp.wrist_arm, tcp.wrist_axis, control_inout.joint_f, gripper_dof)


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
def ignore_attached_contacts_kernel(layout: LayoutData, contacts_inout: Contacts, state: Worlds, seals: Seals):
    """Disable contacts between a gripper head and its attached objects, which would fight the seal: set their margin to -APART.

    The solver makes no constraint rows for contacts that far apart. The collision pipeline writes all margins anew each time, after it has
    stored what it matches the next step's contacts with. Disabling the shapes instead would put all such contacts of all worlds into one
    pair of bodies, and the solver's time grows with the square of a pair's contacts. Launched over contact.
    """
    contact = wp.tid()
    if contact >= contacts_inout.count[0] or contacts_inout.shape0[contact] < 0 or contacts_inout.shape1[contact] < 0:
        return
    a = contacts_inout.shape_body[contacts_inout.shape0[contact]]
    b = contacts_inout.shape_body[contacts_inout.shape1[contact]]
    if a < 0 or b < 0:
        return
    cup = a
    other = b
    if b % layout.bodies == CUP:
        cup = b
        other = a
    if cup % layout.bodies != CUP:
        return
    if is_attached(layout, cup // layout.bodies, other, state.body_slot, seals.attached):
        contacts_inout.margin0[contact] = -APART
