"""Images of a scene by type, image and ground-truth index: files of a scene folder, or files whose names begin with a key.

A key names the view, SCENE_IMAGE, as in 000001_000042.rgb.jpg. BOP has two such layouts: webdataset shards (tar files, with a
key_to_shard.json that says which), and the imagewise layout (the files themselves, all in one folder).
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.dataset.bop.layout import KEYED, KEYS, SHARD, Listing, SceneRef
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import MAX_JSON, decode_json, read_file
from synpick_warp.system.inputs.image_files import MAX_IMAGE_FILE
from synpick_warp.system.inputs.tar_files import list_members

SUFFIXES = ("png", "jpg", "jpeg", "tif", "tiff")
"""File formats of images that BOP data sets have, the preferred one first."""
KINDS = ("rgb", "gray", "depth", "mask", "mask_visib")
COLOR = ("rgb", "gray")
"""Kinds that can be shown as a colour image, the preferred one first."""
_NAME = re.compile(r"([0-9]{1,9})(?:_([0-9]{1,9}))?\.(\w+)")
"""Name of an image's file: image, ground-truth index of a mask, suffix."""

KEY = re.compile(r"([0-9]{6,9})_([0-9]{6,9})")
"""Key of a view: scene, image."""

Index = tuple[int, int | None]
"""im_id of an image, and for a mask the index of its instance in the image's list in scene_gt.json (BOP's gt_id)."""


class SceneImages(ABC):
    """Images of a scene as one sensor sees it."""

    listing: Listing
    """Folder of the scene, or of the shards or files."""

    @abstractmethod
    def indices(self, kind: str) -> dict[Index, str]:
        """File names of a kind by image, and instance or None."""

    @abstractmethod
    def file(self, kind: str, image: int, index: int | None = None) -> str:
        """Path of an image relative to the data set, whether it exists or not."""

    @abstractmethod
    def read(self, kind: str, image: int, index: int | None, limit: int) -> bytes | None:
        """Read an image of at most `limit` bytes; None: there is none. Raises DatasetError if it cannot be read."""

    def find(self, name: str, image: int, index: int | None = None) -> tuple[str, bytes, str] | None:
        """Suffix, content and path of an image; "rgb" is grey where there is no colour. None: there is none."""
        for kind in COLOR if name == "rgb" else (name,):
            data = self.read(kind, image, index, MAX_IMAGE_FILE)
            if data is not None:
                source = str(self.listing.root / self.file(kind, image, index))
                return f".{source.rpartition('.')[2].lower()}", data, source
        return None


class FolderImages(SceneImages):
    """Images of one sensor in a scene folder, by the suffix of its files, such as "_cam1", empty: the classic layout; `digits`: least
    number of digits of indices in file names, of which BOP has six."""

    def __init__(self, listing: Listing, sensor: str, digits: int = 1) -> None:
        self.listing, self.sensor, self._digits = listing, sensor, digits
        self._indices: dict[str, dict[Index, str]] = {}

    def folder(self, kind: str) -> str:
        """Folder of a kind: KIND_SENSOR, such as rgb_cam1; but images of a sensor that is named like a kind, "gray1", are in "gray1"."""
        modality = self.sensor[1:]
        if kind in ("rgb", "gray", "depth") and re.fullmatch(rf"{kind}[0-9]*", modality) and modality in self.listing.folders:
            return modality
        return f"{kind}{self.sensor}"

    @property
    def kinds(self) -> set[str]:
        """Kinds of images that the scene has, of KINDS."""
        return {kind for kind in KINDS if self.folder(kind) in self.listing.folders}

    @cached_property
    def listings(self) -> dict[str, Listing]:
        """Listings of the scene's image folders by kind."""
        return {kind: self.listing.enter(self.folder(kind)) for kind in KINDS if kind in self.kinds}

    def indices(self, kind: str) -> dict[Index, str]:
        if kind not in self._indices:
            self._indices[kind] = self._index(self.listing.enter(self.folder(kind)), kind.startswith("mask"))
        return self._indices[kind]

    def _index(self, listing: Listing, paired: bool) -> dict[Index, str]:
        """File names by (image, instance or None); `paired`: names with an instance (masks). Of several the first in SUFFIXES wins."""
        found: dict[Index, str] = {}
        matches = [match for name in listing.files if (match := _NAME.fullmatch(name)) and match[3].lower() in SUFFIXES]
        for match in sorted(matches, key=lambda match: SUFFIXES.index(match[3].lower())):
            if bool(match[2]) == paired and min(map(len, filter(None, match.group(1, 2)))) >= self._digits:
                found.setdefault((int(match[1]), int(match[2]) if match[2] else None), match[0])
        return found

    def file(self, kind: str, image: int, index: int | None = None) -> str:
        default = f"{image:06d}.png" if index is None else f"{image:06d}_{index:06d}.png"
        return self.listing.name(f"{self.folder(kind)}/{self.indices(kind).get((image, index), default)}")

    def read(self, kind: str, image: int, index: int | None, limit: int) -> bytes | None:
        if (image, index) not in self.indices(kind):
            return None
        return read_file(self.listing.root / self.file(kind, image, index), limit, DatasetError)


@dataclass(frozen=True)
class Member:
    """Where one file of a view is: a file of its own, or a part of a shard."""

    file: str
    """Name for messages: PATH, or SHARD:NAME, relative to the data set."""
    path: Path
    """The file, or the shard."""
    offset: int = 0
    size: int | None = None
    """[B]; None: the whole file."""


