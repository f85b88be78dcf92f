"""Reader of data sets in stores: copies of whole sets, episodes by an LRU cache, verification, streams of shards."""

import contextlib
import hashlib
import importlib
import io
import os
import re
import shutil
import sys
import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import msgspec

from synpick_warp.cloud.delivery import FILES_AT_ONCE
from synpick_warp.cloud.ledger import ENTRY
from synpick_warp.configs.dataset import episode_range
from synpick_warp.dataset.annotations import ADVICE, Index
from synpick_warp.dataset.commit import manifest as manifests
from synpick_warp.dataset.commit.verify import Verdict, check_part
from synpick_warp.dataset.reading import DataSet, Episode
from synpick_warp.errors import ConfigError, DatasetError, OutputError, StoreError
from synpick_warp.system.inputs.files import MAX_JSON, MAX_TOML, decode_json, make_folder, path_inside, read_file
from synpick_warp.system.inputs.urls import SCHEMES
from synpick_warp.system.progress import Report, ignore_progress
from synpick_warp.system.stores.store import CONTROL, SizeError, open_store

CACHE_BYTES = 8 << 30
"""Default limit of an opened set's cache of episodes [B]; the least recently used are evicted."""
STREAM_BYTES = 1 << 20
"""Size of the buffer of a stream [B]."""
FREE_PART = 0.5
"""Fraction of the temporary folder's free space that a copied set may take."""


class _Length(msgspec.Struct):
    """Schema of a line of the episode list, as far as it is read here."""

    episode: Index
    frames: Index


class Copier:
    """Downloader: copies objects of a data set into a folder, under the same names."""

    def __init__(self, url: str, folder: Path) -> None:
        self.store = open_store(url)
        self.folder = folder

    def fetch(self, name: str, digest: str | None = None, limit: int = MAX_JSON) -> bool:
        """Download an object atomically unless it is cached in the folder; returns whether the file exists afterwards. `digest`: expected
        SHA-256; None: unchecked. `limit`: maximum size [bytes]. Raises DatasetError: its checksum differs, or its name leads out of the
        folder; OutputError: the folder cannot be written; SizeError: it is larger."""
        path, state = path_inside(self.folder, name, self.store.url, DatasetError), hashlib.sha256()
        if path.exists():
            return True
        part = path.with_name(f".{path.name}.part")
        try:
            make_folder(path.parent)
            with part.open("wb") as file:
                for block in self.store.blocks(name, limit):
                    state.update(block)
                    file.write(block)
            if digest is not None and state.hexdigest() != digest:
                raise DatasetError(f"{self.store.url}/{name} has changed since it was written: its checksum differs")
            part.replace(path)
        except FileNotFoundError:
            return False
        except OSError as error:
            reason = error.strerror or error
            raise OutputError(f"cannot copy {self.store.url}/{name} to {path}: {reason}; set TMPDIR to a folder with more space") from None
        finally:
            with contextlib.suppress(OSError):
                part.unlink()
        return True

    def fetch_all(self, names: Mapping[str, tuple[str | None, int]], report: Report = ignore_progress) -> None:
        """Download objects in parallel, given SHA-256 (None: unchecked) and largest size [B] by name. Missing objects are skipped."""
        with ThreadPoolExecutor(FILES_AT_ONCE, "download") as pool:
            for done, _ in enumerate(pool.map(lambda item: self.fetch(item[0], *item[1]), names.items()), 1):
                report("files copied", done, len(names))

    def fetch_files(self, entry: Path, *, check: bool = True) -> dict[str, str]:
        """Download the files of a manifest entry that is in the folder, none larger than all of them together; returns their SHA-256 by
        name. `check`: whether to compare it."""
        names, limit = manifests.read_checksums(self.folder, entry), (manifests.read_entry(self.folder, entry) or {"bytes": 0})["bytes"]
        self.fetch_all({name: (digest if check else None, limit) for name, digest in names.items()})
        return names

    def fetch_records(self) -> None:
        """Download manifest and settings. Raises DatasetError: there is no manifest; StoreError: there is no bucket."""
        if not self.fetch(manifests.MANIFEST_FILE):
            with contextlib.suppress(FileNotFoundError):
                self.store.get(manifests.MANIFEST_FILE, MAX_JSON)  # Raises StoreError if there is no bucket, which HEAD does not tell.
            raise DatasetError(f"{self.store.url} has no {manifests.MANIFEST_FILE}; name the prefix of a data set that synpick-warp baked")
        self.fetch(manifests.CONFIG_FILE, limit=MAX_TOML)
        (self.folder / manifests.ENTRIES).mkdir(exist_ok=True)

    def fetch_entry(self, entry: Path) -> bool:
        """Download a manifest entry, both files; returns whether there is one."""
        return self.fetch(f"{entry}.json") and self.fetch(f"{entry}.sha256")

    def episodes(self) -> Iterator[int]:
        """Yield the episodes that have a done mark, in the order of their keys, lazily."""
        for key, _ in self.store.list(str(manifests.ENTRIES)):
            if match := ENTRY.fullmatch(key):
                yield int(match[1])


