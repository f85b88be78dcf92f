"""Occlusion votes along contours: a nearer neighbour on the other side of a contour occludes the object that the contour encloses."""

import warp as wp

from synpick_warp.kernels.perception.components import Patches
from synpick_warp.kernels.render.visibility.camera import ImageGrid, Views
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer
from synpick_warp.kernels.state import Observations, Worlds
from synpick_warp.kernels.structs import CatalogData, PerceptionData

wp.set_module_options({"enable_backward": False})

TANGENT_REACH = wp.constant(3)
"""Contour tangents are central differences over this many points to each side; adjacent points have only eight directions."""
CONTOUR_LANES = wp.constant(128)
"""Threads of a contour; neighbouring threads process neighbouring points."""
NOWHERE = wp.constant(-(1 << 20))
"""Identity of the maximum in `bound_contours_kernel` [px]: less than the extent of any pixel."""
FULL = wp.constant(0)
DEEP = wp.constant(1)
"""Indices of the kinds of votes."""


@wp.struct
class Voting:
    """Scratch of the occlusion votes."""

    count: wp.array4d[int]
    """(view, instance, instance, kind): votes that the second instance lies above the first, by kind: full, or deep (it is seen below the
    first one's grasp point)."""
    extent: wp.array2d[wp.vec4i]
    """(view, instance): bounding box of each contour as maxima: -column, -row, column, row [px]."""
    reach: wp.array2d[float]
    """(view, instance): bound of an object's size in the image: votes from pixels with a farther point of its contour do not count [px]."""


@wp.func
def visible_instance(gbuffer: GBuffer, view: int, row: int, column: int, instances: int) -> int:
    """Instance that the G-buffer shows at a pixel; -1: none."""
    segment = int(gbuffer.segment[view, row, column])
    if segment < 1 or segment > instances:
        return -1
    return segment - 1


@wp.func
def contour_normal(patches: Patches, view: int, instance: int, point: int) -> wp.vec2:
    """Outward unit normal (column, row) of an outer contour at a point; zero where the tangent vanishes.

    OpenCV's outer contours run counter-clockwise in the displayed image, with rows growing downward: the object lies to the left of the
    tangent t, and n = (-t_y, t_x) / |t|. So the two sides of a thin part have opposite normals even where they share pixels.
    """
    length = patches.contour_length[view, instance]
    before = patches.contour[view, instance, (point + length - TANGENT_REACH % length) % length]
    after = patches.contour[view, instance, (point + TANGENT_REACH) % length]
    x = float(after[0] - before[0])
    y = float(after[1] - before[1])
    square = x * x + y * y
    if square == 0.0:
        return wp.vec2(0.0, 0.0)
    size = wp.sqrt(square)
    return wp.vec2(-y / size, x / size)


@wp.func
def offset_pixel(point: wp.vec2i, normal: wp.vec2, offset: float, grid: ImageGrid) -> wp.vec2i:
    """The pixel (column, row) nearest to point + offset · normal; (-1, -1) outside the image."""
    column = int(wp.floor(float(point[0]) + offset * normal[0] + 0.5))
    row = int(wp.floor(float(point[1]) + offset * normal[1] + 0.5))
    if column < 0 or column >= grid.width or row < 0 or row >= grid.height:
        return wp.vec2i(-1, -1)
    return wp.vec2i(column, row)


@wp.func
def is_in_reach(voting: Voting, patches: Patches, view: int, instance: int, q: wp.vec2i) -> bool:
    """True if max over c of |c - q| ≤ reach [px], for the points c of an instance's contour; True for a contour without points.

    Bounding-box test first: a contour touches each side of its box, so its farthest point is at least as far as the farthest side and at
    most as far as the farthest corner. The points are tested only if the reach lies between these two.
    """
    reach, extent = voting.reach[view, instance], voting.extent[view, instance]
    across = wp.max(wp.max(q[0] + extent[0], extent[2] - q[0]), 0)
    down = wp.max(wp.max(q[1] + extent[1], extent[3] - q[1]), 0)
    side = wp.max(across, down)
    square = reach * reach
    if float(across * across + down * down) <= square:
        return True
    if float(side * side) > square:
        return False
    for point in range(patches.contour_length[view, instance]):
        away = patches.contour[view, instance, point] - q
        if float(away[0] * away[0] + away[1] * away[1]) > square:
            return False
    return True


