"""What leaves a tick: the snapshot for pictures and a few numbers a world for the host."""

import warp as wp

from synpick_warp.codes import Measure, Phase, Status, Task
from synpick_warp.kernels.sim.endings import delivers
from synpick_warp.kernels.structs import LayoutData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def take_snapshot_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    phase: wp.array[int],
    ending: wp.array[int],
    arrangement_id: wp.array[wp.vec2i],
    frame: wp.array[int],
    task: wp.array[int],
    catalog_index: wp.array2d[int],
    body_slot: wp.array2d[int],
    body_q: wp.array[wp.transform],
    # Out:
    live_out: wp.array[int],
    episode_out: wp.array[int],
    frame_out: wp.array[int],
    catalog_index_out: wp.array2d[int],
    pose_out: wp.array2d[wp.transform],
    fixture_pose_out: wp.array2d[wp.transform],
    fixture_visible_out: wp.array2d[int],
):
    """Copy what pictures need. A tick is a frame while the gripper acts, and once more when it has finished.

    The gripper is not in the picture while it LOOKs: it then waits at home.
    """
    world = wp.tid()
    live = int(0)
    if phase[world] == Phase.ACT or (phase[world] == Phase.OVER and delivers(ending[world])):
        live = 1
    live_out[world] = live
    episode_out[world] = arrangement_id[world][0]
    frame_out[world] = frame[world]
    body = world * layout.bodies
    for instance in range(layout.instances):
        catalog_index_out[world, instance] = catalog_index[world, instance]
        if catalog_index[world, instance] >= 0:
            pose_out[world, instance] = body_q[body + layout.gripper_bodies + body_slot[world, instance]]
    gripper = wp.where(task[world] == Task.LOOK, 0, 1)
    fixture_pose_out[world, 0] = wp.transform_identity()
    fixture_visible_out[world, 0] = 1
    for link in range(2):
        fixture_pose_out[world, 1 + link] = body_q[body + link]
        fixture_visible_out[world, 1 + link] = gripper


@wp.struct
class FramePoses:
    """What a frame must tell the next one: parts of a snapshot."""

    live: wp.array[int]
    episode: wp.array[int]
    frame: wp.array[int]
    catalog_index: wp.array2d[int]
    pose: wp.array2d[wp.transform]
    """Object to world [m]."""
    fixture_pose: wp.array2d[wp.transform]
    """Fixture to world [m]."""
    fixture_visible: wp.array2d[int]


@wp.kernel
def link_frames_kernel(
    # In:
    now: FramePoses,
    # Out:
    last_inout: FramePoses,
    follows_out: wp.array[int],
    catalog_index_out: wp.array2d[int],
    pose_out: wp.array2d[wp.transform],
    fixture_pose_out: wp.array2d[wp.transform],
    fixture_visible_out: wp.array2d[int],
):
    """Put the last tick's poses beside this one's, and keep these for the next.

    A frame follows the last one if that was the frame before it in the same episode: an episode's first frame follows none.
    """
    world = wp.tid()
    follows = int(0)
    if now.live[world] != 0 and last_inout.live[world] != 0:
        if now.episode[world] == last_inout.episode[world] and now.frame[world] == last_inout.frame[world] + 1:
            follows = 1
    follows_out[world] = follows
    last_inout.live[world] = now.live[world]
    last_inout.episode[world] = now.episode[world]
    last_inout.frame[world] = now.frame[world]
    for instance in range(now.catalog_index.shape[1]):
        catalog_index_out[world, instance] = last_inout.catalog_index[world, instance]
        pose_out[world, instance] = last_inout.pose[world, instance]
        last_inout.catalog_index[world, instance] = now.catalog_index[world, instance]
        last_inout.pose[world, instance] = now.pose[world, instance]
    for fixture in range(now.fixture_pose.shape[1]):
        fixture_pose_out[world, fixture] = last_inout.fixture_pose[world, fixture]
        fixture_visible_out[world, fixture] = last_inout.fixture_visible[world, fixture]
        last_inout.fixture_pose[world, fixture] = now.fixture_pose[world, fixture]
        last_inout.fixture_visible[world, fixture] = now.fixture_visible[world, fixture]


@wp.kernel
def pack_status_kernel(
    # State:
    live: wp.array[int],
    phase: wp.array[int],
    ending: wp.array[int],
    arrangement_id: wp.array[wp.vec2i],
    frame: wp.array[int],
    mode: wp.array[int],
    task: wp.array[int],
    attempt: wp.array[int],
    outcome: wp.array[int],
    target: wp.array[int],
    hits: wp.array[int],
    engaged_bits: wp.array[wp.uint32],
    attached_bits: wp.array[wp.uint32],
    peak_force: wp.array[float],
    # Out:
    status_out: wp.array2d[int],
    measure_out: wp.array2d[float],
):
    """Gather the few numbers of each world that the host reads."""
    world = wp.tid()
    status_out[world, Status.PHASE] = phase[world]
    status_out[world, Status.ENDING] = ending[world]
    status_out[world, Status.EPISODE] = arrangement_id[world][0]
    status_out[world, Status.ARRANGEMENT] = arrangement_id[world][1]
    status_out[world, Status.FRAME] = frame[world]
    status_out[world, Status.LIVE] = live[world]
    status_out[world, Status.MODE] = mode[world]
    status_out[world, Status.TASK] = task[world]
    status_out[world, Status.ATTEMPT] = attempt[world]
    status_out[world, Status.OUTCOME] = outcome[world]
    status_out[world, Status.TARGET] = target[world]
    status_out[world, Status.HITS] = 0
    status_out[world, Status.ENGAGED] = 0
    if attempt[world] >= 0:
        status_out[world, Status.HITS] = hits[world]
        status_out[world, Status.ENGAGED] = int(engaged_bits[world])
    status_out[world, Status.ATTACHED] = int(attached_bits[world])
    measure_out[world, Measure.PEAK_FORCE] = peak_force[world]
