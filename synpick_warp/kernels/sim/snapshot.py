"""Output of a tick: the snapshot for rendering, the previous frame's poses, and the status rows that the host reads."""

import warp as wp

from synpick_warp.codes import Measure, Phase, Status, Task
from synpick_warp.kernels.bitsets import NO_MEMBERS
from synpick_warp.kernels.sim.endings import delivers
from synpick_warp.kernels.state import Attempts, FramePoses, Motion, Plans, Seals, Snapshots, Worlds
from synpick_warp.kernels.structs import BinData, CatalogData, LayoutData

wp.set_module_options({"enable_backward": False})

HOLD = wp.constant(1.0e-5)
"""Hysteresis of poses: a body keeps the pose of the previous frame until one of its points is displaced by more than this [m], a tenth of
a depth count. Bodies at rest creep by 0.1 to 50 µm a tick; with it, most have identical poses in successive frames."""
FIXTURE_REACH = wp.constant(1.0)
"""Upper bound of the distance of a fixture's points from its origin [m]."""


@wp.func
def is_held(now: wp.transform, then: wp.transform, reach: float) -> bool:
    """Whether no point of a body within `reach` of its origin [m] is farther than HOLD from where it was at the pose `then`."""
    turn = wp.transform_get_rotation(now) * wp.quat_inverse(wp.transform_get_rotation(then))
    sine = wp.min(wp.length(wp.vec3(turn[0], turn[1], turn[2])), 1.0)
    return wp.length(wp.transform_get_translation(now) - wp.transform_get_translation(then)) + 2.0 * reach * sine <= HOLD


@wp.kernel
def take_snapshot_kernel(layout: LayoutData, bins: BinData, state: Worlds, attempts: Attempts, motion: Motion, snapshot_out: Snapshots):
    """Copy episode, frame, catalog indices and poses of objects and fixtures into the snapshot.

    `live` is 1 if the tick is a frame: in phase ACT, and in the tick in which an episode ends that becomes part of the data set
    (`delivers`). The gripper is invisible during task LOOK, in which it waits at home. Fixtures are bin, gripper shaft ("finger") and cup.
    Launched over world.
    """
    world = wp.tid()
    live = int(0)
    if state.phase[world] == Phase.ACT or (state.phase[world] == Phase.OVER and delivers(state.ending[world])):
        live = 1
    snapshot_out.live[world] = live
    snapshot_out.episode[world] = state.arrangement_id[world][0]
    snapshot_out.frame[world] = state.frame[world]
    body = world * layout.bodies
    for instance in range(layout.instances):
        snapshot_out.catalog_index[world, instance] = state.catalog_index[world, instance]
        if state.catalog_index[world, instance] >= 0:
            snapshot_out.pose[world, instance] = motion.body_q[body + layout.gripper_bodies + state.body_slot[world, instance]]
    gripper = wp.where(attempts.task[world] == Task.LOOK, 0, 1)
    snapshot_out.fixture_pose[world, 0] = bins.pose[world]
    snapshot_out.fixture_visible[world, 0] = bins.visible
    for link in range(2):
        snapshot_out.fixture_pose[world, 1 + link] = motion.body_q[body + link]
        snapshot_out.fixture_visible[world, 1 + link] = gripper


