"""How much of the main light and of the sky reaches each hit: few rays a pixel, shared by neighbours through a filter."""

import warp as wp

from synpick_warp.kernels.camera_rays import Cameras, ImageGrid, camera_ray, tile_pixel
from synpick_warp.kernels.environment import Lights, turned
from synpick_warp.kernels.hits import NOTHING, TABLE, Bodies, Hits, Meshes, Table, body_of, is_blocked

wp.set_module_options({"enable_backward": False})

CELL = wp.constant(4)
"""Width of the filter's window [px]: occlusion rays differ within cells of 4 x 4 pixels, so that each window sees all of a cell's.
Cells differ within blocks of 4 x 4 cells, and blocks repeat: a second window, over every fourth pixel, sees all of a block's."""
RAY_OFFSET = wp.constant(2.0e-4)
"""Secondary rays start this far off the surface [m], so that they do not hit it again."""
SHADOW_REACH = wp.constant(10.0)
"""Length of shadow rays [m]: more than a scene measures."""
OCCLUDER_DISTANCE = wp.constant(0.1)
"""Usual distance from a surface in a tote to what shades it [m]."""
SAME_SURFACE = wp.constant(2.0)
"""Neighbours count as the same surface up to this distance from its tangent plane, in pixel widths at their depth."""


@wp.struct
class OcclusionRays:
    """How hidden light is found."""

    shadow: int
    """Rays a pixel towards the main light; 0: no shadows."""
    ambient: int
    """Rays a pixel into the hemisphere; 0: nothing hides the sky."""
    ambient_reach: float
    """Length of ambient rays [m]."""


@wp.struct
class Sample:
    """One of the colour samples of a pixel."""

    offset: wp.vec2
    """From the pixel's centre [px]."""
    shift: wp.vec2
    """Moves the pattern of occlusion rays, so that samples do not repeat each other."""
    weight: float
    """Share of this sample in the pixel."""
    footprint: float
    """Width of what the sample stands for [px]."""
    number: int


@wp.func
def sobol_point(index: int) -> wp.vec2:
    """Point of the two-dimensional Sobol' sequence, 16 bits: aligned runs of 2^k points fill the unit square evenly (Sobol', 1967)."""
    rest = wp.uint32(index)
    x = wp.uint32(0)
    y = wp.uint32(0)
    x_digit = wp.uint32(0x8000)
    y_digit = wp.uint32(0x8000)
    while rest != wp.uint32(0):
        if (rest & wp.uint32(1)) != wp.uint32(0):
            x = x ^ x_digit
            y = y ^ y_digit
        rest = rest >> wp.uint32(1)
        x_digit = x_digit >> wp.uint32(1)
        y_digit = y_digit ^ (y_digit >> wp.uint32(1))
    return wp.vec2((float(x) + 0.5) / 65536.0, (float(y) + 0.5) / 65536.0)


@wp.func
def bayer(row: int, column: int) -> int:
    """Number from 0 to 15 of a place in a cell; neighbours' numbers lie far apart."""
    mixed = row ^ column
    return (mixed & 1) * 8 + (row & 1) * 4 + ((mixed >> 1) & 1) * 2 + ((row >> 1) & 1)


