"""Image and annotation files of rendered views: BOP scene folders and webdataset shards behind one interface.

What is read is checked once: annotations against their schemas, images against the camera's resolution.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from synpick_warp.dataset.annotations import ADVICE, MASK_SCHEMA, SCENE_SCHEMAS, VIEW_SCHEMAS, check_json, read_checked
from synpick_warp.errors import DatasetError
from synpick_warp.inputs.files import read_file_if_present
from synpick_warp.inputs.image_files import MAX_IMAGE_FILE, decode_image, image_size, tiff_size
from synpick_warp.inputs.tar_files import list_members

SUFFIXES = (".png", ".jpg")
"""File formats of images; colour may be either."""
RECORD_NAMES = ("camera", "gt", "gt_info")


class ViewRecords(NamedTuple):
    """Annotations of one image, as BOP's scene_camera.json, scene_gt.json and scene_gt_info.json have them [mm]."""

    camera: dict[str, Any]
    gt: list[dict[str, Any]]
    """One per instance."""
    gt_info: list[dict[str, Any]]
    """One per instance, in the same order."""


class SceneFiles(Protocol):
    """Files of one scene: all frames of one camera in one episode."""

    @property
    def place(self) -> Path:
        """Folder or first shard, for messages."""
        ...

    lenient: bool
    """Whether parts may be missing: the scene is of a data set that no bake wrote."""

    def frames(self) -> tuple[int, ...]:
        """BOP's im_id of each image, in order."""
        ...

    def has(self, name: str) -> bool:
        """Whether there are images or annotations of a type: rgb, depth, mask, mask_visib, camera, gt, gt_info."""
        ...

    def records(self, frame: int) -> ViewRecords:
        """Annotations of a frame."""
        ...

    def image_size(self, frame: int) -> tuple[int, int]:
        """Width and height of a frame's images [px]."""
        ...

    def image(self, name: str, frame: int) -> np.ndarray:
        """An image, decoded by OpenCV without conversion (H, W[, 3]), blue first; `name` is "rgb", "depth" or a layer."""
        ...

    def image_file(self, name: str, frame: int) -> tuple[str, bytes]:
        """Suffix and content of an image's file, which states the scene's size; `name` as for `image`."""
        ...

    def masks(self, name: str, frame: int, count: int) -> list[np.ndarray]:
        """Masks (H, W) bool of the frame's `count` instances; `name` is "mask" (amodal) or "mask_visib" (modal)."""
        ...

    def layers(self) -> set[str]:
        """Names of image types besides colour, depth and masks."""
        ...


class SceneFolder:
    """`SceneFiles` of a BOP "scenewise" folder: one file per image and mask."""

    lenient = False

    def __init__(self, folder: Path, size: tuple[int, int] | None = None, suffix: str = "") -> None:
        """
        Args:
            folder: Scene folder, such as DATA/train_pbr/000000.
            size: Width and height of the camera's images [px]; None: not checked.
            suffix: Suffix of the files of one sensor, such as "_cam1"; empty: the classic layout.
        """
        self.folder, self.size, self.suffix = folder, size, suffix

    @property
    def place(self) -> Path:
        """See `SceneFiles`."""
        return self.folder

    def images(self, name: str) -> Path:
        """Folder of one kind of images, such as "rgb"."""
        return self.folder / f"{name}{self.suffix}"

    def annotations(self, name: str) -> Path:
        """Annotation file: "camera", "gt" or "gt_info"."""
        return self.folder / f"scene_{name}{self.suffix}.json"

    @cached_property
    def _records(self) -> list[dict[int, Any]]:
        return [read_checked(self.annotations(name), SCENE_SCHEMAS[name]) for name in RECORD_NAMES]

    def frames(self) -> tuple[int, ...]:
        """See `SceneFiles`."""
        return tuple(sorted(self._records[0]))

    def has(self, name: str) -> bool:
        """See `SceneFiles`."""
        return (self.annotations if name in RECORD_NAMES else self.images)(name).exists()

    def image_size(self, frame: int) -> tuple[int, int]:
        """See `SceneFiles`."""
        return self.size or self.image("rgb", frame).shape[1::-1]

    def records(self, frame: int) -> ViewRecords:
        """See `SceneFiles`."""
        return _check_records([part.get(frame) for part in self._records], self.folder, frame)

    def image(self, name: str, frame: int) -> np.ndarray:
        """See `SceneFiles`."""
        return read_image(self.images(name), f"{frame:06d}", size=self.size)

    def image_file(self, name: str, frame: int) -> tuple[str, bytes]:
        """See `SceneFiles`."""
        for suffix in SUFFIXES:
            path = self.images(name) / f"{frame:06d}{suffix}"
            data = read_file_if_present(path, MAX_IMAGE_FILE, DatasetError)
            if data is not None:
                return suffix, check_stated_size(data, self.size, path)
        raise DatasetError(f"there is no {self.images(name) / f'{frame:06d}'}.png or .jpg; the data set is not complete")

    def masks(self, name: str, frame: int, count: int) -> list[np.ndarray]:
        """See `SceneFiles`."""
        if not self.images(name).is_dir():
            raise DatasetError(f"{self.folder} has no {name}{self.suffix}; bake with bop.masks = true")
        return [self.mask(name, frame, index) for index in range(count)]

    def mask(self, name: str, frame: int, index: int) -> np.ndarray:
        """One of `masks`."""
        stem = f"{frame:06d}_{index:06d}"
        return check_planes(read_image(self.images(name), stem, size=self.size), None, f"{self.images(name) / stem}.png") > 0

    def layers(self) -> set[str]:
        """See `SceneFiles`."""
        names = {path.name for path in self.folder.iterdir() if path.is_dir() and path.name.endswith(self.suffix)}
        return {name.removesuffix(self.suffix) for name in names} - {"rgb", "depth", "mask", "mask_visib"}


