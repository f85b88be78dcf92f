"""Test kernel that evaluates the gripper's inverse kinematics."""

import warp as wp

from synpick_warp.kernels.perception import grasp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def solve_kinematics_kernel(
    # In:
    normal: wp.array[wp.vec3],  # (sample)
    limit: float,
    # Out:
    angles_out: wp.array[wp.vec2],  # (sample) [rad]
    limited_out: wp.array[wp.vec3],  # (sample)
):
    """Limited normal, and yaw and tilt for it."""
    i = wp.tid()
    limited = grasp.limit_normal(normal[i], limit)
    limited_out[i] = limited
    angles_out[i] = grasp.gripper_angles(limited)
