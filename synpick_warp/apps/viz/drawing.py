"""Drawing primitives of all figures: text, colours and short labels of instances, picture files."""

import colorsys
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.errors import OutputError
from synpick_warp.exporters.writing.files import write_atomically
from synpick_warp.system.inputs.files import make_folder

FONT = cv2.FONT_HERSHEY_SIMPLEX
GOLDEN = 0.6180339887498949
"""Golden ratio conjugate (√5 - 1) / 2: multiples modulo 1 are a low-discrepancy sequence for any count."""
INK = (40, 40, 40)
WHITE = (255, 255, 255)
_SUFFIXES = (".png", ".jpg", ".jpeg")

_SMALL = 0.44
"""Font scale of a caption (OpenCV)."""
Color = tuple[int, int, int]
"""Blue, green, red."""
Image = np.ndarray
"""(H, W, 3) uint8, blue first, OpenCV's order."""


def check_picture_name(out: Path) -> None:
    """Raise OutputError unless the file name ends as a PNG or JPEG file."""
    if out.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"{out} is not an image file; its name must end in {', '.join(_SUFFIXES)}")


def write_picture(out: Path, picture: Image) -> Path:
    """Write an image in the format of its suffix; its folder is created. Returns the path. Raises OutputError if it cannot be written."""
    try:
        encoded, data = cv2.imencode(out.suffix, picture)
    except cv2.error:
        encoded, data = False, np.empty(0, np.uint8)
    if not encoded:
        raise OutputError(
            f"cannot write {out}: OpenCV cannot encode {picture.shape[1]} x {picture.shape[0]} pixels; use .png or fewer views"
        )
    try:
        make_folder(out.parent)
        if out.is_dir():
            raise OutputError(f"cannot write {out}: it is a folder")
        write_atomically(out, data.tobytes())
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot write {out}: {getattr(error, 'strerror', None) or error}") from error
    return out


def put_text(image: Image, text: str, place: tuple[int, int], size: float, color: Color, thickness: int = 1) -> None:
    """Draw text; `place` is its lower left corner [px], `size` OpenCV's font scale."""
    # Names of folders and texts of records may have characters that cannot be encoded, or that end OpenCV's string.
    shown = "".join(letter if letter.isprintable() else "?" for letter in text)
    cv2.putText(image, shown, place, FONT, size, color, thickness, cv2.LINE_AA)


def text_size(text: str, size: float) -> tuple[int, int]:
    """Width and height of a text [px] at OpenCV's font scale `size`."""
    width, height = cv2.getTextSize(text, FONT, size, 1)[0]
    return width, height


def put_lines(image: Image, lines: Iterable[str], place: tuple[int, int], step: int, size: float, color: Color = INK) -> None:
    """Draw lines of text below each other, at a distance of `step` [px]; `place` is the lower left corner of the first."""
    for number, line in enumerate(lines):
        put_text(image, line, (place[0], place[1] + step * number), size, color)


def shorten(text: str, width: float, size: float) -> str:
    """Cut a text to a width [px] at a font scale."""
    if text_size(text, size)[0] <= width:
        return text
    while text and text_size(f"{text}...", size)[0] > width:
        text = text[: -1 - len(text) // 16]
    return f"{text}..."


def blank(width: int, height: int) -> Image:
    """A white image."""
    return np.full((height, width, 3), 255, np.uint8)


def paste(sheet: Image, picture: Image, column: int, row: int) -> None:
    """Copy a picture into a sheet; `column` and `row` are those of its upper left corner."""
    sheet[row : row + picture.shape[0], column : column + picture.shape[1]] = picture


def stacked(rows: Sequence[Image], gap: int = 0) -> Image:
    """Images below each other, each followed by a gap, on white as wide as the widest."""
    width = max(row.shape[1] for row in rows)
    padded = [cv2.copyMakeBorder(row, 0, gap, 0, width - row.shape[1], cv2.BORDER_CONSTANT, value=WHITE) for row in rows]
    return np.concatenate(padded)


def with_text(picture: Image, lines: Sequence[str], height: int, step: int) -> Image:
    """Picture with lines of small text in a white strip of a height [px] below it."""
    strip = blank(picture.shape[1], height)
    put_lines(strip, lines, (4, step - 2), step, _SMALL)
    return np.concatenate([picture, strip])


def instance_color(instance: int) -> Color:
    """Colour of an instance id, the same in all images of an episode; blue first."""
    red, green, blue = colorsys.hsv_to_rgb(instance * GOLDEN % 1.0, 0.85 - 0.3 * (instance % 2), 1.0)
    return round(255 * blue), round(255 * green), round(255 * red)


def readable_on(color: Color) -> Color:
    """Text colour with contrast to a background (blue first): dark or white by luma."""
    blue, green, red = color
    return INK if 0.114 * blue + 0.587 * green + 0.299 * red > 110 else WHITE


def short_labels(objects: Iterable[tuple[int, int]]) -> dict[int, str]:
    """Short label of each (instance id, obj_id): its obj_id, with letters where several instances share it: 9a, 9b, ..., 9z, 9aa.

    Letters number instance ids, so that an instance has the same in every picture, whichever others are there.
    """
    shown = dict(objects)
    counts = Counter(shown.values())
    return {instance: f"{object_id}{_letters(instance) if counts[object_id] > 1 else ''}" for instance, object_id in shown.items()}


def _letters(place: int) -> str:
    """Letters that number a place: a, b, ..., z, aa, ab, ..."""
    return (_letters(place // 26 - 1) if place >= 26 else "") + chr(ord("a") + place % 26)
