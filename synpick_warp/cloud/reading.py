"""Reading of data sets in stores: whole into a temporary folder of bounded size, or episode by episode with a cache."""

from __future__ import annotations

import hashlib
import importlib
import json
import re
import shutil
import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import IO, Any

from synpick_warp.cloud.delivery import FILES_AT_ONCE
from synpick_warp.configs.dataset.splits import episode_range
from synpick_warp.dataset.commit.manifest import (
    CONFIG_FILE,
    CONSTANTS,
    ENTRIES,
    INDICES,
    MANIFEST_FILE,
    episode_entry,
    read_checksums,
    read_entry,
    read_manifest,
    read_settings,
)
from synpick_warp.dataset.commit.verify import CheckPart, Verdict, check_part
from synpick_warp.dataset.reading import DataSet, Episode
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.system.inputs.paths import path_inside
from synpick_warp.system.progress import Report
from synpick_warp.system.stores.base import Store
from synpick_warp.system.stores.opening import CONTROL, open_store

CACHE_BYTES = 8 << 30
"""Size of the episodes that an opened set keeps in its temporary folder [B]; those used least recently go first."""
FREE_PART = 0.5
"""Most of the temporary folder's free space that a set may take."""
_ENTRY = re.compile(rf"{ENTRIES}/([0-9]{{6,12}})\.json")


class Copier:
    """Copies objects of a data set into a folder of the same names."""

    def __init__(self, url: str, folder: Path) -> None:
        self.store: Store = open_store(url)
        self.folder = folder

    def fetch(self, name: str, digest: str | None = None) -> bool:
        """Copy an object, unless it is there; returns whether the store has it.

        Raises:
            DatasetError: Its checksum is another one.
        """
        path, state = path_inside(self.folder, name, self.store.url, DatasetError), hashlib.sha256()
        if path.exists():
            return True
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.part")
        try:
            with part.open("wb") as file:
                for block in self.store.blocks(name):
                    state.update(block)
                    file.write(block)
            if digest is not None and state.hexdigest() != digest:
                raise DatasetError(f"{self.store.url}/{name} has changed since it was written: its checksum differs")
            part.replace(path)
        except FileNotFoundError:
            return False
        finally:
            part.unlink(missing_ok=True)
        return True

    def fetch_all(self, names: dict[str, str | None]) -> None:
        """Copy objects in parallel, with their checksums (None: not known). Missing ones are left out."""
        with ThreadPoolExecutor(FILES_AT_ONCE, "download") as pool:
            list(pool.map(lambda item: self.fetch(*item), names.items()))

    def fetch_records(self) -> None:
        """Copy manifest and settings.

        Raises:
            DatasetError: There is no manifest.
        """
        if not self.fetch(MANIFEST_FILE):
            raise DatasetError(f"{self.store.url} has no {MANIFEST_FILE}; name the prefix of a data set that synpick-warp baked")
        self.fetch(CONFIG_FILE)
        (self.folder / ENTRIES).mkdir(exist_ok=True)

    def fetch_entry(self, entry: Path) -> bool:
        """Copy a manifest entry; returns whether there is one."""
        return self.fetch(f"{entry}.json") and self.fetch(f"{entry}.sha256")

    def episodes(self) -> Iterator[int]:
        """Episodes that have a done mark, in the order of their names; read as far as they are asked for."""
        for key, _ in self.store.list(str(ENTRIES)):
            if match := _ENTRY.fullmatch(key):
                yield int(match[1])


