"""Which objects a world gets, and where they fall from."""

import warp as wp

from synpick_warp.codes import Ending, Mode, Phase, Stream
from synpick_warp.kernels.rng import TAU, stream_key, uniform, uniform_index, uniform_rotation
from synpick_warp.kernels.sim.endings import delivers
from synpick_warp.kernels.structs import CatalogData, DropData, LayoutData, ModeData

wp.set_module_options({"enable_backward": False})

# Draws before an arrangement without repeats is taken as complete; each draw finds a new object with
# probability 1 / entries at least, so 4,096 miss one with probability e^-8 at 512 entries.
MAX_SAMPLES = wp.constant(4096)
# Empty slots wait here, far below everything [m].
PARKED_HEIGHT = wp.constant(-100.0)
# Numbers that one drop takes from its stream: x, y and three for the rotation.
DROP_SAMPLES = wp.constant(5)


@wp.kernel
def assign_episodes_kernel(
    # Scene:
    worlds: int,
    episodes: wp.array[int],
    tries: int,
    # State:
    arrangement_id_inout: wp.array[wp.vec2i],
    phase_inout: wp.array[int],
    ending_inout: wp.array[int],
    next_episode_inout: wp.array[int],
):
    """Worlds whose episode is over take the next of `episodes`; an episode that delivered nothing is drawn again where it was.

    One thread walks over the worlds, so that numbers go to worlds in corner_order.
    """
    following = next_episode_inout[0]
    for world in range(worlds):
        phase = phase_inout[world]
        episode = arrangement_id_inout[world][0]
        redraw = arrangement_id_inout[world][1]
        again = phase == Phase.OVER and not delivers(ending_inout[world]) and redraw + 1 < tries
        if again:
            arrangement_id_inout[world] = wp.vec2i(episode, redraw + 1)
            phase_inout[world] = Phase.START
        elif phase == Phase.OVER or phase == Phase.EMPTY:
            if following < episodes.shape[0]:
                arrangement_id_inout[world] = wp.vec2i(episodes[following], 0)
                phase_inout[world] = Phase.START
                following += 1
            else:
                arrangement_id_inout[world] = wp.vec2i(-1, 0)
                phase_inout[world] = Phase.IDLE
        if phase == Phase.OVER or phase == Phase.EMPTY:
            ending_inout[world] = Ending.RUNNING
    next_episode_inout[0] = following


@wp.kernel
def sample_modes_kernel(
    # Scene:
    seed: wp.uint64,
    mode: ModeData,
    # State:
    arrangement_id: wp.array[wp.vec2i],
    phase: wp.array[int],
    # Out:
    mode_out: wp.array[int],
):
    """Draw the mode of worlds that start an episode: PICK if u < p, else TARGET if u < p + t, else MOVE, with shares p and t of the modes.

    u is the first number of the stream (seed, episode, 0, Stream.MODE): another arrangement of the episode has the same mode.
    """
    world = wp.tid()
    if phase[world] != Phase.START:
        return
    number = uniform(stream_key(seed, arrangement_id[world][0], 0, Stream.MODE), 0)
    if number < mode.pick_share:
        mode_out[world] = Mode.PICK
    elif number < mode.pick_or_target_share:
        mode_out[world] = Mode.TARGET
    else:
        mode_out[world] = Mode.MOVE


@wp.func
def clear_catalog_indices(catalog_index: wp.array2d[int], world: int, instances: int):
    for instance in range(instances):
        catalog_index[world, instance] = -1


@wp.func
def is_sampled(catalog_index: wp.array2d[int], world: int, count: int, candidate: int) -> bool:
    found = bool(False)
    for instance in range(count):
        if catalog_index[world, instance] == candidate:
            found = True
    return found


