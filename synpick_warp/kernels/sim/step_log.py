"""Step log: poses, velocities, contact and seal forces of every physics step, for trajectories; who lies on whom in a tick.

A row of the log, called "place", is an instance; the rows of the gripper shaft and the cup follow those of the instances.
"""

import warp as wp

from synpick_warp.codes import Mode, Phase, Task
from synpick_warp.kernels.state import Attempts, Contacts, Control, Motion, Seals, Worlds
from synpick_warp.kernels.structs import LayoutData

wp.set_module_options({"enable_backward": False})

# Fixed-point scale of sums of contact forces: integer sums do not depend on the order of threads. A count is 1 µN, the largest sum
# 9e12 N.
COUNTS_PER_NEWTON = wp.constant(1048576.0)
# Column of these sums with the sum of magnitudes; columns 0 to 2 hold the vector sum.
MAGNITUDE = wp.constant(3)


@wp.struct
class StepLog:
    """Step log of a tick: poses, velocities, contact and seal forces, and what the gripper does in each step."""

    pose: wp.array3d[wp.transform]
    """(world, step, place): body to world at the step's end [m]."""
    velocity: wp.array3d[wp.vec3]
    """(world, step, place): linear velocity of the centre of mass [m/s]."""
    angular_velocity: wp.array3d[wp.vec3]
    """(world, step, place): angular velocity in the world's axes [rad/s]."""
    contact_force: wp.array3d[wp.vec3]
    """(world, step, place): vector sum of all contact forces on the body, mean over the step [N]."""
    contact_load: wp.array3d[float]
    """(world, step, place): sum of their magnitudes, mean over the step [N]."""
    seal_force: wp.array3d[float]
    """(world, step, instance): tension and shear of the instance's seal, that of a seal that broke in the step included [N]; 0: no seal."""
    attached: wp.array3d[wp.uint8]
    """(world, step, instance): 1: a seal holds the instance at the step's end."""
    setpoint: wp.array2d[wp.vec3]
    """(world, step): setpoint of the wrist in the step [m]; NaN: none."""
    impedance_force: wp.array2d[wp.vec3]
    """(world, step): impedance force on the gripper, without gravity compensation [N]."""
    task: wp.array2d[wp.int8]
    """(world, step): `Task` at the step's end."""
    cup_force: wp.array3d[float]
    """(world, step, cup): tension and shear of each cup's seals in the step, as `seal_force` [N]."""


@wp.func
def body_of(layout: LayoutData, world: int, place: int, state: Worlds) -> int:
    """Body index of row `place` of the step log: of an instance, then of the gripper shaft and the cup; -1: no such instance."""
    if place >= layout.instances:
        return world * layout.bodies + place - layout.instances
    if state.catalog_index[world, place] < 0:
        return -1
    return world * layout.bodies + layout.gripper_bodies + state.body_slot[world, place]


@wp.func
def add_force(body: int, force: wp.vec3, total: wp.array2d[wp.int64]):
    """Add a contact force [N] to a body's fixed-point sums by atomics: its components to columns 0 to 2, its magnitude to column 3."""
    for axis in range(3):
        wp.atomic_add(total, body, axis, wp.int64(wp.rint(force[axis] * COUNTS_PER_NEWTON)))
    wp.atomic_add(total, body, MAGNITUDE, wp.int64(wp.rint(wp.length(force) * COUNTS_PER_NEWTON)))


@wp.kernel
def sum_contacts_kernel(
    # State:
    contacts: Contacts,
    # In:
    contact_force: wp.array[wp.spatial_vector],  # (contact) [N, N·m]
    # Out:
    total_inout: wp.array2d[wp.int64],  # (body, column)
):
    """Sum contact forces by body, in fixed point (`add_force`): each contact's force acts on its first shape, the opposite on the second.

    Forces that are not finite are left out. Launched over contact.
    """
    contact = wp.tid()
    if contact >= contacts.count[0]:
        return
    force = wp.spatial_top(contact_force[contact])
    if not wp.isfinite(force):
        return
    for side in range(2):
        shape = contacts.shape0[contact]
        if side == 1:
            shape = contacts.shape1[contact]
            force = -force
        if shape >= 0 and contacts.shape_body[shape] >= 0:
            add_force(contacts.shape_body[shape], force, total_inout)


@wp.kernel
def sum_supports_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    contacts: Contacts,
    # In:
    contact_force: wp.array[wp.spatial_vector],  # (contact) [N, N·m]
    # Out:
    total_inout: wp.array2d[wp.int64],  # (body, other)
):
    """Sum the upward contact forces on each body by the body that exerts them, in fixed point; downward ones count negative.

    Column `other` is the body's index in its world; the last one is for everything static: bins and table. Launched over contact.
    """
    contact = wp.tid()
    if contact >= contacts.count[0] or contacts.shape0[contact] < 0 or contacts.shape1[contact] < 0:
        return
    upward = contact_force[contact][2]
    if not wp.isfinite(upward):
        return
    counts = wp.int64(wp.rint(upward * COUNTS_PER_NEWTON))
    a = contacts.shape_body[contacts.shape0[contact]]
    b = contacts.shape_body[contacts.shape1[contact]]
    static = total_inout.shape[1] - 1
    if a >= 0:
        wp.atomic_add(total_inout, a, wp.where(b >= 0, b % layout.bodies, static), counts)
    if b >= 0:
        wp.atomic_add(total_inout, b, wp.where(a >= 0, a % layout.bodies, static), -counts)


