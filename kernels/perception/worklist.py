"""Which worlds look, in batches, without asking the host how many there are."""

import warp as wp

from synpick_warp.codes import Phase, Task

wp.set_module_options({"enable_backward": False})


@wp.kernel
def list_worlds_kernel(
    # Scene:
    worlds: int,
    # State:
    phase: wp.array[int],
    task: wp.array[int],
    # Out:
    looker_out: wp.array[int],
    count_out: wp.array[int],
    first_out: wp.array[int],
    left_out: wp.array[int],
):
    """List the worlds that LOOK, in order, and begin with the first. One thread walks over the worlds."""
    count = int(0)
    for world in range(worlds):
        if phase[world] == Phase.ACT and task[world] == Task.LOOK:
            looker_out[count] = world
            count += 1
    count_out[0] = count
    first_out[0] = 0
    left_out[0] = count


@wp.kernel
def take_batch_kernel(
    # State:
    looker: wp.array[int],
    count: wp.array[int],
    first: wp.array[int],
    # Out:
    world_out: wp.array[int],
):
    """The next worlds become the views of a batch; -1: no world is left for the view."""
    view = wp.tid()
    number = first[0] + view
    world_out[view] = -1
    if number < count[0]:
        world_out[view] = looker[number]


@wp.kernel
def advance_batch_kernel(
    # Scene:
    batch_size: int,
    # State:
    count: wp.array[int],
    # Out:
    first_inout: wp.array[int],
    left_out: wp.array[int],
):
    """Go on behind the batch."""
    first_inout[0] = first_inout[0] + batch_size
    left_out[0] = wp.max(count[0] - first_inout[0], 0)
