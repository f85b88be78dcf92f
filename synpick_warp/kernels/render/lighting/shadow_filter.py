"""Filter of lamp shadows in wide penumbrae, on the shadow grid, and a measure of their steepness, where the filter would blur edges.

The filter is centered, and has the same weight for each part of a lamp, wherever it lies: it leaves no pattern of the sample points. Where
it would blur a shadow's edge, the shadow is steep, and `shadow_edges` traces rays from its pixels.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.coarse_grid import (
    PLANE_TOLERANCE,
    CoarseGrid,
    flat_index,
    middle_pixel,
    unpack_normal,
)
from synpick_warp.kernels.render.lighting.environment import Lights, lamp_share
from synpick_warp.kernels.render.lighting.paths.tracing import PathScene
from synpick_warp.kernels.render.lighting.plane_distance import Plane, plane_distance, tangent_plane
from synpick_warp.kernels.render.lighting.shadows import (
    STRATA_PERIOD,
    ShadowRays,
    rays_bits,
    rays_depth,
    rays_normal,
    rays_segment,
    spread_bits,
    visible_normal,
)
from synpick_warp.kernels.render.visibility.camera import camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot, Meshes, read_hit
from synpick_warp.kernels.render.visibility.records import read_uint64, write_record, write_uint64
from synpick_warp.kernels.render.visibility.variants import kernel_of_views

wp.set_module_options({"enable_backward": False, "fast_math": True})

FILTER_RADIUS = wp.constant(int(STRATA_PERIOD) // 2)
"""Largest offset of the filter's taps [pixels of the shadow grid]; those at this offset count half, so that each part of a lamp, which
returns after STRATA_PERIOD pixels, has the same weight."""
STEEPNESS_DISTANCE = wp.constant(2)
"""Distance of the pixels around a pixel by which steepness is measured [pixels of the shadow grid]."""
MIN_STEEPNESS = wp.constant(0.65)
MAX_STEEPNESS = wp.constant(0.9)
"""Difference of a lamp's visible fractions on both sides of a pixel, STEEPNESS_DISTANCE away, up to which the filter is right, and from
which on rays from the pixels replace it. Between them both are blended."""
FULL_SHARE = wp.constant(0.2)
"""Share of a lamp in the light of an open surface that faces up, below which its shadow counts as less steep, since it is faint."""
MIN_SHARE = wp.constant(float(MIN_STEEPNESS) * float(FULL_SHARE))
"""Share of a lamp below which none of its shadows is steep."""
STEEPNESS_LEVELS = wp.constant(7)
"""Levels of steepness, STEEPNESS_BITS for each lamp; the highest: filtered fractions do not count."""
STEEPNESS_BITS = wp.constant(3)
MIN_COSINE = wp.constant(0.87)
"""Minimum cosine of the angle between the normals of one surface. Lamps behind a surface count as unblocked, and must not light one that
bends towards them, such as the bevel between a wall and the floor."""
MIN_SUPPORT = wp.constant(4)
"""Minimum number of the eight pixels around a pixel, STEEPNESS_DISTANCE away, on its surface; fewer have too few rays."""
EVEN_BYTES = wp.constant(wp.uint64(0x00FF00FF00FF00FF))
"""Bytes 0, 2, 4, 6, each with room for a sum in 16 bits."""
SEGMENT_BITS = wp.constant(wp.uint32(0xFF))
"""Lowest bits of a depth that a segmentation id replaces: 2^-15 of the depth, 0.06 mm at 2 m."""


@wp.struct
class LampShadows:
    """Visible fraction of each lamp and steepness of its shadow, on the shadow grid and at pixels with rays of their own. Scratch."""

    fractions: wp.array3d[wp.uint64]
    """(view, shadow_row, shadow_column): filtered visible fractions of the lamps, byte k that of lamp k in 1/255."""
    record: wp.array3d[wp.vec4]
    """(view, shadow_row, shadow_column): the same with steepness, depth and segmentation id, packed by `pack_shadows`."""
    near_edge: wp.array3d[wp.uint8]
    """(view, shadow_row, shadow_column): 1 in pixels around steep shadows and edges of surfaces, 0 elsewhere; cleared when listed."""
    edge: wp.array3d[wp.uint32]
    """(view, row, column): rays from the pixel itself at steep edges, 4 bits a lamp: 0, or 1 + the number of unblocked rays. Before
    they are traced: steepness as in `record`."""


@wp.func
def pack_shadows(fractions: wp.uint64, steepness: wp.uint32, rays: wp.uint64) -> wp.vec4:
    """Pack fractions, steepness, and the surface of packed shadow rays; the segmentation id replaces the depth's lowest bits."""
    surface = (wp.cast(rays_depth(rays), wp.uint32) & ~SEGMENT_BITS) | wp.uint32(rays_segment(rays))
    return wp.vec4(
        wp.cast(wp.uint32(fractions), wp.float32),
        wp.cast(wp.uint32(fractions >> wp.uint64(32)), wp.float32),
        wp.cast(steepness | (wp.uint32(rays_normal(rays)) << wp.uint32(24)), wp.float32),
        wp.cast(surface, wp.float32),
    )


