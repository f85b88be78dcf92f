"""Per-view setup: camera-space transforms, screen boxes and bounding spheres, front-to-back order, tile binning of bodies."""

import warp as wp

from synpick_warp.kernels.render.visibility.bvh_rays import body_ray_start
from synpick_warp.kernels.render.visibility.camera import (
    PIXEL_CENTER,
    TILE_HEIGHT,
    TILE_WIDTH,
    AnyViews,
    CameraTable,
    ImageGrid,
    camera_ray,
    lens_of,
    projected_box,
)
from synpick_warp.kernels.render.visibility.gbuffer import FAR, FIXTURES, MASK_BITS, Meshes, ViewBodies, fixture_mesh
from synpick_warp.kernels.render.visibility.lens import STRETCH
from synpick_warp.kernels.render.visibility.ray_bodies import write_ray_body
from synpick_warp.kernels.render.visibility.variants import kernel_of_views

wp.set_module_options({"enable_backward": False})

TILE_RADIUS = wp.constant(5.5)
"""Largest distance of a tile's rays from its central ray [px]: half the diagonal, 4.5, plus the offsets of colour samples."""


@kernel_of_views
def aim_views_kernel(views_inout: AnyViews):
    """Set the camera of each view: 0, or -1 where the view is unused (world -1). Launched over view."""
    view = wp.tid()
    views_inout.camera[view] = 0
    if views_inout.world[view] < 0:
        views_inout.camera[view] = -1


@kernel_of_views
def aim_cameras_kernel(cameras: CameraTable, views_inout: AnyViews):
    """Gather camera parameters: copy intrinsics, pose and lens of row `slot` of the scene's to each used view. Launched over view."""
    view = wp.tid()
    if views_inout.camera[view] >= 0:
        camera = views_inout.slot[view]
        views_inout.cameras.intrinsics[view] = cameras.intrinsics[camera]
        views_inout.cameras.rotation[view] = cameras.rotation[camera]
        views_inout.cameras.center[view] = cameras.center[camera]
        views_inout.cameras.to_world[view] = cameras.to_world[camera]
        if cameras.lenses.ray.shape[0] > 0:
            views_inout.cameras.lens[view] = cameras.lens[camera]


@kernel_of_views
def set_up_views_kernel(
    # Scene:
    meshes: Meshes,
    grid: ImageGrid,
    # State:
    bin: wp.array[int],  # (world)
    catalog_index: wp.array2d[int],  # (world, instance)
    pose: wp.array2d[wp.transformf],  # (world, instance) [m]
    fixture_pose: wp.array2d[wp.transformf],  # (world, fixture) [m]
    fixture_visible: wp.array2d[int],  # (world, fixture)
    # In:
    views: AnyViews,
    # Out:
    bodies_out: ViewBodies,
):
    """Transform each body into a view's camera, x_camera = R (x_world - c), in float64, stored in float32. Launched over view, body. Fills
    `ViewBodies` except `order`, `ray_record`, `present` and `body_mask`. Absent bodies, and all bodies of unused views, get mesh -1."""
    view, body = wp.tid()
    world = views.world[view]
    mesh = int(-1)
    placed = wp.transform_identity(dtype=float)
    if world < 0:
        mesh = -1
    elif body < views.instances:
        mesh = catalog_index[world, body]
        placed = pose[world, body]
    elif fixture_visible[world, body - views.instances] != 0:
        mesh = fixture_mesh(meshes, bin[world], body - views.instances)
        placed = fixture_pose[world, body - views.instances]
    bodies_out.mesh[view, body] = mesh
    if body == views.instances:
        bodies_out.uses_background[view] = int(mesh == meshes.entries and placed == wp.transform_identity(dtype=float))
    if mesh < 0:
        bodies_out.box[view, body] = wp.vec4i(0, 0, -1, -1)
        bodies_out.sphere[view, body] = wp.vec4(0.0, 0.0, 0.0, -1.0)
        return
    p = wp.transform_get_translation(placed)
    q = wp.transform_get_rotation(placed)
    position = wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]))
    rotation = wp.quat_to_matrix(wp.normalize(wp.quatd(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3]))))
    to_camera = views.cameras.rotation[view] * rotation
    origin = views.cameras.rotation[view] * (position - views.cameras.center[view])

    c = meshes.center[mesh]
    center = wp.vec3d(wp.float64(c[0]), wp.float64(c[1]), wp.float64(c[2]))
    radius = meshes.radius[mesh]
    near = wp.max(float((to_camera * center + origin)[2]) - radius, 0.0)
    start = wp.transpose(to_camera) * (wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(near)) - origin)
    sphere = rotation * center + position

    bodies_out.rotation[view, body] = wp.mat33(wp.transpose(to_camera))
    bodies_out.start[view, body] = wp.vec3(start)
    bodies_out.near[view, body] = near
    bodies_out.box[view, body] = projected_box(meshes.lower[mesh], meshes.upper[mesh], to_camera, origin, views.cameras, view, grid)
    bodies_out.world_rotation[view, body] = wp.mat33(wp.transpose(rotation))
    bodies_out.position[view, body] = p
    bodies_out.sphere[view, body] = wp.vec4(float(sphere[0]), float(sphere[1]), float(sphere[2]), radius * radius)


