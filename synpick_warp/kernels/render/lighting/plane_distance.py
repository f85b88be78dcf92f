"""Plane-distance weight of the denoiser: distance of other pixels from the tangent plane of a pixel's surface, an edge-stopping test."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import AnyCameras, loop_ray

wp.set_module_options({"enable_backward": False})


@wp.struct
class Plane:
    """Tangent plane at a pixel or coarse pixel: segmentation id, normal, and n · ray as a linear function of row and column."""

    segment: wp.uint8
    """Segmentation id, as in `GBuffer`."""
    normal: wp.vec3
    """Unit normal n in camera space."""
    height: float
    """n · x of the plane's points x [m]: signed distance from the camera's centre."""
    facing: float
    """n · ray at the plane's own pixel."""
    down: float
    """Change of n · ray per row, of pixels or coarse pixels."""
    right: float
    """Change of n · ray per column, of pixels or coarse pixels."""
    width: float
    """Width of a pixel, or coarse pixel, at the surface's depth [m]."""


@wp.func
def tangent_plane(
    cameras: AnyCameras, intrinsics: wp.vec4, view: int, row: int, column: int, segment: wp.uint8, depth: float, normal: wp.vec3
) -> Plane:
    """Tangent plane of the surface at a pixel; `depth` is planar [m], `normal` is in camera space, `intrinsics` are those of the view."""
    plane = Plane()
    plane.segment = segment
    plane.normal = normal
    plane.facing = wp.dot(normal, loop_ray(cameras, intrinsics, view, row, column, wp.vec2(0.0, 0.0)))
    plane.down = normal[1] / intrinsics[1]
    plane.right = normal[0] / intrinsics[0]
    plane.height = depth * plane.facing
    plane.width = depth / intrinsics[0]
    return plane


@wp.func
def plane_distance(plane: Plane, down: int, right: int, depth: float) -> float:
    """Distance [m] from the plane of a surface at planar `depth` [m], seen `down` rows and `right` columns from the plane's own pixel."""
    return wp.abs(depth * (plane.facing + float(down) * plane.down + float(right) * plane.right) - plane.height)
