"""Settling: penetration and displacement of objects, re-drops, and the decision that a pile is at rest."""

import warp as wp

from synpick_warp.codes import Lost, Phase, Stream
from synpick_warp.kernels.rng import stream_key
from synpick_warp.kernels.sim.drop import choose_compartment, drop_pose, top_of_objects, write_body
from synpick_warp.kernels.state import Contacts, Motion, Worlds
from synpick_warp.kernels.structs import BinData, CatalogData, DropData, LayoutData, SettleData

wp.set_module_options({"enable_backward": False})

# Slack of a number of objects that is a fraction of them, for rounding.
COUNT_ROUNDING = wp.constant(1.0e-3)
# Height of an object's origin below which it has left the bin, through its floor or beside it [m].
BELOW_FLOOR = wp.constant(-0.01)
# Offset of collision shapes that must not touch anything: above whatever falls [m].
SHAPES_AWAY = wp.constant(1000.0)
# Offset of the shapes of bins that are not drawn: above all others, such as the shaft of a gripper that picks, which is SHAPES_AWAY [m].
BINS_AWAY = wp.constant(2000.0)


@wp.kernel
def measure_penetration_kernel(contacts: Contacts, motion: Motion, state_out: Worlds):
    """Deepest penetration of each body [m]: max over its contacts of margin_0 + margin_1 - n·(p_1 - p_0), by atomics.

    `penetration` must be cleared before. Launched over contact.
    """
    contact = wp.tid()
    if contact >= contacts.count[0]:
        return
    a = int(-1)
    b = int(-1)
    if contacts.shape0[contact] >= 0:
        a = contacts.shape_body[contacts.shape0[contact]]
    if contacts.shape1[contact] >= 0:
        b = contacts.shape_body[contacts.shape1[contact]]
    p = contacts.point0[contact]
    q = contacts.point1[contact]
    if a >= 0:
        p = wp.transform_point(motion.body_q[a], p)
    if b >= 0:
        q = wp.transform_point(motion.body_q[b], q)
    penetration = contacts.margin0[contact] + contacts.margin1[contact] - wp.dot(contacts.normal[contact], q - p)
    if a >= 0:
        wp.atomic_max(state_out.penetration, a, penetration)
    if b >= 0:
        wp.atomic_max(state_out.penetration, b, penetration)


@wp.kernel
def measure_displacement_kernel(layout: LayoutData, catalog: CatalogData, state_inout: Worlds, motion: Motion):
    """Displacement of each object over the last tick [m]: the bound |Δp| + θ r on the motion of its points, with rotation angle θ.

    r is the bounding radius. Over a tick instead of by velocity: a solver that has not converged makes a pile vibrate in place. Launched
    over world, instance.
    """
    world, instance = wp.tid()
    index = state_inout.catalog_index[world, instance]
    if index < 0:
        return
    pose = motion.body_q[world * layout.bodies + layout.gripper_bodies + state_inout.body_slot[world, instance]]
    relative = wp.transform_inverse(state_inout.previous_pose[world, instance]) * pose
    distance = wp.length(wp.transform_get_translation(pose) - wp.transform_get_translation(state_inout.previous_pose[world, instance]))
    q = wp.transform_get_rotation(relative)
    angle = 2.0 * wp.atan2(wp.length(wp.vec3(q[0], q[1], q[2])), wp.abs(q[3]))
    state_inout.displacement[world, instance] = distance + angle * catalog.radius[index]
    state_inout.previous_pose[world, instance] = pose


@wp.func
def is_outside(position: wp.vec3, bins: BinData, world: int) -> bool:
    """True if an object's origin [m] lies below the floor of the world's bin, or beside its opening and below the rim.

    The inside of a bin of pitch > 0 is given by a height field.
    """
    chosen = bins.chosen[world]
    local = wp.transform_point(wp.transform_inverse(bins.pose[world]), position)
    pitch = bins.pitch[chosen]
    if pitch[0] > 0.0:
        column = int(wp.floor(local[0] / pitch[0])) + bins.limit.shape[1] // 2
        row = int(wp.floor(local[1] / pitch[1])) + bins.limit.shape[2] // 2
        if column < 0 or row < 0 or column >= bins.limit.shape[1] or row >= bins.limit.shape[2]:
            return local[2] < bins.wall_height[chosen]
        return local[2] < bins.limit[chosen, column, row]
    reach = bins.reach[chosen]
    beside = wp.abs(local[0]) > reach[0] or wp.abs(local[1]) > reach[1]
    return local[2] < BELOW_FLOOR or (beside and local[2] < bins.wall_height[chosen])


