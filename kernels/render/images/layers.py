"""Layers of a view beside colour, depth and instances, from its hits: normals, base colour, places on objects, classes, motion."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.color import srgb_byte
from synpick_warp.kernels.render.lighting.materials import Surface, Surfaces, interpolate_surface, make_table_surface, sample_base_color
from synpick_warp.kernels.render.visibility.camera import NEAR_PLANE, Cameras, ImageGrid, Views, camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, Meshes, ViewBodies, body_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class Motions:
    """Scratch, one row a view and body: where the points of the body were in the frame before, in the camera's axes."""

    known: wp.array2d[int]
    """1: the body was in the picture in the frame before, as part of the same episode."""
    rotation: wp.array2d[wp.mat33]
    """Rotation from now to then, minus the identity."""
    origin: wp.array2d[wp.vec3]
    """Origin of the body now [m]."""
    shift: wp.array2d[wp.vec3]
    """From there to its origin then [m]."""


@wp.func
def rotation_of(pose: wp.transformf) -> wp.mat33d:
    """A pose's rotation, in float64."""
    q = wp.transform_get_rotation(pose)
    return wp.quat_to_matrix(wp.normalize(wp.quatd(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3]))))


@wp.func
def position_of(pose: wp.transformf) -> wp.vec3d:
    """A pose's translation, in float64 [m]."""
    p = wp.transform_get_translation(pose)
    return wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]))


@wp.kernel
def prepare_motions_kernel(
    # Scene:
    cameras: Cameras,
    # State:
    catalog_index: wp.array2d[int],
    pose: wp.array2d[wp.transformf],
    fixture_pose: wp.array2d[wp.transformf],
    follows: wp.array[int],
    last_catalog_index: wp.array2d[int],
    last_pose: wp.array2d[wp.transformf],
    last_fixture_pose: wp.array2d[wp.transformf],
    last_fixture_visible: wp.array2d[int],
    # In:
    views: Views,
    # Out:
    motions_out: Motions,
):
    """Relative motion of each body: p_then - p = (R_then R⁻¹ - 1) (p - o) + (o_then - o), in float64, stored in float32.

    Differences are stored, not poses, so that the error of a small motion is small.
    """
    view, body = wp.tid()
    world = views.world[view]
    known = follows[world]
    now = pose[world, 0]
    then = now
    if body < views.instances:
        now = pose[world, body]
        then = last_pose[world, body]
        if catalog_index[world, body] < 0 or last_catalog_index[world, body] != catalog_index[world, body]:
            known = 0
    else:
        now = fixture_pose[world, body - views.instances]
        then = last_fixture_pose[world, body - views.instances]
        known *= last_fixture_visible[world, body - views.instances]
    motions_out.known[view, body] = known
    if known == 0:
        return
    to_camera = cameras.rotation[views.camera[view]]
    rotation = to_camera * rotation_of(then) * wp.transpose(rotation_of(now)) * wp.transpose(to_camera)
    motions_out.rotation[view, body] = wp.mat33(rotation - wp.identity(n=3, dtype=wp.float64))
    motions_out.origin[view, body] = wp.vec3(to_camera * (position_of(now) - cameras.center[views.camera[view]]))
    motions_out.shift[view, body] = wp.vec3(to_camera * (position_of(then) - position_of(now)))


@wp.func
def hit_surface(
    meshes: Meshes,
    surfaces: Surfaces,
    cameras: Cameras,
    bodies: ViewBodies,
    gbuffer: GBuffer,
    view: int,
    row: int,
    column: int,
    camera: int,
    instances: int,
) -> Surface:
    """Surface that a pixel's ray hit, which must have hit something."""
    to_camera = -wp.normalize(cameras.to_world[camera] * camera_ray(cameras.intrinsics[camera], row, column, wp.vec2(0.0, 0.0)))
    segment = int(gbuffer.segment[view, row, column])
    if segment == Segment.TABLE:
        return make_table_surface(meshes, to_camera)
    triangle = gbuffer.triangle[view, row, column]
    barycentric = gbuffer.barycentric[view, row, column]
    width = gbuffer.depth[view, row, column] / cameras.intrinsics[camera][0]
    return interpolate_surface(meshes, surfaces, bodies, view, body_of(segment, instances), triangle, barycentric, to_camera, width)


@wp.kernel
def draw_normals_kernel(
    # Scene:
    meshes: Meshes,
    surfaces: Surfaces,
    cameras: Cameras,
    grid: ImageGrid,
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    first: int,
    # Out:
    normals_out: wp.array3d[wp.vec3],
):
    """The interpolated normal that shading uses, in the camera's axes; zero where nothing is."""
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    camera = views.camera[view]
    normal = wp.vec3(0.0, 0.0, 0.0)
    if int(gbuffer.segment[view, row, column]) != Segment.NOTHING:
        surface = hit_surface(meshes, surfaces, cameras, bodies, gbuffer, view, row, column, camera, views.instances)
        normal = wp.transpose(cameras.to_world[camera]) * surface.normal
    normals_out[view, row, column] = normal