@wp.kernel
def record_supports_kernel(
    # Scene:
    layout: LayoutData,
    scale: float,
    # State:
    state: Worlds,
    # In:
    total: wp.array2d[wp.int64],  # (body, other)
    # Out:
    support_out: wp.array3d[float],  # (world, instance, supporter) [N]
):
    """Record what carries each instance: mean upward force of each supporter on it, `scale` x `total`; 0 for instances not in the scene.

    The last axis indexes supporters: the instances, then one entry for all static bodies. Launched over world, instance, supporter.
    """
    world, instance, supporter = wp.tid()
    body = body_of(layout, world, instance, state)
    other = total.shape[1] - 1
    if supporter < layout.instances:
        other = body_of(layout, world, supporter, state)
        if other >= 0:
            other = other % layout.bodies
    support = float(0.0)
    if body >= 0 and other >= 0:
        support = scale * float(total[body, other])
    support_out[world, instance, supporter] = support


@wp.kernel
def save_impedance_force_kernel(
    # Scene:
    layout: LayoutData,
    weight: float,
    # State:
    control: Control,
    # Out:
    force_out: wp.array[wp.vec3],  # (world) [N]
):
    """Save the force of the gripper's impedance control [N] to `force_out`: its x, y, z joint forces minus `weight` [N], the gravity
    compensation in z, before seal forces are added. Launched over world.
    """
    world = wp.tid()
    first = world * layout.dofs
    force_out[world] = wp.vec3(control.joint_f[first], control.joint_f[first + 1], control.joint_f[first + 2] - weight)


@wp.kernel
def record_motion_kernel(layout: LayoutData, step: int, state: Worlds, motion: Motion, log_out: StepLog):
    """Record poses and velocities of objects, gripper shaft and cup at the end of a step; NaN for instances that are not in the scene.

    Launched over world, place.
    """
    world, place = wp.tid()
    body = body_of(layout, world, place, state)
    if body < 0:
        unknown = wp.vec3(wp.nan, wp.nan, wp.nan)
        log_out.pose[world, step, place] = wp.transform(unknown, wp.quat(wp.nan, wp.nan, wp.nan, wp.nan))
        log_out.velocity[world, step, place] = unknown
        log_out.angular_velocity[world, step, place] = unknown
        return
    log_out.pose[world, step, place] = motion.body_q[body]
    log_out.velocity[world, step, place] = wp.spatial_top(motion.body_qd[body])
    log_out.angular_velocity[world, step, place] = wp.spatial_bottom(motion.body_qd[body])


@wp.kernel
def record_forces_kernel(
    # Scene:
    layout: LayoutData,
    step: int,
    substep_fraction: float,
    # State:
    state: Worlds,
    seals: Seals,
    # In:
    total: wp.array2d[wp.int64],  # (body, column)
    # Out:
    log_out: StepLog,
):
    """Record contact and seal forces of a step; instances that are not in the scene have NaN, and 0 in `attached`.

    `contact_force` receives the vector sum over a body's contacts, `contact_load` the sum of magnitudes; both are means over the solver's
    substeps, whose forces `total` sums: `substep_fraction` is 1 / substeps. `attached` receives 1 if a seal holds the instance at the
    step's end. Launched over world, place.
    """
    world, place = wp.tid()
    body = body_of(layout, world, place, state)
    force = wp.vec3(wp.nan, wp.nan, wp.nan)
    magnitude = float(wp.nan)
    if body >= 0:
        scale = substep_fraction / COUNTS_PER_NEWTON
        force = wp.vec3(scale * float(total[body, 0]), scale * float(total[body, 1]), scale * float(total[body, 2]))
        magnitude = scale * float(total[body, MAGNITUDE])
    log_out.contact_force[world, step, place] = force
    log_out.contact_load[world, step, place] = magnitude
    if place < layout.instances:
        seal = float(wp.nan)
        holds = int(0)
        if body >= 0:
            seal = seals.seal_force[world, place]
            holds = wp.where(seals.attached[world, place] != 0, 1, 0)
        log_out.seal_force[world, step, place] = seal
        log_out.attached[world, step, place] = wp.uint8(holds)


@wp.kernel
def record_gripper_kernel(
    # Scene:
    step: int,
    # State:
    state: Worlds,
    attempts: Attempts,
    seals: Seals,
    # In:
    force: wp.array[wp.vec3],  # (world) [N]
    # Out:
    log_out: StepLog,
):
    """Record the gripper's task, setpoint (NaN without one), impedance force and forces of its cups in a step. Launched over world."""
    world = wp.tid()
    current_task = int(Task.NONE)
    if state.phase[world] == Phase.ACT:
        current_task = attempts.task[world]
    target = wp.vec3(wp.nan, wp.nan, wp.nan)
    if state.phase[world] == Phase.ACT and (state.mode[world] == Mode.MOVE or current_task >= Task.APPROACH):
        target = state.setpoint[world]
    log_out.setpoint[world, step] = target
    log_out.impedance_force[world, step] = force[world]
    log_out.task[world, step] = wp.int8(current_task)
    for cup in range(seals.cup_force.shape[1]):
        log_out.cup_force[world, step, cup] = seals.cup_force[world, cup]


@wp.kernel
def save_drop_poses_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    state: Worlds,
    motion: Motion,
    # Out:
    drop_out: wp.array2d[wp.transform],  # (world, instance) [m]
):
    """Save the drop poses of objects: their poses before the first tick of phase SETTLE. Launched over world, instance."""
    world, instance = wp.tid()
    if state.phase[world] == Phase.SETTLE and state.progress[world][0] == 0 and state.catalog_index[world, instance] >= 0:
        drop_out[world, instance] = motion.body_q[world * layout.bodies + layout.gripper_bodies + state.body_slot[world, instance]]
