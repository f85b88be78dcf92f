"""Joins the parts of a data set that several bakes have made, each its share of the episodes."""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from synpick_warp.configs.load import load_config
from synpick_warp.configs.schema import Config
from synpick_warp.configs.write import config_to_toml
from synpick_warp.dataset.manifest import (
    CONFIG_FILE,
    CONSTANTS,
    RECORDS,
    describe_differences,
    encode_manifest,
    episode_place,
    read_checksums,
    read_manifest,
    recorded_episodes,
)
from synpick_warp.dataset.writing import complete, lock_folder
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.registry import load_exporter_classes, slot_bytes
from synpick_warp.exporters.writing.files import MANIFEST_FILE, check_output_folder, output_error, write_atomically
from synpick_warp.exporters.writing.pool import WriterPool


class Merged(NamedTuple):
    """What came of it."""

    episodes: int
    missing: list[int]
    """Numbers that no part has; a bake with the same settings makes them."""


def merge(parts: Sequence[Path], out: Path) -> Merged:
    """Make one data set of the whole episodes of several. Files are hard links where the file system allows, else copies.

    Args:
        parts: Data sets of the same settings, versions, objects and lights.
        out: Folder of the data set: new, or empty.

    Raises:
        DatasetError: A part is no data set, or they do not fit each other.
        OutputError: A file cannot be written.
    """
    manifest = read_manifest(parts[0])
    for part in parts[1:]:
        said = describe_differences(read_manifest(part), manifest)
        if said:
            raise DatasetError(f"{part} was made with other settings than {parts[0]}: {said}; only parts of one data set can be joined")
    sources = _sources(parts)
    config = _config(parts)
    check_output_folder(out)
    if (out / MANIFEST_FILE).exists():
        raise DatasetError(f"{out} is a data set already; --out takes a new or an empty folder")
    locks = [lock_folder(part) for part in parts]
    try:
        _fill(out, sources, config, encode_manifest(manifest))
    except OSError as error:
        raise output_error(out, error) from error
    finally:
        for lock in locks:
            os.close(lock)
    there = recorded_episodes(out)
    return Merged(len(there), sorted(set(range(config.bake.episodes)) - set(there)))


def _sources(parts: Sequence[Path]) -> dict[Path, Path]:
    """Where each record is taken from: place -> part."""
    sources: dict[Path, Path] = {}
    for part in parts:
        for place in (CONSTANTS, *map(episode_place, recorded_episodes(part))):
            known = sources.setdefault(place, part)
            if known != part and read_checksums(known, place) != read_checksums(part, place):
                raise DatasetError(f"{known} and {part} have different files for {place.name}; only parts of one data set can be joined")
    if not any(place != CONSTANTS for place in sources):
        raise DatasetError(f"{' and '.join(map(str, parts))} have no whole episode")
    return sources


def _config(parts: Sequence[Path]) -> Config:
    """The settings of the first part, with the most episodes that a part was to have."""
    configs = [load_config(str(part / CONFIG_FILE), {}) for part in parts]
    most = max(config.bake.episodes for config in configs)
    return dataclasses.replace(configs[0], bake=dataclasses.replace(configs[0].bake, episodes=most))


def _fill(out: Path, sources: dict[Path, Path], config: Config, manifest: bytes) -> None:
    """Link all files, then all records; the manifest makes it a data set, and a bake can go on from there."""
    kinds = load_exporter_classes(config.bake.formats)
    new = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    lock = lock_folder(out)
    try:
        try:
            (out / RECORDS).mkdir()
            for place, part in sources.items():
                for name in read_checksums(part, place):
                    _link(part / name, out / name)
                for suffix in (".sha256", ".json"):
                    _link(part / f"{place}{suffix}", out / f"{place}{suffix}")
            write_atomically(out / CONFIG_FILE, config_to_toml(config).encode())
        except BaseException:
            _empty(out, new)
            raise
        write_atomically(out / MANIFEST_FILE, manifest)
        writers = config.bake.writers or len(os.sched_getaffinity(0))
        with WriterPool(writers, slot_bytes(kinds, config), lock) as pool:
            complete(out, config, kinds, pool)
    finally:
        os.close(lock)


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except FileNotFoundError:
        raise DatasetError(f"{source} is missing; `synpick-warp verify` tells of more") from None
    except OSError:
        shutil.copy2(source, target)


def _empty(out: Path, whole: bool) -> None:
    """Remove what was begun in a folder that was empty, and the folder itself if it was new."""
    for path in out.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    if whole:
        out.rmdir()
