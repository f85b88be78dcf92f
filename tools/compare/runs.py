"""Comparison of two data sets file by file: the first difference, and for every layer the differing files and the largest difference.

A layer is the content of one type of file: rgb, depth, scene_gt.json, an array of the trajectories, ... Settings that no file depends
on, such as the count of worlds, and the program's version in the manifest are ignored. Exits with 0 if the data sets are equal, 1 if not,
2 if there is nothing to compare.

    python -m tools.compare runs A B
"""

import argparse
import filecmp
import io
import json
import math
import re
import sys
import tarfile
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import cv2
import numpy as np

from synpick_warp.dataset.commit.manifest import CONFIG_FILE, FREE_SETTINGS, INPUTS, MANIFEST_FILE, OBJECT
from synpick_warp.errors import DatasetError
from tools.options import fail

IGNORED = {CONFIG_FILE: FREE_SETTINGS, MANIFEST_FILE: ("versions.synpick-warp", f"{INPUTS}.{OBJECT}*")}
"""Keys of files that may differ, as patterns. The digest of all objects covers those of single objects, which older versions lack."""
SAME_CONTENT = "different bytes, equal content"
_INDICES = re.compile(r"\d{6,}(_\d{6,})*")
"""Indices of episodes, scenes, frames and instances in a file's path."""


class Difference(NamedTuple):
    """Difference of two files or values."""

    where: str
    """Key path, with indices in brackets; line or member of an archive."""
    values: str
    largest: float = math.nan
    """Largest difference of two numbers; NaN: something other than numbers differs."""

    def __str__(self) -> str:
        return f"{self.where}: {self.values}".removeprefix(": ")


@dataclass
class LayerImages:
    """Comparison of all files of one type."""

    files: int = 0
    differing: int = 0
    largest: float = 0.0
    """Largest difference of two numbers; NaN: something other than numbers differs."""


def compare(first: Path, second: Path) -> tuple[dict[str, LayerImages], str]:
    """Compare two folders; returns counts by type of file (`layer_of`), and the first difference as one line (empty: none).

    Sources come before files derived from them: manifest and settings, then files by name, then manifest entries and lists. Raises
    DatasetError: a folder is missing or empty."""
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
            first_difference = first_difference or f"{name}: {difference}"
    return layers, first_difference


def _list_files(folder: Path) -> set[str]:
    if not folder.is_dir():
        raise DatasetError(f"there is no folder {folder}")
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    if not names:
        raise DatasetError(f"{folder} is empty")
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
            return Difference("", f"only in {second if folder == first else first}")
    if filecmp.cmp(first / name, second / name, shallow=False):
        return None
    difference = explain(first / name, second / name)
    if difference is None and name not in IGNORED:
        return Difference("", SAME_CONTENT, 0.0)
    return difference


def explain(first: Path, second: Path) -> Difference | None:
    """First difference of the decoded content of two files, with the largest of all; None: equal, or differing only in ignored settings."""
    folder = _array_folder(first)
    if folder is not None:
        import zarr

        folders = (folder, second.parents[first.parents.index(folder)])
        one, other = (np.asarray(zarr.open_array(each, mode="r")[...]) for each in folders)
        found = compare_values(one, other)
    elif first.suffix.startswith(".usd"):
        from pxr import Sdf

        layers = (Sdf.Layer.OpenAsAnonymous(str(path)) for path in (first, second))  # type: ignore[attr-defined]
        one, other = (_lines(layer.ExportToString().encode()) for layer in layers)
        found = compare_values(one, other)
    else:
        found = compare_bytes(first.name, first.read_bytes(), second.read_bytes())
    kept = [each for each in found if not any(fnmatchcase(each.where, key) for key in IGNORED.get(first.name, ()))]
    if not kept:
        return None
    largest = [each.largest for each in kept]
    return kept[0]._replace(largest=math.nan if any(map(math.isnan, largest)) else max(largest))


def _array_folder(path: Path) -> Path | None:
    """Folder of the zarr array that a chunk belongs to; None: the file is not a chunk."""
    if path.name == "zarr.json" or not any(part.endswith(".zarr") for part in path.parts):
        return None
    for folder in path.parents:
        node = folder / "zarr.json"
        if node.is_file() and json.loads(node.read_bytes()).get("node_type") == "array":
            return folder
    return None


