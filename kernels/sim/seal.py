"""What holds objects to the cup: seals, each a spring-damper that breaks, and contacts that it replaces."""

import warp as wp

from synpick_warp.kernels.sim.cup_rays import CUP, tcp_pose
from synpick_warp.kernels.structs import TILT, LayoutData, SuctionData

wp.set_module_options({"enable_backward": False})

# A contact that is not to act is this far from touching [m]; stages.sim.physics makes the solver skip contacts far nearer than that.
APART = wp.constant(1.0)


@wp.struct
class InverseMass:
    """How a unit wrench at the tcp accelerates a point and a frame there: a symmetric 6 x 6 matrix in blocks of 3 x 3."""

    linear: wp.mat33
    """Acceleration of the point by a force [1/kg]."""
    mixed: wp.mat33
    """Acceleration of the point by a torque; transposed, angular acceleration by a force [1/(kg·m)]."""
    angular: wp.mat33
    """Angular acceleration by a torque [1/(kg·m²)]."""


@wp.struct
class RotationError:
    """How far an object is turned from where it was grip_in_world, and what the seal has against it."""

    torque: wp.vec3
    """On the object, without damping [N·m]."""
    stiffness: wp.mat33
    """[N·m/rad]"""


@wp.struct
class Wrench:
    """On the object, at the tcp, in the world's axes."""

    force: wp.vec3
    torque: wp.vec3


@wp.func
def object_inverse_mass(inverse_mass: float, inverse_inertia: wp.mat33, lever: wp.vec3) -> InverseMass:
    """Of a free body at `lever` from its centre of mass, with the inverse inertia in the world's axes.

    A force F accelerates the point by F/m + (I⁻¹ (r x F)) x r, a torque T by (I⁻¹ T) x r.
    """
    cross = wp.skew(lever)
    made = InverseMass()
    made.mixed = -cross * inverse_inertia
    made.linear = inverse_mass * wp.identity(n=3, dtype=float) + made.mixed * cross
    made.angular = inverse_inertia
    return made


@wp.func
def gripper_inverse_mass(suction: SuctionData, axis: wp.vec3, lever: wp.vec3, seals: int) -> InverseMass:
    """Of an n-th of the gripper at `lever` from the tilt axis: it slides as a whole, and turns about the axis against its drive.

    With n seals that pull at the same mass, each may reckon with an n-th of it. An approximation, which shapes how a seal swings in,
    not what it bears: sliding and tilting are taken as independent.
    """
    way = wp.cross(axis, lever)
    slide = float(seals) / (suction.finger_mass + suction.cup_mass)
    tilt = float(seals) / suction.tilt_inertia
    made = InverseMass()
    made.linear = slide * wp.identity(n=3, dtype=float) + tilt * wp.outer(way, way)
    made.mixed = tilt * wp.outer(way, axis)
    made.angular = tilt * wp.outer(axis, axis)
    return made


@wp.func
def add_inverse_masses(a: InverseMass, b: InverseMass) -> InverseMass:
    """Of one body against the other."""
    made = InverseMass()
    made.linear = a.linear + b.linear
    made.mixed = a.mixed + b.mixed
    made.angular = a.angular + b.angular
    return made