@wp.func
def cell_point(row: int, column: int, ray: int, rays: int, shift: wp.vec2) -> wp.vec2:
    """One of the 256 `rays` points in the unit square that a block shares out: evenly over the block, each cell and each pixel."""
    cell = bayer((row // CELL) % CELL, (column // CELL) % CELL)
    place = bayer(row % CELL, column % CELL)
    point = sobol_point((cell * CELL * CELL + place) * rays + ray) + shift
    return wp.vec2(point[0] - wp.floor(point[0]), point[1] - wp.floor(point[1]))


@wp.func
def is_wide(spread: float, width: float) -> bool:
    """Whether a light with `spread` makes half-shadows so much wider than a window of the filter that they need a whole block's rays.

    `width` [m] is a pixel's at its depth.
    """
    return spread * OCCLUDER_DISTANCE > 2.0 * float(CELL) * width


@wp.func
def around(axis: wp.vec3, local: wp.vec3) -> wp.vec3:
    """`local`, carried from a frame with z up to one whose z is the unit vector `axis` (Duff et al., 2017)."""
    side = float(1.0)
    if axis[2] < 0.0:
        side = float(-1.0)
    a = -1.0 / (side + axis[2])
    b = axis[0] * axis[1] * a
    tangent = wp.vec3(1.0 + side * axis[0] * axis[0] * a, side * b, -side * axis[0])
    bitangent = wp.vec3(b, side + axis[1] * axis[1] * a, -axis[1])
    return local[0] * tangent + local[1] * bitangent + local[2] * axis


@wp.func
def hit_position(cameras: Cameras, camera: int, ray: wp.vec3, depth: float) -> wp.vec3:
    """Where a camera ray reaches a planar depth, in the world [m]."""
    return wp.vec3(cameras.center[camera]) + cameras.to_world[camera] * (depth * ray)


@wp.func
def face_normal(meshes: Meshes, bodies: Bodies, hits: Hits, view: int, row: int, column: int, instances: int) -> wp.vec3:
    """Unit normal, in the world, of the triangle or table that a pixel shows; either side."""
    code = int(hits.code[view, row, column])
    if code == TABLE:
        return wp.vec3(0.0, 0.0, 1.0)
    body = body_of(code, instances)
    local = wp.mesh_eval_face_normal(meshes.id[bodies.mesh[view, body]], hits.triangle[view, row, column])
    return wp.transpose(bodies.world_turn[view, body]) * local


@wp.func
def seen_sky(
    meshes: Meshes,
    table: Table,
    bodies: Bodies,
    view: int,
    instances: int,
    origin: wp.vec3,
    normal: wp.vec3,
    row: int,
    column: int,
    rays: OcclusionRays,
    sample: Sample,
) -> float:
    """Share of the hemisphere about `normal`, weighted by the cosine, that nothing near hides; 1 without rays."""
    if rays.ambient == 0:
        return 1.0
    seen = int(0)
    for i in range(rays.ambient):
        point = cell_point(row, column, i, rays.ambient, sample.shift)
        radius = wp.sqrt(point[0])
        angle = wp.TAU * point[1]
        direction = around(normal, wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), wp.sqrt(1.0 - point[0])))
        if not is_blocked(meshes, table, bodies, view, instances, origin, direction, rays.ambient_reach):
            seen += 1
    return float(seen) / float(rays.ambient)


@wp.func
def seen_light(
    meshes: Meshes,
    table: Table,
    bodies: Bodies,
    view: int,
    instances: int,
    origin: wp.vec3,
    direction: wp.vec3,
    spread: float,
    row: int,
    column: int,
    rays: OcclusionRays,
    sample: Sample,
    wide: bool,
) -> float:
    """Share of the main light's disc, about `direction` and with tangent `spread` of its radius, that nothing hides; 1 without rays."""
    if rays.shadow == 0:
        return 1.0
    block = int(CELL)
    if wide:
        block = CELL * CELL
    seen = int(0)
    for i in range(rays.shadow):
        point = cell_point(row % block, column % block, i, rays.shadow, sample.shift)
        radius = spread * wp.sqrt(point[0])
        angle = wp.TAU * point[1]
        ray = wp.normalize(around(direction, wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), 1.0)))
        if not is_blocked(meshes, table, bodies, view, instances, origin, ray, SHADOW_REACH):
            seen += 1
    return float(seen) / float(rays.shadow)


