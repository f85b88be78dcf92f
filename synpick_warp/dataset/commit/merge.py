"""Merge of data sets that several bakes wrote in shares: hard links to all committed episodes, then new indices.

Parts may have been edited: names come from checked lists only, symbolic links are refused, and files are created, never overwritten.
"""

import contextlib
import dataclasses
import itertools
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.files.load import config_to_toml
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit import manifest as manifests
from synpick_warp.dataset.commit.writing import finalize_data_set, lock_folder, remove_path
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.registry import Needs
from synpick_warp.exporters.writing import files
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.inputs.files import make_folder
from synpick_warp.system.inputs.urls import store_url

MAX_EPISODES = 10_000_000
"""Maximum number of episodes of a merged data set, since missing ones are listed."""
_EXECUTE = 0o111 | stat.S_ISUID | stat.S_ISGID | stat.S_ISVTX
"""Permission bits that files of a data set do not have. Some file systems set them on every file, so they are not an error."""
_COPY_BYTES = 1 << 20
"""Size of a copy block [B]."""


class Merged(NamedTuple):
    """Result of a merge: number of episodes, indices of missing episodes, remarks on skipped files."""

    episodes: int
    missing: list[int]
    """Episodes that no part contains; a bake with the same settings generates them."""
    left_out: list[str]


def merge(parts: Sequence[Path], out: Path) -> Merged:
    """Merge the committed episodes of several data sets of the same settings, versions, objects and lights into one, in a new or empty
    folder. Files are hard links where the file system allows, else copies. Raises DatasetError if a part is not a data set, or parts do not
    match, and OutputError if a file cannot be written."""
    if (url := next(filter(None, map(store_url, parts)), None)) is not None:
        raise DatasetError(f"{url} is in an object store, where all of --shard fill one prefix; merge takes folders of this machine")
    manifest = manifests.read_manifest(parts[0])
    for part in parts[1:]:
        other = manifests.read_manifest(part)
        if said := manifests.describe_differences(other, manifest):
            raise DatasetError(f"{part} was made with other settings than {parts[0]}: {said}; only parts of one data set can be merged")
        if said := manifests.describe_inputs(other.get(manifests.INPUTS, {}), manifest.get(manifests.INPUTS, {})):
            raise DatasetError(f"{part} was made with other {said} than {parts[0]}; only parts of one data set can be merged")
    _check_folders(parts, out)
    config = _config(parts, manifest)
    layout = DataLayout.of(config)
    sources = _sources(parts, layout)
    files.check_output_folder(out)
    if (out / files.MANIFEST_FILE).exists():
        raise DatasetError(f"{out} is already a data set; --out takes a new or an empty folder")
    locks = []
    try:
        for part in parts:
            locks.append(lock_folder(part))  # noqa: PERF401 (those that are locked must be closed)
        _fill(out, sources, config, manifests.encode_manifest(manifest))
    except OSError as error:
        raise files.output_error(out, error) from error
    finally:
        for lock in locks:
            os.close(lock)
    there = set(manifests.committed_episodes(out))
    missing = [index for each in layout.plan() for index in each if index not in there]
    return Merged(
        len(there),
        missing,
        [line for part in parts if (line := manifests.describe_strays(part, layout, manifests.committed_episodes(part)))],
    )


def _check_folders(parts: Sequence[Path], out: Path) -> None:
    """Check that the parts are distinct, and that the output folder neither is, contains nor lies in one. Raises DatasetError otherwise."""
    known: dict[tuple[int, int], Path] = {}
    try:
        target = out.resolve()
        for part in parts:
            state, place = part.stat(), part.resolve()
            first = known.get((state.st_dev, state.st_ino))
            if first is not None:
                raise DatasetError(f"{first} and {part} are the same folder; name each part once")
            known[state.st_dev, state.st_ino] = part
            if target.is_relative_to(place) or place.is_relative_to(target):
                raise DatasetError(f"--out is {out}, which is, holds or lies in the part {part}; name a folder outside of the parts")
    except (OSError, RuntimeError, ValueError) as error:  # Links in a circle; a name with a null byte.
        raise DatasetError(f"a part or --out cannot be read: {getattr(error, 'strerror', None) or error}") from None


def _sources(parts: Sequence[Path], layout: DataLayout) -> dict[Path, Path]:
    """Map each manifest entry to the first part that contains it: entry -> part. Raises DatasetError if parts differ in
    an entry, an entry or a checksum list is damaged, or no part has a committed episode."""
    sources: dict[Path, Path] = {}
    for part in parts:
        for entry in (manifests.CONSTANTS, *map(manifests.episode_entry, manifests.committed_episodes(part))):
            checksums, known = manifests.read_checksums(part, entry), sources.setdefault(entry, part)
            manifests.check_file_names(part, entry, checksums, layout)
            if known is part:
                continue
            if manifests.read_checksums(known, entry) != checksums or manifests.read_entry(known, entry) != manifests.read_entry(
                part, entry
            ):
                raise DatasetError(f"{known} and {part} have different files for {entry.name}; only parts of one data set can be merged")
    if not any(entry != manifests.CONSTANTS for entry in sources):
        raise DatasetError(f"{' and '.join(map(str, parts))} have no committed episode")
    return sources


