"""Suction grasp point of each instance in the image: pole of inaccessibility, centroid, their midpoint, and the choice among them."""

import warp as wp

from synpick_warp.kernels.perception.components import STRIP, pack_key, unpack_pixel
from synpick_warp.kernels.perception.distance_transform import SEGMENT_MASK
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.structs import CatalogData, PerceptionData

wp.set_module_options({"enable_backward": False})

SQUARE_UNITS = wp.constant(16777216.0)
"""Squared depths are summed as integer multiples of 2⁻²⁴ m², so that the sum does not depend on the order of threads."""


@wp.kernel
def clear_sums_kernel(
    # In:
    views: Views,
    # Out:
    largest_key_out: wp.array2d[wp.int64],  # (view, instance)
    pole_key_out: wp.array2d[wp.int64],  # (view, instance)
    square_out: wp.array2d[wp.int64],  # (view, instance) [2⁻²⁴ m²]
    overflow_out: wp.array[int],  # (world)
):
    """Reset the maxima and sums of every view and instance, and the contour overflow flags of the worlds in the batch, to 0.

    Launched over view, instance.
    """
    view, instance = wp.tid()
    largest_key_out[view, instance] = wp.int64(0)
    pole_key_out[view, instance] = wp.int64(0)
    square_out[view, instance] = wp.int64(0)
    if instance == 0 and views.world[view] >= 0:
        overflow_out[views.world[view]] = 0


@wp.kernel
def measure_patches_kernel(
    # In:
    views: Views,
    patch: wp.array2d[wp.uint16],  # (view, pixel)
    distance: wp.array2d[float],  # (view, pixel) [px]
    depth: wp.array2d[float],  # (view, pixel) [m]
    width: int,
    # Out:
    pole_key_out: wp.array2d[wp.int64],  # (view, instance)
    square_out: wp.array2d[wp.int64],  # (view, instance) [2⁻²⁴ m²]
):
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
        here = int(patch[view, pixel]) & SEGMENT_MASK
        if here != run:
            if run > 0:
                wp.atomic_max(pole_key_out, view, run - 1, key)
                wp.atomic_add(square_out, view, run - 1, square)
            run = here
            key = wp.int64(0)
            square = wp.int64(0)
        if here > 0:
            d = distance[view, pixel]
            z = depth[view, pixel]
            key = wp.max(key, pack_key(wp.int64(wp.rint(d * d)), pixel))
            square += wp.int64(wp.rint(z * z * SQUARE_UNITS))
    if run > 0:
        wp.atomic_max(pole_key_out, view, run - 1, key)
        wp.atomic_add(square_out, view, run - 1, square)


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
    # In:
    views: Views,
    component: wp.array2d[int],  # (view, pixel)
    area: wp.array2d[int],  # (view, pixel) [px]
    largest: wp.array2d[int],  # (view, instance)
    distance: wp.array2d[float],  # (view, pixel) [px]
    pole_key: wp.array2d[wp.int64],  # (view, instance)
    square: wp.array2d[wp.int64],  # (view, instance) [2⁻²⁴ m²]
    width: int,
    # Out:
    visible_out: wp.array2d[int],  # (world, instance) [px]
    visible_fraction_out: wp.array2d[float],  # (world, instance)
    pole_out: wp.array2d[wp.vec2],  # (world, instance) [px]
    centroid_inout: wp.array2d[wp.vec2],  # (world, instance) [px]
    distances_out: wp.array2d[wp.vec3],  # (world, instance) [px]
):
    """Visible pixels, visible fraction Σ (z / fx) (z / fy) / expected area, pole p, and distances to the contour at p, c and (p + c) / 2.

    c is the centroid. Instances that are not visible get 0 pixels, fraction 0, distances 0, and points (-1, -1). Launched over view,
    instance.
    """
    view, instance = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    label = largest[view, instance]
    if label < 0:
        visible_out[world, instance] = 0
        visible_fraction_out[world, instance] = 0.0
        pole_out[world, instance] = wp.vec2(-1.0, -1.0)
        centroid_inout[world, instance] = wp.vec2(-1.0, -1.0)
        distances_out[world, instance] = wp.vec3(0.0, 0.0, 0.0)
        return
    focal = intrinsics[0]
    surface = wp.float64(square[view, instance]) / wp.float64(SQUARE_UNITS * focal[0] * focal[1])
    pixel = unpack_pixel(pole_key[view, instance])
    row = pixel // width
    pole = wp.vec2(float(pixel - row * width), float(row))
    centroid = centroid_inout[world, instance]
    visible_out[world, instance] = area[view, label]
    visible_fraction_out[world, instance] = float(surface) / catalog.area[catalog_index[world, instance]]
    pole_out[world, instance] = pole
    distances_out[world, instance] = wp.vec3(
        distance[view, pixel],
        distance_at(component, distance, view, width, label, centroid),
        distance_at(component, distance, view, width, label, 0.5 * (pole + centroid)),
    )


@wp.kernel
def choose_grasp_points_kernel(
    # Scene:
    catalog: CatalogData,
    perception: PerceptionData,
    # State:
    catalog_index: wp.array2d[int],  # (world, instance)
    # In:
    views: Views,
    visible: wp.array2d[int],  # (world, instance) [px]
    pole: wp.array2d[wp.vec2],  # (world, instance) [px]
    centroid: wp.array2d[wp.vec2],  # (world, instance) [px]
    distances: wp.array2d[wp.vec3],  # (world, instance) [px]
    hit_depth: wp.array3d[float],  # (view, row, column) [m]
    # Out:
    midpoint_out: wp.array2d[wp.vec2],  # (world, instance) [px]
    grasp_pixel_out: wp.array2d[wp.vec2i],  # (world, instance) [px]
    depth_out: wp.array2d[float],  # (world, instance) [m]
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
    midpoint_out[world, instance] = 0.5 * (pole[world, instance] + centroid[world, instance])
    if visible[world, instance] == 0:
        grasp_pixel_out[world, instance] = wp.vec2i(-1, -1)
        depth_out[world, instance] = 0.0
        return
    threshold = perception.center_fraction
    if catalog.mass[catalog_index[world, instance]] > perception.heavy_mass:
        threshold = perception.heavy_center_fraction
    d = distances[world, instance]
    point = centroid[world, instance]
    ratio = d[1] / d[0]
    if d[2] > d[1]:
        point = midpoint_out[world, instance]
        ratio = d[2] / d[0]
    if ratio <= threshold:
        point = pole[world, instance]
    pixel = round_to_pixel(point)
    grasp_pixel_out[world, instance] = pixel
    depth_out[world, instance] = hit_depth[view, pixel[1], pixel[0]]
