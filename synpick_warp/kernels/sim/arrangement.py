"""Episode start: assign episodes to worlds, sample mode, bin, objects and light."""

import warp as wp

from synpick_warp.codes import Ending, Look, LookKind, LookPart, Mode, Phase, Stream
from synpick_warp.kernels.distributions import LookTable, draw_look, look_key
from synpick_warp.kernels.rng import TAU, pixel_key, stream_key, uniform, uniform_index
from synpick_warp.kernels.sim.endings import delivers
from synpick_warp.kernels.state import Worlds
from synpick_warp.kernels.structs import BinData, CatalogData, DropData, LayoutData, ModeData

wp.set_module_options({"enable_backward": False})

# Samples after which an arrangement without repeats counts as complete; each sample finds a new object with
# probability 1 / entries at least, so 4,096 miss one with probability e^-8 at 512 entries.
MAX_SAMPLES = wp.constant(4096)


@wp.kernel
def assign_episodes_kernel(
    # Scene:
    worlds: int,
    episodes: wp.array[int],  # (episode)
    tries: int,
    # State:
    state_inout: Worlds,
):
    """Assign episodes to free worlds in order: the next of `episodes`, or the same one again if its arrangement is to be resampled.

    `arrangement_id` receives (episode index, arrangement index): the arrangement index counts the resamples of an episode, up to
    `tries` - 1; -1, 0 stands for no episode. Phases become START or IDLE. A single thread (dim 1) loops over the worlds, so that
    worlds receive episodes in order.
    """
    following = state_inout.next_episode[0]
    for world in range(worlds):
        phase = state_inout.phase[world]
        episode = state_inout.arrangement_id[world][0]
        arrangement = state_inout.arrangement_id[world][1]
        resample = phase == Phase.OVER and not delivers(state_inout.ending[world]) and arrangement + 1 < tries
        if resample:
            state_inout.arrangement_id[world] = wp.vec2i(episode, arrangement + 1)
            state_inout.phase[world] = Phase.START
        elif phase == Phase.OVER or phase == Phase.EMPTY:
            if following < episodes.shape[0]:
                state_inout.arrangement_id[world] = wp.vec2i(episodes[following], 0)
                state_inout.phase[world] = Phase.START
                following += 1
            else:
                state_inout.arrangement_id[world] = wp.vec2i(-1, 0)
                state_inout.phase[world] = Phase.IDLE
        if phase == Phase.OVER or phase == Phase.EMPTY:
            state_inout.ending[world] = Ending.RUNNING
    state_inout.next_episode[0] = following


@wp.kernel
def free_idle_worlds_kernel(state_inout: Worlds):
    """Free the worlds that are idle: their phases become EMPTY, for `assign_episodes_kernel`. Launched over world."""
    world = wp.tid()
    if state_inout.phase[world] == Phase.IDLE:
        state_inout.phase[world] = Phase.EMPTY