@wp.func
def rotation_error(cup: wp.quat, grip_in_world: wp.quat, suction: SuctionData) -> RotationError:
    """Twist and swing of the frame in which the object was grip_in_world, against the cup's.

    With the relative rotation q: twist φ = 2 atan2(q_z, q_w) about the cup's axis z; swing θ between z and the turned z', about
    n = z x z' / |z x z'|. Torque -k_twist φ z - k_swing (θ - break_force) n, the latter beyond the break_force only.
    """
    relative = wp.quat_inverse(cup) * grip_in_world
    if relative[3] < 0.0:
        relative = -relative
    axis = wp.quat_rotate(cup, wp.vec3(0.0, 0.0, 1.0))
    made = RotationError()
    made.torque = -suction.twist_stiffness * 2.0 * wp.atan2(relative[2], relative[3]) * axis
    made.stiffness = suction.twist_stiffness * wp.outer(axis, axis)
    turned = wp.quat_rotate(relative, wp.vec3(0.0, 0.0, 1.0))
    sine = wp.sqrt(turned[0] * turned[0] + turned[1] * turned[1])
    beyond = wp.atan2(sine, turned[2]) - suction.swing_limit
    if beyond > 0.0 and sine > 0.0:
        normal = wp.quat_rotate(cup, wp.vec3(-turned[1] / sine, turned[0] / sine, 0.0))
        made.torque = made.torque - suction.swing_stiffness * beyond * normal
        made.stiffness = made.stiffness + suction.swing_stiffness * wp.outer(normal, normal)
    return made


@wp.func
def seal_wrench(
    offset: wp.vec3, turn: RotationError, velocity: wp.vec3, spin: wp.vec3, response: InverseMass, suction: SuctionData
) -> Wrench:
    """Wrench w on the object of a spring-damper that is implicit in offset and velocity at the end of the step h.

    w = K (e + h u') + D u' with u' = u - h W w, hence (1 + h (h K + D) W) w = K e + (h K + D) u. Offset e and velocity u are the tcp's
    against the object's point and frame there, W is the sum of both responses. Stable for every mass, stiffness and damping.
    """
    h = suction.step
    one = wp.identity(n=3, dtype=float)
    pull = h * suction.stiffness + suction.damping
    hold = h * turn.stiffness + suction.twist_damping * one
    force = suction.stiffness * offset + pull * velocity
    torque = turn.torque + hold * spin
    # Blocks of the 6 x 6 system, solved for the torque first.
    upper = wp.inverse(one + (h * pull) * response.linear)
    right = (h * pull) * response.mixed
    left = h * hold * wp.transpose(response.mixed) * upper
    lower = one + h * hold * response.angular - left * right
    made = Wrench()
    made.torque = wp.inverse(lower) * (torque - left * force)
    made.force = upper * (force - right * made.torque)
    return made


@wp.func
def tension_and_shear(force: wp.vec3, axis: wp.vec3) -> float:
    """Tension and shear [N]: size of the force on the object without the part that presses it against the cup."""
    return wp.length(force - wp.min(wp.dot(force, axis), 0.0) * axis)


@wp.func
def release_seal(attached: wp.array2d[int], joint_f: wp.array[float], world: int, instance: int, first_dof: int):
    """Let go of an instance whose six degrees of freedom begin at `first_dof`."""
    attached[world, instance] = 0
    for axis in range(6):
        joint_f[first_dof + axis] = 0.0


@wp.func
def apply_wrench(wrench: Wrench, arm: wp.vec3, lever: wp.vec3, hinge: wp.vec3, joint_f: wp.array[float], gripper: int, first: int):
    """Write a wrench at the tcp to the object's degrees of freedom from `first`, and add the opposite to the gripper's.

    `arm` leads to the tcp from the object's centre of mass, `lever` from the tilt axis. What would turn the finger its joint bears.
    """
    torque = wrench.torque + wp.cross(arm, wrench.force)
    for axis in range(3):
        joint_f[first + axis] = wrench.force[axis]
        joint_f[first + 3 + axis] = torque[axis]
        joint_f[gripper + axis] = joint_f[gripper + axis] - wrench.force[axis]
    joint_f[gripper + TILT] = joint_f[gripper + TILT] - wp.dot(hinge, wrench.torque + wp.cross(lever, wrench.force))