@wp.kernel
def occlude_kernel(
    # Scene:
    meshes: Meshes,
    table: Table,
    cameras: Cameras,
    grid: ImageGrid,
    lights: Lights,
    # State:
    light: wp.array[int],
    light_turn: wp.array[float],
    # In:
    bodies: Bodies,
    hits: Hits,
    view_world: wp.array[int],
    view_camera: wp.array[int],
    instances: int,
    rays: OcclusionRays,
    sample: Sample,
    first: int,
    # Out:
    occlusion_out: wp.array3d[wp.vec2],
):
    """Visible shares of the main light and of the sky at each hit, one cell's pattern of rays shared by 4 x 4 pixels."""
    pixel = tile_pixel(grid, wp.tid() + first)
    view = pixel[0]
    row = pixel[1]
    column = pixel[2]
    if row >= grid.height or column >= grid.width:
        return
    if int(hits.code[view, row, column]) == NOTHING:
        return
    camera = view_camera[view]
    world = view_world[view]
    ray = camera_ray(cameras.intrinsics[camera], row, column, sample.offset)
    normal = face_normal(meshes, bodies, hits, view, row, column, instances)
    if wp.dot(normal, cameras.to_world[camera] * ray) > 0.0:
        normal = -normal
    origin = hit_position(cameras, camera, ray, hits.depth[view, row, column]) + RAY_OFFSET * normal

    ambient = seen_sky(meshes, table, bodies, view, instances, origin, normal, row, column, rays, sample)
    lit = float(1.0)
    which = light[world]
    direction = turned(lights.main_direction[which], light_turn[world])
    # A surface that faces away gets no main light anyhow; calling it lit keeps the filter from darkening edges.
    if wp.dot(normal, direction) > 0.0 and wp.length_sq(lights.main_irradiance[which]) > 0.0:
        spread = lights.main_spread[which]
        wide = is_wide(spread, hits.depth[view, row, column] / cameras.intrinsics[camera][0])
        lit = seen_light(meshes, table, bodies, view, instances, origin, direction, spread, row, column, rays, sample, wide)
    occlusion_out[view, row, column] = wp.vec2(lit, ambient)


@wp.func
def filtered_occlusion(
    hits: Hits,
    occlusion: wp.array3d[wp.vec2],
    grid: ImageGrid,
    intrinsics: wp.vec4,
    offset: wp.vec2,
    view: int,
    row: int,
    column: int,
    normal: wp.vec3,
    stride: int,
) -> wp.vec2:
    """Mean over a window of CELL x CELL pixels, `stride` apart, of those near the tangent plane of the surface in the middle.

    `normal` is the surface's, in the camera's axes; `offset` is the colour sample's.
    """
    depth = hits.depth[view, row, column]
    ray = camera_ray(intrinsics, row, column, offset)
    # The signed distance of a neighbour from the plane is depth' (n . ray') - depth (n . ray), and n . ray' is linear in the image.
    facing = wp.dot(normal, ray)
    down = normal[1] / intrinsics[1]
    right = normal[0] / intrinsics[0]
    tolerance = SAME_SURFACE * depth / intrinsics[0]
    total = wp.vec2(0.0, 0.0)
    count = float(0.0)
    for i in range(CELL):
        r = row + (i - CELL // 2) * stride
        if r >= 0 and r < grid.height:
            for j in range(CELL):
                c = column + (j - CELL // 2) * stride
                if c >= 0 and c < grid.width:
                    slope = facing + float(r - row) * down + float(c - column) * right
                    if wp.abs(hits.depth[view, r, c] * slope - depth * facing) < tolerance:
                        total += occlusion[view, r, c]
                        count += 1.0
    if count == 0.0:
        return occlusion[view, row, column]
    return total / count


@wp.kernel
def filter_occlusion_kernel(
    # Scene:
    meshes: Meshes,
    cameras: Cameras,
    grid: ImageGrid,
    # In:
    bodies: Bodies,
    hits: Hits,
    occlusion: wp.array3d[wp.vec2],
    view_camera: wp.array[int],
    instances: int,
    sample: Sample,
    first: int,
    # Out:
    occlusion_out: wp.array3d[wp.vec2],
):
    """First of two passes: the mean over windows of neighbouring pixels. Shading makes the second, over every fourth pixel."""
    pixel = tile_pixel(grid, wp.tid() + first)
    view = pixel[0]
    row = pixel[1]
    column = pixel[2]
    if row >= grid.height or column >= grid.width:
        return
    if int(hits.code[view, row, column]) == NOTHING:
        return
    camera = view_camera[view]
    normal = face_normal(meshes, bodies, hits, view, row, column, instances)
    normal = wp.transpose(cameras.to_world[camera]) * normal
    occlusion_out[view, row, column] = filtered_occlusion(
        hits, occlusion, grid, cameras.intrinsics[camera], sample.offset, view, row, column, normal, 1
    )
