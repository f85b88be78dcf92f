"""Busy-wait kernel: keeps a CUDA stream busy, so that missing synchronization shows."""

import warp as wp

wp.set_module_options({"enable_backward": False})

SPINS = 20_000
"""Iterations of the busy-wait kernel that take about a millisecond on a GPU."""


@wp.kernel
def spin_kernel(
    # State:
    value_inout: wp.array[float],  # (thread)
    # In:
    iterations: int,
):
    """Busy wait of `iterations` dependent sines."""
    i = wp.tid()
    x = value_inout[i]
    for _ in range(iterations):
        x = wp.sin(x) + 1.0
    value_inout[i] = x
