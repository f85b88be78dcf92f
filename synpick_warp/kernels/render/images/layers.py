"""Annotation layers (AOVs) computed from the G-buffer: normals, albedo, NOCS, class ids, optical flow and scene flow.

`synpick_warp.views.layers` has the table of layers, and says what to touch to add one.
"""

from collections.abc import Callable
from typing import Any

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.images.camera_effects import SensorParameters
from synpick_warp.kernels.render.lighting.color import srgb_byte
from synpick_warp.kernels.render.lighting.materials import interpolate_surface, make_table_surface, map_table, material_at, wear_at
from synpick_warp.kernels.render.lighting.paths.tracing import AnyScene
from synpick_warp.kernels.render.lighting.surfaces import Surface
from synpick_warp.kernels.render.visibility.camera import (
    NEAR_PLANE,
    AnyViews,
    camera_ray,
    hit_position,
    in_image,
    lens_of,
    tile_pixel,
)
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot, Hit, ViewBodies, body_of, read_hit
from synpick_warp.kernels.render.visibility.lens import distort
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.state import Snapshots

wp.set_module_options({"enable_backward": False})

SMALL_SHIFT = wp.constant(1.0e-8)
"""Squared distance in the normalised plane below which a lens moves points by its Jacobian: the difference of two places is rounded."""


@wp.struct
class BodyMotions:
    """Motion of each body, and of the table as the last, from this frame back to the previous one, in the camera's axes. Scratch."""

    known: wp.array2d[int]
    """1: the body was in the scene in the previous frame, of the same episode; of the table: the camera has moved (view, body)."""
    rotation: wp.array2d[wp.mat33]
    """Rotation R from the current to the previous orientation, minus the identity (view, body)."""
    origin: wp.array2d[wp.vec3]
    """Current origin of the body (view, body) [m]."""
    displacement: wp.array2d[wp.vec3]
    """From the current origin to the previous one (view, body) [m]."""


@wp.func
def rotation_of(pose: wp.transformf) -> wp.mat33d:
    """Rotation matrix of a pose, in float64."""
    q = wp.transform_get_rotation(pose)
    return wp.quat_to_matrix(wp.normalize(wp.quatd(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3]))))


@wp.func
def position_of(pose: wp.transformf) -> wp.vec3d:
    """Translation of a pose, in float64 [m]."""
    p = wp.transform_get_translation(pose)
    return wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]))


@kernel_of_views
def compute_motions_kernel(
    # State:
    snapshot: Snapshots,
    # In:
    views: AnyViews,
    last_rotation: wp.array[wp.mat33d],  # (view)
    last_center: wp.array[wp.vec3d],  # (view) [m]
    # Out:
    motions_out: BodyMotions,
):
    """Relative rigid motion of each body: p_then - p = (R_then R⁻¹ - 1) (p - o) + (o_then - o), in float64, stored in float32.

    `motions_out` receives R_then R⁻¹ - 1, o and o_then - o, rotated to the camera's axes; positions of then are those in the axes of
    the camera then, which has moved with the gripper or not at all. Differences are stored instead of poses, so that small motions have
    small errors. `follows` is 1 if the last tick was the previous frame of the same episode. Launched over view, body and table.
    """
    view, body = wp.tid()
    world = views.world[view]
    known = snapshot.follows[world]
    now = wp.transform_identity(dtype=float)
    then = now
    to_camera = views.cameras.rotation[view]
    center = views.cameras.center[view]
    moves = int(1)
    if last_center[view] == center and last_rotation[view] == to_camera:
        moves = 0
    if body == motions_out.known.shape[1] - 1:
        known *= moves
    elif body < views.instances:
        now = snapshot.pose[world, body]
        then = snapshot.last_pose[world, body]
        if snapshot.catalog_index[world, body] < 0 or snapshot.last_catalog_index[world, body] != snapshot.catalog_index[world, body]:
            known = 0
    else:
        now = snapshot.fixture_pose[world, body - views.instances]
        then = snapshot.last_fixture_pose[world, body - views.instances]
        known *= snapshot.last_fixture_visible[world, body - views.instances]
    motions_out.known[view, body] = known
    if known == 0:
        return
    rotation = last_rotation[view] * rotation_of(then) * wp.transpose(rotation_of(now)) * wp.transpose(to_camera)
    displacement = to_camera * (position_of(then) - position_of(now))
    if moves != 0:
        displacement = last_rotation[view] * (position_of(then) - last_center[view]) - to_camera * (position_of(now) - center)
    motions_out.rotation[view, body] = wp.mat33(rotation - wp.identity(n=3, dtype=wp.float64))
    motions_out.origin[view, body] = wp.vec3(to_camera * (position_of(now) - center))
    motions_out.displacement[view, body] = wp.vec3(displacement)


