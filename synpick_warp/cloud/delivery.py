"""Background upload of finished episodes from a local folder into a store: files, index file, checksum list, done mark, in this order.

A thread polls the folder's manifest, so that the bake needs no hook, and episodes of several devices are uploaded alike. An index
file is a tar.gz per episode with the inputs of the indices over all episodes: what an episode adds to lists is made by its worker, and
the last worker only appends it to the parts of the lists, below LINES.
"""

import contextlib
import gzip
import hashlib
import io
import os
import re
import struct
import tarfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from synpick_warp.cloud.claims import LeaseLostError
from synpick_warp.cloud.ledger import INDEX, Ledger
from synpick_warp.configs.dataset import ExportSettings
from synpick_warp.dataset.commit.manifest import CONSTANTS, MANIFEST_FILE, committed_episodes, episode_entry, read_checksums, read_entry
from synpick_warp.dataset.commit.writing import list_lines
from synpick_warp.errors import DatasetError, OutputError, StoreError
from synpick_warp.exporters.base import Exporter, list_folders
from synpick_warp.exporters.formats import indexed_files
from synpick_warp.exporters.registry import load_exporter_classes, shared_files
from synpick_warp.exporters.writing.files import LINES
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.system import clock
from synpick_warp.system.inputs.files import MAX_JSON, make_folder, path_inside
from synpick_warp.system.progress import ForwardingProgress, Progress
from synpick_warp.system.stores.store import Store, TransientError, persist

MAX_BUNDLE = 1 << 30
"""Limit of an episode's index file, unpacked [B]: guards against decompression bombs."""
_LINES = re.compile(rf"{re.escape(LINES)}(?:/[^./][^/]*)+")
"""Names of lines in an index file: inside of LINES, which only `unpack_bundle` fills."""
_ADVICE = "delete it and its episode's done mark, manifest/NUMBER.json, and resume the bake without --claim"


def make_bundle(folder: Path, episode: int, settings: ExportSettings, kinds: Sequence[type[Exporter]]) -> bytes:
    """Pack the index file of an episode that is committed in a data set with exporters of these kinds; deterministic on one machine
    (another zlib may compress otherwise). Raises OutputError: the episode was removed."""
    entry = read_entry(folder, episode_entry(episode))
    if entry is None:
        raise OutputError(f"{folder / episode_entry(episode)}.json was removed while it was uploaded; resume the bake")
    packed, names = io.BytesIO(), list(read_checksums(folder, episode_entry(episode)))
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for name, lines in list_lines(entry).items():
            _add(archive, f"{LINES}/{name}/0", lines)
        for name, lines in (line for kind in kinds for line in kind.index_lines(folder, settings, names)):
            _add(archive, f"{LINES}/{name}", lines)
        for name in filter(indexed_files(settings.layout.formats).fullmatch, names):
            _add(archive, name, (folder / name).read_bytes())
    return gzip.compress(packed.getvalue(), 6, mtime=0)


def _add(archive: tarfile.TarFile, name: str, data: bytes) -> None:
    info = tarfile.TarInfo(name)
    info.size = len(data)
    archive.addfile(info, io.BytesIO(data))


def unpack_bundle(data: bytes, folder: Path, indexed: re.Pattern[str], source: str) -> None:
    """Unpack an episode's index file into a folder: files, and lines, which are appended to those of the episodes before. `data`: the index
    file. `indexed`: pattern of the names of files that indices are made of. `source`: its object, for messages. Raises DatasetError: it is
    damaged, too large, or has files that no index is made of; OutputError: the folder cannot be written."""
    try:
        stream = zlib.decompressobj(31)
        plain = stream.decompress(data, MAX_BUNDLE)
        if not stream.eof:
            raise DatasetError(f"{source} is damaged: it is cut off or too large; {_ADVICE}")
        with tarfile.open(fileobj=io.BytesIO(plain), mode="r:") as archive:
            for info in archive:
                is_lines, content = _LINES.fullmatch(info.name), archive.extractfile(info)
                if content is None or not (is_lines or indexed.fullmatch(info.name)):
                    raise DatasetError(f"{source} is damaged: it has {info.name[:80]!r}; {_ADVICE}")
                path = folder / info.name if is_lines else path_inside(folder, info.name, source, DatasetError)
                if not os.path.exists(path):
                    make_folder(path.parent)
                with open(path, "ab" if is_lines else "wb") as file:
                    file.write(content.read())
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}; set TMPDIR to a folder with more space") from None
    except (zlib.error, tarfile.TarError, struct.error, OverflowError, ValueError, RecursionError) as error:
        raise DatasetError(f"{source} is damaged: {error}; {_ADVICE}") from None


