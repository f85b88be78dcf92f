"""Lamp shadows: shadow rays to sample points of the lamps from the pixels of the shadow grid.

The sample points of neighbouring pixels are stratified, so that a filter sees the whole lamp (interleaved sampling; Keller and Heidrich,
2001): `shadow_filter` filters wide penumbrae, and `shadow_edges` traces further rays in narrow ones. On a resting surface a ray is traced
again only if a moving body may block it now, or may have blocked it in the previous frame; so its result is that of tracing all.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.coarse_grid import CoarseGrid, middle_pixel, morton_index, pack_normal
from synpick_warp.kernels.render.lighting.environment import Lights, lamp_direction, rotate_heading, unit_heading
from synpick_warp.kernels.render.lighting.history import LightHistory
from synpick_warp.kernels.render.lighting.moving_bodies import MovingBodies, rests
from synpick_warp.kernels.render.lighting.paths.tracing import PathScene
from synpick_warp.kernels.render.lighting.tile_flags import TileFlags
from synpick_warp.kernels.render.visibility.bvh_rays import RAY_OFFSET, is_blocked
from synpick_warp.kernels.render.visibility.camera import camera_ray, hit_position, in_image, tile_of, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import FAR, AnyShot, Hit, Meshes, face_normal, read_hit
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.tuning import RAY_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})

ALL_RAYS = wp.constant(0xFF)
"""Bits of all shadow rays of a pixel, at most eight."""
LAMP_STRATA = wp.constant(16)
"""Parts of a lamp, of equal irradiance; the pixels of a square of 4 x 4 send a ray to each."""
POINT_BITS = wp.constant(2)
"""Binary logarithm of the sample points of a part. The pixel's hash picks one: a single point would show as a contour."""
LAMP_POINTS = wp.constant(int(LAMP_STRATA) << int(POINT_BITS))
"""Number of a lamp's sample points; the low bits of a point's index are that of its part."""
STRATA_PERIOD = wp.constant(4)
"""Period of the parts of a lamp to which pixels send rays [pixels of the shadow grid, or pixels]."""
MIN_DIRECTION = wp.constant(1.0e-9)
"""Components of directions with a smaller magnitude are replaced by this before they divide."""
SPREAD_BITS = wp.constant(wp.uint64(0x8040201008040201))
"""Bit k of byte k."""
EVERY_BYTE = wp.constant(wp.uint64(0x0101010101010101))
"""1 in each byte."""
CARRY_BITS = wp.constant(wp.uint64(0x7F7F7F7F7F7F7F7F))
"""Added to bytes of at most 0x80, this sets their highest bit if they are not 0."""


@wp.struct
class ShadowRays:
    """Traced shadow rays on the shadow grid."""

    packed: wp.array3d[wp.uint64]
    """(view, shadow_row, shadow_column): the lamps' visibility bits, depth, segmentation id and normal, packed by `pack_rays`."""


@wp.func
def pack_last(segment: int, rays: int) -> wp.uint16:
    """Pack a segmentation id and the visibility bits of a pixel's shadow rays into the history."""
    return wp.uint16((segment << 8) | rays)


@wp.func
def pack_rays(rays: int, depth: float, segment: int, normal: int) -> wp.uint64:
    """Pack the bits of a pixel's shadow rays (1: unblocked) with segmentation id, depth [m] and packed normal of the surface. The filter
    thus reads each neighbour once. Ray j to lamp k has bit k * `Lights.lamp_rays` + j."""
    return (wp.uint64(wp.cast(depth, wp.uint32)) << wp.uint64(32)) | wp.uint64((normal << 16) | (segment << 8) | rays)


@wp.func
def rays_bits(packed: wp.uint64) -> int:
    """Visibility bits of packed shadow rays (`pack_rays`)."""
    return int(wp.uint32(packed)) & ALL_RAYS


@wp.func
def rays_segment(packed: wp.uint64) -> wp.uint8:
    """Segmentation id of packed shadow rays (`pack_rays`)."""
    return wp.uint8(wp.uint32(packed) >> wp.uint32(8))


@wp.func
def rays_normal(packed: wp.uint64) -> int:
    """Normal of packed shadow rays (`pack_rays`), packed in 8 bits by `pack_normal`."""
    return int((wp.uint32(packed) >> wp.uint32(16)) & wp.uint32(0xFF))


@wp.func
def rays_depth(packed: wp.uint64) -> float:
    """Planar depth of packed shadow rays (`pack_rays`) [m]."""
    return wp.cast(wp.uint32(packed >> wp.uint64(32)), wp.float32)