def copy_set(url: str, folder: Path, wanted: Callable[[str], bool] = lambda name: True) -> None:
    """Copy a data set into an empty folder.

    Args:
        url: Its prefix.
        folder: The folder.
        wanted: Whether a file is copied, by its name.

    Raises:
        DatasetError: It is no data set, or larger than FREE_PART of the free space there.
    """
    copier = Copier(url, folder)
    copier.fetch_records()
    names, size = [], 0
    free = int(FREE_PART * shutil.disk_usage(folder).free)
    for name, length in copier.store.list(""):
        if name.startswith(f"{CONTROL}/") or not wanted(name):
            continue
        names.append(name)
        size += length
        if size > free:
            raise DatasetError(
                f"{url} has more than the {free / 1e9:.1f} GB that may be copied to {folder.parent}; set TMPDIR to a larger disk, or read "
                "it by synpick_warp.open, which keeps a few episodes at a time"
            )
    copier.fetch_all(dict.fromkeys(names))


def verify_store(url: str, report: Report = lambda unit, done, total: None) -> Verdict:
    """Verify the checksum of every file of a data set in a store; as `commit.verify.verify`, one entry at a time in a temporary folder.

    Raises:
        DatasetError: The prefix has no data set.
    """
    with tempfile.TemporaryDirectory(prefix="synpick-verify-") as name:
        folder = Path(name)
        copier = Copier(url, folder)
        copier.fetch_records()
        manifest, files, episodes, finished = read_manifest(folder), 0, [], False
        try:
            read_settings(folder, manifest)
            episodes = sorted(copier.episodes())
            for entry in (CONSTANTS, *map(episode_entry, episodes), INDICES):
                checked, listed = _verify_entry(copier, entry)
                files += checked
                report("files", files, files)
                if entry == INDICES:
                    finished = listed == episodes
        except (ConfigError, DatasetError) as error:
            return Verdict(str(error).replace(name, url), len(episodes), files, finished)
    return Verdict("", len(episodes), files, finished)


def _verify_entry(copier: Copier, entry: Path) -> tuple[int, list[int]]:
    """Verify the files of an entry, and delete them; returns their number, and of the indices the episodes.

    Raises:
        DatasetError: A file is missing or damaged.
    """
    if not copier.fetch_entry(entry):
        if entry == INDICES:
            return 0, []
        raise DatasetError(f"{copier.store.url}/{entry}.json or .sha256 is missing; resume the bake")
    names, folder = read_checksums(copier.folder, entry), copier.folder
    copier.fetch_all(dict.fromkeys(names))
    checked = check_part(folder, CheckPart(entry))
    if checked.problem:
        raise DatasetError(checked.problem)
    listed = (read_entry(folder, entry) or {}).get("episodes", [])
    for name in (*names, f"{entry}.json", f"{entry}.sha256"):
        (folder / name).unlink(missing_ok=True)
    return checked.files, listed


class StoreCache:
    """Temporary folder with the records of a data set in a store, and its episodes used last."""

    def __init__(self, url: str, limit: int = CACHE_BYTES) -> None:
        place = tempfile.mkdtemp(prefix="synpick-read-")
        weakref.finalize(self, shutil.rmtree, place, ignore_errors=True)
        self.folder = Path(place) / (url.rpartition("/")[2] or "set")
        self.folder.mkdir()
        self.copier, self._limit = Copier(url, self.folder), limit
        self._held: OrderedDict[int, int] = OrderedDict()
        """Episodes that are here, with their sizes [B], the one used last at the end."""
        self.copier.fetch_records()
        for entry in (CONSTANTS, INDICES):
            if self.copier.fetch_entry(entry):
                self.copier.fetch_all(dict(read_checksums(self.folder, entry)))

    def has(self, episode: int) -> bool:
        """Whether an episode has a done mark."""
        return episode in self._held or self.copier.store.stat(f"{episode_entry(episode)}.json") is not None

    def fetch(self, episode: int) -> None:
        """Copy the files of an episode here, checked by their checksums, and drop others beyond the limit."""
        if episode in self._held:
            self._held.move_to_end(episode)
            return
        entry = episode_entry(episode)
        self.copier.fetch_entry(entry)
        names = read_checksums(self.folder, entry)
        self.copier.fetch_all(dict(names))
        missing = next((name for name in names if not (self.folder / name).exists()), None)
        if missing is not None:
            raise DatasetError(f"{self.copier.store.url}/{missing} is missing")
        self._held[episode] = sum((self.folder / name).stat().st_size for name in names)
        while len(self._held) > 1 and sum(self._held.values()) > self._limit:
            old, _ = self._held.popitem(last=False)
            for name in (*read_checksums(self.folder, episode_entry(old)), *(f"{episode_entry(old)}{end}" for end in (".json", ".sha256"))):
                (self.folder / name).unlink(missing_ok=True)


