"""Manifest of a data set: seed, versions and settings, and one entry with checksums per committed episode.

    manifest.json           seed, versions, the settings that determine the output; the first file of a data set
    manifest/constants.*    constants: models, USD assets
    manifest/000012.*       episode 12: how it ended, its attempts
    manifest/joined.*       indices: lists over all episodes; the last files of a data set

An entry is two files: `NAME.sha256` lists the checksums of its files, as `sha256sum -c` reads them in the data set's folder; `NAME.json`
is written after it and commits them. Nothing here depends on the machine, the time, or the number of worlds and writers.
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

ENTRIES = Path("manifest")
"""Folder of the entries, in the data set."""
CONSTANTS, INDICES = ENTRIES / "constants", ENTRIES / "joined"
CONFIG_FILE = "config.toml"
"""Resolved settings of the last bake that wrote to the data set."""
EPISODES_FILE = "episodes.jsonl"
"""List of episodes and how they ended."""
ATTEMPTS_FILE = "attempts.jsonl"
"""List of all pick attempts, ordered by episode and index; absent from bakes without picking."""
INPUTS = "inputs"
"""Key in the manifest: content digests of objects and lights."""
FORMAT = 1
"""Version of the manifest's file format."""
FREE_SETTINGS = (
    "bake.worlds",
    "bake.episodes",
    "bake.device",
    "bake.models",
    "bake.lights",
    "bake.writers",
    "render.views_per_batch",
    "perception.views",
)
"""Settings that may differ when a bake is resumed: no episode depends on them. Objects and lights are compared by content, not by the name
of their folder. A device of another type computes the same episodes up to rounding."""
PACKAGES = ("warp-lang", "newton", "numpy", "scipy", "coacd", "opencv-python-headless", "isal", "orjson", "usd-core", "zarr")
"""Packages whose versions the output depends on."""


def make_manifest(config: Config) -> dict[str, Any]:
    """Build the manifest of a data set with these settings, in types of JSON."""
    settings = fixed_settings(config)
    content = {
        "format": FORMAT,
        "seed": config.bake.seed,
        "versions": {"synpick-warp": __version__, **{name: _version(name) for name in PACKAGES}},
        "settings_checksum": _digest(settings),
        "settings": settings,
    }
    return json.loads(json.dumps(content))


def fixed_settings(config: Config) -> dict[str, Any]:
    """Settings that determine the output: all but FREE_SETTINGS, nested as in the file; formats sorted by name."""
    settings = dataclasses.asdict(config)
    for key in FREE_SETTINGS:
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
    """Serialize a manifest."""
    return (json.dumps(content, indent=2) + "\n").encode()


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read a data set's manifest.

    Raises:
        DatasetError: There is none, or it is damaged.
    """
    content = read_json(folder / MANIFEST_FILE)
    if content is None:
        raise DatasetError(f"{folder} has no {MANIFEST_FILE}; name the folder of a data set that synpick-warp baked")
    if content.get("format") != FORMAT:
        raise DatasetError(f"{folder / MANIFEST_FILE} has the format {content.get('format')}; this version reads {FORMAT}")
    if content.get("settings_checksum") != _digest(content.get("settings")):
        raise DatasetError(f"the settings in {folder / MANIFEST_FILE} do not match their checksum; it has been changed by hand")
    return content


def read_json(path: Path) -> dict[str, Any] | None:
    """Read a JSON object from a file that a bake wrote; None: no such file.

    Raises:
        DatasetError: The file cannot be read, or is damaged.
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
        raise DatasetError(f"{path} is damaged: it is not a JSON object")
    return content


def differences(here: Mapping[str, Any], there: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Compare two manifests: (key, value here, value there) of each difference; None: no such key."""
    for name in [*here, *(name for name in there if name not in here)]:
        first, second = here.get(name), there.get(name)
        if isinstance(first, Mapping) and isinstance(second, Mapping):
            yield from differences(first, second, f"{path}{name}.")
        elif first != second:
            yield f"{path}{name}", first, second


def describe_differences(here: Mapping[str, Any], there: Mapping[str, Any]) -> str:
    """Describe the differences of two manifests in a sentence: "physics.step is 0.004, there 0.002"."""
    parts = []
    for key, first, second in differences(here, there):
        if key not in ("settings_checksum", "seed"):
            parts.append(f"{key.removeprefix('settings.')} is {json.dumps(first)}, there {json.dumps(second)}")
    return "; ".join(parts)


def episode_entry(episode: int) -> Path:
    """Path of an episode's manifest entry, relative to the data set, without suffix."""
    return ENTRIES / f"{episode:06d}"


def committed_episodes(folder: Path) -> list[int]:
    """Indices of the episodes that have a manifest entry, sorted."""
    entries = folder / ENTRIES
    names = (path.stem for path in entries.iterdir() if path.suffix == ".json") if entries.is_dir() else ()
    return sorted(int(name) for name in names if name.isdecimal())


def read_entry(folder: Path, entry: Path) -> dict[str, Any] | None:
    """Read a manifest entry; None: there is none."""
    return read_json(folder / f"{entry}.json")


def read_checksums(folder: Path, entry: Path) -> dict[str, str]:
    """Read the checksums of an entry's files: path relative to the data set -> SHA-256.

    Raises:
        DatasetError: The list is missing, or does not match its entry.
    """
    path, content = folder / f"{entry}.sha256", read_entry(folder, entry)
    try:
        lines = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}") from error
    if content is None or hashlib.sha256(lines).hexdigest() != content.get("checksum"):
        raise DatasetError(f"{path} does not match {path.with_suffix('.json')}")
    pairs = (line.split("  ", 1) for line in lines.decode().splitlines())
    return {name: digest for digest, name in pairs}


def is_complete(folder: Path, entry: Path) -> bool:
    """Whether an entry and all of its files exist, compared by total size; `verify` checks content."""
    content = read_entry(folder, entry)
    if content is None:
        return False
    try:
        return sum((folder / name).stat().st_size for name in read_checksums(folder, entry)) == content.get("bytes")
    except (FileNotFoundError, NotADirectoryError, DatasetError):
        return False
