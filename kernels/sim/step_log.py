"""What physics does in every step, written down for trajectories."""

import warp as wp

from synpick_warp.codes import Mode, Phase, Task
from synpick_warp.kernels.structs import LayoutData

wp.set_module_options({"enable_backward": False})

# Counts of a newton in sums of contact forces: integers, so that no corner_order of threads changes a sum. A count is 1 µN, the largest sum
# 9e12 N.
COUNTS_PER_NEWTON = wp.constant(1048576.0)
# Columns of these sums: the vector's x, y and z, then the sizes.
MAGNITUDE = wp.constant(3)


@wp.func
def body_of(layout: LayoutData, world: int, place: int, catalog_index: wp.array2d[int], body_slot: wp.array2d[int]) -> int:
    """Index of the body in a place of a record: of an instance, or after these of the finger and the cup; -1: no such instance."""
    if place >= layout.instances:
        return world * layout.bodies + place - layout.instances
    if catalog_index[world, place] < 0:
        return -1
    return world * layout.bodies + layout.gripper_bodies + body_slot[world, place]


@wp.func
def add_force(body: int, force: wp.vec3, total: wp.array2d[wp.int64]):
    """Add a contact's force [N] to a body's sums."""
    for axis in range(3):
        wp.atomic_add(total, body, axis, wp.int64(wp.rint(force[axis] * COUNTS_PER_NEWTON)))
    wp.atomic_add(total, body, MAGNITUDE, wp.int64(wp.rint(wp.length(force) * COUNTS_PER_NEWTON)))


@wp.kernel
def sum_contacts_kernel(
    # Scene:
    shape_body: wp.array[int],
    # State:
    contact_count: wp.array[int],
    shape0: wp.array[int],
    shape1: wp.array[int],
    # In:
    contact_force: wp.array[wp.spatial_vector],
    # Out:
    total_inout: wp.array2d[wp.int64],
):
    """Add the force of each contact, which is that on its first shape, to the sums of the one body and its opposite to the other's."""
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
def save_impedance_force_kernel(
    # Scene:
    layout: LayoutData,
    weight: float,
    # State:
    joint_f: wp.array[float],
    # Out:
    force_out: wp.array[wp.vec3],
):
    """The force that draws the gripper to its setpoint, before the seals add theirs: what acts on it but for the weight it bears."""
    world = wp.tid()
    first = world * layout.dofs
    force_out[world] = wp.vec3(joint_f[first], joint_f[first + 1], joint_f[first + 2] - weight)


@wp.kernel
def record_motion_kernel(
    # Scene:
    layout: LayoutData,
    step: int,
    # State:
    catalog_index: wp.array2d[int],
    body_slot: wp.array2d[int],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    # Out:
    pose_out: wp.array3d[wp.transform],
    velocity_out: wp.array3d[wp.vec3],
    spin_out: wp.array3d[wp.vec3],
):
    """Where objects, finger and cup are at the end of a step, and how they move; NaN for an instance that is not in the scene."""
    world, place = wp.tid()
    body = body_of(layout, world, place, catalog_index, body_slot)
    if body < 0:
        nothing = wp.vec3(wp.nan, wp.nan, wp.nan)
        pose_out[world, step, place] = wp.transform(nothing, wp.quat(wp.nan, wp.nan, wp.nan, wp.nan))
        velocity_out[world, step, place] = nothing
        spin_out[world, step, place] = nothing
        return
    pose_out[world, step, place] = body_q[body]
    velocity_out[world, step, place] = wp.spatial_top(body_qd[body])
    spin_out[world, step, place] = wp.spatial_bottom(body_qd[body])


@wp.kernel
def record_forces_kernel(
    # Scene:
    layout: LayoutData,
    step: int,
    share: float,
    # State:
    catalog_index: wp.array2d[int],
    body_slot: wp.array2d[int],
    attached: wp.array2d[int],
    seal_force: wp.array2d[float],
    # In:
    total: wp.array2d[wp.int64],
    # Out:
    contact_force_out: wp.array3d[wp.vec3],
    contact_load_out: wp.array3d[float],
    seal_force_out: wp.array3d[float],
    attached_out: wp.array3d[wp.uint8],
):
    """What acted on objects, finger and cup in a step; NaN for an instance that is not in the scene.

    Contact forces are a mean over the step's solver steps, whose forces were summed: `share` is 1 / their number.
    """
    world, place = wp.tid()
    body = body_of(layout, world, place, catalog_index, body_slot)
    force = wp.vec3(wp.nan, wp.nan, wp.nan)
    size = float(wp.nan)
    if body >= 0:
        scale = share / COUNTS_PER_NEWTON
        force = wp.vec3(scale * float(total[body, 0]), scale * float(total[body, 1]), scale * float(total[body, 2]))
        size = scale * float(total[body, MAGNITUDE])
    contact_force_out[world, step, place] = force
    contact_load_out[world, step, place] = size
    if place < layout.instances:
        bears = float(wp.nan)
        hangs = int(0)
        if body >= 0:
            bears = seal_force[world, place]
            hangs = attached[world, place]
        seal_force_out[world, step, place] = bears
        attached_out[world, step, place] = wp.uint8(hangs)


@wp.kernel
def record_gripper_kernel(
    # Scene:
    step: int,
    # State:
    phase: wp.array[int],
    mode: wp.array[int],
    task: wp.array[int],
    setpoint: wp.array[wp.vec3],
    # In:
    force: wp.array[wp.vec3],
    # Out:
    setpoint_out: wp.array2d[wp.vec3],
    force_out: wp.array2d[wp.vec3],
    task_out: wp.array2d[wp.int8],
):
    """What the gripper did in a step: its task, its setpoint, which is NaN where it has none, and the force towards it."""
    world = wp.tid()
    doing = int(Task.NONE)
    if phase[world] == Phase.ACT:
        doing = task[world]
    place = wp.vec3(wp.nan, wp.nan, wp.nan)
    if phase[world] == Phase.ACT and (mode[world] == Mode.MOVE or doing >= Task.APPROACH):
        place = setpoint[world]
    setpoint_out[world, step] = place
    force_out[world, step] = force[world]
    task_out[world, step] = wp.int8(doing)


@wp.kernel
def save_drop_poses_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    phase: wp.array[int],
    progress: wp.array[wp.vec4i],
    catalog_index: wp.array2d[int],
    body_slot: wp.array2d[int],
    body_q: wp.array[wp.transform],
    # Out:
    drop_out: wp.array2d[wp.transform],
):
    """Where a world's objects begin to fall: their poses before its first tick."""
    world, instance = wp.tid()
    if phase[world] == Phase.SETTLE and progress[world][0] == 0 and catalog_index[world, instance] >= 0:
        drop_out[world, instance] = body_q[world * layout.bodies + layout.gripper_bodies + body_slot[world, instance]]
