"""Whether a world's pile is at rest, and what must be dropped again."""

import warp as wp

from synpick_warp.codes import Phase, Stream
from synpick_warp.kernels.rng import stream_key
from synpick_warp.kernels.sim.arrangement import drop_pose, write_body
from synpick_warp.kernels.structs import CatalogData, DropData, LayoutData, SettleData

wp.set_module_options({"enable_backward": False})

# An object whose origin is lower than this has left the tote through its floor or beside it [m].
BELOW_FLOOR = wp.constant(-0.01)
# Collision shapes that are to touch nothing are this much higher, above whatever falls [m].
SHAPES_AWAY = wp.constant(1000.0)


@wp.kernel
def measure_penetration_kernel(
    # State:
    contact_count: wp.array[int],
    shape0: wp.array[int],
    shape1: wp.array[int],
    point0: wp.array[wp.vec3],
    point1: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    margin0: wp.array[float],
    margin1: wp.array[float],
    shape_body: wp.array[int],
    body_q: wp.array[wp.transform],
    # Out:
    penetration_out: wp.array[float],
):
    """Deepest penetration of each body [m]: max over its contacts of margin_0 + margin_1 - n·(p_1 - p_0)."""
    contact = wp.tid()
    if contact >= contact_count[0]:
        return
    a = int(-1)
    b = int(-1)
    if shape0[contact] >= 0:
        a = shape_body[shape0[contact]]
    if shape1[contact] >= 0:
        b = shape_body[shape1[contact]]
    p = point0[contact]
    q = point1[contact]
    if a >= 0:
        p = wp.transform_point(body_q[a], p)
    if b >= 0:
        q = wp.transform_point(body_q[b], q)
    penetration = margin0[contact] + margin1[contact] - wp.dot(normal[contact], q - p)
    if a >= 0:
        wp.atomic_max(penetration_out, a, penetration)
    if b >= 0:
        wp.atomic_max(penetration_out, b, penetration)


@wp.kernel
def measure_displacement_kernel(
    # Scene:
    layout: LayoutData,
    catalog: CatalogData,
    # State:
    catalog_index: wp.array2d[int],
    body_slot: wp.array2d[int],
    body_q: wp.array[wp.transform],
    previous_pose_inout: wp.array2d[wp.transform],
    # Out:
    displacement_out: wp.array2d[float],
):
    """How far any point of an object moved since the last tick, at most [m]: |Δp| + θ r, with the rotation's angle θ.

    Over a tick, not an instant: a solver that has not converged makes a pile buzz about its place without going anywhere.
    """
    world, instance = wp.tid()
    e = catalog_index[world, instance]
    if e < 0:
        return
    pose = body_q[world * layout.bodies + layout.gripper_bodies + body_slot[world, instance]]
    turn = wp.transform_inverse(previous_pose_inout[world, instance]) * pose
    displacement = wp.length(wp.transform_get_translation(pose) - wp.transform_get_translation(previous_pose_inout[world, instance]))
    q = wp.transform_get_rotation(turn)
    angle = 2.0 * wp.atan2(wp.length(wp.vec3(q[0], q[1], q[2])), wp.abs(q[3]))
    displacement_out[world, instance] = displacement + angle * catalog.radius[e]
    previous_pose_inout[world, instance] = pose


@wp.func
def is_outside(position: wp.vec3, drop: DropData) -> bool:
    """Whether an object's origin has left the tote."""
    beside = wp.abs(position[0]) > 0.5 * drop.rim_length or wp.abs(position[1]) > 0.5 * drop.rim_width
    return position[2] < BELOW_FLOOR or (beside and position[2] < drop.rim_height)


