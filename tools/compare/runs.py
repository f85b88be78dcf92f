"""Comparison of two data sets file by file: the first difference, and for every layer the differing files and the largest difference.

A layer is the content of one type of file: rgb, depth, scene_gt.json, an array of the trajectories, ... Settings that no file depends
on, such as the count of worlds, and the program's version in the manifest are ignored. Exits with 0 if the data sets are equal, 1 if not,
2 if there is nothing to compare.

    python -m tools.compare runs A B
"""

from __future__ import annotations

import argparse
import io
import json
import math
import re
import sys
import tarfile
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np

from synpick_warp.dataset.commit.manifest import CONFIG_FILE, FREE_SETTINGS, INPUTS, MANIFEST_FILE, OBJECT
from tools.options import fail

IMAGES = (".png", ".jpg")
USD = (".usd", ".usdc", ".usda")
IGNORED = {CONFIG_FILE: FREE_SETTINGS, MANIFEST_FILE: ("versions.synpick-warp", f"{INPUTS}.{OBJECT}*")}
"""Keys of files that may differ, as patterns. The digest of all objects covers those of single objects, which older versions lack."""
SAME_CONTENT = "different bytes, equal content"
CHUNK = 1 << 20
"""Bytes of a file compared at once."""
_INDICES = re.compile(r"\d{6,}(_\d{6,})*")
"""Indices of episodes, scenes, frames and instances in a file's path."""


@dataclass
class Difference:
    """First difference of two files (where, with both values), and the largest one (NaN: something other than numbers differs)."""

    where: str
    """Key path, pixel, index or byte, with both values."""
    largest: float = math.nan
    """Largest difference of two numbers; NaN: something other than numbers differs."""


@dataclass
class LayerImages:
    """Comparison of all files of one type: their number, how many differ, largest difference (NaN: something other than numbers
    differs).
    """

    files: int = 0
    differing: int = 0
    largest: float = 0.0
    """Largest difference of two numbers; NaN: something other than numbers differs."""


class UnusableRunError(Exception):
    """Error: a folder is missing or empty."""


def compare(first: Path, second: Path) -> tuple[dict[str, LayerImages], str]:
    """Compare two folders; returns layers by name, and the first difference as one line (empty: none).

    Sources come before files derived from them: manifest and settings, then files by name, then manifest entries and lists.
    """
    names = [_list_files(folder) for folder in (first, second)]
    layers: dict[str, LayerImages] = {}
    first_difference = ""
    for name in sorted(names[0] | names[1], key=_sort_key):
        layer = layers.setdefault(layer_of(name), LayerImages())
        layer.files += 1
        difference = _compare_file(first, second, name, names)
        if difference is not None:
            layer.differing += 1
            layer.largest = math.nan if math.isnan(difference.largest) else max(layer.largest, difference.largest)
            first_difference = first_difference or f"{name}: {difference.where}"
    return layers, first_difference


def _list_files(folder: Path) -> set[str]:
    """Paths of all files below a folder, relative to it."""
    if not folder.is_dir():
        raise UnusableRunError(f"there is no folder {folder}")
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    if not names:
        raise UnusableRunError(f"{folder} is empty")
    return names


def _sort_key(name: str) -> tuple[int, str]:
    """Order of comparison: settings, data, then files derived from them."""
    if name in (MANIFEST_FILE, CONFIG_FILE):
        return 0, name
    derived = name.startswith("manifest/") or "/" not in name
    return 1 + derived, name


def layer_of(name: str) -> str:
    """Layer of a file: its path with indices of episodes, scenes and frames replaced by `*`."""
    path = PurePosixPath(name)
    if any(part.endswith(".zarr") for part in path.parts):
        # Chunks lie below the array's folder.
        path = path.parent / "zarr.json" if path.name == "zarr.json" else path.parent
    return "/".join(_INDICES.sub("*", part) for part in path.parts)


def _compare_file(first: Path, second: Path, name: str, names: list[set[str]]) -> Difference | None:
    """Difference of one file of both folders; None if its bytes are equal, or its settings are equal in effect."""
    for folder, own in zip((first, second), names, strict=True):
        if name not in own:
            return Difference(f"only in {second if folder == first else first}")
    if _same_bytes(first / name, second / name):
        return None
    difference = explain(first / name, second / name)
    if difference is None and name not in IGNORED:
        return Difference(SAME_CONTENT, 0.0)
    return difference