@wp.struct
class SuctionScene:
    """Radius of the suction cup, and centres of mass of the catalog's objects. Constant."""

    radius: float
    """[m]"""
    center_of_mass: wp.array[wp.vec3]
    """(entry): in the object's frame [m]."""


@wp.struct
class LayerScene:
    """What layers need beside the renderer's scene and views."""

    obj_id: wp.array[int]
    """(entry): obj_id of the catalog's objects; negative: without label."""
    suction: SuctionScene
    sensor: SensorParameters
    nearest: wp.array2d[float]
    """(view, row of tiles): least depth [m]; for the layer depth_sensor."""
    motions: BodyMotions
    follows: wp.array[int]
    """(world): as in `Snapshots`."""


def kernel_of_layer(value: wp.Function, name: str, dtype: Any) -> Callable[..., None]:
    """Kernel that writes a function of pixels to the layer `name`. Launched over view, pixel (tile order, from flat index `first` on)."""

    @kernel_of_views(name=f"render_{name}_kernel")
    def render_layer_kernel(
        # Scene:
        scene: AnyScene,
        layer: LayerScene,
        # In:
        shot: AnyShot,
        first: int,
        # Out:
        image_out: wp.array3d[dtype],  # (view, row, column)
    ):
        """Layer of which `value` is the law."""
        view, row, column = tile_pixel(shot.grid, wp.tid() + first)
        if in_image(shot.grid, row, column):
            image_out[view, row, column] = value(scene, layer, shot, view, row, column)

    return render_layer_kernel


@wp.func
def seen_surface(scene: AnyScene, shot: AnyShot, bodies: ViewBodies, view: int, hit: Hit, point: wp.vec3, to_camera: wp.vec3) -> Surface:
    """Surface attributes of a hit at `point` in the camera's axes [m]; the hit must be of a body or the table."""
    cameras = shot.views.cameras
    width = hit.depth / cameras.intrinsics[view][0]
    if hit.segment == Segment.TABLE:
        table = make_table_surface(scene.meshes, scene.surfaces, bodies, view, to_camera)
        return map_table(scene.surfaces, table, hit_position(cameras, view, point, 1.0), to_camera, width)
    body = body_of(hit.segment, shot.views.instances)
    return interpolate_surface(scene.meshes, scene.surfaces, bodies, view, body, hit.triangle, hit.barycentric, to_camera, width)


@wp.func
def hit_surface(scene: AnyScene, shot: AnyShot, view: int, row: int, column: int) -> Surface:
    """Surface attributes of a pixel's primary hit, from the G-buffer; the pixel must show a body or the table."""
    ray = camera_ray(shot.views.cameras, view, row, column, wp.vec2(0.0, 0.0))
    hit = read_hit(shot.gbuffer, view, row, column)
    to_camera = -wp.normalize(shot.views.cameras.to_world[view] * ray)
    return seen_surface(scene, shot, shot.bodies, view, hit, hit.depth * ray, to_camera)


@wp.func
def normal_at(scene: AnyScene, layer: LayerScene, shot: AnyShot, view: int, row: int, column: int) -> wp.vec3:
    """Normal map: the interpolated shading normal in the camera's axes; zero without surface."""
    normal = wp.vec3(0.0, 0.0, 0.0)
    if int(shot.gbuffer.segment[view, row, column]) != Segment.NOTHING:
        normal = wp.transpose(shot.views.cameras.to_world[view]) * hit_surface(scene, shot, view, row, column).normal
    return normal


@wp.func
def albedo_at(scene: AnyScene, layer: LayerScene, shot: AnyShot, view: int, row: int, column: int) -> wp.vec3ub:
    """Albedo map: base colour, material times texture filtered over the pixel, as sRGB bytes; black without surface."""
    color = wp.vec3(0.0, 0.0, 0.0)
    if int(shot.gbuffer.segment[view, row, column]) != Segment.NOTHING:
        surface = hit_surface(scene, shot, view, row, column)
        color = material_at(scene.surfaces, surface, wear_at(scene.surfaces, surface, False)).color
    return wp.vec3ub(srgb_byte(color[0]), srgb_byte(color[1]), srgb_byte(color[2]))


