"""Subjects of the rules: data set, target lists, scene of one sensor, view; their files are read once and when they are needed."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np

from synpick_warp.apps.validation.scene_files import Annotation, CheckedScene, Coco, Info, RecordFile, StoredMask, TruthSchema, png_type
from synpick_warp.dataset.annotations import TargetEntry
from synpick_warp.dataset.bop.layout import TARGETS, Layout, is_index
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import MAX_JSON, decode_json
from synpick_warp.system.inputs.image_files import MAX_IMAGE_FILE, decode_picture

_Result = TypeVar("_Result")
COLOURS = ("rgb", "gray")
"""Folders of colour and greyscale images; a scene has one of them."""
MASKS = ("mask", "mask_visib")


@dataclass(frozen=True, eq=False)
class CocoFile:
    """COCO file of a scene: name, content (None: it does not fit the schema), fault, and whether its boxes are those of visible masks."""

    file: str
    content: Coco | None
    fault: str
    modal: bool

    @cached_property
    def by_image(self) -> dict[int, list[Annotation]]:
        """Annotations of each image, in the order of the file."""
        result: dict[int, list[Annotation]] = {}
        for annotation in self.content.annotations if self.content else ():
            result.setdefault(annotation.image_id, []).append(annotation)
        return result


@dataclass(frozen=True, eq=False)
class TreeSubject:
    """Subject of rules about the folders of a whole data set."""

    layout: Layout
    place: str = "."


@dataclass(frozen=True, eq=False)
class SceneSubject:
    """Subject of rules about a scene as one sensor sees it: its files, and the target lists' records about it."""

    layout: Layout
    files: CheckedScene
    targets: Mapping[str, Mapping[int, Any]] = field(default_factory=dict)
    """Records of each target list about this scene: by image, its records."""

    @property
    def place(self) -> str:
        """Path relative to the data set."""
        return self.files.ref.place

    @property
    def exact(self) -> bool:
        """Whether depth and masks of the scene's split were rendered, not measured by a real camera."""
        return self.layout.is_rendered(self.files.ref.split)

    def record(self, name: str) -> RecordFile:
        """Entries of scene_camera.json, scene_gt.json or scene_gt_info.json: "camera", "gt" or "gt_info"."""
        return self.files.record(name)

    @property
    def cameras(self) -> dict[int, Any]:
        """Entries of scene_camera.json by image, those that fit the schema."""
        return self.record("camera").entries

    @property
    def truths(self) -> dict[int, list[TruthSchema]]:
        """Entries of scene_gt.json by image, those that fit the schema."""
        return self.record("gt").entries

    @property
    def infos(self) -> dict[int, list[Info]]:
        """Entries of scene_gt_info.json by image, those that fit the schema."""
        return self.record("gt_info").entries

    @cached_property
    def images(self) -> list[int]:
        """Images that the annotations name, sorted."""
        return sorted(set(self.record("camera").raw) | set(self.record("gt").raw))

    @cached_property
    def cocos(self) -> list[CocoFile]:
        """COCO files of the scene: scene_gt_coco.json, scene_gt_coco_modal.json, those that exist."""
        found = []
        for name in ("", "_modal"):
            try:
                given = self.files.coco(name)
            except DatasetError as error:
                found.append(CocoFile(f"{self.place}/scene_gt_coco{name}{self.files.ref.sensor}.json", None, str(error), bool(name)))
                continue
            if given is not None:
                found.append(CocoFile(*given, "", bool(name)))
        return found

    @cached_property
    def colour(self) -> str | None:
        """Image type that shows the scene: rgb or gray; None: neither."""
        return next((name for name in COLOURS if name in self.files.kinds), None)


