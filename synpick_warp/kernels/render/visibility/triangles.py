"""Triangle setup and ray/triangle test of the rasterizer: conservative screen footprint (edge functions), watertight intersection.

For dense meshes rasterizing beats ray tracing: a triangle covers a few known pixels, whereas a ray has to find its triangle in a BVH. The
rays are those of `camera.camera_ray`, so that both agree.
"""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import NEAR_PLANE, PIXEL_CENTER, AnyCameras, ImageGrid, lens_of
from synpick_warp.kernels.render.visibility.gbuffer import Meshes, ViewBodies
from synpick_warp.kernels.render.visibility.lens import BEND, distort

wp.set_module_options({"enable_backward": False})

MARGIN = wp.constant(0.02)
"""A footprint is enlarged by this [px], against rounding of the projected corners: 2e-4 px at 2,000 columns."""
MAX_PROJECTION = wp.constant(16384.0)
"""A corner projected farther out than this [px] is not accurate to MARGIN: the footprint is then the whole image."""
CANCELLATION = wp.constant(1.0e-3)
"""A difference of products below this fraction of their sum is recomputed in float64, where it is exact."""


@wp.struct
class Triangle:
    """Triangle in camera axes [m], with z relative to its body's depth `near` (depth = near + z), which keeps float32 precise far away."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    """Corners."""
    near: float


@wp.struct
class Footprint:
    """Conservative screen footprint of a triangle: a box and three edge functions."""

    pixels: wp.vec4i
    """Box (x_min, y_min, x_max, y_max), inclusive; empty if a maximum is below its minimum."""
    origin: wp.vec2
    """Column and row that are the origin of the edge functions [px]."""
    ab: wp.vec3
    bc: wp.vec3
    ca: wp.vec3
    """Edge functions, see `edge_line`; 0: no bound."""


@wp.func
def camera_triangle(meshes: Meshes, bodies: ViewBodies, view: int, body: int, triangle: int) -> Triangle:
    """Transform a body's triangle into a view's camera axes. Neighbours share corners to the last bit, which watertightness needs."""
    first = 3 * (meshes.first_triangle[bodies.mesh[view, body]] + triangle)
    rotation = wp.transpose(bodies.rotation[view, body])
    start = bodies.start[view, body]
    made = Triangle()
    made.a = rotation * (meshes.corner[first] - start)
    made.b = rotation * (meshes.corner[first + 1] - start)
    made.c = rotation * (meshes.corner[first + 2] - start)
    made.near = bodies.near[view, body]
    return made


@wp.func
def beside_ray(point: wp.vec3, near: float, ray: wp.vec3) -> wp.vec2:
    """Offset of a point from a camera ray at the point's depth, along the image axes [m]: the shear of the watertight test."""
    depth = near + point[2]
    return wp.vec2(point[0] - depth * ray[0], point[1] - depth * ray[1])


@wp.func
def cross(a: wp.vec2, b: wp.vec2) -> float:
    """2D cross product a_x b_y - a_y b_x, in float64 where float32 cancels: its sign is exact, so no ray slips through a shared edge."""
    forward = a[0] * b[1]
    backward = a[1] * b[0]
    difference = forward - backward
    if wp.abs(difference) <= CANCELLATION * (wp.abs(forward) + wp.abs(backward)):
        exact = wp.float64(a[0]) * wp.float64(b[1]) - wp.float64(a[1]) * wp.float64(b[0])
        difference = float(exact)
    return difference


@wp.func
def edge_areas(triangle: Triangle, ray: wp.vec3) -> wp.vec3:
    """Barycentric weights of a, b, c, not yet divided by their sum, at the point where a camera ray meets a triangle's plane."""
    a = beside_ray(triangle.a, triangle.near, ray)
    b = beside_ray(triangle.b, triangle.near, ray)
    c = beside_ray(triangle.c, triangle.near, ray)
    return wp.vec3(cross(c, b), cross(a, c), cross(b, a))


@wp.func
def ray_weights(triangle: Triangle, ray: wp.vec3) -> wp.vec3:
    """Watertight ray/triangle intersection (Woop, Benthin and Wald, 2013): barycentric weights of a, b, c, edges included; -1: a miss. All
    rays start at the camera and have the optical axis as their dominant axis."""
    areas = edge_areas(triangle, ray)
    total = areas[0] + areas[1] + areas[2]
    if (wp.min(areas) < 0.0 and wp.max(areas) > 0.0) or total == 0.0:
        return wp.vec3(-1.0, -1.0, -1.0)
    return areas / total


@wp.func
def edge_line(start: wp.vec2, end: wp.vec2, sense: float, margin: float) -> wp.vec3:
    """Edge function (p, q, r): p column + q row + r >= 0 on the inner side and within `margin` of the edge. `sense` (1 or -1) is the
    triangle's orientation."""
    p = sense * (start[1] - end[1])
    q = sense * (end[0] - start[0])
    return wp.vec3(p, q, margin - p * start[0] - q * start[1])