@wp.func
def spread_bits(bits: int) -> wp.uint64:
    """Spread the low eight bits over the bytes of a word: byte k is bit k, 0 or 1."""
    isolated = (wp.uint64(bits) * EVERY_BYTE) & SPREAD_BITS
    return ((isolated + CARRY_BITS) >> wp.uint64(7)) & EVERY_BYTE


@wp.func
def byte_of(packed: wp.uint64, index: int) -> int:
    """Byte `index` of a word, 0 the lowest."""
    return int(packed >> wp.uint64(8 * index)) & 0xFF


@wp.func
def hash_pixel(row: int, column: int) -> wp.uint32:
    """Hash of a pixel's position (multiply and xorshift), uniform in its upper bits."""
    x = (wp.uint32(row) * wp.uint32(0x1E3779B1)) ^ (wp.uint32(column) * wp.uint32(0x35EBCA77))
    x = (x ^ (x >> wp.uint32(15))) * wp.uint32(0x2C1B3C6D)
    x = (x ^ (x >> wp.uint32(12))) * wp.uint32(0x297A2D39)
    return x ^ (x >> wp.uint32(15))


@wp.func
def point_direction(lights: Lights, which: int, heading: wp.vec2, lamp: int, rays: int, ray: int, row: int, column: int) -> wp.vec3:
    """Stratified sampling of a lamp: unit vector, in the world, to the sample point of the ray `ray` of `rays` from a pixel to it.

    `which`: index of the environment map; `heading`: cosine and sine of the map's yaw. The part of the lamp follows from the pixel's place
    in Morton order, the point in the part from a hash of the pixel.

    Pixels that follow each other in Morton order take consecutive runs of `rays` parts of the lamp, so that a square of 4 x 4 of them,
    or of 2 x 2 with four rays each, takes all.
    """
    part = (morton_index(STRATA_PERIOD, row, column) * rays + ray) % LAMP_STRATA
    point = part + LAMP_STRATA * int(hash_pixel(row, column) >> wp.uint32(32 - POINT_BITS))
    return rotate_heading(lights.lamp_point[which, lamp, point], heading)


