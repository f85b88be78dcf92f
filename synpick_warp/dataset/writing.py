"""The folder of a data set while a bake writes to it: locked, compared with the settings, cleaned of what is not whole, completed."""

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
    EPISODES_FILE,
    INPUTS,
    JOINED,
    MANIFEST_FILE,
    RECORDS,
    describe_differences,
    encode_manifest,
    episode_place,
    make_manifest,
    read_checksums,
    read_manifest,
    read_record,
    recorded_episodes,
    seems_whole,
)
from synpick_warp.errors import ConfigError, DatasetError, OutputError
from synpick_warp.exporters.base import Exporter
from synpick_warp.exporters.registry import Exporters, finalize
from synpick_warp.exporters.writing.checksums import write_manifest_entry
from synpick_warp.exporters.writing.files import PARTIAL, check_output_folder, output_error, sync_folder, write_atomically
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.frames import EpisodeEnd

LOCK_TIMEOUT = 20.0
"""How long writers of a killed bake may take to end [s]."""
_LOCK_INTERVAL = 0.1
"""Between two looks whether they have [s]."""
_ADVICE = "go on with the same, or name another folder with --out"


class Output:
    """The folder of a data set. Use it as a context manager: it holds the folder's lock.

    The lock belongs to the open handle, so writer processes that inherit it hold it too: as long as one of a killed bake
    still writes, nobody else begins.
    """

    def __init__(self, out: Path, config: Config, episodes: Sequence[int]) -> None:
        """Make or lock the folder, and compare what it says with the settings.

        Args:
            out: Folder of the data set: new, empty, or of a bake with the same settings.
            config: All settings.
            episodes: Numbers of the episodes that are to be there in the end, in order.

        Raises:
            ConfigError: The folder was begun with other settings.
            OutputError: The folder cannot be used, or another bake uses it.
        """
        self.out, self.config, self.episodes = out, config, list(episodes)
        self._manifest = make_manifest(config)
        check_output_folder(out)
        self._made = [folder for folder in (out, *out.parents) if not os.path.lexists(folder)]
        try:
            out.mkdir(parents=True, exist_ok=True)
            self.lock = lock_folder(out)
        except OSError as error:
            raise output_error(out, error) from error
        try:
            self._look()
        except OSError as error:
            os.close(self.lock)
            raise output_error(out, error) from error
        except BaseException:
            os.close(self.lock)
            raise

    def __enter__(self) -> Output:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.lock)

    def _look(self) -> None:
        """Compare settings, and find out which episodes are whole."""
        out, episodes = self.out, self.config.bake.episodes
        self._known = read_manifest(out) if (out / MANIFEST_FILE).exists() else None
        if self._known:
            said = describe_differences(self._manifest, {name: self._known[name] for name in self._known if name != INPUTS})
            if said:
                raise ConfigError(f"{out} was begun with other settings: {said}; {_ADVICE}")
        recorded = recorded_episodes(out)
        if recorded and recorded[-1] >= episodes:
            raise ConfigError(f"bake.episodes is {episodes}, but {out} has episode {recorded[-1]}; a data set can only grow")
        whole = {number for number in recorded if seems_whole(self.out, episode_place(number))}
        self.before = sorted(whole.intersection(self.episodes))
        self.left = sorted(set(self.episodes) - whole)
        self._strays = sorted(set(range(max(episodes, _episodes_of(out)))) - whole) if self._known else []

    def is_finished(self) -> bool:
        """Whether nothing is left to do."""
        lists = read_record(self.out, JOINED) or {}
        return not self.left and lists.get("episodes") == recorded_episodes(self.out) and seems_whole(self.out, JOINED)

    def begin(self, exporters: Exporters, inputs: dict[str, str], pool: WriterPool) -> None:
        """Make the folder ready for the episodes that are left.

        Args:
            exporters: What will be written.
            inputs: Checksums of objects and lights.
            pool: Writers.

        Raises:
            ConfigError: The data set was made of other objects or lights.
            OutputError: The folder cannot be written.
        """
        differing = [name for name in inputs if self._known and self._known.get(INPUTS, {}).get(name) != inputs[name]]
        if differing:
            raise ConfigError(f"{self.out} was begun with other {' and '.join(differing)}; {_ADVICE}")
        try:
            shutil.rmtree(self.out / PARTIAL, ignore_errors=True)
            if not self._known:
                write_atomically(self.out / MANIFEST_FILE, encode_manifest({**self._manifest, INPUTS: inputs}))
            (self.out / RECORDS).mkdir(exist_ok=True)
            # Lists that will not be true any longer, and episodes that are not whole.
            self._remove_files(JOINED)
            for episode in self._strays:
                self._remove_record(episode_place(episode))
                for path in exporters.files(episode):
                    _remove(self.out / path)
            write_atomically(self.out / CONFIG_FILE, config_to_toml(self.config).encode())
            (self.out / PARTIAL).mkdir()
            if not seems_whole(self.out, CONSTANTS):
                self._remove_record(CONSTANTS)
                paths = self._write_constants(exporters)
                pool.submit(write_manifest_entry, (), (self.out, CONSTANTS, paths, {}), path=self.out / CONSTANTS)
                pool.wait()
        except OSError as error:
            raise output_error(self.out, error) from error

    def _write_constants(self, exporters: Exporters) -> list[Path]:
        before = set(os.listdir(self.out))
        try:
            return exporters.write_constants()
        except BaseException:
            with contextlib.suppress(OSError):
                for name in set(os.listdir(self.out)) - before:
                    _remove(self.out / name)
            raise

    def _remove_files(self, place: Path) -> None:
        """Remove a record and its files."""
        with contextlib.suppress(DatasetError):
            for name in read_checksums(self.out, place) if read_record(self.out, place) else ():
                _remove(self.out / name)
        self._remove_record(place)

    def _remove_record(self, place: Path) -> None:
        for suffix in (".json", ".sha256"):
            (self.out / f"{place}{suffix}").unlink(missing_ok=True)

    def record(self, exporters: Exporters, pool: WriterPool, end: EpisodeEnd) -> None:
        """All files of an episode are in their place: have their checksums noted, by which it is whole."""
        content = {"episode": end.episode, "row": dict(end.row), "attempts": [json.loads(line) for line in end.attempts]}
        place = episode_place(end.episode)
        pool.submit(write_manifest_entry, (), (self.out, place, exporters.files(end.episode), content), path=self.out / place)

    def close(self) -> None:
        """Remove what is not whole, after success or after an error. Of a data set without a whole episode nothing stays."""
        shutil.rmtree(self.out / PARTIAL, ignore_errors=True)
        with contextlib.suppress(OSError, DatasetError):
            if not recorded_episodes(self.out):
                self._remove_files(CONSTANTS)
                shutil.rmtree(self.out / RECORDS, ignore_errors=True)
                for name in (CONFIG_FILE, MANIFEST_FILE):
                    (self.out / name).unlink(missing_ok=True)
                _remove_empty_folders(self.out)
                for folder in self._made:
                    folder.rmdir()


