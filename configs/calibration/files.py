"""Readers of camera calibration files of OpenCV, ROS, BOP, RealSense and Zivid; all return intrinsics with pixel centres at + 0.5.

| format | file | pixel centres | lens |
|---|---|---|---|
| OpenCV | YAML, XML, JSON of `FileStorage`, names as in its samples | integers | pinhole 4, 5, 8, 12 (14 without tilt), fisheye |
| ROS | `camera_info` YAML, or a `CameraInfo` message as text | integers | plumb_bob, rational_polynomial, equidistant |
| BOP | `camera.json` | + 0.5, as here | none |
| RealSense | JSON with the fields of `rs2_intrinsics` | integers | brown_conrady, kannala_brandt4; others if all are 0 |
| Zivid | YAML or JSON of `CameraIntrinsics` | integers | pinhole 5; K3 stands before P1 and P2 |

Raw images are described: rectification and projection matrices are not read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from synpick_warp.configs.calibration.documents import Tree, read_document
from synpick_warp.errors import ConfigError, format_value

PINHOLE = "pinhole"
FISHEYE = "fisheye"
MODELS = (PINHOLE, FISHEYE)
COUNTS = {PINHOLE: (4, 5, 8, 12), FISHEYE: (4,)}
"""Numbers of coefficients of each model: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]] and k1 k2 k3 k4, in OpenCV's order."""
INTEGERS, HALVES = 0.0, 0.5
"""Image coordinates of the centre of the first pixel [px]."""
MAX_SIDE = 8192
"""Largest width and height of an image [px]: the limit of cameras.resolution."""
_MAX_NUMBERS = 64
_NO_SKEW = 1e-9
"""Largest skew of a camera matrix, relative to fx."""
_ROS_MODELS = {
    "plumb_bob": (PINHOLE, (4, 5)), "rational_polynomial": (PINHOLE, (8, 12, 14)),
    "equidistant": (FISHEYE, (4,)), "fisheye": (FISHEYE, (4,)),
}  # fmt: skip
_RS_MODELS = ("none", "modified_brown_conrady", "inverse_brown_conrady", "ftheta", "brown_conrady", "kannala_brandt4")
"""Names of `rs2_distortion`, in the order of its values."""


@dataclass(frozen=True)
class Calibration:
    """Intrinsics and distortion of a camera; pixel centres at + 0.5."""

    width: int
    """Image width [px]; 0: the file does not say."""
    height: int
    """Image height [px]; 0: the file does not say."""
    fx: float
    fy: float
    cx: float
    cy: float
    """Focal lengths and principal point [px]."""
    model: str = PINHOLE
    """Distortion model."""
    distortion: tuple[float, ...] = ()
    """Coefficients in OpenCV's order; empty: none."""


def read_calibration(path: Path, model: str = "", pixel_center: float | None = None) -> Calibration:
    """Read the intrinsics of a camera from a file of any of the formats, which is told from its content.

    Args:
        path: The file.
        model: Distortion model, where the file does not name it: four coefficients in a file of OpenCV may be of both.
        pixel_center: Image coordinates of the first pixel's centre in the file, 0 or 0.5 [px]; None: those of its format.

    Raises:
        ConfigError: In one line: the file cannot be read or is of no such format, a value is missing or impossible, or a distortion model
            is one that is not rendered.
    """
    tree = read_document(path)
    try:
        name, counted, convert = next((row[0], row[2], row[3]) for row in _FORMATS if row[1](tree))
    except StopIteration:
        keys = ", ".join(map(str, list(tree)[:6]))
        raise ConfigError(
            f"{path} has no intrinsics of a known format, but {format_value(keys)}; known: {', '.join(row[0] for row in _FORMATS)}"
        ) from None
    try:
        found = _check(convert(tree, model), model)
    except _FaultError as fault:
        raise ConfigError(f"{path} ({name}): {fault}") from None
    shift = HALVES - (counted if pixel_center is None else pixel_center)
    return replace(found, cx=found.cx + shift, cy=found.cy + shift)


class _FaultError(Exception):
    """What is wrong with the content of a file."""


def _check(found: Calibration, model: str) -> Calibration:
    """Validate what all formats have in common; coefficients that are all 0 are none, except those of a fisheye."""
    if min(found.fx, found.fy) <= 0:
        raise _FaultError(f"the focal lengths are {found.fx:g} and {found.fy:g}; allowed: above 0 [px]")
    if (found.width or found.height) and not (0 < found.width <= MAX_SIDE and 0 < found.height <= MAX_SIDE):
        raise _FaultError(f"the image has {found.width} x {found.height} pixels; allowed: 1 to {MAX_SIDE}")
    if found.model == PINHOLE and not any(found.distortion):
        found = replace(found, distortion=())
    elif model not in ("", found.model):
        raise _FaultError(f"its distortion is of the model {found.model}, not {model}")
    elif len(found.distortion) not in COUNTS[found.model]:
        allowed = " or ".join(map(str, COUNTS[found.model]))
        raise _FaultError(f"it has {len(found.distortion)} coefficients of distortion; allowed: {allowed} with the model {found.model}")
    return found


