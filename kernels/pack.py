"""What leaves a tick: the snapshot for pictures and a few numbers a world for the host."""

import warp as wp

from synpick_warp.kernels.phases import ACT, OVER, delivers
from synpick_warp.kernels.structs import LayoutData

wp.set_module_options({"enable_backward": False})

# Columns of the status table.
STATUS_PHASE = wp.constant(0)
STATUS_OUTCOME = wp.constant(1)
STATUS_EPISODE = wp.constant(2)
STATUS_ATTEMPT = wp.constant(3)
STATUS_FRAME = wp.constant(4)
STATUS_LIVE = wp.constant(5)
# Tote, finger, cup.
FIXTURES = wp.constant(3)


@wp.kernel
def take_snapshot_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    phase: wp.array[int],
    ending: wp.array[int],
    address: wp.array[wp.vec2i],
    frame: wp.array[int],
    entry: wp.array2d[int],
    slot: wp.array2d[int],
    body_q: wp.array[wp.transform],
    # Out:
    live_out: wp.array[int],
    episode_out: wp.array[int],
    frame_out: wp.array[int],
    entry_out: wp.array2d[int],
    pose_out: wp.array2d[wp.transform],
    fixture_pose_out: wp.array2d[wp.transform],
    status_out: wp.array2d[int],
):
    """Copy what pictures need. A tick is a frame while the gripper acts, and once more when it has finished."""
    world = wp.tid()
    live = int(0)
    if phase[world] == ACT or (phase[world] == OVER and delivers(ending[world])):
        live = 1
    live_out[world] = live
    episode_out[world] = address[world][0]
    frame_out[world] = frame[world]
    body = world * layout.bodies
    for instance in range(layout.instances):
        entry_out[world, instance] = entry[world, instance]
        if entry[world, instance] >= 0:
            pose_out[world, instance] = body_q[body + layout.gripper_bodies + slot[world, instance]]
    fixture_pose_out[world, 0] = wp.transform_identity()
    fixture_pose_out[world, 1] = body_q[body]
    fixture_pose_out[world, 2] = body_q[body + 1]
    status_out[world, STATUS_PHASE] = phase[world]
    status_out[world, STATUS_OUTCOME] = ending[world]
    status_out[world, STATUS_EPISODE] = address[world][0]
    status_out[world, STATUS_ATTEMPT] = address[world][1]
    status_out[world, STATUS_FRAME] = frame[world]
    status_out[world, STATUS_LIVE] = live
