"""Launching pixel kernels: blocks of whole tiles on the GPU, several threads on the CPU."""

from __future__ import annotations

import functools
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS

BLOCK = 128
"""Threads of a block: four tiles of 8 x 4 pixels."""
CHUNKS = 8
"""Pieces a processor core gets of a launch, so that cores finish together though some tiles cost more."""
CHUNK_PIXELS = 8192
"""Smallest piece: launching one costs as much as shading about a hundred pixels."""


@functools.cache
def _cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_cores(), thread_name_prefix="pixels")


# Threads do not survive a fork: a child starts its own.
os.register_at_fork(after_in_child=_pool.cache_clear)


def launch_pixels(kernel: wp.Kernel, pixels: int, inputs: list[Any], outputs: list[Any], device: wp.Device) -> None:
    """Launch a kernel over a flat range of pixels; its last input is the range's begin. No two tiles of threads write the same place.

    Warp runs a launch on the CPU in the calling thread and releases the interpreter's lock meanwhile; so pieces of the range run
    side by side, whole tiles each. Which thread takes which piece does not change the result.
    """
    if device.is_cuda:
        wp.launch(kernel, dim=pixels, inputs=[*inputs, 0], outputs=outputs, device=device, block_dim=BLOCK)
        return
    if _cores() == 1 or pixels <= CHUNK_PIXELS:
        wp.launch(kernel, dim=pixels, inputs=[*inputs, 0], outputs=outputs, device=device)
        return
    # Loading a module is not safe from several threads at once.
    kernel.module.load(device, 1)
    tiles = -(-pixels // (CHUNKS * _cores() * int(TILE_PIXELS)))
    size = max(CHUNK_PIXELS, tiles * int(TILE_PIXELS))

    def launch_piece(first: int) -> None:
        wp.launch(kernel, dim=min(size, pixels - first), inputs=[*inputs, first], outputs=outputs, device=device)

    for _ in _pool().map(launch_piece, range(0, pixels, size)):
        pass


def launch_views(kernel: wp.Kernel, views: int, each: int, inputs: list[Any], outputs: list[Any], device: wp.Device) -> None:
    """Launch a kernel over `each` threads for each view; its last input is the range's begin. Threads of a view may write the same place.

    On the CPU, where Warp's atomic operations are none, the threads of a view run one after the other, and views side by side.
    """
    if device.is_cuda:
        wp.launch(kernel, dim=views * each, inputs=[*inputs, 0], outputs=outputs, device=device, block_dim=BLOCK)
        return
    kernel.module.load(device, 1)

    def launch_view(view: int) -> None:
        wp.launch(kernel, dim=each, inputs=[*inputs, view * each], outputs=outputs, device=device)

    for _ in _pool().map(launch_view, range(views)):
        pass