@wp.kernel
def link_frames_kernel(catalog: CatalogData, snapshot_inout: Snapshots, last_inout: FramePoses):
    """Copy the last tick's poses into this snapshot as its previous frame, for optical and scene flow, then store this tick's; bodies that
    moved by less than HOLD since then keep them.

    `follows` is 1 if the last tick was the preceding frame of the same episode; its first frame follows none. Launched over world.
    """
    world = wp.tid()
    follows = int(0)
    if snapshot_inout.live[world] != 0 and last_inout.live[world] != 0:
        if snapshot_inout.episode[world] == last_inout.episode[world] and snapshot_inout.frame[world] == last_inout.frame[world] + 1:
            follows = 1
    snapshot_inout.follows[world] = follows
    last_inout.live[world] = snapshot_inout.live[world]
    last_inout.episode[world] = snapshot_inout.episode[world]
    last_inout.frame[world] = snapshot_inout.frame[world]
    for instance in range(snapshot_inout.catalog_index.shape[1]):
        entry = snapshot_inout.catalog_index[world, instance]
        if follows != 0 and entry >= 0 and entry == last_inout.catalog_index[world, instance]:
            if is_held(snapshot_inout.pose[world, instance], last_inout.pose[world, instance], catalog.radius[entry]):
                snapshot_inout.pose[world, instance] = last_inout.pose[world, instance]
        snapshot_inout.last_catalog_index[world, instance] = last_inout.catalog_index[world, instance]
        snapshot_inout.last_pose[world, instance] = last_inout.pose[world, instance]
        last_inout.catalog_index[world, instance] = snapshot_inout.catalog_index[world, instance]
        last_inout.pose[world, instance] = snapshot_inout.pose[world, instance]
    for fixture in range(snapshot_inout.fixture_pose.shape[1]):
        if follows != 0 and is_held(snapshot_inout.fixture_pose[world, fixture], last_inout.fixture_pose[world, fixture], FIXTURE_REACH):
            snapshot_inout.fixture_pose[world, fixture] = last_inout.fixture_pose[world, fixture]
        snapshot_inout.last_fixture_pose[world, fixture] = last_inout.fixture_pose[world, fixture]
        snapshot_inout.last_fixture_visible[world, fixture] = last_inout.fixture_visible[world, fixture]
        last_inout.fixture_pose[world, fixture] = snapshot_inout.fixture_pose[world, fixture]
        last_inout.fixture_visible[world, fixture] = snapshot_inout.fixture_visible[world, fixture]


@wp.kernel
def pack_status_kernel(
    # State:
    snapshot: Snapshots,
    state: Worlds,
    attempts: Attempts,
    plan: Plans,
    seals: Seals,
    # Out:
    status_out: wp.array2d[int],  # (world, status)
    measure_out: wp.array2d[float],  # (world, measure)
):
    """Pack the columns of `Status` and `Measure` of each world, which the host reads after each tick. Launched over world."""
    world = wp.tid()
    status_out[world, Status.PHASE] = state.phase[world]
    status_out[world, Status.ENDING] = state.ending[world]
    status_out[world, Status.EPISODE] = state.arrangement_id[world][0]
    status_out[world, Status.ARRANGEMENT] = state.arrangement_id[world][1]
    status_out[world, Status.FRAME] = state.frame[world]
    status_out[world, Status.LIVE] = snapshot.live[world]
    status_out[world, Status.MODE] = state.mode[world]
    status_out[world, Status.TASK] = attempts.task[world]
    status_out[world, Status.ATTEMPT] = attempts.attempt[world]
    status_out[world, Status.OUTCOME] = attempts.outcome[world]
    status_out[world, Status.TARGET] = plan.target[world]
    status_out[world, Status.HITS] = 0
    status_out[world, Status.SEALED] = 0
    if attempts.attempt[world] >= 0:
        status_out[world, Status.HITS] = attempts.hits[world][0]
        status_out[world, Status.SEALED] = attempts.hits[world][1]
    measure_out[world, Measure.PEAK_FORCE] = seals.peak[world][0]
    least = float(0.0)
    for cup in range(seals.break_force.shape[1]):
        force = seals.break_force[world, cup]
        if force > 0.0 and (least == 0.0 or force < least):
            least = force
    measure_out[world, Measure.BREAK_FORCE] = least


@wp.kernel
def copy_sets_kernel(
    # State:
    attempts: Attempts,
    # Out:
    engaged_out: wp.array2d[wp.uint32],  # (world, word)
    attached_out: wp.array2d[wp.uint32],  # (world, word)
):
    """Copy the bit sets of engaged and attached instances beside the status rows; engaged are none before the first attempt. Launched over
    world, word.
    """
    world, word = wp.tid()
    engaged_out[world, word] = NO_MEMBERS
    if attempts.attempt[world] >= 0:
        engaged_out[world, word] = attempts.engaged_words[world, word]
    attached_out[world, word] = attempts.attached_words[world, word]
