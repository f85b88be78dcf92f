"""Device-to-host copies of a batch's images: which are copied, which are replaced by encoded files or run boundaries, and the copies.

Run boundaries are the positions at which masks change down a column, from which run lengths (RLE) are made; see `annotate`.
"""

import time
from dataclasses import dataclass

import numpy as np
import warp as wp

from synpick_warp.configs.schema import Bop

# Smallest image height at which the lists of run boundaries, at full length, are no larger than the images that they replace [px].
MIN_LISTED_ROWS = 288
# Pause between two queries of a copy's event: seconds, or a fraction of the wait so far, if that is longer. On an H200 a batch of 50
# full-HD views takes 80 ms, and the next one is queued meanwhile.
PAUSE_SECONDS, PAUSE_FRACTION = 5e-4, 1 / 32
# Longest wait with pauses [s]. A query does not tell a failed copy from an unfinished one, and Warp prints a line for each that fails;
# the synchronisation that comes next raises the error.
MAX_PAUSED_SECONDS = 0.5


class DeviceImages:
    """Images of a batch that stay on the device until they are indexed; implements the protocol `frames.Images`."""

    def __init__(self, array: wp.array) -> None:
        self.array = array

    def __getitem__(self, index: int | tuple[int, slice]) -> np.ndarray:
        """Copy an image, or a part of it, to the host; waits for the device."""
        return self.array[index].numpy()


@dataclass(frozen=True)
class TransferSettings:
    """Which images of a batch are copied to the host, and which are replaced by encoded files or run boundaries."""

    on_demand: tuple[str, ...] = ()
    """Arrays of `ViewBuffers` that stay on the device: files or run boundaries are copied instead; single ones can still be indexed."""
    jpeg_quality: int = 0
    """Quality of the JPEG files that the device encodes and that are copied instead of colour images; 0: none."""
    depth_files: bool = False
    """Whether the device encodes depth as PNG data (IDAT), copied instead of depth images, or beside them if these are needed, too."""


def choose_transfers(bop: Bop, height: int, device: wp.Device, needs_images: bool, depth_files: bool) -> TransferSettings:
    """Choose which images of a batch are copied to the host and which stay on the device.

    On the CPU nothing is left out: the arrays are the host's. For an exporter that needs all images, only masks stay on the device. Else
    files and run boundaries replace images; of those lower than MIN_LISTED_ROWS only depth, since lists of run boundaries, capped at the
    size of an image, may overflow, and fetching the image then stalls. Depth files are made on every device: their bytes are the same.
    `height`: rows of an image [px]. `needs_images`: whether an exporter reads all images. `depth_files`: whether an exporter writes depth
    files."""
    if not device.is_cuda:
        return TransferSettings(depth_files=depth_files)
    if needs_images:
        return TransferSettings(("mask_words",) if height >= MIN_LISTED_ROWS else (), depth_files=depth_files)
    # Keypoints read depth: from its file, or from the image if no format has depth files.
    depth = ("depth",) if depth_files or not bop.keypoints else ()
    if height < MIN_LISTED_ROWS:
        return TransferSettings(depth, depth_files=depth_files)
    if bop.color_format != "jpg":
        return TransferSettings((*depth, "instance", "mask_words"), depth_files=depth_files)
    return TransferSettings((*depth, "color", "instance", "mask_words"), bop.jpeg_quality, depth_files)


class HostCopy:
    """Host mirror of device arrays: asynchronous copies into pinned memory on CUDA; on a CPU by default the arrays themselves."""

    def __init__(self, arrays: list[wp.array], target: list[wp.array] | None = None) -> None:
        """`arrays`: arrays of one device. `target`: arrays on the host that they are copied to, pinned for a GPU; None: new ones for a GPU,
        on a CPU the arrays themselves."""
        self.source = arrays
        self.device = arrays[0].device
        if target is None:
            is_cuda = self.device.is_cuda
            target = [wp.empty(a.shape, dtype=a.dtype, device="cpu", pinned=True) for a in arrays] if is_cuda else arrays
        self.target = target
        self.done = wp.Event(self.device) if self.device.is_cuda else None

    def start(self, stream: wp.Stream | None) -> None:
        """Begin to copy on `stream` (None: the current one), after the work queued on the current one. On a CPU copies are synchronous."""
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
    """Wait for an event with pauses: `wp.synchronize_event` alone keeps a core busy, since CUDA spins."""
    started = time.monotonic()
    while not event.is_complete and (waited := time.monotonic() - started) < MAX_PAUSED_SECONDS:
        time.sleep(max(PAUSE_SECONDS, PAUSE_FRACTION * waited))
    wp.synchronize_event(event)
