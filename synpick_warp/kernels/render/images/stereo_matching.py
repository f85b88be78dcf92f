"""Stereo matching of rectified images: semi-global matching (SGM, Hirschmüller, PAMI 2008) of census-transformed images along four paths.

All costs are integers, so that no order of threads changes a result. A few views at a time are matched, each with a slot of the scratch:
its cost volume is 2 bytes a pixel and disparity, and a path is one chain of dependent steps, so that those of one view do not fill a GPU.
Penalties, windows, uniqueness and checks are those that simsense (Zhang et al., 2023) publishes for RealSense-like cameras. Fractions of
a pixel come from costs summed over a block instead of along paths: the penalties there pull disparities to whole pixels, by up to 0.25 px
(SGBM of OpenCV does so, too), while these are within 0.03 px.
"""

import warp as wp

from synpick_warp.codes import MAX_DISPARITIES
from synpick_warp.kernels.render.images.camera_effects import SensorParameters
from synpick_warp.kernels.render.visibility.camera import AnyViews, ImageGrid, clamp_index, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import MAX_COUNTS
from synpick_warp.kernels.render.visibility.variants import kernel_of_views

wp.set_module_options({"enable_backward": False})

RADIUS = wp.constant(3)
"""The windows of census transform and block have 7 x 7 pixels."""
SMALL_PENALTY = 8
"""P1: cost of a step of disparity by 1 along a path, in bits of the census."""
LARGE_PENALTY = 32
"""P2: cost of any larger step."""
CENSUS_BITS = wp.constant(24)
"""Pairs of opposite pixels in the window; the cost of a pixel without a partner in the image."""
UNIQUENESS = wp.constant(15)
"""A match must be cheaper than all others but its neighbours by this [%]."""
MAX_DIFFERENCE = wp.constant(1)
"""Largest difference between the disparities of a match from either image [px]."""
FRACTIONS = wp.constant(256)
"""Steps of sub-pixel disparity in a pixel."""
WARP = 32
"""Threads that share a path on a GPU."""
NO_MATCH = wp.constant(-1)
"""Disparity of a pixel without a match."""


@wp.struct
class MatchingScratch:
    """Scratch of matching: a slot for each view that is matched at a time."""

    census: wp.array4d[wp.uint32]
    """(slot, eye, row, column)."""
    cost: wp.array4d[wp.uint16]
    """(slot, row, column, disparity): sum of the costs of all paths."""
    right_match: wp.array3d[int]
    """(slot, row, column): index of the cheapest disparity of right images; NO_MATCH: none."""
    disparity: wp.array3d[int]
    """(slot, row, column): of left images [px/FRACTIONS]; NO_MATCH: none."""


@wp.func
def first_disparity(sensor: SensorParameters, views: AnyViews, view: int) -> int:
    """Smallest disparity that is searched in a view, that of the farthest depth [px]."""
    return int(wp.floor(views.cameras.intrinsics[view][0] * sensor.baseline / sensor.far))


@wp.kernel
def transform_census_kernel(
    # Scene:
    grid: ImageGrid,
    # In:
    left: wp.array3d[wp.uint8],  # (view, row, column)
    right: wp.array3d[wp.uint8],  # (view, row, column)
    first_view: int,
    first: int,
    # Out:
    census_out: wp.array4d[wp.uint32],  # (slot, eye, row, column)
):
    """Centre-symmetric census transform (Spangenberg et al., 2013) of both images of the views from `first_view` on.

    A bit tells which one of two opposite pixels of the window is brighter; windows end at the border. Launched over slot, eye, pixel (tile
    order, from flat index `first` on).
    """
    image, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    slot = image // 2
    eye = image % 2
    view = first_view + slot
    bits = wp.uint32(0)
    # Not unrolled.
    radius = int(RADIUS)
    for down in range(-radius, 1):
        for right_by in range(-radius, radius + 1):
            if down < 0 or right_by < 0:
                upper = clamp_index(row + down, grid.height)
                lower = clamp_index(row - down, grid.height)
                one = clamp_index(column + right_by, grid.width)
                other = clamp_index(column - right_by, grid.width)
                bits = bits << wp.uint32(1)
                if eye == 0:
                    bits |= wp.where(left[view, upper, one] > left[view, lower, other], wp.uint32(1), wp.uint32(0))
                else:
                    bits |= wp.where(right[view, upper, one] > right[view, lower, other], wp.uint32(1), wp.uint32(0))
    census_out[slot, eye, row, column] = bits


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const auto count_bits = [](unsigned bits) {{ return __popc(bits); }};
    const int lane = threadIdx.x & {WARP - 1};
    constexpr int lanes = {WARP};
#else
    const auto count_bits = [](unsigned bits) {{ return __builtin_popcount(bits); }};
    constexpr int lane = 0, lanes = 1;
