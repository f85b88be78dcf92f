"""Grasp point where the surface is flat: rejection sampling on the target's mask, for grasps that shall seal, and for second attempts."""

import warp as wp

from synpick_warp.codes import Stream
from synpick_warp.kernels.perception.components import Patches
from synpick_warp.kernels.perception.occlusion_votes import Voting
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer
from synpick_warp.kernels.rng import stream_key, uniform_index
from synpick_warp.kernels.state import Attempts, Observations, Plans, Worlds
from synpick_warp.kernels.structs import CupData, SuctionData

wp.set_module_options({"enable_backward": False})

# Random pixels that are tried.
DRAWS = wp.constant(64)
# Least distance of a random grasp point from the contour, as a fraction of the pole's.
MARGIN = wp.constant(0.5)
# Diameters of the circle on which the surface is compared with its middle.
DIAMETERS = wp.constant(4)
# Radius of that circle about a cup, in radii of its circle of rays: the lip lies outside of the rays.
LIP = wp.constant(1.5)
# Sum of the deviations up to which a surface counts as flat [m].
FLAT = wp.constant(1.0e-3)
# Deviation of a diameter that leaves the mask, and the largest of one on it [m].
OUTSIDE = wp.constant(0.05)


@wp.func
def head_span(suction: SuctionData, cups: CupData) -> float:
    """Radius of the circle about the tool centre point within which all cups lie [m]."""
    farthest = float(0.0)
    for cup in range(cups.count):
        farthest = wp.max(farthest, wp.length(wp.vec2(cups.place[cup][0], cups.place[cup][1])))
    return farthest + LIP * suction.radius


@wp.func
def lies_on(component: wp.array3d[int], view: int, pixel: wp.vec2i, other: wp.vec2i) -> bool:
    """True if the other pixel (column, row) is in the image (view, row, column) and belongs to the same component."""
    if other[0] < 0 or other[1] < 0 or other[0] >= component.shape[2] or other[1] >= component.shape[1]:
        return False
    return component[view, other[1], other[0]] == component[view, pixel[1], pixel[0]]


@wp.func
def measure_bump(gbuffer: GBuffer, patches: Patches, view: int, pixel: wp.vec2i, radius: float) -> float:
    """Deviation of the surface around a pixel from a plane [m]: Σ z² |(1 / z_a + 1 / z_b) / 2 - 1 / z| over diameters a, b of a circle.

    1 / z of a plane is affine in the image, so that it is 0 there. `radius` is in pixels; ends outside of the component count as OUTSIDE.
    """
    z = gbuffer.depth[view, pixel[1], pixel[0]]
    total = float(0.0)
    for index in range(DIAMETERS):
        angle = wp.PI * float(index) / float(DIAMETERS)
        offset = wp.vec2i(int(wp.rint(radius * wp.cos(angle))), int(wp.rint(radius * wp.sin(angle))))
        deviation = float(OUTSIDE)
        if lies_on(patches.component, view, pixel, pixel + offset) and lies_on(patches.component, view, pixel, pixel - offset):
            first = gbuffer.depth[view, pixel[1] + offset[1], pixel[0] + offset[0]]
            second = gbuffer.depth[view, pixel[1] - offset[1], pixel[0] - offset[0]]
            deviation = wp.min(z * z * wp.abs(0.5 * (1.0 / first + 1.0 / second) - 1.0 / z), OUTSIDE)
        total += deviation
    return total


@wp.kernel
def choose_flat_points_kernel(
    seed: wp.uint64,
    suction: SuctionData,
    cups: CupData,
    least_failures: int,
    state: Worlds,
    attempts: Attempts,
    observation_inout: Observations,
    plan: Plans,
    views: Views,
    gbuffer: GBuffer,
    patches: Patches,
    voting: Voting,
):
    """Move the grasp point of targets with at least `least_failures` failed attempts to where the surface below all cups is flat.

    The first that is flat (FLAT) of: the grasp point, unless an attempt at the target has failed; then DRAWS random pixels of the contour's
    box (`extent`) on the largest component, at least MARGIN of the pole's distance from the contour. Else the flattest of them, the first
    of equals; without one the point stays. Writes pixel and planar depth. Launched over view.
    """
    view = wp.tid()
    world = views.world[view]
    if world < 0 or plan.target[world] < 0:
        return
    instance = plan.target[world]
    failures = attempts.target_failures[world, instance]
    if failures < least_failures:
        return
    key = stream_key(seed, state.arrangement_id[world][0], state.arrangement_id[world][1], Stream.GRASPS)
    box = voting.extent[view, instance]
    chosen = observation_inout.grasp_pixel[world, instance]
    label = patches.component[view, chosen[1], chosen[0]]
    radius = head_span(suction, cups) * views.cameras.intrinsics[view][0]
    bump = float(DIAMETERS + 1) * OUTSIDE
    if failures == 0:
        bump = measure_bump(gbuffer, patches, view, chosen, radius / gbuffer.depth[view, chosen[1], chosen[0]])
    first = 2 * DRAWS * (attempts.attempt[world] + 1)
    draw = int(0)
    while draw < DRAWS and bump > FLAT:
        column = uniform_index(key, first + 2 * draw, box[2] + box[0] + 1) - box[0]
        row = uniform_index(key, first + 2 * draw + 1, box[3] + box[1] + 1) - box[1]
        draw += 1
        if (
            patches.component[view, row, column] == label
            and patches.distance[view, row, column] >= MARGIN * observation_inout.distances[world, instance][0]
        ):
            pixel = wp.vec2i(column, row)
            other = measure_bump(gbuffer, patches, view, pixel, radius / gbuffer.depth[view, row, column])
            if other < bump:
                bump = other
                chosen = pixel
    observation_inout.grasp_pixel[world, instance] = chosen
    observation_inout.depth[world, instance] = gbuffer.depth[view, chosen[1], chosen[0]]
