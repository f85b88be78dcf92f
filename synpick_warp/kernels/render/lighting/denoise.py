"""Variance-guided denoiser: the widest of three kernels (16², 8², 4² coarse pixels) whose mean agrees with the narrower ones within noise.

Visibility ratios (see `paths.coarse`) are filtered in three passes: joint bilateral means over blocks, choice of the kernel, smoothing.
`upsampling` then interpolates them at full resolution.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.coarse_grid import (
    PLANE_TOLERANCE,
    CoarseGrid,
    Guide,
    flat_index,
    middle_pixel,
    surface_depth,
    surface_normal,
    surface_segment,
)
from synpick_warp.kernels.render.lighting.color import luminance, pack_half3, unpack_half3
from synpick_warp.kernels.render.lighting.paths.light import CoarseLight, pack_light, unpack_half2
from synpick_warp.kernels.render.lighting.plane_distance import Plane, plane_distance, tangent_plane
from synpick_warp.kernels.render.lighting.tile_flags import (
    BLOCK_STAGE,
    CHOICE_STAGE,
    LIGHT_STAGE,
    RATIO_STAGE,
    TileFlags,
    skips,
    tile_corner,
)
from synpick_warp.kernels.render.lighting.unoccluded import visibility_ratio
from synpick_warp.kernels.render.lighting.upsampling import RatioImages, RatioRecord, Ratios, add_ratios, pack_ratios
from synpick_warp.kernels.render.visibility.camera import (
    TILE_HEIGHT,
    TILE_WIDTH,
    AnyCameras,
    AnyViews,
    ImageGrid,
    clamp_index,
    tile_pixel,
)
from synpick_warp.kernels.render.visibility.damage import any_flagged
from synpick_warp.kernels.render.visibility.records import read_record, read_uint64, write_record, write_uint64
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.tuning import CHOICE_REGISTERS, FILTER_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})

BLOCK = wp.constant(4)
"""Width of the narrow kernel, a block [coarse pixels]."""
BLOCKS = wp.constant(4)
"""Width of the wide kernel [blocks]."""
HALF_BLOCK = wp.constant(int(BLOCK) // 2)
"""Largest offset of a block's coarse pixels [coarse pixels]. Those at this offset count half, since the next block has them, too: so blocks
are centered on their coarse pixel, and tile the image."""
BlockRow = wp.types.vector(length=2 * int(HALF_BLOCK) + 1, dtype=wp.float32)
"""Weights of a row of a block."""
BLOCKS_START = wp.constant(-(int(BLOCK) * (int(BLOCKS) - 1) // 2))
"""Offset of the first block of the wide kernel [coarse pixels]."""
BORDER_VARIANCE = wp.constant(64.0 / 49.0)
"""Ratio of the variances of a mean over BLOCK² samples and over a block, whose border counts half but is shared with its neighbours."""
MEDIUM_BLOCKS = wp.constant(4.0)
"""Blocks of the medium kernel: 2 x 2."""
SAME_BODY_WEIGHT = wp.constant(0.004)
"""Bilateral weight of a coarse pixel on the same body but on another surface: it reduces noise where few pixels are similar."""


@wp.func
def any_due(flags: TileFlags, grid: ImageGrid, view: int, tile: int, reach: int) -> bool:
    """Whether new ratios are due in any tile with coarse pixels within `reach` of those of a tile."""
    row, column = tile_corner(grid, tile)
    bottom, right = row + TILE_HEIGHT - 1 + reach, column + TILE_WIDTH - 1 + reach
    return any_flagged(flags.due, grid, view, row - reach, column - reach, bottom, right)


@wp.kernel
def plan_stages_kernel(grid: ImageGrid, flags_inout: TileFlags):
    """Plan the stages of each tile of coarse pixels, so that all that the ratios of `due` tiles depend on is computed. Launched over view,
    tile of coarse pixels."""
    view, tile = wp.tid()
    stages = int(flags_inout.due[view, tile]) * RATIO_STAGE
    if any_due(flags_inout, grid, view, tile, 1):
        stages = stages | CHOICE_STAGE
    if any_due(flags_inout, grid, view, tile, 1 - BLOCKS_START):
        stages = stages | BLOCK_STAGE
    if any_due(flags_inout, grid, view, tile, 1 - BLOCKS_START + HALF_BLOCK):
        stages = stages | LIGHT_STAGE
    flags_inout.stages[view, tile] = wp.uint8(stages)


@wp.func
def coarse_plane(coarse: CoarseGrid, surface: wp.vec4, cameras: AnyCameras, view: int, row: int, column: int) -> Plane:
    """Tangent plane at a coarse pixel of packed `surface`, whose `down`, `right` and `width` are per coarse pixel."""
    pixel = middle_pixel(coarse, row, column)
    depth = surface_depth(surface)
    intrinsics = cameras.intrinsics[view]
    segment, normal = surface_segment(surface), surface_normal(surface)
    plane = tangent_plane(cameras, intrinsics, view, pixel[0], pixel[1], segment, depth, normal)
    size = float(coarse.size)
    plane.down = size * plane.down
    plane.right = size * plane.right
    plane.width = size * plane.width
    return plane


@wp.func
def bilateral_weight(surface: wp.vec4, plane: Plane, down: int, right: int, stride: int) -> float:
    """Bilateral weight of a coarse pixel of packed `surface`, at offset (down, right) from the plane's own: body, plane distance, normal.

    0 on another body; SAME_BODY_WEIGHT off the plane; else that plus the 8th power of the normals' cosine. The tolerance of the plane
    distance grows with the filter's `stride` [coarse pixels]. Without branches, so that loads of several coarse pixels overlap.
    """
    distance = plane_distance(plane, down, right, surface_depth(surface))
    cosine = wp.max(wp.dot(surface_normal(surface), plane.normal), 0.0)
    square = cosine * cosine
    fourth = square * square
    weight = SAME_BODY_WEIGHT + wp.where(distance < PLANE_TOLERANCE * plane.width * float(stride), fourth * fourth, 0.0)
    return wp.where(wp.abs(surface[3]) == float(plane.segment), weight, 0.0)


@wp.struct
class KernelSum:
    """Weighted sums of `CoarseLight` over a filter kernel: occluded and unoccluded light, statistics for the noise of the
    ratios, weights.
    """

    diffuse: wp.vec3
    specular: wp.vec3
    unoccluded_diffuse: wp.vec3
    unoccluded_specular: wp.vec3
    indirect: wp.vec3
    statistic: wp.vec2
    """Weighted sums of the statistics in `pack_light`, of the diffuse and the specular visibility ratio."""
    weight: float


@wp.func
def read_light(light: CoarseLight, index: int) -> KernelSum:
    """Read a coarse pixel by its `flat_index`, as sums of weight 1."""
    diffuse = read_record(light.diffuse, index)
    specular = read_record(light.specular, index)
    a, b, c = unpack_half2(diffuse[0]), unpack_half2(diffuse[1]), unpack_half2(diffuse[2])
    d, e, f = unpack_half2(specular[0]), unpack_half2(specular[1]), unpack_half2(specular[2])
    result = KernelSum()
    result.diffuse = wp.vec3(a[0], a[1], b[0])
    result.unoccluded_diffuse = wp.vec3(b[1], c[0], c[1])
    result.specular = wp.vec3(d[0], d[1], e[0])
    result.unoccluded_specular = wp.vec3(e[1], f[0], f[1])
    result.indirect = unpack_half3(read_uint64(light.indirect, index))
    result.statistic = wp.vec2(diffuse[3], specular[3])
    result.weight = 1.0
    return result


@wp.func
def add_light(total: KernelSum, one: KernelSum, weight: float) -> KernelSum:
    """Add a coarse pixel's sums, times `weight`, to weighted sums."""
    result = KernelSum()
    result.diffuse = total.diffuse + weight * one.diffuse
    result.specular = total.specular + weight * one.specular
    result.unoccluded_diffuse = total.unoccluded_diffuse + weight * one.unoccluded_diffuse
    result.unoccluded_specular = total.unoccluded_specular + weight * one.unoccluded_specular
    result.indirect = total.indirect + weight * one.indirect
    result.statistic = total.statistic + weight * one.statistic
    result.weight = total.weight + weight
    return result


