"""HDR environment maps from a folder: Radiance files (.hdr) and sIBL sets (.ibl), or the embedded procedural maps.

Radiance files (Ward, 1991) differ in the first line, comments, the order and presence of FORMAT, and the direction of scanlines, of which
OpenCV reads one variant; the pixels are coded alike.
"""

import configparser
import itertools
import os
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.configs.fields import PATH_RULE
from synpick_warp.errors import LightError
from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.scenes.assets.asset_files import check_file_name, ignore, locate, read_isolated
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.scenes.environment import LUMINANCE, map_directions
from synpick_warp.scenes.types import EnvironmentMap, Sun
from synpick_warp.system.inputs.files import read_file
from synpick_warp.system.linear_algebra import DECIMALS, dot
from synpick_warp.system.processes.isolation import MAX_PIXELS, Limits

READ_LIMITS = Limits(300.0, 2**32)
"""Limits of a map: 5 min and 4 GiB; the largest takes some seconds and 1.2 GB."""
_SUFFIXES = (".hdr", ".exr", ".ibl")
_EXR = b"v/1\x01"
MAX_HEIGHT = 512
"""Maps with more rows are downsampled to this many: 0.35° a texel is finer than any shading here resolves."""
SUN_ROWS = 64
"""Rows of the downsampled map in which a set's sun is verified; 2.8° a texel include the glow about a clipped sun."""
MAX_SUN_OFFSET = 10.0
"""A set's sun is used if the map is bright within this angle of it [°]; positions set by hand are off by some degrees."""
MIN_SUN_BRIGHTNESS = 0.5
"""Threshold of brightness, relative to the map's maximum: 8-bit maps have many maxima, rooms several lamps."""
MAX_SUN_GAIN = 1e6
"""Maximum SUNmulti; no sun outshines its sky by more."""
MAX_MAP_FILE = 2**29
"""Largest image file [bytes]: 512 MiB."""
MAX_SET_FILE, MAX_SET_LINE = 2**16, 2**10
"""Largest .ibl file [bytes] and its longest line; the parser's time grows with the square of a line."""
MAX_RADIANCE = 1e11
"""Maximum radiance: that of the sun is 2e9 cd/m². Kernels keep products of three radiances as 32-bit floats, which end at 3e38."""
MAX_GAMMA = 100.0
"""Maximum REFgamma; displays have 2.2."""
MIN_RADIANCE = 1e-6
"""Least radiance that a map's brightest texel must have: the automatic exposure divides by the radiance of white, at least 1e-9."""
_MAX_HEADER = 2**16
"""Longest header of a Radiance file [bytes]."""
_RESOLUTION = re.compile(rb"([-+])([XY])\s+(\d{1,9})\s+([-+])([XY])\s+(\d{1,9})\s*")
_RGBE, _XYZE = b"32-bit_rle_rgbe", b"32-bit_rle_xyze"


def load_lights(folder: str, report: Callable[[str], None] = ignore, strict: bool = False) -> tuple[EnvironmentMap, ...]:
    """Load all environment maps of a folder and its direct subfolders, sorted by name.

    A folder with an .ibl file is an sIBL set (hdrlabs.com/sibl), of which the reflection map and the sun are used. In other folders every
    .hdr file is a map. The image's middle column becomes azimuth 0 (+x); columns right of it, as seen from inside, get negative azimuth.
    Maps are read in isolated processes; those that cannot be used are left out with a line each. `folder`: the folder; empty: the embedded
    maps. `strict`: whether the first map that cannot be used is an error.

    Raises LightError: the folder does not exist or contains no map that can be used, two have the same name, or time or memory of this
    machine does not suffice for one."""
    if not folder:
        return skies()
    root = Path(folder)
    if not root.is_dir():
        raise LightError(
            f"lights folder {folder} does not exist; give a folder with .hdr maps or sIBL sets, or none for the embedded maps; {PATH_RULE}"
        )
    try:
        folders = [root, *sorted(path for path in root.iterdir() if path.is_dir())]
        files = [path for each in folders for path in _list_maps(each)]
    except OSError as error:
        raise LightError(f"lights folder {folder} cannot be read: {error.strerror}; check its permissions") from error
    if not files:
        raise LightError(f"lights folder {folder} contains no environment map; add .hdr files or sIBL sets (.ibl with its maps)")
    maps, faults = [], []
    calls, smaller = [(path, strict, MAX_HEIGHT) for path in files], "scale the map down, or remove it"
    for result in read_isolated(_load_map, calls, READ_LIMITS, LightError, smaller, "replace it"):
        if isinstance(result, LightError):
            faults.append(result)
            if strict:
                raise result
            continue
        maps.append(result[0])
        for line in result[1]:
            report(line)
    if not maps:
        if len(faults) == 1:
            raise faults[0]
        raise LightError(f"lights folder {folder}: none of its {len(faults)} maps can be used; the first: {faults[0]}")
    for fault in faults:
        report(f"left out: {fault}")
    maps.sort(key=lambda light: light.name)
    for first, second in itertools.pairwise(maps):
        if first.name == second.name:  # The name is all that a data set says of a view's map.
            raise LightError(f"lights folder {folder}: two maps have the name {first.name}; rename one of them")
    return tuple(maps)


