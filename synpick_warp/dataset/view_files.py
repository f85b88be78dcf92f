"""Image and annotation files of rendered views: BOP scene folders and webdataset shards behind one interface."""

from __future__ import annotations

import json
import tarfile
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from synpick_warp.errors import DatasetError

if TYPE_CHECKING:
    from collections.abc import Mapping

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

    def records(self, frame: int) -> ViewRecords:
        """Annotations of a frame."""
        ...

    def image(self, name: str, frame: int) -> np.ndarray:
        """An image, decoded by OpenCV without conversion (H, W[, 3]), blue first; `name` is "rgb", "depth" or a layer."""
        ...

    def masks(self, name: str, frame: int, count: int) -> list[np.ndarray]:
        """Masks (H, W) bool of the frame's `count` instances; `name` is "mask" (amodal) or "mask_visib" (modal)."""
        ...

    def layers(self) -> set[str]:
        """Names of image types besides colour, depth and masks."""
        ...


class SceneFolder:
    """`SceneFiles` of a BOP "scenewise" folder: one file per image and mask."""

    def __init__(self, folder: Path) -> None:
        """
        Args:
            folder: Scene folder, such as DATA/train_pbr/000000.
        """
        self.folder = folder

    @cached_property
    def _records(self) -> list[dict[str, Any]]:
        return [read_json(self.folder / f"scene_{name}.json") for name in RECORD_NAMES]

    def records(self, frame: int) -> ViewRecords:
        """See `SceneFiles`."""
        return _check_records([part.get(str(frame)) for part in self._records], self.folder, frame)

    def image(self, name: str, frame: int) -> np.ndarray:
        """See `SceneFiles`."""
        return read_image(self.folder / name, f"{frame:06d}")

    def masks(self, name: str, frame: int, count: int) -> list[np.ndarray]:
        """See `SceneFiles`."""
        if not (self.folder / name).is_dir():
            raise DatasetError(f"{self.folder} has no {name}; bake with bop.masks = true")
        return [read_image(self.folder / name, f"{frame:06d}_{index:06d}") > 0 for index in range(count)]

    def layers(self) -> set[str]:
        """See `SceneFiles`."""
        return {path.name for path in self.folder.iterdir() if path.is_dir()} - {"rgb", "depth", "mask", "mask_visib"}


class SceneShards:
    """`SceneFiles` of webdataset shards: tar files of whole views. The index of a tar file is read once, members by their offset."""

    def __init__(self, shards: Sequence[Path], scene: int) -> None:
        """
        Args:
            shards: The scene's tar files.
            scene: Index of the scene, with which keys begin.
        """
        self.shards, self.scene = tuple(shards), scene

    @cached_property
    def _members(self) -> Mapping[str, tuple[Path, int, int]]:
        """Member name -> (shard, offset, size) [B]."""
        members = {}
        for shard in self.shards:
            try:
                with tarfile.open(shard, "r:") as file:
                    members |= {member.name: (shard, member.offset_data, member.size) for member in file}
            except (OSError, tarfile.TarError) as error:
                raise DatasetError(f"cannot read {shard}: {error}") from error
        return members

    def records(self, frame: int) -> ViewRecords:
        """See `SceneFiles`."""
        parts = [self._read(frame, f"{name}.json") for name in RECORD_NAMES]
        return _check_records([part and json.loads(part) for part in parts], self.shards[0], frame)

    def image(self, name: str, frame: int) -> np.ndarray:
        """See `SceneFiles`."""
        for suffix in SUFFIXES:
            data = self._read(frame, f"{name}{suffix}")
            if data is not None:
                return decode_image(data, f"{self._key(frame)}.{name}{suffix} in {self.shards[0].parent}")
        raise DatasetError(f"{self.shards[0].parent} has no {self._key(frame)}.{name}{SUFFIXES[0]}; the data set is not complete")

    def masks(self, name: str, frame: int, count: int) -> list[np.ndarray]:
        """See `SceneFiles`."""
        data = self._read(frame, f"{name}.json")
        if data is None:
            raise DatasetError(f"{self.shards[0]} has no {name}; bake with bop.masks = true")
        records = json.loads(data)
        return [decode_run_lengths(**records[str(index)]) for index in range(count)]

    def layers(self) -> set[str]:
        """See `SceneFiles`."""
        names = {name.partition(".")[2] for name in self._members}
        return {Path(name).stem for name in names if name.endswith(SUFFIXES)} - {"rgb", "depth"}

    def _key(self, frame: int) -> str:
        return f"{self.scene:06d}_{frame:06d}"

    def _read(self, frame: int, name: str) -> bytes | None:
        """Content of a member; None: there is none."""
        shard, offset, size = self._members.get(f"{self._key(frame)}.{name}", (None, 0, 0))
        if shard is None:
            return None
        with shard.open("rb") as file:
            file.seek(offset)
            return file.read(size)


def _check_records(parts: list[Any], place: Path, frame: int) -> ViewRecords:
    camera, gt, info = parts
    if camera is None or gt is None or info is None or len(gt) != len(info):
        raise DatasetError(f"{place}: scene_camera.json, scene_gt.json and scene_gt_info.json do not agree about image {frame}")
    return ViewRecords(camera, gt, info)


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


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object from a file.

    Raises:
        DatasetError: The file is missing, or not JSON.
    """
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise DatasetError(f"{path} is not a JSON file: {error}") from error


def read_image(folder: Path, stem: str, flags: int = -1) -> np.ndarray:
    """Decode the PNG or JPEG file of that name without suffix.

    Args:
        folder: Where it lies.
        stem: File name without suffix.
        flags: OpenCV's `IMREAD_` flags; -1: unchanged.

    Raises:
        DatasetError: There is none, or OpenCV cannot decode it.
    """
    for suffix in SUFFIXES:
        path = folder / f"{stem}{suffix}"
        if path.is_file():
            return decode_image(path.read_bytes(), str(path), flags)
    raise DatasetError(f"there is no {folder / stem}.png or .jpg; the data set is not complete")


def decode_image(data: bytes, name: str, flags: int = -1) -> np.ndarray:
    """Decode a PNG or JPEG file's content by OpenCV; `name` is for the message.

    Raises:
        DatasetError: OpenCV cannot decode it.
    """
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise DatasetError(f"{name} is not an image that OpenCV can decode")
    return image
