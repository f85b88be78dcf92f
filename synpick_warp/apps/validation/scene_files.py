"""Files of a scene behind one interface: scene folders (classic, one per sensor), webdataset shards, and the imagewise layout.

Masks are crops, with the bit depth and colour type that the file states. Schemas are as loose as the toolkit is, so that rules, not the
parser, name what is wrong.
"""

import re
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
from msgspec import UNSET, Struct, UnsetType

from synpick_warp.dataset.annotations import GraphEntry, Index, InfoEntry, Length, Matrix3, TruthEntry, camera_schema
from synpick_warp.dataset.bop.images import FolderImages, KeyedImages
from synpick_warp.dataset.bop.layout import Layout, SceneRef
from synpick_warp.dataset.view_files import decode_run_lengths
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import MAX_JSON, decode_json
from synpick_warp.system.inputs.image_files import MAX_SIDE, decode_picture

PLAIN_KEY = re.compile(r"0|[1-9][0-9]{0,8}")
"""An index as a key: decimal digits without leading zeros."""
CAMERA = camera_schema(cam_model=dict[str, Any], depth_scale=Length, cam_R_w2c=Matrix3)


class TruthSchema(TruthEntry, gc=False):
    """Schema of an instance's entry in scene_gt.json: object-to-camera rotation and translation [mm], obj_id."""

    cam_R_m2c: Matrix3  # noqa: N815


class Info(InfoEntry, gc=False):
    """Schema of an instance's entry in scene_gt_info.json: boxes and pixel counts [px], visible fraction."""

    visib_fract: Length


class Segmentation(Struct, gc=False):
    """Run-length encoding (RLE) of a mask; `counts` is a list, or a string in pycocotools' compressed form."""

    counts: list[Index] | str
    size: tuple[Index, Index]
    """Height and width [px]."""


class Annotation(Struct, gc=False):
    """Schema of an annotation in scene_gt_coco.json: ids, box [px], run lengths; UNSET: missing."""

    id: Index
    image_id: Index
    category_id: Index
    bbox: Annotated[list[Length], msgspec.Meta(min_length=4, max_length=4)]
    segmentation: Segmentation
    area: Length | UnsetType = UNSET
    ignore: bool | UnsetType = UNSET


class CocoImage(Struct, gc=False):
    """Schema of an image in scene_gt_coco.json."""

    id: Index
    file_name: str
    width: Index
    height: Index


class Category(Struct, gc=False):
    """Schema of a category, an object, in scene_gt_coco.json."""

    id: Index


class Coco(Struct, gc=False):
    """Schema of scene_gt_coco.json."""

    images: list[CocoImage]
    annotations: list[Annotation]
    categories: list[Category]


RECORDS: dict[str, Any] = {"camera": CAMERA, "gt": list[TruthSchema], "gt_info": list[Info], "graph": GraphEntry}
"""Schema of an image's entry by file."""


def convert(content: Any, schema: Any) -> Any:
    """Convert decoded JSON to a schema's types; raises ValueError in few words, with the place in `content`."""
    try:
        return msgspec.convert(content, schema)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except msgspec.ValidationError as fault:
        raise ValueError(str(fault).replace("`", "")) from None


_PNG = b"\x89PNG\r\n\x1a\n"
_COLOUR_TYPES = {0: "greyscale", 2: "RGB", 3: "palette", 4: "greyscale with alpha", 6: "RGB with alpha"}
"""PNG specification, table 11.1."""


def png_type(data: bytes) -> tuple[int, str] | None:
    """Bit depth and colour type of a PNG file; None: it is no PNG file."""
    if not data.startswith(_PNG) or len(data) < 26:
        return None
    return data[24], _COLOUR_TYPES.get(data[25], f"of colour type {data[25]}")


