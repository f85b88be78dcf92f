"""Default folders and files of the commands: which data set is read, where outputs go.

A data set is a folder with manifest.json and manifest/. Commands take the current folder if it is one, else the last data set in it:
finished ones before unfinished ones, then by the time at which an episode was last committed, which neither reading nor checking changes.
"""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

from synpick_warp.cli.options import one_line
from synpick_warp.errors import DatasetError, OutputError, escape
from synpick_warp.system.inputs.urls import store_url

if TYPE_CHECKING:
    from synpick_warp.dataset.reading import DataSet

DEFAULT_NAME = "synpick-data"
"""Folder of a bake without --out."""
_MAX_NAMED = 3
"""Most folders that a message names."""
OWN_SUFFIXES = (".png", ".jpg", ".jpeg", ".html", ".htm", ".csv")
"""Suffixes of pictures, pages and tables, which no format has in the data set's own folder: there, outputs may have them."""


class _Found(NamedTuple):
    """A data set in the current folder; the last one is the largest."""

    finished: bool
    committed: int
    """Time at which an entry of the manifest was last written [ns]."""
    folder: Path


def is_data_set(folder: Path | str) -> bool:
    """Whether a folder has the manifest of a data set, and a folder of entries; nothing is read."""
    return _has(f"{folder}/manifest.json", stat.S_ISREG) and _has(f"{folder}/manifest", stat.S_ISDIR)


def _has(path: str, kind: Callable[[int], bool]) -> bool:
    """Whether there is an entry at the path, links not followed, whose mode is of this kind."""
    try:
        return kind(os.lstat(path).st_mode)
    except (OSError, ValueError):
        return False


# ---- which data set is read ----


def has_scenes(folder: Path) -> bool:
    """Whether a data set has BOP scenes."""
    return next(folder.glob("[!.]*/*/scene_camera*.json"), None) is not None


def has_attempts(folder: Path) -> bool:
    """Whether a data set has BOP scenes and pick attempts."""
    try:
        return (folder / "attempts.jsonl").stat().st_size > 0 and has_scenes(folder)
    except OSError:
        return False


def has_images(folder: Path) -> bool:
    """Whether a data set has BOP scenes or shards."""
    return has_scenes(folder) or next(folder.glob("[!.]*_web/*.tar"), None) is not None


_NEEDS: dict[Callable[[Path], bool], str] = {
    has_scenes: "BOP scenes (--formats bop)",
    has_attempts: "BOP scenes (--formats bop) with pick attempts (--mode pick, target, mixed or cycle)",
    has_images: "images (--formats bop or shards)",
}


def find_data_set(named: Path | None, usage: str, suits: Callable[[Path], bool] | None = None) -> Path:
    """Return the data set that is named, or else the last one of the current folder, which is announced on the standard error.

    Args:
        named: Folder that the user has named, which is not checked; None: none.
        usage: How the command is called with a folder, for messages.
        suits: Whether the command can use a data set; None: any.

    Raises:
        DatasetError: There is none.
    """
    if named is not None:
        url = store_url(named)
        return named if url is None else _fetch(url)
    try:
        found = [_Found(True, 0, Path.cwd())] if is_data_set(".") else sorted(_list_data_sets(), reverse=True)
    except OSError as error:
        raise DatasetError(f"the current folder cannot be read: {error.strerror}; name a data set: {usage}") from None
    if not found:
        raise DatasetError(f"there is no data set in the current folder; name one ({usage}), or make one first (synpick-warp bake)")
    last = next((each for each in found if suits is None or suits(each.folder)), None)
    if last is None:
        needed = _NEEDS[suits] if suits else ""
        here = ", ".join(str(each.folder) for each in found[:_MAX_NAMED])
        raise DatasetError(f"no data set in the current folder ({escape(here)}) has {needed}; name one that has: {usage}")
    state = "" if last.finished else ", which is not finished"
    print(one_line(f"synpick-warp: data set: {last.folder}{state} (the last one here; {usage} takes another)"), file=sys.stderr)
    return last.folder