@wp.kernel
def bound_contours_kernel(
    catalog: CatalogData,
    perception: PerceptionData,
    state: Worlds,
    observation: Observations,
    views: Views,
    patches: Patches,
    voting_out: Voting,
):
    """Bounding box of each contour, and reach of each instance.

    extent[j] = max over the contour of (-column, -row, column, row), which must be NOWHERE at the start; reach[j] =
    perception.reach · diagonal_j · f_x / depth_j [px], unwritten for instances without a catalog entry, which are never visible. Launched
    over view, instance, lane.
    """
    view, instance, lane = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    e = state.catalog_index[world, instance]
    if lane == 0 and e >= 0:
        voting_out.reach[view, instance] = (
            perception.reach * catalog.diagonal[e] * views.cameras.intrinsics[view][0] / observation.depth[world, instance]
        )
    extent = wp.vec4i(NOWHERE, NOWHERE, NOWHERE, NOWHERE)
    length = patches.contour_length[view, instance]
    for point in range(lane, length, CONTOUR_LANES):
        c = patches.contour[view, instance, point]
        extent = wp.max(extent, wp.vec4i(-c[0], -c[1], c[0], c[1]))
    if lane < length:
        wp.atomic_max(voting_out.extent, view, instance, extent)


@wp.kernel
def count_votes_kernel(
    grid: ImageGrid,
    perception: PerceptionData,
    observation: Observations,
    gbuffer: GBuffer,
    views: Views,
    patches: Patches,
    voting_inout: Voting,
):
    """count[i, j, kind]: number of points of i's contour at which j occludes i. Counts must be 0 at the start.

    At a point p with normal n, the pixel p - o n must belong to the largest component of i, and q = p + o n to another instance j with a
    smaller depth; o is the contour offset. The vote is deep if j at q lies below i's grasp point by more than `deep_distance`. A vote is
    rejected if a point of j's contour is farther from q than j's reach: the mask is then too large for j, which true masks hardly ever are.
    Distractors have no component, and get no votes.
    Launched over view, instance, lane: the lanes of an instance stride over its contour.
    """
    view, instance, lane = wp.tid()
    world = views.world[view]
    if world < 0 or patches.largest[view, instance] < 0:
        return
    instances = patches.largest.shape[1]
    for point in range(lane, patches.contour_length[view, instance], CONTOUR_LANES):
        p = patches.contour[view, instance, point]
        normal = contour_normal(patches, view, instance, point)
        inside = offset_pixel(p, normal, -perception.contour_offset, grid)
        q = offset_pixel(p, normal, perception.contour_offset, grid)
        if inside[0] >= 0 and q[0] >= 0 and patches.component[view, inside[1], inside[0]] == patches.largest[view, instance]:
            j = visible_instance(gbuffer, view, q[1], q[0], instances)
            d = gbuffer.depth[view, q[1], q[0]]
            if j >= 0 and j != instance and patches.largest[view, j] >= 0 and d < gbuffer.depth[view, inside[1], inside[0]]:
                if is_in_reach(voting_inout, patches, view, j, q):
                    if d > observation.depth[world, instance] + perception.deep_distance:
                        wp.atomic_add(voting_inout.count, view, instance, j, DEEP, 1)
                    else:
                        wp.atomic_add(voting_inout.count, view, instance, j, FULL, 1)


@wp.kernel
def weigh_votes_kernel(perception: PerceptionData, views: Views, voting: Voting, observation_out: Observations):
    """Write the occlusion votes votes[i, j] = full + deep_weight · deep, that j lies above i, from the counts by kind. Launched over view,
    instance, instance.
    """
    view, instance, neighbour = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    deep = float(voting.count[view, instance, neighbour, DEEP])
    observation_out.votes[world, instance, neighbour] = float(voting.count[view, instance, neighbour, FULL]) + perception.deep_weight * deep