@dataclass(frozen=True, eq=False)
class StoredMask:
    """Mask of an instance as the crop (at left, top) that contains all of its pixels, with the image size, and how the file was encoded."""

    file: str
    size: tuple[int, int]
    """Width and height of the image [px]."""
    left: int
    top: int
    crop: np.ndarray
    """(h, w) bool; (0, 0): the mask is empty."""
    binary: bool = True
    """Whether the image has no values besides 0 and 255."""
    kind: tuple[int, str] | None = (8, "greyscale")
    """Bit depth and colour type of the file; None: no PNG."""

    @property
    def count(self) -> int:
        """Number of pixels that are set."""
        return int(np.count_nonzero(self.crop))

    @property
    def box(self) -> tuple[int, int, int, int] | None:
        """Column, row, width and height [px] of the tight box; None: the mask is empty."""
        height, width = self.crop.shape
        return (self.left, self.top, width, height) if self.crop.size else None

    def window(self, left: int, top: int, width: int, height: int) -> np.ndarray:
        """Crop of the mask's image (height, width) bool at another place; outside of the image it is False."""
        result = np.zeros((height, width), bool)
        rows, columns = self.crop.shape
        first, last = max(left, self.left), min(left + width, self.left + columns)
        upper, lower = max(top, self.top), min(top + height, self.top + rows)
        if first < last and upper < lower:
            part = self.crop[upper - self.top : lower - self.top, first - self.left : last - self.left]
            result[upper - top : lower - top, first - left : last - left] = part
        return result


def decode_mask(data: bytes, file: str) -> StoredMask:
    """Decode a mask; raises as `decode_picture`."""
    image = decode_picture(data, file, DatasetError)
    size, kind = (image.shape[1], image.shape[0]), png_type(data)
    if image.ndim != 2 or image.dtype != np.uint8:
        flat = np.asarray(image.reshape(*image.shape[:2], -1).any(axis=2))
        return crop_mask(flat, file, binary=False, kind=kind or (8 * image.itemsize, f"of {image.shape[2:] or 1} channels"))
    left, top, width, height = cv2.boundingRect(image)
    crop = image[top : top + height, left : left + width]
    filled = crop > 0
    binary = int(crop.sum(dtype=np.int64)) == 255 * int(np.count_nonzero(filled))
    return StoredMask(file, size, left, top, filled, binary, kind)


def crop_mask(image: np.ndarray, file: str, *, binary: bool = True, kind: tuple[int, str] | None = (8, "greyscale")) -> StoredMask:
    """Mask from a whole image (H, W) bool."""
    left, top, width, height = cv2.boundingRect(np.ascontiguousarray(image).view(np.uint8))
    crop = np.ascontiguousarray(image[top : top + height, left : left + width])
    return StoredMask(file, (image.shape[1], image.shape[0]), left, top, crop, binary, kind)


_DIGITS = 6
"""Least number of digits of indices in file names."""


@dataclass(eq=False)
class RecordFile:
    """Parsed annotation file (scene_camera, scene_gt or scene_gt_info), by image."""

    file: str
    """Path relative to the data set."""
    present: bool = True
    raw: dict[int, Any] = field(default_factory=dict)
    """Decoded JSON entries, not checked."""
    entries: dict[int, Any] = field(default_factory=dict)
    """Entries that fit the schema, as its types."""
    faults: list[tuple[str, str]] = field(default_factory=list)
    """(file, what does not fit the schema)."""
    keys: list[str] = field(default_factory=list)
    """Keys that are no plain indices."""
    sources: dict[int, str] = field(default_factory=dict)
    """File of an entry, where each has its own."""

    def add(self, image: int, content: Any, name: str, source: str = "") -> None:
        """Add an image's decoded entry; a part that does not fit the schema becomes a fault."""
        self.raw[image] = content
        if source:
            self.sources[image] = source
        try:
            self.entries[image] = convert(content, RECORDS[name])
        except ValueError as fault:
            self.faults.append((source or self.file, f"image {image}: {fault}"))

    def where(self, image: int) -> str:
        """Name of the file that holds an image's entry, for messages."""
        return self.sources.get(image, self.file)


