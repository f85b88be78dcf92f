"""What a data set says of its own making: seed, versions, settings, and a record with checksums of everything that is whole.

    manifest.json           seed, versions, the settings that what is written depends on; the first file of a data set
    manifest/constants.*    models, assets: what the data set says once
    manifest/000012.*       episode 12: how it ended, its attempts
    manifest/joined.*       lists that span episodes; the last files of a data set

A record is two files: `NAME.sha256` has the files' checksums, as `sha256sum -c` reads them in the data set's folder; `NAME.json` is
written after it, and what has one is whole. Nothing here depends on the machine, the time, or the number of worlds and writers.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from synpick_warp import __version__
from synpick_warp.configs.schema import Config
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.files import MANIFEST_FILE

RECORDS = Path("manifest")
"""Folder of the records, in the data set."""
CONSTANTS, JOINED = RECORDS / "constants", RECORDS / "joined"
CONFIG_FILE = "config.toml"
"""The resolved settings, in the data set; those of the last bake that went on with it."""
EPISODES_FILE = "episodes.jsonl"
"""How every episode ended, in the data set."""
ATTEMPTS_FILE = "attempts.jsonl"
"""List of all attempts to pick, ordered by episode and index; absent from bakes without picking."""
INPUTS = "inputs"
"""Key in the manifest: checksums of what is in the objects and in the lights."""
FORMAT = 1
"""Of these files."""
FREE = (
    "bake.worlds",
    "bake.episodes",
    "bake.device",
    "bake.models",
    "bake.lights",
    "bake.writers",
    "render.views_per_batch",
    "sight.views",
)
"""Settings in which a bake may differ from the one that it goes on with: no episode depends on them. Objects and lights are compared by
what is in them, not by the name of their folder. A device of another kind computes the same episodes to its own last bits."""
PACKAGES = ("warp-lang", "newton", "numpy", "scipy", "coacd", "opencv-python-headless", "isal", "orjson", "usd-core", "zarr")
"""Whose versions files depend on."""


def make_manifest(config: Config) -> dict[str, Any]:
    """The content of a data set's manifest, as JSON has it."""
    settings = binding_settings(config)
    content = {
        "format": FORMAT,
        "seed": config.bake.seed,
        "versions": {"synpick-warp": __version__, **{name: _version(name) for name in PACKAGES}},
        "settings_checksum": _digest(settings),
        "settings": settings,
    }
    return json.loads(json.dumps(content))


def binding_settings(config: Config) -> dict[str, Any]:
    """All settings but FREE, nested as in the file; formats in the order of their names."""
    settings = dataclasses.asdict(config)
    for key in FREE:
        section, name = key.split(".")
        del settings[section][name]
    settings["bake"]["formats"] = sorted(set(config.bake.formats))
    return settings


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _digest(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def encode_manifest(content: Mapping[str, Any]) -> bytes:
    """As it is written."""
    return (json.dumps(content, indent=2) + "\n").encode()


def read_manifest(folder: Path) -> dict[str, Any]:
    """A data set's manifest.

    Raises:
        DatasetError: There is none, or it is damaged.
    """
    content = read_json(folder / MANIFEST_FILE)
    if content is None:
        raise DatasetError(f"{folder} has no {MANIFEST_FILE}; name the folder of a data set that synpick-warp baked")
    if content.get("format") != FORMAT:
        raise DatasetError(f"{folder / MANIFEST_FILE} has the format {content.get('format')}; this version reads {FORMAT}")
    if content.get("settings_checksum") != _digest(content.get("settings")):
        raise DatasetError(f"the settings in {folder / MANIFEST_FILE} do not fit their checksum; it has been changed by hand")
    return content


def read_json(path: Path) -> dict[str, Any] | None:
    """An object from a file of ours; None: no such file.

    Raises:
        DatasetError: The file cannot be read, or is none of ours.
    """
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise DatasetError(f"{path} is damaged: {error}") from None
    if not isinstance(content, dict):
        raise DatasetError(f"{path} is damaged: it has no object")
    return content


def differences(here: Mapping[str, Any], there: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Keys in which two manifests differ, as (key, value here, value there); None: no such key."""
    for name in [*here, *(name for name in there if name not in here)]:
        first, second = here.get(name), there.get(name)
        if isinstance(first, Mapping) and isinstance(second, Mapping):
            yield from differences(first, second, f"{path}{name}.")
        elif first != second:
            yield f"{path}{name}", first, second


def describe_differences(here: Mapping[str, Any], there: Mapping[str, Any]) -> str:
    """Keys in which two manifests differ, with both values, as people know them: "physics.step is 0.004, there 0.002"."""
    parts = []
    for key, first, second in differences(here, there):
        if key not in ("settings_checksum", "seed"):
            parts.append(f"{key.removeprefix('settings.')} is {json.dumps(first)}, there {json.dumps(second)}")
    return "; ".join(parts)


def episode_place(episode: int) -> Path:
    """Where the record of an episode is, relative to the data set, without suffix."""
    return RECORDS / f"{episode:06d}"


def recorded_episodes(folder: Path) -> list[int]:
    """Numbers of the episodes that have a record, in order."""
    place = folder / RECORDS
    names = (path.stem for path in place.iterdir() if path.suffix == ".json") if place.is_dir() else ()
    return sorted(int(name) for name in names if name.isdecimal())


def read_record(folder: Path, place: Path) -> dict[str, Any] | None:
    """The record at a place; None: there is none."""
    return read_json(folder / f"{place}.json")


def read_checksums(folder: Path, place: Path) -> dict[str, str]:
    """Path -> checksum of a record's files.

    Raises:
        DatasetError: The list is missing, or does not fit its record.
    """
    path, record = folder / f"{place}.sha256", read_record(folder, place)
    try:
        lines = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}") from error
    if record is None or hashlib.sha256(lines).hexdigest() != record.get("checksum"):
        raise DatasetError(f"{path} does not fit {path.with_suffix('.json')}")
    pairs = (line.split("  ", 1) for line in lines.decode().splitlines())
    return {name: digest for digest, name in pairs}


def seems_whole(folder: Path, place: Path) -> bool:
    """Whether a record and its files are there, by size; content is for `verify` to check."""
    record = read_record(folder, place)
    if record is None:
        return False
    try:
        return sum((folder / name).stat().st_size for name in read_checksums(folder, place)) == record.get("bytes")
    except (FileNotFoundError, NotADirectoryError, DatasetError):
        return False
