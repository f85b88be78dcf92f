"""Votes along contours for what lies above what: a nearer neighbour across a contour hides the object that the contour encloses."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import Cameras, ImageGrid, Views
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer
from synpick_warp.kernels.structs import CatalogData, PerceptionData

wp.set_module_options({"enable_backward": False})

TANGENT_REACH = wp.constant(3)
"""A contour's direction at a point is that from so many points before it to as many after it: from one to the next there are eight only."""
CONTOUR_LANES = wp.constant(128)
"""Threads that share a contour; neighbours take neighbouring points."""
NOWHERE = wp.constant(-(1 << 20))
"""Extent of a contour without points, in every direction: short of any pixel."""
FULL = wp.constant(0)
DEEP = wp.constant(1)
"""Kinds of votes."""


@wp.func
def seen_instance(gbuffer: GBuffer, view: int, row: int, column: int, instances: int) -> int:
    """The instance that a pixel shows; -1: none."""
    segment = int(gbuffer.segment[view, row, column])
    if segment < 1 or segment > instances:
        return -1
    return segment - 1


@wp.func
def contour_normal(contour: wp.array3d[wp.vec2i], view: int, instance: int, point: int, length: int) -> wp.vec2:
    """Unit normal of an outer contour at a point, out of the object, as (column, row); zero where the contour turns back.

    Outer contours of OpenCV run counter-clockwise as one sees them, rows growing downward: from the direction (t_x, t_y) the object lies
    to the left, and n = (-t_y, t_x) / |t|. So the two sides of a thin part get opposite normals though they are the same pixels.
    """
    before = contour[view, instance, (point + length - TANGENT_REACH % length) % length]
    after = contour[view, instance, (point + TANGENT_REACH) % length]
    x = float(after[0] - before[0])
    y = float(after[1] - before[1])
    square = x * x + y * y
    if square == 0.0:
        return wp.vec2(0.0, 0.0)
    size = wp.sqrt(square)
    return wp.vec2(-y / size, x / size)


@wp.func
def beside(point: wp.vec2i, normal: wp.vec2, offset: float, grid: ImageGrid) -> wp.vec2i:
    """The pixel (column, row) nearest to point + offset · normal; (-1, -1) outside the image."""
    column = int(wp.floor(float(point[0]) + offset * normal[0] + 0.5))
    row = int(wp.floor(float(point[1]) + offset * normal[1] + 0.5))
    if column < 0 or column >= grid.width or row < 0 or row >= grid.height:
        return wp.vec2i(-1, -1)
    return wp.vec2i(column, row)


@wp.func
def is_in_reach(q: wp.vec2i, reach: float, extent: wp.vec4i, contour: wp.array3d[wp.vec2i], view: int, instance: int, length: int) -> bool:
    """Whether max over c of |c - q| ≤ reach [px], c being the points of an instance's contour; true of a contour without points.

    A contour touches each side of its box, so its farthest point is no nearer than the farthest side and no farther than the farthest
    corner: it is walked only where the reach lies between the two.
    """
    across = wp.max(wp.max(q[0] + extent[0], extent[2] - q[0]), 0)
    down = wp.max(wp.max(q[1] + extent[1], extent[3] - q[1]), 0)
    side = wp.max(across, down)
    square = reach * reach
    if float(across * across + down * down) <= square:
        return True
    if float(side * side) > square:
        return False
    for point in range(length):
        away = contour[view, instance, point] - q
        if float(away[0] * away[0] + away[1] * away[1]) > square:
            return False
    return True


@wp.kernel
def bound_contours_kernel(
    # Scene:
    catalog: CatalogData,
    cameras: Cameras,
    sight: PerceptionData,
    # State:
    entry: wp.array2d[int],
    # In:
    views: Views,
    contour: wp.array3d[wp.vec2i],
    contour_length: wp.array2d[int],
    depth: wp.array2d[float],
    # Out:
    extent_out: wp.array2d[wp.vec4i],
    reach_out: wp.array2d[float],
):
    """extent[j] = max over the contour of (-column, -row, column, row); reach[j] = reach · diagonal_j · f_x / depth_j [px].

    The extents begin at NOWHERE. An instance without an entry shows no pixel, so nobody asks for its reach.
    """
    view, instance, lane = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    e = entry[world, instance]
    if lane == 0 and e >= 0:
        reach_out[view, instance] = sight.reach * catalog.diagonal[e] * cameras.intrinsics[views.camera[view]][0] / depth[world, instance]
    extent = wp.vec4i(NOWHERE, NOWHERE, NOWHERE, NOWHERE)
    length = contour_length[view, instance]
    for point in range(lane, length, CONTOUR_LANES):
        c = contour[view, instance, point]
        extent = wp.max(extent, wp.vec4i(-c[0], -c[1], c[0], c[1]))
    if lane < length:
        wp.atomic_max(extent_out, view, instance, extent)


@wp.kernel
def count_votes_kernel(
    # Scene:
    grid: ImageGrid,
    sight: PerceptionData,
    # In:
    gbuffer: GBuffer,
    views: Views,
    component: wp.array3d[int],
    largest: wp.array2d[int],
    contour: wp.array3d[wp.vec2i],
    contour_length: wp.array2d[int],
    depth: wp.array2d[float],
    extent: wp.array2d[wp.vec4i],
    reach: wp.array2d[float],
    # Out:
    count_out: wp.array4d[int],
):
    """count[i, j, kind]: points of i's contour at which j lies nearer to the camera.

    At a point p with normal n, p - o n must show the largest component of i and q = p + o n another instance j, with a smaller depth; o
    is the contour's offset. The vote is deep where j lies lower than i's suction point by more than `deep_distance`. It does not count
    where a point of j's contour is farther from q than j's reach: what is seen is then too large for j, which true masks hardly ever are.
    """
    view, instance, lane = wp.tid()
    world = views.world[view]
    if world < 0 or largest[view, instance] < 0:
        return
    instances = largest.shape[1]
    for point in range(lane, contour_length[view, instance], CONTOUR_LANES):
        p = contour[view, instance, point]
        normal = contour_normal(contour, view, instance, point, contour_length[view, instance])
        inside = beside(p, normal, -sight.contour_offset, grid)
        q = beside(p, normal, sight.contour_offset, grid)
        if inside[0] >= 0 and q[0] >= 0 and component[view, inside[1], inside[0]] == largest[view, instance]:
            j = seen_instance(gbuffer, view, q[1], q[0], instances)
            d = gbuffer.depth[view, q[1], q[0]]
            if j >= 0 and j != instance and d < gbuffer.depth[view, inside[1], inside[0]]:
                if is_in_reach(q, reach[view, j], extent[view, j], contour, view, j, contour_length[view, j]):
                    if d > depth[world, instance] + sight.deep_distance:
                        wp.atomic_add(count_out, view, instance, j, DEEP, 1)
                    else:
                        wp.atomic_add(count_out, view, instance, j, FULL, 1)


@wp.kernel
def weigh_votes_kernel(
    # Scene:
    sight: PerceptionData,
    # In:
    views: Views,
    count: wp.array4d[int],
    # Out:
    votes_out: wp.array3d[float],
):
    """votes[i, j] = full + deep_weight · deep."""
    view, instance, neighbour = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    deep = float(count[view, instance, neighbour, DEEP])
    votes_out[world, instance, neighbour] = float(count[view, instance, neighbour, FULL]) + sight.deep_weight * deep
