"""Scenes of a BOP folder that no bake describes: found by its layout, read as far as they are there (lenient reading)."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.dataset.annotations import LENIENT_SCENE_SCHEMAS, LENIENT_VIEW_SCHEMAS, check_json, read_checked
from synpick_warp.dataset.bop.folders import Listing
from synpick_warp.dataset.bop.layout import KEYED, SHARD, Layout, NoLayoutError, SceneRef
from synpick_warp.dataset.bop.measured import UNKNOWN, measure_info
from synpick_warp.dataset.view_files import RECORD_NAMES, SceneFolder, SceneShards, ViewRecords
from synpick_warp.errors import DatasetError
from synpick_warp.inputs.files import read_file_if_present
from synpick_warp.inputs.image_files import MAX_IMAGE_FILE, decode_picture, image_size, tiff_size
from synpick_warp.inputs.tar_files import list_members

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""File formats of images that BOP data sets have."""
MASKS = ("mask", "mask_visib")
COLOR = ("rgb", "gray")
"""Image types that show colour or brightness, the preferred one first."""
_PER_OBJECT = 1000
"""Ids of instances that are made up, per object."""
_SCENE_OFFSET = 10**6
"""Between the episodes of splits that have scenes of the same index."""


class _LenientImages:
    """Images of a scene, which may be grey, and of any format that BOP data sets have."""

    _known: tuple[int, tuple[int, int]] | None = None
    """Frame, and the size of its images."""

    def has(self, name: str) -> bool:
        """See `SceneFiles`."""
        raise NotImplementedError

    def _find(self, name: str, frame: int) -> tuple[str, bytes, str]:
        """Suffix, content and source of an image."""
        raise NotImplementedError

    def image(self, name: str, frame: int) -> np.ndarray:
        """See `SceneFiles`; grey images are given as colour."""
        _, data, source = self._find(name, frame)
        if name == "rgb":
            return to_color(decode_picture(data, source, DatasetError))
        return decode_picture(data, source, DatasetError, self.image_size(frame))

    def image_file(self, name: str, frame: int) -> tuple[str, bytes]:
        """See `SceneFiles`."""
        suffix, data, _ = self._find(name, frame)
        return suffix, data

    def image_size(self, frame: int) -> tuple[int, int]:
        """See `SceneFiles`: those of the frame's colour image, which others of the frame must have, too."""
        if self._known is None or self._known[0] != frame:
            self._known = frame, self._stated_size(frame)
        return self._known[1]

    def _stated_size(self, frame: int) -> tuple[int, int]:
        name = "rgb" if self.has("rgb") else "depth"
        _, data, source = self._find(name, frame)
        stated = image_size(data) or tiff_size(data)
        if stated is None:
            raise DatasetError(f"{source} is not an image: neither PNG, JPEG nor TIFF")
        return stated

    def layers(self) -> set[str]:
        """See `SceneFiles`: none, as folders of these names may have any content in data sets of others."""
        return set()


class FoundFolder(_LenientImages, SceneFolder):
    """`SceneFiles` of a scene folder; grey images stand in for colour, annotations may be missing."""

    lenient = True

    def __init__(self, listing: Listing, suffix: str) -> None:
        """
        Args:
            listing: The scene folder.
            suffix: Suffix of the sensor's files, such as "_cam1"; empty: the classic layout.
        """
        super().__init__(listing.root / listing.place, None, suffix)
        self.listing = listing

    def images(self, name: str) -> Path:
        """Folder of one kind of images: KIND_SENSOR, or, where a modality has annotations of its own, the modality itself."""
        return self.folder / self._folder(name)

    def _folder(self, name: str) -> str:
        modality = self.suffix[1:]
        for kind in COLOR if name == "rgb" else (name,):
            for folder in (f"{kind}{self.suffix}", *([modality] if re.fullmatch(rf"{kind}[0-9]*", modality) else [])):
                if folder in self.listing.folders:
                    return folder
        return f"{name}{self.suffix}"

    @cached_property
    def _parts(self) -> list[dict[int, Any] | None]:
        """Annotations by image of each of RECORD_NAMES; None: there is no such file."""
        found = []
        for name in RECORD_NAMES:
            file = self.annotations(name).name
            needed = name == "camera"
            found.append(read_checked(self.folder / file, LENIENT_SCENE_SCHEMAS[name]) if needed or file in self.listing.files else None)
        return found

    def frames(self) -> tuple[int, ...]:
        """See `SceneFiles`."""
        return tuple(sorted(self._parts[0] or ()))

    def has(self, name: str) -> bool:
        """See `SceneFiles`."""
        return self.annotations(name).name in self.listing.files if name in RECORD_NAMES else self._folder(name) in self.listing.folders

    def camera(self, frame: int) -> dict[str, Any]:
        """Entry of scene_camera.json."""
        return (self._parts[0] or {})[frame]

    def records(self, frame: int) -> ViewRecords:
        """See `SceneFiles`."""
        camera, gt, info = self._parts
        truth = None if gt is None else gt.get(frame, [])
        return _complete(self, [(camera or {}).get(frame), truth, None if info is None else info.get(frame, [])], frame)

    def _find(self, name: str, frame: int) -> tuple[str, bytes, str]:
        return self._find_file(name, f"{frame:06d}")

    def _find_file(self, name: str, stem: str) -> tuple[str, bytes, str]:
        folder = self._folder(name)
        for suffix in SUFFIXES if folder in self.listing.folders else ():
            path = self.folder / folder / f"{stem}{suffix}"
            data = read_file_if_present(path, MAX_IMAGE_FILE, DatasetError)
            if data is not None:
                return suffix, data, str(path)
        raise DatasetError(f"there is no {self.folder / folder / stem}.png or .jpg or .tif")

    def masks(self, name: str, frame: int, count: int) -> list[np.ndarray]:
        """See `SceneFiles`."""
        return [self.mask(name, frame, index) for index in range(count)]

    def mask(self, name: str, frame: int, index: int) -> np.ndarray:
        """One of `masks`."""
        _, data, source = self._find_file(name, f"{frame:06d}_{index:06d}")
        mask = decode_picture(data, source, DatasetError, self.image_size(frame)) > 0
        return mask if mask.ndim == 2 else np.asarray(mask.any(axis=2))


