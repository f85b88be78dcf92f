"""Light maps from a folder: Radiance maps (.hdr) and sIBL sets (.ibl), or the embedded skies."""

from __future__ import annotations

import configparser
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.errors import LightError
from synpick_warp.scenes.shapes import LightMap
from synpick_warp.scenes.skies import skies

MAX_HEIGHT = 512
"""Maps with more rows are reduced to this many: half the map's 0.35° is finer than any shading here resolves."""


def load_lights(folder: str) -> tuple[LightMap, ...]:
    """All light maps of a folder and its direct subfolders, sorted by name.

    A folder that holds an .ibl file is an sIBL set (hdrlabs.com/sibl): its reflection map counts and its other maps do not.
    In other folders every .hdr file is a map. A picture's middle column becomes azimuth 0 (+x), and what lies right of
    it for someone who stands inside lies at negative azimuth.

    Args:
        folder: The folder; empty for the embedded skies.

    Raises:
        LightError: There is no such folder or no map in it; a map cannot be read or is no light map; a set names a missing file.
    """
    if not folder:
        return skies()
    root = Path(folder)
    if not root.is_dir():
        raise LightError(
            f"lights folder {folder} does not exist; give a folder with .hdr maps or sIBL sets, or none for the embedded skies"
        )
    try:
        places = [root, *sorted(path for path in root.iterdir() if path.is_dir())]
        maps = [light for place in places for light in _read_place(place)]
    except OSError as error:
        raise LightError(f"lights folder {folder} cannot be read: {error.strerror}; check its permissions") from error
    if not maps:
        raise LightError(f"lights folder {folder} holds no light map; put .hdr files or sIBL sets (.ibl with its maps) into it")
    return tuple(sorted(maps, key=lambda light: light.name))


def _read_place(place: Path) -> list[LightMap]:
    """The maps that lie directly in a folder."""
    files = sorted(path for path in place.iterdir() if path.is_file())
    sets = [path for path in files if path.suffix.lower() == ".ibl"]
    if sets:
        return [_read_set(path) for path in sets]
    return [LightMap(path.stem, _finish(_read_image(path, gamma=1.0), path)) for path in files if path.suffix.lower() == ".hdr"]


def _read_set(path: Path) -> LightMap:
    """The reflection map of an sIBL set, times its REFmulti. Set files are INI; notes in them begin with two dashes."""
    parser = configparser.ConfigParser(interpolation=None, strict=False, comment_prefixes=("#", ";", "--", "//"))
    try:
        parser.read_string(path.read_text(encoding="utf-8-sig", errors="replace"))
    except configparser.Error as error:
        raise LightError(f"{path} is no sIBL set file: {str(error).splitlines()[0]}; it must be INI text") from error
    # The format spells it "Enviroment".
    for section, key in (("Enviroment", "EVfile"), ("Reflection", "REFfile")):
        file = _text(parser, section, key)
        if file and not (path.parent / file).is_file():
            raise LightError(f"{path} names {key} = {file}, which is not beside it; add the file")
    file = _text(parser, "Reflection", "REFfile")
    if not file:
        raise LightError(f"{path} names no reflection map; it needs REFfile in [Reflection]")
    if _number(parser, path, "REFmap", 1.0) != 1.0:
        raise LightError(f"{path} has REFmap = {_text(parser, 'Reflection', 'REFmap')}; only 1, a spherical map, can be read")
    gain = _number(parser, path, "REFmulti", 1.0)
    picture = path.parent / file
    image = _read_image(picture, gamma=_number(parser, path, "REFgamma", 1.0))
    with np.errstate(over="ignore"):  # what becomes infinite is refused with the rest
        image = image * np.float32(gain)
    return LightMap(path.stem, _finish(image, picture))


def _text(parser: configparser.ConfigParser, section: str, key: str) -> str:
    return parser.get(section, key, fallback="").strip().strip('"')


def _number(parser: configparser.ConfigParser, path: Path, key: str, default: float) -> float:
    """A positive number of the section Reflection."""
    text = _text(parser, "Reflection", key)
    if not text:
        return default
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not (0 < value < float("inf")):
        raise LightError(f"{path} has {key} = {text}; it must be a positive number")
    return value


def _read_image(path: Path, gamma: float) -> np.ndarray:
    """Linear RGB (H, W, 3) float32, as the picture shows it.

    Radiance maps are linear by their format; published sets nevertheless name a gamma for them, as a hint for renderers
    that do not work in linear light, so it is applied to pictures of 8 or 16 bits alone.
    """
    image = _decode(path)
    if image is None:
        raise LightError(f"{path} cannot be read as an image: it is empty, cut short or of another format; replace it")
    if image.ndim != 3 or image.shape[2] < 3:
        raise LightError(f"{path} is no colour image; a light map needs red, green and blue")
    linear = image[..., 2::-1].astype(np.float32)
    if image.dtype in (np.uint8, np.uint16):
        linear = (linear / np.float32(255 if image.dtype == np.uint8 else 65535)) ** np.float32(gamma)
    return linear


def _decode(path: Path) -> np.ndarray | None:
    """The picture as stored, channels as OpenCV has them; None if it cannot be read. OpenCV's own messages are kept quiet."""
    if not path.stat().st_size:
        return None
    logging = cv2.utils.logging
    level = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        return cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_ANYDEPTH)
    except cv2.error:
        return None
    finally:
        logging.setLogLevel(level)


def _finish(image: np.ndarray, path: Path) -> np.ndarray:
    """Check radiance, reduce it, and turn it to this project's convention."""
    height, width = image.shape[:2]
    if width != 2 * height:
        raise LightError(f"{path} is {width} x {height} pixels; an equirectangular map is twice as wide as high")
    if not np.isfinite(image).all():
        raise LightError(f"{path} has radiance that is infinite or not a number; replace the map")
    if image.min() < 0:
        raise LightError(f"{path} has negative radiance ({image.min():g}); replace the map")
    if image.max() <= 0:
        raise LightError(f"{path} is black all over; a light map must hold some light")
    if height > MAX_HEIGHT:
        image = cv2.resize(image, (2 * MAX_HEIGHT, MAX_HEIGHT), interpolation=cv2.INTER_AREA)
    # Seen from inside, right is clockwise from above, against the azimuth.
    return np.ascontiguousarray(image[:, ::-1], dtype=np.float32)