@wp.func
def ray_direction(lights: Lights, which: int, heading: wp.vec2, ray: int, row: int, column: int) -> wp.vec3:
    """`point_direction` of shadow ray `ray` from a pixel of the shadow grid; ray j to lamp k is ray k * `Lights.lamp_rays` + j."""
    rays = lights.lamp_rays[which]
    return point_direction(lights, which, heading, ray // rays, rays, ray % rays, row, column)


@wp.func
def meets_box(origin: wp.vec3, inverse: wp.vec3, lower: wp.vec3, upper: wp.vec3) -> bool:
    """Slab test (Kay and Kajiya, 1986): whether a ray meets an axis-aligned box; `inverse` is 1 / direction."""
    first = wp.cw_mul(lower - origin, inverse)
    second = wp.cw_mul(upper - origin, inverse)
    near = wp.max(wp.min(first, second))
    far = wp.min(wp.max(first, second))
    return far >= wp.max(near, 0.0)


@wp.func
def may_change(moving: MovingBodies, view: int, origin: wp.vec3, direction: wp.vec3) -> bool:
    """Whether a moving body may block a ray now, or may have blocked it in the previous frame. Tests the union of the moving bodies'
    bounding boxes first, then each box. `MovingBodies.count` must be above 0."""
    inverse = wp.vec3()
    for i in range(3):
        inverse[i] = 1.0 / wp.where(wp.abs(direction[i]) < MIN_DIRECTION, MIN_DIRECTION, direction[i])
    if not meets_box(origin, inverse, moving.all_lower[view], moving.all_upper[view]):
        return False
    for rank in range(moving.count[view]):
        if meets_box(origin, inverse, moving.lower[view, rank], moving.upper[view, rank]):
            return True
    return False


@wp.func
def faces_lamp(lights: Lights, which: int, heading: wp.vec2, ray: int, normal: wp.vec3) -> bool:
    """Whether the center of a shadow ray's lamp lies before a surface of unit `normal`."""
    return wp.dot(normal, lamp_direction(lights, which, ray // lights.lamp_rays[which], heading)) > 0.0


@wp.func
def visible_normal(meshes: Meshes, shot: AnyShot, view: int, hit: Hit, ray: wp.vec3) -> wp.vec3:
    """Geometric unit normal of a hit, in the world, on the side from which a `ray` comes (its direction, in the world)."""
    normal = face_normal(meshes, shot, view, hit)
    return wp.where(wp.dot(normal, ray) > 0.0, -normal, normal)


@wp.func
def is_shadowed(scene: PathScene, shot: AnyShot, view: int, position: wp.vec3, normal: wp.vec3, direction: wp.vec3) -> bool:
    """Shadow test: whether a unit `direction`, in the world, points below the surface or is blocked."""
    if wp.dot(normal, direction) <= 0.0:
        return True
    start = position + RAY_OFFSET * normal
    return is_blocked(scene.meshes, scene.table, shot.bodies, view, shot.views.instances, start, direction, FAR)


@wp.func
def last_rays(
    history: LightHistory, moving: MovingBodies, shot: AnyShot, view: int, slot: int, row: int, column: int, segment: int
) -> tuple[bool, int]:
    """Temporal reuse: (True, bits of a pixel's shadow rays in the previous frame) if these may be reused, else (False, 0). They may if the
    history contains that frame, and the pixel showed the same body, which `rests`. `slot`: row of the history."""
    if moving.holds[view] == 0:
        return False, 0
    last = int(history.shadows[slot, row, column])
    if last >> 8 != segment or not rests(moving, view, segment, shot.views.instances):
        return False, 0
    return True, last & ALL_RAYS


@wp.func
def changed_rays(
    lights: Lights, moving: MovingBodies, view: int, which: int, position: wp.vec3, heading: wp.vec2, rays: int, row: int, column: int
) -> int:
    """Bits of those of the first `rays` shadow rays that a moving body may have changed; `position` is the surface's."""
    result = int(0)
    if moving.count[view] == 0:
        return result
    for ray in range(rays):
        if may_change(moving, view, position, ray_direction(lights, which, heading, ray, row, column)):
            result |= 1 << ray
    return result


@kernel_of_views(cuda_max_registers=RAY_REGISTERS)
def trace_shadow_rays_kernel(
    scene: PathScene,
    coarse: CoarseGrid,
    shot: AnyShot,
    moving: MovingBodies,
    first: int,
    history_inout: LightHistory,
    rays_out: ShadowRays,
    flags_out: TileFlags,
):
    """Shadow rays from the middle pixels of the shadow grid, traced or reused from the last frame; writes `rays_out` and the history.
    `shadowed`, which must be 0, becomes 1 in tiles where their results or surfaces differ from the last frame's.

    Nothing is written under a map without lamps. Rays to lamps behind the surface count as unblocked. Launched over view, grid pixel.
    """
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if not in_image(coarse.grid, row, column):
        return
    lights, gbuffer, cameras = scene.lights, shot.gbuffer, shot.views.cameras
    world = shot.views.world[view]
    which = shot.snapshot.light[world]
    rays = lights.lamps[which] * lights.lamp_rays[which]
    if rays == 0:
        return
    pixel = middle_pixel(coarse, row, column)
    segment = int(gbuffer.segment[view, pixel[0], pixel[1]])
    depth = gbuffer.depth[view, pixel[0], pixel[1]]
    slot = world * history_inout.cameras + shot.views.slot[view]
    free, packed_normal = int(ALL_RAYS), int(0)
    known, last = last_rays(history_inout, moving, shot, view, slot, row, column, segment)
    if segment != Segment.NOTHING:
        camera_direction = camera_ray(cameras, view, pixel[0], pixel[1], wp.vec2(0.0, 0.0))
        position = hit_position(cameras, view, camera_direction, depth)
        heading = unit_heading(shot.snapshot.light_yaw[world])
        hit = read_hit(gbuffer, view, pixel[0], pixel[1])
        normal = visible_normal(scene.meshes, shot, view, hit, cameras.to_world[view] * camera_direction)
        packed_normal = pack_normal(wp.transpose(cameras.to_world[view]) * normal)
        traced = int(ALL_RAYS)
        if known:
            free = last
            traced = changed_rays(lights, moving, view, which, position, heading, rays, row, column)
        for ray in range(rays):
            bit = 1 << ray
            if traced & bit != 0:
                free |= bit
                if faces_lamp(lights, which, heading, ray, normal):
                    direction = ray_direction(lights, which, heading, ray, row, column)
                    if is_shadowed(scene, shot, view, position, normal, direction):
                        free -= bit
    if not known or free != last:
        flags_out.shadowed[view, tile_of(coarse.grid, row, column)] = wp.uint8(1)
    if history_inout.shadows.shape[0] > 0:
        history_inout.shadows[slot, row, column] = pack_last(segment, free)
    rays_out.packed[view, row, column] = pack_rays(free, depth, segment, packed_normal)
