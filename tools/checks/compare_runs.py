"""Compare two data sets file by file: name the first difference, and say for every layer how many files differ and by how much.

A layer is what a kind of file holds: rgb, depth, scene_gt.json, an array of the trajectories, ... Settings that no file depends on,
such as the number of worlds, count for nothing. Exits with 0 if the data sets are the same, 1 if not, 2 if there is
nothing to compare.

    python -m tools.checks.compare_runs A B
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
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np

from synpick_warp.dataset.manifest import CONFIG_FILE, FREE_SETTINGS, MANIFEST_FILE

IMAGES = (".png", ".jpg")
USD = (".usd", ".usdc", ".usda")
CHUNK = 1 << 20
"""Bytes of a file that are compared at once."""
_NUMBERS = re.compile(r"\d{6,}(_\d{6,})*")
"""Numbers of episodes, scenes, frames and instances in a file's path."""


@dataclass
class Difference:
    """Where two files differ first, and by how much in all."""

    where: str
    """Key path, pixel, index or byte, with both values."""
    largest: float = math.nan
    """Largest difference of two numbers; NaN: something else than numbers differs."""


@dataclass
class Layer:
    """What became of the files of a kind."""

    files: int = 0
    differing: int = 0
    largest: float = 0.0


class UnusableError(Exception):
    """There is nothing to compare."""


def compare(first: Path, second: Path) -> tuple[dict[str, Layer], str]:
    """Layers by name, and the first difference as one line; empty: none.

    Settings and truth come before what is derived from them: the manifest, then files by name, then records and lists.
    """
    names = [_names(folder) for folder in (first, second)]
    layers: dict[str, Layer] = {}
    said = ""
    for name in sorted(names[0] | names[1], key=_order):
        layer = layers.setdefault(layer_of(name), Layer())
        layer.files += 1
        found = _compare_file(first, second, name, names)
        if found is not None:
            layer.differing += 1
            layer.largest = math.nan if math.isnan(found.largest) else max(layer.largest, found.largest)
            said = said or f"{name}: {found.where}"
    return layers, said


def _names(folder: Path) -> set[str]:
    if not folder.is_dir():
        raise UnusableError(f"there is no folder {folder}")
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    if not names:
        raise UnusableError(f"{folder} is empty")
    return names


def _order(name: str) -> tuple[int, str]:
    if name in (MANIFEST_FILE, CONFIG_FILE):
        return 0, name
    derived = name.startswith("manifest/") or "/" not in name
    return 1 + derived, name


def layer_of(name: str) -> str:
    """The kind of a file: its path without numbers of episodes, scenes and frames."""
    path = PurePosixPath(name)
    if any(part.endswith(".zarr") for part in path.parts):
        # The array's name; below it are chunks.
        path = path.parent / "zarr.json" if path.name == "zarr.json" else path.parent
    return "/".join(_NUMBERS.sub("*", part) for part in path.parts)


def _compare_file(first: Path, second: Path, name: str, names: list[set[str]]) -> Difference | None:
    for folder, own in zip((first, second), names, strict=True):
        if name not in own:
            return Difference(f"only in {second if folder == first else first}")
    if _same_bytes(first / name, second / name):
        return None
    found = explain(first / name, second / name)
    if found is None and name != CONFIG_FILE:
        return Difference("other bytes, the same content", 0.0)
    return found


def _same_bytes(first: Path, second: Path) -> bool:
    if first.stat().st_size != second.stat().st_size:
        return False
    with first.open("rb") as one, second.open("rb") as other:
        while True:
            part = one.read(CHUNK)
            if part != other.read(CHUNK):
                return False
            if not part:
                return True


def explain(first: Path, second: Path) -> Difference | None:
    """Where the content of two files differs; None: not at all, or nothing that counts."""
    folder = _array_folder(first)
    if folder is not None:
        return compare_zarr(folder, second.parents[first.parents.index(folder)])
    if first.suffix == ".tar":
        return compare_tars(first, second)
    if first.suffix in USD:
        return compare_usd(first, second)
    return compare_bytes(first.name, first.read_bytes(), second.read_bytes())


def compare_bytes(name: str, first: bytes, second: bytes) -> Difference | None:
    """Content of two files of a name."""
    suffix = PurePosixPath(name).suffix
    if suffix in IMAGES:
        one, other = (cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) for data in (first, second))
        if one is None or other is None:
            return Difference("no image")
        return compare_arrays(one, other, names=("row", "column", "channel"))
    if suffix == ".json":
        return _from_pairs(compare_values(json.loads(first), json.loads(second)))
    if suffix == ".jsonl":
        lines, others = ([json.loads(line) for line in data.splitlines()] for data in (first, second))
        return _from_pairs(compare_values(lines, others))
    if suffix == ".toml":
        pairs = compare_values(tomllib.loads(first.decode()), tomllib.loads(second.decode()))
        return _from_pairs(pair for pair in pairs if pair[0].lstrip(".") not in FREE_SETTINGS)
    length = min(len(first), len(second))
    unlike = np.flatnonzero(np.frombuffer(first[:length], np.uint8) != np.frombuffer(second[:length], np.uint8))
    place = int(unlike[0]) if unlike.size else length
    if suffix in (".sha256", ".md"):
        line = first[:place].count(b"\n")
        return Difference(f"line {line + 1}: {_line(first, line)} and {_line(second, line)}")
    return Difference(f"byte {place:,}; {len(first):,} and {len(second):,} bytes")


