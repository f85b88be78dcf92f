"""Observations of the vector environment: depth, segmentation and normals in full precision, target masks, and state vectors."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.materials import interpolate_surface
from synpick_warp.kernels.render.lighting.surfaces import Surfaces
from synpick_warp.kernels.render.visibility.camera import ImageGrid, Views, camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, Meshes, ViewBodies, body_of
from synpick_warp.kernels.state import Motion, Plans, Seals, Worlds
from synpick_warp.kernels.structs import TILT, LayoutData

wp.set_module_options({"enable_backward": False})

# Values of the gripper at the beginning of a state vector: wrist (3), yaw, tilt, number of held objects.
GRIPPER_VALUES = wp.constant(6)
# Values of an instance: present (0 or 1), obj_id, held (0 or 1), pose (7).
INSTANCE_VALUES = wp.constant(10)


@wp.kernel
def copy_images_kernel(
    # Scene:
    meshes: Meshes,
    surfaces: Surfaces,
    grid: ImageGrid,
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    first: int,
    # Out:
    depth_out: wp.array3d[float],  # (world, row, column) [m]
    segment_out: wp.array3d[wp.uint8],  # (world, row, column)
    normal_out: wp.array3d[wp.vec3],  # (world, row, column)
    cloud_out: wp.array3d[wp.vec3],  # (world, row, column) [m]; or empty
):
    """Copy the G-buffer to the worlds' images: planar depth (0: no surface), segmentation id, unit shading normal (up where no mesh is),
    and the surface points in the camera's axes (NaN: no surface).

    Launched over view, pixel (tile order, from flat index `first` on).
    """
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column) or views.world[view] < 0:
        return
    world = views.world[view]
    seen = gbuffer.segment[view, row, column]
    segment = int(seen)
    segment_out[world, row, column] = seen
    depth = float(0.0)
    if segment != Segment.NOTHING:
        depth = gbuffer.depth[view, row, column]
    depth_out[world, row, column] = depth
    axis = camera_ray(views.cameras, view, row, column, wp.vec2(0.0, 0.0))
    if cloud_out.shape[0] > 0:
        cloud_out[world, row, column] = wp.where(segment == Segment.NOTHING, wp.nan, depth) * axis
    normal = wp.vec3(0.0, 0.0, 1.0)
    if segment != Segment.NOTHING and segment != Segment.TABLE:
        ray = views.cameras.to_world[view] * axis
        triangle = gbuffer.triangle[view, row, column]
        barycentric = gbuffer.barycentric[view, row, column]
        body = body_of(segment, views.instances)
        # Only the normal is used; the pixel width (0) affects texture filtering alone.
        surface = interpolate_surface(meshes, surfaces, bodies, view, body, triangle, barycentric, -wp.normalize(ray), 0.0)
        normal = surface.normal
    normal_out[world, row, column] = normal


@wp.kernel
def write_target_masks_kernel(
    # In:
    segment: wp.array3d[wp.uint8],  # (world, row, column)
    target: wp.array[int],  # (world)
    # Out:
    mask_out: wp.array3d[wp.uint8],  # (world, row, column)
):
    """Write the visible mask of each world's target: 1, elsewhere 0. Launched over world, row, column."""
    world, row, column = wp.tid()
    mask_out[world, row, column] = wp.uint8(0)
    if target[world] >= 0 and int(segment[world, row, column]) == target[world] + 1:
        mask_out[world, row, column] = wp.uint8(1)


@wp.kernel
def write_target_points_kernel(
    # In:
    target: wp.array[int],  # (world)
    planned: wp.array[wp.vec3],  # (world) [m]
    # Out:
    point_out: wp.array[wp.vec3],  # (world) [m]
):
    """Copy the planned grasp points of worlds with a target; 0 elsewhere. Launched over world."""
    world = wp.tid()
    point_out[world] = wp.vec3(0.0, 0.0, 0.0)
    if target[world] >= 0:
        point_out[world] = planned[world]


@wp.kernel
def write_states_kernel(
    # Scene:
    layout: LayoutData,
    object_id: wp.array[int],  # (entry)
    # State:
    state: Worlds,
    seals: Seals,
    plan: Plans,
    motion: Motion,
    # Out:
    values_out: wp.array2d[float],  # (world, value)
):
    """Write each world's state vector: wrist, yaw, tilt, number of objects held; then by instance 1 (present), obj_id, held, pose.

    An instance that is not in the scene has zeros. Launched over world.
    """
    world = wp.tid()
    q = world * layout.coords
    for axis in range(3):
        values_out[world, axis] = motion.joint_q[q + axis]
    values_out[world, 3] = plan.yaw[world]
    values_out[world, 4] = motion.joint_q[q + TILT]
    held = float(0.0)
    for instance in range(layout.instances):
        first = int(GRIPPER_VALUES) + instance * int(INSTANCE_VALUES)
        index = state.catalog_index[world, instance]
        for value in range(int(INSTANCE_VALUES)):
            values_out[world, first + value] = 0.0
        if index >= 0:
            values_out[world, first] = 1.0
            values_out[world, first + 1] = float(object_id[index])
            if seals.attached[world, instance] != 0:
                values_out[world, first + 2] = 1.0
                held += 1.0
            pose = motion.body_q[world * layout.bodies + layout.gripper_bodies + state.body_slot[world, instance]]
            for value in range(7):
                values_out[world, first + 3 + value] = pose[value]
    values_out[world, 5] = held