@wp.func
def shadow_fractions(record: wp.vec4) -> wp.uint64:
    """Visible fractions of the lamps in a record of `pack_shadows`."""
    return (wp.uint64(wp.cast(record[1], wp.uint32)) << wp.uint64(32)) | wp.uint64(wp.cast(record[0], wp.uint32))


@wp.func
def shadow_steepness(record: wp.vec4) -> wp.uint32:
    """Steepness of the lamps' shadows in a record of `pack_shadows`, STEEPNESS_BITS for each from the lowest on."""
    return wp.cast(record[2], wp.uint32) & wp.uint32(0xFFFFFF)


@wp.func
def shadow_normal(record: wp.vec4) -> int:
    """Normal in a record of `pack_shadows`, packed in 8 bits by `pack_normal`."""
    return int(wp.cast(record[2], wp.uint32) >> wp.uint32(24))


@wp.func
def shadow_depth(record: wp.vec4) -> float:
    """Planar depth in a record of `pack_shadows` [m]."""
    return wp.cast(wp.cast(record[3], wp.uint32) & ~SEGMENT_BITS, wp.float32)


@wp.func
def shadow_segment(record: wp.vec4) -> wp.uint8:
    """Segmentation id in a record of `pack_shadows`."""
    return wp.uint8(wp.cast(record[3], wp.uint32) & SEGMENT_BITS)


