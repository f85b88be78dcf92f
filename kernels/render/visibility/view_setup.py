"""Bodies before cameras: where they stand, in which order, and which of them a tile's rays may meet."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import (
    PIXEL_CENTER,
    TILE_HEIGHT,
    TILE_WIDTH,
    Cameras,
    ImageGrid,
    Views,
    camera_ray,
    projected_box,
)
from synpick_warp.kernels.render.visibility.gbuffer import FAR, FIXTURES, Meshes, ViewBodies, body_ray_start

wp.set_module_options({"enable_backward": False})

TILE_REACH = wp.constant(5.5)
"""Rays of a tile pass within this many pixels of the ray of its middle: half its diagonal, 4.5, and colour samples' offsets."""


@wp.kernel
def aim_views_kernel(
    # Out:
    views_inout: Views,
):
    """Views of a world look through camera 0, views of none (-1) through none (-1)."""
    view = wp.tid()
    views_inout.camera[view] = 0
    if views_inout.world[view] < 0:
        views_inout.camera[view] = -1


@wp.kernel
def set_up_views_kernel(
    # Scene:
    meshes: Meshes,
    cameras: Cameras,
    grid: ImageGrid,
    # State:
    catalog_index: wp.array2d[int],
    pose: wp.array2d[wp.transformf],
    fixture_pose: wp.array2d[wp.transformf],
    fixture_visible: wp.array2d[int],
    # In:
    views: Views,
    # Out:
    bodies_out: ViewBodies,
):
    """Place bodies of a view's world (-1: none) before the view's camera: x_camera = R (x_world - c), in float64, stored in float32."""
    view, body = wp.tid()
    world = views.world[view]
    camera = views.camera[view]
    mesh = int(-1)
    placed = wp.transform_identity(dtype=float)
    if world < 0:
        mesh = -1
    elif body < views.instances:
        mesh = catalog_index[world, body]
        placed = pose[world, body]
    elif fixture_visible[world, body - views.instances] != 0:
        mesh = meshes.entries + body - views.instances
        placed = fixture_pose[world, body - views.instances]
    bodies_out.mesh[view, body] = mesh
    if body == views.instances:
        bodies_out.uses_background[view] = int(mesh >= 0 and placed == wp.transform_identity(dtype=float))
    if mesh < 0:
        bodies_out.box[view, body] = wp.vec4i(0, 0, -1, -1)
        bodies_out.sphere[view, body] = wp.vec4(0.0, 0.0, 0.0, -1.0)
        return

    p = wp.transform_get_translation(placed)
    q = wp.transform_get_rotation(placed)
    position = wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]))
    rotation = wp.quat_to_matrix(wp.normalize(wp.quatd(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3]))))
    to_camera = cameras.rotation[camera] * rotation
    origin = cameras.rotation[camera] * (position - cameras.center[camera])

    c = meshes.center[mesh]
    center = wp.vec3d(wp.float64(c[0]), wp.float64(c[1]), wp.float64(c[2]))
    radius = meshes.radius[mesh]
    near = wp.max(float((to_camera * center + origin)[2]) - radius, 0.0)
    start = wp.transpose(to_camera) * (wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(near)) - origin)
    sphere = rotation * center + position

    bodies_out.rotation[view, body] = wp.mat33(wp.transpose(to_camera))
    bodies_out.start[view, body] = wp.vec3(start)
    bodies_out.near[view, body] = near
    bodies_out.box[view, body] = projected_box(meshes.lower[mesh], meshes.upper[mesh], to_camera, origin, cameras.intrinsics[camera], grid)
    bodies_out.world_rotation[view, body] = wp.mat33(wp.transpose(rotation))
    bodies_out.position[view, body] = p
    bodies_out.sphere[view, body] = wp.vec4(float(sphere[0]), float(sphere[1]), float(sphere[2]), radius * radius)


@wp.func
def rank_depth(bodies: ViewBodies, view: int, body: int) -> float:
    """What bodies are ranked by [m]. A ray that has met an object in the tote seldom has to look at the tote, see `stays_in_interior`."""
    if body == bodies.mesh.shape[1] - FIXTURES:
        return FAR
    return bodies.near[view, body]


@wp.kernel
def sort_bodies_kernel(
    # Out:
    bodies_inout: ViewBodies,
):
    """List a view's bodies that are there, the nearest first and the tote last: a body's rank is the number of those before it."""
    view, body = wp.tid()
    bodies = bodies_inout.mesh.shape[1]
    near = rank_depth(bodies_inout, view, body)
    there = bodies_inout.mesh[view, body] >= 0
    rank = int(0)
    total = int(0)
    for other in range(bodies):
        if bodies_inout.mesh[view, other] >= 0:
            total += 1
            other_near = rank_depth(bodies_inout, view, other)
            if other_near < near or (other_near == near and other < body):
                rank += 1
    if there:
        bodies_inout.order[view, rank] = body
    if body == 0:
        bodies_inout.present[view] = total


@wp.func
def meets_box(lower: wp.vec3, upper: wp.vec3, start: wp.vec3, direction: wp.vec3) -> bool:
    """Whether the line through `start` along `direction` meets a box."""
    enter = float(-FAR)
    leave = float(FAR)
    for axis in range(3):
        if direction[axis] == 0.0:
            if start[axis] < lower[axis] or start[axis] > upper[axis]:
                return False
        else:
            a = (lower[axis] - start[axis]) / direction[axis]
            b = (upper[axis] - start[axis]) / direction[axis]
            enter = wp.max(enter, wp.min(a, b))
            leave = wp.min(leave, wp.max(a, b))
    return enter <= leave


@wp.kernel
def bin_bodies_kernel(
    # Scene:
    meshes: Meshes,
    cameras: Cameras,
    grid: ImageGrid,
    # In:
    views: Views,
    # Out:
    bodies_inout: ViewBodies,
):
    """Which bodies the rays of a tile's pixels may meet: those whose box, in its own axes, the ray of the tile's middle meets.

    Boxes are made larger by how far the tile's rays lie apart at the body's far side.
    """
    view, tile = wp.tid()
    camera = views.camera[view]
    found = wp.uint64(0)
    if camera >= 0:
        intrinsics = cameras.intrinsics[camera]
        tile_row = tile // grid.tile_columns
        row = tile_row * TILE_HEIGHT
        column = (tile - tile_row * grid.tile_columns) * TILE_WIDTH
        middle = wp.vec2(0.5 * float(TILE_WIDTH) - PIXEL_CENTER, 0.5 * float(TILE_HEIGHT) - PIXEL_CENTER)
        ray = camera_ray(intrinsics, row, column, middle)
        apart = TILE_REACH / wp.min(intrinsics[0], intrinsics[1])
        for number in range(bodies_inout.present[view]):
            body = bodies_inout.order[view, number]
            box = bodies_inout.box[view, body]
            if column <= box[2] and column + TILE_WIDTH > box[0] and row <= box[3] and row + TILE_HEIGHT > box[1]:
                mesh = bodies_inout.mesh[view, body]
                far = bodies_inout.near[view, body] + 2.0 * meshes.radius[mesh]
                margin = wp.vec3(apart * far, apart * far, apart * far)
                start = body_ray_start(bodies_inout, view, body, ray)
                direction = bodies_inout.rotation[view, body] * ray
                if meets_box(meshes.lower[mesh] - margin, meshes.upper[mesh] + margin, start, direction):
                    found = found | (wp.uint64(1) << wp.uint64(number))
    bodies_inout.body_mask[view, tile] = found
