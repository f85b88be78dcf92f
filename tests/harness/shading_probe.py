"""Test kernel that moves barycentric weights from the middle of a pixel to a shaded point."""

import warp as wp

from synpick_warp.kernels.render.lighting.shading import move_weights
from synpick_warp.kernels.render.visibility.triangles import Triangle, edge_areas

wp.set_module_options({"enable_backward": False})


@wp.kernel
def move_weights_kernel(
    # In:
    corners: wp.array2d[wp.vec3],  # (sample, corner) camera axes [m]
    ray: wp.array[wp.vec3],  # (sample), depth 1
    middle: wp.array[wp.vec3],  # (sample)
    # Out:
    weights_out: wp.array[wp.vec3],  # (sample)
    fraction_out: wp.array[float],  # (sample)
):
    """Weights of the point where each ray meets its triangle's plane, and the fraction of the way from `middle`."""
    i = wp.tid()
    triangle = Triangle()
    triangle.a = corners[i, 0]
    triangle.b = corners[i, 1]
    triangle.c = corners[i, 2]
    weights, fraction = move_weights(middle[i], edge_areas(triangle, ray[i]))
    weights_out[i] = weights
    fraction_out[i] = fraction