FILES_AT_ONCE, EPISODES_AT_ONCE = 16, 4
"""Concurrent uploads, of files and of episodes: requests of small files wait for the store, not for a core."""
WHOLE_BYTES = 8 << 20
"""Largest file that is hashed and sent from one read [B]; larger ones are read twice."""
MAX_BACKLOG = 16 << 30
"""Backpressure: amount of finished data that waits for its upload, beyond which the bake waits [B]."""
_INTERVAL = 0.1
"""Polling interval [s]."""


def send_file(store: Store, path: Path, name: str, digest: str) -> None:
    """Upload a file with end-to-end checks: its SHA-256 before, its size in the store after. Raises OutputError: the local file has another
    checksum; StoreError: it could not be uploaded."""
    size = path.stat().st_size
    data = path.read_bytes() if size <= WHOLE_BYTES else None
    if data is not None:
        found = hashlib.sha256(data).hexdigest()
    else:
        with path.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != digest:
        raise OutputError(f"{path} has changed since it was written: its checksum differs; check disk and memory of this machine")

    def send() -> None:
        store.put_file(name, path) if data is None else store.put(name, data)
        stat = store.stat(name)
        if stat is None or stat.size != size:
            raise TransientError(f"it arrived with {0 if stat is None else stat.size:,} of {size:,} bytes")

    persist(send, f"write {store.url}/{name}")


