"""Decoding of views into batches: colour, depth and labels of one frame of a scene, and the batches' layout in shared memory."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from synpick_warp.apps.estimation.mask_errors import disturb_labels
from synpick_warp.apps.estimation.scenes import ABSENT, Scene
from synpick_warp.errors import DatasetError
from synpick_warp.stages.pose.batch import RgbdBatch
from synpick_warp.system.processes.shared_memory import SharedArray, shared_bytes

_MARGIN = 2
"""Pixels around a visible box that are searched for its mask: conventions of boxes differ by one."""


@dataclass(frozen=True, eq=False)
class DecodeJob:
    """Job of decoding scenes of equal image size side by side: depth folder, seed of mask errors (None: exact masks), and number of batches
    that are filled in turn.
    """

    scenes: tuple[Scene, ...]
    depth: str
    """Folder of depth images."""
    mask_seed: int | None
    """Seed of mask errors; None: exact masks."""
    batches: int
    """Number of batches."""

    def without_truth(self) -> DecodeJob:
        """Job without the parts of the ground truth that decoding does not need, which are most of its bytes."""
        nothing = np.empty(0)
        return replace(self, scenes=tuple(replace(scene, poses=nothing, visibility=nothing) for scene in self.scenes))

    def memory_bytes(self) -> int:
        """Size of the shared memory of all batches [B]."""
        return max(1, self.batches * self._batch_bytes())

    def new_batches(self, memory: mmap.mmap) -> list[RgbdBatch]:
        """`map_batches` of a memory that is zero yet; cameras and depth scales become 1, so that they are valid in views never filled."""
        batches = self.map_batches(memory)
        for batch in batches:
            batch.intrinsics[:], batch.depth_scale[:] = 1, 1
        return batches

    def map_batches(self, memory: mmap.mmap) -> list[RgbdBatch]:
        """Batches whose arrays are views of a memory of `memory_bytes`."""
        return [self._map_batch(memory, index * self._batch_bytes()) for index in range(self.batches)]

    def fill_view(self, batch: RgbdBatch, view: int, step: int) -> None:
        """Decode the images of scene `view` in frame `step` into the batch; a scene that has ended is zero in all images.

        Raises:
            DatasetError: An image or mask is missing or damaged, or has another size.
        """
        scene = self.scenes[view]
        if step >= len(scene):
            if step - len(scene) < self.batches:  # Once for each of the batches, which come in turn.
                batch.color[view], batch.depth[view], batch.label[view] = 0, 0, 0
            return
        frame = scene.plan.frames[step]
        batch.intrinsics[view], batch.depth_scale[view] = scene.intrinsics[step], scene.depth_scale[step]
        color = scene.files.typed_image("rgb", frame, 3, "uint8")
        if color.shape[1::-1] != scene.size:
            sizes = f"{color.shape[1]} x {color.shape[0]} pixels, the scene's first one {scene.size[0]} x {scene.size[1]}"
            raise DatasetError(f"{scene.files.place}: image {frame} has {sizes}; poses are estimated in images of one size")
        cv2.cvtColor(color, cv2.COLOR_BGR2RGB, dst=batch.color[view])
        batch.depth[view] = scene.files.typed_image(self.depth, frame, None, "uint16")
        paint_label(scene, step, batch.label[view])
        if self.mask_seed is not None:
            disturb_labels(batch.label[view], scene.boxes[step], scene.instances, self.mask_seed, scene.plan.scene, frame)
        _hide(batch.label[view], np.flatnonzero((scene.index[step] != ABSENT) & ~scene.asked[step]))

    def _map_batch(self, memory: mmap.mmap, offset: int) -> RgbdBatch:
        """Batch whose arrays are views of shared memory from `offset` [B] on."""
        arrays = {}
        for name, shape, dtype in self._layout():
            arrays[name] = SharedArray(offset, shape, dtype).map(memory)
            offset += shared_bytes((arrays[name].nbytes,))
        return RgbdBatch(**arrays)

    def _batch_bytes(self) -> int:
        """Size of a batch in shared memory [B]."""
        return shared_bytes(int(np.prod(shape)) * np.dtype(dtype).itemsize for _, shape, dtype in self._layout())

    def _layout(self) -> Iterator[tuple[str, tuple[int, ...], str]]:
        """Yield name, shape and type of each array of a batch."""
        views = len(self.scenes)
        width, height = self.scenes[0].size if views else (0, 0)
        yield "color", (views, height, width, 3), "uint8"
        yield "depth", (views, height, width), "uint16"
        yield "depth_scale", (views,), "float32"
        yield "label", (views, height, width), "uint8"
        yield "intrinsics", (views, 4), "float32"


def paint_label(scene: Scene, step: int, label: np.ndarray) -> None:
    """Read the visible masks of a frame into a label image.

    Args:
        scene: The scene.
        step: Index of the frame among the planned ones.
        label: (H, W) uint8; becomes 0 for nothing, 1 + slot for the instance in that slot.

    Raises:
        DatasetError: The data set has no masks, or one is missing or damaged.
    """
    label[:] = 0
    shown = np.flatnonzero((scene.index[step] != ABSENT) & (scene.boxes[step, :, 2] >= 0))
    frame = scene.plan.frames[step]
    for slot in shown.tolist():
        rows, columns = _crop(scene.boxes[step, slot], scene.size)
        crop = scene.files.mask_crop("mask_visib", frame, int(scene.index[step, slot]), rows, columns)
        label[rows, columns][crop] = 1 + slot


def _hide(label: np.ndarray, slots: np.ndarray) -> None:
    """Set the labels of slots to 0 in a label image: their instances are not observed."""
    if len(slots):
        table = np.arange(256, dtype=np.uint8)
        table[1 + slots] = 0
        cv2.LUT(label, table, dst=label)


def _crop(box: np.ndarray, size: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of a visible box x, y, width, height with a margin, within the image."""
    x, y, width, height = box.tolist()
    columns = slice(min(max(0, x - _MARGIN), size[0]), max(0, min(size[0], x + width + 1 + _MARGIN)))
    rows = slice(min(max(0, y - _MARGIN), size[1]), max(0, min(size[1], y + height + 1 + _MARGIN)))
    return slice(rows.start, max(rows.start, rows.stop)), slice(columns.start, max(columns.start, columns.stop))