@wp.kernel
def apply_seal_forces_kernel(
    # Scene:
    layout: LayoutData,
    suction: SuctionData,
    body_com: wp.array[wp.vec3],
    body_inv_mass: wp.array[float],
    body_inv_inertia: wp.array[wp.mat33],
    # State:
    body_slot: wp.array2d[int],
    object_in_tcp: wp.array2d[wp.transform],
    break_force: wp.array[float],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    attached_inout: wp.array2d[int],
    seal_force_inout: wp.array2d[float],
    peak_force_inout: wp.array[float],
    joint_f_inout: wp.array[float],
):
    """Wrench of every seal on its object, and the opposite on the gripper; a seal whose force exceeds the break force breaks instead."""
    world = wp.tid()
    seals = int(0)
    for instance in range(layout.instances):
        seals += attached_inout[world, instance]
        seal_force_inout[world, instance] = 0.0
    if seals == 0:
        return
    cup = world * layout.bodies + CUP
    tcp = tcp_pose(body_q[cup], suction.tcp_offset)
    place = wp.transform_get_translation(tcp)
    axis = wp.transform_vector(tcp, wp.vec3(0.0, 0.0, 1.0))
    hinge = wp.transform_vector(tcp, wp.vec3(0.0, 1.0, 0.0))
    lever = place - wp.transform_get_translation(body_q[cup])
    spin = wp.spatial_bottom(body_qd[cup])
    velocity = wp.spatial_top(body_qd[cup]) + wp.cross(spin, place - wp.transform_point(body_q[cup], body_com[cup]))
    gripper = gripper_inverse_mass(suction, hinge, lever, seals)
    dof = world * layout.dofs
    for instance in range(layout.instances):
        if attached_inout[world, instance] != 0:
            s = body_slot[world, instance]
            body = world * layout.bodies + layout.gripper_bodies + s
            grip_in_world = body_q[body] * wp.transform_inverse(object_in_tcp[world, instance])
            arm = place - wp.transform_point(body_q[body], body_com[body])
            turned = wp.quat_to_matrix(wp.transform_get_rotation(body_q[body]))
            own = object_inverse_mass(body_inv_mass[body], turned * body_inv_inertia[body] * wp.transpose(turned), arm)
            rate = wp.spatial_bottom(body_qd[body])
            slip = velocity - wp.spatial_top(body_qd[body]) - wp.cross(rate, arm)
            turn = rotation_error(wp.transform_get_rotation(tcp), wp.transform_get_rotation(grip_in_world), suction)
            wrench = seal_wrench(
                place - wp.transform_get_translation(grip_in_world), turn, slip, spin - rate, add_inverse_masses(own, gripper), suction
            )
            seal_force = tension_and_shear(wrench.force, axis)
            first = dof + layout.gripper_dofs + 6 * s
            seal_force_inout[world, instance] = seal_force
            peak_force_inout[world] = wp.max(peak_force_inout[world], seal_force)
            if seal_force > break_force[world]:
                release_seal(attached_inout, joint_f_inout, world, instance, first)
            else:
                apply_wrench(wrench, arm, lever, hinge, joint_f_inout, dof, first)


@wp.func
def is_attached(layout: LayoutData, world: int, body: int, body_slot: wp.array2d[int], attached: wp.array2d[int]) -> bool:
    """Whether a seal holds the body, which is not the gripper's."""
    found = bool(False)
    s = body - world * layout.bodies - layout.gripper_bodies
    for instance in range(layout.instances):
        if attached[world, instance] != 0 and body_slot[world, instance] == s:
            found = True
    return found


@wp.kernel
def ignore_attached_contacts_kernel(
    # Scene:
    layout: LayoutData,
    shape_body: wp.array[int],
    # State:
    contact_count: wp.array[int],
    body_slot: wp.array2d[int],
    attached: wp.array2d[int],
    shape0: wp.array[int],
    shape1: wp.array[int],
    # Out:
    margin_out: wp.array[float],
):
    """Pull contacts of a cup with what is_attached on it so far apart that the solver makes no rows for them: they would fight the seal.

    The collision pipeline writes all margins anew each time, and has by then kept what it matches the next contacts with. Taking the
    shapes away instead would make one pair of bodies of all such contacts of all worlds, and the solver's time grows with a pair's
    square.
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