@wp.kernel
def sample_objects_kernel(
    # Scene:
    seed: wp.uint64,
    layout: LayoutData,
    catalog: CatalogData,
    drop: DropData,
    # State:
    arrangement_id: wp.array[wp.vec2i],
    mode: wp.array[int],
    phase_inout: wp.array[int],
    ending_inout: wp.array[int],
    # Out:
    catalog_index_out: wp.array2d[int],
    body_slot_out: wp.array2d[int],
):
    """Draw objects, uniformly, until the next one would exceed the volume budget V: Σ volume ≤ V.

    The first object may be drawn several times, until one fits. Objects take slots of their kind in the corner_order drawn; if a
    kind runs out, the episode ends with an overflow and is drawn again.
    """
    world = wp.tid()
    phase = phase_inout[world]
    if phase != Phase.START and phase != Phase.IDLE:
        return
    clear_catalog_indices(catalog_index_out, world, layout.instances)
    if phase == Phase.IDLE:
        return
    key = stream_key(seed, arrangement_id[world][0], arrangement_id[world][1], Stream.OBJECTS)
    repeats = wp.where(mode[world] == Mode.MOVE, drop.move_repeats, drop.pick_repeats)
    count = int(0)
    singles = int(0)
    compounds = int(0)
    total = float(0.0)
    overflow = bool(False)
    open = bool(True)
    for draw in range(MAX_SAMPLES):
        if open:
            candidate = uniform_index(key, draw, catalog.count)
            known = repeats == 0 and is_sampled(catalog_index_out, world, count, candidate)
            fits = total + catalog.volume[candidate] <= drop.volume
            if not known and not fits and count > 0:
                open = False
            if not known and fits:
                body_slot = singles
                if catalog.compound[candidate] == 1:
                    body_slot = layout.single_slots + compounds
                    compounds += 1
                else:
                    singles += 1
                overflow = overflow or singles > layout.single_slots or compounds > layout.slots - layout.single_slots
                catalog_index_out[world, count] = candidate
                body_slot_out[world, count] = body_slot
                total += catalog.volume[candidate]
                count += 1
            if overflow or count == layout.instances or (repeats == 0 and count == catalog.count):
                open = False
    if overflow:
        clear_catalog_indices(catalog_index_out, world, layout.instances)
        ending_inout[world] = Ending.ARRANGEMENT_OVERFLOW
        phase_inout[world] = Phase.OVER


@wp.kernel
def sample_lights_kernel(
    # Scene:
    seed: wp.uint64,
    drop: DropData,
    # State:
    arrangement_id: wp.array[wp.vec2i],
    phase: wp.array[int],
    # Out:
    light_out: wp.array[int],
    light_yaw_out: wp.array[float],
    light_exposure_out: wp.array[float],
):
    """Draw the light map of worlds that start an episode, its turn about the vertical and its exposure.

    With the numbers u_i of the stream (seed, episode, redraw, Stream.LIGHT): turn = 2π u_1, exposure = s (2 u_2 - 1) stops for a spread s.
    """
    world = wp.tid()
    if phase[world] != Phase.START:
        return
    key = stream_key(seed, arrangement_id[world][0], arrangement_id[world][1], Stream.LIGHT)
    light_out[world] = uniform_index(key, 0, drop.lights)
    light_yaw_out[world] = TAU * uniform(key, 1) * float(drop.turn_lights)
    light_exposure_out[world] = drop.exposure_spread * (2.0 * uniform(key, 2) - 1.0)


@wp.func
def drop_pose(key: wp.uint64, index: int, radius: float, height: float, drop: DropData) -> wp.transform:
    """A random pose at a height: spread over the part of the rim's opening that the bounding sphere can use."""
    first = index * DROP_SAMPLES
    x = (2.0 * uniform(key, first) - 1.0) * drop.spread * wp.max(0.0, 0.5 * drop.rim_length - radius)
    y = (2.0 * uniform(key, first + 1) - 1.0) * drop.spread * wp.max(0.0, 0.5 * drop.rim_width - radius)
    return wp.transform(wp.vec3(x, y, height), uniform_rotation(key, first + 2))


@wp.func
def write_body(joint_q: wp.array[float], joint_qd: wp.array[float], first_q: int, first_qd: int, pose: wp.transform):
    """Put a free body at a pose, at rest."""
    p = wp.transform_get_translation(pose)
    r = wp.transform_get_rotation(pose)
    for axis in range(3):
        joint_q[first_q + axis] = p[axis]
    for axis in range(4):
        joint_q[first_q + 3 + axis] = r[axis]
    for axis in range(6):
        joint_qd[first_qd + axis] = 0.0


