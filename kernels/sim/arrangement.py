"""Episode start: assign episodes to worlds, sample mode, bin, objects and light, and stack the objects above the bin to be dropped."""

import warp as wp

from synpick_warp.codes import Ending, Look, LookKind, LookPart, Mode, Phase, Stream
from synpick_warp.kernels.distributions import LookTable, draw_look, look_key
from synpick_warp.kernels.rng import TAU, pixel_key, stream_key, uniform, uniform_index, uniform_rotation
from synpick_warp.kernels.sim.endings import delivers
from synpick_warp.kernels.structs import BinData, CatalogData, DropData, LayoutData, ModeData

wp.set_module_options({"enable_backward": False})

# Samples after which an arrangement without repeats counts as complete; each sample finds a new object with
# probability 1 / entries at least, so 4,096 miss one with probability e^-8 at 512 entries.
MAX_SAMPLES = wp.constant(4096)
# Height of unused body slots, far below everything [m].
PARKED_HEIGHT = wp.constant(-100.0)
# Samples of the random stream that one drop uses: x, y and three for the rotation.
DROP_SAMPLES = wp.constant(5)


@wp.kernel
def assign_episodes_kernel(
    # Scene:
    worlds: int,
    episodes: wp.array[int],  # (episode)
    tries: int,
    # State:
    arrangement_id_inout: wp.array[wp.vec2i],  # (world)
    phase_inout: wp.array[int],  # (world)
    ending_inout: wp.array[int],  # (world)
    next_episode_inout: wp.array[int],  # (one)
):
    """Assign episodes to free worlds in order: the next of `episodes`, or the same one again if its arrangement is to be resampled.

    `arrangement_id` receives (episode index, arrangement index): the arrangement index counts the resamples of an episode, up to
    `tries` - 1; -1, 0 stands for no episode. Phases become START or IDLE. A single thread (dim 1) loops over the worlds, so that
    worlds receive episodes in order.
    """
    following = next_episode_inout[0]
    for world in range(worlds):
        phase = phase_inout[world]
        episode = arrangement_id_inout[world][0]
        arrangement = arrangement_id_inout[world][1]
        resample = phase == Phase.OVER and not delivers(ending_inout[world]) and arrangement + 1 < tries
        if resample:
            arrangement_id_inout[world] = wp.vec2i(episode, arrangement + 1)
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
    modes: wp.array[ModeData],  # (split)
    # State:
    arrangement_id: wp.array[wp.vec2i],  # (world)
    phase: wp.array[int],  # (world)
    # Out:
    mode_out: wp.array[int],  # (world)
):
    """Sample the mode of starting episodes: PICK if u < p, else TARGET if u < p + t, else MOVE, with fractions p and t of the modes.

    The fractions are those of the episode's split; splits are sorted by first episode. u is the first sample of the stream (seed, episode,
    0, Stream.MODE): a resampled arrangement of the episode has the same mode. In a round robin of n episodes, episode i of the split has
    the midpoint of stratum i mod n instead: u = (i mod n + 1/2) / n. Launched over world.
    """
    world = wp.tid()
    if phase[world] != Phase.START:
        return
    episode = arrangement_id[world][0]
    split = int(0)
    for index in range(1, modes.shape[0]):
        if episode >= modes[index].first:
            split = index
    mode = modes[split]
    u = uniform(stream_key(seed, episode, 0, Stream.MODE), 0)
    if mode.cycle > 0:
        u = (float((episode - mode.first) % mode.cycle) + 0.5) / float(mode.cycle)
    if u < mode.pick_share:
        mode_out[world] = Mode.PICK
    elif u < mode.pick_or_target_share:
        mode_out[world] = Mode.TARGET
    else:
        mode_out[world] = Mode.MOVE


@wp.func
def clear_catalog_indices(catalog_index: wp.array2d[int], world: int, instances: int):
    """Set all instances of a world to -1: no object."""
    for instance in range(instances):
        catalog_index[world, instance] = -1


@wp.func
def is_sampled(catalog_index: wp.array2d[int], world: int, count: int, candidate: int) -> bool:
    """True if the first `count` instances of a world contain the object `candidate`."""
    result = bool(False)
    for instance in range(count):
        if catalog_index[world, instance] == candidate:
            result = True
    return result


