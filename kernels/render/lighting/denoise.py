"""Variance-guided denoiser: the widest of three kernels (16², 8², 4² coarse pixels) whose mean agrees with the narrower ones within noise.

It filters visibility ratios (see `coarse_paths`) in three passes: joint bilateral means over blocks, choice of the kernel, smoothing.
`upsampling` then interpolates them at full resolution.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.coarse_grid import PLANE_TOLERANCE, CoarseGrid, Guide, middle_pixel
from synpick_warp.kernels.render.lighting.coarse_paths import CoarseLight
from synpick_warp.kernels.render.lighting.color import MIN_RADIANCE, luminance, pack_half3, unpack_half3
from synpick_warp.kernels.render.lighting.plane_distance import Plane, plane_distance, tangent_plane
from synpick_warp.kernels.render.lighting.unoccluded import visibility_ratio
from synpick_warp.kernels.render.lighting.upsampling import RatioImages, RatioRecord, Ratios, add_ratios, pack_ratios
from synpick_warp.kernels.render.visibility.camera import Cameras, Views, in_image, tile_pixel

wp.set_module_options({"enable_backward": False, "fast_math": True})

BLOCK = wp.constant(4)
"""Width of the narrow kernel, a block [coarse pixels]."""
BLOCKS = wp.constant(4)
"""Width of the wide kernel [blocks]."""
MEDIUM_BLOCKS = wp.constant(4.0)
"""Blocks of the medium kernel: 2 x 2."""
SAME_BODY_WEIGHT = wp.constant(0.02)
"""Bilateral weight of a coarse pixel on the same body but on another surface: it reduces noise where few pixels are similar."""


@wp.func
def coarse_plane(coarse: CoarseGrid, guide: Guide, intrinsics: wp.vec4, view: int, row: int, column: int) -> Plane:
    """Tangent plane at a coarse pixel, whose `down`, `right` and `width` are per coarse pixel."""
    pixel = middle_pixel(coarse, row, column)
    depth = guide.depth[view, row, column]
    plane = tangent_plane(intrinsics, pixel[0], pixel[1], guide.segment[view, row, column], depth, guide.normal[view, row, column])
    size = float(coarse.size)
    plane.down = size * plane.down
    plane.right = size * plane.right
    plane.width = size * plane.width
    return plane


@wp.func
def bilateral_weight(guide: Guide, plane: Plane, view: int, row: int, column: int, down: int, right: int, stride: int) -> float:
    """Bilateral weight of the coarse pixel at (row, column), at offset (down, right) from the plane's own: body, plane distance, normal.

    0 on another body; SAME_BODY_WEIGHT off the plane; else that plus the 8th power of the normals' cosine. The tolerance of the plane
    distance grows with the filter's `stride` [coarse pixels].
    """
    if guide.segment[view, row, column] != plane.segment:
        return 0.0
    weight = SAME_BODY_WEIGHT
    if plane_distance(plane, down, right, guide.depth[view, row, column]) < PLANE_TOLERANCE * plane.width * float(stride):
        cosine = wp.max(wp.dot(guide.normal[view, row, column], plane.normal), 0.0)
        square = cosine * cosine
        weight += square * square * square * square
    return weight


@wp.struct
class KernelSum:
    """Weighted sums of `CoarseLight` over a filter kernel."""

    diffuse: wp.vec3
    specular: wp.vec3
    unoccluded_diffuse: wp.vec3
    unoccluded_specular: wp.vec3
    indirect: wp.vec3
    weight: float


@wp.func
def read_light(light: CoarseLight, view: int, row: int, column: int) -> KernelSum:
    """One coarse pixel, with weight 1."""
    result = KernelSum()
    result.diffuse = unpack_half3(light.diffuse[view, row, column])
    result.specular = unpack_half3(light.specular[view, row, column])
    result.unoccluded_diffuse = unpack_half3(light.unoccluded_diffuse[view, row, column])
    result.unoccluded_specular = unpack_half3(light.unoccluded_specular[view, row, column])
    result.indirect = unpack_half3(light.indirect[view, row, column])
    result.weight = 1.0
    return result


@wp.func
def add_light(total: KernelSum, one: KernelSum, weight: float) -> KernelSum:
    """Add one coarse pixel to the sums."""
    result = KernelSum()
    result.diffuse = total.diffuse + weight * one.diffuse
    result.specular = total.specular + weight * one.specular
    result.unoccluded_diffuse = total.unoccluded_diffuse + weight * one.unoccluded_diffuse
    result.unoccluded_specular = total.unoccluded_specular + weight * one.unoccluded_specular
    result.indirect = total.indirect + weight * one.indirect
    result.weight = total.weight + weight
    return result


@wp.func
def luminance_ratio(light: wp.vec3, unoccluded: wp.vec3) -> float:
    """Ratio of luminances; unoccluded light is 0 only if the whole map is black."""
    return luminance(light) / wp.max(luminance(unoccluded), MIN_RADIANCE)


@wp.kernel
def filter_blocks_kernel(
    # Scene:
    cameras: Cameras,
    coarse: CoarseGrid,
    # In:
    guide: Guide,
    coarse_light: CoarseLight,
    views: Views,
    first: int,
    # Out:
    blocks_out: CoarseLight,
):
    """Narrow filter: bilateral mean over the 4 x 4 block around each coarse pixel, and the variance of the mean visibility ratio.

    The variance of a mean is that of its samples over their effective number, (Σ w)² / Σ w². All members of `blocks_out` are written.
    """
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if not in_image(coarse.grid, row, column):
        return
    if int(guide.segment[view, row, column]) == Segment.NOTHING:
        return
    plane = coarse_plane(coarse, guide, cameras.intrinsics[views.camera[view]], view, row, column)
    sums = KernelSum()
    mean = wp.vec2(0.0, 0.0)
    square = wp.vec2(0.0, 0.0)
    squared_weight = float(0.0)
    for i in range(BLOCK):
        down = i - BLOCK // 2
        r = row + down
        if r >= 0 and r < coarse.grid.height:
            for j in range(BLOCK):
                right = j - BLOCK // 2
                c = column + right
                if c >= 0 and c < coarse.grid.width:
                    weight = bilateral_weight(guide, plane, view, r, c, down, right, 1)
                    if weight > 0.0:
                        one = read_light(coarse_light, view, r, c)
                        sums = add_light(sums, one, weight)
                        d = luminance_ratio(one.diffuse, one.unoccluded_diffuse)
                        s = luminance_ratio(one.specular, one.unoccluded_specular)
                        mean += weight * wp.vec2(d, s)
                        square += weight * wp.vec2(d * d, s * s)
                        squared_weight += weight * weight
    total = sums.weight
    blocks_out.diffuse[view, row, column] = pack_half3(sums.diffuse / total)
    blocks_out.specular[view, row, column] = pack_half3(sums.specular / total)
    blocks_out.unoccluded_diffuse[view, row, column] = pack_half3(sums.unoccluded_diffuse / total)
    blocks_out.unoccluded_specular[view, row, column] = pack_half3(sums.unoccluded_specular / total)
    blocks_out.indirect[view, row, column] = pack_half3(sums.indirect / total)
    mean = mean / total
    variance = square / total - wp.cw_mul(mean, mean)
    count = total * total / squared_weight
    blocks_out.variance[view, row, column] = wp.vec2(wp.max(variance[0], 0.0), wp.max(variance[1], 0.0)) / count


@wp.func
def shrink(wide: wp.vec3, narrow: wp.vec3, variance: float) -> wp.vec3:
    """Shrinkage estimator: `wide`, moved towards `narrow` as far as their squared difference exceeds the `variance` of `narrow`."""
    difference = luminance(narrow) - luminance(wide)
    square = difference * difference
    if square <= variance:
        return wide
    return wide + (1.0 - variance / square) * (narrow - wide)


@wp.kernel
def choose_widths_kernel(
    # Scene:
    cameras: Cameras,
    coarse: CoarseGrid,
    # In:
    guide: Guide,
    blocks: CoarseLight,
    views: Views,
    variance_scale: float,
    first: int,
    # Out:
    ratios_out: RatioImages,
):
    """Choose the filter width: visibility ratios of the widest kernel (4 x 4, 2 x 2 or 1 block) that agrees with the narrower ones.

    Blocks of a kernel do not overlap, so a mean over n of them has 1/n of a block's variance. That is the estimated variance times
    `variance_scale`. Indirect light always takes the wide kernel. All members of `ratios_out` are written.
    """
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if not in_image(coarse.grid, row, column):
        return
    segment = guide.segment[view, row, column]
    if int(segment) == Segment.NOTHING:
        return
    depth = guide.depth[view, row, column]
    plane = coarse_plane(coarse, guide, cameras.intrinsics[views.camera[view]], view, row, column)
    wide = KernelSum()
    medium = KernelSum()
    variance = wp.vec2(0.0, 0.0)
    for i in range(BLOCKS):
        down = i * BLOCK - BLOCK * (BLOCKS - 1) // 2
        r = row + down
        if r >= 0 and r < coarse.grid.height:
            for j in range(BLOCKS):
                right = j * BLOCK - BLOCK * (BLOCKS - 1) // 2
                c = column + right
                if c >= 0 and c < coarse.grid.width:
                    weight = bilateral_weight(guide, plane, view, r, c, down, right, BLOCK)
                    if weight > 0.0:
                        block = read_light(blocks, view, r, c)
                        wide = add_light(wide, block, weight)
                        variance += weight * blocks.variance[view, r, c]
                        if (i == 1 or i == 2) and (j == 1 or j == 2):
                            medium = add_light(medium, block, weight)
    narrow = read_light(blocks, view, row, column)
    narrow_diffuse = visibility_ratio(narrow.diffuse, narrow.unoccluded_diffuse)
    narrow_specular = visibility_ratio(narrow.specular, narrow.unoccluded_specular)
    if wide.weight <= 0.0:
        # The middles of all blocks may lie off the body.
        ratios_out.record[view, row, column] = pack_ratios(narrow_diffuse, narrow_specular, narrow.indirect, depth, segment)
        return
    variance = variance_scale * variance / wide.weight
    diffuse = visibility_ratio(wide.diffuse, wide.unoccluded_diffuse)
    specular = visibility_ratio(wide.specular, wide.unoccluded_specular)
    if medium.weight > 0.0:
        diffuse = shrink(diffuse, visibility_ratio(medium.diffuse, medium.unoccluded_diffuse), variance[0] / MEDIUM_BLOCKS)
        specular = shrink(specular, visibility_ratio(medium.specular, medium.unoccluded_specular), variance[1] / MEDIUM_BLOCKS)
    diffuse = shrink(diffuse, narrow_diffuse, variance[0])
    specular = shrink(specular, narrow_specular, variance[1])
    ratios_out.record[view, row, column] = pack_ratios(diffuse, specular, wide.indirect / wide.weight, depth, segment)


@wp.kernel
def smooth_ratios_kernel(
    # Scene:
    cameras: Cameras,
    coarse: CoarseGrid,
    # In:
    guide: Guide,
    ratios: RatioImages,
    views: Views,
    first: int,
    # Out:
    ratios_out: RatioImages,
):
    """Bilateral mean over 3 x 3 coarse pixels, which hides the borders between kernel widths. All members of `ratios_out` are written."""
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if not in_image(coarse.grid, row, column):
        return
    segment = guide.segment[view, row, column]
    if int(segment) == Segment.NOTHING:
        ratios_out.record[view, row, column] = RatioRecord()
        return
    plane = coarse_plane(coarse, guide, cameras.intrinsics[views.camera[view]], view, row, column)
    sums = Ratios()
    total = float(0.0)
    for down in range(-1, 2):
        r = row + down
        if r >= 0 and r < coarse.grid.height:
            for right in range(-1, 2):
                c = column + right
                if c >= 0 and c < coarse.grid.width:
                    weight = bilateral_weight(guide, plane, view, r, c, down, right, 1)
                    sums = add_ratios(sums, ratios.record[view, r, c], weight)
                    total += weight
    depth = guide.depth[view, row, column]
    ratios_out.record[view, row, column] = pack_ratios(sums.diffuse / total, sums.specular / total, sums.indirect / total, depth, segment)
