"""Scenes of a BOP folder that no bake describes: found by its layout, read as far as they are there (lenient reading)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.dataset.annotations import LENIENT_SCENE_SCHEMAS, LENIENT_VIEW_SCHEMAS, MASK_SCHEMA, check_json, read_checked
from synpick_warp.dataset.bop.images import FolderImages, KeyedImages
from synpick_warp.dataset.bop.layout import KEYED, SHARD, Layout, NoLayoutError, SceneRef
from synpick_warp.dataset.bop.measured import UNKNOWN, measure_info
from synpick_warp.dataset.view_files import RECORD_NAMES, ViewRecords, check_run_lengths, check_stated_size, decode_run_lengths
from synpick_warp.errors import DatasetError
from synpick_warp.inputs.image_files import MAX_IMAGE_FILE, decode_picture, image_size, tiff_size
from synpick_warp.inputs.json import MAX_JSON
from synpick_warp.inputs.tar_files import list_members

MASKS = ("mask", "mask_visib")
COLOR = ("rgb", "gray")
"""Image types that show colour or brightness, the preferred one first."""
_SCENE_OFFSET = 10**6
"""Between the episodes of splits that have scenes of the same index."""


class FoundScene:
    """`SceneFiles` of a scene folder, of shards or of the imagewise layout; parts may be missing, and grey images stand in for colour."""

    lenient = True

    def __init__(self, images: FolderImages | KeyedImages) -> None:
        """
        Args:
            images: Where its images are.
        """
        self._images = images
        self._known: tuple[int, tuple[int, int]] | None = None
        self._runs: tuple[tuple[str, int], dict[int, Any]] | None = None

    @property
    def place(self) -> Path:
        """See `SceneFiles`."""
        images = self._images
        return images.listing.path(next(iter(images.ref.shards), "")) if isinstance(images, KeyedImages) else images.listing.path("")

    def _annotations(self, name: str) -> str:
        """Annotation file, in messages."""
        return f"scene_{name}{self._images.sensor}.json" if isinstance(self._images, FolderImages) else f"{name}.json"

    @cached_property
    def _parts(self) -> list[dict[int, Any] | None]:
        """Annotations by image of each of RECORD_NAMES; None: there are none. Those of a folder only."""
        images = self._images
        assert isinstance(images, FolderImages)
        files = {name: self._annotations(name) for name in RECORD_NAMES}
        return [
            read_checked(images.listing.path(file), LENIENT_SCENE_SCHEMAS[name]) if file in images.listing.files else None
            for name, file in files.items()
        ]

    def _part(self, name: str, frame: int) -> Any:
        """Annotations of a frame; None: there are none."""
        images = self._images
        if isinstance(images, FolderImages):
            part = self._parts[RECORD_NAMES.index(name)]
            return None if part is None else part.get(frame, None if name == "camera" else [])
        member = images.members.get((frame, f"{name}.json"))
        return None if member is None else check_json(images.content(member, MAX_JSON), LENIENT_VIEW_SCHEMAS[name], member.file)

    def frames(self) -> tuple[int, ...]:
        """See `SceneFiles`: those that scene_camera.json has, or else scene_gt.json, or else images."""
        images = self._images
        if isinstance(images, FolderImages):
            named = next((part for part in self._parts[:2] if part is not None), None)
        else:
            named = [frame for frame, content in images.members if content == "camera.json"]
            named = named or [frame for frame, content in images.members if content == "gt.json"] or None
        kinds = (*COLOR, "depth")
        return tuple(sorted({image for kind in kinds for image, _ in images.indices(kind)} if named is None else set(named)))

    def has(self, name: str) -> bool:
        """See `SceneFiles`."""
        images = self._images
        if name not in RECORD_NAMES:
            return name in images.kinds or (name == "rgb" and "gray" in images.kinds)
        if isinstance(images, FolderImages):
            return self._annotations(name) in images.listing.files
        return any(content == f"{name}.json" for _, content in images.members)

    def camera(self, frame: int) -> dict[str, Any]:
        """A frame's entry in scene_camera.json; empty: there is no such file."""
        found = self._part("camera", frame)
        if found is None and self.has("camera"):
            raise DatasetError(f"{self.place}: {self._annotations('camera')} has no image {frame}")
        return found or {}

    def records(self, frame: int) -> ViewRecords:
        """See `SceneFiles`; what a missing scene_gt_info would tell is measured from the masks, or else unknown."""
        camera, gt, info = self.camera(frame), self._part("gt", frame), self._part("gt_info", frame)
        if gt is None and info:
            raise DatasetError(f"there is no file {self.place}/{self._annotations('gt')}, but a {self._annotations('gt_info')}")
        gt = gt or []
        if info is not None and len(info) != len(gt):
            raise DatasetError(f"{self.place}: scene_gt.json and scene_gt_info.json do not agree about image {frame}")
        if info is None and gt and self.has("mask_visib"):
            amodal = self.masks("mask", frame, len(gt)) if self.has("mask") else None
            info = measure_info(self.masks("mask_visib", frame, len(gt)), amodal)
        return ViewRecords(camera, gt, [dict(UNKNOWN) for _ in gt] if info is None else info)

    def _read(self, name: str, frame: int, index: int | None = None) -> tuple[str, bytes] | None:
        """File and content of an image; None: there is none."""
        for kind in COLOR if name == "rgb" else (name,):
            data = self._images.read(kind, frame, index, MAX_IMAGE_FILE)
            if data is not None:
                return str(self._images.listing.root / self._images.file(kind, frame, index)), data
        return None

    def _need(self, name: str, frame: int, index: int | None = None) -> tuple[str, bytes]:
        found = self._read(name, frame, index)
        if found is None:
            raise DatasetError(f"there is no {self._images.listing.root / self._images.file(name, frame, index)} or .jpg or .tif")
        return found

    def image(self, name: str, frame: int) -> np.ndarray:
        """See `SceneFiles`; grey images are given as colour."""
        source, data = self._need(name, frame)
        if name == "rgb":
            return to_color(decode_picture(data, source, DatasetError))
        return decode_picture(data, source, DatasetError, self.image_size(frame))

    def image_file(self, name: str, frame: int) -> tuple[str, bytes]:
        """See `SceneFiles`."""
        source, data = self._need(name, frame)
        return f".{source.rpartition('.')[2].lower()}", check_stated_size(data, self.image_size(frame), source)

    def image_size(self, frame: int) -> tuple[int, int]:
        """See `SceneFiles`: those of the frame's colour image, or else its depth image or first mask, which its others must have, too."""
        if self._known is None or self._known[0] != frame:
            self._known = frame, self._stated_size(frame)
        return self._known[1]

    def _stated_size(self, frame: int) -> tuple[int, int]:
        for name in ("rgb", "depth", *MASKS):
            if isinstance(self._images, KeyedImages) and name in MASKS:
                size = next((entry["size"][::-1] for entry in self._read_runs(name, frame).values()), None)
                if size is not None:
                    return tuple(size)
                continue
            found = self._read(name, frame, 0 if name in MASKS else None)
            if found is not None:
                stated = image_size(found[1]) or tiff_size(found[1])
                if stated is None:
                    raise DatasetError(f"{found[0]} is not an image: neither PNG, JPEG nor TIFF")
                return stated
        raise DatasetError(f"{self.place} has neither colour nor depth of image {frame}")

    def layers(self) -> set[str]:
        """See `SceneFiles`: none, as folders of these names may have any content in data sets of others."""
        return set()

    def masks(self, name: str, frame: int, count: int) -> list[np.ndarray]:
        """See `SceneFiles`."""
        return [self.mask(name, frame, index) for index in range(count)]

    def mask(self, name: str, frame: int, index: int) -> np.ndarray:
        """One of `masks`."""
        if isinstance(self._images, KeyedImages):
            runs = self._read_runs(name, frame).get(index)
            if runs is None:
                raise DatasetError(f"{self.place}: {self._images.file(name, frame)} has no mask {index}")
            check_run_lengths(runs, self.image_size(frame), self._images.file(name, frame, index))
            return decode_run_lengths(runs["counts"], runs["size"])
        source, data = self._need(name, frame, index)
        mask = decode_picture(data, source, DatasetError, self.image_size(frame)) > 0
        return mask if mask.ndim == 2 else np.asarray(mask.any(axis=2))

    def _read_runs(self, name: str, frame: int) -> dict[int, Any]:
        """Run lengths of the masks of a frame by instance; empty: there are none."""
        if self._runs is None or self._runs[0] != (name, frame):
            data = self._images.read(name, frame, None, MAX_JSON)
            self._runs = (name, frame), {} if data is None else check_json(data, MASK_SCHEMA, self._images.file(name, frame))
        return self._runs[1]


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

    def files(self, episode: int, camera: int) -> FoundScene:
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
        return self.open(ref)

    def open(self, ref: SceneRef) -> FoundScene:
        """Files of a scene."""
        if ref.name:
            return FoundScene(FolderImages(self.layout.splits[ref.split].enter(ref.name), ref.sensor))
        return FoundScene(KeyedImages(self.layout.keyed[ref.split], ref))


def to_color(image: np.ndarray) -> np.ndarray:
    """An image (H, W[, C]) as colour (H, W, 3) uint8: grey in all channels, without alpha, of 16 bits the upper 8."""
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3]) if image.shape[2] == 4 else image
