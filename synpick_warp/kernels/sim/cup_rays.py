"""Suction test: rays cast from a ring on each suction cup's lip decide which objects it engages, and how strong its seal is."""

import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.kernels.bitsets import pack_word
from synpick_warp.kernels.rng import TAU
from synpick_warp.kernels.state import Attempts, Motion, Seals, Worlds
from synpick_warp.kernels.structs import CupData, LayoutData, PickData, SuctionData

wp.set_module_options({"enable_backward": False})

# Ray distance that stands for no hit.
MISS = wp.constant(-1.0)
# Index of the gripper head, which has the cups, among a world's bodies; the gripper shaft ("finger") is 0.
CUP = wp.constant(1)


@wp.struct
class SurfaceData:
    """Surfaces of the catalog objects for ray casts, in their frames."""

    first_piece: wp.array[int]
    """(entry + 1): convex pieces of object e are first_piece[e] to first_piece[e + 1] - 1."""
    first_plane: wp.array[int]
    """(piece + 1): planes of piece p are first_plane[p] to first_plane[p + 1] - 1."""
    plane: wp.array[wp.vec4]
    """(plane): outward unit normal n and d [m] in the object's frame; inside is n·x ≤ d."""
    mesh: wp.array[wp.uint64]
    """(entry): ids of the visual meshes, used if `use_mesh` is 1."""
    use_mesh: int
    """1: cast against visual meshes; 0: against convex pieces."""
    radius: wp.array[float]
    """(entry): radius of the bounding sphere about the object's origin [m]."""


@wp.func
def tcp_pose(head_in_world: wp.transform, place: wp.vec3) -> wp.transform:
    """Pose of a cup's TCP frame in the world: the head's axes at `place` [m] in the head's frame."""
    return head_in_world * wp.transform(place, wp.quat_identity())


@wp.func
def ray_start(ray: int, suction: SuctionData) -> wp.vec3:
    """Origin of a ray in the TCP frame [m]: on the circle at angle 2 π ray / rays, the first on +x."""
    angle = TAU * float(ray) / float(suction.rays)
    return wp.vec3(suction.radius * wp.cos(angle), suction.radius * wp.sin(angle), 0.0)


@wp.func
def clip_piece(start: wp.vec3, direction: wp.vec3, reach: float, first: int, last: int, plane: wp.array[wp.vec4]) -> float:
    """Intersect a ray with a convex polytope (slab test; Cyrus and Beck, 1978).

    Of t in [0, reach], each half-space n·(start + t direction) ≤ d leaves an interval; the ray hits where their intersection begins.
    Returns the distance [m], 0 if the ray starts inside, MISS if there is no hit within reach.
    """
    enter = float(0.0)
    leave = float(reach)
    for row in range(first, last):
        half = plane[row]
        normal = wp.vec3(half[0], half[1], half[2])
        distance = half[3] - wp.dot(normal, start)
        slope = wp.dot(normal, direction)
        if slope < 0.0:
            enter = wp.max(enter, distance / slope)
        elif slope > 0.0:
            leave = wp.min(leave, distance / slope)
        elif distance < 0.0:
            return MISS
        if enter > leave:
            return MISS
    return enter


@wp.func
def cast_ray(start: wp.vec3, direction: wp.vec3, reach: float, pose: wp.transform, catalog_index: int, surface: SurfaceData) -> float:
    """Distance to the surface of an object at a pose, along a ray in the world's frame [m], or MISS.

    A mesh is hit at the ray's first intersection with a triangle, from either side: a ray that starts inside hits where it leaves.
    """
    inverse = wp.transform_inverse(pose)
    local = wp.transform_point(inverse, start)
    local_direction = wp.transform_vector(inverse, direction)
    nearest = float(MISS)
    if surface.use_mesh != 0:
        query = wp.mesh_query_ray(surface.mesh[catalog_index], local, local_direction, reach)
        if query.result:
            nearest = query.t
        return nearest
    for piece in range(surface.first_piece[catalog_index], surface.first_piece[catalog_index + 1]):
        distance = clip_piece(local, local_direction, reach, surface.first_plane[piece], surface.first_plane[piece + 1], surface.plane)
        if distance >= 0.0 and (nearest < 0.0 or distance < nearest):
            nearest = distance
    return nearest


@wp.func
def suction_begins(state: Worlds, attempts: Attempts, world: int, pick: PickData) -> bool:
    """True at the end of the last tick of task PRESS, when suction is switched on."""
    return state.phase[world] == Phase.ACT and attempts.task[world] == Task.PRESS and attempts.steps[world] >= pick.press_steps


@wp.func
def has_bit(bits: int, index: int) -> bool:
    """True if bit `index` is set."""
    return (bits >> index) & 1 != 0