def _list_maps(folder: Path) -> list[Path]:
    """The maps directly in a folder: its sIBL sets, or if there are none its image files."""
    files = sorted(path for path in folder.iterdir() if not path.is_dir() and path.suffix.lower() in _SUFFIXES)
    return [path for path in files if path.suffix.lower() == ".ibl"] or files


def _load_map(path: Path, strict: bool, max_height: int) -> tuple[EnvironmentMap, list[str]]:
    """Load the map of an image file or an sIBL set, with at most `max_height` rows, and lines on what is missing."""
    check_file_name(path, LightError)
    lines: list[str] = []
    if path.suffix.lower() == ".ibl":
        return _read_set(path, strict, max_height, lines), lines
    return EnvironmentMap(path.stem, _validate(_read_image(path, gamma=1.0), path, max_height)), lines


def _read_set(path: Path, strict: bool, max_height: int, lines: list[str]) -> EnvironmentMap:
    """Read the reflection map of an sIBL set, times its REFmulti, and its sun. Set files are INI, with comments that begin with two dashes.

    The reflection map is used for diffuse light and background, too: the set's environment map is a blurred copy of it. If one of those
    that are not used is missing, that is a line, or an error if `strict`.
    """
    parser = configparser.ConfigParser(interpolation=None, strict=False, comment_prefixes=("#", ";", "--", "//"))
    text = read_file(path, MAX_SET_FILE, LightError).decode("utf-8-sig", errors="replace")
    if max(map(len, text.splitlines()), default=0) > MAX_SET_LINE:
        raise LightError(f"{path} is not an sIBL set file: a line is longer than {MAX_SET_LINE} characters; it must be INI text")
    try:
        parser.read_string(text)
    except Exception as error:  # besides its own errors, the parser raises AttributeError on some lines
        raise LightError(f"{path} is not an sIBL set file: {str(error).splitlines()[0]}; it must be INI text") from error
    # The format spells it "Enviroment".
    for section, key in (("Background", "BGfile"), ("Enviroment", "EVfile"), ("Reflection", "REFfile")):
        file = _text(parser, section, key)
        if file and not os.path.lexists(locate(path.parent, file, path, LightError)):
            fault = f"{path} names {key} = {file}, but there is no such file beside it"
            if strict or key == "REFfile":
                raise LightError(f"{fault}; add it")
            lines.append(f"{fault}; it is not used")
    file = _text(parser, "Reflection", "REFfile")
    if not file:
        raise LightError(f"{path} names no reflection map; it needs REFfile in [Reflection]")
    if _number(parser, path, "REFmap", 1.0) != 1.0:
        raise LightError(f"{path} has REFmap = {_text(parser, 'Reflection', 'REFmap')}; only 1, a spherical map, can be read")
    gain = _number(parser, path, "REFmulti", 1.0)
    map_file = locate(path.parent, file, path, LightError)
    image = _read_image(map_file, gamma=_number(parser, path, "REFgamma", 1.0, MAX_GAMMA))
    with np.errstate(over="ignore"):  # infinite values are refused by _validate
        image = image * np.float32(gain)
    sun = _read_sun(parser, path)
    radiance = _validate(image, map_file, max_height)
    return EnvironmentMap(path.stem, radiance, sun if sun is not None and _is_bright(radiance, sun.direction) else None)


