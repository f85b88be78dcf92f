"""Where to suck each instance: pole of inaccessibility, centroid, the point half-way, and the rule that chooses among them."""

import warp as wp

from synpick_warp.kernels.perception.components import STRIP, pack_key, unpack_pixel
from synpick_warp.kernels.perception.distance_transform import SEGMENT_MASK
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.structs import CatalogData, PerceptionData

wp.set_module_options({"enable_backward": False})

SQUARE_UNITS = wp.constant(16777216.0)
"""Squared depths are summed as whole multiples of 2⁻²⁴ m², so that the order of the summands does not matter."""


@wp.kernel
def clear_sums_kernel(
    # In:
    views: Views,
    # Out:
    largest_key_out: wp.array2d[wp.int64],
    pole_key_out: wp.array2d[wp.int64],
    square_out: wp.array2d[wp.int64],
    overflow_out: wp.array[int],
):
    """Maxima and sums of every view and instance to 0, and no contour of the worlds looked at has overflowed."""
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
    patch: wp.array2d[wp.uint16],
    distance: wp.array2d[float],
    depth: wp.array2d[float],
    width: int,
    # Out:
    pole_key_out: wp.array2d[wp.int64],
    square_out: wp.array2d[wp.int64],
):
    """Per patch: the maximum of `pack_key(d², pixel)` over its pixels, and Σ z² in units of 2⁻²⁴ m². Both begin as 0.

    d² is a whole number and comes back from its float32 root as long as d < 1600 px; beyond, neighbouring squares may count as equal.
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
def nearest_pixel(point: wp.vec2) -> wp.vec2i:
    """Column and row of the pixel whose centre is nearest; halves go to the even one."""
    return wp.vec2i(int(wp.rint(point[0])), int(wp.rint(point[1])))


@wp.func
def distance_at(component: wp.array2d[int], distance: wp.array2d[float], view: int, width: int, name: int, point: wp.vec2) -> float:
    """Distance to the contour [px] at the pixel nearest to a point; 0 where that is not of the component."""
    pixel = nearest_pixel(point)
    index = pixel[1] * width + pixel[0]
    if component[view, index] != name:
        return 0.0
    return distance[view, index]


@wp.kernel
def measure_points_kernel(
    # Scene:
    catalog: CatalogData,
    intrinsics: wp.array[wp.vec4],
    # State:
    entry: wp.array2d[int],
    # In:
    views: Views,
    component: wp.array2d[int],
    area: wp.array2d[int],
    largest: wp.array2d[int],
    distance: wp.array2d[float],
    pole_key: wp.array2d[wp.int64],
    square: wp.array2d[wp.int64],
    width: int,
    # Out:
    visible_out: wp.array2d[int],
    share_out: wp.array2d[float],
    pole_out: wp.array2d[wp.vec2],
    centroid_inout: wp.array2d[wp.vec2],
    distances_out: wp.array2d[wp.vec3],
):
    """Pixels, share = Σ (z / fx) (z / fy) / expected area, pole, and distance to the contour of pole, centroid c and (pole + c) / 2."""
    view, instance = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    name = largest[view, instance]
    if name < 0:
        visible_out[world, instance] = 0
        share_out[world, instance] = 0.0
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
    visible_out[world, instance] = area[view, name]
    share_out[world, instance] = float(surface) / catalog.area[entry[world, instance]]
    pole_out[world, instance] = pole
    distances_out[world, instance] = wp.vec3(
        distance[view, pixel],
        distance_at(component, distance, view, width, name, centroid),
        distance_at(component, distance, view, width, name, 0.5 * (pole + centroid)),
    )


@wp.kernel
def choose_grasp_points_kernel(
    # Scene:
    catalog: CatalogData,
    sight: PerceptionData,
    # State:
    entry: wp.array2d[int],
    # In:
    views: Views,
    visible: wp.array2d[int],
    pole: wp.array2d[wp.vec2],
    centroid: wp.array2d[wp.vec2],
    distances: wp.array2d[wp.vec3],
    hit_depth: wp.array3d[float],
    # Out:
    middle_out: wp.array2d[wp.vec2],
    suction_out: wp.array2d[wp.vec2i],
    depth_out: wp.array2d[float],
):
    """With r = distance / pole's distance: of centroid and middle the one with the larger r, if r > center_share; else the pole.

    The centroid wins a tie. Above heavy_mass [kg] the share asked for is heavy_center_share (Periyasamy et al., 2021).
    """
    view, instance = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    middle_out[world, instance] = 0.5 * (pole[world, instance] + centroid[world, instance])
    if visible[world, instance] == 0:
        suction_out[world, instance] = wp.vec2i(-1, -1)
        depth_out[world, instance] = 0.0
        return
    share = sight.center_share
    if catalog.mass[entry[world, instance]] > sight.heavy_mass:
        share = sight.heavy_center_share
    found = distances[world, instance]
    point = centroid[world, instance]
    ratio = found[1] / found[0]
    if found[2] > found[1]:
        point = middle_out[world, instance]
        ratio = found[2] / found[0]
    if ratio <= share:
        point = pole[world, instance]
    pixel = nearest_pixel(point)
    suction_out[world, instance] = pixel
    depth_out[world, instance] = hit_depth[view, pixel[1], pixel[0]]
