"""Files of a scene behind one interface: scene folders (classic, one per sensor), webdataset shards, and the imagewise layout."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from synpick_warp.dataset.bop.folders import Listing
from synpick_warp.dataset.bop.layout import KEYED, Layout, SceneRef
from synpick_warp.dataset.view_files import decode_run_lengths
from synpick_warp.errors import DatasetError
from synpick_warp.inputs.image_files import MAX_SIDE
from synpick_warp.inputs.json import MAX_JSON, decode_json
from synpick_warp.inputs.tar_files import list_members
from synpick_warp.validation.pictures import Mask, crop_mask, decode_mask
from synpick_warp.validation.schemas import PLAIN_KEY, RECORDS, Coco, Segmentation, convert

SUFFIXES = ("png", "jpg", "jpeg", "tif", "tiff")
"""File formats of images that the toolkit and this package read."""
_KINDS = ("rgb", "gray", "depth", "mask", "mask_visib")
_STEM = re.compile(r"([0-9]{6,9})(?:_([0-9]{6,9}))?\.(\w+)")


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
        """Add an entry, and check it."""
        self.raw[image] = content
        if source:
            self.sources[image] = source
        try:
            self.entries[image] = convert(content, RECORDS[name])
        except ValueError as fault:
            self.faults.append((source or self.file, f"image {image}: {fault}"))

    def where(self, image: int) -> str:
        """File of an entry."""
        return self.sources.get(image, self.file)


class SceneFiles(Protocol):
    """Files of one scene of one sensor."""

    ref: SceneRef

    @property
    def kinds(self) -> set[str]:
        """Types of images that the scene has, of rgb, gray, depth, mask and mask_visib."""
        ...

    def record(self, name: str) -> RecordFile:
        """Entries of "camera", "gt" or "gt_info"."""
        ...

    def coco(self, name: str) -> tuple[str, Any] | None:
        """File and content of scene_gt_coco.json, or with `name` "_modal" of that file; None: there is none."""
        ...

    def indices(self, kind: str) -> dict[tuple[int, int | None], str]:
        """File of each image of a type by (image, ground-truth index)."""
        ...

    def file(self, kind: str, image: int, index: int | None = None) -> str:
        """Path of an image relative to the data set, whether it exists or not."""
        ...

    def read(self, kind: str, image: int, index: int | None, limit: int) -> bytes | None:
        """Read an image; None: there is none. Raises DatasetError if it cannot be read."""
        ...

    def mask(self, kind: str, image: int, index: int) -> Mask | None:
        """Decode a mask; None: there is none. Raises DatasetError if it cannot be decoded."""
        ...


class FolderScene:
    """`SceneFiles` of a folder: one file per image and mask."""

    def __init__(self, layout: Layout, ref: SceneRef) -> None:
        self.ref = ref
        self.listing = layout.splits[ref.split].enter(ref.name)
        self._records: dict[str, RecordFile] = {}

    def folder(self, kind: str) -> str:
        """Folder of a type: KIND_SENSOR, or, where a modality has annotations of its own, the modality itself."""
        sensor = self.ref.sensor
        if kind in ("rgb", "gray", "depth") and sensor == f"_{kind}" and kind in self.listing.folders:
            return kind
        return f"{kind}{sensor}"

    @cached_property
    def listings(self) -> dict[str, Listing]:
        """Listings of the folders of images by type."""
        return {kind: self.listing.enter(self.folder(kind)) for kind in _KINDS if self.folder(kind) in self.listing.folders}

    @property
    def kinds(self) -> set[str]:
        """See `SceneFiles`."""
        return set(self.listings)

    @cached_property
    def _indices(self) -> dict[str, dict[tuple[int, int | None], str]]:
        result = {}
        for kind, listing in self.listings.items():
            matches = [match for name in listing.files if (match := _STEM.fullmatch(name)) and match[3].lower() in SUFFIXES]
            paired = kind.startswith("mask")
            result[kind] = {(int(match[1]), int(match[2]) if match[2] else None): match[0] for match in matches if bool(match[2]) == paired}
        return result

    def indices(self, kind: str) -> dict[tuple[int, int | None], str]:
        """See `SceneFiles`."""
        return self._indices.get(kind, {})

    def record(self, name: str) -> RecordFile:
        """See `SceneFiles`."""
        if name not in self._records:
            self._records[name] = self._read_record(name)
        return self._records[name]

    def _read_record(self, name: str) -> RecordFile:
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
        """See `SceneFiles`."""
        for file in (f"scene_gt_coco{self.ref.sensor}{name}.json", f"scene_gt_coco{name}{self.ref.sensor}.json"):
            if file in self.listing.files:
                place = self.listing.name(file)
                return place, decode_json(self.listing.read(file, MAX_JSON), Coco, place, DatasetError)
        return None

    def file(self, kind: str, image: int, index: int | None = None) -> str:
        """See `SceneFiles`."""
        name = self.indices(kind).get((image, index))
        default = f"{image:06d}.png" if index is None else f"{image:06d}_{index:06d}.png"
        return self.listing.name(f"{self.folder(kind)}/{name or default}")

    def read(self, kind: str, image: int, index: int | None, limit: int) -> bytes | None:
        """See `SceneFiles`."""
        name = self.indices(kind).get((image, index))
        return None if name is None else self.listings[kind].read(name, limit)

    def mask(self, kind: str, image: int, index: int) -> Mask | None:
        """See `SceneFiles`."""
        data = self.read(kind, image, index, MAX_JSON)
        return None if data is None else decode_mask(data, self.file(kind, image, index))


@dataclass(frozen=True)
class Member:
    """Content of a key: a file, or a part of a shard."""

    file: str
    path: Path
    offset: int = 0
    size: int | None = None
    """[B]; None: the whole file."""


class KeyedScene:
    """`SceneFiles` of views with a key each: members of shards, or files of the imagewise layout. Masks are run lengths."""

    def __init__(self, layout: Layout, ref: SceneRef) -> None:
        self.ref, self.listing = ref, layout.keyed[ref.split]
        self._masks: tuple[tuple[str, int], Any] | None = None

    @cached_property
    def members(self) -> Mapping[tuple[int, str], Member]:
        """Members of the scene by (image, content), such as (3, "rgb.jpg").

        Raises:
            DatasetError: A shard is damaged.
        """
        found: dict[tuple[int, str], Member] = {}
        for shard in self.ref.shards:
            path = self.listing.path(shard)
            for name, offset, size in list_members(path):
                self._add(found, name, Member(f"{self.listing.name(shard)}:{name}", path, offset, size))
        if not self.ref.shards:
            for name in self.listing.files:
                self._add(found, name, Member(self.listing.name(name), self.listing.path(name)))
        return found

    def _add(self, found: dict[tuple[int, str], Member], name: str, member: Member) -> None:
        match = KEYED.fullmatch(name)
        if match and int(match[1]) == self.ref.scene:
            found[int(match[2]), match[3]] = member

    def _content(self, member: Member, limit: int) -> bytes:
        if member.size is None:
            return self.listing.read(member.path.name, limit)
        with member.path.open("rb") as file:
            file.seek(member.offset)
            return file.read(min(member.size, limit))

    @property
    def kinds(self) -> set[str]:
        """See `SceneFiles`."""
        return self._kinds

    @cached_property
    def _kinds(self) -> set[str]:
        return {content.split(".")[0] for _, content in self.members} & set(_KINDS)

    @cached_property
    def _records(self) -> dict[str, RecordFile]:
        records = {name: RecordFile(self.ref.place) for name in RECORDS}
        for (image, content), member in sorted(self.members.items()):
            name = content.removesuffix(".json")
            if name not in records or name == content:
                continue
            try:
                entry: Any = decode_json(self._content(member, MAX_JSON), object, member.file, DatasetError)
            except DatasetError as error:
                records[name].faults.append((member.file, str(error)))
                continue
            records[name].add(image, entry, name, member.file)
        return records

    def record(self, name: str) -> RecordFile:
        """See `SceneFiles`."""
        return self._records[name]

    def coco(self, name: str) -> tuple[str, Any] | None:
        """See `SceneFiles`: keyed layouts have no COCO file."""
        return None

    def _find(self, kind: str, image: int) -> Member | None:
        suffixes = ("json",) if kind.startswith("mask") else SUFFIXES
        return next((member for suffix in suffixes if (member := self.members.get((image, f"{kind}.{suffix}")))), None)

    def indices(self, kind: str) -> dict[tuple[int, int | None], str]:
        """See `SceneFiles`; masks of a view are one file, without index."""
        return {(image, None): member.file for (image, content), member in self.members.items() if content.split(".")[0] == kind}

    def file(self, kind: str, image: int, index: int | None = None) -> str:
        """See `SceneFiles`."""
        member = self._find(kind, image)
        part = "" if index is None else f", mask {index}"
        return f"{member.file}{part}" if member else f"{self.ref.place}/{self.ref.scene:06d}_{image:06d}.{kind}{part}"

    def read(self, kind: str, image: int, index: int | None, limit: int) -> bytes | None:
        """See `SceneFiles`."""
        member = self._find(kind, image)
        return None if member is None else self._content(member, limit)

    def mask(self, kind: str, image: int, index: int) -> Mask | None:
        """See `SceneFiles`."""
        if self._masks is None or self._masks[0] != (kind, image):
            data = self.read(kind, image, None, MAX_JSON)
            file = self.file(kind, image)
            runs = {} if data is None else decode_json(data, dict[str, Segmentation], file, DatasetError)
            self._masks = (kind, image), runs
        runs = self._masks[1].get(str(index))
        return None if runs is None else crop_mask(decode_runs(runs, self.file(kind, image, index)), self.file(kind, image, index))


def decode_runs(runs: Segmentation, file: str) -> np.ndarray:
    """Decode run lengths (H, W) bool.

    Raises:
        DatasetError: They are compressed, or do not cover the image.
    """
    height, width = runs.size
    if isinstance(runs.counts, str) or max(runs.size) > MAX_SIDE or sum(runs.counts) != height * width:
        raise DatasetError(f"{file}: the runs do not cover the image of {width} x {height} pixels")
    return decode_run_lengths(runs.counts, runs.size)


def open_scene(layout: Layout, ref: SceneRef) -> SceneFiles:
    """Files of a scene."""
    return FolderScene(layout, ref) if ref.name else KeyedScene(layout, ref)