class FoundShards(_LenientImages, SceneShards):
    """`SceneFiles` of views with a key each: members of shards, or files of the imagewise layout."""

    lenient = True

    def __init__(self, listing: Listing, ref: SceneRef) -> None:
        """
        Args:
            listing: Folder of the shards or files.
            ref: The scene.
        """
        super().__init__([listing.path(name) for name in ref.shards] or [listing.path("")], ref.scene, None)
        self.listing, self._files = listing, not ref.shards

    @cached_property
    def _members(self) -> Mapping[str, tuple[Path, int, int]]:
        if not self._files:
            return {name: (shard, offset, size) for shard in self.shards for name, offset, size in list_members(shard)}
        return {name: (self.listing.path(name), 0, -1) for name in self.listing.files if KEYED.fullmatch(name)}

    @property
    def place(self) -> Path:
        """See `SceneFiles`."""
        return self.shards[0]

    @cached_property
    def _contents(self) -> dict[int, set[str]]:
        """Contents of each frame, such as "rgb.jpg"."""
        found: dict[int, set[str]] = {}
        for name in self._members:
            match = KEYED.fullmatch(name)
            if match and int(match[1]) == self.scene:
                found.setdefault(int(match[2]), set()).add(match[3])
        return found

    def frames(self) -> tuple[int, ...]:
        """See `SceneFiles`."""
        return tuple(sorted(frame for frame, contents in self._contents.items() if "camera.json" in contents))

    def has(self, name: str) -> bool:
        """See `SceneFiles`."""
        names = {content.partition(".")[0] for contents in self._contents.values() for content in contents}
        return name in names or (name == "rgb" and "gray" in names)

    def _read(self, frame: int, name: str) -> bytes | None:
        if not self._files:
            return super()._read(frame, name)
        file = f"{self._key(frame)}.{name}"
        return read_file_if_present(self.listing.path(file), MAX_IMAGE_FILE, DatasetError) if file in self.listing.files else None

    def records(self, frame: int) -> ViewRecords:
        """See `SceneFiles`."""
        parts = []
        for name in RECORD_NAMES:
            data = self._read(frame, f"{name}.json")
            parts.append(None if data is None else check_json(data, LENIENT_VIEW_SCHEMAS[name], self._source(frame, f"{name}.json")))
        return _complete(self, parts, frame)

    def _find(self, name: str, frame: int) -> tuple[str, bytes, str]:
        for kind in COLOR if name == "rgb" else (name,):
            for suffix in SUFFIXES:
                data = self._read(frame, f"{kind}{suffix}")
                if data is not None:
                    return suffix, data, self._source(frame, f"{kind}{suffix}")
        raise DatasetError(f"{self.shards[0].parent} has no {self._key(frame)}.{name}.png or .jpg or .tif")


