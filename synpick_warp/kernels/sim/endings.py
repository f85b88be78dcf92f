"""Endings: decide when an episode is over, and whether it is delivered."""

import warp as wp

from synpick_warp.codes import Ending, Lost, Mode, Phase, Task
from synpick_warp.kernels.state import Attempts, Motion, Worlds
from synpick_warp.kernels.structs import CatalogData, LayoutData, MoveData, PickData, SettleData

wp.set_module_options({"enable_backward": False})


@wp.func
def delivers(ending: int) -> bool:
    """True if an episode with this `Ending` becomes part of the data set."""
    return ending >= Ending.FINISHED and ending <= Ending.GAVE_UP


@wp.kernel
def judge_tasks_kernel(layout: LayoutData, catalog: CatalogData, move: MoveData, pick: PickData, state_inout: Worlds, attempts: Attempts):
    """Write the `Ending` of episodes that complete: all waypoints reached, no object with label left, too many failed attempts, or STILL.

    Launched over world.
    """
    world = wp.tid()
    if state_inout.phase[world] != Phase.ACT:
        return
    if state_inout.mode[world] == Mode.MOVE:
        if state_inout.waypoint[world] >= move.waypoints:
            state_inout.ending[world] = Ending.FINISHED
        return
    if state_inout.mode[world] == Mode.STILL:
        state_inout.ending[world] = Ending.FINISHED
        return
    if attempts.task[world] != Task.LOOK:
        return
    left = int(0)
    for instance in range(layout.instances):
        if state_inout.catalog_index[world, instance] >= 0 and state_inout.catalog_index[world, instance] < catalog.count:
            left += 1
    if left == 0:
        state_inout.ending[world] = Ending.EMPTIED
    elif attempts.failures[world] >= pick.failures:
        state_inout.ending[world] = Ending.GAVE_UP


@wp.func
def is_finite(pose: wp.transform) -> bool:
    """True if no coordinate of a body's position is infinite or NaN."""
    p = wp.transform_get_translation(pose)
    return wp.isfinite(p[0] + p[1] + p[2])


@wp.kernel
def judge_episodes_kernel(
    # Scene:
    layout: LayoutData,
    settle: SettleData,
    # State:
    state_inout: Worlds,
    motion: Motion,
    solver_overflow: wp.array[wp.bool],  # (world)
    perception_overflow: wp.array[int],  # (world)
    lost_inout: wp.array[int],  # (world)
):
    """Move worlds whose episode has an ending to phase OVER; failures override the endings of `judge_tasks_kernel`.

    Failures, each overriding those before it: not settled in time or within the allowed re-drops, an overflow of contour points in
    perception, an overflow of constraint rows in the solver, of contacts or pairs in collision detection, a pose that is not finite.
    `lost`, bits of `Lost`, ends as 0. Launched over world.
    """
    world = wp.tid()
    phase = state_inout.phase[world]
    lost = lost_inout[world]
    lost_inout[world] = 0
    if phase != Phase.SETTLE and phase != Phase.ACT:
        return
    ending = state_inout.ending[world]
    if phase == Phase.SETTLE and (
        state_inout.progress[world][0] >= settle.max_ticks or state_inout.progress[world][2] > settle.max_redrops
    ):
        ending = Ending.UNSETTLED
    if perception_overflow[world] != 0:
        ending = Ending.PERCEPTION_OVERFLOW
    if solver_overflow[world]:
        ending = Ending.SOLVER_OVERFLOW
    if (lost & Lost.CONTACTS) != 0:
        ending = Ending.CONTACT_OVERFLOW
    if (lost & Lost.PAIRS) != 0:
        ending = Ending.PAIR_OVERFLOW
    body = world * layout.bodies
    for link in range(layout.gripper_bodies):
        if not is_finite(motion.body_q[body + link]):
            ending = Ending.NOT_FINITE
    for instance in range(layout.instances):
        if state_inout.catalog_index[world, instance] >= 0:
            if not is_finite(motion.body_q[body + layout.gripper_bodies + state_inout.body_slot[world, instance]]):
                ending = Ending.NOT_FINITE
    if ending != Ending.RUNNING:
        state_inout.ending[world] = ending
        state_inout.phase[world] = Phase.OVER