@wp.func
def rank_depth(bodies: ViewBodies, view: int, body: int) -> float:
    """Sort key of a body: its near depth [m]; FAR for the tote, which is then tested last: a ray with a hit inside can mostly skip it."""
    if body == bodies.mesh.shape[1] - FIXTURES:
        return FAR
    return bodies.near[view, body]


@wp.kernel
def sort_bodies_kernel(meshes: Meshes, bodies_inout: ViewBodies):
    """Sort the present bodies of each view front to back, the tote last, by counting: a body's rank is the number of bodies before it.
    Writes `order`, `ray_record` and `present`. Launched over view, body."""
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
        write_ray_body(meshes, bodies_inout, view, rank, body)
    if body == 0:
        bodies_inout.present[view] = total


@wp.func
def hits_box(lower: wp.vec3, upper: wp.vec3, start: wp.vec3, direction: wp.vec3) -> bool:
    """Slab test: True if the line through `start` along `direction` intersects a box."""
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


@kernel_of_views
def bin_bodies_kernel(meshes: Meshes, grid: ImageGrid, views: AnyViews, bodies_inout: ViewBodies):
    """Tile binning: `body_mask` of each tile, by place in `order`: bodies whose oriented bounding box the tile's central ray intersects.

    Boxes are enlarged by the tile's radius at the body's far side, so that the mask is conservative for all rays of the tile. A screen box
    is tested first. Launched over view, tile.
    """
    view, tile = wp.tid()
    camera = views.camera[view]
    mask = wp.uint64(0)
    word = int(0)
    if camera >= 0:
        intrinsics = views.cameras.intrinsics[view]
        tile_row = tile // grid.tile_columns
        row = tile_row * TILE_HEIGHT
        column = (tile - tile_row * grid.tile_columns) * TILE_WIDTH
        middle = wp.vec2(0.5 * float(TILE_WIDTH) - PIXEL_CENTER, 0.5 * float(TILE_HEIGHT) - PIXEL_CENTER)
        ray = camera_ray(views.cameras, view, row, column, middle)
        spread = TILE_RADIUS / wp.min(intrinsics[0], intrinsics[1])
        lens = lens_of(views.cameras, view)
        if lens >= 0:
            # The ray of the pixel that is nearest to the middle: of all others in the image, none is farther than the tile's diagonal.
            ray = camera_ray(views.cameras, view, row + TILE_HEIGHT // 2, column + TILE_WIDTH // 2, wp.vec2(0.0, 0.0))
            spread = 2.0 * TILE_RADIUS * views.cameras.lenses.number[lens, STRETCH]
        for rank in range(bodies_inout.present[view]):
            if rank == (word + 1) * MASK_BITS:
                bodies_inout.body_mask[view, tile, word] = mask
                mask = wp.uint64(0)
                word += 1
            body = bodies_inout.order[view, rank]
            box = bodies_inout.box[view, body]
            if column <= box[2] and column + TILE_WIDTH > box[0] and row <= box[3] and row + TILE_HEIGHT > box[1]:
                mesh = bodies_inout.mesh[view, body]
                far = bodies_inout.near[view, body] + 2.0 * meshes.radius[mesh]
                margin = wp.vec3(spread * far, spread * far, spread * far)
                start = body_ray_start(bodies_inout, view, body, ray)
                direction = bodies_inout.rotation[view, body] * ray
                if hits_box(meshes.lower[mesh] - margin, meshes.upper[mesh] + margin, start, direction):
                    mask = mask | (wp.uint64(1) << wp.uint64(rank - word * MASK_BITS))
    while word < bodies_inout.body_mask.shape[2]:
        bodies_inout.body_mask[view, tile, word] = mask
        mask = wp.uint64(0)
        word += 1
