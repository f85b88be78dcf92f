"""Drop of an episode's objects: worlds are reset, and objects stacked above the bin, in a column or in layers."""

import warp as wp

from synpick_warp.codes import Phase, Stream
from synpick_warp.kernels.rng import TAU, pixel_key, stream_key, uniform, uniform_index, uniform_rotation
from synpick_warp.kernels.sim.arrangement import count_instances
from synpick_warp.kernels.state import Control, Motion, Worlds
from synpick_warp.kernels.structs import BinData, CatalogData, DropData, LayoutData

wp.set_module_options({"enable_backward": False})

# Height of unused body slots, far below everything [m].
PARKED_HEIGHT = wp.constant(-100.0)
# Samples of the random stream that one drop uses: x, y and three for the rotation.
DROP_SAMPLES = wp.constant(5)
# Candidate positions of a scattered object; it begins to fall at the lowest.
PLACES = wp.constant(24)


@wp.func
def choose_compartment(bins: BinData, world: int, key: wp.uint64, instance: int) -> int:
    """Sample the compartment of the world's bin that an instance is dropped into, from the stream of `Stream.COMPARTMENT`."""
    chosen = bins.chosen[world]
    first = bins.first_compartment[chosen]
    return first + uniform_index(key, instance, bins.first_compartment[chosen + 1] - first)


@wp.func
def drop_pose(
    key: wp.uint64, index: int, radius: float, height: float, spread: float, bins: BinData, world: int, center: wp.vec2, half: wp.vec2
) -> wp.transform:
    """Sample a drop pose at a height above the floor [m]: uniform rotation, position uniform over a fraction `spread` of an area.

    The area, about `center` in the frame of the world's bin, is reduced by the bounding radius [m]; `index` counts the drops of the stream.
    """
    first = index * DROP_SAMPLES
    x = (2.0 * uniform(key, first) - 1.0) * spread * wp.max(0.0, half[0] - radius) + center[0]
    y = (2.0 * uniform(key, first + 1) - 1.0) * spread * wp.max(0.0, half[1] - radius) + center[1]
    return bins.pose[world] * wp.transform(wp.vec3(x, y, height), uniform_rotation(key, first + 2))


@wp.func
def top_of_objects(layout: LayoutData, catalog: CatalogData, state: Worlds, body_q: wp.array[wp.transform], world: int) -> float:
    """Height up to which bounding spheres of a world's objects reach in the world [m]; PARKED_HEIGHT without objects."""
    result = float(PARKED_HEIGHT)
    for instance in range(layout.instances):
        index = state.catalog_index[world, instance]
        if index >= 0:
            body = world * layout.bodies + layout.gripper_bodies + state.body_slot[world, instance]
            result = wp.max(result, wp.transform_get_translation(body_q[body])[2] + catalog.radius[index])
    return result


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
def count_before(bins: BinData, world: int, key: wp.uint64, first: int, place: int, count: int) -> int:
    """Number of the instances before a place that fall into the compartment of the one there; the first place has instance `first`."""
    compartment = choose_compartment(bins, world, key, (first + place) % count)
    result = int(0)
    for other in range(place):
        result += int(choose_compartment(bins, world, key, (first + other) % count) == compartment)
    return result


