"""Readers of camera calibration files; all return intrinsics with pixel centres at + 0.5.

| format | file | pixel centres | lens |
|---|---|---|---|
| OpenCV | YAML, XML, JSON of `FileStorage`, `.npz`, `.npy`; samples' names | integers | pinhole 4, 5, 8, 12 (14 without tilt), fisheye |
| cam_K.txt | the nine numbers of the matrix, as FoundationPose has them; also as a list of JSON | integers | none |
| ROS | `camera_info` YAML or `.ini`, or a `CameraInfo` message as text | integers | plumb_bob, rational_polynomial, equidistant |
| Kalibr | `camchain.yaml` | integers | radtan, equidistant |
| BOP | `camera.json`, `scene_camera.json` | + 0.5, as here | as this program adds it |
| Open3D | `PinholeCameraIntrinsic`, whose matrix stands column by column | integers | none |
| COLMAP | `cameras.txt` | + 0.5 | those that are OpenCV's: radial, OPENCV, FULL_OPENCV, fisheye |
| nerfstudio | `transforms.json` | + 0.5 | OPENCV, OPENCV_FISHEYE |
| RealSense | JSON with the fields of `rs2_intrinsics` | integers | brown_conrady, kannala_brandt4; others if all are 0 |
| Zivid | YAML or JSON of `CameraIntrinsics` | integers | pinhole 5; K3 stands before P1 and P2 |

A file of several cameras is read where they are equal. Raw images are described: rectification and projection matrices are not read.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from synpick_warp.configs.calibration.documents import Tree, read_document
from synpick_warp.errors import ConfigError, SynpickError, format_value

PINHOLE = "pinhole"
FISHEYE = "fisheye"
MODELS = (PINHOLE, FISHEYE)
COUNTS = {PINHOLE: (4, 5, 8, 12), FISHEYE: (4,)}
"""Numbers of coefficients of each model: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]] and k1 k2 k3 k4, in OpenCV's order."""
INTEGERS, HALVES = 0.0, 0.5
"""Image coordinates of the centre of the first pixel [px]."""
MAX_SIDE = 8192
"""Largest width and height of an image [px]: the limit of cameras.resolution."""
MAX_NUMBER = 1e6
"""Largest focal length, coordinate of the principal point [px] and coefficient of distortion: the limit of camera.matrix."""
_MAX_NUMBERS = 64
_SECONDS, _MEMORY = 3.0, 2**28
"""Limits of reading a file: processor time [s] and memory [bytes]."""
_NO_SKEW = 1e-9
"""Largest skew of a camera matrix, relative to fx."""
_ROS_MODELS = {
    "plumb_bob": (PINHOLE, (4, 5)), "radtan": (PINHOLE, (4,)), "rational_polynomial": (PINHOLE, (8, 12, 14)),
    "equidistant": (FISHEYE, (4,)), "fisheye": (FISHEYE, (4,)),
}  # fmt: skip
_RS_MODELS = ("none", "modified_brown_conrady", "inverse_brown_conrady", "ftheta", "brown_conrady", "kannala_brandt4")
"""Names of `rs2_distortion`, in the order of its values."""
_COLMAP_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy", "PINHOLE": "fx fy cx cy", "SIMPLE_RADIAL": "f cx cy k1", "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2", "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1", "RADIAL_FISHEYE": "f cx cy k1 k2",
}  # fmt: skip
"""Parameters of COLMAP's models that are OpenCV's, in their order."""


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
    distortion: tuple[float, ...] = ()
    """Coefficients in OpenCV's order; empty: none."""


