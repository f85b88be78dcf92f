"""Tracks: one instance over all cameras and frames of its episode, as arrays. Only annotations are read, no images."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from synpick_warp.dataset.view import View


@dataclass(frozen=True, eq=False)
class Track:
    """Poses, visibility and boxes of one instance over C cameras and the F frames of its episode; where it is not in the scene, poses are
    NaN, boxes -1, the rest 0. Poses: object to tote, object to camera [m]."""

    instance_id: int
    object_id: int
    """BOP object id (class)."""
    present: np.ndarray
    """Whether it is in the scene (F,) bool; visible or not."""
    object_to_world: np.ndarray
    """Poses in the tote's frame (F, 4, 4) float64 [m]; see `dataset.view` for frames and names."""
    object_to_camera: np.ndarray
    """Poses in the frame of each camera (C, F, 4, 4) float64 [m]."""
    visibility: np.ndarray
    """Visible fraction of the silhouette (C, F) float64."""
    visible_pixels: np.ndarray
    """(C, F) int64 [px]."""
    boxes: np.ndarray
    """Amodal bounding boxes (C, F, 4) int64 [px]: x, y, width, height, as BOP has them; -1 if nothing is visible."""
    visible_boxes: np.ndarray
    """Bounding boxes of the visible parts; as `boxes`."""

    def __len__(self) -> int:
        """Number of frames F of the episode."""
        return len(self.present)

    def __repr__(self) -> str:
        return f"Track(instance {self.instance_id}, object {self.object_id}, in {int(self.present.sum())} of {len(self)} frames)"


class Tracks(Mapping[int, Track]):
    """Tracks of an episode by instance id. All are made at once from the annotations of all its views, which may come in any order, in one
    pass."""

    def __init__(self, views: Iterable[View], cameras: int, frames: int) -> None:
        self._size = cameras, frames
        self._tracks: dict[int, Track] = {}
        for view in views:
            self._add(view)

    def _add(self, view: View) -> None:
        """Copy the rows of a view into its instances' arrays."""
        place = view.camera, view.frame
        poses = view.object_to_camera
        worlds = view.object_to_world if view.camera == 0 else None
        counts = [row["px_count_visib"] for row in view.records.gt_info]
        for row, (instance, object_id) in enumerate(zip(view.instance_ids.tolist(), view.object_ids.tolist(), strict=True)):
            track = self._tracks.get(instance) or self._tracks.setdefault(instance, self._make(instance, object_id))
            track.object_to_camera[place] = poses[row]
            track.visibility[place] = view.visibility[row]
            track.visible_pixels[place] = counts[row]
            track.boxes[place] = view.boxes[row]
            track.visible_boxes[place] = view.visible_boxes[row]
            if worlds is not None:
                track.present[view.frame] = True
                track.object_to_world[view.frame] = worlds[row]

    def _make(self, instance: int, object_id: int) -> Track:
        """Empty track of an instance: absent in all frames, poses NaN, visibility and pixels 0."""
        cameras, frames = self._size
        return Track(
            instance_id=instance,
            object_id=object_id,
            present=np.zeros(frames, bool),
            object_to_world=np.full((frames, 4, 4), np.nan),
            object_to_camera=np.full((cameras, frames, 4, 4), np.nan),
            visibility=np.zeros((cameras, frames)),
            visible_pixels=np.zeros((cameras, frames), np.int64),
            boxes=np.full((cameras, frames, 4), -1, np.int64),
            visible_boxes=np.full((cameras, frames, 4), -1, np.int64),
        )

    def __getitem__(self, instance_id: int) -> Track:
        if instance_id not in self._tracks:
            raise KeyError(f"there is no instance {instance_id}; instances: {', '.join(map(str, self))}")
        return self._tracks[instance_id]

    def __iter__(self) -> Iterator[int]:
        return iter(sorted(self._tracks))

    def __len__(self) -> int:
        return len(self._tracks)

    def __repr__(self) -> str:
        return f"Tracks({', '.join(map(str, self))})"
