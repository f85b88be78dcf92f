"""Settling of piles for the checkpoint bank: assignment of episodes to worlds, and detection of rest."""

import warp as wp

from synpick_warp.codes import Ending, Phase

wp.set_module_options({"enable_backward": False})


@wp.kernel
def start_piles_kernel(
    # In:
    episode: wp.array[int],  # (world)
    # Out:
    arrangement_id_out: wp.array[wp.vec2i],  # (world)
    phase_out: wp.array[int],  # (world)
    ending_out: wp.array[int],  # (world)
):
    """Assign an episode to each world, which starts in the next tick from its first arrangement; -1: the world becomes idle.

    Launched over world.
    """
    world = wp.tid()
    arrangement_id_out[world] = wp.vec2i(episode[world], 0)
    ending_out[world] = Ending.RUNNING
    phase_out[world] = Phase.IDLE
    if episode[world] >= 0:
        phase_out[world] = Phase.START


@wp.kernel
def list_settled_kernel(
    # State:
    phase: wp.array[int],  # (world)
    frame: wp.array[int],  # (world)
    # Out:
    row_inout: wp.array[int],  # (world)
    world_out: wp.array[int],  # (row)
    done_inout: wp.array[int],  # (two)
):
    """List the piles that came to rest in this tick: write the world of each bank row, and -1 to that world's `row`.

    `done` counts the piles at rest, and the worlds whose episode has used up its arrangements. Launched over world.
    """
    world = wp.tid()
    row = row_inout[world]
    if row < 0:
        return
    if phase[world] == Phase.ACT and frame[world] == 0:
        world_out[row] = world
        row_inout[world] = -1
        wp.atomic_add(done_inout, 0, 1)
    elif phase[world] == Phase.IDLE:
        row_inout[world] = -1
        wp.atomic_add(done_inout, 1, 1)