@wp.kernel
def redrop_objects_kernel(
    seed: wp.uint64,
    layout: LayoutData,
    catalog: CatalogData,
    drop: DropData,
    settle: SettleData,
    bins: BinData,
    state_inout: Worlds,
    motion_inout: Motion,
):
    """Drop objects again that left the bin or were stuck, that is, in deep penetration for longer than `stuck_ticks`.

    They are stacked one above the other, above all other objects, and the guide walls return. `progress` holds ticks since the drop, ticks
    at rest, re-drops, and whether the guide walls stand; `stuck` counts each instance's ticks in deep penetration. Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.SETTLE:
        return
    progress = state_inout.progress[world]
    key = stream_key(seed, state_inout.arrangement_id[world][0], state_inout.arrangement_id[world][1], Stream.REDROP)
    places = stream_key(seed, state_inout.arrangement_id[world][0], state_inout.arrangement_id[world][1], Stream.COMPARTMENT)
    height = bins.rim_height[bins.chosen[world]]
    body = world * layout.bodies + layout.gripper_bodies
    if drop.layers == 1:
        top = top_of_objects(layout, catalog, state_inout, motion_inout.body_q, world)
        height = wp.max(height, top - wp.transform_get_translation(bins.pose[world])[2] + drop.clearance)
    for instance in range(layout.instances):
        index = state_inout.catalog_index[world, instance]
        if index >= 0:
            slot = state_inout.body_slot[world, instance]
            stuck = state_inout.stuck[world, instance] + 1
            if state_inout.penetration[body + slot] < settle.stuck_depth:
                stuck = 0
            position = wp.transform_get_translation(motion_inout.body_q[body + slot])
            if stuck > settle.stuck_ticks or is_outside(position, bins, world):
                stuck = 0
                radius = catalog.radius[index]
                compartment = choose_compartment(bins, world, places, instance)
                center = bins.center[compartment]
                half = bins.half[compartment]
                pose = drop_pose(key, progress[2], radius, height + radius, drop.spread, bins, world, center, half)
                height += 2.0 * radius + drop.clearance
                q = world * layout.coords + layout.gripper_dofs + 7 * slot
                write_body(motion_inout.joint_q, motion_inout.joint_qd, q, world * layout.dofs + layout.gripper_dofs + 6 * slot, pose)
                progress = wp.vec4i(progress[0], -1, progress[2] + 1, 1)
            state_inout.stuck[world, instance] = stuck
    state_inout.progress[world] = progress


@wp.kernel
def judge_rest_kernel(layout: LayoutData, settle: SettleData, restless: float, state_inout: Worlds):
    """Count ticks at rest; after `rest_ticks` of them remove the guide walls, after as many again begin phase ACT.

    A pile is at rest if no object's displacement exceeds `rest_threshold`, or `relaxed_rest_threshold` after `late_ticks`. Up to a fraction
    `restless` of its objects may have displacements between the two. Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.SETTLE:
        return
    ticks = state_inout.progress[world][0] + 1
    resting = state_inout.progress[world][1] + 1
    guides = state_inout.progress[world][3]
    allowed = settle.rest_threshold
    if ticks > settle.late_ticks:
        allowed = settle.relaxed_rest_threshold
    objects = int(0)
    moving = int(0)
    for instance in range(layout.instances):
        if state_inout.catalog_index[world, instance] >= 0:
            objects += 1
            if state_inout.displacement[world, instance] > allowed:
                moving += 1
            if state_inout.displacement[world, instance] > wp.max(allowed, settle.relaxed_rest_threshold):
                resting = 0
    if float(moving) > restless * float(objects) + COUNT_ROUNDING:
        resting = 0
    if resting >= settle.rest_ticks and ticks >= settle.min_ticks:
        if guides == 1:
            guides = 0
            resting = 0
        else:
            state_inout.phase[world] = Phase.ACT
    state_inout.progress[world] = wp.vec4i(ticks, resting, state_inout.progress[world][2], guides)


