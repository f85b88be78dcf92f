"""Output folder of a bake: lock, resume check, atomic commit of episodes, removal of incomplete ones, indices over all episodes.

Files are written in a staging folder, `PARTIAL`. An episode is committed when its manifest entry is written, after its files have been
renamed into place; resuming deletes the files of planned episodes that are not complete. Paths to delete come from the formats, never from
files in the folder. The manifest marks the folder as ours: it is written first and removed last.
"""

import contextlib
import dataclasses
import errno
import fcntl
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.configs.dataset import DataLayout, ExportSettings, may_pick
from synpick_warp.configs.files.load import config_to_toml, load_config
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit import manifest
from synpick_warp.errors import ConfigError, DatasetError, OutputError
from synpick_warp.exporters.base import Exporter, SharedFiles, list_folders
from synpick_warp.exporters.registry import Exporters, finalize, load_exporter_classes, shared_files
from synpick_warp.exporters.writing.files import (
    LINES,
    PARTIAL,
    check_output_folder,
    is_folder,
    is_litter,
    join_manifest_entry,
    name_parts,
    output_error,
    output_errors,
    remove_folder,
    sync_file_system,
    sync_folder,
    write_atomically,
    write_checksums,
    write_manifest_entry,
)
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import BLACK, OPAQUE, PLAIN, Catalog, EnvironmentMap, Material
from synpick_warp.system import clock
from synpick_warp.system.inputs.files import MAX_TOML, check_regular_file, make_folder
from synpick_warp.views.frames import EpisodeEnd

LOCK_TIMEOUT = 20.0
"""Longest wait for the writer processes of a killed bake to exit [s]."""
_LOCK_INTERVAL = 0.1
"""Time between two attempts to lock [s]."""
_INDEXED = re.compile(r"(?:shard-)?([0-9]{6,12})(?:\.[a-z0-9]+)?")
"""Name of an episode's or a scene's file, folder or entry."""
_TEMPORARY = re.compile(r"\.(?:constants|joined|[0-9]{6,12})\.(?:json|sha256)\.new")
"""What `write_atomically` leaves of an entry if the bake is killed."""
_ADVICE = "resume with the same, or name another folder with --out"


