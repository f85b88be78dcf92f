"""Moments of choice: list of the worlds whose states are saved for grasp trials."""

import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.kernels.state import Attempts, Worlds
from synpick_warp.kernels.structs import CatalogData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def list_choices_kernel(
    # Scene:
    catalog: CatalogData,
    states: int,
    # State:
    state: Worlds,
    attempts: Attempts,
    # Out:
    stride_inout: wp.array[int],  # (world)
    next_inout: wp.array[int],  # (one)
    world_out: wp.array[int],  # (row)
):
    """Write the worlds that planned an attempt in this tick, in order, to the next rows of a ring buffer; other rows become -1.

    Of an episode's attempts every `stride`-th counts, up to `states` of them, spread over as many attempts as it begins with labelled
    objects. `stride` is set at the first look of an episode, whether or not it sees a target. A single thread (dim 1).
    """
    rows = world_out.shape[0]
    for row in range(rows):
        world_out[row] = -1
    for world in range(state.phase.shape[0]):
        is_planned = attempts.task[world] == Task.APPROACH
        if state.phase[world] == Phase.ACT and attempts.steps[world] == 0 and (is_planned or attempts.task[world] == Task.LOOK):
            if attempts.attempt[world] == 0:
                objects = int(0)
                for instance in range(state.catalog_index.shape[1]):
                    if state.catalog_index[world, instance] >= 0 and state.catalog_index[world, instance] < catalog.count:
                        objects += 1
                stride_inout[world] = (objects + states - 1) // states
            stride = wp.max(stride_inout[world], 1)
            if is_planned and attempts.attempt[world] % stride == 0 and attempts.attempt[world] // stride < states:
                world_out[next_inout[0] % rows] = world
                next_inout[0] = next_inout[0] + 1
