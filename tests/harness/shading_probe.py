"""Test kernel that moves barycentric weights from the center of a pixel to a shading sample."""

import warp as wp

from synpick_warp.kernels.render.lighting.shading import move_weights, sum_of
from synpick_warp.kernels.render.visibility.triangles import Triangle, edge_areas

wp.set_module_options({"enable_backward": False})


@wp.kernel
def move_weights_kernel(
    # In:
    corners: wp.array2d[wp.vec3],  # (sample, corner) camera axes [m]
    ray: wp.array[wp.vec3],  # (sample), depth 1
    center_ray: wp.array[wp.vec3],  # (sample), depth 1
    center: wp.array[wp.vec3],  # (sample)
    # Out:
    weights_out: wp.array[wp.vec3],  # (sample)
    fraction_out: wp.array[float],  # (sample)
):
    """Weights of the point where each ray meets its triangle's plane, and the fraction of the way from `center`."""
    i = wp.tid()
    triangle = Triangle()
    triangle.a = corners[i, 0]
    triangle.b = corners[i, 1]
    triangle.c = corners[i, 2]
    orientation = wp.sign(sum_of(edge_areas(triangle, center_ray[i])))
    weights, fraction = move_weights(center[i], orientation, edge_areas(triangle, ray[i]))
    weights_out[i] = weights
    fraction_out[i] = fraction
