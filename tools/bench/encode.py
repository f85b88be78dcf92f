"""Benchmark of the image encoders: colour as JPEG and depth as PNG, on the device, and on a core of the CPU for comparison."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import warp as wp

from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import ViewBuffers
from synpick_warp.stages.encoding.jpeg import JpegBuffers, JpegEncoder, JpegScratch, jpeg_sizes
from synpick_warp.stages.encoding.png import DepthBuffers, DepthEncoder, allocate_depth_scratch, depth_sizes
from synpick_warp.system.codecs.jpeg import encode_jpeg
from tools.bench.physics import BURST, seconds_per_call
from tools.options import Row

CPU_VIEWS = 6
"""Views encoded on the CPU."""


def measure_encoding(images: ViewBuffers, count: int, quality: int, device: wp.Device, min_seconds: float) -> Iterator[Row]:
    """Benchmark of the encoders.

    Args:
        images: Rendered views.
        count: Views in use.
        quality: JPEG quality.
        device: Where they are.
        min_seconds: Time of a measurement, at least [s].
    """
    views, height, width = images.depth.shape
    sizes = jpeg_sizes(views, width, height)
    jpeg, jpeg_out = JpegEncoder(allocate(JpegScratch, sizes, device), width, height), allocate(JpegBuffers, sizes, device)
    depth = DepthEncoder(allocate_depth_scratch(views, width, height, device), width, height)
    depth_out = allocate(DepthBuffers, depth_sizes(views, width, height), device)
    qualities = wp.full(views, quality, dtype=wp.int32, device=device)
    runs: dict[str, tuple[Callable[[], None], wp.array, int, Callable[[int], object]]] = {
        f"JPEG, quality {quality}": (
            lambda: jpeg.encode(images.color, qualities, count, jpeg_out),
            jpeg_out.jpeg_size,
            jpeg_out.jpeg.shape[1],
            lambda view: encode_jpeg(colors[view], quality),
        ),
        "depth PNG": (
            lambda: depth.encode(images.depth, count, depth_out),
            depth_out.depth_idat_size,
            depth_out.depth_idat.shape[1],
            lambda view: encode_png(depths[view]),
        ),
    }
    colors, depths = (array[: min(count, CPU_VIEWS)].numpy() for array in (images.color, images.depth))
    for name, (run, sizes, capacity, encode) in runs.items():
        yield Row(f"a view: {name}", 1e3 * seconds_per_call(run, device, min_seconds, BURST) / count, "ms")
        bytes_ = sizes.numpy()[:count]
        yield Row(f"{name}: size", 1e-6 * float(bytes_.mean()), "MB")
        yield Row(f"{name}: largest size, of its capacity", 100.0 * float(bytes_.max()) / capacity, "%")
        yield Row(f"{name}: CPU time of a view by the CPU's encoder", 1e3 * _cpu_seconds(encode, len(depths)), "ms")


def _cpu_seconds(encode: Callable[[int], object], views: int) -> float:
    """Median CPU time of a view [s], after one warm-up."""
    encode(0)
    times = []
    for view in range(views):
        started = time.process_time()
        encode(view)
        times.append(time.process_time() - started)
    return float(np.median(times))
