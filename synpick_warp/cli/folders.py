"""Default paths of the commands: the data set to read, and the output files.

A data set is a folder with manifest.json and manifest/. Commands take the current folder if it is one, else that of a bake without --out.
"""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from synpick_warp.cli.options import one_line
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.system.inputs.urls import store_url

if TYPE_CHECKING:
    from synpick_warp.dataset.reading import DataSet

DEFAULT_NAME = "synpick-data"
"""Folder of a bake without --out."""
OWN_SUFFIXES = (".png", ".jpg", ".jpeg", ".html", ".htm", ".csv")
"""File suffixes of pictures, pages and tables. No data format writes such files at the top of a data set, so outputs may lie there."""


def is_data_set(folder: Path | str) -> bool:
    """Whether a folder contains a data set's manifest and its folder of entries; neither is read."""
    return _has(f"{folder}/manifest.json", stat.S_ISREG) and _has(f"{folder}/manifest", stat.S_ISDIR)


def _has(path: str, kind: Callable[[int], bool]) -> bool:
    """Whether the path exists and has this file type; symbolic links are not followed."""
    try:
        return kind(os.lstat(path).st_mode)
    except (OSError, ValueError):
        return False


# ---- which data set is read ----


def find_data_set(named: Path | None, usage: str) -> Path:
    """Return the data set that is named, which is not checked, or else the current folder or `DEFAULT_NAME` in it, which is announced on
    the standard error. `usage`: how the command is called with a folder. Raises DatasetError if there is none."""
    if named is not None:
        url = store_url(named)
        return named if url is None else _fetch(url)
    found = next(filter(is_data_set, (".", DEFAULT_NAME)), None)
    if found is None:
        raise DatasetError(f"there is no data set in the current folder; name one ({usage}), or make one first (synpick-warp bake)")
    folder = Path.cwd() if found == "." else Path(found)
    print(one_line(f"synpick-warp: data set: {folder} ({usage} takes another)"), file=sys.stderr)
    return folder


_fetched: dict[Path, tuple[str, TemporaryDirectory[str]]] = {}
"""Temporary copies of data sets in object stores: folder -> URL and its finalizer."""


def _fetch(url: str) -> Path:
    """Copy a data set in an object store into a temporary folder, which `drop_fetched` deletes; returns the copy's folder."""
    from synpick_warp.cli.display import count_on_stderr
    from synpick_warp.cloud.reading import copy_set

    place = TemporaryDirectory(prefix="synpick-read-")
    folder = Path(place.name) / url.rpartition("/")[2]
    _fetched[folder] = url, place
    with count_on_stderr() as counter:
        copy_set(url, folder, report=counter.report)
    return folder


def drop_fetched() -> None:
    """Delete the copies of data sets in object stores."""
    while _fetched:
        _fetched.popitem()[1][1].cleanup()


def name_fetched(text: str) -> str:
    """Replace folders of temporary copies in a message by the URLs of their data sets."""
    for folder, (url, _) in _fetched.items():
        text = text.replace(str(folder), url)
    return text


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
    """Raise OutputError if an output replaces a file of a data set, or one that the command reads; call it before anything is read.

    In the folder of a data set itself files, but no folders, may have the suffixes OWN_SUFFIXES; in its subfolders there are no outputs.
    `data_set` is the one that the command reads, which may be one of other programs; `inputs` are other files that it reads.
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


def check_new_folder(folder: Path, option: str) -> None:
    """Check that an output folder is new or empty and that its parent exists; raises OutputError. Permissions are not tested."""
    try:
        if os.path.lexists(folder) and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(f"{option} is {folder}; allowed: a new or an empty folder")
        parent = next(path for path in folder.absolute().parents if os.path.lexists(path))
    except (OSError, ValueError) as error:
        raise OutputError(f"{option} is {folder}: {getattr(error, 'strerror', None) or error}; name another folder") from error
    if not parent.is_dir():
        raise OutputError(f"{option} is {folder}, but {parent} is a file; name another folder")


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