@wp.kernel
def sample_modes_kernel(
    # Scene:
    seed: wp.uint64,
    modes: wp.array[ModeData],  # (split)
    # State:
    state_inout: Worlds,
):
    """Sample the mode of starting episodes: PICK if u < p, else TARGET if u < p + t, else MOVE, with fractions p and t of the modes; all
    may be STILL instead.

    The fractions are those of the episode's split; splits are sorted by first episode. u is the first sample of the stream (seed, episode,
    0, Stream.MODE): a resampled arrangement of the episode has the same mode. In a round robin of n episodes, episode i of the split has
    the midpoint of stratum i mod n instead: u = (i mod n + 1/2) / n. Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.START:
        return
    episode = state_inout.arrangement_id[world][0]
    split = int(0)
    for index in range(1, modes.shape[0]):
        if episode >= modes[index].first:
            split = index
    mode = modes[split]
    u = uniform(stream_key(seed, episode, 0, Stream.MODE), 0)
    if mode.cycle > 0:
        u = (float((episode - mode.first) % mode.cycle) + 0.5) / float(mode.cycle)
    if mode.still == 1:
        state_inout.mode[world] = Mode.STILL
    elif u < mode.pick_share:
        state_inout.mode[world] = Mode.PICK
    elif u < mode.pick_or_target_share:
        state_inout.mode[world] = Mode.TARGET
    else:
        state_inout.mode[world] = Mode.MOVE


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
    """True if an object of this volume may be drawn: with `exceed` if it alone is within the budget, else with the total before it [m³]."""
    return wp.where(drop.exceed == 1, volume, total + volume) <= drop.volume


@wp.func
def assign_slots(layout: LayoutData, catalog: CatalogData, state: Worlds, world: int, first: int, count: int) -> bool:
    """Assign the next free body slot of its class to each instance from `first` to before `count`; False: some have none."""
    singles = int(0)
    compounds = int(0)
    for instance in range(count):
        compound = catalog.compound[state.catalog_index[world, instance]]
        if instance >= first:
            slot = singles
            if compound == 1:
                slot = layout.single_slots + compounds
            state.body_slot[world, instance] = slot
        compounds += compound
        singles += 1 - compound
    return singles <= layout.single_slots and compounds <= layout.slots - layout.single_slots


@wp.func
def draw_counted(catalog: CatalogData, key: wp.uint64, catalog_index: wp.array2d[int], world: int) -> int:
    """Draw the number of each object, and their order (Fisher and Yates, 1938); returns the number of objects.

    Samples 0 to E - 1 are the numbers, uniform from least to most, of E objects; sample E + i swaps instance i with one up to it.
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
def sample_objects_kernel(seed: wp.uint64, layout: LayoutData, catalog: CatalogData, drop: DropData, state_inout: Worlds):
    """Sample objects up to a volume budget V: with `exceed` until Σ volume ≥ V, else while Σ volume ≤ V. Launched over world.

    An object larger than V is resampled; without `exceed`, after the first one, it ends the draw. Where numbers of objects are set, these
    are drawn instead. `catalog_index` receives the objects (-1: none), `body_slot` the next free slot of their class; without one the
    episode ends (ARRANGEMENT_OVERFLOW).
    """
    world = wp.tid()
    phase = state_inout.phase[world]
    if phase != Phase.START and phase != Phase.IDLE:
        return
    clear_catalog_indices(state_inout.catalog_index, world, layout.instances)
    if phase == Phase.IDLE:
        return
    key = stream_key(seed, state_inout.arrangement_id[world][0], state_inout.arrangement_id[world][1], Stream.OBJECTS)
    repeats = wp.where(state_inout.mode[world] == Mode.MOVE, drop.move_repeats, drop.pick_repeats)
    count = int(0)
    total = float(0.0)
    open = catalog.counted == 0
    if not open:
        count = draw_counted(catalog, key, state_inout.catalog_index, world)
    for sample in range(MAX_SAMPLES):
        if open:
            candidate = uniform_index(key, sample, catalog.count)
            repeated = repeats == 0 and is_sampled(state_inout.catalog_index, world, count, candidate)
            fits = fits_budget(total, catalog.volume[candidate], drop)
            if drop.exceed == 0 and not repeated and not fits and count > 0:
                open = False
            if not repeated and fits:
                state_inout.catalog_index[world, count] = candidate
                total += catalog.volume[candidate]
                count += 1
            full = count == drop.objects or (repeats == 0 and count == catalog.count)
            if full or (drop.exceed == 1 and total >= drop.volume):
                open = False
    if not assign_slots(layout, catalog, state_inout, world, 0, count):
        clear_catalog_indices(state_inout.catalog_index, world, layout.instances)
        state_inout.ending[world] = Ending.ARRANGEMENT_OVERFLOW
        state_inout.phase[world] = Phase.OVER


@wp.func
def count_instances(catalog_index: wp.array2d[int], world: int, instances: int) -> int:
    """Number of a world's objects before the first gap."""
    count = int(0)
    while count < instances and catalog_index[world, count] >= 0:
        count += 1
    return count