@wp.func
def fits_budget(total: float, volume: float, drop: DropData) -> bool:
    """True if an object of this volume may be drawn: with `exceed` if it alone is within the budget, else if it is with the total before it
    [m³]."""
    return wp.where(drop.exceed == 1, volume, total + volume) <= drop.volume


@wp.func
def assign_slots(
    layout: LayoutData,
    catalog: CatalogData,
    catalog_index: wp.array2d[int],
    body_slot: wp.array2d[int],
    world: int,
    first: int,
    count: int,
) -> bool:
    """Assign the next free body slot of its class to each instance from `first` to before `count`; False: some have none."""
    singles = int(0)
    compounds = int(0)
    for instance in range(count):
        compound = catalog.compound[catalog_index[world, instance]]
        if instance >= first:
            slot = singles
            if compound == 1:
                slot = layout.single_slots + compounds
            body_slot[world, instance] = slot
        compounds += compound
        singles += 1 - compound
    return singles <= layout.single_slots and compounds <= layout.slots - layout.single_slots


@wp.func
def draw_counted(catalog: CatalogData, key: wp.uint64, catalog_index: wp.array2d[int], world: int) -> int:
    """Draw the number of each object, and their order (Fisher and Yates, 1938); returns the number of objects.

    Samples 0 to E - 1 of the stream are the numbers, uniform from least to most, of E objects; sample E + i swaps instance i with one up
    to it.
    """
    count = int(0)
    for entry in range(catalog.count):
        number = catalog.least[entry] + uniform_index(key, entry, catalog.most[entry] - catalog.least[entry] + 1)
        for _copy in range(number):
            catalog_index[world, count] = entry
            count += 1
    for back in range(count - 1):
        instance = count - 1 - back
        other = uniform_index(key, catalog.count + instance, instance + 1)
        swapped = catalog_index[world, other]
        catalog_index[world, other] = catalog_index[world, instance]
        catalog_index[world, instance] = swapped
    return count


@wp.kernel
def sample_objects_kernel(
    # Scene:
    seed: wp.uint64,
    layout: LayoutData,
    catalog: CatalogData,
    drop: DropData,
    # State:
    arrangement_id: wp.array[wp.vec2i],  # (world)
    mode: wp.array[int],  # (world)
    phase_inout: wp.array[int],  # (world)
    ending_inout: wp.array[int],  # (world)
    # Out:
    catalog_index_out: wp.array2d[int],  # (world, instance)
    body_slot_out: wp.array2d[int],  # (world, instance)
):
    """Sample objects up to a volume budget V: with `exceed` until Σ volume ≥ V, else while Σ volume ≤ V. Launched over world.

    An object larger than V is resampled; without `exceed`, after the first one, it ends the draw. Where numbers of objects are set, these
    are drawn instead. `catalog_index` receives the objects (-1: none), `body_slot` the next free slot of their class; without one the
    episode ends (ARRANGEMENT_OVERFLOW).
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
    total = float(0.0)
    open = catalog.counted == 0
    if not open:
        count = draw_counted(catalog, key, catalog_index_out, world)
    for sample in range(MAX_SAMPLES):
        if open:
            candidate = uniform_index(key, sample, catalog.count)
            repeated = repeats == 0 and is_sampled(catalog_index_out, world, count, candidate)
            fits = fits_budget(total, catalog.volume[candidate], drop)
            if drop.exceed == 0 and not repeated and not fits and count > 0:
                open = False
            if not repeated and fits:
                catalog_index_out[world, count] = candidate
                total += catalog.volume[candidate]
                count += 1
            full = count == drop.objects or (repeats == 0 and count == catalog.count)
            if full or (drop.exceed == 1 and total >= drop.volume):
                open = False
    if not assign_slots(layout, catalog, catalog_index_out, body_slot_out, world, 0, count):
        clear_catalog_indices(catalog_index_out, world, layout.instances)
        ending_inout[world] = Ending.ARRANGEMENT_OVERFLOW
        phase_inout[world] = Phase.OVER


@wp.func
def count_instances(catalog_index: wp.array2d[int], world: int, instances: int) -> int:
    """Number of a world's objects before the first gap."""
    count = int(0)
    while count < instances and catalog_index[world, count] >= 0:
        count += 1
    return count