@wp.func
def row_weights(guide: Guide, plane: Plane, grid: ImageGrid, view: int, row: int, column: int, r: int, start: int, stride: int) -> wp.vec4:
    """Bilateral weights of four coarse pixels in row `r`, at column offsets `start`, `start + stride`, ...; 0 outside the image. `row` and
    `column` are those of the plane's own coarse pixel."""
    weights = wp.vec4()
    if r < 0 or r >= grid.height:
        return weights
    left = flat_index(grid, view, r, 0)
    for j in range(BLOCK):
        right = start + j * stride
        c = column + right
        weight = bilateral_weight(read_record(guide.surface, left + clamp_index(c, grid.width)), plane, r - row, right, stride)
        weights[j] = wp.where(c >= 0 and c < grid.width, weight, 0.0)
    return weights


@wp.func
def block_row_weights(guide: Guide, plane: Plane, grid: ImageGrid, view: int, row: int, column: int, down: int) -> BlockRow:
    """Weights of a row of the block around a coarse pixel, at offset `down`: bilateral, half at the block's border, 0 outside the image."""
    weights = BlockRow()
    r = row + down
    if r < 0 or r >= grid.height:
        return weights
    share = wp.where(down == -HALF_BLOCK or down == HALF_BLOCK, 0.5, 1.0)
    left = flat_index(grid, view, r, 0)
    for j in range(2 * HALF_BLOCK + 1):
        right = j - HALF_BLOCK
        c = column + right
        weight = share * bilateral_weight(read_record(guide.surface, left + clamp_index(c, grid.width)), plane, down, right, 1)
        if right == -HALF_BLOCK or right == HALF_BLOCK:
            weight *= 0.5
        weights[j] = wp.where(c >= 0 and c < grid.width, weight, 0.0)
    return weights