@wp.func
def is_out_of_sight(grid: ImageGrid, cameras: AnyCameras, intrinsics: wp.vec4, view: int, triangle: Triangle, depth: wp.vec3) -> bool:
    """Frustum culling by the corners' depths: True if all are behind the camera, or (pinholes only) all outside of the same side of the
    image, widened by `MARGIN` px."""
    if wp.max(depth) <= 0.0:
        return True
    if lens_of(cameras, view) >= 0:
        return False
    x = intrinsics[0] * wp.vec3(triangle.a[0], triangle.b[0], triangle.c[0]) + intrinsics[2] * depth
    y = intrinsics[1] * wp.vec3(triangle.a[1], triangle.b[1], triangle.c[1]) + intrinsics[3] * depth
    right, bottom = x - (float(grid.width) + MARGIN) * depth, y - (float(grid.height) + MARGIN) * depth
    beside = wp.max(x + MARGIN * depth) < 0.0 or wp.min(right) > 0.0
    return beside or wp.max(y + MARGIN * depth) < 0.0 or wp.min(bottom) > 0.0


@wp.func
def find_footprint(grid: ImageGrid, cameras: AnyCameras, intrinsics: wp.vec4, view: int, triangle: Triangle) -> Footprint:
    """Project a triangle and compute its conservative footprint, clipped to the image. Lens distortion bends edges: they stay within BEND
    D² / 6 of straight ones (D: longest edge in the normalised plane), added as a margin."""
    found = Footprint()
    found.pixels = wp.vec4i(0, 0, grid.width - 1, grid.height - 1)
    depth = wp.vec3(triangle.near + triangle.a[2], triangle.near + triangle.b[2], triangle.near + triangle.c[2])
    if wp.min(depth) < NEAR_PLANE:
        # A corner so close has no useful projection.
        if is_out_of_sight(grid, cameras, intrinsics, view, triangle, depth):
            found.pixels = wp.vec4i(0, 0, -1, -1)
        return found
    focal = wp.vec2(intrinsics[0], intrinsics[1])
    middle = wp.vec2(intrinsics[2] - PIXEL_CENTER, intrinsics[3] - PIXEL_CENTER)
    a = wp.vec2(triangle.a[0], triangle.a[1]) / depth[0]
    b = wp.vec2(triangle.b[0], triangle.b[1]) / depth[1]
    c = wp.vec2(triangle.c[0], triangle.c[1]) / depth[2]
    wide = float(MARGIN)
    lens = lens_of(cameras, view)
    if lens >= 0:
        longest = wp.max(wp.length_sq(a - b), wp.max(wp.length_sq(b - c), wp.length_sq(c - a)))
        wide += cameras.lenses.number[lens, BEND] * longest / 6.0
        a, _ = distort(cameras.lenses, lens, a)
        b, _ = distort(cameras.lenses, lens, b)
        c, _ = distort(cameras.lenses, lens, c)
    a = wp.cw_mul(focal, a) + middle
    b = wp.cw_mul(focal, b) + middle
    c = wp.cw_mul(focal, c) + middle
    least = wp.min(wp.min(a, b), c)
    most = wp.max(wp.max(a, b), c)
    if wp.max(wp.max(-least), wp.max(most)) > MAX_PROJECTION:
        return found
    width = float(grid.width)
    height = float(grid.height)
    found.pixels = wp.vec4i(
        int(wp.ceil(wp.clamp(least[0] - wide, 0.0, width))),
        int(wp.ceil(wp.clamp(least[1] - wide, 0.0, height))),
        int(wp.floor(wp.clamp(most[0] + wide, -1.0, width - 1.0))),
        int(wp.floor(wp.clamp(most[1] + wide, -1.0, height - 1.0))),
    )
    if found.pixels[2] < found.pixels[0] or found.pixels[3] < found.pixels[1]:
        return found
    # Relative to the box's corner, so that numbers are small. Edge functions are not normalized: the margin is scaled by at least their
    # gradient, that of the longest edge which fits into the box (1 px or more).
    a -= least
    b -= least
    c -= least
    extent = most - least
    margin = wide * (extent[0] + extent[1] + 1.0)
    sense = wp.where((b[0] - a[0]) * (c[1] - a[1]) < (b[1] - a[1]) * (c[0] - a[0]), -1.0, 1.0)
    found.origin = least
    found.ab = edge_line(a, b, sense, margin)
    found.bc = edge_line(b, c, sense, margin)
    found.ca = edge_line(c, a, sense, margin)
    return found


@wp.func
def cut_span(span: wp.vec2, line: wp.vec3, row: float) -> wp.vec2:
    """Clip a row's interval of columns (minimum, maximum) by an edge function."""
    left = span[0]
    right = span[1]
    if line[0] > 0.0:
        left = wp.max(left, -(line[1] * row + line[2]) / line[0])
    elif line[0] < 0.0:
        right = wp.min(right, -(line[1] * row + line[2]) / line[0])
    return wp.vec2(left, right)


@wp.func
def row_span(footprint: Footprint, row: int) -> wp.vec2i:
    """Scanline span: first and last column of a footprint in a row, within its box; empty if last < first."""
    left, right = footprint.pixels[0], footprint.pixels[2]
    begin = float(left) - footprint.origin[0]
    end = float(right) - footprint.origin[0]
    down = float(row) - footprint.origin[1]
    span = cut_span(cut_span(cut_span(wp.vec2(begin, end), footprint.ab, down), footprint.bc, down), footprint.ca, down)
    # The intersection with an almost horizontal edge may be any number, so clamp before rounding.
    before = wp.ceil(wp.min(span[0], end + 1.0) - begin)
    behind = wp.ceil(end - wp.max(span[1], begin - 1.0))
    return wp.vec2i(left + int(before), right - int(behind))