#endif
    // A lane has `each` disparities in a row, `most` of them if all are searched.
    constexpr int most = {MAX_DISPARITIES} / lanes, none = 1 << 20;
    const int width = census.shape[3], height = census.shape[2], count = cost_inout.shape[3];
    const int each = (count + lanes - 1) / lanes, begin = lane * each, owned = wp::min(each, count - begin);
    const int across = direction == 0 ? 1 : direction == 1 ? -1 : 0, down = direction == 2 ? 1 : direction == 3 ? -1 : 0;
    int row = across ? line : (down > 0 ? 0 : height - 1), column = down ? line : (across > 0 ? 0 : width - 1);
    const wp::uint32* left = census.data + (size_t)slot * 2 * height * width;
    const wp::uint32* right = left + (size_t)height * width;
    int path[most], least = 0, top = begin < count ? 0 : none;
    for (int k = 0; k < most; ++k) path[k] = k < owned ? 0 : none;
    for (int step = across ? width : height; step > 0; --step, row += down, column += across) {{
        const wp::uint32 here = left[row * width + column];
        const wp::uint32* partner = right + row * width + column - lowest - begin;
        const int partners = column - lowest - begin + 1;
        wp::uint16* total = cost_inout.data + (((size_t)slot * height + row) * width + column) * count + begin;
        int before = none, after = none, next_least = none, next_top = none;
#if defined(__CUDA_ARCH__)
        before = __shfl_up_sync(~0u, top, 1);
        after = __shfl_down_sync(~0u, path[0], 1);
        if (lane == 0) before = none;
        if (lane == lanes - 1) after = none;
        #pragma unroll
        for (int k = 0; k < most; ++k) if (k < owned) {{
#else
        for (int k = 0; k < owned; ++k) {{
#endif
            const int current = path[k], upper = k + 1 < owned ? path[k + 1 < most ? k + 1 : k] : after;
            const int cost = k < partners ? count_bits(here ^ partner[-k]) : {int(CENSUS_BITS)};
            const int value = cost - least + wp::min(wp::min(current, least + {LARGE_PENALTY}), wp::min(before, upper) + {SMALL_PENALTY});
            total[k] = (wp::uint16)(direction == 0 ? value : total[k] + value);
            next_least = wp::min(next_least, value);
            next_top = value;
            path[k] = value;
            before = current;
        }}
#if defined(__CUDA_ARCH__)
        #pragma unroll
        for (int distance = lanes / 2; distance > 0; distance /= 2)
            next_least = wp::min(next_least, __shfl_xor_sync(~0u, next_least, distance));
#endif
        least = next_least;
        top = next_top;
    }}
""")
def follow_path(census: wp.array4d[wp.uint32], slot: int, lowest: int, line: int, direction: int, cost_inout: wp.array4d[wp.uint16]):
    """Accumulate the costs of one path across an image, `line` of those in a direction (0 right, 1 left, 2 down, 3 up).

    L(p, d) = C(p, d) + min(L(q, d), L(q, d - 1) + P1, L(q, d + 1) + P1, m + P2) - m, where q is the pixel before p and m its least L. On a
    GPU a warp shares a path, each thread some disparities in a row. Direction 0 writes the costs, the others add theirs.
    """
    ...


@kernel_of_views
def sum_path_costs_kernel(
    sensor: SensorParameters,
    views: AnyViews,
    first_view: int,
    direction: int,
    lines: int,
    lanes: int,
    first: int,
    matching_inout: MatchingScratch,
):
    """Add the costs of all paths in one direction, see `follow_path`. Launched over slot, line, lane (from flat index `first` on)."""
    path = (wp.tid() + first) // lanes
    slot = path // lines
    lowest = first_disparity(sensor, views, first_view + slot)
    follow_path(matching_inout.census, slot, lowest, path % lines, direction, matching_inout.cost)


@kernel_of_views
def match_right_kernel(
    grid: ImageGrid, sensor: SensorParameters, views: AnyViews, first_view: int, first: int, matching_inout: MatchingScratch
):
    """Index of the cheapest disparity of each pixel of right images. Launched over slot, pixel (tile order, from flat index `first` on)."""
    slot, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    shift = column + first_disparity(sensor, views, first_view + slot)
    best = int(NO_MATCH)
    least = int(1 << 20)
    for index in range(wp.min(matching_inout.cost.shape[3], grid.width - shift)):
        value = int(matching_inout.cost[slot, row, shift + index, index])
        if value < least:
            least = value
            best = index
    matching_inout.right_match[slot, row, column] = best


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __popc(bits);
#else
    return __builtin_popcount(bits);
#endif
""")
def count_bits(bits: wp.uint32) -> int:
    """Number of bits that are 1."""
    ...


@wp.func
def block_cost(census: wp.array4d[wp.uint32], slot: int, row: int, column: int, disparity: int) -> int:
    """Sum of the costs of a disparity over the block around a pixel; the block ends at the border."""
    total = int(0)
    # Not unrolled.
    radius = int(RADIUS)
    for down in range(-radius, radius + 1):
        at_row = clamp_index(row + down, census.shape[2])
        for right in range(-radius, radius + 1):
            at_column = clamp_index(column + right, census.shape[3])
            if at_column >= disparity:
                total += count_bits(census[slot, 0, at_row, at_column] ^ census[slot, 1, at_row, at_column - disparity])
            else:
                total += CENSUS_BITS
    return total


@wp.func
def sub_pixel(before: int, here: int, after: int) -> int:
    """Minimum of the costs at -1, 0 and 1 px, where two lines of opposite slope meet (Shimizu and Okutomi, 2001) [px/FRACTIONS]."""
    slope = wp.max(wp.max(before, after) - wp.min(here, wp.min(before, after)), 1)
    # Positive, so that the division rounds down.
    return (FRACTIONS * (before - after + 2 * slope) + slope) // (2 * slope) - FRACTIONS


@kernel_of_views
def match_left_kernel(
    grid: ImageGrid, sensor: SensorParameters, views: AnyViews, first_view: int, first: int, matching_inout: MatchingScratch
):
    """Sub-pixel disparity of each pixel of left images, NO_MATCH where there is none. The cheapest disparity must be unique, not at an end
    of the search, and within MAX_DIFFERENCE of its partner's. Launched over slot, pixel (tile order, from flat index `first` on)."""
    slot, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    matching_inout.disparity[slot, row, column] = NO_MATCH
    cost, census = matching_inout.cost, matching_inout.census
    count = cost.shape[3]
    best = int(0)
    least = int(1 << 20)
    for index in range(count):
        value = int(cost[slot, row, column, index])
        if value < least:
            least = value
            best = index
    lowest = first_disparity(sensor, views, first_view + slot)
    partner = column - lowest - best
    if best == 0 or best == count - 1 or partner < 0:
        return
    if wp.abs(matching_inout.right_match[slot, row, partner] - best) > MAX_DIFFERENCE:
        return
    for index in range(count):
        if wp.abs(index - best) > 1 and int(cost[slot, row, column, index]) * (100 - UNIQUENESS) < least * 100:
            return
    disparity = lowest + best
    before = block_cost(census, slot, row, column, disparity - 1)
    after = block_cost(census, slot, row, column, disparity + 1)
    here = block_cost(census, slot, row, column, disparity)
    matching_inout.disparity[slot, row, column] = FRACTIONS * disparity + sub_pixel(before, here, after)


@wp.func
def median_disparity(disparity: wp.array3d[int], grid: ImageGrid, slot: int, row: int, column: int) -> int:
    """3 x 3 median filter; pixels without a match count as the smallest disparity, and border pixels are repeated."""
    for at in range(9):
        value = disparity[slot, clamp_index(row + at // 3 - 1, grid.height), clamp_index(column + at % 3 - 1, grid.width)]
        less = int(0)
        same = int(0)
        for other in range(9):
            compared = disparity[slot, clamp_index(row + other // 3 - 1, grid.height), clamp_index(column + other % 3 - 1, grid.width)]
            less += int(compared < value)
            same += int(compared == value)
        if less <= 4 and less + same > 4:
            return value
    return NO_MATCH


@kernel_of_views
def measure_depth_kernel(
    # Scene:
    grid: ImageGrid,
    # In:
    sensor: SensorParameters,
    views: AnyViews,
    disparity: wp.array3d[int],  # (slot, row, column) [px/FRACTIONS]
    first_view: int,
    first: int,
    # Out:
    depth_stereo_out: wp.array3d[wp.uint16],  # (view, row, column) [counts]
):
    """Depth f b / d of the filtered disparity, in steps of `disparity_step`; 0 (hole): no match, or outside of the measuring range.
    Launched over slot, pixel (tile order, from flat index `first` on)."""
    slot, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    view = first_view + slot
    depth_stereo_out[view, row, column] = wp.uint16(0)
    matched = float(median_disparity(disparity, grid, slot, row, column)) / float(FRACTIONS)
    steps = wp.rint(matched / sensor.disparity_step)
    if steps < 1.0 or (sensor.max_disparity > 0.0 and matched > sensor.max_disparity):
        return
    depth = views.cameras.intrinsics[view][0] * sensor.baseline / (steps * sensor.disparity_step)
    counts = wp.rint(sensor.counts_per_meter * depth)
    if depth >= sensor.near and depth <= sensor.far and counts <= MAX_COUNTS:
        depth_stereo_out[view, row, column] = wp.uint16(counts)
