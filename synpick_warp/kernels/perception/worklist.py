"""Worklist of the worlds to observe, processed in batches; its length stays on the device."""

import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.kernels.state import Attempts, Worlds

wp.set_module_options({"enable_backward": False})


@wp.kernel
def list_worlds_kernel(
    # Scene:
    worlds: int,
    # State:
    state: Worlds,
    attempts: Attempts,
    # Out:
    worklist_out: wp.array[int],  # (world)
    length_out: wp.array[int],  # (one)
    next_out: wp.array[int],  # (one)
    remaining_out: wp.array[int],  # (one)
):
    """Stream compaction: list the acting worlds whose task is LOOK, in order, in `worklist_out`. Launched as one thread.

    `length` receives the length of the worklist, `next` the index of its first unprocessed item (0), `remaining` the number of these.
    """
    count = int(0)
    for world in range(worlds):
        if state.phase[world] == Phase.ACT and attempts.task[world] == Task.LOOK:
            worklist_out[count] = world
            count += 1
    length_out[0] = count
    next_out[0] = 0
    remaining_out[0] = count


@wp.kernel
def take_batch_kernel(
    # In:
    worklist: wp.array[int],  # (world)
    length: wp.array[int],  # (one)
    next_item: wp.array[int],  # (one)
    # Out:
    world_out: wp.array[int],  # (view)
):
    """Assign the next worlds of the worklist to the views of a batch; -1: the view is unused. Launched over view."""
    view = wp.tid()
    item = next_item[0] + view
    world_out[view] = -1
    if item < length[0]:
        world_out[view] = worklist[item]


@wp.kernel
def advance_batch_kernel(
    # Scene:
    views: int,
    # In:
    length: wp.array[int],  # (one)
    # Out:
    next_inout: wp.array[int],  # (one)
    remaining_out: wp.array[int],  # (one)
):
    """Advance the worklist by one batch; the loop ends when `remaining` is 0. Launched as one thread."""
    next_inout[0] = next_inout[0] + views
    remaining_out[0] = wp.max(length[0] - next_inout[0], 0)