def _same_bytes(first: Path, second: Path) -> bool:
    """Whether two files have the same content."""
    if first.stat().st_size != second.stat().st_size:
        return False
    with first.open("rb") as one, second.open("rb") as other:
        while True:
            chunk = one.read(CHUNK)
            if chunk != other.read(CHUNK):
                return False
            if not chunk:
                return True


def explain(first: Path, second: Path) -> Difference | None:
    """First difference of the decoded content of two files; None: equal, or differing only in ignored settings."""
    folder = _array_folder(first)
    if folder is not None:
        return compare_zarr(folder, second.parents[first.parents.index(folder)])
    if first.suffix == ".tar":
        return compare_tars(first, second)
    if first.suffix in USD:
        return compare_usd(first, second)
    return compare_bytes(first.name, first.read_bytes(), second.read_bytes())


def compare_bytes(name: str, first: bytes, second: bytes) -> Difference | None:
    """First difference of two files' content, decoded by the suffix of their name."""
    suffix = PurePosixPath(name).suffix
    if suffix in IMAGES:
        one, other = (cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) for data in (first, second))
        if one is None or other is None:
            return Difference("not an image")
        return compare_arrays(one, other, names=("row", "column", "channel"))
    if suffix == ".json":
        return _from_pairs(_without_ignored(name, compare_values(json.loads(first), json.loads(second))))
    if suffix == ".jsonl":
        lines, others = ([json.loads(line) for line in data.splitlines()] for data in (first, second))
        return _from_pairs(compare_values(lines, others))
    if suffix == ".toml":
        pairs = compare_values(tomllib.loads(first.decode()), tomllib.loads(second.decode()))
        return _from_pairs(_without_ignored(name, pairs))
    length = min(len(first), len(second))
    differs = np.flatnonzero(np.frombuffer(first[:length], np.uint8) != np.frombuffer(second[:length], np.uint8))
    offset = int(differs[0]) if differs.size else length
    if suffix in (".sha256", ".md"):
        line = first[:offset].count(b"\n")
        return Difference(f"line {line + 1}: {_line(first, line)} and {_line(second, line)}")
    return Difference(f"byte {offset:,}; {len(first):,} and {len(second):,} bytes")