def _opencv(tree: Tree, model: str) -> Calibration:
    """Values of OpenCV's calibration samples, of C++ and Python."""
    width, height = _size(tree, ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height"))
    coefficients = _numbers(_first(tree, _DISTORTION, []), "distortion coefficients")
    flag = str(_first(tree, ("fisheye_model", "fisheye"), "")).strip().lower()
    said = FISHEYE if flag in ("1", "true") or str(_first(tree, _MODEL, "")).lower() in ("fisheye", "equidistant") else ""
    said = said or (PINHOLE if flag or len(coefficients) != 4 else model or ("" if any(coefficients) else PINHOLE))
    if not said:
        raise _FaultError('its 4 coefficients may be of both models; set model = "pinhole" or "fisheye"')
    return Calibration(width, height, *_matrix(_first(tree, _MATRIX, None)), said, _without_tilt(coefficients))


def _ros(tree: Tree, model: str) -> Calibration:
    """Values of ROS's camera_calibration, or of a message."""
    width, height = _size(tree, ("image_width", "width"), ("image_height", "height"))
    for key in ("binning_x", "binning_y"):
        if _number(tree.get(key, 0), key) > 1:
            raise _FaultError(f"{key} is {tree[key]}; give intrinsics of the image as it is, without binning")
    roi = tree.get("roi", {})
    part = tuple(int(_number(roi.get(key, 0), f"roi.{key}")) for key in ("width", "height")) if isinstance(roi, dict) else (0, 0)
    if part not in ((0, 0), (width, height)):
        raise _FaultError(f"its region of interest has {part[0]} x {part[1]} of {width} x {height} pixels; calibrate the whole image")
    matrix = _numbers(_first(tree, _MATRIX, None), "camera matrix")
    if not any(matrix[:1]):
        raise _FaultError("its camera is not calibrated: K[0] is 0")
    coefficients = _numbers(_first(tree, _DISTORTION, []), "distortion coefficients")
    named = str(_first(tree, _MODEL, "")).strip().lower()
    if named not in _ROS_MODELS:
        if any(coefficients):
            raise _FaultError(f"its distortion model is {format_value(named)}; allowed: {', '.join(_ROS_MODELS)}")
        return Calibration(width, height, *_matrix(matrix))
    kind, counts = _ROS_MODELS[named]
    if coefficients and len(coefficients) not in counts:
        raise _FaultError(f"{named} has {len(coefficients)} coefficients; allowed: {' or '.join(map(str, counts))}")
    return Calibration(width, height, *_matrix(matrix), kind, _without_tilt(coefficients))


def _bop(tree: Tree, model: str) -> Calibration:
    """Values of BOP's camera.json; with the distortion that this program adds to it."""
    lens = (str(tree.get("cam_dist_model", PINHOLE)), _numbers(tree.get("cam_dist", []), "cam_dist"))
    return Calibration(*_size(tree, ("width",), ("height",)), *_four(tree, "fx fy cx cy"), *lens)


def _realsense(tree: Tree, model: str) -> Calibration:
    """Fields of librealsense's rs2_intrinsics, whose models differ from OpenCV's.

    `brown_conrady` and `kannala_brandt4` are OpenCV's. `modified_brown_conrady` shifts points that are scaled already, and so is OpenCV's
    only without tangential coefficients; `inverse_brown_conrady` takes distorted points to undistorted ones.
    """
    plain = Calibration(*_size(tree, ("width",), ("height",)), *_four(tree, "fx fy ppx ppy"))
    coefficients = _numbers(tree.get("coeffs", []), "coeffs")
    named = str(_first(tree, _MODEL, "none"))
    name = named.strip().lower().rpartition(".")[2].replace(" ", "_").removeprefix("rs2_distortion_")
    name = _RS_MODELS[int(name)] if name.isdigit() and int(name) < len(_RS_MODELS) else name
    if name == "kannala_brandt4":
        return replace(plain, model=FISHEYE, distortion=coefficients[:4])
    if not any(coefficients):
        return plain
    if name == "brown_conrady" or (name == "modified_brown_conrady" and not any(coefficients[2:4])):
        return replace(plain, distortion=coefficients)
    raise _FaultError(
        f"its distortion model {format_value(named)} with coefficients other than 0 is not OpenCV's; calibrate the stream with OpenCV, "
        "or set the coefficients to 0"
    )


def _zivid(tree: Tree, model: str) -> Calibration:
    """Zivid's CameraIntrinsics, which do not say the resolution."""
    top = tree.get("CameraIntrinsics", tree)
    camera, lens = _mapping(top, "CameraMatrix"), _mapping(top, "Distortion")
    return Calibration(
        0, 0, *_four(camera, "FX FY CX CY"), PINHOLE, tuple(_number(lens.get(key), key) for key in ("K1", "K2", "P1", "P2", "K3"))
    )


_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "camera_Matrix", "mtx", "K", "k")
_DISTORTION = (
    "distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "dist_coeff", "distortion_coeffs", "dist", "D", "d",
)  # fmt: skip
_MODEL = ("distortion_model", "model", "camera_model")
_FORMATS: tuple[tuple[str, Callable[[Tree], bool], float, Callable[[Tree, str], Calibration]], ...] = (
    ("Zivid", lambda tree: "CameraIntrinsics" in tree or {"CameraMatrix", "Distortion"} <= tree.keys(), INTEGERS, _zivid),
    ("RealSense", lambda tree: {"ppx", "ppy"} <= tree.keys(), INTEGERS, _realsense),
    ("ROS", lambda tree: bool({"camera_name", "distortion_model", "header"} & tree.keys()) and _has_matrix(tree), INTEGERS, _ros),
    ("OpenCV", lambda tree: _has_matrix(tree), INTEGERS, _opencv),
    ("BOP", lambda tree: {"fx", "fy", "cx", "cy"} <= tree.keys(), HALVES, _bop),
)
"""Name, test of a file's content, place of the first pixel's centre, and reader of each format; the first whose test passes is taken."""


