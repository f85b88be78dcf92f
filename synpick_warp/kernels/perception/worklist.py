"""Worklist of the worlds to observe, processed in batches; its length stays on the device."""

import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.state import Attempts, Worlds

wp.set_module_options({"enable_backward": False})


@wp.struct
class Worklist:
    """Worlds to observe, in order."""

    world: wp.array[int]
    """(world)"""
    length: wp.array[int]
    """(one): number of worlds."""
    next: wp.array[int]
    """(one): index of the first one that is not processed yet."""
    remaining: wp.array[int]
    """(one): number of those."""


@wp.kernel
def list_worlds_kernel(worlds: int, state: Worlds, attempts: Attempts, worklist_out: Worklist):
    """Stream compaction: list the acting worlds whose task is LOOK, in order. Launched as one thread."""
    count = int(0)
    for world in range(worlds):
        if state.phase[world] == Phase.ACT and attempts.task[world] == Task.LOOK:
            worklist_out.world[count] = world
            count += 1
    worklist_out.length[0] = count
    worklist_out.next[0] = 0
    worklist_out.remaining[0] = count


@wp.kernel
def take_batch_kernel(worklist: Worklist, views_out: Views):
    """Assign the next worlds of the worklist to the views of a batch; -1: the view is unused. Launched over view."""
    view = wp.tid()
    item = worklist.next[0] + view
    views_out.world[view] = -1
    if item < worklist.length[0]:
        views_out.world[view] = worklist.world[item]


@wp.kernel
def advance_batch_kernel(views: int, worklist_inout: Worklist):
    """Advance the worklist by one batch; the loop ends when `remaining` is 0. Launched as one thread."""
    worklist_inout.next[0] = worklist_inout.next[0] + views
    worklist_inout.remaining[0] = wp.max(worklist_inout.length[0] - worklist_inout.next[0], 0)
