"""Output folder of a bake: lock, resume check, atomic commit of episodes, removal of partial files, indices over all episodes.

An episode is committed when its manifest entry is written, after its files have been renamed into place; anything without entry is partial,
and is removed when the bake is resumed.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

from synpick_warp.configs.load import load_config
from synpick_warp.configs.modes import may_pick
from synpick_warp.configs.schema import Config
from synpick_warp.configs.write import config_to_toml
from synpick_warp.dataset.manifest import (
    ATTEMPTS_FILE,
    CONFIG_FILE,
    CONSTANTS,
    ENTRIES,
    EPISODES_FILE,
    INDICES,
    INPUTS,
    MANIFEST_FILE,
    committed_episodes,
    describe_differences,
    encode_manifest,
    episode_entry,
    is_complete,
    make_manifest,
    read_checksums,
    read_entry,
    read_manifest,
)
from synpick_warp.errors import ConfigError, DatasetError, OutputError
from synpick_warp.exporters.base import Exporter
from synpick_warp.exporters.registry import Exporters, finalize
from synpick_warp.exporters.writing.checksums import write_manifest_entry
from synpick_warp.exporters.writing.files import PARTIAL, check_output_folder, output_error, sync_folder, write_atomically
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.frames import EpisodeEnd

LOCK_TIMEOUT = 20.0
"""Longest wait for the writer processes of a killed bake to exit [s]."""
_LOCK_INTERVAL = 0.1
"""Time between two attempts to lock [s]."""
_ADVICE = "resume with the same, or name another folder with --out"


class OutputFolder:
    """Folder of a data set during a bake; a context manager that holds the folder's advisory lock (flock).

    The lock belongs to the open file description, so writer processes that inherit the handle hold it, too: no bake starts while a
    writer of a killed bake is still running.
    """

    def __init__(self, out: Path, config: Config, episodes: Sequence[int]) -> None:
        """Create and lock the folder, and compare its manifest with the settings.

        Args:
            out: Folder of the data set: new, empty, or of a bake with the same settings.
            config: All settings.
            episodes: Indices of the episodes that the bake must deliver, sorted.

        Raises:
            ConfigError: The folder was started with other settings.
            OutputError: The folder cannot be used, or another bake uses it.
        """
        self.out, self.config, self.episodes = out, config, list(episodes)
        self._manifest = make_manifest(config)
        check_output_folder(out)
        self._created = [folder for folder in (out, *out.parents) if not os.path.lexists(folder)]
        try:
            out.mkdir(parents=True, exist_ok=True)
            self.lock = lock_folder(out)
        except OSError as error:
            raise output_error(out, error) from error
        try:
            self._scan()
        except OSError as error:
            os.close(self.lock)
            raise output_error(out, error) from error
        except BaseException:
            os.close(self.lock)
            raise

    def __enter__(self) -> OutputFolder:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.lock)

    def _scan(self) -> None:
        """Compare settings, and sort episodes into committed, remaining and partial ones."""
        out, episodes = self.out, self.config.bake.episodes
        self._known = read_manifest(out) if (out / MANIFEST_FILE).exists() else None
        if self._known:
            said = describe_differences(self._manifest, {name: self._known[name] for name in self._known if name != INPUTS})
            if said:
                raise ConfigError(f"{out} was started with other settings: {said}; {_ADVICE}")
        entries = committed_episodes(out)
        if entries and entries[-1] >= episodes:
            raise ConfigError(f"bake.episodes is {episodes}, but {out} has episode {entries[-1]}; a data set can only grow")
        complete = {index for index in entries if is_complete(self.out, episode_entry(index))}
        self.committed = sorted(complete.intersection(self.episodes))
        self.remaining = sorted(set(self.episodes) - complete)
        self._partial = sorted(set(range(max(episodes, _planned_episodes(out)))) - complete) if self._known else []

    def is_finished(self) -> bool:
        """Whether all episodes are committed and the indices cover them."""
        indices = read_entry(self.out, INDICES) or {}
        return not self.remaining and indices.get("episodes") == committed_episodes(self.out) and is_complete(self.out, INDICES)

    def prepare(self, exporters: Exporters, inputs: dict[str, str], pool: WriterPool) -> None:
        """Prepare the folder for the remaining episodes: manifest, settings, constants; remove partial episodes and stale indices.

        Args:
            exporters: All exporters of the bake.
            inputs: Content digests of objects and lights.
            pool: Writer processes.

        Raises:
            ConfigError: The data set was started with other objects or lights.
            OutputError: The folder cannot be written.
        """
        differing = [name for name in inputs if self._known and self._known.get(INPUTS, {}).get(name) != inputs[name]]
        if differing:
            raise ConfigError(f"{self.out} was started with other {' and '.join(differing)}; {_ADVICE}")
        try:
            shutil.rmtree(self.out / PARTIAL, ignore_errors=True)
            if not self._known:
                write_atomically(self.out / MANIFEST_FILE, encode_manifest({**self._manifest, INPUTS: inputs}))
            (self.out / ENTRIES).mkdir(exist_ok=True)
            self._remove_files(INDICES)
            for episode in self._partial:
                self._remove_entry(episode_entry(episode))
                for path in exporters.files(episode):
                    _remove(self.out / path)
            write_atomically(self.out / CONFIG_FILE, config_to_toml(self.config).encode())
            (self.out / PARTIAL).mkdir()
            if not is_complete(self.out, CONSTANTS):
                self._remove_entry(CONSTANTS)
                paths = self._write_constants(exporters)
                pool.submit(write_manifest_entry, (), (self.out, CONSTANTS, paths, {}), path=self.out / CONSTANTS)
                pool.wait()
        except OSError as error:
            raise output_error(self.out, error) from error

    def _write_constants(self, exporters: Exporters) -> list[Path]:
        """Have constants written; an error removes what was added."""
        before = set(os.listdir(self.out))
        try:
            return exporters.write_constants()
        except BaseException:
            with contextlib.suppress(OSError):
                for name in set(os.listdir(self.out)) - before:
                    _remove(self.out / name)
            raise

    def _remove_files(self, entry: Path) -> None:
        """Remove a manifest entry and its files."""
        with contextlib.suppress(DatasetError):
            for name in read_checksums(self.out, entry) if read_entry(self.out, entry) else ():
                _remove(self.out / name)
        self._remove_entry(entry)

    def _remove_entry(self, entry: Path) -> None:
        for suffix in (".json", ".sha256"):
            (self.out / f"{entry}{suffix}").unlink(missing_ok=True)

    def commit(self, exporters: Exporters, pool: WriterPool, end: EpisodeEnd) -> None:
        """Commit an episode whose files are all in place: a writer computes their checksums and writes the manifest entry."""
        content = {"episode": end.episode, "row": dict(end.row), "attempts": [json.loads(line) for line in end.attempts]}
        entry = episode_entry(end.episode)
        pool.submit(write_manifest_entry, (), (self.out, entry, exporters.files(end.episode), content), path=self.out / entry)

    def clean_up(self) -> None:
        """Remove partial files, after success or an error; a data set without committed episodes is removed entirely."""
        shutil.rmtree(self.out / PARTIAL, ignore_errors=True)
        with contextlib.suppress(OSError, DatasetError):
            if not committed_episodes(self.out):
                self._remove_files(CONSTANTS)
                shutil.rmtree(self.out / ENTRIES, ignore_errors=True)
                for name in (CONFIG_FILE, MANIFEST_FILE):
                    (self.out / name).unlink(missing_ok=True)
                _remove_empty_folders(self.out)
                for folder in self._created:
                    folder.rmdir()


def finalize_data_set(out: Path, config: Config, kinds: Sequence[type[Exporter]], pool: WriterPool) -> None:
    """Build the indices over all committed episodes, and commit them.

    Raises:
        OutputError: They cannot be written.
    """
    try:
        shutil.rmtree(out / PARTIAL, ignore_errors=True)
        (out / PARTIAL).mkdir()
        paths = build_lists(out, config) + finalize(kinds, out, config, pool)
        write_manifest_entry(out, INDICES, paths, {"episodes": committed_episodes(out)})
        shutil.rmtree(out / PARTIAL)
    except OSError as error:
        raise output_error(out, error) from error


def build_lists(out: Path, config: Config) -> list[Path]:
    """Write the lists of episodes and of attempts from the manifest entries, sorted by episode; returns both files."""
    paths = [Path(name) for name in (EPISODES_FILE, *((ATTEMPTS_FILE,) if may_pick(config) else ()))]
    for path in paths:
        with (out / PARTIAL / path).open("w", encoding="ascii") as file:
            for index in committed_episodes(out):
                entry = read_entry(out, episode_entry(index)) or {}
                rows = [{**entry["row"], "checksum": entry["checksum"]}] if path.name == EPISODES_FILE else entry["attempts"]
                file.writelines(json.dumps(row, allow_nan=False) + "\n" for row in rows)
            file.flush()
            os.fsync(file.fileno())
        (out / PARTIAL / path).replace(out / path)
    sync_folder(out)
    return paths


def _planned_episodes(out: Path) -> int:
    """`bake.episodes` of the last bake of the folder; 0 if its settings cannot be read."""
    with contextlib.suppress(ConfigError):
        return load_config(str(out / CONFIG_FILE), {}).bake.episodes
    return 0


def lock_folder(out: Path) -> int:
    """Lock a folder by an open handle, which is returned; file systems without locks are used unlocked."""
    handle = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    deadline = time.monotonic() + LOCK_TIMEOUT
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > deadline:
                os.close(handle)
                raise OutputError(f"another bake writes to {out}; wait for its end, or name another folder with --out") from None
            time.sleep(_LOCK_INTERVAL)
        except OSError as error:
            if error.errno not in (errno.ENOTSUP, errno.ENOLCK, errno.EBADF, errno.ENOSYS, errno.EINVAL):
                raise
            return handle
        else:
            return handle


def _remove(path: Path) -> None:
    """Remove a file, or a folder with its content."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _remove_empty_folders(out: Path) -> None:
    """Remove all empty folders below a folder, deepest first."""
    for folder, _, _ in os.walk(out, topdown=False):
        if Path(folder) != out:
            with contextlib.suppress(OSError):
                os.rmdir(folder)