@kernel_of_views(cuda_max_registers=FILTER_REGISTERS)
def filter_blocks_kernel(
    coarse: CoarseGrid,
    guide: Guide,
    coarse_light: CoarseLight,
    views: AnyViews,
    flags: TileFlags,
    first: int,
    blocks_out: CoarseLight,
):
    """Narrow filter: bilateral mean over the block of 4 x 4 around each coarse pixel, and the variance of the mean visibility ratio.

    The variance of a mean is that of its samples over their effective number, (Σ w)² / Σ w². All members of `blocks_out` are written.
    Launched over view, coarse pixel (tile order, from flat index `first` on).
    """
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if skips(coarse.grid, flags, BLOCK_STAGE, view, row, column):
        return
    index = flat_index(coarse.grid, view, row, column)
    surface = read_record(guide.surface, index)
    if int(surface_segment(surface)) == Segment.NOTHING:
        return
    plane = coarse_plane(coarse, surface, views.cameras, view, row, column)
    sums = KernelSum()
    square = wp.vec2(0.0, 0.0)
    squared_weight = float(0.0)
    # This loop is not unrolled, which saves registers and raises occupancy.
    end = int(HALF_BLOCK) + 1
    for down in range(1 - end, end):
        weights = block_row_weights(guide, plane, coarse.grid, view, row, column, down)
        left = index + down * coarse.grid.width - HALF_BLOCK
        for j in range(2 * HALF_BLOCK + 1):
            weight = weights[j]
            if weight > 0.0:
                one = read_light(coarse_light, left + j)
                sums = add_light(sums, one, weight)
                square += weight * wp.cw_mul(one.statistic, one.statistic)
                squared_weight += weight * weight
    scale = 1.0 / sums.weight
    mean = scale * sums.statistic
    # Divided by the effective number of samples.
    share = squared_weight * scale * scale
    variance = share * (scale * square - wp.cw_mul(mean, mean))
    diffuse = pack_light(scale * sums.diffuse, scale * sums.unoccluded_diffuse, wp.max(variance[0], 0.0))
    specular = pack_light(scale * sums.specular, scale * sums.unoccluded_specular, wp.max(variance[1], 0.0))
    write_record(blocks_out.diffuse, index, diffuse)
    write_record(blocks_out.specular, index, specular)
    write_uint64(blocks_out.indirect, index, pack_half3(scale * sums.indirect))