def copy_set(url: str, folder: Path, report: Report = ignore_progress) -> None:
    """Download a whole data set into a new folder, which is made. Raises DatasetError: it is no data set, or larger than FREE_PART of the
    free space there."""
    copier = Copier(url, folder)  # Refuses URLs whose last part would lead elsewhere.
    folder.mkdir()
    copier.fetch_records()
    names: dict[str, tuple[str | None, int]] = {}
    size = 0
    free = int(FREE_PART * shutil.disk_usage(folder).free)
    for name, length in copier.store.list(""):
        if name.startswith(f"{CONTROL}/"):
            continue
        names[name] = None, MAX_JSON if name.startswith(f"{manifests.ENTRIES}/") else length
        size += length
        if size > free:
            raise DatasetError(
                f"{url} has more than the {free / 1e9:.1f} GB that may be copied to {folder.parent}; set TMPDIR to a larger disk, or read "
                "it by synpick_warp.open, which keeps a few episodes at a time"
            )
    copier.fetch_all(names, report)


def verify_store(url: str, report: Report = ignore_progress) -> Verdict:
    """Verify the checksum of every file of a data set in a store, as `commit.verify.verify`: downloads one entry at a time. Raises
    DatasetError: the prefix has no data set, or its manifest is damaged; OutputError: the temporary folder cannot be written; StoreError:
    the store cannot be read."""
    with tempfile.TemporaryDirectory(prefix="synpick-verify-") as name:
        folder = Path(name)
        copier = Copier(url, folder)
        copier.fetch_records()
        manifest, files, episodes, listed, finished = manifests.read_manifest(folder), 0, [], [], False
        try:
            manifests.read_settings(folder, manifest)
            episodes = sorted(copier.episodes())
            for done, entry in enumerate((manifests.CONSTANTS, *map(manifests.episode_entry, episodes), manifests.INDICES)):
                checked, listed = _verify_entry(copier, entry)
                files += checked
                report("episodes", min(done, len(episodes)), len(episodes))
                if entry == manifests.INDICES:
                    finished = listed == episodes
        except (ConfigError, DatasetError, SizeError) as error:
            return Verdict(str(error).replace(name, url), len(episodes), files, finished)
    names = (f"{manifests.episode_entry(episode)}.json" for episode in sorted(set(listed) - set(episodes)))
    gone = next((name for name in names if copier.store.stat(name) is None), None)  # Others were committed meanwhile.
    return Verdict(f"{url}/{gone} is missing" if gone else "", len(episodes), files, finished)


def _verify_entry(copier: Copier, entry: Path) -> tuple[int, list[int]]:
    """Download and verify the files of an entry, and delete them; returns their number, and the episodes that the indices list. Raises
    DatasetError: A file is missing or damaged."""
    if not copier.fetch_entry(entry):
        if entry == manifests.INDICES:
            return 0, []
        raise DatasetError(f"{copier.store.url}/{entry}.json or .sha256 is missing; resume the bake")
    folder, names = copier.folder, copier.fetch_files(entry, check=False)
    checked = check_part(folder, entry)
    if checked.problem:
        raise DatasetError(checked.problem)
    listed = (manifests.read_entry(folder, entry) or {}).get("episodes", [])
    for name in (*names, f"{entry}.json", f"{entry}.sha256"):
        (folder / name).unlink(missing_ok=True)
    return checked.files, listed


class StoreCache:
    """LRU cache of a data set's episodes in a temporary folder, which also has its records, constants and indices. For one thread of the
    process that made it, which alone deletes the folder."""

    def __init__(self, url: str, limit: int = CACHE_BYTES) -> None:
        """Download all but the episodes. Arguments and errors as `open_store_set`."""
        self.process, place = os.getpid(), tempfile.mkdtemp(prefix="synpick-read-")
        weakref.finalize(self, _remove_own, place, self.process)
        self.folder = Path(place) / (url.rpartition("/")[2] or "set")
        self.copier, self.limit = Copier(url, self.folder), limit  # Refuses URLs whose last part would lead elsewhere.
        self.folder.mkdir()
        self._held: OrderedDict[int, int] = OrderedDict()
        """Cached episodes with their sizes [B], least recently used first."""
        self.copier.fetch_records()
        try:
            manifests.read_settings(self.folder, manifests.read_manifest(self.folder))
        except (ConfigError, DatasetError) as error:
            raise type(error)(str(error).replace(str(self.folder), url)) from None
        for entry in (manifests.CONSTANTS, manifests.INDICES):
            if self.copier.fetch_entry(entry):
                self.copier.fetch_files(entry)

    def has(self, episode: int) -> bool:
        """Whether an episode is committed: cached, or its done mark is in the store."""
        return episode in self._held or self.copier.store.stat(f"{manifests.episode_entry(episode)}.json") is not None

    def fetch(self, episode: int) -> None:
        """Download an episode, checked by its checksums, and evict the least recently used ones beyond the limit. Raises DatasetError: it
        is damaged, or a file is missing."""
        if episode in self._held:
            self._held.move_to_end(episode)
            return
        entry = manifests.episode_entry(episode)
        self.copier.fetch_entry(entry)
        names = self.copier.fetch_files(entry)
        missing = next((name for name in names if not (self.folder / name).exists()), None)
        if missing is not None:
            raise DatasetError(f"{self.copier.store.url}/{missing} is missing")
        self._held[episode] = sum((self.folder / name).stat().st_size for name in names)
        while len(self._held) > 1 and sum(self._held.values()) > self.limit:
            old, _ = self._held.popitem(last=False)
            for name in (
                *manifests.read_checksums(self.folder, manifests.episode_entry(old)),
                *(f"{manifests.episode_entry(old)}{end}" for end in (".json", ".sha256")),
            ):
                (self.folder / name).unlink(missing_ok=True)