@wp.func
def nocs_at(scene: AnyScene, layer: LayerScene, shot: AnyShot, view: int, row: int, column: int) -> wp.vec3:
    """NOCS map, normalized object coordinates (Wang et al., 2019): (p - c) / |u - l| + 1/2, c = (l + u) / 2, l and u the mesh's bounds.
    Zero stands for no instance, or one without label: no point of an object with an extent has 0 in all three components."""
    segment = int(shot.gbuffer.segment[view, row, column])
    coordinates = wp.vec3(0.0, 0.0, 0.0)
    if segment != Segment.NOTHING and segment <= shot.views.instances:
        mesh = shot.bodies.mesh[view, segment - 1]
        if layer.obj_id[mesh] >= 0:
            lower = scene.meshes.lower[mesh]
            upper = scene.meshes.upper[mesh]
            barycentric = shot.gbuffer.barycentric[view, row, column]
            triangle = shot.gbuffer.triangle[view, row, column]
            point = wp.mesh_eval_position(scene.meshes.id[mesh], triangle, barycentric[0], barycentric[1])
            coordinates = (point - 0.5 * (lower + upper)) / wp.length(upper - lower) + wp.vec3(0.5, 0.5, 0.5)
    return coordinates


@wp.func
def class_at(scene: AnyScene, layer: LayerScene, shot: AnyShot, view: int, row: int, column: int) -> wp.uint16:
    """Semantic segmentation: the class id, obj_id, of the visible instance; 0 without instance, or of one without label."""
    segment = int(shot.gbuffer.segment[view, row, column])
    class_id = int(0)
    if segment != Segment.NOTHING and segment <= shot.views.instances:
        class_id = wp.max(layer.obj_id[shot.bodies.mesh[view, segment - 1]], 0)
    return wp.uint16(class_id)


@wp.func
def displacement_at(scene: AnyScene, layer: LayerScene, shot: AnyShot, view: int, row: int, column: int) -> wp.vec3:
    """Backward scene flow: displacement of the surface point to the previous frame, each in the axes of its camera [m]; NaN: unknown."""
    cameras, motions = shot.views.cameras, layer.motions
    unknown = wp.vec3(wp.NAN, wp.NAN, wp.NAN)
    segment = int(shot.gbuffer.segment[view, row, column])
    if segment == Segment.NOTHING or layer.follows[shot.views.world[view]] == 0:
        return unknown
    table = motions.known.shape[1] - 1
    body = table
    if segment != Segment.TABLE:
        body = body_of(segment, shot.views.instances)
    if motions.known[view, body] == 0:
        if body == table:
            return wp.vec3(0.0, 0.0, 0.0)
        return unknown
    depth = shot.gbuffer.depth[view, row, column]
    # One component after the other: their order decides which product is fused with the difference below, and so the last bits.
    x = depth * camera_ray(cameras, view, row, column, wp.vec2(0.0, 0.0))[0]
    y = depth * camera_ray(cameras, view, row, column, wp.vec2(0.0, 0.0))[1]
    point = wp.vec3(x, y, depth)
    return motions.rotation[view, body] * (point - motions.origin[view, body]) + motions.displacement[view, body]


@wp.func
def flow_at(scene: AnyScene, layer: LayerScene, shot: AnyShot, view: int, row: int, column: int) -> wp.vec2:
    """Backward optical flow [px]: f_x ((x + d_x) / (z + d_z) - x / z) = f_x (d_x - (x / z) d_z) / (z + d_z), rows alike; through a lens,
    the difference of both places. NaN where the displacement d is unknown, and where the point was behind the camera."""
    cameras = shot.views.cameras
    intrinsics = cameras.intrinsics[view]
    ray = camera_ray(cameras, view, row, column, wp.vec2(0.0, 0.0))
    d = displacement_at(scene, layer, shot, view, row, column)
    depth = shot.gbuffer.depth[view, row, column] + d[2]
    flow = wp.vec2(wp.NAN, wp.NAN)
    if depth > NEAR_PLANE:
        flow = wp.vec2(intrinsics[0] * (d[0] - ray[0] * d[2]) / depth, intrinsics[1] * (d[1] - ray[1] * d[2]) / depth)
        lens = lens_of(cameras, view)
        if lens >= 0:
            shift = wp.vec2(flow[0] / intrinsics[0], flow[1] / intrinsics[1])
            now, jacobian = distort(cameras.lenses, lens, wp.vec2(ray[0], ray[1]))
            change = jacobian * shift
            if wp.length_sq(shift) > SMALL_SHIFT:
                before, _ = distort(cameras.lenses, lens, wp.vec2(ray[0], ray[1]) + shift)
                change = before - now
            flow = wp.vec2(intrinsics[0] * change[0], intrinsics[1] * change[1])
    return flow


render_normals_kernel = kernel_of_layer(normal_at, "normals", wp.vec3)
render_albedo_kernel = kernel_of_layer(albedo_at, "albedo", wp.vec3ub)
render_nocs_kernel = kernel_of_layer(nocs_at, "nocs", wp.vec3)
render_classes_kernel = kernel_of_layer(class_at, "classes", wp.uint16)
render_scene_flow_kernel = kernel_of_layer(displacement_at, "scene_flow", wp.vec3)
render_flow_kernel = kernel_of_layer(flow_at, "flow", wp.vec2)