class Delivery:
    """Uploader of one folder: a context manager that owns its threads. The first error stops the uploads; `check` and `finish` raise it."""

    def __init__(
        self,
        ledger: Ledger,
        folder: Path,
        permit: Callable[[int], None] = lambda _: None,
        delivered: Callable[[int], None] = lambda _: None,
    ) -> None:
        """`ledger`: commit log of the data set. `folder`: local data set that a bake fills. `permit`: called with an episode before upload
        and mark; raises LeaseLostError to drop it. `delivered`: called with an episode after its mark. Several threads call both."""
        self._ledger, self._folder, self._permit, self._delivered = ledger, folder, permit, delivered
        self._settings, self._kinds = ExportSettings.of(ledger.config), load_exporter_classes(ledger.layout.formats)
        self._shared = shared_files(self._kinds, ledger.layout).folders
        self._fault: BaseException | None = None
        self._waiting: dict[int, int] = {}
        """Backlog: sizes of the episodes that are committed in the folder and not delivered [B]."""
        self._ending, self._lock = clock.Event(), clock.Lock()
        self._files = clock.Executor(FILES_AT_ONCE, "upload")
        self._episodes = clock.Executor(EPISODES_AT_ONCE, "deliver")
        self._watcher = clock.Thread(target=self._watch, name="delivery", daemon=True)

    def __enter__(self) -> Self:
        self._watcher.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is not None and self._fault is None:
            self._fault = error
        self._ending.set()
        self._watcher.join()
        for pool in (self._episodes, self._files):
            pool.shutdown(cancel_futures=True)

    def check(self) -> None:
        """Apply backpressure: waits while the backlog exceeds MAX_BACKLOG. Raises the first error."""
        while True:
            if self._fault is not None:
                raise self._fault
            if sum(list(self._waiting.values())) <= MAX_BACKLOG:
                return
            clock.sleep(_INTERVAL)

    def finish(self) -> None:
        """Drain the uploads: waits until all episodes that are committed in the folder are delivered. Raises the first error."""
        self._ending.set()
        self._watcher.join()
        self._episodes.shutdown()
        self.check()

    def _watch(self) -> None:
        """Watcher thread: polls the manifest, uploads the constants once, and queues episodes as the bake commits them."""
        constants, known = False, set()
        try:
            while self._fault is None:
                ending = self._ending.is_set()
                if not constants and (self._folder / f"{CONSTANTS}.json").exists():
                    self._send_constants()
                    constants = True
                if constants:
                    for episode in committed_episodes(self._folder):
                        if episode not in known:
                            known.add(episode)
                            self._hand_out(episode)
                if ending:
                    return
                self._ending.wait(_INTERVAL)
        except BaseException as error:
            self._fail(error)

    def _hand_out(self, episode: int) -> None:
        with contextlib.suppress(FileNotFoundError):
            content = read_entry(self._folder, episode_entry(episode))
            if content is not None:
                self._waiting[episode] = content["bytes"]
                self._episodes.submit(self._deliver, episode)

    def _send_constants(self) -> None:
        """Upload manifest, settings and constants, unless they are there. Raises ConfigError: the data set was started with others."""
        ledger, folder, store = self._ledger, self._folder, self._ledger.store
        ledger.put_manifest((folder / MANIFEST_FILE).read_bytes())
        ledger.put_settings()
        lines = (folder / f"{CONSTANTS}.sha256").read_bytes()
        try:
            if store.get(f"{CONSTANTS}.sha256", MAX_JSON) == lines and store.stat(f"{CONSTANTS}.json") is not None:
                return
        except FileNotFoundError:
            pass
        self._send_files(read_checksums(folder, CONSTANTS))
        store.put(f"{CONSTANTS}.sha256", lines)
        store.put(f"{CONSTANTS}.json", (folder / f"{CONSTANTS}.json").read_bytes())

    def _send_files(self, names: dict[str, str]) -> None:
        """Upload files in parallel, given their SHA-256 by name; raises the first error, after which no other is begun."""
        store, folder = self._ledger.store, self._folder
        list(self._files.map(lambda name: send_file(store, folder / name, name, names[name]), names))

    def _deliver(self, episode: int) -> None:
        """Task: upload and commit an episode, unless its lease is lost, and delete its local copy."""
        if self._fault is not None:
            return
        try:
            entry, folder, store = episode_entry(episode), self._folder, self._ledger.store
            names = read_checksums(folder, entry)
            with contextlib.suppress(LeaseLostError):
                self._permit(episode)
                self._send_files(names)
                store.put(f"{INDEX}/{episode:06d}.tar.gz", make_bundle(folder, episode, self._settings, self._kinds))
                self._permit(episode)
                self._ledger.commit(episode, (folder / f"{entry}.sha256").read_bytes(), (folder / f"{entry}.json").read_bytes())
                self._delivered(episode)
            self._remove(episode, names)
            self._waiting.pop(episode, None)
        except BaseException as error:
            self._fail(error)

    def _remove(self, episode: int, names: dict[str, str]) -> None:
        """Delete an episode's local files, and the folders that are empty then, but those that episodes share."""
        folder = self._folder
        for suffix in (".json", ".sha256"):
            (folder / f"{episode_entry(episode)}{suffix}").unlink(missing_ok=True)
        kept = {folder, *(folder / name for name in list_folders(folder, self._shared))}
        for name in names:
            (folder / name).unlink(missing_ok=True)
        parents = {parent for name in names for parent in (folder / name).parents if parent.is_relative_to(folder)} - kept
        for parent in sorted(parents, key=lambda path: len(path.parts), reverse=True):
            with contextlib.suppress(OSError):
                os.rmdir(parent)

    def _fail(self, error: BaseException) -> None:
        """Record an error, if it is the first; one of the operating system becomes a StoreError."""
        with self._lock:
            if self._fault is None:
                failed = StoreError(f"an upload failed: {error}; the same command resumes")
                self._fault = failed if isinstance(error, OSError) else error


class WatchedProgress(ForwardingProgress):
    """Decorator of a progress observer that raises the errors of an upload into the bake, which so ends early, and applies backpressure. It
    adds the counts of earlier bakes."""

    def __init__(self, progress: Progress, check: Callable[[], None], ended: BakeSummary) -> None:
        super().__init__(progress)
        self._check, self._ended = check, ended

    def stage(self, text: str) -> None:
        self._check()
        super().stage(text)

    def update(self, **counts: Any) -> None:
        self._check()
        before = {"episodes_done": len(self._ended.episodes), "episodes": self._ended.total, "views": self._ended.views}
        super().update(**counts | {name: count + counts[name] for name, count in before.items()})
