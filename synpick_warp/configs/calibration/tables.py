"""Sensors of [[camera]] tables and of `depth_sensor`: presets (sensors.toml), and tables that name a calibration file or a sensor, whose
numbers replace the name, so that the file is not read again.

A preset sets `depth_sensor.*`. Its noise is noise of disparity, from which depth noise follows by focal length and baseline:
sigma_z = z² sigma_d / (f b). Two cameras of one model differ by some pixels: a calibration of the own camera is better.
"""

import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from synpick_warp.configs.calibration.files import HALVES, INTEGERS, MAX_NUMBER, MODELS, Calibration, read_calibration
from synpick_warp.configs.fields import PATH_RULE
from synpick_warp.errors import ConfigError, format_value, suggest

_INTRINSICS = ("matrix", "fov", "distortion")
"""Keys that a file or a sensor stands for, with `model` and `resolution`."""
NO_OTHER_NOISE: dict[str, Any] = {"noise": 0.0, "noise_growth": 0.0, "noise_angle": 0.0}
"""Settings of all presets: the only noise is that of disparity and of the pixel's position."""
_CAMERA = ("resolution", "focal", "center", "height")
"""Values that are no settings of `depth_sensor`."""


class Figure(NamedTuple):
    """Value of a preset, how it is known (published, measured, assumed or defined), and its source in words."""

    value: Any
    trust: str
    source: str


def _read_presets() -> dict[str, dict[str, Figure]]:
    """Values of each preset, with those of its series."""
    tables = tomllib.loads(Path(__file__).with_name("sensors.toml").read_text(encoding="utf-8"))
    rows = {name: table | tables["series"].get(table.pop("series", ""), {}) for name, table in tables["sensors"].items()}
    return {
        name: {key: Figure(tuple(value) if isinstance(value, list) else value, *rest) for key, (value, *rest) in row.items()}
        for name, row in rows.items()
    }


SENSORS = _read_presets()
"""Values of each preset by name."""


def sensor_settings(name: str) -> dict[str, Any]:
    """Settings of the section `depth_sensor` that a preset stands for; none for an empty or unknown name."""
    figures = SENSORS.get(name, {})
    known = {key: figure.value for key, figure in figures.items() if key not in _CAMERA}
    return {**NO_OTHER_NOISE, "max_disparity": 0.0, **known} if figures else {}


def sensor_camera(name: str) -> Calibration | None:
    """Resolution and intrinsics of a preset's depth image; None: it has no camera of its own, as `ideal`, or there is no such preset."""
    figures = SENSORS.get(name, {})
    if "focal" not in figures:
        return None
    return Calibration(*figures["resolution"].value, *figures["focal"].value, *figures["center"].value)


def fill_tables(tables: object, source: str) -> object:
    """Replace `file` or `sensor`, and `pixel_center`, in the content of [[camera]] tables; anything that is no such table is left as it is.
    `source`: where the tables come from, for messages. Raises ConfigError: a file cannot be used, there is no such sensor, or one stands
    beside keys that it sets."""
    if not isinstance(tables, list):
        return tables
    return [_fill(f"camera[{index}]", table, source) if isinstance(table, dict) else table for index, table in enumerate(tables)]


def _fill(key: str, table: Mapping[str, Any], source: str) -> dict[str, Any]:
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
    if found := sensor_camera(name):
        return found
    known = [each for each in SENSORS if sensor_camera(each)]
    raise ConfigError(f"{key}.sensor is {format_value(name)} {source}; allowed: {', '.join(known)}{suggest(name, known)}")


def _shifted(table: dict[str, Any], center: float | None) -> dict[str, Any]:
    """Table whose matrix counts pixel centres at + 0.5; a matrix that is none is left to the check of settings."""
    matrix = table.get("matrix")
    if center is None or center == HALVES or not (isinstance(matrix, list) and len(matrix) == 3):
        return table
    if not all(isinstance(row, list) and len(row) == 3 and isinstance(row[2], int | float) and abs(row[2]) <= MAX_NUMBER for row in matrix):
        return table
    return table | {"matrix": [[*row[:2], row[2] + HALVES - center] for row in matrix[:2]] + matrix[2:]}