def _read_sun(parser: configparser.ConfigParser, path: Path) -> Sun | None:
    """Read the section Sun of an sIBL set; None if it has no position, is black, or lies below the horizon.

    SUNu and SUNv are image coordinates from 0 to 1, to the right and downward, so that SUNv = 0 is the zenith. SUNcolor is sRGB in
    0..255. A white diffuse surface that faces the sun has radiance SUNmulti times this colour, linear: the irradiance is π times that,
    in the units of the map after REFmulti.
    """
    u, v = (_sun_numbers(parser, path, key, 1, 1.0) for key in ("SUNu", "SUNv"))
    color = _sun_numbers(parser, path, "SUNcolor", 3, 255.0)
    gain = _sun_numbers(parser, path, "SUNmulti", 1, MAX_SUN_GAIN)
    if (u is None) != (v is None):
        raise LightError(f"{path} has {'SUNv' if u is None else 'SUNu'} alone; a sun needs SUNu and SUNv, or neither")
    if u is None or v is None:
        return None
    azimuth, polar = (0.5 - u[0]) * 2 * np.pi, v[0] * np.pi
    direction = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]).round(DECIMALS)
    linear = np.ones(3) if color is None else srgb_to_linear(color / 255.0)
    irradiance = np.pi * (1.0 if gain is None else gain[0]) * linear
    return Sun(direction, irradiance) if v[0] < 0.5 and float(dot(irradiance, LUMINANCE)) >= MIN_RADIANCE else None


def _sun_numbers(parser: configparser.ConfigParser, path: Path, key: str, count: int, high: float) -> np.ndarray | None:
    """Parse the numbers (count) of a key in the section Sun, each in 0..high; None if the key is missing."""
    text = _text(parser, "Sun", key)
    if not text:
        return None
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not ((values >= 0.0) & (values <= high)).all():
        wanted = "a number" if count == 1 else f"{count} numbers, with commas between them,"
        raise LightError(f"{path} has {key} = {text}; it must be {wanted} from 0 to {high:g}")
    return values


def _is_bright(radiance: np.ndarray, direction: np.ndarray) -> bool:
    """Whether a map is bright near a direction, so that the sun there is plausible.

    Otherwise the set's sun is ignored and the map's brightest place is used: shadows must agree with reflections; in some sets v points up.
    """
    height = min(radiance.shape[0], SUN_ROWS)
    bright = cv2.resize(radiance, (2 * height, height), interpolation=cv2.INTER_AREA).sum(axis=2)
    cosine = dot(map_directions(height)[0], direction)
    # In coarse maps even the nearest texel may lie farther away than the angle.
    near = cosine >= min(np.cos(np.radians(MAX_SUN_OFFSET)).round(DECIMALS), cosine.max())
    return bool(bright[near].max() >= MIN_SUN_BRIGHTNESS * bright.max())


def _text(parser: configparser.ConfigParser, section: str, key: str) -> str:
    """Value of a key as one line; values may span several in the format."""
    text = " ".join(parser.get(section, key, fallback="").split()).strip('"')
    return text if text.isprintable() else ascii(text)[1:-1]


def _number(parser: configparser.ConfigParser, path: Path, key: str, default: float, high: float = float("inf")) -> float:
    """Parse a positive number up to `high` in the section Reflection."""
    text = _text(parser, "Reflection", key)
    if not text:
        return default
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not (0 < value < float("inf")) or value > high:
        limit = "" if high == float("inf") else f" up to {high:g}"
        raise LightError(f"{path} has {key} = {text}; it must be a positive number{limit}")
    return value


def _read_image(path: Path, gamma: float) -> np.ndarray:
    """Read an image as linear RGB (H, W, 3) float32, in its own orientation.

    Gamma is applied to 8-bit and 16-bit images only: Radiance files are linear by their format, although published sets name a gamma
    for them, as a hint for renderers that do not work in linear light.
    """
    image = _decode(path)
    if image is None:
        raise LightError(f"{path} cannot be read as an image: it is empty, cut short or of another format; replace it")
    if image.ndim != 3 or image.shape[2] < 3:
        raise LightError(f"{path} is not a colour image; an environment map needs red, green and blue")
    if image.dtype in (np.uint8, np.uint16):
        levels = np.linspace(0.0, 1.0, 256 if image.dtype == np.uint8 else 65536) ** gamma
        return levels.astype(np.float32)[image[..., 2::-1]]
    return image[..., 2::-1].astype(np.float32)


def _decode(path: Path) -> np.ndarray | None:
    """Decode an image in OpenCV's channel order; None if it cannot be read. OpenCV's own messages are suppressed. Raises LightError: it is
    too large, or of a format that is known but not read."""
    data = read_file(path, MAX_MAP_FILE, LightError)
    if data.startswith(_EXR) or path.suffix.lower() == ".exr":
        raise LightError(f"{path}: OpenEXR maps are not read; save it as Radiance (.hdr)")
    orient: Callable[[np.ndarray], np.ndarray] = np.asarray
    if data[:2] == b"#?":
        found = _canonical_radiance(data, path)
        if found is None:
            return None
        data, orient = found
    logging = cv2.utils.logging
    level = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:
        if "MAX_IMAGE_PIXELS" in str(error):
            size = f"{MAX_PIXELS} pixels; allowed: up to 8192 x 4096"
            raise LightError(f"{path} has more than {size}; scale it down, {MAX_HEIGHT} rows are used") from None
        return None
    finally:
        logging.setLogLevel(level)
    return None if image is None else orient(image)