@wp.func
def first_hit(
    start: wp.vec3,
    direction: wp.vec3,
    reach: float,
    depth: float,
    layout: LayoutData,
    surface: SurfaceData,
    world: int,
    state: Worlds,
    motion: Motion,
):
    """Distance to the first object along a ray [m] and its instance, the first of several at the same distance; -1: none.

    The ray is as long as `reach` [m], and longer by `depth` radii of the object's bounding sphere.
    """
    nearest = float(MISS)
    hit = int(-1)
    for instance in range(layout.instances):
        index = state.catalog_index[world, instance]
        if index >= 0:
            pose = motion.body_q[world * layout.bodies + layout.gripper_bodies + state.body_slot[world, instance]]
            length = reach + depth * surface.radius[index]
            # Bounding-sphere test: no point of the ray is farther from its start than its length.
            if wp.length(wp.transform_get_translation(pose) - start) <= surface.radius[index] + length:
                distance = cast_ray(start, direction, length, pose, index, surface)
                if distance >= 0.0 and (hit < 0 or distance < nearest):
                    nearest = distance
                    hit = instance
    return nearest, hit


@wp.kernel
def count_seal_rays_kernel(
    layout: LayoutData,
    pick: PickData,
    suction: SuctionData,
    cups: CupData,
    surface: SurfaceData,
    state: Worlds,
    attempts_inout: Attempts,
    motion: Motion,
    seals_inout: Seals,
):
    """Cast the suction rays where suction is switched on: `hits` receives the number of rays that hit and the cups with a good seal as
    bits, `engaged_words` the bit set of the instances that are hit, `attached` bit k for every cup k of which a ray hits the instance.

    Rays run from a circle about a cup's TCP along the cup's -z: x_k = tcp + r (cos a, sin a, 0), a = 2 π k / rays. Each engages the
    nearest object within reach, the first of several at the same distance. Only the world's own objects are tested. A seal is good if at
    most `tolerated_misses` of the cup's rays miss; with a common valve, if that holds for every cup. Launched over world.
    """
    world = wp.tid()
    if not suction_begins(state, attempts_inout, world, pick):
        return
    body = world * layout.bodies
    total = int(0)
    sealed = int(0)
    for instance in range(layout.instances):
        seals_inout.attached[world, instance] = 0
    tcp_in_world = tcp_pose(motion.body_q[body + CUP], wp.vec3(0.0, 0.0, -suction.tcp_offset))
    direction = wp.transform_vector(tcp_in_world, wp.vec3(0.0, 0.0, -1.0))
    for cup in range(cups.count):
        place = cups.place[cup]
        hits = int(0)
        for ray in range(suction.rays):
            start = wp.transform_point(tcp_in_world, ray_start(ray, suction) + wp.vec3(place[0], place[1], 0.0))
            _, hit = first_hit(start, direction, suction.reach, 0.0, layout, surface, world, state, motion)
            if hit >= 0:
                hits += 1
                seals_inout.attached[world, hit] = seals_inout.attached[world, hit] | (1 << cup)
        total += hits
        if suction.rays - hits <= suction.tolerated_misses:
            sealed = sealed | (1 << cup)
    if cups.common_valve != 0 and sealed != (1 << cups.count) - 1:
        sealed = 0
    for cup in range(cups.count):
        seals_inout.break_force[world, cup] = wp.where(has_bit(sealed, cup), suction.good_force, suction.poor_force)
    attempts_inout.hits[world] = wp.vec2i(total, sealed)
    for word in range(attempts_inout.engaged_words.shape[1]):
        attempts_inout.engaged_words[world, word] = pack_word(seals_inout.attached, state.catalog_index, world, word)


@wp.kernel
def engage_seals_kernel(
    layout: LayoutData, pick: PickData, suction: SuctionData, state: Worlds, attempts: Attempts, motion: Motion, seals_inout: Seals
):
    """Store the pose of every attached object where suction is switched on: object_in_tcp = tcp_in_world⁻¹ object_in_world.

    Seal forces begin at 0. Launched over world, instance.
    """
    world, instance = wp.tid()
    if not suction_begins(state, attempts, world, pick) or seals_inout.attached[world, instance] == 0:
        return
    body = world * layout.bodies
    tcp_in_world = tcp_pose(motion.body_q[body + CUP], wp.vec3(0.0, 0.0, -suction.tcp_offset))
    object_in_world = motion.body_q[body + layout.gripper_bodies + state.body_slot[world, instance]]
    seals_inout.object_in_tcp[world, instance] = wp.transform_inverse(tcp_in_world) * object_in_world
    seals_inout.seal_force[world, instance] = 0.0
