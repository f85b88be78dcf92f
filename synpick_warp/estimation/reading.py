"""Prefetching reader: colour, depth and label images of many scenes side by side, decoded by threads; one frame of each scene a step.

OpenCV and ISA-L decode without Python's global lock, so that threads run in parallel.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Self

import cv2
import numpy as np

from synpick_warp.dataset.view_files import SceneFiles, SceneFolder, check_planes
from synpick_warp.errors import DatasetError
from synpick_warp.estimation.mask_errors import disturb_labels
from synpick_warp.estimation.scenes import ABSENT, Scene
from synpick_warp.inputs.files import read_file
from synpick_warp.inputs.image_files import MAX_IMAGE_FILE
from synpick_warp.inputs.png_crop import decode_grey_crop
from synpick_warp.stages.pose.batch import ViewBatch

AHEAD = 2
"""Steps that are decoded ahead of the one in use."""
BYTES_PER_PIXEL = 6
"""Of a view in a `ViewBatch`: colour, depth and label."""
DEPTHS = {"clean": "depth", "sensor": "depth_sensor"}
"""Choices of depth images, and the folders they are in."""
_MARGIN = 2
"""Pixels around a visible box that are searched for its mask: conventions of boxes differ by one."""


class SceneReader:
    """Reader of scenes of equal image size; iterate over its steps within `with`."""

    def __init__(
        self, scenes: Sequence[Scene], depth: str = "clean", *, mask_seed: int | None = None, threads: int = 1, ahead: int = AHEAD
    ) -> None:
        """
        Args:
            scenes: Scenes that are read side by side.
            depth: Key of DEPTHS.
            mask_seed: Seed of mask errors; None: exact masks.
            threads: Number of decoding threads.
            ahead: Steps that are decoded ahead.
        """
        self.scenes = tuple(scenes)
        self.steps = max((len(scene) for scene in scenes), default=0)
        self._depth, self._mask_seed, self._ahead = DEPTHS[depth], mask_seed, ahead
        self._pool = ThreadPoolExecutor(max(1, threads), "read")
        # Threads decode whole images each; OpenCV's own would only compete with them.
        cv2.setNumThreads(1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __iter__(self) -> Iterator[ViewBatch]:
        """Batches of step 0, 1, ...; view v shows the step's frame of scene v, or is zero in all images if that scene has ended.

        Labels show the instances that are asked; others are 0, as is everything else that is no instance.

        The arrays of a batch are used again: they are valid until the next batch is taken.

        Raises:
            DatasetError: An image or mask is missing or damaged, or has another size.
        """
        pending: deque[tuple[ViewBatch, list[Future[None]]]] = deque()
        free = [self._allocate() for _ in range(min(self.steps, 1 + self._ahead))]
        submitted = 0
        for _ in range(self.steps):
            while submitted < self.steps and free:
                batch = free.pop()
                jobs = [self._pool.submit(self._fill, batch, view, submitted) for view in range(len(self.scenes))]
                pending.append((batch, jobs))
                submitted += 1
            batch, jobs = pending.popleft()
            for job in jobs:
                job.result()
            yield batch
            free.append(batch)

    def check(self, step: int) -> None:
        """Read the views of one step, to find out early that images or masks cannot be read. Raises as the iteration."""
        batch = self._allocate()
        for view in range(len(self.scenes)):
            self._fill(batch, view, step)

    def _allocate(self) -> ViewBatch:
        views = len(self.scenes)
        width, height = self.scenes[0].size
        return ViewBatch(
            color=np.zeros((views, height, width, 3), np.uint8),
            depth=np.zeros((views, height, width), np.uint16),
            depth_scale=np.ones(views, np.float32),
            label=np.zeros((views, height, width), np.uint8),
            intrinsics=np.ones((views, 4), np.float32),
        )

    def _fill(self, batch: ViewBatch, view: int, step: int) -> None:
        """Task: decode the images of a view into the batch."""
        scene = self.scenes[view]
        if step >= len(scene):
            if step - len(scene) <= self._ahead:  # Once for each of the batches, which come in turn.
                batch.color[view], batch.depth[view], batch.label[view] = 0, 0, 0
            return
        frame = scene.plan.frames[step]
        batch.intrinsics[view], batch.depth_scale[view] = scene.intrinsics[step], scene.depth_scale[step]
        color = _read_image(scene.files, "rgb", frame, 3, "uint8")
        cv2.cvtColor(color, cv2.COLOR_BGR2RGB, dst=batch.color[view])
        batch.depth[view] = _read_image(scene.files, self._depth, frame, None, "uint16")
        paint_label(scene, step, batch.label[view])
        if self._mask_seed is not None:
            plan = scene.plan
            disturb_labels(batch.label[view], scene.boxes[step], scene.instances, self._mask_seed, plan.scene, plan.frames[step])
        _hide(batch.label[view], np.flatnonzero((scene.index[step] != ABSENT) & ~scene.asked[step]))


def _read_image(files: SceneFiles, name: str, frame: int, channels: int | None, dtype: str) -> np.ndarray:
    return check_planes(files.image(name, frame), channels, f"{name} of image {frame} in {files.place}", dtype)


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
    if isinstance(scene.files, SceneFolder):
        if not (scene.files.folder / "mask_visib").is_dir():
            raise DatasetError(f"{scene.files.folder} has no mask_visib; bake with bop.masks = true")
        for slot in shown.tolist():
            rows, columns = _crop(scene.boxes[step, slot], scene.size)
            label[rows, columns][_read_mask(scene.files, frame, int(scene.index[step, slot]), scene.size, rows, columns)] = 1 + slot
        return
    masks = scene.files.masks("mask_visib", frame, int((scene.index[step] != ABSENT).sum()))
    for slot in shown.tolist():
        rows, columns = _crop(scene.boxes[step, slot], scene.size)
        label[rows, columns][masks[scene.index[step, slot]][rows, columns]] = 1 + slot


def _hide(label: np.ndarray, slots: np.ndarray) -> None:
    """Set the labels of slots to 0, in place."""
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


def _read_mask(files: SceneFolder, frame: int, index: int, size: tuple[int, int], rows: slice, columns: slice) -> np.ndarray:
    """Crop of a visible mask (rows, columns) bool."""
    path = files.folder / "mask_visib" / f"{frame:06d}_{index:06d}.png"
    crop = decode_grey_crop(read_file(path, MAX_IMAGE_FILE, DatasetError), size, rows, columns) if path.exists() else None
    return files.mask("mask_visib", frame, index)[rows, columns] if crop is None else crop > 0
