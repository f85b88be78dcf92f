"""Attempts of the vector environment: their start from planned actions, their end, and their results."""

import warp as wp

from synpick_warp.codes import Outcome, Phase, Task
from synpick_warp.kernels.bitsets import NO_MEMBERS, has_member
from synpick_warp.kernels.sim.trials import count_lost, measure_motion
from synpick_warp.kernels.structs import LayoutData

wp.set_module_options({"enable_backward": False})


@wp.struct
class Results:
    """Results of the last attempt of each world, and the poses and counts that they are measured against."""

    outcome: wp.array[int]
    """(world): `Outcome`; NONE if the episode failed first, with its `Ending`."""
    picked: wp.array[int]
    """(world): first instance attached at the end; -1: none."""
    hits: wp.array[wp.vec2i]
    """(world): number of suction rays that hit an object, and bit mask of cups with a good seal."""
    peak_force: wp.array[float]
    """(world): largest seal force, including seals that broke [N]."""
    ticks: wp.array[int]
    """(world): duration [ticks]."""
    moved: wp.array[int]
    """(world): number of objects other than the one picked that were displaced by more than a threshold."""
    farthest: wp.array[float]
    """(world): largest displacement of any object but the one picked [m]."""
    lost: wp.array[int]
    """(world): objects that left the bin without being picked."""
    lost_before: wp.array[int]
    """(world): objects lost in the episode before the attempt began."""
    pose: wp.array2d[wp.transform]
    """(world, instance): pose of each object when the attempt began [m]."""


@wp.kernel
def begin_results_kernel(
    # Scene:
    layout: LayoutData,
    # State:
    removed: wp.array2d[int],  # (world, instance)
    body_slot: wp.array2d[int],  # (world, instance)
    body_q: wp.array[wp.transform],  # (body) [m]
    # Out:
    results_out: Results,
):
    """Reset the results, and write the references of their measurement: poses and number of lost objects. Launched over world."""
    world = wp.tid()
    results_out.outcome[world] = Outcome.NONE
    results_out.picked[world] = -1
    results_out.hits[world] = wp.vec2i(0, 0)
    results_out.peak_force[world] = 0.0
    results_out.ticks[world] = 0
    results_out.moved[world] = 0
    results_out.farthest[world] = 0.0
    results_out.lost[world] = 0
    results_out.lost_before[world] = count_lost(removed, world)
    body = world * layout.bodies + layout.gripper_bodies
    for instance in range(layout.instances):
        results_out.pose[world, instance] = body_q[body + body_slot[world, instance]]


@wp.kernel
def begin_attempts_kernel(
    # State:
    running: wp.array[int],  # (world)
    task_inout: wp.array[int],  # (world)
    attempt_inout: wp.array[int],  # (world)
    # Out:
    steps_out: wp.array[int],  # (world)
    hits_out: wp.array[wp.vec2i],  # (world)
    engaged_words_out: wp.array2d[wp.uint32],  # (world, word)
):
    """Begin the planned attempts of running worlds: write task APPROACH and reset the counters. Launched over world."""
    world = wp.tid()
    if running[world] == 0:
        return
    attempt_inout[world] = attempt_inout[world] + 1
    task_inout[world] = Task.APPROACH
    steps_out[world] = 0
    hits_out[world] = wp.vec2i(0, 0)
    for word in range(engaged_words_out.shape[1]):
        engaged_words_out[world, word] = NO_MEMBERS


@wp.kernel
def judge_attempts_kernel(
    # Scene:
    layout: LayoutData,
    moved_distance: float,
    # State:
    phase: wp.array[int],  # (world)
    outcome: wp.array[int],  # (world)
    hits: wp.array[wp.vec2i],  # (world)
    attached_words: wp.array2d[wp.uint32],  # (world, word)
    peak: wp.array[wp.vec2],  # (world) [N]
    catalog_index: wp.array2d[int],  # (world, instance)
    removed: wp.array2d[int],  # (world, instance)
    body_slot: wp.array2d[int],  # (world, instance)
    body_q: wp.array[wp.transform],  # (body) [m]
    # Out:
    running_inout: wp.array[int],  # (world)
    results_inout: Results,
    world_out: wp.array[int],  # (world)
    done_inout: wp.array[int],  # (one)
):
    """Write the results of running attempts after a tick. Those that ended in it get `running` 0, and `done` is incremented.

    `world` becomes the world's own index where its attempt ended in this tick, for a save; else -1. Launched over world.
    """
    world = wp.tid()
    world_out[world] = -1
    if running_inout[world] == 0:
        return
    picked = int(-1)
    for instance in range(layout.instances):
        if picked < 0 and has_member(attached_words, world, instance):
            picked = instance
    moved, farthest = measure_motion(layout, world, picked, moved_distance, catalog_index, body_slot, body_q, results_inout.pose)
    results_inout.outcome[world] = outcome[world]
    results_inout.picked[world] = picked
    results_inout.hits[world] = hits[world]
    results_inout.peak_force[world] = wp.max(results_inout.peak_force[world], peak[world][0])
    results_inout.ticks[world] = results_inout.ticks[world] + 1
    results_inout.moved[world] = moved
    results_inout.farthest[world] = farthest
    results_inout.lost[world] = count_lost(removed, world) - results_inout.lost_before[world]
    if outcome[world] == Outcome.NONE and phase[world] == Phase.ACT:
        return
    world_out[world] = world
    running_inout[world] = 0
    wp.atomic_add(done_inout, 0, 1)