def _config(parts: Sequence[Path], manifest: Mapping[str, Any]) -> Config:
    """Settings of the first part, with the maximum number of episodes over all parts, per split."""
    configs = [manifests.read_settings(part, manifest) for part in parts]
    longest = [max(each, key=lambda split: split.episodes) for each in zip(*(config.splits for config in configs), strict=True)]
    episodes = sum(split.episodes for split in longest) or max(config.bake.episodes for config in configs)
    if episodes > MAX_EPISODES:
        raise DatasetError(
            f"bake.episodes is {episodes} in the {manifests.CONFIG_FILE} of a part; allowed: up to {MAX_EPISODES}; correct it there"
        )
    config = dataclasses.replace(configs[0].with_values({"bake.episodes": episodes}), splits=tuple(longest))
    for before, after in itertools.pairwise(config.splits):
        if after.first < before.first + before.episodes:
            raise DatasetError(f"the split {before.name} of one part has episodes that the split {after.name} of another one has")
    return config


def _fill(out: Path, sources: dict[Path, Path], config: Config, manifest: bytes) -> None:
    """Link all files, then all entries, and build the indices in a staging folder, whose content is then moved; removed on errors."""
    created = [folder for folder in (out, *out.parents) if not os.path.lexists(folder)]
    work = out / files.PARTIAL
    names: list[str] = []
    try:
        make_folder(work)
        (work / manifests.ENTRIES).mkdir()
        lock = lock_folder(out)
        try:
            _stage(work, sources, config, manifest, lock)
            # The manifest marks a data set, so it comes last.
            names = sorted(os.listdir(work), key=lambda name: name == files.MANIFEST_FILE)
            for name in names:
                (work / name).rename(out / name)
        finally:
            os.close(lock)
    except BaseException:
        with contextlib.suppress(OSError):
            for name in (name for name in names if not os.path.lexists(work / name)):
                remove_path(out / name)
            files.remove_folder(work, ignore_errors=True)
            for folder in created:
                folder.rmdir()
        raise
    files.remove_folder(work)


def _stage(work: Path, sources: dict[Path, Path], config: Config, manifest: bytes, lock: int) -> None:
    """Fill an empty folder with the files of all entries, the entries, settings, manifest and indices."""
    for entry, part in sources.items():
        size = sum(link_file(part / name, work / name) for name in manifests.read_checksums(part, entry))
        for suffix in (".sha256", ".json"):
            link_file(part / f"{entry}{suffix}", work / f"{entry}{suffix}")
        if size != (manifests.read_entry(work, entry) or {}).get("bytes"):  # A power cut shortens what an unfinished bake has not flushed.
            raise DatasetError(f"{part} has files of other sizes than {entry}.json says; resume its bake, or see `synpick-warp verify`")
    files.write_atomically(work / manifests.CONFIG_FILE, config_to_toml(config).encode())
    files.write_atomically(work / files.MANIFEST_FILE, manifest)
    needs = Needs.of(config)
    with WriterPool(config.bake.writers or count_cores(), needs.slot_bytes, lock) as pool:
        finalize_data_set(work, ExportSettings.of(config), needs.classes, pool)


def link_file(source: Path, target: Path) -> int:
    """Hard-link a regular file, or copy it where links are not possible, or would bring the right to execute it along; returns its size
    [B]. Raises DatasetError if the source is missing, is a symbolic link or no regular file, or cannot be read, and OSError if the target
    cannot be written, or exists: it may be a hard link, so that it is never written to."""
    make_folder(target.parent)
    try:
        handle = files.open_regular(source)
    except FileNotFoundError:
        raise DatasetError(f"{source} is missing; `synpick-warp verify` names what is damaged") from None
    except OSError as error:
        raise DatasetError(f"{source} cannot be read: {error.strerror}; `synpick-warp verify` names what is damaged") from None
    with open(source, "rb", opener=lambda *_: handle) as file:
        state = os.fstat(handle)
        if not state.st_mode & _EXECUTE:
            with contextlib.suppress(OSError):  # Where links are not possible; `_copy` raises if the target exists.
                os.link(source, target, follow_symlinks=False)
                return state.st_size
        _copy(file, target)
        return state.st_size


def _copy(source: BinaryIO, target: Path) -> None:
    """Copy an open file to a new path, with its mode (not executable) and times."""
    with open(target, "xb") as file:
        try:
            for block in _read_blocks(source):
                file.write(block)
            file.flush()
            state = os.fstat(source.fileno())
            os.fchmod(file.fileno(), stat.S_IMODE(state.st_mode) & ~_EXECUTE)
            os.utime(file.fileno(), ns=(state.st_atime_ns, state.st_mtime_ns))
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(target)) from error


def _read_blocks(source: BinaryIO) -> Iterator[bytes]:
    """Yield a file's content in blocks; raises DatasetError if it cannot be read."""
    while True:
        try:
            block = source.read(_COPY_BYTES)
        except OSError as error:
            raise DatasetError(f"{source.name} cannot be read: {error.strerror}") from None
        if not block:
            return
        yield block