def _remove_own(place: str, process: int) -> None:
    """Delete the folder of a cache, but in a fork of its process."""
    if os.getpid() == process:
        shutil.rmtree(place, ignore_errors=True)


class StoreDataSet(DataSet):
    """Data set in a store: indexing downloads an episode into the cache. An evicted `Episode` loses its files; index the data set again."""

    def __init__(self, cache: StoreCache, episodes: range | None = None) -> None:
        super().__init__(cache.folder, episodes)
        self._cache = cache

    def __reduce__(self) -> tuple[Callable[..., DataSet], tuple[Any, ...]]:
        """Pickle as an order to open the set again, such as for the spawned workers of a DataLoader."""
        return open_store_set, (self._cache.copier.store.url, self._cache.limit, self._only)

    @cached_property
    def splits(self) -> dict[str, DataSet]:
        named: dict[str, DataSet] = {split.name: StoreDataSet(self._cache, episode_range(split)) for split in self.config.splits}
        return named or {self.config.bop.split: self}

    def __getitem__(self, index: int) -> Episode:
        if (self._only is not None and index not in self._only) or not self._cache.has(index):
            raise KeyError(f"{self._cache.copier.store.url} has no episode {index}")
        self._cache.fetch(index)
        return super().__getitem__(index)

    def __iter__(self) -> Iterator[int]:
        """Iterate over the committed episodes in the order of their keys, without those known to be given up, which have no files."""
        found = (index for index in self._cache.copier.episodes() if self._only is None or index in self._only)
        return (index for index in found if self._frames.get(index, 1))

    def length(self, index: int) -> int:
        """See `DataSet`: by the list of episodes, without a download, if it has the episode."""
        return self._frames[index] if index in self._frames else super().length(index)

    @cached_property
    def _frames(self) -> dict[int, int]:
        """Number of frames of each episode, 0 if it was given up, by the list of episodes; empty while there is no such list."""
        path = self.folder / manifests.EPISODES_FILE
        if not path.exists():
            return {}
        lines = enumerate(read_file(path, MAX_JSON, DatasetError).splitlines(), 1)
        rows = (
            decode_json(line, _Length, f"{self._cache.copier.store.url}/{path.name}, line {row},", DatasetError, ADVICE)
            for row, line in lines
        )
        return {row.episode: row.frames for row in rows}


def open_store_set(url: str, limit: int = CACHE_BYTES, episodes: range | None = None) -> DataSet:
    """Open a data set in a store: downloads its records, constants and indices. `limit`: size of the cache of episodes [B]; the last one is
    kept whatever its size. `episodes`: indices of the episodes to show; None: all. Raises DatasetError: the prefix has no data set;
    StoreError: the store cannot be read."""
    return StoreDataSet(StoreCache(url, limit), episodes)


def list_shards(url: str) -> list[str]:
    """List the URLs of a set's webdataset shards, sorted, also those of episodes that are not committed. `stream_shards` lets
    `webdataset.WebDataset` read them without a copy."""
    store = open_store(url)
    return [f"{store.url}/{name}" for name, _ in store.list("") if re.fullmatch(r"[^/]+_web/shard-[0-9]+\.tar", name)]


class _Blocks(io.RawIOBase):
    """Raw stream of an object's blocks, read one after the other."""

    def __init__(self, blocks: Iterator[bytes]) -> None:
        self._blocks, self._held = blocks, memoryview(b"")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        self._held = self._held or memoryview(next(self._blocks, b""))
        count = min(len(buffer), len(self._held))
        buffer[:count], self._held = self._held[:count], self._held[count:]
        return count


def open_stream(url: str, mode: str = "rb", *_: object, **__: object) -> IO[bytes]:
    """Open an object as a binary stream, with the signature of webdataset's openers. Raises StoreError: the mode is not for reading."""
    if "r" not in mode:
        raise StoreError(f"{url} can be streamed for reading only; write to a local file")
    place, _slash, name = url.rpartition("/")
    return io.BufferedReader(_Blocks(open_store(place).blocks(name, sys.maxsize)), STREAM_BYTES)


def stream_shards() -> None:
    """Register `open_stream` with webdataset as the opener of URLs of stores, in place of the programs aws and gsutil."""
    openers = importlib.import_module("webdataset.gopen").gopen_schemes
    for scheme in SCHEMES:
        openers[scheme] = open_stream
