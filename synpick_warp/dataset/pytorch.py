"""PyTorch dataset (map style): views of a data set as dictionaries of arrays, and the collate function for batches of them.

    views = synpick_warp.dataset.pytorch.Views("DATA", fields=("rgb", "boxes", "object_ids"))
    loader = torch.utils.data.DataLoader(views, batch_size=8, shuffle=True, num_workers=4, collate_fn=synpick_warp.dataset.pytorch.collate)

PyTorch is imported when a batch is collated, or by its own DataLoader; without it, samples are the same NumPy arrays. A view depends on its
index alone, so the order is that of the sampler. What is pickled for a worker is the folder and the index; files are opened there.
"""

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.configs.schema import LAYERS
from synpick_warp.dataset.reading import DataSet, Episode, open_data_set
from synpick_warp.dataset.view import View, candidates, find_pixels, mean_by_candidate
from synpick_warp.errors import DatasetError, suggest

Sample = dict[str, Any]
_OPEN_EPISODES = 8
"""Episodes whose annotations a process keeps, of those read last: about 20 MB per 1,000 frames and camera."""


def _corners(boxes: np.ndarray) -> np.ndarray:
    """Boxes x, y, width, height by BOP's convention to x_min, y_min, x_max, y_max with exclusive maxima, as torchvision has them."""
    corners = np.concatenate((boxes[:, :2], boxes[:, :2] + boxes[:, 2:] + 1), axis=1)
    return corners.astype(np.float32)


FIELDS: Mapping[str, Callable[[View], np.ndarray]] = {
    "rgb": lambda view: np.ascontiguousarray(view.rgb.transpose(2, 0, 1)),
    "depth": lambda view: view.depth[None],
    "points": lambda view: np.ascontiguousarray(view.points().transpose(2, 0, 1)),
    "masks": lambda view: view.masks,
    "amodal_masks": lambda view: view.amodal_masks,
    "boxes": lambda view: _corners(view.visible_boxes),
    "amodal_boxes": lambda view: _corners(view.boxes),
    "object_ids": lambda view: view.object_ids,
    "instance_ids": lambda view: view.instance_ids,
    "visibility": lambda view: view.visibility.astype(np.float32),
    "poses": lambda view: view.object_to_camera.astype(np.float32),
    "intrinsics": lambda view: view.intrinsics.astype(np.float32),
    "world_to_camera": lambda view: view.world_to_camera.astype(np.float32),
    "pick_pixels": lambda view: find_pixels(view, candidates(view.picks)),
    "pick_success": lambda view: mean_by_candidate(view.picks)[1].astype(np.float32),
    "pick_weights": lambda view: candidates(view.picks)["weight"],
}
"""Contents of a sample. Images: rgb (3, H, W) uint8, depth (1, H, W) float32 [m], points (3, H, W) float32 in the camera frame [m], NaN
where there is no surface. One row per instance of the sample: masks (N, H, W) bool, boxes (N, 4) float32 [px] of the visible part, as
x_min, y_min, x_max, y_max, object_ids and instance_ids (N,) int64, visibility (N,) float32, poses (N, 4, 4) float32, object to camera [m].
Cameras: intrinsics (3, 3) [px], world_to_camera (4, 4) [m], float32. One row per grasp candidate of the format picks: pick_pixels (C, 2)
int64, column and row, pick_success (C,) float32, the share of successful trials, and pick_weights (C,) float32, the inverse of the sampling
probability (0: the episode's own grasp)."""
_PER_INSTANCE = ("masks", "amodal_masks", "boxes", "amodal_boxes", "object_ids", "instance_ids", "visibility", "poses")
_PER_CANDIDATE = ("pick_pixels", "pick_success", "pick_weights")


