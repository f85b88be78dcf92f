"""Choice of the target: the instance to pick next, by its ancestors in the clutter graph and its visibility."""

import warp as wp

from synpick_warp.codes import Mode, Outcome, Stream
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.rng import stream_key, uniform_index
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
def rank_visible(
    visible: wp.array2d[int],
    visible_fraction: wp.array2d[float],
    ancestors: wp.array3d[wp.uint32],
    target_failures: wp.array2d[int],
    world: int,
    sign: float,
) -> int:
    """Visible instance with the smallest sign · (number of ancestors) + failures, then the largest sign · fraction, then the smallest
    index; or -1. A failed attempt weighs as one more object above, one since the last success more than all objects.
    """
    chosen = int(-1)
    least = float(0.0)
    largest = float(0.0)
    for i in range(visible.shape[1]):
        if visible[world, i] > 0:
            members = int(0)
            for word in range(ancestors.shape[2]):
                members += int(wp.bit_count(ancestors[world, i, word]))
            # Whole numbers, which are exact in single precision.
            count = sign * float(members) + float(target_failures[world, i])
            fraction = sign * visible_fraction[world, i]
            if chosen < 0 or count < least or (count == least and fraction > largest):
                chosen = i
                least = count
                largest = fraction
    return chosen


@wp.kernel
def choose_target_kernel(
    # Scene:
    seed: wp.uint64,
    pick: PickData,
    # State: worlds, attempts
    arrangement_id: wp.array[wp.vec2i],  # (world)
    mode: wp.array[int],  # (world)
    attempt: wp.array[int],  # (world)
    outcome: wp.array[int],  # (world)
    target_failures: wp.array2d[int],  # (world, instance)
    # In:
    views: Views,
    visible: wp.array2d[int],  # (world, instance) [px]
    visible_fraction: wp.array2d[float],  # (world, instance)
    ancestors: wp.array3d[wp.uint32],  # (world, instance, word)
    # Out:
    target_out: wp.array[int],  # (world)
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
    if mode[world] != Mode.TARGET:
        chosen = rank_visible(visible, visible_fraction, ancestors, target_failures, world, 1.0)
    elif pick.random_after_failure != 0 and outcome[world] >= Outcome.DROPPED:
        key = stream_key(seed, arrangement_id[world][0], arrangement_id[world][1], Stream.TARGETS)
        chosen = sample_visible(visible, world, key, attempt[world] + 1)
    else:
        chosen = rank_visible(visible, visible_fraction, ancestors, target_failures, world, -1.0)
    target_out[world] = chosen