def _has_matrix(tree: Tree) -> bool:
    """Whether there is a camera matrix under one of its names."""
    return any(name in tree for name in _MATRIX)


def _first(tree: Tree, names: Sequence[str], default: Any) -> Any:
    """Value of the first of these names that is there."""
    return next((tree[name] for name in names if name in tree), default)


def _mapping(tree: Any, key: str) -> Tree:
    """Mapping under a name."""
    value = tree.get(key) if isinstance(tree, dict) else None
    if not isinstance(value, dict):
        raise _FaultError(f"it has no {key}")
    return value


def _number(value: Any, key: str) -> float:
    """A finite number, or a string of one."""
    try:
        number = float(value) if isinstance(value, str | int | float) and not isinstance(value, bool) else math.nan
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise _FaultError(
            f"{key} is missing; give a number" if value is None else f"{key} is {format_value(value)}; allowed: a finite number"
        )
    return number


def _four(tree: Tree, keys: str) -> tuple[float, float, float, float]:
    """Numbers under four names, which blanks separate."""
    a, b, c, d = (_number(tree.get(key), key) for key in keys.split())
    return a, b, c, d


def _numbers(value: Any, key: str) -> tuple[float, ...]:
    """Numbers of a matrix: OpenCV's or ROS's mapping with rows, cols and data, nested lists, or a text with blanks between them."""
    sizes = None
    if isinstance(value, dict):
        sizes = int(_number(value.get("rows"), f"rows of {key}")), int(_number(value.get("cols"), f"cols of {key}"))
        value = value.get("data")
    items = tuple(_flatten(value.split() if isinstance(value, str) else [] if value is None else value))
    if len(items) > _MAX_NUMBERS or (sizes and sizes[0] * sizes[1] != len(items)):
        raise _FaultError(f"{key} has {len(items)} numbers{f' for {sizes[0]} x {sizes[1]}' if sizes else ''}")
    return tuple(_number(item, key) for item in items)


def _flatten(value: Any) -> Iterator[Any]:
    """Items of a list, and of lists in it."""
    for item in value if isinstance(value, list | tuple) else [value]:
        yield from item if isinstance(item, list) else [item]


def _size(tree: Tree, width: Sequence[str], height: Sequence[str]) -> tuple[int, int]:
    """Width and height of the image; 0, 0 if the file does not say."""
    values = [_number(_first(tree, names, 0), names[0]) for names in (width, height)]
    if any(value != int(value) for value in values):
        raise _FaultError(f"the image has {values[0]:g} x {values[1]:g} pixels; allowed: whole numbers")
    return int(values[0]), int(values[1])


def _matrix(value: Any) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a camera matrix, row by row."""
    numbers = _numbers(value, "camera matrix")
    if len(numbers) != 9:
        raise _FaultError(f"the camera matrix has {len(numbers)} numbers; allowed: 9")
    fx, skew, cx, zero, fy, cy, *last = numbers
    if (skew, zero) == (0.0, 0.0) and last[:2] != [0.0, 0.0] and (cx, cy) == (0.0, 0.0):
        raise _FaultError("the camera matrix is written column by column; write it row by row")
    if abs(skew) > _NO_SKEW * abs(fx) or zero != 0.0 or last != [0.0, 0.0, 1.0]:
        raise _FaultError("the camera matrix has skew or another last row than 0 0 1; allowed: fx 0 cx, 0 fy cy, 0 0 1")
    return fx, fy, cx, cy


def _without_tilt(coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """Coefficients without those of a tilted sensor, which must be 0."""
    if len(coefficients) != 14:
        return coefficients
    if any(coefficients[12:]):
        raise _FaultError("its sensor is tilted (the 13th and 14th coefficient); allowed: 0, calibrate without CALIB_TILTED_MODEL")
    return coefficients[:12]