@wp.func
def write_body(joint_q: wp.array[float], joint_qd: wp.array[float], first_q: int, first_qd: int, pose: wp.transform):
    """Set a free body to a pose [m], at rest: its joint coordinates begin at `first_q`, its joint velocities at `first_qd`."""
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
    layout: LayoutData, catalog: CatalogData, drop: DropData, state_inout: Worlds, motion_out: Motion, control_out: Control
):
    """Reset worlds in the phases START, IDLE and OVER: all body slots empty and parked, the gripper at home.

    `variant` receives each slot's empty variant, or -1 (no change) in other worlds; `restarted` is True for reset worlds. A force m g on
    each parked body cancels its weight. Launched over world.
    """
    world = wp.tid()
    fresh = state_inout.phase[world] == Phase.START or state_inout.phase[world] == Phase.IDLE or state_inout.phase[world] == Phase.OVER
    state_inout.restarted[world] = fresh
    body = world * layout.bodies + layout.gripper_bodies
    for slot in range(layout.slots):
        state_inout.variant[body + slot] = -1
    if not fresh:
        return
    # Ticks since the drop, ticks at rest, re-drops, whether the guide walls stand.
    state_inout.progress[world] = wp.vec4i(0, 0, 0, 1)
    for instance in range(layout.instances):
        state_inout.stuck[world, instance] = 0
    q = world * layout.coords
    qd = world * layout.dofs
    for axis in range(layout.gripper_dofs):
        motion_out.joint_q[q + axis] = 0.0
        motion_out.joint_qd[qd + axis] = 0.0
    for axis in range(3):
        motion_out.joint_q[q + axis] = drop.gripper_home[axis]
    parked = wp.transform(wp.vec3(0.0, 0.0, PARKED_HEIGHT), wp.quat_identity())
    for slot in range(layout.slots):
        state_inout.variant[body + slot] = catalog.empty_single
        if slot >= layout.single_slots:
            state_inout.variant[body + slot] = catalog.empty_compound
        first = qd + layout.gripper_dofs + 6 * slot
        write_body(motion_out.joint_q, motion_out.joint_qd, q + layout.gripper_dofs + 7 * slot, first, parked)
        for axis in range(6):
            control_out.joint_f[first + axis] = 0.0
        control_out.joint_f[first + 2] = catalog.empty_mass * drop.gravity


