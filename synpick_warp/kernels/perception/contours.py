"""Border following (Suzuki and Abe, 1985): outer contour of each instance's largest component, and the centroid of its polygon."""

import warp as wp

from synpick_warp.kernels.perception.components import Segments
from synpick_warp.kernels.perception.distance_transform import SEGMENT_BITS, direction_column, direction_row
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.state import Observations

wp.set_module_options({"enable_backward": False})

NORTH_WEST = wp.constant(3)
"""Direction in which the search around a contour's first pixel begins: that pixel has no neighbour to its west."""
NO_DIRECTION = wp.constant(-1)
COUNTER_CLOCKWISE = wp.constant(1)
CLOCKWISE = wp.constant(-1)


@wp.struct
class PolygonMoments:
    """Exact integer sums over the edges of a closed polygon, for its area and centroid (Green's theorem), with sums, last and number of its
    vertices; (u, v) [px] are relative to the first vertex.
    """

    cross: wp.int64
    """Twice the signed area: sum of c = u₁ v₂ - u₂ v₁ over the edges."""
    cross_u: wp.int64
    """Six times the first moment in u: sum of c (u₁ + u₂) over the edges."""
    cross_v: wp.int64
    """Six times the first moment in v."""
    u: wp.int64
    v: wp.int64
    last_u: int
    last_v: int
    points: int


@wp.func
def add_vertex(polygon: PolygonMoments, u: int, v: int) -> PolygonMoments:
    """Sums with one more vertex. Edges from and to the first vertex contribute nothing because it is the origin."""
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
def polygon_centroid(polygon: PolygonMoments) -> wp.vec2d:
    """Centroid Σ c (p₁ + p₂) / (3 Σ c) over the edges, relative to the first vertex [px]; the mean of the vertices where the
    area is zero.
    """
    if polygon.cross != wp.int64(0):
        whole = wp.float64(3.0) * wp.float64(polygon.cross)
        return wp.vec2d(wp.float64(polygon.cross_u) / whole, wp.float64(polygon.cross_v) / whole)
    count = wp.float64(polygon.points)
    return wp.vec2d(wp.float64(polygon.u) / count, wp.float64(polygon.v) / count)


@wp.func
def next_direction(neighbours: int, start: int, turn: int) -> int:
    """First of the 8 directions, from `start` on in the sense of rotation `turn`, whose bit is set in `neighbours`; -1: none."""
    for i in range(8):
        direction = (start + turn * i) & 7
        if (neighbours >> direction) & 1 != 0:
            return direction
    return NO_DIRECTION


@wp.kernel
def trace_contours_kernel(segments_inout: Segments, views: Views, width: int, observation_out: Observations):
    """Border following (Moore neighbours): outer contour of each instance's largest component, its length and centroid.

    From the previous pixel, turn counter-clockwise to the next pixel of the component. A contour begins at the component's smallest index,
    which is the leftmost of its topmost pixels, and ends when the first step would repeat. Every step reads one patch word. A contour
    longer than its capacity is truncated, and its world's overflow flag is set to 1. Launched over view, instance.
    """
    view, instance = wp.tid()
    world = views.world[view]
    segments_inout.contour_length[view, instance] = 0
    if world < 0:
        return
    origin = segments_inout.largest[view, instance]
    if origin < 0:
        return
    start_row = origin // width
    start_column = origin - start_row * width
    neighbours = int(segments_inout.patch[view, origin]) >> SEGMENT_BITS
    direction = next_direction(neighbours, NORTH_WEST, CLOCKWISE)
    # Offset of the pixel from which the border returns to its start: the last contour point.
    last_u = direction_column(direction)
    last_v = direction_row(direction)
    u = int(0)
    v = int(0)
    polygon = PolygonMoments()
    following = bool(True)
    while following:
        if polygon.points == segments_inout.contour.shape[2]:
            observation_out.overflow[world] = 1
            break
        segments_inout.contour[view, instance, polygon.points] = wp.vec2i(start_column + u, start_row + v)
        polygon = add_vertex(polygon, u, v)
        if direction == NO_DIRECTION:
            break
        direction = next_direction(neighbours, direction + 1, COUNTER_CLOCKWISE)
        next_u = u + direction_column(direction)
        next_v = v + direction_row(direction)
        following = next_u != 0 or next_v != 0 or u != last_u or v != last_v
        u = next_u
        v = next_v
        direction = (direction + 4) & 7
        neighbours = int(segments_inout.patch[view, origin + v * width + u]) >> SEGMENT_BITS
    segments_inout.contour_length[view, instance] = polygon.points
    centroid = polygon_centroid(polygon)
    observation_out.centroid[world, instance] = wp.vec2(float(start_column) + float(centroid[0]), float(start_row) + float(centroid[1]))