def _validate(image: np.ndarray, path: Path, max_height: int) -> np.ndarray:
    """Radiance of an image file, validated, limited in resolution, and in this project's orientation."""
    height, width = image.shape[:2]
    if width != 2 * height:
        raise LightError(f"{path} is {width} x {height} pixels; an equirectangular map must be twice as wide as high")
    if not np.isfinite(image).all():
        raise LightError(f"{path} has radiance that is infinite or not a number; replace the map")
    if image.min() < 0:
        raise LightError(f"{path} has negative radiance ({image.min():g}); replace the map")
    if image.max() > MAX_RADIANCE:
        raise LightError(f"{path} has radiance {image.max():g}; allowed: up to {MAX_RADIANCE:g}; scale the map down")
    if image.max() < MIN_RADIANCE:
        raise LightError(f"{path} is black: no radiance above {MIN_RADIANCE:g}; an environment map must contain some light")
    _check_rows(image, path)
    if height > max_height:
        image = cv2.resize(image, (2 * max_height, max_height), interpolation=cv2.INTER_AREA)
    # Columns run clockwise as seen from above, azimuth counter-clockwise.
    return np.ascontiguousarray(image[:, ::-1], dtype=np.float32)


def _check_rows(image: np.ndarray, path: Path) -> None:
    """Refuse a map that was cut short and filled up: rows of zeros, where no other texel is black.

    A sky that ends at the horizon has black rows, too, all those below it.
    """
    black = (image == 0.0).all(axis=2)
    rows = np.flatnonzero(np.all(black, axis=1))
    if len(rows) and black.sum() == len(rows) * image.shape[1] and abs(len(rows) - image.shape[0] / 2) > 1:
        raise LightError(
            f"{path}: {len(rows)} of {image.shape[0]} rows are black, from row {rows[0]} on, while no other texel is: it was cut short; "
            "replace it"
        )


def _canonical_radiance(data: bytes, path: Path) -> tuple[bytes, Callable[[np.ndarray], np.ndarray]] | None:
    """Rewrite the header of a Radiance file: magic, FORMAT, scanlines from the top, from left to right. Returns the file with another
    header, and what turns its image as the header said, and divides by its exposure. None: it has no such header. Raises LightError: the
    colours are not RGB."""
    lines, at = [], 0
    while (end := data.find(b"\n", at, _MAX_HEADER)) >= 0:
        line = data[at:end].rstrip(b"\r")
        at = end + 1
        match = _RESOLUTION.fullmatch(line)
        if match is not None:
            break
        lines.append(line)
    else:
        return None
    first_sign, first, first_size, second_sign, second, second_size = match.groups()
    if first == second:
        return None
    kinds = [line.partition(b"=")[2].strip().lower() for line in lines if line.upper().startswith(b"FORMAT=")]
    if _XYZE in kinds:
        raise LightError(f"{path} has XYZ colours (32-bit_rle_xyze), which are not read; convert it to RGB")
    if kinds and kinds[-1] != _RGBE:
        return None
    signs, exposure = {first: first_sign, second: second_sign}, _exposure(lines)

    def orient(image: np.ndarray) -> np.ndarray:
        """Turn the image to rows from the top and columns from the left, and divide by the exposure."""
        image = image.swapaxes(0, 1) if first == b"X" else image
        image = image[:: -1 if signs[b"Y"] == b"+" else 1, :: -1 if signs[b"X"] == b"-" else 1]
        return image if exposure == 1.0 else image / np.float32(exposure)

    return b"#?RADIANCE\nFORMAT=%s\n\n-Y %d +X %d\n" % (_RGBE, int(first_size), int(second_size)) + data[at:], orient


def _exposure(lines: list[bytes]) -> float:
    """Product of all EXPOSURE lines; those that are no positive number count as 1."""
    exposure = 1.0
    for line in lines:
        if line.upper().startswith(b"EXPOSURE="):
            try:
                value = float(line[9:])
            except ValueError:
                continue
            if 0.0 < value < float("inf"):
                exposure *= value
    return exposure if 0.0 < exposure < float("inf") else 1.0