def _image(data: bytes) -> Any:
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return "not an image" if pixels is None else pixels


def _lines(data: bytes) -> dict[str, str]:
    return {f"line {number}": line.strip() for number, line in enumerate(data.decode(errors="replace").splitlines(), start=1)}


DECODERS: Mapping[str, Callable[[bytes], Any]] = {
    ".png": _image,
    ".jpg": _image,
    ".json": json.loads,
    ".jsonl": lambda data: [json.loads(line) for line in data.splitlines()],
    ".toml": lambda data: tomllib.loads(data.decode()),
    ".sha256": _lines,
    ".md": _lines,
}
"""Suffix -> content of such a file as values, lists, dictionaries and arrays."""


def compare_bytes(name: str, first: bytes, second: bytes, path: str = "") -> Iterator[Difference]:
    """Differences of two files' content, decoded by the suffix of their name; of archives member by member."""
    suffix = PurePosixPath(name).suffix
    if suffix == ".tar":
        one, other = (dict(_members(data)) for data in (first, second))
        for member in dict.fromkeys([*one, *other]):
            if member not in one or member not in other:
                yield Difference(member, "only in one of them")
            elif one[member] != other[member]:
                yield from compare_bytes(member, one[member], other[member], member)
    elif suffix in DECODERS:
        one, other = map(DECODERS[suffix], (first, second))
        yield from compare_values(one, other, path)
    else:
        length = min(len(first), len(second))
        differs = np.flatnonzero(np.frombuffer(first[:length], np.uint8) != np.frombuffer(second[:length], np.uint8))
        yield Difference(f"{path} byte {differs[0] if differs.size else length:,}".lstrip(), f"{len(first):,} and {len(second):,} bytes")


def _members(archive: bytes) -> Iterator[tuple[str, bytes]]:
    """(name, content) of each member of a tar archive."""
    with tarfile.open(fileobj=io.BytesIO(archive)) as file:
        yield from ((member.name, (file.extractfile(member) or io.BytesIO()).read()) for member in file)


def compare_values(first: Any, second: Any, path: str = "") -> Iterator[Difference]:
    """Differences between two JSON values, whose leaves may be arrays."""
    if isinstance(first, dict) and isinstance(second, dict):
        for key in dict.fromkeys([*first, *second]):
            yield from compare_values(first.get(key), second.get(key), f"{path}.{key}".lstrip("."))
    elif isinstance(first, list) and isinstance(second, list) and len(first) == len(second):
        for index, (one, other) in enumerate(zip(first, second, strict=True)):
            yield from compare_values(one, other, f"{path}[{index}]")
    elif isinstance(first, list) and isinstance(second, list):
        yield Difference(path, f"{len(first)} entries and {len(second)} entries")
    elif isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        yield from compare_arrays(first, second, path)
    elif isinstance(first, np.ndarray) or isinstance(second, np.ndarray) or first != second:
        numbers = [value for value in (first, second) if isinstance(value, int | float) and not isinstance(value, bool)]
        yield Difference(path, f"{first} and {second}", abs(numbers[0] - numbers[1]) if len(numbers) == 2 else math.nan)


def compare_arrays(first: np.ndarray, second: np.ndarray, path: str = "") -> Iterable[Difference]:
    """First differing element of two arrays, and the largest difference; NaN equals NaN."""
    if first.shape != second.shape or first.dtype != second.dtype:
        return [Difference(path, f"{first.dtype}{list(first.shape)} and {second.dtype}{list(second.shape)}")]
    numbers = first.dtype.kind in "biuf"
    differs = (first != second) & ~((first != first) & (second != second)) if numbers else first != second
    if not differs.any():
        return []
    index = tuple(np.argwhere(differs)[0].tolist())
    largest = float(np.abs(first[differs].astype(np.float64) - second[differs].astype(np.float64)).max()) if numbers else math.nan
    values = f"{first[index]} and {second[index]}; {int(differs.sum()):,} of {first.size:,} values, by up to {largest:g}"
    return [Difference(f"{path}{list(index)}", values, largest)]


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
    except (DatasetError, OSError, ValueError) as error:
        return fail("compare runs", " ".join(str(error).split()))
    print_layers(layers)
    print(f"first difference: {first_difference}" if first_difference else "no difference")
    return 1 if first_difference else 0


if __name__ == "__main__":
    sys.exit(main())
