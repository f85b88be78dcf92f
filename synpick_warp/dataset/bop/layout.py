"""Layout detection of a BOP data set: splits, scenes, sensors, shards and models folders, from the files that exist, not from folder
names; and model files: the folder that ground truth refers to, PLY file and symmetries of each object, and the objects' names.

Listings are confined to the data set: symbolic links that lead out of it are named and never followed.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from synpick_warp.configs.schema import ObjectRow
from synpick_warp.dataset.annotations import Key, ModelDiameter, read_checked
from synpick_warp.errors import DatasetError
from synpick_warp.scenes.assets.models_info import FileModelInfo, read_models_info
from synpick_warp.system.inputs.files import check_regular_file, path_inside, read_file

if TYPE_CHECKING:
    from synpick_warp.dataset.reading import DataSet


SPLIT = re.compile(r"(train|val|test)(_.*)?")
"""Folders that are splits even without a scene; others are splits if they have scenes."""
MODELS = re.compile(r"models(_.*)?")
MODEL_FILE = re.compile(r"obj_([0-9]{6,9})\.ply")
TARGETS = re.compile(r".*targets.*\.json")
"""Lists of the instances that a BOP challenge asks for."""
KEYS = "key_to_shard.json"
SHARD = re.compile(r"shard-[0-9]+\.tar")
KEYED = re.compile(r"([0-9]{6,9})_([0-9]{6,9})\.(.+)")
"""File of the imagewise layout, and member of a shard: scene, image, content."""
_ANNOTATION = re.compile(r"scene_(?:camera|gt)(?:_(?!info(?:_|\.)|coco(?:_|\.)|world(?:_|\.))(\w+))?\.json")
"""Annotations of a scene, with the name of the sensor, if there is one."""
RENDERING_MODELS = ("models", "models_cad", "models_eval", "models_reconst")
"""Models folders, the preferred one first: poses in the ground truth are those of the first one that there is."""


@dataclass(frozen=True)
class Listing:
    """Names in a folder. Files are read by these names only, so that no link leads a reader out of the data set."""

    root: Path
    """The data set, as the user names it."""
    place: str
    """The folder, relative to the root; "" is the root."""
    files: frozenset[str] = frozenset()
    folders: frozenset[str] = frozenset()
    outside: tuple[str, ...] = ()
    """Symbolic links that lead out of the data set, or nowhere."""
    special: tuple[str, ...] = ()
    """Pipes, sockets and devices."""

    def name(self, entry: str) -> str:
        """Path of an entry relative to the root, for messages."""
        return f"{self.place}/{entry}" if self.place else entry

    def path(self, entry: str) -> Path:
        """Path of an entry, from the root of the data set."""
        return self.root / self.name(entry)

    def read(self, entry: str, limit: int) -> bytes:
        """Read a listed file. Raises DatasetError: it cannot be read, or is larger than `limit` [B]."""
        if entry not in self.files:
            raise DatasetError(f"there is no file {self.name(entry)}")
        return read_file(self.path(entry), limit, DatasetError)

    def enter(self, folder: str) -> Listing:
        """List a folder in this one; empty if there is none."""
        return list_folder(self.root, self.name(folder)) if folder in self.folders else Listing(self.root, self.name(folder))


def list_folder(root: Path, place: str = "") -> Listing:
    """List a folder of a data set, by its path relative to the root; raises DatasetError if it cannot be listed."""
    files, folders, outside, special = set(), set(), [], []
    try:
        with os.scandir(root / place) as entries:
            for entry in entries:
                if entry.is_symlink() and not _leads_inside(root, entry.path):
                    outside.append(entry.name)
                elif entry.is_dir():
                    folders.add(entry.name)
                elif entry.is_file():
                    files.add(entry.name)
                else:
                    special.append(entry.name)
    except OSError as fault:
        raise DatasetError(f"{root / place} cannot be listed: {fault.strerror}") from None
    return Listing(root, place, frozenset(files), frozenset(folders), tuple(sorted(outside)), tuple(sorted(special)))


def _leads_inside(root: Path, link: str) -> bool:
    """Whether a symbolic link leads to something inside the data set."""
    try:
        target, place = Path(link).resolve(strict=True), root.resolve()
    except (OSError, RuntimeError):
        return False
    return target != place and target.is_relative_to(place)


class NoLayoutError(DatasetError):
    """A folder that is no BOP data set, nor a part of one."""


@dataclass(frozen=True)
class SceneRef:
    """A scene as one sensor sees it: a folder of files, members of shards, or files of the imagewise layout."""

    split: str
    scene: int
    name: str
    """Folder in the split; empty: the scene is in shards or in the imagewise layout."""
    sensor: str = ""
    """Suffix of the sensor's files, such as "_cam1" of scene_gt_cam1.json; empty: the classic layout."""
    shards: tuple[str, ...] = ()
    """Tar files in the split's folder; empty, with no name: imagewise."""

    @property
    def place(self) -> str:
        """Path relative to the data set."""
        return f"{self.split}/{self.name}" if self.name else self.split