@wp.kernel
def sample_distractors_kernel(
    # Scene:
    seed: wp.uint64,
    layout: LayoutData,
    catalog: CatalogData,
    looks: LookTable,
    # State:
    arrangement_id: wp.array[wp.vec2i],  # (world)
    phase_inout: wp.array[int],  # (world)
    ending_inout: wp.array[int],  # (world)
    # Out:
    catalog_index_inout: wp.array2d[int],  # (world, instance)
    body_slot_inout: wp.array2d[int],  # (world, instance)
):
    """Sample distractors, objects without labels, into the instances behind the sampled objects, and the next free slots.

    Their number n is drawn from the stream (seed, episode, arrangement, Stream.DISTRACTORS), then each uniformly, with repeats. Without a
    free slot the episode ends (ARRANGEMENT_OVERFLOW). Launched over world.
    """
    world = wp.tid()
    if phase_inout[world] != Phase.START:
        return
    key = stream_key(seed, arrangement_id[world][0], arrangement_id[world][1], Stream.DISTRACTORS)
    wanted = int(wp.rint(draw_look(looks, key, LookPart.EPISODE, Look.COUNT)[0]))
    first = count_instances(catalog_index_inout, world, layout.instances)
    choices = pixel_key(key, 0)
    count = wp.min(first + wanted, layout.instances)
    for instance in range(first, count):
        catalog_index_inout[world, instance] = catalog.count + uniform_index(choices, instance - first, catalog.distractors)
    if not assign_slots(layout, catalog, catalog_index_inout, body_slot_inout, world, first, count):
        clear_catalog_indices(catalog_index_inout, world, layout.instances)
        ending_inout[world] = Ending.ARRANGEMENT_OVERFLOW
        phase_inout[world] = Phase.OVER


@wp.kernel
def sample_lights_kernel(
    # Scene:
    seed: wp.uint64,
    drop: DropData,
    looks: LookTable,
    # State:
    arrangement_id: wp.array[wp.vec2i],  # (world)
    phase: wp.array[int],  # (world)
    # Out:
    light_out: wp.array[int],  # (world)
    light_yaw_out: wp.array[float],  # (world) [rad]
    light_exposure_out: wp.array[float],  # (world) [EV]
):
    """Sample the environment map of starting episodes, its yaw [rad] and its exposure value [EV].

    With the samples u_i of the stream (seed, episode, arrangement, Stream.LIGHT): map by u_0, yaw = 2π u_1 or, without `random_yaw`, 0,
    exposure = s (2 u_2 - 1) for a spread s; but with a distribution of its own, exposure is a look of the episode. Launched over world.
    """
    world = wp.tid()
    if phase[world] != Phase.START:
        return
    key = stream_key(seed, arrangement_id[world][0], arrangement_id[world][1], Stream.LIGHT)
    light_out[world] = uniform_index(key, 0, drop.lights)
    light_yaw_out[world] = TAU * uniform(key, 1) * float(drop.random_yaw)
    light_exposure_out[world] = drop.exposure_spread * (2.0 * uniform(key, 2) - 1.0)
    if looks.distribution[LookPart.EPISODE, Look.EXPOSURE].kind != LookKind.OFF:
        own = look_key(seed, arrangement_id[world][0], LookPart.EPISODE, 0)
        light_exposure_out[world] = draw_look(looks, own, LookPart.EPISODE, Look.EXPOSURE)[0]


