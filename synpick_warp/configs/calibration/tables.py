"""Resolution of [[camera]] tables that name a calibration file or a sensor: numbers replace the name, and the file is not read again."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from synpick_warp.configs.calibration.files import HALVES, INTEGERS, MAX_NUMBER, MODELS, Calibration, read_calibration
from synpick_warp.configs.calibration.sensor_presets import SENSORS, sensor_camera
from synpick_warp.configs.fields import PATH_RULE
from synpick_warp.errors import ConfigError, format_value, suggest

_INTRINSICS = ("matrix", "fov", "distortion")
"""Keys that a file or a sensor stands for, with `model` and `resolution`."""


def fill_tables(tables: object, source: str) -> object:
    """Replace `file` or `sensor`, and `pixel_center`, in the content of [[camera]] tables; anything that is no such table is left as it is.

    Args:
        tables: Value of `camera` as parsed from TOML.
        source: Where the tables come from, for messages.

    Raises:
        ConfigError: A file cannot be used, there is no such sensor, or one stands beside keys that it sets.
    """
    if not isinstance(tables, list):
        return tables
    return [_fill(f"camera[{index}]", table, source) if isinstance(table, dict) else table for index, table in enumerate(tables)]


def _fill(key: str, table: Mapping[str, Any], source: str) -> dict[str, Any]:
    """One table with numbers."""
    rest = {name: value for name, value in table.items() if name not in ("file", "sensor", "pixel_center")}
    center = table.get("pixel_center")
    if center not in (None, INTEGERS, HALVES) or isinstance(center, bool):
        raise ConfigError(f"{key}.pixel_center is {format_value(center)} {source}; allowed: 0 or 0.5 [px]")
    named = [name for name in ("file", "sensor") if table.get(name, "") != ""]
    if not named:
        return _shifted(rest, center)
    for name in named:
        if not isinstance(table[name], str):
            raise ConfigError(f"{key}.{name} is {format_value(table[name])} {source}; allowed: a string")
    if beside := [name for name in (*_INTRINSICS, *named[1:]) if name in table]:
        raise ConfigError(f"{key}.{beside[0]} stands beside {key}.{named[0]} {source}; allowed: one of them")
    model = table.get("model", "")
    if model not in ("", *MODELS):
        raise ConfigError(f"{key}.model is {format_value(model)} {source}; allowed: {', '.join(MODELS)}")
    if named == ["file"] and not os.path.lexists(table["file"]):
        raise ConfigError(f"{key}.file: there is no file {table['file']}; {PATH_RULE}")
    found = _sensor(key, table["sensor"], source) if named == ["sensor"] else read_calibration(Path(table["file"]), model, center)
    size = [found.width, found.height]
    if found.width == 0 and "resolution" not in table:
        raise ConfigError(f"{key}.file does not say the image's size {source}; set {key}.resolution")
    if found.width and table.get("resolution", size) != size:
        given = format_value(table["resolution"])
        raise ConfigError(
            f"{key}.resolution is {given} {source}; allowed: {format_value(size)}, that of its {named[0]}, or none; "
            f"{key}.scale = 0.5 makes images of half that size"
        )
    rest |= {"resolution": size} if found.width else {}
    rest["matrix"] = [[found.fx, 0.0, found.cx], [0.0, found.fy, found.cy], [0.0, 0.0, 1.0]]
    rest.pop("model", None)
    if found.distortion:
        rest |= {"distortion": list(found.distortion), "model": found.model}
    return rest


def _sensor(key: str, name: str, source: str) -> Calibration:
    """Intrinsics of a sensor."""
    known = [name for name in SENSORS if sensor_camera(name) is not None]
    if name not in known:
        raise ConfigError(f"{key}.sensor is {format_value(name)} {source}; allowed: {', '.join(known)}{suggest(name, known)}")
    found = sensor_camera(name)
    assert found is not None
    return found


def _shifted(table: dict[str, Any], center: float | None) -> dict[str, Any]:
    """Table whose matrix counts pixel centres at + 0.5; a matrix that is none is left to the check of settings."""
    matrix = table.get("matrix")
    if center is None or center == HALVES or not (isinstance(matrix, list) and len(matrix) == 3):
        return table
    if not all(isinstance(row, list) and len(row) == 3 and isinstance(row[2], int | float) and abs(row[2]) <= MAX_NUMBER for row in matrix):
        return table
    return table | {"matrix": [[*row[:2], row[2] + HALVES - center] for row in matrix[:2]] + matrix[2:]}