def read_calibration(path: Path, model: str = "", pixel_center: float | None = None) -> Calibration:
    """Read the intrinsics of a camera from a file of any of the formats, which is detected from its content. `model`: distortion model,
    where the file does not name it: four coefficients in a file of OpenCV may be of both. `pixel_center`: image coordinates of the first
    pixel's centre in the file, 0 or 0.5 [px]; None: those of its format. Raises ConfigError: the file cannot be read or is of no such
    format, a value is missing or impossible, or a distortion model is not rendered."""
    from synpick_warp.system.processes.isolation import Failure, Limits, run_isolated

    (found,) = run_isolated(_read, [(path, model, pixel_center)], Limits(_SECONDS, _MEMORY))
    if isinstance(found, Failure):
        verdict = "cannot be read on this machine" if found.by_machine else "is no calibration file"
        raise ConfigError(f"{path} {verdict}: its reader {found.reason}")
    if isinstance(found, SynpickError):
        raise found
    return found


def _read(path: Path, model: str, pixel_center: float | None) -> Calibration:
    """As `read_calibration`, in the isolated process."""
    tree = read_document(path)
    trees = [tree] if _format(tree) else [part for part in tree.values() if isinstance(part, dict) and _format(part)]
    if not trees:
        keys = format_value(", ".join(map(str, list(tree)[:6])))
        raise ConfigError(
            f"{path} has no intrinsics of a known format, but {keys}; known: {', '.join(dict.fromkeys(row[0] for row in _FORMATS))}; "
            "or write resolution, matrix and distortion into the settings"
        )
    read = set()
    for part in trees:
        name, _, counted, convert = _format(part) or _FORMATS[-1]
        try:
            found = _check(convert(part, model), model)
        except _FaultError as fault:
            raise ConfigError(f"{path} ({name}): {fault}") from None
        shift = HALVES - (counted if pixel_center is None else pixel_center)
        read.add(replace(found, cx=found.cx + shift, cy=found.cy + shift))
    if len(read) > 1:
        raise ConfigError(f"{path} has {len(read)} cameras that differ; write each into a file of its own")
    return read.pop()


def _format(tree: Tree) -> "_Format | None":
    """The first of the formats that a tree is of."""
    return next((row for row in _FORMATS if row[1](tree)), None)


class _FaultError(Exception):
    """What is wrong with the content of a file."""


def _check(found: Calibration, model: str) -> Calibration:
    """Validate what all formats have in common; coefficients that are all 0 are none, except those of a fisheye."""
    if min(found.fx, found.fy) <= 0:
        raise _FaultError(f"the focal lengths are {found.fx:g} and {found.fy:g}; allowed: above 0 [px]")
    if max(map(abs, (found.fx, found.fy, found.cx, found.cy, *found.distortion))) > MAX_NUMBER:
        raise _FaultError(f"it has a focal length, centre or coefficient above {MAX_NUMBER:g}; check its numbers")
    if (found.width or found.height) and not (0 < found.width <= MAX_SIDE and 0 < found.height <= MAX_SIDE):
        raise _FaultError(f"the image has {found.width:g} x {found.height:g} pixels; allowed: 1 to {MAX_SIDE}")
    if found.model not in COUNTS:
        raise _FaultError(f"its distortion model is {format_value(found.model)}; allowed: {', '.join(COUNTS)}")
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
    coefficients = _coefficients(tree)
    flag = str(_first(tree, ("fisheye_model", "fisheye"), "")).strip().lower()
    said = FISHEYE if flag in ("1", "true") or str(_first(tree, _MODEL, "")).lower() in ("fisheye", "equidistant") else ""
    said = said or (PINHOLE if flag or len(coefficients) != 4 else model or ("" if any(coefficients) else PINHOLE))
    if not said:
        raise _FaultError('its 4 coefficients may be of both models; set model = "pinhole" or "fisheye"')
    matrix = _four(tree, "fx fy cx cy") if "fx" in tree else _matrix(_first(tree, _MATRIX, None))
    return Calibration(*_size(tree), *matrix, said, _without_tilt(coefficients))