def compare_values(first: Any, second: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """(key path, value, value) of everything in which two JSON values differ."""
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


def _from_pairs(pairs: Iterator[tuple[str, Any, Any]]) -> Difference | None:
    where, largest = "", 0.0
    for path, one, other in pairs:
        where = where or f"{path.lstrip('.') or 'all'}: {one} and {other}"
        plain = all(isinstance(value, int | float) and not isinstance(value, bool) for value in (one, other))
        largest = max(largest, abs(one - other)) if plain and not math.isnan(largest) else math.nan
    return Difference(where, largest) if where else None


def compare_arrays(first: np.ndarray, second: np.ndarray, names: tuple[str, ...] = ()) -> Difference | None:
    """The first unlike element of two arrays; NaN equals NaN. `names` are of the dimensions."""
    if first.shape != second.shape or first.dtype != second.dtype:
        return Difference(f"{first.dtype}{list(first.shape)} and {second.dtype}{list(second.shape)}")
    numbers = first.dtype.kind in "biuf"
    unlike = (first != second) & ~((first != first) & (second != second)) if numbers else first != second
    if not unlike.any():
        return None
    index = tuple(int(place) for place in np.argwhere(unlike)[0])
    labels = names[: len(index)] or tuple(f"axis {axis}" for axis in range(len(index)))
    place = ", ".join(f"{label} {number}" for label, number in zip(labels, index, strict=True))
    largest = float(np.abs(first[unlike].astype(np.float64) - second[unlike].astype(np.float64)).max()) if numbers else math.nan
    count = int(unlike.sum())
    return Difference(f"{place}: {first[index]} and {second[index]}; {count:,} of {first.size:,} values, by up to {largest:g}", largest)


def _array_folder(path: Path) -> Path | None:
    """The zarr array that a chunk belongs to."""
    if path.name == "zarr.json" or not any(part.endswith(".zarr") for part in path.parts):
        return None
    for folder in path.parents:
        node = folder / "zarr.json"
        if node.is_file() and json.loads(node.read_bytes()).get("node_type") == "array":
            return folder
    return None


def compare_zarr(first: Path, second: Path) -> Difference | None:
    """Two arrays on disk."""
    import zarr

    one, other = (np.asarray(zarr.open_array(folder, mode="r")[...]) for folder in (first, second))
    return compare_arrays(one, other)


def compare_tars(first: Path, second: Path) -> Difference | None:
    """Members of two archives, in order."""
    with tarfile.open(first) as one, tarfile.open(second) as other:
        members = (one.getmembers(), other.getmembers())
        named = [[member.name for member in own] for own in members]
        if named[0] != named[1]:
            return Difference(f"{len(named[0])} and {len(named[1])} members, or other names")
        found: Difference | None = None
        for mine, theirs in zip(*members, strict=True):
            data = [(archive.extractfile(member) or io.BytesIO()).read() for archive, member in ((one, mine), (other, theirs))]
            unlike = compare_bytes(mine.name, *data) if data[0] != data[1] else None
            if unlike is not None:
                where = found.where if found else f"{mine.name}: {unlike.where}"
                found = Difference(where, unlike.largest if found is None else max(found.largest, unlike.largest))
        return found


def compare_usd(first: Path, second: Path) -> Difference | None:
    """Two layers, as text."""
    from pxr import Sdf

    layers = (Sdf.Layer.OpenAsAnonymous(str(path)) for path in (first, second))  # type: ignore[attr-defined]
    texts = [layer.ExportToString().splitlines() for layer in layers]
    for number, (one, other) in enumerate(zip(*texts, strict=False), start=1):
        if one != other:
            return Difference(f"line {number} as text: {one.strip()} and {other.strip()}")
    return Difference(f"{len(texts[0])} and {len(texts[1])} lines as text") if len(texts[0]) != len(texts[1]) else None


def _line(data: bytes, number: int) -> str:
    lines = data.splitlines()
    return lines[number].decode(errors="replace") if number < len(lines) else "nothing"


def show(layers: dict[str, Layer]) -> None:
    """A table of layers."""
    width = max(len(name) for name in layers)
    print(f"{'layer':{width}}  files  differ  largest difference")
    for name, layer in sorted(layers.items()):
        largest = "" if not layer.differing else "no number" if math.isnan(layer.largest) else f"{layer.largest:g}"
        print(f"{name:{width}}  {layer.files:5d}  {layer.differing:6d}  {largest}".rstrip())


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("first", type=Path, metavar="A")
    parser.add_argument("second", type=Path, metavar="B")
    given = parser.parse_args(arguments)
    try:
        layers, said = compare(given.first, given.second)
    except (UnusableError, OSError, ValueError) as error:
        print(f"compare_runs: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    show(layers)
    print(f"first difference: {said}" if said else "no difference")
    return 1 if said else 0


if __name__ == "__main__":
    sys.exit(main())
