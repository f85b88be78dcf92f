"""Step log: poses, velocities, contact and seal forces of every physics step, for trajectories; who lies on whom in a tick.

A row of the log, called "place", is an instance; the rows of the gripper shaft and the cup follow those of the instances.
"""

import warp as wp

from synpick_warp.codes import Mode, Phase, Task
from synpick_warp.kernels.structs import LayoutData

wp.set_module_options({"enable_backward": False})

# Fixed-point scale of sums of contact forces: integer sums do not depend on the order of threads. A count is 1 µN, the largest sum
# 9e12 N.
COUNTS_PER_NEWTON = wp.constant(1048576.0)
# Column of these sums with the sum of magnitudes; columns 0 to 2 hold the vector sum.
MAGNITUDE = wp.constant(3)


@wp.func
def body_of(layout: LayoutData, world: int, place: int, catalog_index: wp.array2d[int], body_slot: wp.array2d[int]) -> int:
    """Body index of row `place` of the step log: of an instance, then of the gripper shaft and the cup; -1: no such instance."""
    if place >= layout.instances:
        return world * layout.bodies + place - layout.instances
    if catalog_index[world, place] < 0:
        return -1
    return world * layout.bodies + layout.gripper_bodies + body_slot[world, place]


@wp.func
def add_force(body: int, force: wp.vec3, total: wp.array2d[wp.int64]):
    """Add a contact force [N] to a body's fixed-point sums by atomics: its components to columns 0 to 2, its magnitude to column 3."""
    for axis in range(3):
        wp.atomic_add(total, body, axis, wp.int64(wp.rint(force[axis] * COUNTS_PER_NEWTON)))
    wp.atomic_add(total, body, MAGNITUDE, wp.int64(wp.rint(wp.length(force) * COUNTS_PER_NEWTON)))


@wp.kernel
def sum_contacts_kernel(
    # Scene:
    shape_body: wp.array[int],  # (shape)
    # State:
    contact_count: wp.array[int],  # (one)
    shape0: wp.array[int],  # (contact)
    shape1: wp.array[int],  # (contact)
    # In:
    contact_force: wp.array[wp.spatial_vector],  # (contact) [N, N·m]
    # Out:
    total_inout: wp.array2d[wp.int64],  # (body, column)
):
    """Sum contact forces by body, in fixed point (`add_force`): each contact's force acts on its first shape, the opposite on the second.

    Forces that are not finite are left out. Launched over contact.
    """
    contact = wp.tid()
    if contact >= contact_count[0]:
        return
    force = wp.spatial_top(contact_force[contact])
    if not wp.isfinite(force):
        return
    for side in range(2):
        shape = shape0[contact]
        if side == 1:
            shape = shape1[contact]
            force = -force
        if shape >= 0 and shape_body[shape] >= 0:
            add_force(shape_body[shape], force, total_inout)


@wp.kernel
def sum_supports_kernel(
    # Scene:
    layout: LayoutData,
    shape_body: wp.array[int],  # (shape)
    # State:
    contact_count: wp.array[int],  # (one)
    shape0: wp.array[int],  # (contact)
    shape1: wp.array[int],  # (contact)
    # In:
    contact_force: wp.array[wp.spatial_vector],  # (contact) [N, N·m]
    # Out:
    total_inout: wp.array2d[wp.int64],  # (body, other)
):
    """Sum the upward contact forces on each body by the body that exerts them, in fixed point; downward ones count negative.

    Column `other` is the body's index in its world; the last one is for everything static: bins and table. Launched over contact.
    """
    contact = wp.tid()
    if contact >= contact_count[0] or shape0[contact] < 0 or shape1[contact] < 0:
        return
    upward = contact_force[contact][2]
    if not wp.isfinite(upward):
        return
    counts = wp.int64(wp.rint(upward * COUNTS_PER_NEWTON))
    a = shape_body[shape0[contact]]
    b = shape_body[shape1[contact]]
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
    catalog_index: wp.array2d[int],  # (world, instance)
    body_slot: wp.array2d[int],  # (world, instance)
    # In:
    total: wp.array2d[wp.int64],  # (body, other)
    # Out:
    support_out: wp.array3d[float],  # (world, instance, supporter) [N]
):
    """Record what carries each instance: mean upward force of each supporter on it, `scale` x `total`; 0 for instances not in the scene.

    The last axis indexes supporters: the instances, then one entry for all static bodies. Launched over world, instance, supporter.
    """
    world, instance, supporter = wp.tid()
    body = body_of(layout, world, instance, catalog_index, body_slot)
    other = total.shape[1] - 1
    if supporter < layout.instances:
        other = body_of(layout, world, supporter, catalog_index, body_slot)
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
    joint_f: wp.array[float],  # (dof) [N, N·m]
    # Out:
    force_out: wp.array[wp.vec3],  # (world) [N]
):
    """Save the force of the gripper's impedance control [N] to `force_out`: its x, y, z joint forces minus `weight` [N], the gravity
    compensation in z, before seal forces are added. Launched over world.
    """
    world = wp.tid()
    first = world * layout.dofs
    force_out[world] = wp.vec3(joint_f[first], joint_f[first + 1], joint_f[first + 2] - weight)