@wp.kernel
def draw_albedo_kernel(
    # Scene:
    meshes: Meshes,
    surfaces: Surfaces,
    cameras: Cameras,
    grid: ImageGrid,
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    first: int,
    # Out:
    albedo_out: wp.array3d[wp.vec3ub],
):
    """Base colour: material times texture, filtered over the pixel; black where nothing is."""
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    color = wp.vec3(0.0, 0.0, 0.0)
    if int(gbuffer.segment[view, row, column]) != Segment.NOTHING:
        surface = hit_surface(meshes, surfaces, cameras, bodies, gbuffer, view, row, column, views.camera[view], views.instances)
        color = sample_base_color(surfaces, surface)
    albedo_out[view, row, column] = wp.vec3ub(srgb_byte(color[0]), srgb_byte(color[1]), srgb_byte(color[2]))


@wp.kernel
def draw_nocs_kernel(
    # Scene:
    meshes: Meshes,
    grid: ImageGrid,
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    first: int,
    # Out:
    nocs_out: wp.array3d[wp.vec3],
):
    """Normalised object coordinates (Wang et al., 2019): (p - c) / |u - l| + 1/2, c = (l + u) / 2, l and u the mesh's bounds.

    No place on an object of any extent gives 0 in all three, which stands for no instance.
    """
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    segment = int(gbuffer.segment[view, row, column])
    place = wp.vec3(0.0, 0.0, 0.0)
    if segment != Segment.NOTHING and segment <= views.instances:
        mesh = bodies.mesh[view, segment - 1]
        lower = meshes.lower[mesh]
        upper = meshes.upper[mesh]
        barycentric = gbuffer.barycentric[view, row, column]
        point = wp.mesh_eval_position(meshes.id[mesh], gbuffer.triangle[view, row, column], barycentric[0], barycentric[1])
        place = (point - 0.5 * (lower + upper)) / wp.length(upper - lower) + wp.vec3(0.5, 0.5, 0.5)
    nocs_out[view, row, column] = place


@wp.kernel
def draw_classes_kernel(
    # Scene:
    grid: ImageGrid,
    obj_id: wp.array[int],
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    first: int,
    # Out:
    classes_out: wp.array3d[wp.uint16],
):
    """obj_id of the instance that is seen, 0 where none is."""
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    segment = int(gbuffer.segment[view, row, column])
    number = int(0)
    if segment != Segment.NOTHING and segment <= views.instances:
        number = obj_id[bodies.mesh[view, segment - 1]]
    classes_out[view, row, column] = wp.uint16(number)


@wp.func
def motion_at(motions: Motions, gbuffer: GBuffer, view: int, row: int, column: int, ray: wp.vec3, follows: int, instances: int) -> wp.vec3:
    """From the point that a pixel's ray met to where it was in the frame before, in the camera's axes [m]; NaN if unknown."""
    unknown = wp.vec3(wp.NAN, wp.NAN, wp.NAN)
    segment = int(gbuffer.segment[view, row, column])
    if segment == Segment.NOTHING or follows == 0:
        return unknown
    if segment == Segment.TABLE:
        return wp.vec3(0.0, 0.0, 0.0)
    body = body_of(segment, instances)
    if motions.known[view, body] == 0:
        return unknown
    point = gbuffer.depth[view, row, column] * ray
    return motions.rotation[view, body] * (point - motions.origin[view, body]) + motions.shift[view, body]


@wp.kernel
def draw_scene_flow_kernel(
    # Scene:
    cameras: Cameras,
    grid: ImageGrid,
    # State:
    follows: wp.array[int],
    # In:
    motions: Motions,
    gbuffer: GBuffer,
    views: Views,
    first: int,
    # Out:
    scene_flow_out: wp.array3d[wp.vec3],
):
    """Displacement of the surface point to the frame before, in the camera's axes [m]."""
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    ray = camera_ray(cameras.intrinsics[views.camera[view]], row, column, wp.vec2(0.0, 0.0))
    scene_flow_out[view, row, column] = motion_at(motions, gbuffer, view, row, column, ray, follows[views.world[view]], views.instances)


@wp.kernel
def draw_flow_kernel(
    # Scene:
    cameras: Cameras,
    grid: ImageGrid,
    # State:
    follows: wp.array[int],
    # In:
    motions: Motions,
    gbuffer: GBuffer,
    views: Views,
    first: int,
    # Out:
    flow_out: wp.array3d[wp.vec2],
):
    """Optical flow to the frame before [px]: f_x ((x + d_x) / (z + d_z) - x / z) = f_x (d_x - (x / z) d_z) / (z + d_z), rows alike.

    NaN where the displacement d is, and where the point was behind the camera.
    """
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    intrinsics = cameras.intrinsics[views.camera[view]]
    ray = camera_ray(intrinsics, row, column, wp.vec2(0.0, 0.0))
    d = motion_at(motions, gbuffer, view, row, column, ray, follows[views.world[view]], views.instances)
    depth = gbuffer.depth[view, row, column] + d[2]
    flow = wp.vec2(wp.NAN, wp.NAN)
    if depth > NEAR_PLANE:
        flow = wp.vec2(intrinsics[0] * (d[0] - ray[0] * d[2]) / depth, intrinsics[1] * (d[1] - ray[1] * d[2]) / depth)
    flow_out[view, row, column] = flow