class SceneShards:
    """`SceneFiles` of webdataset shards: tar files of whole views. The index of a tar file is read once, members by their offset."""

    lenient = False

    def __init__(self, shards: Sequence[Path], scene: int, size: tuple[int, int] | None) -> None:
        """
        Args:
            shards: The scene's tar files.
            scene: Index of the scene, with which keys begin.
            size: Width and height of the camera's images [px]; None: not checked.
        """
        self.shards, self.scene, self.size = tuple(shards), scene, size

    @property
    def place(self) -> Path:
        """See `SceneFiles`."""
        return self.shards[0]

    @cached_property
    def _members(self) -> Mapping[str, tuple[Path, int, int]]:
        """Member name -> (shard, offset, size) [B]."""
        return {name: (shard, offset, size) for shard in self.shards for name, offset, size in list_members(shard)}

    def frames(self) -> tuple[int, ...]:
        """See `SceneFiles`."""
        keys = (name.partition(".")[0] for name in self._members if name.endswith(".camera.json"))
        return tuple(sorted(int(key.partition("_")[2]) for key in keys))

    def has(self, name: str) -> bool:
        """See `SceneFiles`."""
        return any(each.partition(".")[2].partition(".")[0] == name for each in self._members)

    def image_size(self, frame: int) -> tuple[int, int]:
        """See `SceneFiles`."""
        return self.size or self.image("rgb", frame).shape[1::-1]

    def records(self, frame: int) -> ViewRecords:
        """See `SceneFiles`."""
        parts = [self._json(frame, name, VIEW_SCHEMAS[name]) for name in RECORD_NAMES]
        return _check_records(parts, self.shards[0], frame)

    def image(self, name: str, frame: int) -> np.ndarray:
        """See `SceneFiles`."""
        for suffix in SUFFIXES:
            data = self._read(frame, f"{name}{suffix}")
            if data is not None:
                return decode_image(data, self._source(frame, f"{name}{suffix}"), DatasetError, size=self.size)
        raise DatasetError(f"{self.shards[0].parent} has no {self._key(frame)}.{name}{SUFFIXES[0]}; the data set is not complete")

    def image_file(self, name: str, frame: int) -> tuple[str, bytes]:
        """See `SceneFiles`."""
        for suffix in SUFFIXES:
            data = self._read(frame, f"{name}{suffix}")
            if data is not None:
                return suffix, check_stated_size(data, self.size, self._source(frame, f"{name}{suffix}"))
        raise DatasetError(f"{self.shards[0].parent} has no {self._key(frame)}.{name}{SUFFIXES[0]}; the data set is not complete")

    def masks(self, name: str, frame: int, count: int) -> list[np.ndarray]:
        """See `SceneFiles`."""
        records = self._json(frame, name, MASK_SCHEMA)
        if records is None:
            raise DatasetError(f"{self.shards[0]} has no {name}; bake with bop.masks = true")
        source = self._source(frame, f"{name}.json")
        if missing := set(range(count)) - set(records):
            raise DatasetError(f"{source} has no mask {min(missing)}, but there are {count} instances; {ADVICE}")
        for index in range(count):
            check_run_lengths(records[index], self.size, f"{source}, mask {index},")
        return [decode_run_lengths(records[index]["counts"], records[index]["size"]) for index in range(count)]

    def layers(self) -> set[str]:
        """See `SceneFiles`."""
        names = {name.partition(".")[2] for name in self._members}
        return {Path(name).stem for name in names if name.endswith(SUFFIXES)} - {"rgb", "depth"}

    def _key(self, frame: int) -> str:
        return f"{self.scene:06d}_{frame:06d}"

    def _source(self, frame: int, name: str) -> str:
        """A member in messages."""
        return f"{self._key(frame)}.{name} in {self.shards[0].parent}"

    def _json(self, frame: int, name: str, schema: Any) -> Any:
        """Checked content of a JSON member; None: there is none."""
        data = self._read(frame, f"{name}.json")
        return None if data is None else check_json(data, schema, self._source(frame, f"{name}.json"))

    def _read(self, frame: int, name: str) -> bytes | None:
        """Content of a member; None: there is none."""
        shard, offset, size = self._members.get(f"{self._key(frame)}.{name}", (None, 0, 0))
        if shard is None:
            return None
        try:
            with shard.open("rb") as file:
                file.seek(offset)
                data = file.read(size)
        except OSError as error:
            raise DatasetError(f"{shard} cannot be read: {error.strerror}") from None
        if len(data) < size:
            raise DatasetError(f"{shard} is damaged: it ends within {self._key(frame)}.{name}; {ADVICE}")
        return data