def compare_values(first: Any, second: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """(key path, first value, second value) of each difference between two JSON values."""
    if isinstance(first, dict) and isinstance(second, dict):
        for key in [*first, *(key for key in second if key not in first)]:
            yield from compare_values(first.get(key), second.get(key), f"{path}.{key}")
    elif isinstance(first, list) and isinstance(second, list) and len(first) == len(second):
        for index, (one, other) in enumerate(zip(first, second, strict=True)):
            yield from compare_values(one, other, f"{path}[{index}]")
    elif isinstance(first, list) and isinstance(second, list):
        yield path, f"{len(first)} entries", f"{len(second)} entries"
    elif first != second:
        yield path, first, second


def _without_ignored(name: str, pairs: Iterator[tuple[str, Any, Any]]) -> Iterator[tuple[str, Any, Any]]:
    """Drop the differing pairs whose key is ignored in files of this name."""
    return (pair for pair in pairs if not any(fnmatchcase(pair[0].lstrip("."), key) for key in IGNORED.get(name, ())))


def _from_pairs(pairs: Iterator[tuple[str, Any, Any]]) -> Difference | None:
    """Summarize differing values (key path, first value, second value); None without any."""
    where, largest = "", 0.0
    for path, one, other in pairs:
        where = where or f"{path.lstrip('.') or 'all'}: {one} and {other}"
        numeric = all(isinstance(value, int | float) and not isinstance(value, bool) for value in (one, other))
        largest = max(largest, abs(one - other)) if numeric and not math.isnan(largest) else math.nan
    return Difference(where, largest) if where else None


def compare_arrays(first: np.ndarray, second: np.ndarray, names: tuple[str, ...] = ()) -> Difference | None:
    """First differing element of two arrays; NaN equals NaN. `names` are the dimensions' names."""
    if first.shape != second.shape or first.dtype != second.dtype:
        return Difference(f"{first.dtype}{list(first.shape)} and {second.dtype}{list(second.shape)}")
    numbers = first.dtype.kind in "biuf"
    differs = (first != second) & ~((first != first) & (second != second)) if numbers else first != second
    if not differs.any():
        return None
    index = tuple(int(position) for position in np.argwhere(differs)[0])
    labels = names[: len(index)] or tuple(f"axis {axis}" for axis in range(len(index)))
    where = ", ".join(f"{label} {position}" for label, position in zip(labels, index, strict=True))
    largest = float(np.abs(first[differs].astype(np.float64) - second[differs].astype(np.float64)).max()) if numbers else math.nan
    count = int(differs.sum())
    return Difference(f"{where}: {first[index]} and {second[index]}; {count:,} of {first.size:,} values, by up to {largest:g}", largest)


def _array_folder(path: Path) -> Path | None:
    """Folder of the zarr array that a chunk belongs to; None: the file is not a chunk."""
    if path.name == "zarr.json" or not any(part.endswith(".zarr") for part in path.parts):
        return None
    for folder in path.parents:
        node = folder / "zarr.json"
        if node.is_file() and json.loads(node.read_bytes()).get("node_type") == "array":
            return folder
    return None


def compare_zarr(first: Path, second: Path) -> Difference | None:
    """First difference of two zarr arrays; None: they are equal."""
    import zarr

    one, other = (np.asarray(zarr.open_array(folder, mode="r")[...]) for folder in (first, second))
    return compare_arrays(one, other)


def compare_tars(first: Path, second: Path) -> Difference | None:
    """First difference of two tar archives, member by member; None: they are equal."""
    with tarfile.open(first) as one, tarfile.open(second) as other:
        members = (one.getmembers(), other.getmembers())
        named = [[member.name for member in own] for own in members]
        if named[0] != named[1]:
            return Difference(f"{len(named[0])} and {len(named[1])} members, or different names")
        total: Difference | None = None
        for mine, theirs in zip(*members, strict=True):
            data = [(archive.extractfile(member) or io.BytesIO()).read() for archive, member in ((one, mine), (other, theirs))]
            difference = compare_bytes(mine.name, *data) if data[0] != data[1] else None
            if difference is not None:
                where = total.where if total else f"{mine.name}: {difference.where}"
                total = Difference(where, difference.largest if total is None else max(total.largest, difference.largest))
        return total


def compare_usd(first: Path, second: Path) -> Difference | None:
    """First differing line of two USD layers as text; None: they are equal."""
    from pxr import Sdf

    layers = (Sdf.Layer.OpenAsAnonymous(str(path)) for path in (first, second))  # type: ignore[attr-defined]
    texts = [layer.ExportToString().splitlines() for layer in layers]
    for line, (one, other) in enumerate(zip(*texts, strict=False), start=1):
        if one != other:
            return Difference(f"line {line} as text: {one.strip()} and {other.strip()}")
    return Difference(f"{len(texts[0])} and {len(texts[1])} lines as text") if len(texts[0]) != len(texts[1]) else None


def _line(data: bytes, index: int) -> str:
    """Line of a text by index; "nothing" beyond its end."""
    lines = data.splitlines()
    return lines[index].decode(errors="replace") if index < len(lines) else "nothing"


def print_layers(layers: dict[str, LayerImages]) -> None:
    """Print the table of layers."""
    width = max(len(name) for name in layers)
    print(f"{'layer':{width}}  files  differ  largest difference")
    for name, layer in sorted(layers.items()):
        largest = "" if not layer.differing else "not numeric" if math.isnan(layer.largest) else f"{layer.largest:g}"
        print(f"{name:{width}}  {layer.files:5d}  {layer.differing:6d}  {largest}".rstrip())


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("first", type=Path, metavar="A")
    parser.add_argument("second", type=Path, metavar="B")
    options = parser.parse_args(arguments)
    try:
        layers, first_difference = compare(options.first, options.second)
    except (UnusableRunError, OSError, ValueError) as error:
        return fail("compare runs", " ".join(str(error).split()))
    print_layers(layers)
    print(f"first difference: {first_difference}" if first_difference else "no difference")
    return 1 if first_difference else 0


if __name__ == "__main__":
    sys.exit(main())