@wp.func
def lamp_fractions(even: wp.uint64, odd: wp.uint64, weight: int, lamps: int, rays: int) -> wp.uint64:
    """Visible fractions of the lamps, byte k that of lamp k in 1/255, from weighted sums of unblocked rays. `even`: sums of the rays with
    an even index, 16 bits each. `odd`: sums of the rays with an odd index, 16 bits each. `weight`: sum of the weights. `lamps`: number of
    lamps. `rays`: rays to each lamp."""
    result = wp.uint64(0)
    samples = weight * rays
    for lamp in range(lamps):
        count = int(0)
        for ray in range(rays):
            index = lamp * rays + ray
            lanes = wp.where(index & 1 == 0, even, odd)
            count += int((lanes >> wp.uint64(16 * (index >> 1))) & wp.uint64(0xFFFF))
        result |= wp.uint64((255 * count + samples // 2) // samples) << wp.uint64(8 * lamp)
    return result


@wp.func
def grid_plane(meshes: Meshes, coarse: CoarseGrid, shot: AnyShot, view: int, row: int, column: int) -> Plane:
    """Tangent plane at the middle pixel of a pixel of the shadow grid, which must show a surface."""
    gbuffer, cameras = shot.gbuffer, shot.views.cameras
    pixel = middle_pixel(coarse, row, column)
    segment = gbuffer.segment[view, pixel[0], pixel[1]]
    depth = gbuffer.depth[view, pixel[0], pixel[1]]
    ray = cameras.to_world[view] * camera_ray(cameras, view, pixel[0], pixel[1], wp.vec2(0.0, 0.0))
    normal = visible_normal(meshes, shot, view, read_hit(gbuffer, view, pixel[0], pixel[1]), ray)
    local = wp.transpose(cameras.to_world[view]) * normal
    return tangent_plane(cameras, cameras.intrinsics[view], view, pixel[0], pixel[1], segment, depth, local)


@wp.func
def same_surface(coarse: CoarseGrid, plane: Plane, down: int, right: int, depth: float, segment: wp.uint8, normal: int) -> bool:
    """Whether a surface seen `down` rows and `right` columns of pixels from the plane's own pixel lies in it, on the same body. `normal` is
    packed by `pack_normal`."""
    near = plane_distance(plane, down, right, depth) <= PLANE_TOLERANCE * float(coarse.size) * plane.width
    return near and segment == plane.segment and wp.abs(wp.dot(unpack_normal(normal), plane.normal)) > MIN_COSINE


@wp.func
def grid_shows(coarse: CoarseGrid, rays: wp.array3d[wp.uint64], plane: Plane, pixel: wp.vec2i, view: int, row: int, column: int) -> bool:
    """Whether a pixel of the shadow grid, which may lie outside, shows the surface whose tangent plane at `pixel` is `plane`."""
    if not in_image(coarse.grid, row, column):
        return False
    packed = rays[view, row, column]
    other = middle_pixel(coarse, row, column)
    down = other[0] - pixel[0]
    right = other[1] - pixel[1]
    return same_surface(coarse, plane, down, right, rays_depth(packed), rays_segment(packed), rays_normal(packed))


@kernel_of_views
def filter_shadows_kernel(scene: PathScene, coarse: CoarseGrid, shot: AnyShot, traced: ShadowRays, first: int, shadows_out: LampShadows):
    """Tent-edged mean filter of shadow rays: `fractions` receives the visible fraction of each lamp over 5 x 5 pixels on one surface.

    Pixels count if they are on the same body and near one tangent plane. Nothing is written in views under a map without lamps and where no
    surface is visible. Launched over view, pixel of the shadow grid (tile order, from flat index `first` on).
    """
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if not in_image(coarse.grid, row, column):
        return
    lights, rays = scene.lights, traced.packed
    which = shot.snapshot.light[shot.views.world[view]]
    if lights.lamps[which] == 0 or int(rays_segment(rays[view, row, column])) == Segment.NOTHING:
        return
    plane = grid_plane(scene.meshes, coarse, shot, view, row, column)
    pixel = middle_pixel(coarse, row, column)
    even = wp.uint64(0)
    odd = wp.uint64(0)
    total = int(0)
    # Not unrolled.
    reach = int(FILTER_RADIUS)
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            if grid_shows(coarse, rays, plane, pixel, view, row + down, column + right):
                weight = wp.where(wp.abs(down) == reach, 1, 2) * wp.where(wp.abs(right) == reach, 1, 2)
                bits = spread_bits(rays_bits(rays[view, row + down, column + right]))
                even += wp.uint64(weight) * (bits & EVEN_BYTES)
                odd += wp.uint64(weight) * ((bits >> wp.uint64(8)) & EVEN_BYTES)
                total += weight
    fractions = lamp_fractions(even, odd, wp.max(total, 1), lights.lamps[which], lights.lamp_rays[which])
    write_uint64(shadows_out.fractions, flat_index(coarse.grid, view, row, column), fractions)


_CHOOSE_BYTES = """
    uint32_t result = 0;
    for (int shift = 0; shift < 32; shift += 8) {
        const uint32_t x = a & (0xFFu << shift), y = b & (0xFFu << shift);
        result |= x < y ? x : y;
    }
    return result;
"""


@wp.func_native(_CHOOSE_BYTES)
def min_bytes(a: wp.uint32, b: wp.uint32) -> wp.uint32:
    """Minimum of each of the four bytes of two words."""
    ...


@wp.func_native(_CHOOSE_BYTES.replace("x < y", "x > y"))
def max_bytes(a: wp.uint32, b: wp.uint32) -> wp.uint32:
    """Maximum of each of the four bytes of two words."""
    ...


@wp.struct
class FractionRange:
    """Minimum and maximum of the visible fractions of lamps 0 to 3 and of lamps 4 to 7, a byte for each lamp."""

    low_min: wp.uint32
    low_max: wp.uint32
    high_min: wp.uint32
    high_max: wp.uint32


@wp.func
def extend_range(range_: FractionRange, fractions: wp.uint64) -> FractionRange:
    """Range extended, lamp by lamp, to include packed visible fractions."""
    low = wp.uint32(fractions)
    high = wp.uint32(fractions >> wp.uint64(32))
    result = FractionRange()
    result.low_min = min_bytes(range_.low_min, low)
    result.low_max = max_bytes(range_.low_max, low)
    result.high_min = min_bytes(range_.high_min, high)
    result.high_max = max_bytes(range_.high_max, high)
    return result


@wp.func
def steepness_levels(lowest: int, highest: int, share: float, supported: bool) -> int:
    """Steepness of a lamp's shadow at a pixel, from 0 to STEEPNESS_LEVELS.

    It grows with the range of the visible fraction, weighted by the lamp's share. Without support it is STEEPNESS_LEVELS, unless the lamp
    is entirely visible or entirely hidden around the pixel (0). `lowest`, `highest`: extremes of the visible fraction around the pixel
    [1/255]. `share`: share of the lamp, see FULL_SHARE. `supported`: whether at least MIN_SUPPORT pixels around are on the pixel's surface.
    """
    if share < MIN_SHARE:
        return 0
    if not supported:
        return wp.where(lowest == highest and (lowest == 0 or lowest == 255), 0, STEEPNESS_LEVELS)
    difference = float(highest - lowest) / 255.0 * wp.min(share / FULL_SHARE, 1.0)
    level = (difference - MIN_STEEPNESS) / (MAX_STEEPNESS - MIN_STEEPNESS)
    return int(wp.clamp(level, 0.0, 1.0) * float(STEEPNESS_LEVELS) + 0.5)


@wp.func
def range_steepness(lights: Lights, which: int, extremes: FractionRange, supported: bool) -> wp.uint32:
    """Steepness of all lamps' shadows, STEEPNESS_BITS for each; `supported` as in `steepness_levels`."""
    steepness = wp.uint32(0)
    for lamp in range(lights.lamps[which]):
        shift = wp.uint32(8 * (lamp % 4))
        lowest = int((wp.where(lamp < 4, extremes.low_min, extremes.high_min) >> shift) & wp.uint32(0xFF))
        highest = int((wp.where(lamp < 4, extremes.low_max, extremes.high_max) >> shift) & wp.uint32(0xFF))
        level = steepness_levels(lowest, highest, lamp_share(lights, which, lamp), supported)
        steepness |= wp.uint32(level) << wp.uint32(STEEPNESS_BITS * lamp)
    return steepness


@wp.func
def mark_edges(coarse: CoarseGrid, near_edge: wp.array3d[wp.uint8], view: int, row: int, column: int, reach: int):
    """Set `near_edge` to 1 at the pixels of the shadow grid from (row - `reach`, column - `reach`) to (row + 1, column + 1). All threads
    write the same value."""
    for r in range(wp.max(row - reach, 0), wp.min(row + 2, coarse.grid.height)):
        for c in range(wp.max(column - reach, 0), wp.min(column + 2, coarse.grid.width)):
            near_edge[view, r, c] = wp.uint8(1)


@kernel_of_views
def measure_steepness_kernel(
    scene: PathScene, coarse: CoarseGrid, shot: AnyShot, traced: ShadowRays, first: int, shadows_inout: LampShadows
):
    """Steepness of each lamp's shadow, the range of its fractions over nine pixels, STEEPNESS_DISTANCE apart, on one surface.

    `record` is written. `near_edge` is set around pixels whose shadow is steep, and around those whose right and lower neighbours are not
    all on the same surface: pixels of the image between them may find no pixel of the shadow grid on their own surface. Launched over view,
    pixel of the shadow grid (tile order, from flat index `first` on).
    """
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if not in_image(coarse.grid, row, column):
        return
    lights, rays = scene.lights, traced.packed
    which = shot.snapshot.light[shot.views.world[view]]
    if lights.lamps[which] == 0:
        return
    index = flat_index(coarse.grid, view, row, column)
    if int(rays_segment(rays[view, row, column])) == Segment.NOTHING:
        write_record(shadows_inout.record, index, wp.vec4())
        mark_edges(coarse, shadows_inout.near_edge, view, row, column, 1)
        return
    plane = grid_plane(scene.meshes, coarse, shot, view, row, column)
    pixel = middle_pixel(coarse, row, column)
    own = read_uint64(shadows_inout.fractions, index)
    extremes = FractionRange(wp.uint32(own), wp.uint32(own), wp.uint32(own >> wp.uint64(32)), wp.uint32(own >> wp.uint64(32)))
    support = int(0)
    around = int(9)
    for tap in range(around):
        down = STEEPNESS_DISTANCE * (tap // 3 - 1)
        right = STEEPNESS_DISTANCE * (tap % 3 - 1)
        if grid_shows(coarse, rays, plane, pixel, view, row + down, column + right):
            extremes = extend_range(extremes, read_uint64(shadows_inout.fractions, index + down * coarse.grid.width + right))
            support += 1
    steepness = range_steepness(lights, which, extremes, support > MIN_SUPPORT)
    write_record(shadows_inout.record, index, pack_shadows(own, steepness, rays[view, row, column]))
    if steepness != wp.uint32(0):
        mark_edges(coarse, shadows_inout.near_edge, view, row, column, 1)
        return
    last_row = wp.min(row + 1, coarse.grid.height - 1)
    last_column = wp.min(column + 1, coarse.grid.width - 1)
    even = grid_shows(coarse, rays, plane, pixel, view, last_row, column) and grid_shows(coarse, rays, plane, pixel, view, row, last_column)
    if not (even and grid_shows(coarse, rays, plane, pixel, view, last_row, last_column)):
        mark_edges(coarse, shadows_inout.near_edge, view, row, column, 0)
