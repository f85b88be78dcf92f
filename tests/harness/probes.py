"""Kernels that let tests call device functions."""

import warp as wp

from synpick_warp.kernels import rng

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sample_kernel(
    seed: wp.array[wp.uint64],
    stream_index: wp.array2d[int],
    count: int,
    key_out: wp.array[wp.uint64],
    uniform_out: wp.array[float],
    index_out: wp.array[int],
    rotation_out: wp.array[wp.quat],
):
    """One sample of each type for each row (episode, arrangement, stream, index)."""
    i = wp.tid()
    key = rng.stream_key(seed[i], stream_index[i, 0], stream_index[i, 1], stream_index[i, 2])
    key_out[i] = key
    uniform_out[i] = rng.uniform(key, stream_index[i, 3])
    index_out[i] = rng.uniform_index(key, stream_index[i, 3], count)
    rotation_out[i] = rng.uniform_rotation(key, stream_index[i, 3])