@wp.kernel
def reset_worlds_kernel(
    # Scene:
    layout: LayoutData,
    catalog: CatalogData,
    drop: DropData,
    # State:
    phase: wp.array[int],
    # Out:
    variant_out: wp.array[int],
    joint_q_out: wp.array[float],
    joint_qd_out: wp.array[float],
    joint_f_out: wp.array[float],
    restarted_out: wp.array[wp.bool],
    progress_out: wp.array[wp.vec4i],
    stuck_out: wp.array2d[int],
):
    """Worlds that start, and worlds without an episode: empty all slots, park them, and send the gripper home.

    A parked body's weight is cancelled by a force m g. Elsewhere variants are -1: nothing changes.
    """
    world = wp.tid()
    fresh = phase[world] == Phase.START or phase[world] == Phase.IDLE or phase[world] == Phase.OVER
    restarted_out[world] = fresh
    body = world * layout.bodies + layout.gripper_bodies
    for s in range(layout.slots):
        variant_out[body + s] = -1
    if not fresh:
        return
    # Ticks since the drop, ticks at rest, re-drops, guide walls standing.
    progress_out[world] = wp.vec4i(0, 0, 0, 1)
    for instance in range(layout.instances):
        stuck_out[world, instance] = 0
    q = world * layout.coords
    qd = world * layout.dofs
    for axis in range(layout.gripper_dofs):
        joint_q_out[q + axis] = 0.0
        joint_qd_out[qd + axis] = 0.0
    for axis in range(3):
        joint_q_out[q + axis] = drop.gripper_home[axis]
    parked = wp.transform(wp.vec3(0.0, 0.0, PARKED_HEIGHT), wp.quat_identity())
    for s in range(layout.slots):
        variant_out[body + s] = catalog.empty_single
        if s >= layout.single_slots:
            variant_out[body + s] = catalog.empty_compound
        first = qd + layout.gripper_dofs + 6 * s
        write_body(joint_q_out, joint_qd_out, q + layout.gripper_dofs + 7 * s, first, parked)
        for axis in range(6):
            joint_f_out[first + axis] = 0.0
        joint_f_out[first + 2] = catalog.empty_mass * drop.gravity


@wp.kernel
def drop_objects_kernel(
    # Scene:
    seed: wp.uint64,
    layout: LayoutData,
    catalog: CatalogData,
    drop: DropData,
    # State:
    arrangement_id: wp.array[wp.vec2i],
    catalog_index: wp.array2d[int],
    body_slot: wp.array2d[int],
    phase_inout: wp.array[int],
    # Out:
    variant_out: wp.array[int],
    joint_q_out: wp.array[float],
    joint_qd_out: wp.array[float],
    joint_f_out: wp.array[float],
):
    """Give slots their objects and stack these above the tote in a column of bounding spheres, at rest.

    Height of sphere i: z_i = rim + r_i + Σ_{j<i} (2 r_j + clearance).
    """
    world = wp.tid()
    if phase_inout[world] != Phase.START:
        return
    body = world * layout.bodies + layout.gripper_bodies
    key = stream_key(seed, arrangement_id[world][0], arrangement_id[world][1], Stream.DROP)
    height = drop.rim_height
    for instance in range(layout.instances):
        e = catalog_index[world, instance]
        if e >= 0:
            s = body_slot[world, instance]
            variant_out[body + s] = catalog.variant[e]
            q = world * layout.coords + layout.gripper_dofs + 7 * s
            qd = world * layout.dofs + layout.gripper_dofs + 6 * s
            write_body(joint_q_out, joint_qd_out, q, qd, drop_pose(key, instance, catalog.radius[e], height + catalog.radius[e], drop))
            joint_f_out[qd + 2] = 0.0
            height += 2.0 * catalog.radius[e] + drop.clearance
    phase_inout[world] = Phase.SETTLE
