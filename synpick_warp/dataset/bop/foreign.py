"""Scenes of BOP data sets from other sources: found from folder and file names, as there is no config.toml, and completed.

Annotations and images may be missing, and only what is asked for must be there. What is not, is made up here: entries of scene_gt_info.json
are measured from masks as the BOP toolkit does (calc_gt_info.py), instances are numbered, and grey images stand in for colour. Behind this
module such a scene is read as that of a bake.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.dataset.annotations import VIEW_SCHEMAS, camera_schema
from synpick_warp.dataset.bop.images import COLOR, FolderImages, KeyedFolder, KeyedImages, SceneImages
from synpick_warp.dataset.bop.layout import Layout, Listing, NoLayoutError, SceneRef
from synpick_warp.dataset.view_files import RECORD_NAMES, SceneFiles, SceneFolder, SceneShards, ViewRecords
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.image_files import decode_picture

_SCENE_OFFSET = 10**6
"""Added to the episodes of each further split, where splits have scenes of the same index, so that every episode has its own."""
HIDDEN_BOX = [-1, -1, -1, -1]
UNKNOWN: dict[str, Any] = {
    "bbox_obj": HIDDEN_BOX,
    "bbox_visib": HIDDEN_BOX,
    "px_count_all": 0,
    "px_count_valid": 0,
    "px_count_visib": 0,
    "visib_fract": math.nan,
}
"""Entry of an instance without scene_gt_info.json and masks: visible fraction NaN says that nothing is known, not that it is hidden."""
_PER_OBJECT = 1000
"""An instance without id gets one from _PER_OBJECT * obj_id on; see `ForeignScene.instance_ids`."""


class ForeignScene(SceneFiles):
    """`SceneFiles` of any origin: what is missing is completed, images may have any format that BOP data sets have."""

    schemas: Mapping[str, Any] = VIEW_SCHEMAS | {"camera": camera_schema()}
    complete = False
    advice = " or .tif"

    def records(self, frame: int) -> ViewRecords:
        """Annotations of a frame; scene_gt_info is measured from visible masks if it is missing, or without these UNKNOWN."""
        gt, info = self._part("gt", frame), self._part("gt_info", frame)
        if gt is None and info:
            raise DatasetError(f"there is no file {self.place}/scene_gt.json, but a scene_gt_info.json")
        gt = gt or []
        if info is not None and len(info) != len(gt):
            raise DatasetError(f"{self.place}: scene_gt.json and scene_gt_info.json do not agree about image {frame}")
        if info is None and gt and self.has("mask_visib"):
            amodal = self.masks("mask", frame, len(gt)) if self.has("mask") else None
            info = measure_info(self.masks("mask_visib", frame, len(gt)), amodal)
        return ViewRecords(self.camera(frame), gt, [dict(UNKNOWN) for _ in gt] if info is None else info)

    def instance_ids(self, instances: Sequence[tuple[int, Any]]) -> list[int]:
        """Ids of the instances of an image. Missing ones are 1000 obj_id, plus the number of instances of the same object before it.

        They follow an instance through a scene that has one of each object; of several, nothing tells which is which in the next image.
        """
        if (known := super().instance_ids(instances)) is not None:
            return known
        seen: Counter[int] = Counter()
        result = []
        for object_id, _ in instances:
            result.append(_PER_OBJECT * object_id + seen[object_id])
            seen[object_id] += 1
        return result

    def image(self, name: str, frame: int) -> np.ndarray:
        """Decoded image (H, W[, C]), blue first; "rgb" is converted to (H, W, 3) uint8."""
        _, data, source = self._need(name, frame)
        if name == "rgb":
            return to_color(decode_picture(data, source, DatasetError))
        return decode_picture(data, source, DatasetError, self.image_size(frame))

    def layers(self) -> set[str]:
        """None: folders of these names may have any content."""
        return set()

    @staticmethod
    def _frames_of(images: SceneImages) -> tuple[int, ...]:
        """Sorted im_ids of colour and depth images."""
        return tuple(sorted({image for kind in (*COLOR, "depth") for image, _ in images.indices(kind)}))


class ForeignFolder(ForeignScene, SceneFolder):
    """Scene folder of one sensor, with the suffix of its files, such as "_cam1"; empty: the classic layout."""

    def __init__(self, listing: Listing, sensor: str) -> None:
        super().__init__(listing.path(""), None, sensor)
        self._images = FolderImages(listing, sensor)

    def images(self, name: str) -> Path:
        return self.folder / self._images.folder(name)

    def _part(self, name: str, frame: int) -> Any:
        """Record of a frame by name; of gt and gt_info an empty list if there is the file, but not the frame."""
        found = super()._part(name, frame)
        return [] if found is None and name != "camera" and self.has(name) else found

    def frames(self) -> tuple[int, ...]:
        named = any(map(self.has, RECORD_NAMES[:2]))
        return super().frames() if named else self._frames_of(self._images)

    def has(self, name: str) -> bool:
        return any(map(super().has, COLOR if name == "rgb" else (name,)))

    def _find(self, name: str, frame: int, index: int | None = None) -> tuple[str, bytes, str] | None:
        return self._images.find(name, frame, index)

    def mask(self, name: str, frame: int, index: int) -> np.ndarray:
        """Mask (H, W) bool, from an image of any number of channels."""
        _, data, source = self._need(name, frame, index)
        mask = decode_picture(data, source, DatasetError, self.image_size(frame)) > 0
        return mask if mask.ndim == 2 else np.asarray(mask.any(axis=2))


class ForeignShards(ForeignScene, SceneShards):
    """Views with a key each, some of whose members may be missing."""

    def frames(self) -> tuple[int, ...]:
        return super().frames() or self._frames_of(self._images)


def to_color(image: np.ndarray) -> np.ndarray:
    """An image (H, W[, C]) as colour (H, W, 3) uint8: grey in all channels, without alpha, of 16 bits the upper 8."""
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3]) if image.shape[2] == 4 else image


def measure_info(visible: Sequence[np.ndarray], amodal: Sequence[np.ndarray] | None) -> list[dict[str, Any]]:
    """Measure pixel counts, visible fraction and boxes of each instance from masks (H, W) bool of its visible part, and of its silhouette
    within the image; without these (None), their measures stay unknown. `px_count_valid`, which needs depth, is that of all pixels."""
    entries = []
    for index, mask in enumerate(visible):
        seen = int(np.count_nonzero(mask))
        entries.append(UNKNOWN | {"bbox_visib": _box(mask), "px_count_visib": seen})
        if amodal is not None:
            every = int(np.count_nonzero(amodal[index]))
            entries[-1] |= {
                "bbox_obj": _box(amodal[index]) if seen else HIDDEN_BOX,
                "px_count_all": every,
                "px_count_valid": every,
                "visib_fract": min(1.0, seen / every) if every else 0.0,
            }
    return entries


def _box(mask: np.ndarray) -> list[int]:
    """Box of a mask as BOP has it: x_min, y_min, x_max - x_min, y_max - y_min [px]."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return list(HIDDEN_BOX)
    return [int(columns[0]), int(rows[0]), int(columns[-1] - columns[0]), int(rows[-1] - rows[0])]


