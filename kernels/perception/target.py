"""Which object is picked next."""

import warp as wp

from synpick_warp.codes import Mode, Outcome, Stream
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.rng import stream_key, uniform_index
from synpick_warp.kernels.structs import PickData

wp.set_module_options({"enable_backward": False})


@wp.func
def drawn_instance(visible: wp.array2d[int], world: int, key: wp.uint64, index: int) -> int:
    """One of the visible instances, each as likely as the others; -1: none is visible."""
    instances = visible.shape[1]
    count = int(0)
    for i in range(instances):
        if visible[world, i] > 0:
            count += 1
    if count == 0:
        return -1
    left = uniform_index(key, index, count)
    chosen = int(-1)
    for i in range(instances):
        if visible[world, i] > 0:
            if left == 0:
                chosen = i
            left -= 1
    return chosen


@wp.func
def ranked_instance(
    visible: wp.array2d[int],
    share: wp.array2d[float],
    ancestors: wp.array2d[wp.uint32],
    world: int,
    sign: float,
) -> int:
    """The visible instance with the least sign · (objects above), among equals with the largest sign · share, then the first; or -1."""
    chosen = int(-1)
    least = float(0.0)
    largest = float(0.0)
    for i in range(visible.shape[1]):
        if visible[world, i] > 0:
            count = sign * float(wp.bit_count(ancestors[world, i]))
            seen = sign * share[world, i]
            if chosen < 0 or count < least or (count == least and seen > largest):
                chosen = i
                least = count
                largest = seen
    return chosen


@wp.kernel
def choose_target_kernel(
    # Scene:
    seed: wp.uint64,
    pick: PickData,
    # State:
    address: wp.array[wp.vec2i],
    mode: wp.array[int],
    attempt: wp.array[int],
    outcome: wp.array[int],
    # In:
    views: Views,
    visible: wp.array2d[int],
    share: wp.array2d[float],
    ancestors: wp.array2d[wp.uint32],
    # Out:
    target_out: wp.array[int],
):
    """The visible instance with the fewest objects above, ties by the largest share; in mode TARGET with the most, ties by the smallest.

    With `random_after_failure`, after an attempt that failed in this tick, mode TARGET draws one of the visible ones instead: the number
    of the coming attempt is the draw's index. -1: nothing is visible.
    """
    view = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    chosen = int(-1)
    if mode[world] != Mode.TARGET:
        chosen = ranked_instance(visible, share, ancestors, world, 1.0)
    elif pick.random_after_failure != 0 and outcome[world] >= Outcome.DROPPED:
        key = stream_key(seed, address[world][0], address[world][1], Stream.TARGETS)
        chosen = drawn_instance(visible, world, key, attempt[world] + 1)
    else:
        chosen = ranked_instance(visible, share, ancestors, world, -1.0)
    target_out[world] = chosen
