"""Sun shadows: one shadow ray per coarse pixel to a point of the sun's disc, filtered and upsampled along surfaces (soft shadows)."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.coarse_grid import (
    MIN_WEIGHT,
    PLANE_TOLERANCE,
    CoarseGrid,
    middle_pixel,
    morton_index,
    window_coordinate,
)
from synpick_warp.kernels.render.lighting.environment import Lights, rotate_z
from synpick_warp.kernels.render.lighting.plane_distance import Plane, plane_distance, tangent_plane
from synpick_warp.kernels.render.lighting.sampling import rotate_to_axis, sobol_point
from synpick_warp.kernels.render.lighting.upsampling import RING
from synpick_warp.kernels.render.visibility.bvh_rays import RAY_OFFSET, is_blocked
from synpick_warp.kernels.render.visibility.camera import Cameras, Views, camera_ray, clamp_index, hit_position, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import FAR, GBuffer, Meshes, Table, ViewBodies, face_normal, read_hit
from synpick_warp.kernels.tuning import RAY_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})

VISIBILITY_BITS = wp.constant(16)
"""Bits of a packed sun visibility."""
VISIBILITY_MASK = wp.constant((1 << 16) - 1)
"""The lowest VISIBILITY_BITS, and packed sun visibility 1."""
VISIBILITY_STEP = wp.constant(1.0 / ((1 << 16) - 1))
"""Smallest packed sun visibility above 0."""


@wp.func
def pack_visibility(visibility: float, depth: float, segment: wp.uint8) -> wp.uint64:
    """Pack a coarse pixel's sun visibility in VISIBILITY_BITS with its segmentation id and, in the upper half, its depth [m]; so filter and
    upsampling read each neighbour once."""
    fraction = wp.uint32(visibility * float(VISIBILITY_MASK) + 0.5)
    lower = (wp.uint32(segment) << wp.uint32(VISIBILITY_BITS)) | fraction
    return (wp.uint64(wp.cast(depth, wp.uint32)) << wp.uint64(32)) | wp.uint64(lower)


@wp.func
def packed_visibility(packed: wp.uint64) -> float:
    """Sun visibility of a packed coarse pixel."""
    return VISIBILITY_STEP * float(int(wp.uint32(packed) & wp.uint32(VISIBILITY_MASK)))


@wp.func
def packed_segment(packed: wp.uint64) -> wp.uint8:
    """Segmentation id of a packed coarse pixel."""
    return wp.uint8(wp.uint32(packed) >> wp.uint32(VISIBILITY_BITS))


@wp.func
def packed_depth(packed: wp.uint64) -> float:
    """Depth of a packed coarse pixel [m]."""
    return wp.cast(wp.uint32(packed >> wp.uint64(32)), wp.float32)


@wp.kernel(cuda_max_registers=RAY_REGISTERS)
def trace_shadow_rays_kernel(
    # Scene:
    meshes: Meshes,
    table: Table,
    cameras: Cameras,
    coarse: CoarseGrid,
    lights: Lights,
    # State: worlds
    light: wp.array[int],  # (world)
    light_yaw: wp.array[float],  # (world) [rad]
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    first: int,
    # Out:
    visibility_out: wp.array3d[wp.uint64],  # (view, shadow_row, shadow_column)
):
    """Sun visibility, packed: 1 where the ray from a coarse pixel's middle pixel to a sample point of the sun's disc is free, else 0."""
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if not in_image(coarse.grid, row, column):
        return
    which = light[views.world[view]]
    pixel = middle_pixel(coarse, row, column)
    visibility = float(1.0)
    segment = gbuffer.segment[view, pixel[0], pixel[1]]
    depth = gbuffer.depth[view, pixel[0], pixel[1]]
    if wp.max(lights.sun_irradiance[which]) > 0.0 and int(segment) != Segment.NOTHING:
        camera = views.camera[view]
        ray = camera_ray(cameras.intrinsics[camera], pixel[0], pixel[1], wp.vec2(0.0, 0.0))
        normal = face_normal(meshes, bodies, view, read_hit(gbuffer, view, pixel[0], pixel[1]), views.instances)
        if wp.dot(normal, cameras.to_world[camera] * ray) > 0.0:
            normal = -normal
        center = rotate_z(lights.sun_direction[which], light_yaw[views.world[view]])
        # A surface that faces away gets no sunlight in any case; visibility 1 there keeps the filter from darkening edges.
        if wp.dot(normal, center) > 0.0:
            point = sobol_point(morton_index(coarse.window, row, column))
            radius = lights.sun_radius[which] * wp.sqrt(point[0])
            angle = wp.TAU * point[1]
            direction = wp.normalize(rotate_to_axis(center, wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), 1.0)))
            origin = hit_position(cameras, camera, ray, depth) + RAY_OFFSET * normal
            if is_blocked(meshes, table, bodies, view, origin, direction, FAR):
                visibility = 0.0
    visibility_out[view, row, column] = pack_visibility(visibility, depth, segment)


@wp.kernel
def filter_shadows_kernel(
    # Scene:
    meshes: Meshes,
    cameras: Cameras,
    coarse: CoarseGrid,
    lights: Lights,
    # State: worlds
    light: wp.array[int],  # (world)
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    visibility: wp.array3d[wp.uint64],  # (view, shadow_row, shadow_column)
    views: Views,
    first: int,
    # Out:
    visibility_out: wp.array3d[wp.uint64],  # (view, shadow_row, shadow_column)
):
    """Mean sun visibility over a window of coarse pixels on one body and near one tangent plane, packed; not written without a sun."""
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if not in_image(coarse.grid, row, column):
        return
    pixel = middle_pixel(coarse, row, column)
    own = visibility[view, row, column]
    segment = packed_segment(own)
    depth = packed_depth(own)
    if wp.max(lights.sun_irradiance[light[views.world[view]]]) <= 0.0:
        return
    if int(segment) == Segment.NOTHING:
        # Bodies smaller than a coarse pixel may have only background pixels to interpolate from.
        visibility_out[view, row, column] = pack_visibility(1.0, depth, segment)
        return
    camera = views.camera[view]
    normal = wp.transpose(cameras.to_world[camera]) * face_normal(
        meshes, bodies, view, read_hit(gbuffer, view, pixel[0], pixel[1]), views.instances
    )
    plane = tangent_plane(cameras.intrinsics[camera], pixel[0], pixel[1], segment, depth, normal)
    tolerance = PLANE_TOLERANCE * float(coarse.size) * plane.width
    visible = float(0.0)
    total = float(0.0)
    for i in range(coarse.window):
        r = row + i - coarse.window // 2
        if r >= 0 and r < coarse.grid.height:
            for j in range(coarse.window):
                c = column + j - coarse.window // 2
                if c >= 0 and c < coarse.grid.width:
                    packed = visibility[view, r, c]
                    if packed_segment(packed) == segment:
                        other = middle_pixel(coarse, r, c)
                        if plane_distance(plane, other[0] - pixel[0], other[1] - pixel[1], packed_depth(packed)) < tolerance:
                            visible += packed_visibility(packed)
                            total += 1.0
    if total > 0.0:
        visibility_out[view, row, column] = pack_visibility(visible / total, depth, segment)
    else:
        visibility_out[view, row, column] = own


@wp.func
def on_plane(packed: wp.uint64, coarse: CoarseGrid, row: int, column: int, plane: Plane, r: int, c: int) -> bool:
    """Whether the coarse pixel (r, c), packed, shows the surface of the pixel (row, column), whose tangent plane is `plane`."""
    pixel = middle_pixel(coarse, r, c)
    distance = plane_distance(plane, pixel[0] - row, pixel[1] - column, packed_depth(packed))
    return packed_segment(packed) == plane.segment and distance <= PLANE_TOLERANCE * float(coarse.size) * plane.width


@wp.func
def upsample_shadow(
    visibility: wp.array3d[wp.uint64],  # (view, shadow_row, shadow_column)
    coarse: CoarseGrid,
    view: int,
    row: int,
    column: int,
    plane: Plane,
) -> float:
    """Sun visibility at a pixel by joint bilateral upsampling from the four nearest coarse pixels; `plane` is the pixel's tangent plane.

    If all four are on other surfaces, the ring around them is searched too, as for visibility ratios: sunlight of another surface would
    show as bright pixels along the edge.
    """
    y = window_coordinate(coarse, row)
    x = window_coordinate(coarse, column)
    top = int(wp.floor(y))
    left = int(wp.floor(x))
    visible = float(0.0)
    total = float(0.0)
    found = bool(False)
    for i in range(2):
        r = clamp_index(top + i, coarse.grid.height)
        vertical = 1.0 - wp.abs(y - float(top + i))
        for j in range(2):
            c = clamp_index(left + j, coarse.grid.width)
            weight = vertical * (1.0 - wp.abs(x - float(left + j))) + MIN_WEIGHT
            packed = visibility[view, r, c]
            if on_plane(packed, coarse, row, column, plane, r, c):
                found = True
            else:
                weight *= MIN_WEIGHT
            visible += weight * packed_visibility(packed)
            total += weight
    if not found:
        # Not unrolled: few pixels come here.
        ring = int(RING)
        for i in range(-ring, 2 + ring):
            r = clamp_index(top + i, coarse.grid.height)
            for j in range(-ring, 2 + ring):
                c = clamp_index(left + j, coarse.grid.width)
                packed = visibility[view, r, c]
                if on_plane(packed, coarse, row, column, plane, r, c):
                    visible += packed_visibility(packed)
                    total += 1.0
    return visible / total