class StoreDataSet(DataSet):
    """Data set in a store: an episode is copied into a temporary folder when it is asked for, and deleted when others need its place. Files
    of an episode that was dropped are gone: ask the data set for it again."""

    def __init__(self, cache: StoreCache, episodes: range | None = None) -> None:
        super().__init__(cache.folder, episodes)
        self._cache = cache

    @cached_property
    def splits(self) -> dict[str, DataSet]:
        """See `DataSet`."""
        named: dict[str, DataSet] = {split.name: StoreDataSet(self._cache, episode_range(split)) for split in self.config.splits}
        return named or {self.config.bop.split: self}

    def __getitem__(self, index: int) -> Episode:
        if (self._only is not None and index not in self._only) or not self._cache.has(index):
            raise KeyError(f"{self._cache.copier.store.url} has no episode {index}")
        self._cache.fetch(index)
        return super().__getitem__(index)

    def __iter__(self) -> Iterator[int]:
        """Committed episodes by the order of their marks; those that were given up have no files, and are left out where that is known."""
        found = (index for index in self._cache.copier.episodes() if self._only is None or index in self._only)
        return (index for index in found if index not in self._given_up)

    @cached_property
    def _given_up(self) -> frozenset[int]:
        """Episodes without frames, by the list of episodes."""
        path = self.folder / "episodes.jsonl"
        rows: list[dict[str, Any]] = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
        return frozenset(row["episode"] for row in rows if not row["frames"])


def open_store_set(url: str, limit: int = CACHE_BYTES) -> DataSet:
    """Open a data set in a store.

    Args:
        url: Its prefix.
        limit: Size of the episodes that are kept in a temporary folder [B].

    Raises:
        DatasetError: The prefix has no data set.
        StoreError: The store cannot be read.
    """
    return StoreDataSet(StoreCache(url, limit))


def list_shards(url: str) -> list[str]:
    """URLs of a set's webdataset shards, sorted; after `stream_shards`, `webdataset.WebDataset` reads them without a copy."""
    store = open_store(url)
    return [f"{store.url}/{name}" for name, _ in store.list("") if re.fullmatch(r"[^/]+_web/shard-[0-9]+\.tar", name)]


class _Stream:
    """Object as a file that is read once, from its beginning."""

    def __init__(self, blocks: Iterator[bytes]) -> None:
        self._blocks, self._held = blocks, bytearray()

    def read(self, size: int = -1) -> bytes:
        """Read up to `size` bytes, -1: all; fewer at the end only."""
        while size < 0 or len(self._held) < size:
            block = next(self._blocks, None)
            if block is None:
                break
            self._held += block
        count = len(self._held) if size < 0 else size
        data = bytes(self._held[:count])
        del self._held[:count]
        return data

    def close(self) -> None:
        """Drop what was not read."""
        self._blocks = iter(())

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_stream(url: str, *_: object, **__: object) -> IO[bytes]:
    """Open an object of a store as a stream, in the form of webdataset's openers."""
    place, _slash, name = url.rpartition("/")
    return _Stream(open_store(place).blocks(name))  # type: ignore[return-value]


def stream_shards() -> None:
    """Have webdataset open URLs of object stores by these stores, in place of the programs aws and gsutil."""
    openers = importlib.import_module("webdataset.gopen").gopen_schemes
    for scheme in ("s3", "gs", "az", "memory"):
        openers[scheme] = open_stream