_fetched: dict[Path, tuple[str, TemporaryDirectory[str]]] = {}
"""Temporary copies of data sets in object stores: folder -> URL, and what deletes it."""


def _fetch(url: str) -> Path:
    """Copy a data set in an object store into a temporary folder, which `drop_fetched` deletes; returns the copy's folder."""
    from rich.console import Console

    from synpick_warp.cli.display import CountProgress
    from synpick_warp.cloud.reading import copy_set

    place = TemporaryDirectory(prefix="synpick-read-")
    folder = Path(place.name) / url.rpartition("/")[2]
    _fetched[folder] = url, place
    with CountProgress(Console(stderr=True, highlight=False)) as counter:
        copy_set(url, folder, report=counter.report)
    return folder


def drop_fetched() -> None:
    """Delete the copies of data sets in object stores."""
    while _fetched:
        _fetched.popitem()[1][1].cleanup()


def name_fetched(text: str) -> str:
    """Message with the URLs of data sets in place of their copies' folders."""
    for folder, (url, _) in _fetched.items():
        text = text.replace(str(folder), url)
    return text


def _list_data_sets() -> Iterator[_Found]:
    """Yield the data sets among the folders in the current one."""
    with os.scandir() as entries:
        for entry in entries:
            if not entry.name.startswith(".") and entry.is_dir() and is_data_set(entry.name):
                committed = os.lstat(f"{entry.name}/manifest").st_mtime_ns
                yield _Found(_has(f"{entry.name}/manifest/joined.json", stat.S_ISREG), committed, Path(entry.name))


# ---- where outputs go ----


def beside(folder: Path, ending: str) -> Path:
    """Path of an output beside a data set: its folder's name with an ending; in the current folder, if the set is in an object store."""
    if folder in _fetched:
        return Path(f"{folder.name}{ending}")
    place = folder if folder.name not in ("", "..") else folder.resolve()
    return place.with_name(f"{place.name or 'data-set'}{ending}")


def check_output_file(
    out: Path, option: str, data_set: Path | None = None, inputs: Sequence[Path] = (), *, is_folder: bool = False
) -> None:
    """Check that an output replaces no file of a data set, nor one that the command reads; call it before anything is read.

    In the folder of a data set itself files may have the suffixes OWN_SUFFIXES; in its subfolders there are no outputs.

    Args:
        data_set: The data set that the command reads, which may be one of other programs.
        inputs: Other files that the command reads.
        is_folder: Whether it is a folder, which none is in the folder of a data set itself, either.

    Raises:
        OutputError: It does.
    """
    from synpick_warp.exporters.writing.files import check_local

    check_local(out, option)
    try:
        place = out.parent.resolve() / out.name
        roots = [folder for folder in place.parents if is_data_set(folder)]
        if data_set is not None and data_set.resolve() in place.parents:
            roots.append(data_set.resolve())
        same = next((path for path in inputs if path.resolve() in (place, out.resolve())), None)
    except (OSError, RuntimeError, ValueError) as error:
        raise OutputError(f"{option} is {out}: {getattr(error, 'strerror', None) or error}") from None
    if same is not None:
        raise OutputError(f"{option} is {out}, which the command reads; name another file")
    for root in roots:
        if is_folder or place.parent != root or place.suffix.lower() not in OWN_SUFFIXES:
            kind = "folder" if is_folder else "file"
            raise OutputError(f"{option} is {out}, among the files of the data set {root}; name a {kind} outside of it")


def open_split(folder: Path, split: str | None) -> DataSet:
    """Open a data set, or one of its splits.

    Raises DatasetError if a baked one lacks its settings or manifest, these are damaged, or it has no such split.
    """
    from synpick_warp.dataset.commit.manifest import read_manifest
    from synpick_warp.dataset.reading import open_data_set

    data_set = open_data_set(folder)
    if data_set.found is None and not (folder / "config.toml").exists():
        raise DatasetError(f"{folder} has no config.toml; name the folder of a data set that synpick-warp baked")
    if (folder / "manifest").is_dir():
        read_manifest(folder)
    return data_set if split is None else data_set.split(split)