@wp.kernel
def flag_lost_kernel(
    # Scene:
    pairs: int,
    contacts: int,
    # State:
    overlap_count: wp.array[int],  # (one)
    pair_count: wp.array[int],  # (one)
    contact_count: wp.array[int],  # (one)
    # Out:
    overflow_out: wp.array[wp.bool],  # (world)
    lost_inout: wp.array[int],  # (world)
):
    """Flag all worlds if collision detection found more overlaps or shape pairs, or contacts, than its capacities: those of any world may
    be lost. `lost` receives bits of `Lost`. Launched over world.
    """
    world = wp.tid()
    lost = int(0)
    if wp.max(overlap_count[0], pair_count[0]) > pairs:
        lost = lost | Lost.PAIRS
    if contact_count[0] > contacts:
        lost = lost | Lost.CONTACTS
    if lost != 0:
        overflow_out[world] = True
        lost_inout[world] = lost_inout[world] | lost


@wp.kernel
def set_gaps_kernel(
    # Scene:
    least: float,
    most: float,
    duration: float,
    falling: float,
    shape_body: wp.array[int],  # (shape), -1: static
    shape_transform: wp.array[wp.transform],  # (shape)
    shape_radius: wp.array[float],  # (shape) [m], about the shape's origin
    body_com: wp.array[wp.vec3],  # (body) [m]
    # In:
    body_qd: wp.array[wp.spatial_vector],  # (body) [m/s, rad/s]
    # Out:
    gap_out: wp.array[float],  # (shape) [m]
):
    """Speculative contact margins: `gap_out` receives `least`, and the bound (|v| + v_g + |ω| r) Δt on the path of the shape's points in a
    substep of the given duration [s], but `most` at most. v_g: speed gained by falling for its time [m/s]. Launched over shape.

    Two shapes have contacts up to the sum of their margins, so before they touch, unless one is hit in that substep: by a cube at 3.9 m/s a
    cube 1 mm above the floor was driven 2.8 mm into it. More contacts carry no impulse, but the rows of one body are solved one by one.
    """
    shape = wp.tid()
    body = shape_body[shape]
    gap = least
    if body >= 0:
        radius = wp.length(wp.transform_get_translation(shape_transform[shape]) - body_com[body]) + shape_radius[shape]
        gap += duration * (falling + wp.length(wp.spatial_top(body_qd[body])) + wp.length(wp.spatial_bottom(body_qd[body])) * radius)
    gap_out[shape] = wp.min(gap, most)


@wp.func
def shape_pose(collides: bool) -> wp.transform:
    """Local pose of a collision shape that can be disabled: identity, or far above, where it touches nothing.

    Moved instead of disabled by its flag: Newton's all-pairs broad phase reads a shape's collision flag only once, when it is built.
    """
    height = SHAPES_AWAY
    if collides:
        height = 0.0
    return wp.transform(wp.vec3(0.0, 0.0, height), wp.quat_identity())


@wp.kernel
def place_bins_kernel(
    # Scene:
    layout: LayoutData,
    bins: BinData,
    # State:
    state: Worlds,
    # Out:
    shape_transform_out: wp.array[wp.transform],  # (shape) [m]
):
    """Place the collision shapes of each world's bin, and its guide walls while `progress` says that they stand.

    Its other guide walls are at SHAPES_AWAY, what belongs to other bins at BINS_AWAY.

    Launched over world, part: a collision shape or guide wall of a bin.
    """
    world, part = wp.tid()
    pose = bins.pose[world]
    if bins.shape_bin[part] != bins.chosen[world]:
        pose = wp.transform(wp.vec3(0.0, 0.0, BINS_AWAY), wp.quat_identity())
    elif bins.shape_guide[part] == 1 and state.progress[world][3] == 0:
        pose = shape_pose(False)
    shape_transform_out[world * layout.shapes + bins.shape[part]] = pose