def complete(out: Path, config: Config, kinds: Sequence[type[Exporter]], pool: WriterPool) -> None:
    """Write the lists that span episodes, from the records and from what is there.

    Raises:
        OutputError: They cannot be written.
    """
    try:
        shutil.rmtree(out / PARTIAL, ignore_errors=True)
        (out / PARTIAL).mkdir()
        paths = join_lists(out, config) + finalize(kinds, out, config, pool)
        write_manifest_entry(out, JOINED, paths, {"episodes": recorded_episodes(out)})
        shutil.rmtree(out / PARTIAL)
    except OSError as error:
        raise output_error(out, error) from error


def join_lists(out: Path, config: Config) -> list[Path]:
    """Write the lists of episodes and of attempts from the records, in the order of their numbers; returns both files."""
    paths = [Path(name) for name in (EPISODES_FILE, *((ATTEMPTS_FILE,) if may_pick(config) else ()))]
    for path in paths:
        with (out / PARTIAL / path).open("w", encoding="ascii") as file:
            for number in recorded_episodes(out):
                record = read_record(out, episode_place(number)) or {}
                rows = [{**record["row"], "checksum": record["checksum"]}] if path.name == EPISODES_FILE else record["attempts"]
                file.writelines(json.dumps(row, allow_nan=False) + "\n" for row in rows)
            file.flush()
            os.fsync(file.fileno())
        (out / PARTIAL / path).replace(out / path)
    sync_folder(out)
    return paths


def _episodes_of(out: Path) -> int:
    """How many episodes the last bake of the folder was to make, as far as can be told."""
    with contextlib.suppress(ConfigError):
        return load_config(str(out / CONFIG_FILE), {}).bake.episodes
    return 0


def lock_folder(out: Path) -> int:
    """An open handle of the folder, which holds its lock; file systems that know no locks go without."""
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
    """Remove a file, or a folder with all that is in it."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _remove_empty_folders(out: Path) -> None:
    for folder, _, _ in os.walk(out, topdown=False):
        if Path(folder) != out:
            with contextlib.suppress(OSError):
                os.rmdir(folder)
