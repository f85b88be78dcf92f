"""Image and annotation files of rendered views: scene folders, shards and the imagewise layout of BOP behind one interface.

What is read is checked once: annotations against their schemas, images against the camera's resolution.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET

from synpick_warp.dataset.annotations import (
    ADVICE,
    GRAPH_SCHEMA,
    MASK_SCHEMA,
    VIEW_SCHEMAS,
    Key,
    check_json,
    read_checked,
)
from synpick_warp.dataset.bop.images import COLOR, KeyedImages
from synpick_warp.dataset.bop.layout import Listing, SceneRef
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import MAX_JSON, read_file_if_present
from synpick_warp.system.inputs.image_files import MAX_IMAGE_FILE, decode_image, image_size
from synpick_warp.system.inputs.png_crop import decode_grey_crop

SUFFIXES = (".png", ".jpg")
"""File formats of images; colour may be either."""
RECORD_NAMES = ("camera", "gt", "gt_info")


class ViewRecords(NamedTuple):
    """Entries of one image in BOP's scene_camera.json, scene_gt.json and scene_gt_info.json [mm]; the last two have one per instance."""

    camera: dict[str, Any]
    gt: list[dict[str, Any]]
    gt_info: list[dict[str, Any]]


class SceneFiles(ABC):
    """Files of one scene: all frames of one camera in one episode.

    A scene has all parts, as those of a bake; `bop.foreign` completes scenes from other sources.
    """

    schemas: Mapping[str, Any] = VIEW_SCHEMAS
    """Schema of a frame's annotations by name."""
    complete = True
    """Whether parts that are missing are a fault."""
    advice = "; the data set is not complete"
    """End of the message on a missing image, whose path ends in ".png or .jpg"."""

    def __init__(self, size: tuple[int, int] | None) -> None:
        """Scene of images of this width and height [px]; None: that of each frame's first image."""
        self.size = size
        self._frame_size: tuple[int, tuple[int, int]] | None = None

    @property
    @abstractmethod
    def place(self) -> Path:
        """Folder or first shard of the scene, for messages."""

    @abstractmethod
    def frames(self) -> tuple[int, ...]:
        """BOP's im_id of each image, in order: those of scene_camera.json, or else of scene_gt.json, or else of images."""

    @abstractmethod
    def has(self, name: str) -> bool:
        """Whether there are images or annotations of a type: rgb, depth, mask, mask_visib, camera, gt, gt_info."""

    @abstractmethod
    def layers(self) -> set[str]:
        """Names of image types besides colour, depth and masks."""

    @abstractmethod
    def _part(self, name: str, frame: int) -> Any:
        """Annotations of a frame, one of RECORD_NAMES; None: there are none."""

    @abstractmethod
    def _find(self, name: str, frame: int, index: int | None = None) -> tuple[str, bytes, str] | None:
        """Suffix, content and source of an image file; None: there is none."""

    @abstractmethod
    def _missing(self, name: str, frame: int, index: int | None = None) -> str:
        """Message that there is no such image."""

    @abstractmethod
    def mask(self, name: str, frame: int, index: int) -> np.ndarray:
        """One mask of `masks` (H, W) bool."""

    @abstractmethod
    def mask_crop(self, name: str, frame: int, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Rows and columns of one of `masks`; most of the image is not decoded if it is a PNG file."""

    def masks(self, name: str, frame: int, count: int) -> list[np.ndarray]:
        """Masks (H, W) bool of the frame's `count` instances; `name` is "mask" (amodal) or "mask_visib" (modal)."""
        return [self.mask(name, frame, index) for index in range(count)]

    def camera(self, frame: int) -> dict[str, Any]:
        """A frame's entry in scene_camera.json; empty: there is no such file. Raises DatasetError if the file lacks the frame."""
        found = self._part("camera", frame)
        if found is None and self.has("camera"):
            raise DatasetError(f"{self.place}: scene_camera.json has no image {frame}")
        return found or {}

    def records(self, frame: int) -> ViewRecords:
        """Annotations of a frame."""
        camera, gt, info = (self._part(name, frame) for name in RECORD_NAMES)
        if camera is None or gt is None or info is None or len(gt) != len(info):
            names = "scene_camera.json, scene_gt.json and scene_gt_info.json"
            raise DatasetError(f"{self.place}: {names} do not agree about image {frame}")
        return ViewRecords(camera, gt, info)

    def instance_ids(self, instances: Sequence[tuple[int, Any]]) -> list[int] | None:
        """Ids of the instances of an image from the obj_id and instance_id, or UNSET, of each; None: they have none."""
        ids = [instance for _, instance in instances]
        return None if UNSET in ids else ids

    def graph(self, frame: int) -> dict[str, Any] | None:
        """A frame's entry in scene_graph.json; None: there is none, as in shards."""
        return None

    def _need(self, name: str, frame: int, index: int | None = None) -> tuple[str, bytes, str]:
        """(suffix, content, source) of an image; raises DatasetError if there is none."""
        found = self._find(name, frame, index)
        if found is None:
            raise DatasetError(self._missing(name, frame, index))
        return found

    def image(self, name: str, frame: int) -> np.ndarray:
        """Decoded image "rgb", "depth" or a layer (H, W[, C]), as stored, blue first."""
        _, data, source = self._need(name, frame)
        return decode_image(data, source, DatasetError, size=self.image_size(frame))

    def typed_image(self, name: str, frame: int, channels: int | None, dtype: str) -> np.ndarray:
        """An `image`, with its channels and type checked; see `check_planes`."""
        return check_planes(self.image(name, frame), channels, f"{name} of image {frame} in {self.place}", dtype)

    def image_file(self, name: str, frame: int, index: int | None = None) -> tuple[str, bytes, str]:
        """Suffix, content and path of an image's or mask's file; raises DatasetError unless its header has the scene's size. `name`: of
        `image`, or "mask" or "mask_visib"."""
        suffix, data, source = self._need(name, frame, index)
        if (stated := image_size(data)) != self.image_size(frame):
            there = "is not an image" if stated is None else f"has {stated[0]} x {stated[1]} pixels, not the camera's; {ADVICE}"
            raise DatasetError(f"{source} {there}")
        return suffix, data, source

    def image_size(self, frame: int) -> tuple[int, int]:
        """Width and height of a frame's images [px]: of colour, or else depth, or else the first mask."""
        if self.size is not None:
            return self.size
        if self._frame_size is None or self._frame_size[0] != frame:
            self._frame_size = frame, self._read_size(frame)
        return self._frame_size[1]

    def _read_size(self, frame: int) -> tuple[int, int]:
        """Width and height of a view [px], from the head of its first image; raises DatasetError without one."""
        for name, index in (("rgb", None), ("depth", None), ("mask", 0), ("mask_visib", 0)):
            found = self._find(name, frame, index)
            if found is not None:
                stated = image_size(found[1])
                if stated is None:
                    raise DatasetError(f"{found[2]} is not an image: neither PNG, JPEG nor TIFF")
                return stated
        raise DatasetError(f"{self.place} has no image {frame} in colour, depth or masks")


class SceneFolder(SceneFiles):
    """A BOP "scenewise" folder, such as DATA/train_pbr/000000: one file per image and mask. `suffix`: that of the files of one sensor, such
    as "_cam1"; empty: the classic layout."""

    def __init__(self, folder: Path, size: tuple[int, int] | None = None, suffix: str = "") -> None:
        super().__init__(size)
        self.folder, self.suffix = folder, suffix

    @property
    def place(self) -> Path:
        """The scene's folder."""
        return self.folder

    def images(self, name: str) -> Path:
        """Folder of one kind of images, such as "rgb"."""
        return self.folder / f"{name}{self.suffix}"

    def annotations(self, name: str) -> Path:
        """Path of an annotation file: "camera", "gt", "gt_info" or "graph"."""
        return self.folder / f"scene_{name}{self.suffix}.json"

    @cached_property
    def _records(self) -> list[dict[int, Any] | None]:
        """Annotations by image of each of RECORD_NAMES; None: there is no such file, and need not be."""
        return [
            read_checked(self.annotations(name), dict[Key, self.schemas[name]]) if self.complete or self.has(name) else None
            for name in RECORD_NAMES
        ]

    @cached_property
    def _graphs(self) -> dict[int, dict[str, Any]]:
        """Entries of scene_graph.json by image; empty: there is no such file."""
        path = self.annotations("graph")
        return read_checked(path, GRAPH_SCHEMA) if path.exists() else {}

    def graph(self, frame: int) -> dict[str, Any] | None:
        return self._graphs.get(frame)

    def _part(self, name: str, frame: int) -> Any:
        part = self._records[RECORD_NAMES.index(name)]
        return None if part is None else part.get(frame)

    def frames(self) -> tuple[int, ...]:
        named = next((part for part in self._records[:2] if part is not None), {})
        return tuple(sorted(named))

    def has(self, name: str) -> bool:
        return (self.annotations(name) if name in RECORD_NAMES else self.images(name)).exists()

    def _find(self, name: str, frame: int, index: int | None = None) -> tuple[str, bytes, str] | None:
        base = f"{self.folder}{os.sep}{name}{self.suffix}{os.sep}{_stem(frame, index)}"
        for suffix in SUFFIXES:
            data = read_file_if_present(f"{base}{suffix}", MAX_IMAGE_FILE, DatasetError)
            if data is not None:
                return suffix, data, f"{base}{suffix}"
        return None

    def _missing(self, name: str, frame: int, index: int | None = None) -> str:
        folder = self.images(name)
        if index is not None and self.complete and not folder.is_dir():
            return f"{self.folder} has no {folder.name}; bake with bop.masks = true"
        return f"there is no {folder / _stem(frame, index)}.png or .jpg{self.advice}"

    def mask(self, name: str, frame: int, index: int) -> np.ndarray:
        _, data, source = self._need(name, frame, index)
        return check_planes(decode_image(data, source, DatasetError, size=self.image_size(frame)), None, source) > 0

    def mask_crop(self, name: str, frame: int, index: int, rows: slice, columns: slice) -> np.ndarray:
        suffix, data, _ = self._need(name, frame, index)
        crop = decode_grey_crop(data, self.image_size(frame), rows, columns) if suffix == ".png" else None
        return self.mask(name, frame, index)[rows, columns] if crop is None else crop > 0

    def layers(self) -> set[str]:
        names = {path.name for path in self.folder.iterdir() if path.is_dir() and path.name.endswith(self.suffix)}
        return {name.removesuffix(self.suffix) for name in names} - {"rgb", "depth", "mask", "mask_visib"}


class SceneShards(SceneFiles):
    """Views with a key each, which begins with the scene's index: members of webdataset shards, whose index is read once, or files in the
    folder of the imagewise layout; `images`: members of the scene, None: those of the shards."""

    def __init__(self, shards: Sequence[Path], scene: int, size: tuple[int, int] | None = None, images: KeyedImages | None = None) -> None:
        super().__init__(size)
        self.shards, self.scene = tuple(shards), scene
        names = tuple(shard.name for shard in shards)
        self._images = images or KeyedImages(Listing(self.shards[0].parent, ""), SceneRef("", scene, "", "", names))
        self._runs: tuple[tuple[str, int], dict[int, Any] | None] | None = None

    @property
    def place(self) -> Path:
        """The first shard."""
        return self.shards[0]

    def frames(self) -> tuple[int, ...]:
        """Sorted im_ids of the views that have camera.json, else gt.json."""
        for name in ("camera.json", "gt.json"):
            if found := [frame for frame, content in self._images.members if content == name]:
                return tuple(sorted(found))
        return ()

    def has(self, name: str) -> bool:
        """Whether any view has a member of this name."""
        kinds = COLOR if name == "rgb" else (name,)
        return any(content.partition(".")[0] in kinds for _, content in self._images.members)

    def _part(self, name: str, frame: int) -> Any:
        return self._json(frame, name, self.schemas[name])

    def _find(self, name: str, frame: int, index: int | None = None) -> tuple[str, bytes, str] | None:
        """(suffix, content, source) of an image; None for masks, which are run lengths here."""
        return None if name.startswith("mask") else self._images.find(name, frame, index)

    def _missing(self, name: str, frame: int, index: int | None = None) -> str:
        return f"{self.shards[0].parent} has no {self.scene:06d}_{frame:06d}.{name}.png or .jpg{self.advice}"

    def masks(self, name: str, frame: int, count: int) -> list[np.ndarray]:
        """Decoded masks 0 to count - 1; raises DatasetError if one is missing, others are ignored."""
        if (runs := self._read_runs(name, frame)) is None:
            raise DatasetError(f"{self.shards[0]} has no {name}; bake with bop.masks = true")
        if missing := set(range(count)) - set(runs):
            source = self._source(self._images.file(name, frame))
            raise DatasetError(f"{source} has no mask {min(missing)}, but there are {count} instances; {ADVICE}")
        return super().masks(name, frame, count)

    def mask(self, name: str, frame: int, index: int) -> np.ndarray:
        runs = (self._read_runs(name, frame) or {}).get(index)
        if runs is None:
            raise DatasetError(f"{self.shards[0]} has no {name} of instance {index} in image {frame}; bake with bop.masks = true")
        check_run_lengths(runs, self.image_size(frame), f"{self._source(self._images.file(name, frame, index))},")
        return decode_run_lengths(runs["counts"], runs["size"])

    def mask_crop(self, name: str, frame: int, index: int, rows: slice, columns: slice) -> np.ndarray:
        return self.mask(name, frame, index)[rows, columns]

    def _read_runs(self, name: str, frame: int) -> dict[int, Any] | None:
        """Run lengths of the masks of a frame by instance; None: there are none."""
        if self._runs is None or self._runs[0] != (name, frame):
            self._runs = (name, frame), self._json(frame, name, MASK_SCHEMA)
        return self._runs[1]

    def _read_size(self, frame: int) -> tuple[int, int]:
        """Width and height of a view [px]; without images those of its first mask."""
        for name in ("mask", "mask_visib") if not (self.has("rgb") or self.has("depth")) else ():
            for runs in (self._read_runs(name, frame) or {}).values():
                return tuple(runs["size"][::-1])
        return super()._read_size(frame)

    def layers(self) -> set[str]:
        names = {content for _, content in self._images.members}
        return {Path(name).stem for name in names if name.endswith(SUFFIXES)} - {"rgb", "depth"}

    def _json(self, frame: int, name: str, schema: Any) -> Any:
        """Checked content of a JSON member; None: there is none."""
        member = self._images.members.get((frame, f"{name}.json"))
        return None if member is None else check_json(self._images.content(member, MAX_JSON), schema, self._source(member.file))

    def _source(self, file: str) -> Path:
        """Path of a member, for messages."""
        return self._images.listing.root / file


def _stem(frame: int, index: int | None) -> str:
    """Name of an image, or of a mask, without suffix."""
    return f"{frame:06d}" if index is None else f"{frame:06d}_{index:06d}"


def check_run_lengths(record: Mapping[str, Any], size: tuple[int, int] | None, source: str) -> None:
    """Raise DatasetError unless run lengths fill their own height and width, which must be `size` (width, height; None: any)."""
    height, width = record["size"]
    if size is not None and (width, height) != size:
        raise DatasetError(f"{source} has {width} x {height} pixels; the images of this camera have {size[0]} x {size[1]}")
    if sum(record["counts"]) != width * height:
        raise DatasetError(f"{source} is damaged: its runs have {sum(record['counts'])} of {width * height} pixels; {ADVICE}")


def check_planes(image: np.ndarray, channels: int | None, source: object, dtype: str = "") -> np.ndarray:
    """Check channels (None: the image has two dimensions) and type (NumPy's name; empty: any) of a decoded image (H, W[, C]); returns it,
    or raises DatasetError about the `source`."""
    expected = () if channels is None else (channels,)
    if image.shape[2:] != expected or (dtype and image.dtype.name != dtype):
        kind = f" of type {dtype}" if dtype else ""
        raise DatasetError(
            f"{source} has {(*image.shape[2:], 1)[0]} channels of type {image.dtype}; expected: {channels or 1}{kind}; {ADVICE}"
        )
    return image


def decode_run_lengths(counts: Sequence[int], size: Sequence[int]) -> np.ndarray:
    """Decode COCO's uncompressed run-length encoding (RLE): columns one after the other, runs of 0 and 1 in turn [px], the first of 0, in
    an image of height and width [px]; returns the mask (H, W) bool."""
    values = np.arange(len(counts)) % 2 == 1
    return np.repeat(values, counts).reshape(size[1], size[0]).T