class KeyedImages(SceneImages):
    """Images of a scene in shards or in the imagewise layout. All masks of an image are one JSON file, of run lengths (COCO's RLE)."""

    def __init__(self, listing: Listing, ref: SceneRef) -> None:
        self.listing, self.ref = listing, ref

    @cached_property
    def members(self) -> Mapping[tuple[int, str], Member]:
        """Members of the scene by (image, content), such as (3, "rgb.jpg"). Raises DatasetError if a shard is damaged."""
        found: dict[tuple[int, str], Member] = {}
        for shard in self.ref.shards:
            path = self.listing.path(shard)
            for name, offset, size in list_members(path, extended=True):
                self._add(found, name, Member(f"{self.listing.name(shard)}:{name}", path, offset, size))
        if not self.ref.shards:
            for name in self.listing.files:
                self._add(found, name, Member(self.listing.name(name), self.listing.path(name)))
        return found

    def _add(self, found: dict[tuple[int, str], Member], name: str, member: Member) -> None:
        """Add a file or member by (image, content), if its name is KEY.CONTENT and of this scene."""
        match = KEYED.fullmatch(name)
        if match and int(match[1]) == self.ref.scene:
            found[int(match[2]), match[3]] = member

    def content(self, member: Member, limit: int) -> bytes:
        """Content of a member, of a shard's its first `limit` bytes. Raises DatasetError if it cannot be read, or a file is larger."""
        if member.size is None:
            return self.listing.read(member.path.name, limit)
        try:
            with member.path.open("rb") as file:
                file.seek(member.offset)
                data = file.read(min(member.size, limit))
        except OSError as error:
            raise DatasetError(f"{member.path} cannot be read: {error.strerror}") from None
        if len(data) < min(member.size, limit):
            raise DatasetError(f"{member.path} is damaged: it ends within {member.file.rpartition(':')[2]}; {ADVICE}")
        return data

    @cached_property
    def kinds(self) -> set[str]:
        """Kinds of images that the scene has, of KINDS."""
        return {content.split(".")[0] for _, content in self.members} & set(KINDS)

    def indices(self, kind: str) -> dict[Index, str]:
        """Files of a kind by (image, None): the masks of a view are one file."""
        return {(image, None): member.file for (image, content), member in self.members.items() if content.split(".")[0] == kind}

    def member(self, kind: str, image: int) -> Member | None:
        """File or shard member of an image, or of all masks of a view; None: there is none."""
        suffixes = ("json",) if kind.startswith("mask") else SUFFIXES
        return next((member for suffix in suffixes if (member := self.members.get((image, f"{kind}.{suffix}")))), None)

    def file(self, kind: str, image: int, index: int | None = None) -> str:
        member = self.member(kind, image)
        part = "" if index is None else f", mask {index}"
        return f"{member.file}{part}" if member else f"{self.ref.place}/{self.ref.scene:06d}_{image:06d}.{kind}{part}"

    def read(self, kind: str, image: int, index: int | None, limit: int) -> bytes | None:
        """Content of the image's member; `index` is not used."""
        member = self.member(kind, image)
        return None if member is None else self.content(member, limit)


@dataclass(frozen=True, eq=False)
class KeyedFolder:
    """A folder of shards, or of files in the imagewise layout."""

    listing: Listing

    @property
    def place(self) -> str:
        """Path relative to the data set."""
        return self.listing.place

    @cached_property
    def shards(self) -> list[str]:
        """Names of the tar files."""
        return sorted(filter(SHARD.fullmatch, self.listing.files))

    @cached_property
    def keys(self) -> tuple[dict[str, int] | None, str]:
        """What key_to_shard.json says, the number of the shard by key, or None; and why it is None, or ""."""
        if KEYS not in self.listing.files:
            return None, f"there is no {KEYS}" if self.shards else ""
        try:
            return decode_json(self.listing.read(KEYS, MAX_JSON), dict[str, int], self.listing.name(KEYS), DatasetError), ""
        except DatasetError as error:
            return None, str(error)

    @cached_property
    def members(self) -> dict[str, set[str] | str]:
        """Keys in each shard, or the reason why it cannot be read."""
        found: dict[str, set[str] | str] = {}
        for shard in self.shards:
            try:
                matches = (KEYED.fullmatch(name) for name, _, _ in list_members(self.listing.path(shard), extended=True))
                found[shard] = {f"{match[1]}_{match[2]}" for match in matches if match}
            except DatasetError as error:
                found[shard] = str(error)
        return found

    def scenes(self) -> list[tuple[SceneRef, list[int]]]:
        """Scenes with their images, by index; those in shards that cannot be read are left out."""
        images: dict[int, set[int]] = {}
        shards: dict[int, set[str]] = {}
        for shard, keys in self.members.items():
            for key in keys if isinstance(keys, set) else ():
                scene, image = map(int, key.split("_"))
                images.setdefault(scene, set()).add(image)
                shards.setdefault(scene, set()).add(shard)
        for name in self.listing.files if not self.shards else ():
            if match := KEYED.fullmatch(name):
                images.setdefault(int(match[1]), set()).add(int(match[2]))
        return [
            (SceneRef(self.place, scene, "", "", tuple(sorted(shards.get(scene, ())))), sorted(images[scene])) for scene in sorted(images)
        ]
