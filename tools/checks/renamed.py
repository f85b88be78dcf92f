"""Public names that changed with the rebuild of the house, old -> new, so that data sets of both spellings can be compared by value."""

from __future__ import annotations

import io
import json
import re
import shutil
import tarfile
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import zarr

SETTINGS = {
    "sight": "perception",
    "center_share": "center_fraction",
    "heavy_center_share": "heavy_center_fraction",
    "turn_lights": "random_yaw",
    "cell": "coarse_pixel",
    "cell_paths": "coarse_paths",
    "rest_shift": "rest_displacement",
    "last_shift": "relaxed_displacement",
    "late_time": "relax_time",
}
"""Sections and keys of config.toml and manifest.json."""
ATTEMPTS = {
    "caught": "engaged",
    "load": "peak_force",
    "sight": "observation",
    "share": "visible_fraction",
    "middle": "midpoint",
    "suction": "grasp_pixel",
    "all_above": "ancestors",
}
"""Keys of a line of attempts.jsonl."""
RECORDS = {"redraw": "arrangement", "turn": "yaw"} | ATTEMPTS
"""Keys of JSON files: lists, manifest entries, scene_camera.json."""
ARRAYS = {"held": "attached", "goal": "setpoint", "seal_load": "seal_force", "caught": "engaged", "load": "peak_force"}
"""Arrays of the zarr store."""
DERIVED = (".sha256",)
"""Suffixes of files that hold checksums of files whose keys changed."""
CHECKSUMS = ("checksum", "settings_checksum", "bytes")
"""Keys whose values are such checksums, or sizes of files whose keys changed; left out."""
RECORD = "record"
"""Array of the zarr store that holds lines of attempts.jsonl."""


def translate(source: Path, target: Path) -> None:
    """Copy a data set to the folder `target`, with old names replaced by the new ones, and without checksums in JSON files."""
    for path in sorted(source.rglob("*")):
        if path.is_file():
            copy = target / renamed_path(path.relative_to(source).as_posix())
            copy.parent.mkdir(parents=True, exist_ok=True)
            if path.suffix == ".tar":
                _translate_tar(path, copy)
            elif path.suffix == ".usdc" and path.parent.name == "usd":
                _translate_usd(path, copy)
            elif path.suffix in (".json", ".jsonl", ".toml"):
                copy.write_bytes(renamed_text(path.name, path.read_bytes()))
            else:
                shutil.copyfile(path, copy)
    for folder in sorted(target.glob(f"*.zarr/**/{RECORD}")):
        array = zarr.open_array(folder, mode="r")
        lines = renamed_text("attempts.jsonl", np.asarray(array[...]).tobytes())
        attributes, names = dict(array.attrs), array.metadata.dimension_names  # type: ignore[union-attr]
        data = np.frombuffer(lines, np.uint8)
        zarr.create_array(folder, data=data, attributes=attributes, dimension_names=names, overwrite=True)


def renamed_path(name: str) -> str:
    """Path of a data set's file under the new names."""
    path = PurePosixPath(name)
    return "/".join(ARRAYS.get(part, part) for part in path.parts) if any(part.endswith(".zarr") for part in path.parts) else name


def renamed_text(name: str, data: bytes) -> bytes:
    """Content of a JSON, JSON lines or TOML file under the new names."""
    if name.endswith(".toml"):
        text = re.sub(r"^\[(\w+)\]$", lambda match: f"[{SETTINGS.get(match[1], match[1])}]", data.decode(), flags=re.MULTILINE)
        return re.sub(r"^(\w+) =", lambda match: f"{SETTINGS.get(match[1], match[1])} =", text, flags=re.MULTILINE).encode()
    table = SETTINGS if name == "manifest.json" else RECORDS | ARRAYS if name == "zarr.json" else RECORDS
    if name.endswith(".jsonl"):
        return b"".join(json.dumps(_renamed(json.loads(line), table)).encode() + b"\n" for line in data.splitlines())
    return json.dumps(_renamed(json.loads(data), table)).encode()


def _renamed(value: Any, table: dict[str, str]) -> Any:
    if isinstance(value, dict):
        return {table.get(key, key): _renamed(item, table) for key, item in value.items() if key not in CHECKSUMS}
    return [_renamed(item, table) for item in value] if isinstance(value, list) else value


def _translate_tar(source: Path, target: Path) -> None:
    with tarfile.open(source) as old, tarfile.open(target, "w") as new:
        for member in old.getmembers():
            data = (old.extractfile(member) or io.BytesIO()).read()
            if member.name.endswith(".json"):
                data = renamed_text(member.name, data)
                member.size = len(data)
            new.addfile(member, io.BytesIO(data))


def _translate_usd(source: Path, target: Path) -> None:
    from pxr import Sdf

    shutil.copyfile(source, target)
    layer = Sdf.Layer.FindOrOpen(str(target))  # type: ignore[attr-defined]
    for prim in layer.rootPrims:
        data = {RECORDS.get(key, key): value for key, value in dict(prim.customData).items()}
        prim.customData = data
    layer.Save()
