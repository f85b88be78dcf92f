"""Kernel that lets tests call the gripper's inverse kinematics."""

import warp as wp

from synpick_warp.kernels.perception import grasp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def frame_kernel(
    normal: wp.array[wp.vec3],
    limit: float,
    angles_out: wp.array[wp.vec2],
    limited_out: wp.array[wp.vec3],
):
    """Limited normal and its angles."""
    i = wp.tid()
    limited = grasp.limited_normal(normal[i], limit)
    limited_out[i] = limited
    angles_out[i] = grasp.gripper_angles(limited)
