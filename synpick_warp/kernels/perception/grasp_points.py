"""Suction grasp point of each instance in the image: pole of inaccessibility, centroid, their midpoint, and the choice among them."""

import warp as wp

from synpick_warp.kernels.perception.components import STRIP, Segments, pack_key, unpack_pixel
from synpick_warp.kernels.perception.distance_transform import SEGMENT_MASK
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.state import Observations
from synpick_warp.kernels.structs import CatalogData, PerceptionData

wp.set_module_options({"enable_backward": False})

SQUARE_UNITS = wp.constant(16777216.0)
"""Squared depths are summed as integer multiples of 2⁻²⁴ m², so that the sum does not depend on the order of threads."""


@wp.kernel
def clear_sums_kernel(
    # In:
    views: Views,
    # Out:
    segments_out: Segments,
    overflow_out: wp.array[int],  # (world)
):
    """Reset the maxima and sums of every view and instance, and the contour overflow flags of the worlds in the batch, to 0.

    Launched over view, instance.
    """
    view, instance = wp.tid()
    segments_out.largest_key[view, instance] = wp.int64(0)
    segments_out.pole_key[view, instance] = wp.int64(0)
    segments_out.square[view, instance] = wp.int64(0)
    if instance == 0 and views.world[view] >= 0:
        overflow_out[views.world[view]] = 0


@wp.kernel
def measure_patches_kernel(segments_inout: Segments, views: Views, width: int):
    """Reduce each patch: pole of inaccessibility as max over its pixels of pack_key(d², pixel), and Σ z². Both must be 0 at the start.

    d² is an integer and is recovered exactly from its float32 root for d < 1600 px; beyond, neighbouring squares may compare as equal.
    Launched over view, row, strip.
    """
    view, row, strip = wp.tid()
    if views.world[view] < 0:
        return
    begin = row * width + strip * STRIP
    run = int(0)
    key = wp.int64(0)
    square = wp.int64(0)
    for pixel in range(begin, wp.min(begin + STRIP, (row + 1) * width)):
        here = int(segments_inout.patch[view, pixel]) & SEGMENT_MASK
        if here != run:
            if run > 0:
                wp.atomic_max(segments_inout.pole_key, view, run - 1, key)
                wp.atomic_add(segments_inout.square, view, run - 1, square)
            run = here
            key = wp.int64(0)
            square = wp.int64(0)
        if here > 0:
            d = segments_inout.distance[view, pixel]
            z = segments_inout.depth[view, pixel]
            key = wp.max(key, pack_key(wp.int64(wp.rint(d * d)), pixel))
            square += wp.int64(wp.rint(z * z * SQUARE_UNITS))
    if run > 0:
        wp.atomic_max(segments_inout.pole_key, view, run - 1, key)
        wp.atomic_add(segments_inout.square, view, run - 1, square)


@wp.func
def round_to_pixel(point: wp.vec2) -> wp.vec2i:
    """Column and row of the pixel with the nearest centre; ties go to the even index."""
    return wp.vec2i(int(wp.rint(point[0])), int(wp.rint(point[1])))


@wp.func
def distance_at(component: wp.array2d[int], distance: wp.array2d[float], view: int, width: int, label: int, point: wp.vec2) -> float:
    """Distance to the contour [px] at the pixel nearest to a point; 0 if that pixel lies outside the component."""
    pixel = round_to_pixel(point)
    index = pixel[1] * width + pixel[0]
    if component[view, index] != label:
        return 0.0
    return distance[view, index]


@wp.kernel
def measure_points_kernel(
    # Scene:
    catalog: CatalogData,
    intrinsics: wp.array[wp.vec4],  # (camera) [px]
    # State:
    catalog_index: wp.array2d[int],  # (world, instance)
    observation_inout: Observations,
    segments: Segments,
    # In:
    views: Views,
    width: int,
):
    """Visible pixels, visible fraction Σ (z / fx) (z / fy) / expected area, pole p, and distances to the contour at p, c and (p + c) / 2.

    c is the centroid. Invisible instances get 0 pixels, fraction 0, distances 0, and points (-1, -1). Launched over view, instance.
    """
    view, instance = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    label = segments.largest[view, instance]
    if label < 0:
        observation_inout.visible[world, instance] = 0
        observation_inout.visible_fraction[world, instance] = 0.0
        observation_inout.pole[world, instance] = wp.vec2(-1.0, -1.0)
        observation_inout.centroid[world, instance] = wp.vec2(-1.0, -1.0)
        observation_inout.distances[world, instance] = wp.vec3(0.0, 0.0, 0.0)
        return
    focal = intrinsics[0]
    surface = wp.float64(segments.square[view, instance]) / wp.float64(SQUARE_UNITS * focal[0] * focal[1])
    pixel = unpack_pixel(segments.pole_key[view, instance])
    row = pixel // width
    pole = wp.vec2(float(pixel - row * width), float(row))
    centroid = observation_inout.centroid[world, instance]
    observation_inout.visible[world, instance] = segments.area[view, label]
    observation_inout.visible_fraction[world, instance] = float(surface) / catalog.area[catalog_index[world, instance]]
    observation_inout.pole[world, instance] = pole
    observation_inout.distances[world, instance] = wp.vec3(
        segments.distance[view, pixel],
        distance_at(segments.component, segments.distance, view, width, label, centroid),
        distance_at(segments.component, segments.distance, view, width, label, 0.5 * (pole + centroid)),
    )


@wp.kernel
def choose_grasp_points_kernel(
    # Scene:
    catalog: CatalogData,
    perception: PerceptionData,
    # State:
    catalog_index: wp.array2d[int],  # (world, instance)
    observation_inout: Observations,
    # In:
    views: Views,
    hit_depth: wp.array3d[float],  # (view, row, column) [m]
):
    """Grasp point: of centroid and midpoint the one with the larger r = distance / pole's distance if r > center_fraction; else the pole.

    The centroid wins ties. For objects above heavy_mass [kg] the threshold is heavy_center_fraction (Periyasamy et al., 2021). Writes the
    midpoint, the pixel of the grasp point and its planar depth; (-1, -1) and depth 0 for instances that are not visible. Launched over
    view, instance.
    """
    view, instance = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    observation_inout.midpoint[world, instance] = 0.5 * (
        observation_inout.pole[world, instance] + observation_inout.centroid[world, instance]
    )
    if observation_inout.visible[world, instance] == 0:
        observation_inout.grasp_pixel[world, instance] = wp.vec2i(-1, -1)
        observation_inout.depth[world, instance] = 0.0
        return
    threshold = perception.center_fraction
    if catalog.mass[catalog_index[world, instance]] > perception.heavy_mass:
        threshold = perception.heavy_center_fraction
    d = observation_inout.distances[world, instance]
    point = observation_inout.centroid[world, instance]
    ratio = d[1] / d[0]
    if d[2] > d[1]:
        point = observation_inout.midpoint[world, instance]
        ratio = d[2] / d[0]
    if ratio <= threshold:
        point = observation_inout.pole[world, instance]
    pixel = round_to_pixel(point)
    observation_inout.grasp_pixel[world, instance] = pixel
    observation_inout.depth[world, instance] = hit_depth[view, pixel[1], pixel[0]]