@wp.kernel
def redrop_objects_kernel(
    # Scene:
    seed: wp.uint64,
    layout: LayoutData,
    catalog: CatalogData,
    drop: DropData,
    settle: SettleData,
    # State:
    arrangement_id: wp.array[wp.vec2i],
    phase: wp.array[int],
    catalog_index: wp.array2d[int],
    body_slot: wp.array2d[int],
    body_q: wp.array[wp.transform],
    penetration: wp.array[float],
    stuck_inout: wp.array2d[int],
    progress_inout: wp.array[wp.vec4i],
    joint_q_inout: wp.array[float],
    joint_qd_inout: wp.array[float],
):
    """Drop again what left the tote, or penetrates something deeply for some time, one above the other; guide walls come back.

    `progress` holds ticks since the drop, ticks at rest, re-drops, and whether the guide walls stand. `arrangement_id` is (episode,
    redraw).
    """
    world = wp.tid()
    if phase[world] != Phase.SETTLE:
        return
    progress = progress_inout[world]
    key = stream_key(seed, arrangement_id[world][0], arrangement_id[world][1], Stream.REDROP)
    height = drop.rim_height
    body = world * layout.bodies + layout.gripper_bodies
    for instance in range(layout.instances):
        e = catalog_index[world, instance]
        if e >= 0:
            s = body_slot[world, instance]
            stuck = stuck_inout[world, instance] + 1
            if penetration[body + s] < settle.stuck_depth:
                stuck = 0
            if stuck > settle.stuck_ticks or is_outside(wp.transform_get_translation(body_q[body + s]), drop):
                stuck = 0
                pose = drop_pose(key, progress[2], catalog.radius[e], height + catalog.radius[e], drop)
                height += 2.0 * catalog.radius[e] + drop.clearance
                q = world * layout.coords + layout.gripper_dofs + 7 * s
                write_body(joint_q_inout, joint_qd_inout, q, world * layout.dofs + layout.gripper_dofs + 6 * s, pose)
                progress = wp.vec4i(progress[0], -1, progress[2] + 1, 1)
            stuck_inout[world, instance] = stuck
    progress_inout[world] = progress


@wp.kernel
def judge_rest_kernel(
    # Scene:
    layout: LayoutData,
    settle: SettleData,
    # State:
    catalog_index: wp.array2d[int],
    displacement: wp.array2d[float],
    phase_inout: wp.array[int],
    progress_inout: wp.array[wp.vec4i],
):
    """Count ticks at rest; after enough of them take the guide walls away, and after as many again let the gripper act.

    Rest is no object moving by more than `rest_shift` in a tick; from `late_ticks` on, `last_shift` will do.
    """
    world = wp.tid()
    if phase_inout[world] != Phase.SETTLE:
        return
    ticks = progress_inout[world][0] + 1
    resting = progress_inout[world][1] + 1
    guides = progress_inout[world][3]
    allowed = settle.rest_threshold
    if ticks > settle.late_ticks:
        allowed = settle.relaxed_rest_threshold
    for instance in range(layout.instances):
        if catalog_index[world, instance] >= 0 and displacement[world, instance] > allowed:
            resting = 0
    if resting >= settle.rest_ticks and ticks >= settle.min_ticks:
        if guides == 1:
            guides = 0
            resting = 0
        else:
            phase_inout[world] = Phase.ACT
    progress_inout[world] = wp.vec4i(ticks, resting, progress_inout[world][2], guides)


@wp.kernel
def flag_lost_pairs_kernel(
    # Scene:
    room: int,
    # State:
    pair_count: wp.array[int],
    # Out:
    overflow_out: wp.array[wp.bool],
):
    """Flag all worlds if the broad phase found more pairs of near shapes than it has room for: any world's may be lost."""
    world = wp.tid()
    if pair_count[0] > room:
        overflow_out[world] = True


@wp.func
def shape_pose(collides: bool) -> wp.transform:
    """Where on its body, or in its world, a collision shape is: in place, or far above, where it touches nothing.

    Moved, not switched off: Newton's all-pairs broad phase reads a shape's collision flag when it is made, and never again.
    """
    height = SHAPES_AWAY
    if collides:
        height = 0.0
    return wp.transform(wp.vec3(0.0, 0.0, height), wp.quat_identity())


@wp.kernel
def set_guides_kernel(
    # Scene:
    layout: LayoutData,
    guide_shapes: wp.array[int],
    # State:
    progress: wp.array[wp.vec4i],
    # Out:
    shape_transform_out: wp.array[wp.transform],
):
    """Put the guide walls of each world in place, or far above."""
    world, guide = wp.tid()
    shape_transform_out[world * layout.shapes + guide_shapes[guide]] = shape_pose(progress[world][3] == 1)