@wp.func
def shrink(wide: wp.vec3, narrow: wp.vec3, variance: float) -> wp.vec3:
    """Shrinkage estimator (James and Stein, 1961): interpolates from `wide` to `narrow` where their squared difference exceeds `variance`.
    `variance` is that of `narrow`; the larger the difference is relative to it, the closer is the result to `narrow`."""
    difference = luminance(narrow) - luminance(wide)
    square = difference * difference
    if square <= variance:
        return wide
    return wide + (1.0 - variance / square) * (narrow - wide)


@wp.func
def firefly_variance(wide: wp.vec3, narrow: wp.vec3, pooled: float, own: float) -> float:
    """Variance of `narrow` for the shrinkage estimator: `pooled`, or its `own` if that is larger and `narrow` is brighter than `wide`.

    This suppresses fireflies: a single bright path raises the mean of its block and the block's own variance. Blocks that are darker than
    their neighbours are mostly contact shadows, and keep the pooled variance.
    """
    if luminance(narrow) > luminance(wide):
        return wp.max(pooled, BORDER_VARIANCE * own)
    return pooled


@wp.func
def choose_ratio(
    wide: wp.vec3, medium: wp.vec3, narrow: wp.vec3, medium_weight: float, pooled: float, medium_sum: float, narrow_variance: float
) -> wp.vec3:
    """Visibility ratio of the widest kernel that agrees with the narrower ones; the medium kernel is skipped where its weight is 0. `wide`,
    `medium`, `narrow`: ratios of the three kernels. `medium_weight`: sum of the weights of the medium kernel's blocks. `pooled`: mean
    variance of a block's ratio over the wide kernel. `medium_sum`: weighted sum of the variances of the medium kernel's blocks.
    `narrow_variance`: variance of the narrow kernel's ratio."""
    result = wide
    if medium_weight > 0.0:
        result = shrink(result, medium, firefly_variance(result, medium, pooled, medium_sum / medium_weight) / MEDIUM_BLOCKS)
    return shrink(result, narrow, firefly_variance(result, narrow, pooled, narrow_variance))


@wp.func
def add_blocks(total: KernelSum, blocks: CoarseLight, middle: int, weights: wp.vec4) -> KernelSum:
    """Add a row of four blocks of the wide kernel to weighted sums; `middle` is the `flat_index` of the row's centre."""
    result = total
    for j in range(BLOCKS):
        if weights[j] > 0.0:
            result = add_light(result, read_light(blocks, middle + BLOCKS_START + j * BLOCK), weights[j])
    return result


