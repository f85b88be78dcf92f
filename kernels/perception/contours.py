"""Outer contours of the largest component of each instance, and the centroid of what they enclose."""

import warp as wp

from synpick_warp.kernels.perception.distance_transform import SEGMENT_BITS, direction_column, direction_row
from synpick_warp.kernels.render.visibility.camera import Views

wp.set_module_options({"enable_backward": False})

NORTH_WEST = wp.constant(3)
"""Where the search around a contour's first pixel begins: nothing lies to the west of it."""
NO_DIRECTION = wp.constant(-1)
COUNTER_CLOCKWISE = wp.constant(1)
CLOCKWISE = wp.constant(-1)


@wp.struct
class Polygon:
    """Sums over a closed chain of points (u, v) [px], relative to its first point; exact, for whole numbers."""

    cross: wp.int64
    """Sum of c = u₁ v₂ - u₂ v₁ over its edges: twice its area."""
    cross_u: wp.int64
    """Sum of c (u₁ + u₂)."""
    cross_v: wp.int64
    u: wp.int64
    """Sum of u over its points."""
    v: wp.int64
    last_u: int
    last_v: int
    points: int


@wp.func
def with_point(polygon: Polygon, u: int, v: int) -> Polygon:
    """The sums after one more point. Edges from and to the first point add nothing, for it is the origin."""
    result = polygon
    cross = wp.int64(polygon.last_u) * wp.int64(v) - wp.int64(u) * wp.int64(polygon.last_v)
    result.cross += cross
    result.cross_u += cross * wp.int64(polygon.last_u + u)
    result.cross_v += cross * wp.int64(polygon.last_v + v)
    result.u += wp.int64(u)
    result.v += wp.int64(v)
    result.last_u = u
    result.last_v = v
    result.points += 1
    return result


@wp.func
def centroid_of(polygon: Polygon) -> wp.vec2d:
    """Σ c (p₁ + p₂) / (3 Σ c); the mean of the points where they enclose nothing."""
    if polygon.cross != wp.int64(0):
        whole = wp.float64(3.0) * wp.float64(polygon.cross)
        return wp.vec2d(wp.float64(polygon.cross_u) / whole, wp.float64(polygon.cross_v) / whole)
    count = wp.float64(polygon.points)
    return wp.vec2d(wp.float64(polygon.u) / count, wp.float64(polygon.v) / count)


@wp.func
def next_direction(neighbours: int, start: int, turn: int) -> int:
    """The first of the 8 directions, from `start` on, whose bit is set."""
    for i in range(8):
        direction = (start + turn * i) & 7
        if (neighbours >> direction) & 1 != 0:
            return direction
    return NO_DIRECTION


@wp.kernel
def trace_contours_kernel(
    # In:
    views: Views,
    patch: wp.array2d[wp.uint16],
    largest: wp.array2d[int],
    width: int,
    # Out:
    contour_out: wp.array3d[wp.vec2i],
    contour_length_out: wp.array2d[int],
    centroid_out: wp.array2d[wp.vec2],
    overflow_out: wp.array[int],
):
    """Follow each outer border (Suzuki and Abe, 1985): turn counter-clockwise from where we came to the next pixel of the component.

    It begins at the component's least index, which is its topmost pixel and of those the leftmost, and ends when the first step
    would be made again. Every step reads one word. A contour longer than its room is cut there, and its world told.
    """
    view, instance = wp.tid()
    world = views.world[view]
    contour_length_out[view, instance] = 0
    if world < 0:
        return
    origin = largest[view, instance]
    if origin < 0:
        return
    start_row = origin // width
    start_column = origin - start_row * width
    neighbours = int(patch[view, origin]) >> SEGMENT_BITS
    direction = next_direction(neighbours, NORTH_WEST, CLOCKWISE)
    # The pixel from which the border comes back to its start: the last one.
    last_u = direction_column(direction)
    last_v = direction_row(direction)
    u = int(0)
    v = int(0)
    polygon = Polygon()
    following = bool(True)
    while following:
        if polygon.points == contour_out.shape[2]:
            overflow_out[world] = 1
            break
        contour_out[view, instance, polygon.points] = wp.vec2i(start_column + u, start_row + v)
        polygon = with_point(polygon, u, v)
        if direction == NO_DIRECTION:
            break
        direction = next_direction(neighbours, direction + 1, COUNTER_CLOCKWISE)
        next_u = u + direction_column(direction)
        next_v = v + direction_row(direction)
        following = next_u != 0 or next_v != 0 or u != last_u or v != last_v
        u = next_u
        v = next_v
        direction = (direction + 4) & 7
        neighbours = int(patch[view, origin + v * width + u]) >> SEGMENT_BITS
    contour_length_out[view, instance] = polygon.points
    centroid = centroid_of(polygon)
    centroid_out[world, instance] = wp.vec2(float(start_column) + float(centroid[0]), float(start_row) + float(centroid[1]))