class ForeignScenes:
    """Scenes of a BOP folder by episode and camera: an episode is a scene, a camera one of its sensors.

    Episodes have the indices of their scenes. Where two splits have scenes of the same index, those of each later split, by name, have a
    million more, whichever splits are shown.
    """

    def __init__(self, folder: Path, split: str | None = None) -> None:
        """Find the scenes of a data set, or of one of its splits; raises DatasetError if there are none."""
        self._folder, self._split = folder, split
        self.layout = Layout(folder)
        if not self.layout.keyed and not self.layout.scenes():
            raise NoLayoutError(f"{folder} is not a BOP data set: its splits ({', '.join(self.layout.splits)}) have no scenes")

    @cached_property
    def _scenes(self) -> dict[int, dict[str, SceneRef]]:
        """Scenes of the chosen split, or all, by episode (scene_id, plus an offset for each split if some clash) and sensor suffix."""
        by_split: dict[str, list[SceneRef]] = {}
        for ref in self.refs():
            by_split.setdefault(ref.split, []).append(ref)
        indices = [ref.scene for refs in by_split.values() for ref in {ref.scene: ref for ref in refs}.values()]
        step = _SCENE_OFFSET if len(set(indices)) < len(indices) else 0
        found: dict[int, dict[str, SceneRef]] = {}
        for number, name in enumerate(sorted(by_split)):
            for ref in by_split[name] if self._split in (None, name) else ():
                found.setdefault(ref.scene + number * step, {})[ref.sensor] = ref
        return dict(sorted(found.items()))

    def refs(self) -> list[SceneRef]:
        """All scenes of all sensors; where a split has both scene folders and shards, which show the same views, those of the folders."""
        folders = self.layout.scenes()
        splits = {ref.split for ref in folders}
        return [*folders, *(ref for ref in self._keyed() if ref.split.removesuffix("_web") not in splits)]

    def _keyed(self) -> Iterator[SceneRef]:
        """Yield the scenes of shards and of the imagewise layout; raises DatasetError if a shard cannot be read."""
        for folder in map(KeyedFolder, self.layout.keyed.values()):
            if fault := next((keys for keys in folder.members.values() if isinstance(keys, str)), None):
                raise DatasetError(fault)
            yield from (ref for ref, _ in folder.scenes())

    @cached_property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors; empty: the classic layout, of one camera a scene."""
        names = {suffix[1:] for refs in self._scenes.values() for suffix in refs if suffix}
        return tuple(sorted(names))

    @property
    def cameras(self) -> int:
        """Number of cameras of an episode."""
        return max(1, len(self.sensors))

    @cached_property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits that have scenes."""
        return tuple(sorted({ref.split for refs in self._scenes.values() for ref in refs.values()}))

    def scene(self, episode: int) -> int:
        """BOP scene_id of an episode."""
        return next(iter(self._scenes[episode].values())).scene

    def split(self, episode: int) -> str:
        """Name of the split of an episode."""
        return next(iter(self._scenes[episode].values())).split

    def cameras_of(self, episode: int) -> list[int]:
        """Indices of the cameras that have recorded an episode."""
        names = self._scenes[episode]
        return [0] if "" in names else [camera for camera, sensor in enumerate(self.sensors) if f"_{sensor}" in names]

    def has(self, episode: int) -> bool:
        """Whether there is such an episode."""
        return episode in self._scenes

    def episodes(self) -> Iterator[int]:
        """Indices of the episodes, in order."""
        yield from self._scenes

    def files(self, episode: int, camera: int) -> SceneFiles:
        """Files of the scene that a camera recorded. Raises DatasetError if the scene has no such sensor."""
        refs = self._scenes[episode]
        suffix = f"_{self.sensors[camera]}" if self.sensors else ""
        # Scenes of one camera stand beside scenes of several sensors in no data set that is known; if they do, they are the first camera's.
        ref = refs.get(suffix) or (refs.get("") if camera == 0 else None)
        if ref is None:
            raise DatasetError(f"{self._folder / next(iter(refs.values())).place} has no sensor {suffix[1:]}")
        return self.open(ref)

    def open(self, ref: SceneRef) -> SceneFiles:
        """Open the files of a scene: of a folder, or of shards or key names."""
        if ref.name:
            listing = self.layout.splits[ref.split].enter(ref.name)
            return ForeignFolder(listing, ref.sensor)
        keyed = self.layout.keyed[ref.split]
        return ForeignShards([keyed.path(name) for name in ref.shards or ("",)], ref.scene, None, KeyedImages(keyed, ref))