class Views:
    """Map-style dataset of views: `len(views)`, `views[i]`, as `torch.utils.data.DataLoader` wants them."""

    def __init__(
        self,
        source: Path | str | DataSet,
        *,
        split: str = "",
        cameras: Sequence[int] | None = None,
        stride: int = 1,
        fields: Sequence[str] = ("rgb", "boxes", "object_ids", "visibility", "poses", "intrinsics"),
        min_visibility: float = 0.1,
        transform: Callable[[Sample], Any] | None = None,
    ) -> None:
        """
        Args:
            source: Folder of the data set, or an open one. `synpick_warp.open("s3://bucket/prefix")` downloads an episode when a view of
                it is asked for; its DataLoader needs `multiprocessing_context="spawn"`.
            split: Name of a split; empty: all episodes.
            cameras: Indices of the cameras; None: all.
            stride: Every n-th frame of an episode, from the first on.
            fields: Contents of a sample, of FIELDS; layers by name, too, as `View.layer` decodes them.
            min_visibility: Instances with a smaller visible fraction, or without visible pixels, are left out of a sample.
            transform: Called with each sample, which also has its `episode`, `camera` and `frame`; must be picklable for workers.

        Raises DatasetError: there is no such data set, split, camera or field, or a value is out of range."""
        if wrong := [name for name in fields if name not in FIELDS and name not in LAYERS]:
            near = suggest(str(wrong[0]), [*FIELDS, *LAYERS])
            raise DatasetError(f"there is no field {wrong[0]}{near}; fields: {', '.join(FIELDS)}; layers: {', '.join(LAYERS)}")
        self.source, self.fields, self.min_visibility, self.transform = source, tuple(fields), min_visibility, transform
        whole = self._open()
        data = whole.split(split) if split else whole
        self.cameras = tuple(range(data.camera_count) if cameras is None else cameras)
        if not set(self.cameras) <= set(range(data.camera_count)):
            raise DatasetError(f"cameras {list(self.cameras)}: {whole.folder} has the cameras 0 to {data.camera_count - 1}")
        if stride < 1:
            raise DatasetError(f"stride {stride}: at least 1")
        self.stride = stride
        self.episodes = tuple(data)
        for each in self.cameras if self.episodes else ():
            if stride % (every := data[self.episodes[0]].frames(each).step):
                raise DatasetError(f"camera {each} has a picture every {every} frames; give a stride of {every}, or cameras without it")
        counts = [len(self.cameras) * -(-data.length(episode) // stride) for episode in self.episodes]
        self._ends = np.cumsum(counts, dtype=np.int64)
        self._data: DataSet | None = None
        self._opened: OrderedDict[int, Episode] = OrderedDict()

    def view(self, index: int) -> View:
        """View of an index: episodes one after the other, in each frame by frame, and of each frame the cameras in turn."""
        count = len(self)
        if not -count <= index < count:
            raise IndexError(f"there is no view {index}; there are {count}")
        index %= count
        row = int(np.searchsorted(self._ends, index, side="right"))
        frame, camera = divmod(index - int(self._ends[row - 1] if row else 0), len(self.cameras))
        return self._episode(self.episodes[row]).view(frame * self.stride, self.cameras[camera])

    def _open(self) -> DataSet:
        """The data set, opened if it is named by its folder."""
        return self.source if isinstance(self.source, DataSet) else open_data_set(self.source)

    def _episode(self, index: int) -> Episode:
        """An episode, opened once while it is among those used last."""
        if index not in self._opened:
            self._data = self._data or self._open()
            self._opened[index] = self._data[index]
            if len(self._opened) > _OPEN_EPISODES:
                self._opened.popitem(last=False)
        self._opened.move_to_end(index)
        return self._opened[index]

    def __getitem__(self, index: int) -> Any:
        view = self.view(index)
        kept = (view.visibility >= self.min_visibility) & (view.visible_boxes[:, 2] >= 0)
        sample: Sample = {"episode": view.episode, "camera": view.camera, "frame": view.frame}
        for name in self.fields:
            value = FIELDS[name](view) if name in FIELDS else view.layer(name)
            sample[name] = value[kept] if name in _PER_INSTANCE else value
        return sample if self.transform is None else self.transform(sample)

    def __len__(self) -> int:
        """Number of views."""
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getstate__(self) -> dict[str, Any]:
        """State for a worker: without open files and annotations."""
        return self.__dict__ | {"_data": None, "_opened": OrderedDict()}

    def __repr__(self) -> str:
        return f"Views({str(self.source)!r}, {len(self)} views of {len(self.episodes)} episodes)"


def collate(samples: Sequence[Sample]) -> dict[str, Any]:
    """Collate samples to a batch: arrays of equal shape become one tensor, those with a row per instance or candidate a list of tensors.
    Raises ImportError if PyTorch is not installed."""
    import torch  # pyright: ignore[reportMissingImports]

    batch: dict[str, Any] = {}
    for name, first in samples[0].items():
        values = [sample[name] for sample in samples]
        if not isinstance(first, np.ndarray):
            batch[name] = torch.as_tensor(values)
        elif name in (*_PER_INSTANCE, *_PER_CANDIDATE):
            batch[name] = [torch.from_numpy(np.ascontiguousarray(value)) for value in values]
        else:
            batch[name] = torch.from_numpy(np.stack(values))
    return batch
