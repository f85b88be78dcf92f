"""Choice of the target: the instance to pick next, by its ancestors in the clutter graph and its visibility."""

import warp as wp

from synpick_warp.codes import Mode, Outcome, Stream
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.rng import stream_key, uniform_index
from synpick_warp.kernels.state import Attempts, Observations, Plans, Worlds
from synpick_warp.kernels.structs import PickData

wp.set_module_options({"enable_backward": False})


@wp.func
def sample_visible(visible: wp.array2d[int], world: int, key: wp.uint64, index: int) -> int:
    """Uniform random choice among the visible instances, by sample `index` of the stream `key`; -1: none is visible."""
    instances = visible.shape[1]
    count = int(0)
    for i in range(instances):
        if visible[world, i] > 0:
            count += 1
    if count == 0:
        return -1
    remaining = uniform_index(key, index, count)
    chosen = int(-1)
    for i in range(instances):
        if visible[world, i] > 0:
            if remaining == 0:
                chosen = i
            remaining -= 1
    return chosen


@wp.func
def rank_visible(observation: Observations, target_failures: wp.array2d[int], world: int, sign: float) -> int:
    """Visible instance with the smallest sign · (number of ancestors) + failures, then the largest sign · fraction, then the smallest
    index; or -1. A failed attempt weighs as one more object above, one since the last success more than all objects.
    """
    chosen = int(-1)
    least = float(0.0)
    largest = float(0.0)
    for i in range(observation.visible.shape[1]):
        if observation.visible[world, i] > 0:
            members = int(0)
            for word in range(observation.ancestors.shape[2]):
                members += int(wp.bit_count(observation.ancestors[world, i, word]))
            # Whole numbers, which are exact in single precision.
            count = sign * float(members) + float(target_failures[world, i])
            fraction = sign * observation.visible_fraction[world, i]
            if chosen < 0 or count < least or (count == least and fraction > largest):
                chosen = i
                least = count
                largest = fraction
    return chosen


@wp.kernel
def choose_target_kernel(
    seed: wp.uint64, pick: PickData, state: Worlds, attempts: Attempts, observation: Observations, views: Views, plan_out: Plans
):
    """Choose a target: the visible instance with the fewest ancestors, ties by the largest visible fraction; -1: none is visible.

    In mode TARGET the one with the most ancestors, ties by the smallest fraction. `target_failures` weigh as `rank_visible` says. With
    `random_after_failure`, mode TARGET samples a visible instance uniformly after an attempt that failed in this tick; the index of the
    coming attempt is the sample's index in the stream. Launched over view.
    """
    view = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    chosen = int(-1)
    if state.mode[world] != Mode.TARGET:
        chosen = rank_visible(observation, attempts.target_failures, world, 1.0)
    elif pick.random_after_failure != 0 and attempts.outcome[world] >= Outcome.DROPPED:
        key = stream_key(seed, state.arrangement_id[world][0], state.arrangement_id[world][1], Stream.TARGETS)
        chosen = sample_visible(observation.visible, world, key, attempts.attempt[world] + 1)
    else:
        chosen = rank_visible(observation, attempts.target_failures, world, -1.0)
    plan_out.target[world] = chosen
