"""Public names that changed with the rebuild of the house, old -> new, so that data sets of both spellings can be compared by value."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

SETTINGS = {
    "sight": "perception",
    "center_fraction": "center_fraction",
    "heavy_center_fraction": "heavy_center_fraction",
    "random_yaw": "random_yaw",
    "cell": "coarse_pixel",
    "cell_paths": "coarse_paths",
    "rest_displacement": "rest_displacement",
    "relaxed_displacement": "relaxed_displacement",
    "relax_time": "relax_time",
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
RECORDS = {"arrangement": "arrangement", "yaw": "yaw"} | ATTEMPTS
"""Keys of JSON files: lists, manifest entries, scene_camera.json."""
ARRAYS = {"held": "attached", "goal": "setpoint", "seal_load": "seal_force", "caught": "engaged", "load": "peak_force"}
"""Arrays of the zarr store."""
DERIVED = (".sha256",)
"""Suffixes of files that hold checksums of files whose keys changed."""


def renamed_path(name: str) -> str:
    """Path of a data set's file under the new names."""
    path = PurePosixPath(name)
    return "/".join(ARRAYS.get(part, part) for part in path.parts) if any(part.endswith(".zarr") for part in path.parts) else name


def renamed_keys(value: Any, name: str) -> Any:
    """A JSON or TOML value of the file `name` under the new names; lines of JSON inside of strings are left alone."""
    table = SETTINGS if PurePosixPath(name).name in ("config.toml", "manifest.json") else RECORDS
    if isinstance(value, dict):
        return {table.get(key, key): renamed_keys(item, name) for key, item in value.items()}
    return [renamed_keys(item, name) for item in value] if isinstance(value, list) else value
