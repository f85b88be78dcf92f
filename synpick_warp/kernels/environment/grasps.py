"""Suction grasps from actions: a pixel of the observed depth image, or a point with a direction."""

import warp as wp

from synpick_warp.kernels.perception.grasp import gripper_angles, limit_normal
from synpick_warp.kernels.render.visibility.camera import Views, camera_ray, hit_position
from synpick_warp.kernels.structs import PickData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def grasp_pixels_kernel(
    # Scene:
    window: int,
    # In:
    views: Views,
    pixel: wp.array[wp.vec2i],  # (world) [px]
    depth: wp.array3d[float],  # (world, row, column) [m]
    segment: wp.array3d[wp.uint8],  # (world, row, column)
    normal: wp.array3d[wp.vec3],  # (world, row, column)
    # Out:
    point_out: wp.array[wp.vec3],  # (world) [m]
    direction_out: wp.array[wp.vec3],  # (world)
    instance_out: wp.array[int],  # (world)
    running_inout: wp.array[int],  # (world)
):
    """Back-project a pixel (column, row) of each world's depth image: write surface point, smoothed normal and instance.

    `direction` is the sum of the normals of the same segment in a square of 2 `window` + 1 pixels; `instance` is -1 where none is shown.
    `running` becomes 0 where the pixel shows no surface. The camera is that of the first view.
    Launched over world.
    """
    world = wp.tid()
    if running_inout[world] == 0:
        return
    p = pixel[world]
    distance = depth[world, p[1], p[0]]
    if distance <= 0.0:
        running_inout[world] = 0
        return
    seen = segment[world, p[1], p[0]]
    total = wp.vec3(0.0, 0.0, 0.0)
    for row in range(wp.max(p[1] - window, 0), wp.min(p[1] + window + 1, depth.shape[1])):
        for column in range(wp.max(p[0] - window, 0), wp.min(p[0] + window + 1, depth.shape[2])):
            if segment[world, row, column] == seen:
                total += normal[world, row, column]
    instance = int(seen) - 1
    if instance >= views.instances:
        instance = -1
    ray = camera_ray(views.cameras, 0, p[1], p[0], wp.vec2(0.0, 0.0))
    point_out[world] = hit_position(views.cameras, 0, ray, distance)
    direction_out[world] = total
    instance_out[world] = instance


@wp.kernel
def plan_grasps_kernel(
    # Scene:
    pick: PickData,
    keeps_target: int,
    # In:
    running: wp.array[int],  # (world)
    grasp_point: wp.array[wp.vec3],  # (world) [m]
    direction: wp.array[wp.vec3],  # (world)
    instance: wp.array[int],  # (world)
    # Out:
    target_out: wp.array[int],  # (world)
    point_out: wp.array[wp.vec3],  # (world) [m]
    normal_out: wp.array[wp.vec3],  # (world)
    yaw_out: wp.array[float],  # (world) [rad]
    tilt_out: wp.array[float],  # (world) [rad]
):
    """Write the grasp plans of running worlds: point, normal along `direction` (out of the surface, of any length), yaw and tilt.

    The normal is clamped to the tilt limit about the vertical. The target becomes `instance`, unless `keeps_target`. Launched over world.
    """
    world = wp.tid()
    if running[world] == 0:
        return
    normal = limit_normal(direction[world], pick.tilt_limit)
    angles = gripper_angles(normal)
    if keeps_target == 0:
        target_out[world] = instance[world]
    point_out[world] = grasp_point[world]
    normal_out[world] = normal
    yaw_out[world] = angles[0]
    tilt_out[world] = angles[1]