@wp.kernel
def sample_bins_kernel(
    # Scene:
    seed: wp.uint64,
    bins: BinData,
    # State:
    arrangement_id: wp.array[wp.vec2i],  # (world)
    phase: wp.array[int],  # (world)
    # Out:
    bin_out: wp.array[int],  # (world)
    bin_pose_out: wp.array[wp.transform],  # (world) [m]
):
    """Sample the bin of starting episodes and its pose.

    With the samples u_i of the stream (seed, episode, arrangement, Stream.BIN): the first bin whose share exceeds u_0, offset
    from its place s (2 u_1 - 1), s (2 u_2 - 1) for half widths s, yaw = a (2 u_3 - 1). Launched over world.
    """
    world = wp.tid()
    if phase[world] != Phase.START:
        return
    key = stream_key(seed, arrangement_id[world][0], arrangement_id[world][1], Stream.BIN)
    chosen = int(0)
    while chosen < bins.count - 1 and uniform(key, 0) >= bins.share[chosen]:
        chosen += 1
    # Not s (2 u - 1), which is -0 for a width of 0.
    x = 2.0 * bins.shift[0] * uniform(key, 1) - bins.shift[0]
    y = 2.0 * bins.shift[1] * uniform(key, 2) - bins.shift[1]
    origin = bins.origin[chosen]
    angle = 2.0 * bins.yaw * uniform(key, 3) - bins.yaw
    bin_out[world] = chosen
    bin_pose_out[world] = wp.transform(origin + wp.vec3(x, y, 0.0), wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle))


@wp.func
def choose_compartment(bins: BinData, world: int, key: wp.uint64, instance: int) -> int:
    """Sample the compartment of the world's bin that an instance is dropped into, from the stream of `Stream.COMPARTMENT`."""
    chosen = bins.chosen[world]
    first = bins.first_compartment[chosen]
    return first + uniform_index(key, instance, bins.first_compartment[chosen + 1] - first)


@wp.func
def drop_pose(
    key: wp.uint64, index: int, radius: float, height: float, spread: float, pose: wp.transform, center: wp.vec2, half: wp.vec2
) -> wp.transform:
    """Sample a drop pose at a height above the floor [m]: uniform rotation, position uniform over a fraction `spread` of an area.

    The area, about `center` in the frame of the bin at `pose`, is reduced by the object's bounding radius [m]; `index` counts the drops of
    the stream.
    """
    first = index * DROP_SAMPLES
    x = (2.0 * uniform(key, first) - 1.0) * spread * wp.max(0.0, half[0] - radius) + center[0]
    y = (2.0 * uniform(key, first + 1) - 1.0) * spread * wp.max(0.0, half[1] - radius) + center[1]
    return pose * wp.transform(wp.vec3(x, y, height), uniform_rotation(key, first + 2))


@wp.func
def largest_radius(catalog: CatalogData, catalog_index: wp.array2d[int], world: int, count: int) -> float:
    """Largest bounding radius of a world's objects [m]."""
    result = float(0.0)
    for instance in range(count):
        result = wp.max(result, catalog.radius[catalog_index[world, instance]])
    return result