def _ros(tree: Tree, model: str) -> Calibration:
    """Values of ROS's camera_calibration, of a message, or of Kalibr."""
    width, height = _size(tree)
    for key in ("binning_x", "binning_y"):
        if (binning := _number(tree.get(key, 0), key)) > 1:
            raise _FaultError(f"{key} is {binning:g}; give intrinsics of the image as it is, without binning")
    roi = tree.get("roi", {})
    part = tuple(int(_number(roi.get(key, 0), f"roi.{key}")) for key in ("width", "height")) if isinstance(roi, dict) else (0, 0)
    if part not in ((0, 0), (width, height)):
        raise _FaultError(
            f"its region of interest has {part[0]:g} x {part[1]:g} of {width:g} x {height:g} pixels; calibrate the whole image"
        )
    matrix = _numbers(_first(tree, _MATRIX, None), "camera matrix")
    if not any(matrix[:1]):
        raise _FaultError("its camera is not calibrated: K[0] is 0")
    named = str(_first(tree, _MODEL, "")).strip().lower()
    # Files of camera_calibration state 5 columns of the 8 coefficients.
    coefficients = _coefficients(tree, any_size=named == "rational_polynomial")
    if named not in _ROS_MODELS:
        if any(coefficients):
            raise _FaultError(f"its distortion model is {format_value(named)}; allowed: {', '.join(_ROS_MODELS)}")
        return Calibration(width, height, *_matrix(matrix))
    kind, counts = _ROS_MODELS[named]
    if coefficients and len(coefficients) not in counts:
        raise _FaultError(f"{named} has {len(coefficients)} coefficients; allowed: {' or '.join(map(str, counts))}")
    return Calibration(width, height, *_matrix(matrix), kind, _without_tilt(coefficients))


def _kalibr(tree: Tree, model: str) -> Calibration:
    """A camera of Kalibr's camchain.yaml."""
    if tree.get("camera_model") != PINHOLE:
        raise _FaultError(f"its camera model is {format_value(tree.get('camera_model'))}; allowed: {PINHOLE}")
    fx, fy, cx, cy = _exactly(_numbers(tree.get("intrinsics"), "intrinsics"), 4, "intrinsics")
    size = _exactly(_numbers(tree.get("resolution", [0, 0]), "resolution"), 2, "resolution")
    lens = {name: tree.get(name) for name in ("distortion_model", "distortion_coeffs")}
    return _ros({"width": size[0], "height": size[1], "K": [fx, 0, cx, 0, fy, cy, 0, 0, 1], **lens}, model)


def _bop(tree: Tree, model: str) -> Calibration:
    """Values of BOP's camera.json, or of an image in its scene_camera.json; with the distortion that this program adds to them."""
    lens = (str(tree.get("cam_dist_model", PINHOLE)), _numbers(tree.get("cam_dist") or [], "cam_dist"))
    return Calibration(*_size(tree), *(_matrix(tree["cam_K"]) if "cam_K" in tree else _four(tree, "fx fy cx cy")), *lens)