class OutputFolder:
    """Folder of a data set during a bake: a context manager that locks the folder (flock) and, on exit, removes the staging folder.

    The lock belongs to the open file description, so writer processes that inherit the handle hold it, too: no bake starts while a
    writer of a killed bake is still running.
    """

    def __init__(self, out: Path, config: Config, episodes: Sequence[int]) -> None:
        """Create and lock a folder that is new, empty, or of a bake with the same settings, for a bake that must deliver these episodes,
        sorted. Raises ConfigError if it was started with other settings, and OutputError if it cannot be used, or another bake uses it."""
        self.out, self.config, self.episodes = out, config, list(episodes)
        self._manifest = manifest.make_manifest(config)
        self._layout = DataLayout.of(config)
        self._shared = shared_files(load_exporter_classes(config.bake.formats), self._layout)
        self._exporters: Exporters | None = None
        check_output_folder(out)
        self._created = [folder for folder in (out, *out.parents) if not os.path.lexists(folder)]
        with output_errors(out):
            make_folder(out)
            self.lock = lock_folder(out)
        try:
            self._scan()
        except OSError as error:
            os.close(self.lock)
            raise output_error(out, error) from error
        except BaseException:
            os.close(self.lock)
            raise

    def __enter__(self) -> "OutputFolder":
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._clean_up()
        finally:
            os.close(self.lock)

    def _scan(self) -> None:
        """Validate an existing data set against the settings, and determine its complete and remaining episodes."""
        out = self.out
        self._known = manifest.read_manifest(out) if os.path.lexists(out / manifest.MANIFEST_FILE) else None
        self._is_ours = self._known is not None
        if self._known:
            if said := manifest.describe_differences(self._manifest, self._known):
                raise ConfigError(f"{out} was started with other settings: {said}; {_ADVICE}")
            _check_kinds(out, self._shared)
        entries = manifest.committed_episodes(out)
        foreign = next((index for index in reversed(entries) if not self._layout.is_planned(index)), None)
        if foreign is not None:
            split = self._layout.split_of(foreign)
            key, episodes = (f"splits.{split.name}.episodes", split.episodes) if split else ("bake.episodes", self.config.bake.episodes)
            raise ConfigError(f"{key} is {episodes}, but {out} has episode {foreign}; a data set can only grow")
        self._complete = {index for index in entries if manifest.is_complete(self.out, manifest.episode_entry(index))}
        self.committed = sorted(self._complete.intersection(self.episodes))
        self.remaining = sorted(set(self.episodes) - self._complete)
        indices = manifest.read_entry(out, manifest.INDICES) or {}
        self.is_finished = not self.remaining and indices.get("episodes") == entries and manifest.is_complete(out, manifest.INDICES)
        """Whether all episodes are committed and the indices cover them."""

    def prepare(self, exporters: Exporters, inputs: dict[str, str], pool: WriterPool) -> None:
        """Prepare the folder for the remaining episodes: remove incomplete ones and all indices; write manifest, settings and constants,
        unless these are complete. `inputs` are content digests of objects, lights and textures. Raises ConfigError if the data set was
        started with other objects or lights, and OutputError if the folder cannot be written."""
        if self._known and (said := manifest.describe_inputs(inputs, self._known.get(manifest.INPUTS, {}))):
            raise ConfigError(f"{self.out} was started with other {said}; {_ADVICE}")
        self._exporters = exporters
        with output_errors(self.out):
            if self._known:
                remove_folder(self.out / PARTIAL, ignore_errors=True)
            else:
                write_atomically(self.out / manifest.MANIFEST_FILE, manifest.encode_manifest({**self._manifest, manifest.INPUTS: inputs}))
            self._is_ours = True
            (self.out / manifest.ENTRIES).mkdir(exist_ok=True)
            self._remove_indices()
            if self._known:
                self._remove_temporary()
                self._remove_incomplete(max(self._layout.episodes_end, _planned_end(self.out)))
            write_atomically(self.out / manifest.CONFIG_FILE, config_to_toml(self.config).encode())
            (self.out / PARTIAL).mkdir()
            if not manifest.is_complete(self.out, manifest.CONSTANTS):
                self._remove_constants()
                try:
                    paths = exporters.write_constants()
                except BaseException:
                    with contextlib.suppress(OSError):
                        self._remove_constants()
                    raise
                pool.submit(write_manifest_entry, (), (self.out, manifest.CONSTANTS, paths, {}), path=self.out / manifest.CONSTANTS)
                pool.wait()

    def _remove_indices(self) -> None:
        """Remove the files that list all episodes, and their entry in the manifest."""
        self._remove_entry(manifest.INDICES)  # First: killed in between, no mark names files that are gone.
        for name in (manifest.EPISODES_FILE, manifest.ATTEMPTS_FILE, *self._shared.indices):
            (self.out / name).unlink(missing_ok=True)

    def _remove_constants(self) -> None:
        """Delete the constants, and folders of formats if they are empty then."""
        self._remove_entry(manifest.CONSTANTS)
        for name in self._shared.constants:
            remove_path(self.out / name)
        for name in list_folders(self.out, self._shared.folders):
            with contextlib.suppress(OSError):
                (self.out / name).rmdir()

    def _remove_incomplete(self, end: int) -> None:
        """Delete the manifest entries and files of incomplete episodes with indices below `end`."""
        assert self._exporters is not None
        for episode in sorted(index for index in self._named_episodes() - self._complete if index < end):
            self._remove_entry(manifest.episode_entry(episode))
            for path in self._exporters.files(episode):
                remove_path(self.out / path)

    def _remove_temporary(self) -> None:
        """Delete files of entries whose commits were killed."""
        for name in filter(_TEMPORARY.fullmatch, os.listdir(self.out / manifest.ENTRIES)):
            (self.out / manifest.ENTRIES / name).unlink()

    def _named_episodes(self) -> set[int]:
        """Superset of the episodes with files: each number in a file name is taken as an episode index and as a BOP scene id."""
        cameras = len(self.config.rig)
        found: set[int] = set()
        for folder in (manifest.ENTRIES, *list_folders(self.out, self._shared.folders)):
            names = os.listdir(self.out / folder) if (self.out / folder).is_dir() else []
            for index in (int(match[1]) for match in map(_INDEXED.fullmatch, names) if match):
                found |= {index, index // cameras}
        return found

    def _remove_entry(self, entry: Path) -> None:
        """Remove an entry of the manifest and its digests, if there."""
        for suffix in (".json", ".sha256"):
            (self.out / f"{entry}{suffix}").unlink(missing_ok=True)

    def _clean_up(self) -> None:
        """Remove the staging folder, after success or an error; a data set without committed episodes is removed entirely.

        A finished data set still has a staging folder if its bake was killed before deleting it. Uncommitted files outside of it are
        deleted by the next `prepare`. Only names defined by the formats are deleted, and only in a folder with our manifest: other files,
        such as hidden files of the user, and folders that existed before the bake stay.
        """
        with contextlib.suppress(OSError, DatasetError):
            if self._is_ours:
                remove_folder(self.out / PARTIAL, ignore_errors=True)
                if not manifest.committed_episodes(self.out):
                    self._remove_data_set()
        with contextlib.suppress(OSError):
            for folder in self._created:
                folder.rmdir()

    def _remove_data_set(self) -> None:
        """Delete a data set without episodes. The manifest goes last, and is kept if other files remain, so that a bake can resume."""
        self._complete = set()
        if self._exporters is not None:
            self._remove_incomplete(self._layout.episodes_end)
        self._remove_indices()
        self._remove_constants()
        if any(os.path.lexists(self.out / folder) for folder in list_folders(self.out, self._shared.folders)):
            return
        if (self.out / manifest.ENTRIES).is_dir():
            self._remove_temporary()
            (self.out / manifest.ENTRIES).rmdir()
        for name in (manifest.CONFIG_FILE, manifest.MANIFEST_FILE):
            (self.out / name).unlink(missing_ok=True)


def commit_episode(out: Path, exporters: Exporters, pool: WriterPool, end: EpisodeEnd) -> None:
    """Queue the commit of an episode whose files are all in place: writers hash them in parallel, then one writes the manifest entry.

    There is one task for each file or folder that `Exporters.files` names, and one for the entry.
    """
    content = {"episode": end.episode, "row": dict(end.row), "attempts": [json.loads(line) for line in end.attempts]}
    entry, paths = manifest.episode_entry(end.episode), exporters.files(end.episode)
    parts = name_parts(out, entry, len(paths))
    missing = set(parts)

    def submit_entry() -> None:
        pool.submit(join_manifest_entry, (), (out, entry, parts, content), path=out / entry)

    def on_hashed(part: Path) -> None:
        missing.remove(part)
        if not missing:
            submit_entry()

    for path, part in zip(paths, parts, strict=True):
        pool.submit(write_checksums, (), (out, path, part), path=out / entry, on_done=partial(on_hashed, part))
    if not parts:  # An episode that was given up has no files.
        submit_entry()


def finalize_data_set(
    out: Path, settings: ExportSettings, kinds: Sequence[type[Exporter]], pool: WriterPool, episodes: Sequence[int] | None = None
) -> None:
    """Write and commit the indices: lists of episodes, attempts and targets over all committed episodes, sorted, whose index lines are in
    LINES; None: those of the manifest, from their files. Raises OutputError if a file cannot be written, or LINES are not of this call."""
    if episodes is None and os.path.lexists(out / LINES):
        raise OutputError(f"{out / LINES} is where the lines of indices are joined; move it away")
    try:
        remove_folder(out / PARTIAL, ignore_errors=True)
        (out / PARTIAL).mkdir()
        known = manifest.committed_episodes(out) if episodes is None else list(episodes)
        paths = build_lists(out, may_pick(settings.bake, settings.layout.splits)) + finalize(kinds, out, settings, pool, known)
        sync_file_system(out)  # Images are not flushed one by one: until here, a resumed bake finds what a power cut has cut short.
        write_manifest_entry(out, manifest.INDICES, paths, {"episodes": known})
    except OSError as error:
        raise output_error(out, error) from error
    finally:
        remove_folder(out / PARTIAL, ignore_errors=True)


def build_lists(out: Path, picks: bool) -> list[Path]:
    """Write the list of episodes, and if episodes can pick (`may_pick`) the list of attempts, from the manifest entries, sorted by episode,
    or of lines made in advance, if there are LINES. Returns paths of the lists, relative to the data set."""
    paths = [Path(name) for name in (manifest.EPISODES_FILE, *((manifest.ATTEMPTS_FILE,) if picks else ()))]
    for path in paths:
        known = out / LINES / path / "0"
        with (out / PARTIAL / path).open("wb") as file:
            if known.is_file():
                with known.open("rb") as lines:
                    shutil.copyfileobj(lines, file)
            for index in () if (out / LINES).is_dir() else manifest.committed_episodes(out):
                entry = manifest.read_entry(out, manifest.episode_entry(index))
                if entry is None:
                    raise OutputError(
                        f"{out / manifest.episode_entry(index)}.json was removed while the lists were written; resume the bake"
                    )
                file.write(list_lines(entry)[path.name])
            file.flush()
            os.fsync(file.fileno())
        (out / PARTIAL / path).replace(out / path)
    sync_folder(out)
    return paths


def list_lines(entry: Mapping[str, Any]) -> dict[str, bytes]:
    """Lines that a manifest entry adds to the lists of episodes and attempts, by their names."""
    rows = {manifest.EPISODES_FILE: [{**entry["row"], "checksum": entry["checksum"]}], manifest.ATTEMPTS_FILE: entry["attempts"]}
    return {name: "".join(json.dumps(row, allow_nan=False) + "\n" for row in found).encode() for name, found in rows.items()}


def _planned_end(out: Path) -> int:
    """Exclusive upper bound of the episode indices planned by the folder's own settings; 0 if they cannot be read."""
    with contextlib.suppress(ConfigError, DatasetError):
        check_regular_file(out / manifest.CONFIG_FILE, MAX_TOML, DatasetError)
        return DataLayout.of(load_config(str(out / manifest.CONFIG_FILE), {})).episodes_end
    return 0


def _check_kinds(out: Path, shared: SharedFiles) -> None:
    """Reject what is no file or folder of a bake at the paths that it writes or deletes: symbolic links, which may point outside of the
    data set, pipes and devices, files in place of folders, folders in place of files. Raises OutputError if a path is of another kind."""
    folders = [out / name for name in (manifest.ENTRIES, PARTIAL, *list_folders(out, shared.folders))]
    files = [out / name for name in (manifest.CONFIG_FILE, manifest.EPISODES_FILE, manifest.ATTEMPTS_FILE, *shared.indices)]
    children = [Path(child.path) for folder in folders if is_folder(folder) for child in os.scandir(folder) if not is_litter(child.name)]
    for path in (*folders, *files, *(out / name for name in shared.constants), *children):
        if path.is_symlink():
            raise OutputError(f"{path} is a symbolic link, through which a bake does not write; replace it by what it names")
        if os.path.lexists(path) and not (path.is_dir() or path.is_file()):
            raise OutputError(f"{path} is neither a file nor a folder, but a pipe, socket or device; remove it")
    for path in folders:
        if path.is_file():
            raise OutputError(f"{path} is a file where a bake has a folder; move it away")
    for path in files:
        if path.is_dir():
            raise OutputError(f"{path} is a folder where a bake has a file; move it away")


def lock_folder(out: Path) -> int:
    """Lock a folder (flock); returns its open handle, which holds the lock. File systems without locks are used unlocked. Raises
    OutputError if the folder stayed locked for LOCK_TIMEOUT."""
    handle = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    deadline = clock.monotonic() + LOCK_TIMEOUT
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if clock.monotonic() > deadline:
                os.close(handle)
                raise OutputError(f"another bake writes to {out}; wait for its end, or name another folder with --out") from None
            clock.sleep(_LOCK_INTERVAL)
        except OSError as error:
            if error.errno not in (errno.ENOTSUP, errno.ENOLCK, errno.EBADF, errno.ENOSYS, errno.EINVAL):
                os.close(handle)
                raise
            return handle
        else:
            return handle


def remove_path(path: Path) -> None:
    """Remove a file, or a folder with its content."""
    remove_folder(path) if is_folder(path) else path.unlink(missing_ok=True)


def digest_inputs(catalog: Catalog, lights: tuple[EnvironmentMap, ...], looks: Looks | None = None) -> dict[str, str]:
    """Content digests of a bake's inputs, by which a resumed bake recognizes other objects or lights: the manifest's INPUTS.

    SHA-256 over objects, lights, distractors, props, textures, maps, glass, emission and finish, without file names, and over each object:
    mesh, material, collision shape, mass properties and symmetries. Names and order of the dataclasses' fields are hashed, too: renaming a
    field of `Catalog` or `EnvironmentMap` changes every manifest.
    """
    textures = {"textures": _digest_data(tuple(looks.textures.values()))} if looks and looks.all_textures else {}
    distractors = {"distractors": _digest_data(catalog.distractors)} if catalog.distractors else {}
    props = tuple(
        (prop, (look := prop.fixture.material).maps, *_added(look)["emission"], *_added(look)["finish"]) for prop in catalog.props
    )
    distractors |= {"props": _digest_data(props)} if props else {}
    added = [_added(body.material) for body in catalog.bodies]
    for name in ("maps", "glass", "emission", "finish"):
        values = tuple(more[name] for more in added if more[name])
        textures |= {name: _digest_data(values)} if values else {}
    given = [(body, *sum(more.values(), ())) if any(more.values()) else body for body, more in zip(catalog.bodies, added, strict=True)]
    each = {f"{manifest.OBJECT}{body.obj_id}: {body.name}": _digest_data(data) for body, data in zip(catalog.bodies, given, strict=True)}
    return {"objects": _digest_data(catalog), "lights": _digest_data(lights)} | distractors | textures | each


def _added(material: Material) -> dict[str, tuple[Any, ...]]:
    """Values of a material that are not hashed with it, by the name of their digest; empty where it has none."""
    return {
        "maps": () if material.maps is None else (material.maps,),
        "glass": () if material.glass == OPAQUE else (material.glass, material.opacity),
        "emission": () if material.emission == BLACK else (material.emission, material.glow),
        "finish": () if material.finish == PLAIN else (material.finish,),
    }


def _digest_data(value: object) -> str:
    """SHA-256 of nested data, by type and content."""
    state = hashlib.sha256()
    for part in _parts(value):
        state.update(part)
    return state.hexdigest()


def _parts(value: object) -> Iterator[bytes]:
    """Serialize dataclasses, tuples, arrays and plain values; paths, and fields that are not hashed, are left out."""
    if isinstance(value, np.ndarray):
        yield f"{value.dtype.str}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, tuple):
        yield f"({len(value)}".encode()
        for part in value:
            yield from _parts(part)
    elif dataclasses.is_dataclass(value):
        for item in (item for item in dataclasses.fields(value) if item.hash is not False):
            yield item.name.encode()
            yield from _parts(getattr(value, item.name))
    elif not isinstance(value, Path):
        yield repr(value).encode()