def check_stated_size(data: bytes, size: tuple[int, int] | None, source: object) -> bytes:
    """Check the size that an image file states; returns its content."""
    stated = image_size(data) or tiff_size(data)
    if stated is None or (size is not None and stated != size):
        there = "is not an image" if stated is None else f"has {stated[0]} x {stated[1]} pixels, not the camera's; {ADVICE}"
        raise DatasetError(f"{source} {there}")
    return data


def _check_records(parts: list[Any], place: Path, frame: int) -> ViewRecords:
    camera, gt, info = parts
    if camera is None or gt is None or info is None or len(gt) != len(info):
        raise DatasetError(f"{place}: scene_camera.json, scene_gt.json and scene_gt_info.json do not agree about image {frame}")
    return ViewRecords(camera, gt, info)


def check_run_lengths(record: Mapping[str, Any], size: tuple[int, int] | None, source: str) -> None:
    """Check that run lengths cover an image of that width and height exactly."""
    height, width = record["size"]
    if size is not None and (width, height) != size:
        raise DatasetError(f"{source} has {width} x {height} pixels; the images of this camera have {size[0]} x {size[1]}")
    if sum(record["counts"]) != width * height:
        raise DatasetError(f"{source} is damaged: its runs have {sum(record['counts'])} of {width * height} pixels; {ADVICE}")


def check_planes(image: np.ndarray, channels: int | None, source: object, dtype: str = "") -> np.ndarray:
    """Check channels and type of a decoded image; returns it.

    Args:
        image: (H, W[, C]).
        channels: Number of channels C; None: the image has two dimensions.
        source: File, for the message.
        dtype: NumPy's name of the type; empty: any.

    Raises:
        DatasetError: The image has others.
    """
    expected = () if channels is None else (channels,)
    if image.shape[2:] != expected or (dtype and image.dtype.name != dtype):
        kind = f" of type {dtype}" if dtype else ""
        raise DatasetError(
            f"{source} has {(*image.shape[2:], 1)[0]} channels of type {image.dtype}; expected: {channels or 1}{kind}; {ADVICE}"
        )
    return image


def decode_run_lengths(counts: Sequence[int], size: Sequence[int]) -> np.ndarray:
    """Decode COCO's uncompressed run-length encoding (RLE): columns one after the other, runs of 0 and 1 in turn.

    Args:
        counts: Lengths of the runs [px]; the first is of 0.
        size: Height and width [px].

    Returns:
        Mask (H, W) bool.
    """
    values = np.arange(len(counts)) % 2 == 1
    return np.repeat(values, counts).reshape(size[1], size[0]).T


def read_image(folder: Path, stem: str, flags: int = -1, size: tuple[int, int] | None = None) -> np.ndarray:
    """Decode the PNG or JPEG file of that name without suffix.

    Args:
        folder: Where it lies.
        stem: File name without suffix.
        flags: OpenCV's `IMREAD_` flags; -1: unchanged.
        size: Width and height that it must have [px]; None: any.

    Raises:
        DatasetError: There is none, or OpenCV cannot decode it, or it has another size.
    """
    base = f"{folder}{os.sep}{stem}"
    for suffix in SUFFIXES:
        path = f"{base}{suffix}"
        data = read_file_if_present(path, MAX_IMAGE_FILE, DatasetError)
        if data is not None:
            return decode_image(data, path, DatasetError, flags, size)
    raise DatasetError(f"there is no {folder / stem}.png or .jpg; the data set is not complete")