def _open3d(tree: Tree, model: str) -> Calibration:
    columns = _exactly(_numbers(tree["intrinsic_matrix"], "intrinsic_matrix"), 9, "intrinsic_matrix")
    return Calibration(*_size(tree), *_matrix([columns[3 * (index % 3) + index // 3] for index in range(9)]))


def _colmap(tree: Tree, model: str) -> Calibration:
    """A line of COLMAP's cameras.txt."""
    named = str(tree["MODEL"])
    if named not in _COLMAP_MODELS:
        raise _FaultError(f"its model is {format_value(named)}; allowed: {', '.join(_COLMAP_MODELS)}")
    names = _COLMAP_MODELS[named].split()
    values = dict(zip(names, _exactly(_numbers(tree["PARAMS"], "PARAMS"), len(names), "PARAMS"), strict=True))
    fx, fy = (values.get(key, values.get("f", 0.0)) for key in ("fx", "fy"))
    return Calibration(*_size(tree), fx, fy, values["cx"], values["cy"], *_by_name(values, named.endswith("FISHEYE")))


def _nerfstudio(tree: Tree, model: str) -> Calibration:
    """Values of nerfstudio's transforms.json, for all frames or equal in each."""
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2")
    frames = tree.get("frames")
    frames = [frame for frame in frames if isinstance(frame, dict)] if isinstance(frames, list) else []
    sets = {tuple(_number(frame.get(key, tree.get(key, 0)), key) for key in keys) for frame in frames or [tree]}
    if len(sets) > 1:
        raise _FaultError(f"its frames are of {len(sets)} cameras; write the values of one into a file of its own")
    values: Tree = dict(zip(keys, sets.pop(), strict=True))
    named, allowed = str(tree.get("camera_model", "OPENCV")), ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "OPENCV_FISHEYE")
    fisheye = named == "OPENCV_FISHEYE" or tree.get("is_fisheye") is True
    if named not in allowed or (values["k4"] and not fisheye):
        raise _FaultError(
            f"its camera_model is {format_value(named)} with k4 = {values['k4']:g}; allowed: {', '.join(allowed)}, k4 of a fisheye"
        )
    focal = values["fl_x"], values["fl_y"] or values["fl_x"]
    return Calibration(*_size(values), *focal, values["cx"], values["cy"], *_by_name(values, fisheye))


def _by_name(values: Tree, fisheye: bool) -> tuple[str, tuple[float, ...]]:
    """Model and coefficients that have names of their own."""
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    found = tuple(_number(values.get(name, 0.0), name) for name in names)
    return (FISHEYE, found) if fisheye else (PINHOLE, found if any(found[5:]) else found[:5])


def _realsense(tree: Tree, model: str) -> Calibration:
    """Fields of librealsense's rs2_intrinsics, whose models differ from OpenCV's.

    `brown_conrady` and `kannala_brandt4` are OpenCV's. `modified_brown_conrady` shifts points that are scaled already, and so is OpenCV's
    only without tangential coefficients; `inverse_brown_conrady` takes distorted points to undistorted ones.
    """
    plain = Calibration(*_size(tree), *_four(tree, "fx fy ppx ppy"))
    coefficients = _numbers(tree.get("coeffs", []), "coeffs")
    named = str(_first(tree, _MODEL, "none"))
    name = named.strip().lower().rpartition(".")[2].replace(" ", "_").removeprefix("rs2_distortion_")
    name = dict(zip("012345", _RS_MODELS, strict=True)).get(name, name)
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


_MATRIX = ("cameramatrix", "cammatrix", "intrinsicmatrix", "cameraintrinsics", "intrinsics", "mtx", "k")
_DISTORTION = (
    "distortioncoefficients", "distortioncoeffs", "distortion",
    "distcoefficients", "distcoeffs", "distcoeff", "distcoefs", "distcoef", "dist", "d", "coeffs", "coefficients",
)  # fmt: skip
_MODEL = ("distortionmodel", "model", "cameramodel")
"""Names of values, as of `_short`."""
_Format = tuple[str, Callable[[Tree], bool], float, Callable[[Tree, str], Calibration]]
_FORMATS: tuple[_Format, ...] = (
    ("Zivid", lambda tree: "CameraIntrinsics" in tree or {"CameraMatrix", "Distortion"} <= tree.keys(), INTEGERS, _zivid),
    ("RealSense", lambda tree: {"ppx", "ppy"} <= tree.keys(), INTEGERS, _realsense),
    ("COLMAP", lambda tree: {"MODEL", "PARAMS"} <= tree.keys(), HALVES, _colmap),
    ("nerfstudio", lambda tree: "fl_x" in tree or {"camera_angle_x", "frames"} <= tree.keys(), HALVES, _nerfstudio),
    ("Kalibr", lambda tree: {"intrinsics", "camera_model"} <= tree.keys(), INTEGERS, _kalibr),
    ("Open3D", lambda tree: {"intrinsic_matrix", "width", "height"} == tree.keys(), INTEGERS, _open3d),
    ("BOP", lambda tree: bool({"cam_K", "cam_dist", "cam_dist_model"} & tree.keys()), HALVES, _bop),
    ("ROS", lambda tree: bool({"camera_name", "distortion_model", "header"} & tree.keys()) and _has(tree, _MATRIX), INTEGERS, _ros),
    ("OpenCV", lambda tree: _has(tree, _MATRIX), INTEGERS, _opencv),
    ("OpenCV", lambda tree: {"fx", "fy", "cx", "cy"} <= tree.keys() and (_has(tree, _DISTORTION) or "k1" in tree), INTEGERS, _opencv),
    ("BOP", lambda tree: {"fx", "fy", "cx", "cy"} <= tree.keys(), HALVES, _bop),
)
"""Name, test of a file's content, place of the first pixel's centre, and reader of each format; the first whose test passes is taken."""


def _short(name: object) -> str:
    """Name in small letters and digits alone."""
    return "".join(letter for letter in str(name) if letter.isalnum()).lower()


def _has(tree: Tree, names: Sequence[str]) -> bool:
    """Whether there is a value under one of these names."""
    return any(_short(name) in names for name in tree)


def _coefficients(tree: Tree, any_size: bool = False) -> tuple[float, ...]:
    """Distortion coefficients under one of their names, or k1, k2, p1, p2 and so on under their own; none if there are none. Raises
    _FaultError: A name looks like one of coefficients, and is not known."""
    if unknown := [name for name in tree if _short(name).startswith("dist") and _short(name) not in (*_DISTORTION, *_MODEL)]:
        raise _FaultError(f"it has {format_value(unknown[0])}, which is no known name; call coefficients distortion_coefficients")
    if _has(tree, _DISTORTION):
        return _numbers(_first(tree, _DISTORTION, None), "distortion coefficients", any_size)
    # Coefficients with k4 but without p1 may be those of a fisheye model.
    return _by_name(tree, fisheye="k4" in tree and "p1" not in tree)[1] if "k1" in tree else ()


def _first(tree: Tree, names: Sequence[str], default: Any) -> Any:
    """Value of the first of these names that is there."""
    short = {_short(name): value for name, value in tree.items()}
    return next((short[_short(name)] for name in names if _short(name) in short), default)


def _mapping(tree: Any, key: str) -> Tree:
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


def _numbers(value: Any, key: str, any_size: bool = False) -> tuple[float, ...]:
    """Numbers of a matrix: OpenCV's or ROS's mapping with rows, cols and data (whose number need not fit with `any_size`), nested lists, or
    a text with blanks between them."""
    sizes = None
    if isinstance(value, dict):
        sizes = _number(value.get("rows"), f"rows of {key}"), _number(value.get("cols"), f"cols of {key}")
        value = value.get("data")
    items = tuple(_flatten(value.split() if isinstance(value, str) else [] if value is None else value))
    if len(items) > _MAX_NUMBERS or (sizes and not any_size and sizes[0] * sizes[1] != len(items)):
        raise _FaultError(f"{key} has {len(items)} numbers{f' for {sizes[0]:g} x {sizes[1]:g}' if sizes else ''}")
    return tuple(_number(item, key) for item in items)


def _exactly(numbers: tuple[float, ...], count: int, key: str) -> tuple[float, ...]:
    """Numbers, of which there must be `count`."""
    if len(numbers) != count:
        raise _FaultError(f"{key} has {len(numbers)} numbers; allowed: {count}")
    return numbers


def _flatten(value: Any) -> Iterator[Any]:
    """Items of a list, and of lists in it."""
    for item in value if isinstance(value, list | tuple) else [value]:
        yield from item if isinstance(item, list) else [item]


def _size(tree: Tree) -> tuple[int, int]:
    """Width and height of the image; 0, 0 if the file does not say."""
    values = [_number(_first(tree, names, 0), names[1]) for names in (("imagewidth", "width", "w"), ("imageheight", "height", "h"))]
    if any(value != int(value) for value in values):
        raise _FaultError(f"the image has {values[0]:g} x {values[1]:g} pixels; allowed: whole numbers")
    return int(values[0]), int(values[1])


def _matrix(value: Any) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a camera matrix, row by row."""
    numbers = _exactly(_numbers(value, "camera matrix"), 9, "the camera matrix")
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