@wp.kernel
def record_motion_kernel(
    # Scene:
    layout: LayoutData,
    step: int,
    # State:
    catalog_index: wp.array2d[int],  # (world, instance)
    body_slot: wp.array2d[int],  # (world, instance)
    body_q: wp.array[wp.transform],  # (body) [m]
    body_qd: wp.array[wp.spatial_vector],  # (body) [m/s, rad/s]
    # Out:
    pose_out: wp.array3d[wp.transform],  # (world, step, place) [m]
    velocity_out: wp.array3d[wp.vec3],  # (world, step, place) [m/s]
    angular_velocity_out: wp.array3d[wp.vec3],  # (world, step, place) [rad/s]
):
    """Record poses and velocities of objects, gripper shaft and cup at the end of a step; NaN for instances that are not in the scene.

    Launched over world, place.
    """
    world, place = wp.tid()
    body = body_of(layout, world, place, catalog_index, body_slot)
    if body < 0:
        unknown = wp.vec3(wp.nan, wp.nan, wp.nan)
        pose_out[world, step, place] = wp.transform(unknown, wp.quat(wp.nan, wp.nan, wp.nan, wp.nan))
        velocity_out[world, step, place] = unknown
        angular_velocity_out[world, step, place] = unknown
        return
    pose_out[world, step, place] = body_q[body]
    velocity_out[world, step, place] = wp.spatial_top(body_qd[body])
    angular_velocity_out[world, step, place] = wp.spatial_bottom(body_qd[body])


@wp.kernel
def record_forces_kernel(
    # Scene:
    layout: LayoutData,
    step: int,
    substep_fraction: float,
    # State:
    catalog_index: wp.array2d[int],  # (world, instance)
    body_slot: wp.array2d[int],  # (world, instance)
    attached: wp.array2d[int],  # (world, instance)
    seal_force: wp.array2d[float],  # (world, instance) [N]
    # In:
    total: wp.array2d[wp.int64],  # (body, column)
    # Out:
    contact_force_out: wp.array3d[wp.vec3],  # (world, step, place) [N]
    contact_load_out: wp.array3d[float],  # (world, step, place) [N]
    seal_force_out: wp.array3d[float],  # (world, step, instance) [N]
    attached_out: wp.array3d[wp.uint8],  # (world, step, instance)
):
    """Record contact and seal forces of a step; instances that are not in the scene have NaN, and 0 in `attached`.

    `contact_force` receives the vector sum over a body's contacts, `contact_load` the sum of magnitudes; both are means over the solver's
    substeps, whose forces `total` sums: `substep_fraction` is 1 / substeps. `attached` receives 1 if a seal holds the instance at the
    step's end. Launched over world, place.
    """
    world, place = wp.tid()
    body = body_of(layout, world, place, catalog_index, body_slot)
    force = wp.vec3(wp.nan, wp.nan, wp.nan)
    magnitude = float(wp.nan)
    if body >= 0:
        scale = substep_fraction / COUNTS_PER_NEWTON
        force = wp.vec3(scale * float(total[body, 0]), scale * float(total[body, 1]), scale * float(total[body, 2]))
        magnitude = scale * float(total[body, MAGNITUDE])
    contact_force_out[world, step, place] = force
    contact_load_out[world, step, place] = magnitude
    if place < layout.instances:
        seal = float(wp.nan)
        holds = int(0)
        if body >= 0:
            seal = seal_force[world, place]
            holds = wp.where(attached[world, place] != 0, 1, 0)
        seal_force_out[world, step, place] = seal
        attached_out[world, step, place] = wp.uint8(holds)


@wp.kernel
def record_gripper_kernel(
    # Scene:
    step: int,
    # State:
    phase: wp.array[int],  # (world)
    mode: wp.array[int],  # (world)
    task: wp.array[int],  # (world)
    setpoint: wp.array[wp.vec3],  # (world) [m]
    cup_force: wp.array2d[float],  # (world, cup) [N]
    # In:
    force: wp.array[wp.vec3],  # (world) [N]
    # Out:
    setpoint_out: wp.array2d[wp.vec3],  # (world, step) [m]
    force_out: wp.array2d[wp.vec3],  # (world, step) [N]
    task_out: wp.array2d[wp.int8],  # (world, step)
    cup_force_out: wp.array3d[float],  # (world, step, cup) [N]
):
    """Record the gripper's task, setpoint (NaN without one), impedance force and forces of its cups in a step. Launched over world."""
    world = wp.tid()
    current_task = int(Task.NONE)
    if phase[world] == Phase.ACT:
        current_task = task[world]
    target = wp.vec3(wp.nan, wp.nan, wp.nan)
    if phase[world] == Phase.ACT and (mode[world] == Mode.MOVE or current_task >= Task.APPROACH):
        target = setpoint[world]
    setpoint_out[world, step] = target
    force_out[world, step] = force[world]
    task_out[world, step] = wp.int8(current_task)
    for cup in range(cup_force.shape[1]):
        cup_force_out[world, step, cup] = cup_force[world, cup]


@wp.kernel
def save_drop_poses_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    phase: wp.array[int],  # (world)
    progress: wp.array[wp.vec4i],  # (world) [ticks]
    catalog_index: wp.array2d[int],  # (world, instance)
    body_slot: wp.array2d[int],  # (world, instance)
    body_q: wp.array[wp.transform],  # (body) [m]
    # Out:
    drop_out: wp.array2d[wp.transform],  # (world, instance) [m]
):
    """Save the drop poses of objects: their poses before the first tick of phase SETTLE. Launched over world, instance."""
    world, instance = wp.tid()
    if phase[world] == Phase.SETTLE and progress[world][0] == 0 and catalog_index[world, instance] >= 0:
        drop_out[world, instance] = body_q[world * layout.bodies + layout.gripper_bodies + body_slot[world, instance]]
