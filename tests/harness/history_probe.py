"""Test kernels for temporal accumulation: histories of single coarse pixels."""

import warp as wp

from synpick_warp.kernels.render.lighting.history import (
    LightHistory,
    covered_fraction,
    lag_frames,
    path_number,
    period_bits,
    update_frame,
    usable_paths,
)
from synpick_warp.kernels.render.lighting.moving_bodies import MovingBodies
from synpick_warp.kernels.render.visibility.gbuffer import Meshes

wp.set_module_options({"enable_backward": False})


@wp.kernel
def usable_paths_kernel(
    # In:
    history: LightHistory,
    limit: int,
    # Out:
    result_out: wp.array[int],
):
    """Paths that may be kept, and rest bits, of one coarse pixel."""
    kept, bits = usable_paths(history, 0, 0, 0, limit)
    result_out[0] = kept
    result_out[1] = bits


@wp.kernel
def schedule_kernel(
    # In:
    row: int,
    column: int,
    # Out:
    number_out: wp.array2d[int],  # (first, path)
):
    """Numbers of the paths that a coarse pixel of a still scene traces until the array is full; its history begins in frame `first`."""
    first = wp.tid()
    paths = wp.int32(0)
    frame = first
    while paths < number_out.shape[1]:
        bits = period_bits(wp.min(paths, 16), 1000)
        if bits == 0 or update_frame(row, column, bits) == frame % (1 << bits):
            number_out[first, paths] = path_number(frame, bits)
            paths += 1
        frame += 1


@wp.kernel
def lag_frames_kernel(
    # Scene:
    meshes: Meshes,
    # In:
    moving: MovingBodies,
    point: wp.array[wp.vec3],  # (point) [m]
    enough: float,
    # Out:
    frames_out: wp.array[float],  # (point)
    covered_out: wp.array2d[float],  # (point, rank)
):
    """Frames until the moving bodies of view 0 have changed the light of each point, and the fraction of its sphere that each covers."""
    i = wp.tid()
    frames_out[i] = lag_frames(meshes, moving, 0, point[i], enough)
    for rank in range(moving.count[0]):
        covered_out[i, rank] = covered_fraction(meshes, moving, 0, rank, point[i])