@wp.func
def layer_cell(half: wp.vec2, side: float, place: int):
    """Cell of a place in layers over an area of half extents `half` [m]: index of the layer, centre of the cell and its half extents [m].

    Layers are grids of as many cells as fit that are at least `side` [m] long and wide, one at least.
    """
    columns = wp.max(1, int(2.0 * half[0] / side))
    rows = wp.max(1, int(2.0 * half[1] / side))
    cell = wp.vec2(half[0] / float(columns), half[1] / float(rows))
    index = place % (columns * rows)
    across = float(2 * (index % columns) + 1 - columns)
    along = float(2 * (index // columns) + 1 - rows)
    return place // (columns * rows), wp.vec2(across * cell[0], along * cell[1]), cell


@wp.func
def write_body(joint_q: wp.array[float], joint_qd: wp.array[float], first_q: int, first_qd: int, pose: wp.transform):
    """Write the joint coordinates of a free body at a pose [m] and clear its velocity; its joints begin at `first_q` and `first_qd`."""
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
    phase: wp.array[int],  # (world)
    # Out:
    variant_out: wp.array[int],  # (body)
    joint_q_out: wp.array[float],  # (coord) [m, rad]
    joint_qd_out: wp.array[float],  # (dof) [m/s, rad/s]
    joint_f_out: wp.array[float],  # (dof) [N, N·m]
    restarted_out: wp.array[wp.bool],  # (world_and_global)
    progress_out: wp.array[wp.vec4i],  # (world) [ticks]
    stuck_out: wp.array2d[int],  # (world, instance) [ticks]
):
    """Reset worlds in the phases START, IDLE and OVER: all body slots empty and parked, the gripper at home.

    `variant` receives each slot's empty variant, or -1 (no change) in other worlds; `restarted` is True for reset worlds. A force m g on
    each parked body cancels its weight. Launched over world.
    """
    world = wp.tid()
    fresh = phase[world] == Phase.START or phase[world] == Phase.IDLE or phase[world] == Phase.OVER
    restarted_out[world] = fresh
    body = world * layout.bodies + layout.gripper_bodies
    for slot in range(layout.slots):
        variant_out[body + slot] = -1
    if not fresh:
        return
    # Ticks since the drop, ticks at rest, re-drops, whether the guide walls stand.
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
    for slot in range(layout.slots):
        variant_out[body + slot] = catalog.empty_single
        if slot >= layout.single_slots:
            variant_out[body + slot] = catalog.empty_compound
        first = qd + layout.gripper_dofs + 6 * slot
        write_body(joint_q_out, joint_qd_out, q + layout.gripper_dofs + 7 * slot, first, parked)
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
    bins: BinData,
    # State:
    arrangement_id: wp.array[wp.vec2i],  # (world)
    catalog_index: wp.array2d[int],  # (world, instance)
    body_slot: wp.array2d[int],  # (world, instance)
    phase_inout: wp.array[int],  # (world)
    # Out:
    variant_out: wp.array[int],  # (body)
    joint_q_out: wp.array[float],  # (coord) [m, rad]
    joint_qd_out: wp.array[float],  # (dof) [m/s, rad/s]
    joint_f_out: wp.array[float],  # (dof) [N, N·m]
):
    """Assign objects to their body slots and stack them above the bin, at rest; phase becomes SETTLE. Launched over world.

    In a column of bounding spheres, sphere i has the height z_i = rim + r_i + Σ_{j<i} (2 r_j + clearance) above the floor, in whichever
    compartment. In layers, each compartment has its own, of cells as wide as the largest sphere and the clearance, and z_i = rim + r_i +
    l_i (2 max r + clearance) in layer l_i. With distractors, which are the last instances, the stack begins with a random instance and goes
    on from the last to the first, so that they lie anywhere in the pile.
    """
    world = wp.tid()
    if phase_inout[world] != Phase.START:
        return
    body = world * layout.bodies + layout.gripper_bodies
    key = stream_key(seed, arrangement_id[world][0], arrangement_id[world][1], Stream.DROP)
    places = stream_key(seed, arrangement_id[world][0], arrangement_id[world][1], Stream.COMPARTMENT)
    rim = bins.rim_height[bins.chosen[world]]
    height = rim
    count = count_instances(catalog_index, world, layout.instances)
    pitch = 2.0 * largest_radius(catalog, catalog_index, world, count) + drop.clearance
    first = int(0)
    if catalog.distractors > 0 and count > 0:
        order = stream_key(seed, arrangement_id[world][0], arrangement_id[world][1], Stream.DISTRACTORS)
        first = uniform_index(pixel_key(order, 1), 0, count)
    for place in range(count):
        instance = (first + place) % count
        index = catalog_index[world, instance]
        if index >= 0:
            slot = body_slot[world, instance]
            variant_out[body + slot] = catalog.variant[index]
            q = world * layout.coords + layout.gripper_dofs + 7 * slot
            qd = world * layout.dofs + layout.gripper_dofs + 6 * slot
            radius = catalog.radius[index]
            compartment = choose_compartment(bins, world, places, instance)
            center = bins.center[compartment]
            half = bins.half[compartment]
            bottom = height
            if drop.layers == 1:
                below = int(0)
                for other in range(place):
                    below += int(choose_compartment(bins, world, places, (first + other) % count) == compartment)
                layer, offset, cell = layer_cell(half, pitch, below)
                center = center + offset
                half = cell
                bottom = rim + float(layer) * pitch
            pose = drop_pose(key, instance, radius, bottom + radius, drop.spread, bins.pose[world], center, half)
            write_body(joint_q_out, joint_qd_out, q, qd, pose)
            joint_f_out[qd + 2] = 0.0
            height += 2.0 * radius + drop.clearance
    phase_inout[world] = Phase.SETTLE
