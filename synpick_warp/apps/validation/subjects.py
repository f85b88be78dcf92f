"""Subjects of the rules: the data set, a scene of one sensor, a view; their files are read once and when they are needed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from synpick_warp.apps.validation.pictures import Mask, png_type
from synpick_warp.apps.validation.scene_files import CheckedScene, RecordFile
from synpick_warp.apps.validation.schemas import Annotation, Camera, Coco, Info, Truth
from synpick_warp.dataset.bop.layout import Layout
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.image_files import MAX_IMAGE_FILE, decode_picture

COLOURS = ("rgb", "gray")
"""Folders of colour and greyscale images; a scene has one of them."""
MASKS = ("mask", "mask_visib")


@dataclass(frozen=True, eq=False)
class CocoFile:
    """COCO file of a scene: name, content (None: it does not fit the schema), fault, and whether its boxes are those of visible masks."""

    file: str
    content: Coco | None
    """None: it does not fit the schema."""
    fault: str
    modal: bool
    """Whether boxes are those of visible masks."""

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
    def cameras(self) -> dict[int, Camera]:
        """Entries of scene_camera.json by image, those that fit the schema."""
        return self.record("camera").entries

    @property
    def truths(self) -> dict[int, list[Truth]]:
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


class ViewSubject:
    """An image of a scene, with its annotations, depth and masks."""

    def __init__(self, scene: SceneSubject, image: int) -> None:
        self.scene, self.image = scene, image
        self.place = scene.place
        self.faults: list[tuple[str, str]] = []
        """Files that cannot be decoded: (file, why)."""
        self.camera = scene.cameras.get(image)
        truths, infos = scene.truths.get(image), scene.infos.get(image)
        self.truths: list[Truth] = truths or []
        self.infos: list[Info] = infos if infos is not None and len(infos) == len(self.truths) else []
        """As long as `truths`, or empty."""

    @cached_property
    def colour(self) -> tuple[str, np.ndarray] | None:
        """File and content (H, W[, C]) of the colour or greyscale image."""
        return self._picture(self.scene.colour) if self.scene.colour else None

    @cached_property
    def _depth(self) -> tuple[str, np.ndarray, tuple[int, str] | None] | None:
        """(file, image, type of the PNG) of the depth image; None: missing, or a fault."""
        found = self._read("depth", None)
        if found is None:
            return None
        image = self._decode(*found)
        return None if image is None else (found[0], image, png_type(found[1]))

    @property
    def depth_file(self) -> tuple[str, np.ndarray, tuple[int, str] | None] | None:
        """File, content and PNG type of the depth image."""
        return self._depth

    @cached_property
    def depth(self) -> np.ndarray | None:
        """Depth in counts (H, W); None: there is none, or it has several channels."""
        return None if self._depth is None or self._depth[1].ndim != 2 else self._depth[1]

    @cached_property
    def masks(self) -> dict[str, list[Mask | None]]:
        """Amodal ("mask") and visible masks ("mask_visib") by ground-truth index; None: the file is missing or cannot be decoded."""
        return {name: [self._mask(name, index) for index in range(len(self.truths))] for name in MASKS if name in self.scene.files.kinds}

    @cached_property
    def size(self) -> tuple[int, int] | None:
        """Width and height [px]: of the colour image, else of depth, else of the first mask."""
        for found in (self.colour, self._depth):
            if found is not None:
                return found[1].shape[1], found[1].shape[0]
        return next((mask.size for masks in self.masks.values() for mask in masks if mask is not None), None)

    def _mask(self, kind: str, index: int) -> Mask | None:
        """Mask of an instance; None: missing, or not readable, which becomes a fault."""
        try:
            return self.scene.files.mask(kind, self.image, index)
        except DatasetError as error:
            self.faults.append((self.scene.files.file(kind, self.image, index), str(error)))
            return None

    def _picture(self, kind: str) -> tuple[str, np.ndarray] | None:
        """(file, image) of the image of a kind; None: missing, or a fault."""
        found = self._read(kind, None)
        image = None if found is None else self._decode(*found)
        return None if found is None or image is None else (found[0], image)

    def _read(self, kind: str, index: int | None) -> tuple[str, bytes] | None:
        """Name and content of an image; None: there is none."""
        file = self.scene.files.file(kind, self.image, index)
        try:
            data = self.scene.files.read(kind, self.image, index, MAX_IMAGE_FILE)
        except DatasetError as error:
            self.faults.append((file, str(error)))
            return None
        return None if data is None else (file, data)

    def _decode(self, file: str, data: bytes) -> np.ndarray | None:
        """Decode an image; None if that fails, which becomes a fault."""
        try:
            return decode_picture(data, file, DatasetError)
        except DatasetError as error:
            self.faults.append((file, str(error)))
            return None
