"""Tangent planes of what pixels show, as other pixels of the image see them: who lies on the same surface."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import camera_ray

wp.set_module_options({"enable_backward": False})


@wp.struct
class Plane:
    """The tangent plane of what a pixel, or a cell's, shows. n . ray is linear in the image."""

    segment: wp.uint8
    """As in `GBuffer`."""
    normal: wp.vec3
    """In the camera's axes."""
    height: float
    """n . x of its points x [m]: distance from the camera's centre, times a sign."""
    facing: float
    """n . ray of its own ray, and by how much n . ray changes from row to row and column to column, of pixels or of cells."""
    down: float
    right: float
    width: float
    """Of a pixel, or of a cell, at its depth [m]."""


@wp.func
def pixel_plane(intrinsics: wp.vec4, row: int, column: int, segment: wp.uint8, depth: float, normal: wp.vec3) -> Plane:
    """The tangent plane of what a pixel shows; `normal` is in the camera's axes."""
    made = Plane()
    made.segment = segment
    made.normal = normal
    made.facing = wp.dot(normal, camera_ray(intrinsics, row, column, wp.vec2(0.0, 0.0)))
    made.down = normal[1] / intrinsics[1]
    made.right = normal[0] / intrinsics[0]
    made.height = depth * made.facing
    made.width = depth / intrinsics[0]
    return made


@wp.func
def off_plane(plane: Plane, down: int, right: int, depth: float) -> float:
    """Distance [m] from a plane of what is seen at a planar depth, so many rows down and columns right of the plane's own."""
    return wp.abs(depth * (plane.facing + float(down) * plane.down + float(right) * plane.right) - plane.height)