@wp.kernel
def drop_objects_kernel(
    seed: wp.uint64,
    layout: LayoutData,
    catalog: CatalogData,
    drop: DropData,
    bins: BinData,
    state_inout: Worlds,
    motion_out: Motion,
    control_out: Control,
):
    """Assign objects to their body slots and stack them above the bin, at rest; phase becomes SETTLE. Launched over world.

    In a column of bounding spheres, sphere i has the height z_i = rim + r_i + Σ_{j<i} (2 r_j + clearance) above the floor, in whichever
    compartment. In layers, each compartment has its own, of cells as wide as the largest sphere and the clearance, and z_i = rim + r_i +
    l_i (2 max r + clearance) in layer l_i. With distractors, which are the last instances, the stack begins with a random instance and goes
    on from the last to the first, so that they lie anywhere in the pile.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.START:
        return
    body = world * layout.bodies + layout.gripper_bodies
    key = stream_key(seed, state_inout.arrangement_id[world][0], state_inout.arrangement_id[world][1], Stream.DROP)
    places = stream_key(seed, state_inout.arrangement_id[world][0], state_inout.arrangement_id[world][1], Stream.COMPARTMENT)
    height = bins.rim_height[bins.chosen[world]]
    count = count_instances(state_inout.catalog_index, world, layout.instances)
    pitch = 2.0 * largest_radius(catalog, state_inout.catalog_index, world, count) + drop.clearance
    first = int(0)
    if catalog.distractors > 0 and count > 0:
        order = stream_key(seed, state_inout.arrangement_id[world][0], state_inout.arrangement_id[world][1], Stream.DISTRACTORS)
        first = uniform_index(pixel_key(order, 1), 0, count)
    for place in range(count):
        instance = (first + place) % count
        index = state_inout.catalog_index[world, instance]
        slot = state_inout.body_slot[world, instance]
        state_inout.variant[body + slot] = catalog.variant[index]
        q = world * layout.coords + layout.gripper_dofs + 7 * slot
        qd = world * layout.dofs + layout.gripper_dofs + 6 * slot
        radius = catalog.radius[index]
        compartment = choose_compartment(bins, world, places, instance)
        center = bins.center[compartment]
        half = bins.half[compartment]
        bottom = height
        if drop.layers == 1:
            layer, offset, cell = layer_cell(half, pitch, count_before(bins, world, places, first, place, count))
            center = center + offset
            half = cell
            bottom = bins.rim_height[bins.chosen[world]] + float(layer) * pitch
        pose = drop_pose(key, instance, radius, bottom + radius, drop.spread, bins, world, center, half)
        write_body(motion_out.joint_q, motion_out.joint_qd, q, qd, pose)
        control_out.joint_f[qd + 2] = 0.0
        height += 2.0 * radius + drop.clearance
    state_inout.phase[world] = Phase.SETTLE


@wp.func
def stands(key: wp.uint64, instance: int, upright: float) -> bool:
    """Whether an instance is turned upright, by the stream of `Stream.UPRIGHT`."""
    return uniform(key, 2 * instance) < upright


@wp.kernel
def raise_objects_kernel(seed: wp.uint64, layout: LayoutData, upright: float, state: Worlds, motion_inout: Motion):
    """Turn a fraction `upright` of the objects just dropped so that their z axis points upwards: yaw = 2π u_1 if u_0 < upright.

    The samples u are those of the stream (seed, episode, arrangement, Stream.UPRIGHT), two an instance. Launched over world, instance.
    """
    world, instance = wp.tid()
    if not state.restarted[world] or state.phase[world] != Phase.SETTLE or state.catalog_index[world, instance] < 0:
        return
    key = stream_key(seed, state.arrangement_id[world][0], state.arrangement_id[world][1], Stream.UPRIGHT)
    if not stands(key, instance, upright):
        return
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), TAU * uniform(key, 2 * instance + 1))
    first = world * layout.coords + layout.gripper_dofs + 7 * state.body_slot[world, instance] + 3
    for axis in range(4):
        motion_inout.joint_q[first + axis] = turn[axis]


@wp.func
def enclose(key: wp.uint64, instance: int, upright: float, cylinder: wp.vec3, radius: float) -> wp.vec3:
    """Vertical cylinder about a falling instance, radius, lower and upper end [m]: its own if it stands, else of its bounding sphere."""
    if stands(key, instance, upright):
        return cylinder
    return wp.vec3(radius, -radius, radius)


@wp.kernel
def scatter_objects_kernel(
    # Scene:
    seed: wp.uint64,
    layout: LayoutData,
    catalog: CatalogData,
    drop: DropData,
    bins: BinData,
    upright: float,
    cylinder: wp.array[wp.vec3],  # (body) [m]
    # State:
    state: Worlds,
    motion_inout: Motion,
):
    """Move objects that have just been dropped beside or right above each other: ballistic deposition, each at the lowest of PLACES.

    Vertical cylinders take turns from a random one. Places are uniform in the compartment's opening, less the radius, times `spread`. One
    begins `clearance` above the rim, and above all before it that are nearer than radii and `clearance`. Launched over world.
    """
    world = wp.tid()
    if not state.restarted[world] or state.phase[world] != Phase.SETTLE:
        return
    episode, arrangement = state.arrangement_id[world][0], state.arrangement_id[world][1]
    key = stream_key(seed, episode, arrangement, Stream.SCATTER)
    standing = stream_key(seed, episode, arrangement, Stream.UPRIGHT)
    compartments = stream_key(seed, episode, arrangement, Stream.COMPARTMENT)
    coords = world * layout.coords + layout.gripper_dofs
    count = count_instances(state.catalog_index, world, layout.instances)
    if count == 0:
        return
    first = uniform_index(key, 0, count)
    for turn in range(count):
        instance = (first + turn) % count
        index = state.catalog_index[world, instance]
        own = enclose(standing, instance, upright, cylinder[index], catalog.radius[index])
        chosen = choose_compartment(bins, world, compartments, instance)
        best = wp.vec3()
        for place in range(PLACES):
            sample = 1 + 2 * (instance * PLACES + place)
            x = (2.0 * uniform(key, sample) - 1.0) * drop.spread * wp.max(0.0, bins.half[chosen][0] - own[0])
            y = (2.0 * uniform(key, sample + 1) - 1.0) * drop.spread * wp.max(0.0, bins.half[chosen][1] - own[0])
            center = wp.vec3(x + bins.center[chosen][0], y + bins.center[chosen][1], bins.rim_height[bins.chosen[world]])
            point = wp.transform_point(bins.pose[world], center)
            for before in range(turn):
                other = (first + before) % count
                body = state.catalog_index[world, other]
                placed = enclose(standing, other, upright, cylinder[body], catalog.radius[body])
                q = coords + 7 * state.body_slot[world, other]
                apart = wp.length(wp.vec2(point[0] - motion_inout.joint_q[q], point[1] - motion_inout.joint_q[q + 1]))
                if apart < own[0] + placed[0] + drop.clearance:
                    point[2] = wp.max(point[2], motion_inout.joint_q[q + 2] + placed[2])
            if place == 0 or point[2] < best[2]:
                best = point
        best[2] += drop.clearance - own[1]
        for axis in range(3):
            motion_inout.joint_q[coords + 7 * state.body_slot[world, instance] + axis] = best[axis]
