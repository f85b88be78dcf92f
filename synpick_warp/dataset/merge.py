"""Merge the shards of a data set that several bakes wrote: hard links of all committed episodes, then new indices."""

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
    ENTRIES,
    committed_episodes,
    describe_differences,
    encode_manifest,
    episode_entry,
    read_checksums,
    read_manifest,
)
from synpick_warp.dataset.writing import finalize_data_set, lock_folder
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.registry import load_exporter_classes, slot_bytes
from synpick_warp.exporters.writing.files import MANIFEST_FILE, check_output_folder, output_error, write_atomically
from synpick_warp.exporters.writing.pool import WriterPool


class Merged(NamedTuple):
    """Result of a merge."""

    episodes: int
    """Number of episodes."""
    missing: list[int]
    """Indices that no part has; a bake with the same settings generates them."""


def merge(parts: Sequence[Path], out: Path) -> Merged:
    """Merge the committed episodes of several data sets into one. Files are hard links where the file system allows, else copies.

    Args:
        parts: Data sets of the same settings, versions, objects and lights.
        out: Folder of the data set: new, or empty.

    Raises:
        DatasetError: A part is not a data set, or parts do not match.
        OutputError: A file cannot be written.
    """
    manifest = read_manifest(parts[0])
    for part in parts[1:]:
        said = describe_differences(read_manifest(part), manifest)
        if said:
            raise DatasetError(f"{part} was made with other settings than {parts[0]}: {said}; only parts of one data set can be merged")
    sources = _sources(parts)
    config = _config(parts)
    check_output_folder(out)
    if (out / MANIFEST_FILE).exists():
        raise DatasetError(f"{out} is already a data set; --out takes a new or an empty folder")
    locks = [lock_folder(part) for part in parts]
    try:
        _fill(out, sources, config, encode_manifest(manifest))
    except OSError as error:
        raise output_error(out, error) from error
    finally:
        for lock in locks:
            os.close(lock)
    there = committed_episodes(out)
    return Merged(len(there), sorted(set(range(config.bake.episodes)) - set(there)))


def _sources(parts: Sequence[Path]) -> dict[Path, Path]:
    """Choose the part that each manifest entry is taken from: entry -> part."""
    sources: dict[Path, Path] = {}
    for part in parts:
        for entry in (CONSTANTS, *map(episode_entry, committed_episodes(part))):
            known = sources.setdefault(entry, part)
            if known != part and read_checksums(known, entry) != read_checksums(part, entry):
                raise DatasetError(f"{known} and {part} have different files for {entry.name}; only parts of one data set can be merged")
    if not any(entry != CONSTANTS for entry in sources):
        raise DatasetError(f"{' and '.join(map(str, parts))} have no committed episode")
    return sources


def _config(parts: Sequence[Path]) -> Config:
    """Settings of the first part, with the largest `bake.episodes` of all."""
    configs = [load_config(str(part / CONFIG_FILE), {}) for part in parts]
    episodes = max(config.bake.episodes for config in configs)
    return dataclasses.replace(configs[0], bake=dataclasses.replace(configs[0].bake, episodes=episodes))


def _fill(out: Path, sources: dict[Path, Path], config: Config, manifest: bytes) -> None:
    """Link all files, then all entries, and build the indices; once the manifest is there, a bake can resume the data set."""
    kinds = load_exporter_classes(config.bake.formats)
    new = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    lock = lock_folder(out)
    try:
        try:
            (out / ENTRIES).mkdir()
            for entry, part in sources.items():
                for name in read_checksums(part, entry):
                    _link(part / name, out / name)
                for suffix in (".sha256", ".json"):
                    _link(part / f"{entry}{suffix}", out / f"{entry}{suffix}")
            write_atomically(out / CONFIG_FILE, config_to_toml(config).encode())
        except BaseException:
            _empty(out, new)
            raise
        write_atomically(out / MANIFEST_FILE, manifest)
        writers = config.bake.writers or len(os.sched_getaffinity(0))
        with WriterPool(writers, slot_bytes(kinds, config), lock) as pool:
            finalize_data_set(out, config, kinds, pool)
    finally:
        os.close(lock)


def _link(source: Path, target: Path) -> None:
    """Hard-link a file, or copy it where links are not possible."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except FileNotFoundError:
        raise DatasetError(f"{source} is missing; `synpick-warp verify` names what is damaged") from None
    except OSError:
        shutil.copy2(source, target)


def _empty(out: Path, remove_folder: bool) -> None:
    """Remove a folder's content, and the folder itself if it was new."""
    for path in out.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    if remove_folder:
        out.rmdir()