class CheckedPicture(NamedTuple):
    """Decoded image of a view."""

    file: str
    pixels: np.ndarray
    """(H, W[, C])."""
    kind: tuple[int, str] | None
    """Bit depth and colour type of the file; None: no PNG."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.pixels.shape[1], self.pixels.shape[0]


class ViewSubject:
    """An image of a scene, with its annotations, depth and masks."""

    def __init__(self, scene: SceneSubject, image: int) -> None:
        self.scene, self.image = scene, image
        self.place = scene.place
        self.faults: list[tuple[str, str]] = []
        """Files that cannot be decoded: (file, why)."""
        self.camera = scene.cameras.get(image)
        truths, infos = scene.truths.get(image), scene.infos.get(image)
        self.truths: list[TruthSchema] = truths or []
        self.infos: list[Info] = infos if infos is not None and len(infos) == len(self.truths) else []
        """As long as `truths`, or empty."""

    @cached_property
    def colour(self) -> CheckedPicture | None:
        """Colour or greyscale image."""
        return self._picture(self.scene.colour) if self.scene.colour else None

    @cached_property
    def depth_file(self) -> CheckedPicture | None:
        """Depth image."""
        return self._picture("depth")

    @cached_property
    def depth(self) -> np.ndarray | None:
        """Depth in counts (H, W); None: there is none, or it has several channels."""
        return None if self.depth_file is None or self.depth_file.pixels.ndim != 2 else self.depth_file.pixels

    @cached_property
    def masks(self) -> dict[str, list[StoredMask | None]]:
        """Amodal ("mask") and visible masks ("mask_visib") by ground-truth index; None: the file is missing or cannot be decoded."""
        return {name: [self._mask(name, index) for index in range(len(self.truths))] for name in MASKS if name in self.scene.files.kinds}

    @cached_property
    def size(self) -> tuple[int, int] | None:
        """Width and height [px]: of the colour image, else of depth, else of the first mask."""
        for found in (self.colour, self.depth_file):
            if found is not None:
                return found.size
        return next((mask.size for masks in self.masks.values() for mask in masks if mask is not None), None)

    def _mask(self, kind: str, index: int) -> StoredMask | None:
        """Mask of an instance; None: missing, or a fault."""
        return self._try(self.scene.files.file(kind, self.image, index), lambda: self.scene.files.mask(kind, self.image, index))

    def _picture(self, kind: str) -> CheckedPicture | None:
        """Image of a kind; None: missing, or a fault."""
        file = self.scene.files.file(kind, self.image)

        def read() -> CheckedPicture | None:
            data = self.scene.files.read(kind, self.image, None, MAX_IMAGE_FILE)
            return None if data is None else CheckedPicture(file, decode_picture(data, file, DatasetError), png_type(data))

        return self._try(file, read)

    def _try(self, file: str, read: Callable[[], _Result | None]) -> _Result | None:
        """Result of reading a file; None if that fails, which becomes a fault."""
        try:
            return read()
        except DatasetError as error:
            self.faults.append((file, str(error)))
            return None


@dataclass(frozen=True)
class TargetFile:
    """Target list: its records of single images, by scene and image, and what is wrong with the file."""

    scenes: dict[int, dict[int, list[TargetEntry]]] = field(default_factory=dict)
    """Records by scene and image. Those of several images (multi-view lists) are dropped; their scene stays, with what else it has."""
    fault: str = ""
    """What is wrong with the file; empty: nothing."""


@dataclass(frozen=True, eq=False)
class TargetLists:
    """Subject of rules about all target lists of a data set."""

    layout: Layout
    place: str = "."

    @cached_property
    def lists(self) -> dict[str, TargetFile]:
        """Target lists by file name. Cached."""
        return {name: self._read(name) for name in sorted(filter(TARGETS.fullmatch, self.layout.listing.files))}

    def _read(self, name: str) -> TargetFile:
        """Read a target list; one that does not fit the schema has a fault instead of records."""
        try:
            records = decode_json(self.layout.listing.read(name, MAX_JSON), list[TargetEntry], name, DatasetError)
        except DatasetError as error:
            return TargetFile(fault=str(error))
        scenes: dict[int, dict[int, list[TargetEntry]]] = {}
        for record in records:
            images = scenes.setdefault(record.scene_id, {})
            if isinstance(record.im_id, int):
                images.setdefault(record.im_id, []).append(record)
        return TargetFile(scenes)

    def splits(self, name: str) -> list[str]:
        """Splits that a target list refers to: `PREFIX` and `PREFIX_*` of a file `PREFIX_targets*`, else `val` and `val_*`, else all.

        Splits with scene folders come first: others count only if no split has any.
        """
        prefix = name.split("_targets")[0]
        with_scenes = [split for split, listing in self.layout.splits.items() if any(map(is_index, listing.folders))]
        names = with_scenes or list(self.layout.splits) or list(self.layout.keyed)
        for start in (prefix, "val"):
            found = [split for split in names if split == start or split.startswith(f"{start}_")]
            if found:
                return found
        return names

    def scene_ids(self, name: str) -> set[int]:
        """Indices of the scenes in the splits that a list is about; without scene folders (shards, imagewise), those that it names."""
        splits = self.splits(name)
        if not self.layout.splits:
            return set(self.lists[name].scenes)
        return {int(folder) for split in splits for folder in self.layout.splits[split].folders if folder.isdecimal()}

    def of_scene(self, split: str, scene: int) -> dict[str, dict[int, list[TargetEntry]]]:
        """Records about a scene: by list and image."""
        return {name: found.scenes[scene] for name, found in self.lists.items() if scene in found.scenes and split in self.splits(name)}