@wp.kernel
def sample_distractors_kernel(seed: wp.uint64, layout: LayoutData, catalog: CatalogData, looks: LookTable, state_inout: Worlds):
    """Sample distractors, objects without labels, into the instances behind the sampled objects, and the next free slots.

    Their number n is drawn from the stream (seed, episode, arrangement, Stream.DISTRACTORS), then each uniformly, with repeats. Without a
    free slot the episode ends (ARRANGEMENT_OVERFLOW). Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.START:
        return
    key = stream_key(seed, state_inout.arrangement_id[world][0], state_inout.arrangement_id[world][1], Stream.DISTRACTORS)
    wanted = int(wp.rint(draw_look(looks, key, LookPart.EPISODE, Look.COUNT)[0]))
    first = count_instances(state_inout.catalog_index, world, layout.instances)
    choices = pixel_key(key, 0)
    count = wp.min(first + wanted, layout.instances)
    for instance in range(first, count):
        state_inout.catalog_index[world, instance] = catalog.count + uniform_index(choices, instance - first, catalog.distractors)
    if not assign_slots(layout, catalog, state_inout, world, first, count):
        clear_catalog_indices(state_inout.catalog_index, world, layout.instances)
        state_inout.ending[world] = Ending.ARRANGEMENT_OVERFLOW
        state_inout.phase[world] = Phase.OVER


@wp.kernel
def sample_lights_kernel(seed: wp.uint64, drop: DropData, looks: LookTable, state_inout: Worlds):
    """Sample the environment map of starting episodes, its yaw [rad] and its exposure value [EV].

    With the samples u_i of the stream (seed, episode, arrangement, Stream.LIGHT): map by u_0, yaw = 2π u_1 or, without `random_yaw`, 0,
    exposure = s (2 u_2 - 1) for a spread s; but with a distribution of its own, exposure is a look of the episode. Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.START:
        return
    key = stream_key(seed, state_inout.arrangement_id[world][0], state_inout.arrangement_id[world][1], Stream.LIGHT)
    state_inout.light[world] = uniform_index(key, 0, drop.lights)
    state_inout.light_yaw[world] = TAU * uniform(key, 1) * float(drop.random_yaw)
    state_inout.light_exposure[world] = drop.exposure_spread * (2.0 * uniform(key, 2) - 1.0)
    if looks.distribution[LookPart.EPISODE, Look.EXPOSURE].kind != LookKind.OFF:
        own = look_key(seed, state_inout.arrangement_id[world][0], LookPart.EPISODE, 0)
        state_inout.light_exposure[world] = draw_look(looks, own, LookPart.EPISODE, Look.EXPOSURE)[0]


@wp.kernel
def sample_bins_kernel(seed: wp.uint64, bins: BinData, state_inout: Worlds):
    """Sample the bin of starting episodes and its pose.

    With the samples u_i of the stream (seed, episode, arrangement, Stream.BIN): the first bin whose share exceeds u_0, offset
    from its place s (2 u_1 - 1), s (2 u_2 - 1) for half widths s, yaw = ψ + a (2 u_3 - 1) for its turn ψ. Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.START:
        return
    key = stream_key(seed, state_inout.arrangement_id[world][0], state_inout.arrangement_id[world][1], Stream.BIN)
    chosen = int(0)
    while chosen < bins.count - 1 and uniform(key, 0) >= bins.share[chosen]:
        chosen += 1
    # Not s (2 u - 1), which is -0 for a width of 0.
    x = 2.0 * bins.shift[0] * uniform(key, 1) - bins.shift[0]
    y = 2.0 * bins.shift[1] * uniform(key, 2) - bins.shift[1]
    origin = bins.origin[chosen]
    angle = bins.turn[chosen] + (2.0 * bins.yaw * uniform(key, 3) - bins.yaw)
    state_inout.bin[world] = chosen
    state_inout.bin_pose[world] = wp.transform(origin + wp.vec3(x, y, 0.0), wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle))


@wp.kernel
def reset_shapes_kernel(
    # Scene:
    shape_body: wp.array[int],  # (shape)
    first_radius: wp.array[float],  # (shape) [m]
    first_transform: wp.array[wp.transform],  # (shape) [m]
    # State:
    body_variant: wp.array[int],  # (body)
    variant: wp.array[int],  # (body)
    # Out:
    radius_inout: wp.array[float],  # (shape) [m]
    transform_inout: wp.array[wp.transform],  # (shape) [m]
):
    """Reset bounding radius and pose of the shapes of bodies that have variants and get another one to those of a new model.

    A variant sets its own shapes alone, and Newton bounds a body, for its patches of friction, by all. Launched over shape.
    """
    shape = wp.tid()
    body = shape_body[shape]
    if body >= 0:
        if body_variant[body] >= 0 and variant[body] >= 0:
            radius_inout[shape] = first_radius[shape]
            transform_inout[shape] = first_transform[shape]
