"""Moments of choice: lists the worlds whose states are saved for grasp trials."""

import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.kernels.structs import CatalogData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def list_choices_kernel(
    # Scene:
    catalog: CatalogData,
    states: int,
    # State:
    phase: wp.array[int],  # (world)
    task: wp.array[int],  # (world)
    steps: wp.array[int],  # (world)
    attempt: wp.array[int],  # (world)
    catalog_index: wp.array2d[int],  # (world, instance)
    # Out:
    stride_inout: wp.array[int],  # (world)
    next_inout: wp.array[int],  # (one)
    world_out: wp.array[int],  # (row)
):
    """List the worlds that have planned an attempt in this tick, in order, in the next rows of a ring; other rows get -1.

    Of an episode's attempts every `stride`-th counts, up to `states` of them: that spreads them over as many attempts as the episode begins
    with labelled objects. A single thread (dim 1).
    """
    rows = world_out.shape[0]
    for row in range(rows):
        world_out[row] = -1
    for world in range(phase.shape[0]):
        if phase[world] == Phase.ACT and task[world] == Task.APPROACH and steps[world] == 0:
            if attempt[world] == 0:
                objects = int(0)
                for instance in range(catalog_index.shape[1]):
                    if catalog_index[world, instance] >= 0 and catalog_index[world, instance] < catalog.count:
                        objects += 1
                stride_inout[world] = (objects + states - 1) // states
            stride = wp.max(stride_inout[world], 1)
            if attempt[world] % stride == 0 and attempt[world] // stride < states:
                world_out[next_inout[0] % rows] = world
                next_inout[0] = next_inout[0] + 1
