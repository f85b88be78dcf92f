"""Output of a tick: the snapshot for rendering, the previous frame's poses, and the status rows that the host reads."""

import warp as wp

from synpick_warp.codes import Measure, Phase, Status, Task
from synpick_warp.kernels.bitsets import NO_MEMBERS
from synpick_warp.kernels.sim.endings import delivers
from synpick_warp.kernels.structs import BinData, LayoutData

wp.set_module_options({"enable_backward": False})


@wp.struct
class FramePoses:
    """State of each world in one snapshot: whether the tick is a frame, episode and frame index, objects (-1: none) and poses to the world
    of instances and fixtures; the next snapshot repeats these as its previous frame.

    Members are named as in `stages.buffers.LastFrame`.
    """

    live: wp.array[int]
    """(world): 1 if the tick is a frame."""
    episode: wp.array[int]
    """(world): episode index."""
    frame: wp.array[int]
    """(world): frame index in the episode."""
    catalog_index: wp.array2d[int]
    """(world, instance): object of each instance; -1: none."""
    pose: wp.array2d[wp.transform]
    """(world, instance): object to world [m]."""
    fixture_pose: wp.array2d[wp.transform]
    """(world, fixture): fixture to world [m]."""
    fixture_visible: wp.array2d[int]
    """(world, fixture): 0 if it is not rendered."""


@wp.kernel
def take_snapshot_kernel(
    # Scene:
    layout: LayoutData,
    bins: BinData,
    # State:
    phase: wp.array[int],  # (world)
    ending: wp.array[int],  # (world)
    arrangement_id: wp.array[wp.vec2i],  # (world)
    frame: wp.array[int],  # (world)
    task: wp.array[int],  # (world)
    catalog_index: wp.array2d[int],  # (world, instance)
    body_slot: wp.array2d[int],  # (world, instance)
    body_q: wp.array[wp.transform],  # (body) [m]
    # Out:
    now_out: FramePoses,
):
    """Copy episode, frame, catalog indices and poses of objects and fixtures into the snapshot.

    `live` is 1 if the tick is a frame: in phase ACT, and in the tick in which an episode ends that becomes part of the data set
    (`delivers`). The gripper is invisible during task LOOK, in which it waits at home. Fixtures are bin, gripper shaft ("finger") and cup.
    Launched over world.
    """
    world = wp.tid()
    live = int(0)
    if phase[world] == Phase.ACT or (phase[world] == Phase.OVER and delivers(ending[world])):
        live = 1
    now_out.live[world] = live
    now_out.episode[world] = arrangement_id[world][0]
    now_out.frame[world] = frame[world]
    body = world * layout.bodies
    for instance in range(layout.instances):
        now_out.catalog_index[world, instance] = catalog_index[world, instance]
        if catalog_index[world, instance] >= 0:
            now_out.pose[world, instance] = body_q[body + layout.gripper_bodies + body_slot[world, instance]]
    gripper = wp.where(task[world] == Task.LOOK, 0, 1)
    now_out.fixture_pose[world, 0] = bins.pose[world]
    now_out.fixture_visible[world, 0] = bins.visible
    for link in range(2):
        now_out.fixture_pose[world, 1 + link] = body_q[body + link]
        now_out.fixture_visible[world, 1 + link] = gripper


@wp.kernel
def link_frames_kernel(
    # In:
    now: FramePoses,
    # Out:
    last_inout: FramePoses,
    follows_out: wp.array[int],  # (world)
    catalog_index_out: wp.array2d[int],  # (world, instance)
    pose_out: wp.array2d[wp.transform],  # (world, instance) [m]
    fixture_pose_out: wp.array2d[wp.transform],  # (world, fixture) [m]
    fixture_visible_out: wp.array2d[int],  # (world, fixture)
):
    """Copy the last tick's poses into this snapshot as its previous frame, for optical and scene flow, then store this tick's.

    `follows` is 1 if the last tick was the preceding frame of the same episode; the first frame of an episode follows none. Launched over
    world.
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
    live: wp.array[int],  # (world)
    phase: wp.array[int],  # (world)
    ending: wp.array[int],  # (world)
    arrangement_id: wp.array[wp.vec2i],  # (world)
    frame: wp.array[int],  # (world)
    mode: wp.array[int],  # (world)
    task: wp.array[int],  # (world)
    attempt: wp.array[int],  # (world)
    outcome: wp.array[int],  # (world)
    target: wp.array[int],  # (world)
    hits: wp.array[wp.vec2i],  # (world)
    peak: wp.array[wp.vec2],  # (world) [N]
    break_force: wp.array2d[float],  # (world, cup) [N]
    # Out:
    status_out: wp.array2d[int],  # (world, status)
    measure_out: wp.array2d[float],  # (world, measure)
):
    """Pack the columns of `Status` and `Measure` of each world, which the host reads after each tick. Launched over world."""
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
    status_out[world, Status.SEALED] = 0
    if attempt[world] >= 0:
        status_out[world, Status.HITS] = hits[world][0]
        status_out[world, Status.SEALED] = hits[world][1]
    measure_out[world, Measure.PEAK_FORCE] = peak[world][0]
    least = float(0.0)
    for cup in range(break_force.shape[1]):
        force = break_force[world, cup]
        if force > 0.0 and (least == 0.0 or force < least):
            least = force
    measure_out[world, Measure.BREAK_FORCE] = least


@wp.kernel
def copy_sets_kernel(
    # State:
    attempt: wp.array[int],  # (world)
    engaged_words: wp.array2d[wp.uint32],  # (world, word)
    attached_words: wp.array2d[wp.uint32],  # (world, word)
    # Out:
    engaged_out: wp.array2d[wp.uint32],  # (world, word)
    attached_out: wp.array2d[wp.uint32],  # (world, word)
):
    """Copy the bit sets of engaged and attached instances beside the status rows; engaged are none before the first attempt. Launched over
    world, word.
    """
    world, word = wp.tid()
    engaged_out[world, word] = NO_MEMBERS
    if attempt[world] >= 0:
        engaged_out[world, word] = engaged_words[world, word]
    attached_out[world, word] = attached_words[world, word]