class Layout:
    """Detected layout of a data set."""

    def __init__(self, folder: Path) -> None:
        """Raises DatasetError if the folder does not exist, cannot be listed, has nothing of a BOP data set, or is a part of one."""
        if not folder.is_dir():
            raise NoLayoutError(f"there is no folder {folder}; name the folder of a BOP data set")
        self.root = folder
        self.listing = list_folder(self.root)
        if any(_ANNOTATION.fullmatch(name) for name in self.listing.files):
            raise DatasetError(f"{folder} is a scene; name the data set, two folders above")
        if _has_scenes(self.listing):
            raise DatasetError(f"{folder} is a split; name the data set, the folder above")
        self.models = {name: self.listing.enter(name) for name in sorted(filter(MODELS.fullmatch, self.listing.folders))}
        others = sorted(name for name in self.listing.folders if not name.startswith(".") and name not in self.models)
        listings = {name: self.listing.enter(name) for name in others}
        self.splits = {name: listing for name, listing in listings.items() if SPLIT.fullmatch(name) and not _is_keyed(listing)}
        self.splits |= {name: listing for name, listing in listings.items() if name not in self.splits and _has_scenes(listing)}
        self.keyed = {name: listing for name, listing in listings.items() if _is_keyed(listing)}
        self.splits = {name: self.splits[name] for name in sorted(self.splits)}
        if not self.splits and not self.keyed:
            raise NoLayoutError(
                f"{folder} is not a BOP data set: it has no split (train_pbr, test, ...) of scenes; name the folder that contains them"
            )

    @property
    def ours(self) -> bool:
        """Whether `bake` made it: masks are exact, and do not overlap."""
        return "manifest.json" in self.listing.files and "manifest" in self.listing.folders

    def is_rendered(self, split: str) -> bool:
        """Whether a split's images are rendered, so that depth is exact."""
        return self.ours or split.endswith(("_pbr", "_pbr_web"))

    @cached_property
    def model_files(self) -> dict[int, tuple[str, str]]:
        """Model by obj_id, as (models folder, file name): those that ground truth is rendered with."""
        order = [name for name in RENDERING_MODELS if name in self.models] + [name for name in self.models if name not in RENDERING_MODELS]
        for folder in order:
            found = {int(match[1]): (folder, match[0]) for name in self.models[folder].files if (match := MODEL_FILE.fullmatch(name))}
            if found:
                return found
        return {}

    def scenes(self) -> list[SceneRef]:
        """All scenes: those of splits by index and sensor, then keyed ones."""
        found = []
        for split, listing in self.splits.items():
            for name in sorted((name for name in listing.folders if is_index(name)), key=int):
                found += [SceneRef(split, int(name), name, sensor) for sensor in sensors(listing.enter(name))]
        return found


def is_index(name: str) -> bool:
    """Whether a name is a number in ASCII digits that fits into 32 bits."""
    return name.isascii() and name.isdecimal() and len(name) <= 9


def sensors(scene: Listing) -> list[str]:
    """Suffixes of a scene's annotation files, one per sensor; the classic layout has the suffix ""."""
    found = {f"_{match[1]}" if match[1] else "" for name in scene.files if (match := _ANNOTATION.fullmatch(name))}
    return sorted(found) or [""]


