"""Host copies of a batch's images: which are copied, which are replaced by encoded files or run boundaries, and the copies themselves."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import warp as wp

from synpick_warp.configs.schema import Bop

# Image height from which the largest lists of run boundaries are no larger than the images [px].
MIN_LISTED_ROWS = 288
# Pause between two queries of a copy's event: seconds, or a fraction of the wait so far, if that is longer. On an H200 a batch of 50
# full-HD views takes 80 ms, and the next one is queued meanwhile.
PAUSE_SECONDS, PAUSE_FRACTION = 5e-4, 1 / 32
# Longest wait with pauses [s]. A query does not tell a failed copy from an unfinished one, and Warp prints a line for each that fails;
# the synchronisation that comes next raises the error.
MAX_PAUSED_SECONDS = 0.5


class DeviceImages:
    """Images of a batch that stay on the device, as `Images` of `frames`."""

    def __init__(self, array: wp.array) -> None:
        self.array = array

    def __getitem__(self, index: int | tuple[int, slice]) -> np.ndarray:
        """Copy an image, or a part of it, to the host; waits for the device."""
        return self.array[index].numpy()


@dataclass(frozen=True)
class HostImages:
    """Transfer settings of a batch: which images are copied to the host, and which are replaced by encoded files or run boundaries."""

    on_demand: tuple[str, ...] = ()
    """Arrays of `ViewBuffers` that stay on the device; files or run boundaries replace them, but for single images that exporters copy."""
    jpeg_quality: int = 0
    """Quality of the JPEG files that are copied instead of colour images; 0: there are none."""
    depth_files: bool = False
    """Whether data of PNG files (IDAT) is copied: instead of depth images, or beside them if these are needed, too."""


def host_images(bop: Bop, height: int, device: wp.Device, needs_images: bool, depth_files: bool) -> HostImages:
    """Choose which images of a batch are copied to the host and which stay on the device.

    On the CPU all are copied; for an exporter that needs all images, all but masks. Else files and run boundaries replace them. Below
    MIN_LISTED_ROWS rows masks are always copied, and depth alone is left out, since lists of run boundaries may be incomplete there, and
    copying single images waits for the device. Depth files are made on every device, so that their bytes do not depend on it.

    Args:
        bop: Settings of the files.
        height: Rows of an image [px].
        device: Device of the rendering.
        needs_images: Whether an exporter reads all images.
        depth_files: Whether an exporter writes depth files.
    """
    if not device.is_cuda:
        return HostImages(depth_files=depth_files)
    if needs_images:
        return HostImages(("mask_words",) if height >= MIN_LISTED_ROWS else (), depth_files=depth_files)
    # Without files, keypoints are the only ones to read depth.
    depth = ("depth",) if depth_files or not bop.keypoints else ()
    if height < MIN_LISTED_ROWS:
        return HostImages(depth, depth_files=depth_files)
    if bop.color_format != "jpg":
        return HostImages((*depth, "instance", "mask_words"), depth_files=depth_files)
    return HostImages((*depth, "color", "instance", "mask_words"), bop.jpeg_quality, depth_files)


class HostCopy:
    """Host mirror of device arrays; on CUDA with asynchronous copies."""

    def __init__(self, arrays: list[wp.array], target: list[wp.array] | None = None) -> None:
        """
        Args:
            arrays: Arrays of one device.
            target: Arrays on the host that they are copied to, pinned for a GPU; None: new ones for a GPU, on a CPU the arrays themselves.
        """
        self.source = arrays
        self.device = arrays[0].device
        if target is None:
            is_cuda = self.device.is_cuda
            target = [wp.empty(a.shape, dtype=a.dtype, device="cpu", pinned=True) for a in arrays] if is_cuda else arrays
        self.target = target
        self.done = wp.Event(self.device) if self.device.is_cuda else None

    def start(self, stream: wp.Stream | None) -> None:
        """Begin to copy on `stream` (None: the current one), after the work queued on the current one. A CPU copies at once, if at all."""
        if self.target is self.source:
            return
        if self.done is None:
            for target, source in zip(self.target, self.source, strict=True):
                wp.copy(target, source)
            return
        if stream is None:
            stream = self.device.stream
        else:
            stream.wait_stream(self.device.stream)
        for target, source in zip(self.target, self.source, strict=True):
            wp.copy(target, source, stream=stream)
        stream.record_event(self.done)

    @property
    def is_done(self) -> bool:
        """Whether the copies that were started are done."""
        return self.done is None or self.done.is_complete

    def wait(self) -> list[np.ndarray]:
        """Wait for the copies and return them as NumPy arrays (views, no further copy)."""
        if self.done is not None:
            wait_event(self.done)
        return [array.numpy() for array in self.target]


def wait_event(event: wp.Event) -> None:
    """Wait for an event with pauses: `wp.synchronize_event` alone keeps a core busy, since CUDA asks the device without a pause."""
    started = time.monotonic()
    while not event.is_complete and (waited := time.monotonic() - started) < MAX_PAUSED_SECONDS:
        time.sleep(max(PAUSE_SECONDS, PAUSE_FRACTION * waited))
    wp.synchronize_event(event)
