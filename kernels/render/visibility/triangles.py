"""Triangles before a camera: which pixels' rays may meet one, and where on it they do. Of a dense mesh, a triangle meets a few rays in
known pixels, while a ray would have to look for its triangle in a tree. The rays are those of `camera_rays`."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import NEAR_PLANE, PIXEL_CENTER, ImageGrid
from synpick_warp.kernels.render.visibility.gbuffer import Meshes, ViewBodies

wp.set_module_options({"enable_backward": False})

MARGIN = wp.constant(0.02)
"""A triangle's footprint is larger by this [px], against rounding of its projected corners: 2e-4 px at 2,000 columns."""
FARTHEST = wp.constant(16384.0)
"""A corner projected farther out than this [px] is not known to within MARGIN: then every pixel is tried."""
UNSURE = wp.constant(1.0e-3)
"""A difference of products smaller than this share of them is computed in float64, where it is exact."""


@wp.struct
class Triangle:
    """A triangle before a camera, in the camera's axes, z from `near` on [m]."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    near: float


@wp.struct
class Footprint:
    """Pixels whose rays a triangle may meet."""

    pixels: wp.vec4i
    """x_min, y_min, x_max, y_max, inclusive; none if a largest is below its least."""
    origin: wp.vec2
    """Column and row from which the lines count [px]."""
    ab: wp.vec3
    bc: wp.vec3
    ca: wp.vec3
    """The edges, see `edge_line`; 0: no bound."""


@wp.func
def camera_triangle(meshes: Meshes, bodies: ViewBodies, view: int, body: int, triangle: int) -> Triangle:
    """A body's triangle before a view's camera. Neighbours have the same corners to the last bit."""
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
    """How far a point lies beside a ray, along the image's axes [m]."""
    depth = near + point[2]
    return wp.vec2(point[0] - depth * ray[0], point[1] - depth * ray[1])


@wp.func
def cross(a: wp.vec2, b: wp.vec2) -> float:
    """a_x b_y - a_y b_x; its sign is exact, so that no ray passes between two triangles that share an edge, nor is lost on it."""
    forward = a[0] * b[1]
    backward = a[1] * b[0]
    difference = forward - backward
    if wp.abs(difference) <= UNSURE * (wp.abs(forward) + wp.abs(backward)):
        exact = wp.float64(a[0]) * wp.float64(b[1]) - wp.float64(a[1]) * wp.float64(b[0])
        difference = float(exact)
    return difference


@wp.func
def ray_weights(triangle: Triangle, ray: wp.vec3) -> wp.vec3:
    """Weights of the corners where a ray meets a triangle's plane, edges included; negative: it passes by. Woop, Benthin and Wald,
    "Watertight ray/triangle intersection" (2013), where all rays have one origin and the camera's axis as their longest."""
    a = beside_ray(triangle.a, triangle.near, ray)
    b = beside_ray(triangle.b, triangle.near, ray)
    c = beside_ray(triangle.c, triangle.near, ray)
    u = cross(c, b)
    v = cross(a, c)
    w = cross(b, a)
    total = u + v + w
    if ((u < 0.0 or v < 0.0 or w < 0.0) and (u > 0.0 or v > 0.0 or w > 0.0)) or total == 0.0:
        return wp.vec3(-1.0, -1.0, -1.0)
    return wp.vec3(u / total, v / total, w / total)


@wp.func
def edge_line(start: wp.vec2, end: wp.vec2, sense: float, margin: float) -> wp.vec3:
    """(p, q, r): pixels on the inner side of an edge, or near it, have p column + q row + r >= 0. `sense` is 1 or -1."""
    p = sense * (start[1] - end[1])
    q = sense * (end[0] - start[0])
    return wp.vec3(p, q, margin - p * start[0] - q * start[1])


@wp.func
def find_footprint(grid: ImageGrid, intrinsics: wp.vec4, triangle: Triangle) -> Footprint:
    """Pixels of the image whose rays a triangle may meet."""
    found = Footprint()
    found.pixels = wp.vec4i(0, 0, grid.width - 1, grid.height - 1)
    depth = wp.vec3(triangle.near + triangle.a[2], triangle.near + triangle.b[2], triangle.near + triangle.c[2])
    if wp.min(depth) < NEAR_PLANE:
        # A corner so close has no useful projection.
        return found
    focal = wp.vec2(intrinsics[0], intrinsics[1])
    middle = wp.vec2(intrinsics[2] - PIXEL_CENTER, intrinsics[3] - PIXEL_CENTER)
    a = wp.cw_mul(focal, wp.vec2(triangle.a[0], triangle.a[1]) / depth[0]) + middle
    b = wp.cw_mul(focal, wp.vec2(triangle.b[0], triangle.b[1]) / depth[1]) + middle
    c = wp.cw_mul(focal, wp.vec2(triangle.c[0], triangle.c[1]) / depth[2]) + middle
    least = wp.min(wp.min(a, b), c)
    most = wp.max(wp.max(a, b), c)
    if wp.max(wp.max(-least), wp.max(most)) > FARTHEST:
        return found
    width = float(grid.width)
    height = float(grid.height)
    found.pixels = wp.vec4i(
        int(wp.ceil(wp.clamp(least[0] - MARGIN, 0.0, width))),
        int(wp.ceil(wp.clamp(least[1] - MARGIN, 0.0, height))),
        int(wp.floor(wp.clamp(most[0] + MARGIN, -1.0, width - 1.0))),
        int(wp.floor(wp.clamp(most[1] + MARGIN, -1.0, height - 1.0))),
    )
    if found.pixels[2] < found.pixels[0] or found.pixels[3] < found.pixels[1]:
        return found
    # From the box's corner on, numbers are small. The margin is that of the longest edge that the box can hold, and of no less than 1 px.
    a -= least
    b -= least
    c -= least
    extent = most - least
    margin = MARGIN * (extent[0] + extent[1] + 1.0)
    sense = wp.where((b[0] - a[0]) * (c[1] - a[1]) < (b[1] - a[1]) * (c[0] - a[0]), -1.0, 1.0)
    found.origin = least
    found.ab = edge_line(a, b, sense, margin)
    found.bc = edge_line(b, c, sense, margin)
    found.ca = edge_line(c, a, sense, margin)
    return found


@wp.func
def cut_span(span: wp.vec2, line: wp.vec3, row: float) -> wp.vec2:
    """A row's columns, least and most, on an edge's inner side."""
    least = span[0]
    most = span[1]
    if line[0] > 0.0:
        least = wp.max(least, -(line[1] * row + line[2]) / line[0])
    elif line[0] < 0.0:
        most = wp.min(most, -(line[1] * row + line[2]) / line[0])
    return wp.vec2(least, most)


@wp.func
def row_span(footprint: Footprint, row: int, left: int, right: int) -> wp.vec2i:
    """First and last pixel of a footprint in a row, from column `left` to column `right`; none if the last is below the first."""
    begin = float(left) - footprint.origin[0]
    end = float(right) - footprint.origin[0]
    down = float(row) - footprint.origin[1]
    span = cut_span(cut_span(cut_span(wp.vec2(begin, end), footprint.ab, down), footprint.bc, down), footprint.ca, down)
    # Lines that are all but level may meet the row anywhere.
    before = wp.ceil(wp.min(span[0], end + 1.0) - begin)
    behind = wp.ceil(end - wp.max(span[1], begin - 1.0))
    return wp.vec2i(left + int(before), right - int(behind))