def _has_scenes(listing: Listing) -> bool:
    """Whether a folder contains a scene: a numbered folder with annotations."""
    return any(
        any(_ANNOTATION.fullmatch(file) for file in listing.enter(name).files) for name in sorted(filter(is_index, listing.folders))[:3]
    )


def _is_keyed(listing: Listing) -> bool:
    """Whether a folder contains shards or files of the imagewise layout."""
    if KEYS in listing.files or any(SHARD.fullmatch(name) for name in listing.files):
        return True
    return any((match := KEYED.fullmatch(name)) and match[3] in ("camera.json", "gt.json") for name in listing.files)


INFO = "models_info.json"
_MODEL_NAME = re.compile(rb"^comment (.+), millimetres\r?$", re.MULTILINE)
"""Comment in a PLY file that the BOP exporter wrote: the object's name."""
_PLY_HEAD = 2048
"""Size of the part of a PLY file that is searched for comments [B]."""
_MAX_MODEL = 2**40
"""Largest PLY file [B]; only its head is read."""


def models_folder(folder: Path) -> str:
    """Name of a data set's folder of models: "models", or another where there is none (T-LESS: models_cad); "models" if there are none."""
    return next((name for name in RENDERING_MODELS if (folder / name).is_dir()), RENDERING_MODELS[0])


def find_models(folder: Path, object_ids: Iterable[int], purpose: str) -> dict[int, tuple[Path, FileModelInfo]]:
    """Find the models of objects: obj_id -> PLY file [mm], and its entry of models_info.json; sorted. `purpose`, such as "poses are
    evaluated", is for messages. Raises DatasetError if the data set has no models, or an object has none, and CatalogError if
    models_info.json is damaged, or lacks an object."""
    models = models_folder(folder)
    info = path_inside(folder, f"{models}/{INFO}", folder, DatasetError)
    if not info.is_file():
        raise DatasetError(f"{folder} has no {models}/{INFO}, which {purpose} with; bake with --formats bop or shards, or add BOP's models")
    wanted = sorted(set(object_ids))
    infos = read_models_info(info, wanted)
    found = {}
    for object_id in wanted:
        name = f"{models}/obj_{object_id:06d}.ply"
        path = path_inside(folder, name, folder, DatasetError)
        if not path.is_file():
            raise DatasetError(
                f"{folder} has no {name}, the model of an object in its ground truth; restore it, or bake the data set again"
            )
        found[object_id] = path, infos[object_id]
    return found


def object_names(dataset: Path, object_ids: set[int], rows: Sequence[ObjectRow] = (), tolerance: float = 0.0) -> dict[int, str]:
    """Names of objects (obj_id -> name): from the exported model's comment, else from the settings' object table; some have none.

    `rows`, `tolerance`: the object table, and `objects.diameter_tolerance`.
    """
    folder = dataset / models_folder(dataset)
    infos = read_checked(folder / INFO, dict[Key, ModelDiameter])
    names = {}
    for object_id in object_ids:
        path = folder / f"obj_{object_id:06d}.ply"
        comment = None
        if path.exists():
            check_regular_file(path, _MAX_MODEL, DatasetError)
            with path.open("rb") as file:
                comment = _MODEL_NAME.search(file.read(_PLY_HEAD))
        size = float(infos.get(object_id, {}).get("diameter", 0.0)) / 1000.0
        # A row without a diameter matches any.
        fits = (row.name for row in rows if row.id == object_id and abs(size - (row.diameter or size)) <= tolerance * row.diameter)
        name = comment[1].decode(errors="replace") if comment else next(fits, "")
        if name:
            names[object_id] = name
    return names


def names_of(data: DataSet) -> dict[int, str]:
    """Names of a data set's objects: from the trajectory store, else from models and settings, else "obj_NNNNNN"; none without both."""
    if data.has_store:
        return {item.object_id: item.name for item in data.objects}
    config = data.config
    if not {"bop", "shards"} & set(config.bake.formats):
        return {}
    known = object_names(data.folder, set(data.models_info), config.object_rows, config.objects.diameter_tolerance)
    return {index: known.get(index, f"obj_{index:06d}") for index in data.models_info}
