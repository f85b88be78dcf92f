"""The gripper's joints as the model has them."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def turn_fingers_kernel(
    # Scene:
    finger_joint: wp.array[int],
    # In:
    yaw: wp.array[float],
    # Out:
    joint_child_out: wp.array[wp.transform],
):
    """Turn each finger by its yaw ψ about z against the axes of its joint: the joint's frame lies in the finger's at R_z(-ψ)."""
    world = wp.tid()
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), -yaw[world])
    joint_child_out[finger_joint[world]] = wp.transform(wp.vec3(0.0, 0.0, 0.0), turn)