@kernel_of_views(cuda_max_registers=CHOICE_REGISTERS)
def choose_widths_kernel(
    coarse: CoarseGrid,
    guide: Guide,
    blocks: CoarseLight,
    views: AnyViews,
    flags: TileFlags,
    variance_scale: float,
    first: int,
    ratios_out: RatioImages,
):
    """Choose the filter width: visibility ratios of the widest kernel (4 x 4, 2 x 2 or 1 block) that agrees with the narrower ones.

    Blocks of a kernel do not overlap, so the mean of n blocks has 1/n of a block's variance. A block's variance is its estimate, see
    `firefly_variance`, times `variance_scale`. Indirect light always takes the wide kernel. All members of `ratios_out` are written.
    Launched over view, coarse pixel (tile order, from flat index `first` on).
    """
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if skips(coarse.grid, flags, CHOICE_STAGE, view, row, column):
        return
    index = flat_index(coarse.grid, view, row, column)
    surface = read_record(guide.surface, index)
    if int(surface_segment(surface)) == Segment.NOTHING:
        return
    plane = coarse_plane(coarse, surface, views.cameras, view, row, column)
    # The two middle rows come first: their inner blocks are the medium kernel. The loops are not unrolled, see `filter_blocks_kernel`.
    sums = KernelSum()
    sides = wp.vec4()
    middle = int(BLOCKS_START) + BLOCK
    for down in range(middle, middle + 2 * BLOCK, BLOCK):
        weights = row_weights(guide, plane, coarse.grid, view, row, column, row + down, BLOCKS_START, BLOCK)
        sums = add_blocks(sums, blocks, index + down * coarse.grid.width, wp.vec4(0.0, weights[1], weights[2], 0.0))
        sides = wp.vec4(sides[2], sides[3], weights[0], weights[3])
    medium_weight = sums.weight
    medium_diffuse = visibility_ratio(sums.diffuse, sums.unoccluded_diffuse)
    medium_specular = visibility_ratio(sums.specular, sums.unoccluded_specular)
    medium_sum = variance_scale * sums.statistic
    for down in range(middle, middle + 2 * BLOCK, BLOCK):
        sums = add_blocks(sums, blocks, index + down * coarse.grid.width, wp.vec4(sides[0], 0.0, 0.0, sides[1]))
        sides = wp.vec4(sides[2], sides[3], 0.0, 0.0)
    for down in range(int(BLOCKS_START), 1 - BLOCKS_START, -2 * BLOCKS_START):
        weights = row_weights(guide, plane, coarse.grid, view, row, column, row + down, BLOCKS_START, BLOCK)
        sums = add_blocks(sums, blocks, index + down * coarse.grid.width, weights)
    narrow = read_light(blocks, index)
    diffuse = visibility_ratio(narrow.diffuse, narrow.unoccluded_diffuse)
    specular = visibility_ratio(narrow.specular, narrow.unoccluded_specular)
    if sums.weight <= 0.0:
        # The centres of all blocks lie on other bodies.
        ratios_out.record[view, row, column] = pack_ratios(diffuse, specular, narrow.indirect, surface)
        return
    scale = 1.0 / sums.weight
    pooled, variance = (variance_scale * scale) * sums.statistic, variance_scale * narrow.statistic
    wide = visibility_ratio(sums.diffuse, sums.unoccluded_diffuse)
    diffuse = choose_ratio(wide, medium_diffuse, diffuse, medium_weight, pooled[0], medium_sum[0], variance[0])
    wide = visibility_ratio(sums.specular, sums.unoccluded_specular)
    specular = choose_ratio(wide, medium_specular, specular, medium_weight, pooled[1], medium_sum[1], variance[1])
    ratios_out.record[view, row, column] = pack_ratios(diffuse, specular, scale * sums.indirect, surface)


@kernel_of_views
def smooth_ratios_kernel(
    coarse: CoarseGrid,
    guide: Guide,
    ratios: RatioImages,
    views: AnyViews,
    flags: TileFlags,
    first: int,
    ratios_out: RatioImages,
):
    """Bilateral mean over 3 x 3 coarse pixels, which hides the borders between kernel widths.

    `ratios_out` keeps those of the frame before in tiles without RATIO_STAGE; its first dimension is that of the light history. Launched
    over view, coarse pixel (tile order, from flat index `first` on).
    """
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if skips(coarse.grid, flags, RATIO_STAGE, view, row, column):
        return
    history = flags.history_row[view]
    index = flat_index(coarse.grid, view, row, column)
    surface = read_record(guide.surface, index)
    if int(surface_segment(surface)) == Segment.NOTHING:
        ratios_out.record[history, row, column] = RatioRecord()
        return
    plane = coarse_plane(coarse, surface, views.cameras, view, row, column)
    sums = Ratios()
    total = float(0.0)
    for down in range(-1, 2):
        r = row + down
        if r >= 0 and r < coarse.grid.height:
            for right in range(-1, 2):
                c = column + right
                if c >= 0 and c < coarse.grid.width:
                    weight = bilateral_weight(read_record(guide.surface, flat_index(coarse.grid, view, r, c)), plane, down, right, 1)
                    sums = add_ratios(sums, ratios.record[view, r, c], weight)
                    total += weight
    scale = 1.0 / total
    ratios_out.record[history, row, column] = pack_ratios(scale * sums.diffuse, scale * sums.specular, scale * sums.indirect, surface)
