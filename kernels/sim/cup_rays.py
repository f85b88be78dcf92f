"""What the suction cup catches: rays from its tcp against the world's own objects."""

import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.kernels.rng import TAU
from synpick_warp.kernels.structs import LayoutData, PickData, SuctionData

wp.set_module_options({"enable_backward": False})

# The ray hits nothing.
MISS = wp.constant(-1.0)
# The cup's place among a world's bodies.
CUP = wp.constant(1)


@wp.struct
class SurfaceData:
    """Surfaces that the rays hit, by catalog index e: convex pieces first_piece[e] to first_piece[e + 1], planes of a piece likewise."""

    first_piece: wp.array[int]
    first_plane: wp.array[int]
    plane: wp.array[wp.vec4]
    """Outward unit normal n and d [m] in the object's frame; inside is n·x ≤ d."""
    mesh: wp.array[wp.uint64]
    """Visual meshes, read if `use_mesh` is 1."""
    use_mesh: int
    radius: wp.array[float]
    """No point of the surface is farther from the object's origin [m]."""


@wp.func
def tcp_pose(cup: wp.transform, tcp_offset: float) -> wp.transform:
    """Frame at the cup's tcp with the cup's axes; the tcp lies at (0, 0, -tcp) in the cup's frame."""
    return cup * wp.transform(wp.vec3(0.0, 0.0, -tcp_offset), wp.quat_identity())


@wp.func
def ray_start(ray: int, suction: SuctionData) -> wp.vec3:
    """Start of a ray in the tcp's frame [m]: on the circle at angle 2 π ray / rays, the first on +x."""
    angle = TAU * float(ray) / float(suction.rays)
    return wp.vec3(suction.radius * wp.cos(angle), suction.radius * wp.sin(angle), 0.0)


@wp.func
def clip_piece(start: wp.vec3, way: wp.vec3, reach: float, first: int, last: int, plane: wp.array[wp.vec4]) -> float:
    """Where the ray enters a convex piece [m], 0 if it starts inside, MISS if it does not within its reach.

    Of t in [0, reach], each half-space n·(start + t way) ≤ d leaves an interval; the ray hits where their intersection begins.
    """
    enter = float(0.0)
    leave = float(reach)
    for row in range(first, last):
        half = plane[row]
        normal = wp.vec3(half[0], half[1], half[2])
        room = half[3] - wp.dot(normal, start)
        slope = wp.dot(normal, way)
        if slope < 0.0:
            enter = wp.max(enter, room / slope)
        elif slope > 0.0:
            leave = wp.min(leave, room / slope)
        elif room < 0.0:
            return MISS
        if enter > leave:
            return MISS
    return enter


@wp.func
def cast_ray(start: wp.vec3, way: wp.vec3, reach: float, pose: wp.transform, catalog_index: int, surface: SurfaceData) -> float:
    """Distance to an object's surface along a ray given in the world [m], or MISS.

    A mesh is hit where the ray first meets a triangle, from either side: a ray that starts inside hits where it leaves.
    """
    inverse = wp.transform_inverse(pose)
    local = wp.transform_point(inverse, start)
    direction = wp.transform_vector(inverse, way)
    nearest = float(MISS)
    if surface.use_mesh != 0:
        query = wp.mesh_query_ray(surface.mesh[catalog_index], local, direction, reach)
        if query.result:
            nearest = query.t
        return nearest
    for piece in range(surface.first_piece[catalog_index], surface.first_piece[catalog_index + 1]):
        distance = clip_piece(local, direction, reach, surface.first_plane[piece], surface.first_plane[piece + 1], surface.plane)
        if distance >= 0.0 and (nearest < 0.0 or distance < nearest):
            nearest = distance
    return nearest


@wp.func
def suction_begins(phase: int, task: int, steps: int, pick: PickData) -> bool:
    """Whether the cup's time to press is up."""
    return phase == Phase.ACT and task == Task.PRESS and steps >= pick.press_steps


@wp.kernel
def count_seal_rays_kernel(
    # Scene:
    layout: LayoutData,
    pick: PickData,
    suction: SuctionData,
    surface: SurfaceData,
    # State:
    phase: wp.array[int],
    task: wp.array[int],
    steps: wp.array[int],
    catalog_index: wp.array2d[int],
    body_slot: wp.array2d[int],
    body_q: wp.array[wp.transform],
    # Out:
    hits_out: wp.array[int],
    engaged_bits_out: wp.array[wp.uint32],
):
    """Where the suction begins: how many rays hit an object, and the objects hit as bits of instances.

    Rays run from a circle at the tcp along the cup's -z, as far as they reach: x_k = tcp + r (cos a, sin a, 0), a = 2 π k / rays. Each
    catches the nearest object on its way, the first of several at the same distance. Nothing but the world's own objects stops a ray.
    """
    world = wp.tid()
    if not suction_begins(phase[world], task[world], steps[world], pick):
        return
    body = world * layout.bodies
    tcp = tcp_pose(body_q[body + CUP], suction.tcp_offset)
    way = wp.transform_vector(tcp, wp.vec3(0.0, 0.0, -1.0))
    hits = int(0)
    engaged_bits = wp.uint32(0)
    for ray in range(suction.rays):
        start = wp.transform_point(tcp, ray_start(ray, suction))
        nearest = float(MISS)
        hit = int(-1)
        for instance in range(layout.instances):
            e = catalog_index[world, instance]
            if e >= 0:
                pose = body_q[body + layout.gripper_bodies + body_slot[world, instance]]
                # No point of the ray is farther from its start than it reaches.
                if wp.length(wp.transform_get_translation(pose) - start) <= surface.radius[e] + suction.reach:
                    distance = cast_ray(start, way, suction.reach, pose, e, surface)
                    if distance >= 0.0 and (nearest < 0.0 or distance < nearest):
                        nearest = distance
                        hit = instance
        if hit >= 0:
            hits += 1
            engaged_bits = engaged_bits | (wp.uint32(1) << wp.uint32(hit))
    hits_out[world] = hits
    engaged_bits_out[world] = engaged_bits


@wp.kernel
def engage_seals_kernel(
    # Scene:
    layout: LayoutData,
    pick: PickData,
    suction: SuctionData,
    # State:
    phase: wp.array[int],
    task: wp.array[int],
    steps: wp.array[int],
    body_slot: wp.array2d[int],
    body_q: wp.array[wp.transform],
    # In:
    hits: wp.array[int],
    engaged_bits: wp.array[wp.uint32],
    # Out:
    attached_out: wp.array2d[int],
    object_in_tcp_out: wp.array2d[wp.transform],
    seal_force_out: wp.array2d[float],
    break_force_out: wp.array[float],
):
    """Where the suction begins: join every object that was engaged_bits to the tcp as it lies there, object_in_tcp = tcp⁻¹ object.

    The seals bear `good_force` if no more rays miss than are tolerated, else `poor_force`.
    """
    world, instance = wp.tid()
    if not suction_begins(phase[world], task[world], steps[world], pick):
        return
    if instance == 0:
        break_force_out[world] = wp.where(suction.rays - hits[world] <= suction.tolerated_misses, suction.good_force, suction.poor_force)
    if (engaged_bits[world] & (wp.uint32(1) << wp.uint32(instance))) == wp.uint32(0):
        return
    body = world * layout.bodies
    tcp = tcp_pose(body_q[body + CUP], suction.tcp_offset)
    pose = body_q[body + layout.gripper_bodies + body_slot[world, instance]]
    attached_out[world, instance] = 1
    object_in_tcp_out[world, instance] = wp.transform_inverse(tcp) * pose
    seal_force_out[world, instance] = 0.0
