"""Rays of the pixels of distorted cameras whose camera matrix episodes draw, from those of the scene."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import Cameras, LensCameras, pinhole_ray
from synpick_warp.kernels.render.visibility.lens import table_ray, undistort

wp.set_module_options({"enable_backward": False})


@wp.kernel
def compute_rays_kernel(
    # Scene:
    cameras: Cameras,
    # In:
    slot: wp.array[int],  # (view)
    view_cameras: LensCameras,
    # Out:
    ray_out: wp.array3d[wp.vec2],  # (view, row, column)
):
    """Ray of each pixel of the views that have a lens, by Newton's method from that of the same pixel in the scene, `cameras`.

    `slot` is the row of a view's camera in the scene. Launched over view, row, column.
    """
    view, row, column = wp.tid()
    if view_cameras.lens[view] >= 0:
        center = wp.vec2(0.0, 0.0)
        ray = pinhole_ray(view_cameras.intrinsics[view], row, column, center)
        near = table_ray(cameras.lenses, cameras.lens[slot[view]], row, column, center)
        goal = wp.vec2(ray[0], ray[1])
        ray_out[view, row, column] = undistort(view_cameras.lenses, view_cameras.lens[view], goal, wp.vec2(near[0], near[1]))