class FolderScene(FolderImages):
    """Scene folder: annotations with their faults, and a file per image and mask."""

    def __init__(self, layout: Layout, ref: SceneRef) -> None:
        super().__init__(layout.splits[ref.split].enter(ref.name), ref.sensor, _DIGITS)
        self.ref = ref
        self._records: dict[str, RecordFile] = {}

    def record(self, name: str) -> RecordFile:
        """Entries of "camera", "gt" or "gt_info"."""
        if name not in self._records:
            self._records[name] = self._read_record(name)
        return self._records[name]

    def _read_record(self, name: str) -> RecordFile:
        """Read an annotation file: entries by image; what cannot be read becomes a fault or a bad key, nothing is raised."""
        file = f"scene_{name}{self.ref.sensor}.json"
        record = RecordFile(self.listing.name(file), file in self.listing.files)
        if not record.present:
            return record
        try:
            content = decode_json(self.listing.read(file, MAX_JSON), dict[str, Any], record.file, DatasetError)
        except DatasetError as error:
            record.faults.append((record.file, str(error)))
            return record
        for key, entry in content.items():
            if PLAIN_KEY.fullmatch(key):
                record.add(int(key), entry, name)
            else:
                record.keys.append(key)
        return record

    def coco(self, name: str) -> tuple[str, Any] | None:
        """File and content of scene_gt_coco.json, or with `name` "_modal" of that file; None: there is none."""
        for file in (f"scene_gt_coco{self.ref.sensor}{name}.json", f"scene_gt_coco{name}{self.ref.sensor}.json"):
            if file in self.listing.files:
                place = self.listing.name(file)
                return place, decode_json(self.listing.read(file, MAX_JSON), Coco, place, DatasetError)
        return None

    def mask(self, kind: str, image: int, index: int) -> StoredMask | None:
        """Decode a mask; None: there is none. Raises DatasetError if it cannot be decoded."""
        data = self.read(kind, image, index, MAX_JSON)
        return None if data is None else decode_mask(data, self.file(kind, image, index))


class KeyedScene(KeyedImages):
    """Views with a key each: members of shards, or files of the imagewise layout. Masks are run lengths."""

    def __init__(self, layout: Layout, ref: SceneRef) -> None:
        super().__init__(layout.keyed[ref.split], ref)
        self._masks: tuple[tuple[str, int], Any] | None = None

    @cached_property
    def _records(self) -> dict[str, RecordFile]:
        """Annotation files gathered from those of the views, by kind; what cannot be read becomes a fault."""
        records = {name: RecordFile(self.ref.place) for name in RECORDS}
        for (image, content), member in sorted(self.members.items()):
            name = content.removesuffix(".json")
            if name not in records or name == content:
                continue
            try:
                entry: Any = decode_json(self.content(member, MAX_JSON), object, member.file, DatasetError)
            except DatasetError as error:
                records[name].faults.append((member.file, str(error)))
                continue
            records[name].add(image, entry, name, member.file)
        return records

    def record(self, name: str) -> RecordFile:
        return self._records[name]

    def coco(self, name: str) -> tuple[str, Any] | None:
        return None

    def mask(self, kind: str, image: int, index: int) -> StoredMask | None:
        if self._masks is None or self._masks[0] != (kind, image):
            data = self.read(kind, image, None, MAX_JSON)
            file = self.file(kind, image)
            runs = {} if data is None else decode_json(data, dict[str, Segmentation], file, DatasetError)
            self._masks = (kind, image), runs
        runs, file = self._masks[1].get(str(index)), self.file(kind, image, index)
        if runs is None:
            return None
        height, width = runs.size
        if isinstance(runs.counts, str) or max(runs.size) > MAX_SIDE or sum(runs.counts) != height * width:
            raise DatasetError(f"{file}: the runs do not cover the image of {width} x {height} pixels")
        return crop_mask(decode_run_lengths(runs.counts, runs.size), file)


CheckedScene = FolderScene | KeyedScene
"""Files of one scene of one sensor, as validation reads them: what does not fit a schema is a fault, not an error."""


def open_scene(layout: Layout, ref: SceneRef) -> CheckedScene:
    """Open the files of a scene: a folder, or views in shards or of key names."""
    return FolderScene(layout, ref) if ref.name else KeyedScene(layout, ref)