class FoundScenes:
    """Scenes of a BOP folder by episode and camera: an episode is a scene, a camera one of its sensors.

    Episodes have the indices of their scenes. Where two splits have scenes of the same index, those of each later split, by name, have a
    million more, whichever splits are shown.
    """

    def __init__(self, folder: Path, split: str | None = None) -> None:
        """
        Args:
            folder: The data set.
            split: Only this split; None: all.

        Raises:
            DatasetError: There are no scenes.
        """
        self._folder, self._split = folder, split
        self.layout = Layout(folder)
        if not self.layout.keyed and not self.layout.scenes():
            raise NoLayoutError(f"{folder} is not a BOP data set: its splits ({', '.join(self.layout.splits)}) have no scenes")

    @cached_property
    def _scenes(self) -> dict[int, dict[str, SceneRef]]:
        """Episode -> suffix of the sensor -> scene."""
        by_split: dict[str, list[SceneRef]] = {}
        for ref in [*self.layout.scenes(), *self._keyed()]:
            by_split.setdefault(ref.split, []).append(ref)
        # A set that has both scene folders and shards of a split has the same views twice.
        for name in [name for name in by_split if name.removesuffix("_web") != name and name.removesuffix("_web") in by_split]:
            del by_split[name]
        indices = [ref.scene for refs in by_split.values() for ref in {ref.scene: ref for ref in refs}.values()]
        step = _SCENE_OFFSET if len(set(indices)) < len(indices) else 0
        found: dict[int, dict[str, SceneRef]] = {}
        for number, name in enumerate(sorted(by_split)):
            for ref in by_split[name] if self._split in (None, name) else ():
                found.setdefault(ref.scene + number * step, {})[ref.sensor] = ref
        return dict(sorted(found.items()))

    def _keyed(self) -> Iterator[SceneRef]:
        """Scenes of shards and of the imagewise layout."""
        for name, listing in self.layout.keyed.items():
            shards = sorted(filter(SHARD.fullmatch, listing.files))
            found: dict[int, set[str]] = {}
            members = [(shard, each) for shard in shards for each, _, _ in list_members(listing.path(shard))]
            for shard, member in members if shards else [("", each) for each in listing.files]:
                if match := KEYED.fullmatch(member):
                    found.setdefault(int(match[1]), set()).add(shard)
            for scene in sorted(found):
                yield SceneRef(name, scene, "", "", tuple(sorted(found[scene])) if shards else ())

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
        """Index of an episode's scene."""
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

    def files(self, episode: int, camera: int) -> FoundFolder | FoundShards:
        """Files of the scene that a camera recorded.

        Raises:
            DatasetError: The scene has no such sensor.
        """
        refs = self._scenes[episode]
        suffix = f"_{self.sensors[camera]}" if self.sensors else ""
        # Scenes of one camera stand beside scenes of several sensors in no data set that is known; if they do, they are the first camera's.
        ref = refs.get(suffix) or (refs.get("") if camera == 0 else None)
        if ref is None:
            raise DatasetError(f"{self._folder / next(iter(refs.values())).place} has no sensor {suffix[1:]}")
        if ref.name:
            return FoundFolder(self.layout.splits[ref.split].enter(ref.name), ref.sensor)
        return FoundShards(self.layout.keyed[ref.split], ref)


def _complete(files: FoundFolder | FoundShards, parts: Sequence[Any], frame: int) -> ViewRecords:
    """Records of a frame; what a missing scene_gt_info would tell is measured from the masks, or else unknown."""
    camera, gt, info = parts
    if camera is None:
        raise DatasetError(f"{files.place}: scene_camera.json has no image {frame}")
    if gt is None and info:
        raise DatasetError(f"there is no file {files.place}/scene_gt.json, but a scene_gt_info.json")
    gt = _with_instances(gt or [])
    if info is not None and len(info) != len(gt):
        raise DatasetError(f"{files.place}: scene_gt.json and scene_gt_info.json do not agree about image {frame}")
    if info is None and gt and files.has("mask_visib"):
        amodal = files.masks("mask", frame, len(gt)) if files.has("mask") else None
        info = measure_info(files.masks("mask_visib", frame, len(gt)), amodal)
    return ViewRecords(camera, gt, [dict(UNKNOWN) for _ in gt] if info is None else info)


def _with_instances(gt: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Instances with ids: where they have none, 1000 times the object's and how many of it come before in the image.

    So instances are the same through a scene if it has one of each object; of several, which is which is not known from image to image.
    """
    if all("instance_id" in entry for entry in gt):
        return gt
    seen: Counter[int] = Counter()
    result = []
    for entry in gt:
        result.append(entry | {"instance_id": _PER_OBJECT * entry["obj_id"] + seen[entry["obj_id"]]})
        seen[entry["obj_id"]] += 1
    return result


def to_color(image: np.ndarray) -> np.ndarray:
    """An image (H, W[, C]) as colour (H, W, 3) uint8: grey in all channels, without alpha, of 16 bits the upper 8."""
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3]) if image.shape[2] == 4 else image
