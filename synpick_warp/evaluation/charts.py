"""Line charts as RGB images: stacked panels with axes, ticks, legend, lines, bars and marks (OpenCV for shapes, Pillow for text).

Drawn for a column of a paper: at a width of 3.5 inches the text has some 7 points. Shapes are drawn at twice the size with anti-aliasing
and reduced, so that lines have fractions of pixels; text is set at the final size.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from synpick_warp.errors import OutputError
from synpick_warp.exporters.writing.files import output_error, write_atomically
from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.system.folders import make_folder

Color = tuple[int, int, int]
"""Red, green, blue."""
Image = np.ndarray
"""(H, W, 3) uint8, red first."""
WIDTH = 1400
"""Width of a chart [px]."""
_TEXT = 34
"""Font size [px]."""
_LEFT, _RIGHT, _BOTTOM, _GAP = 158, 40, 112, 34
"""Margins of the panels, and gap between two [px]; the left one has the y axis' numbers and label."""
_LEGEND_LINE, _SWATCH = 50, 64
"""Height of a line of the legend, and width of an entry's sample [px]."""
_TICK = 10
"""Length of a tick [px]."""
_SUPER = 2
"""Supersampling of shapes."""
_SHIFT = 4
"""Fractional bits of OpenCV's fixed-point coordinates."""
_FAR = 20_000.0
"""Limit of coordinates [px]: what lies outside a panel is clipped, and must fit OpenCV's integers."""
_MAX_LABEL = 36
"""Maximum number of letters of a legend entry."""
_LINE = 2.5
"""Width of a line [px]."""
_DOT = 2.5
"""Radius of a dot relative to the line's width."""
_RING, _RING_LINE = 15, 3
"""Radius of a ring around a point, and width of its line [px]."""
_EVENT_ROW, _EVENT = 12.0, 8.0
"""Distance of the discs of events from the upper edge, and their radius [px]."""
_BAR_GAP = 6
"""Distance of a bar from the edges of its bin [supersampled px]."""
INK, SOFT, GRID = (30, 30, 30), (110, 110, 110), (226, 226, 226)
PALETTE: tuple[Color, ...] = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233))
"""Colours that colour-blind readers tell apart (Okabe and Ito, 2008)."""

Place = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Maps x and y (n,) to pixels of a panel (n, 2)."""


@dataclass(frozen=True)
class Axis:
    """Range, scale and label of an axis."""

    label: str
    low: float
    high: float
    log: bool = False
    ticks: tuple[tuple[float, str], ...] | None = None
    """Values and their texts; None: multiples of 1, 2 or 5 times a power of ten."""

    def fraction(self, values: np.ndarray) -> np.ndarray:
        """Position of values between the ends of the axis; 0 to 1 inside."""
        values = np.asarray(values, np.float64)
        if self.log:
            return np.log(values / self.low) / math.log(self.high / self.low)
        return (values - self.low) / (self.high - self.low)

    def labelled_ticks(self, count: int) -> tuple[tuple[float, str], ...]:
        """Given ticks, or at most about `count` round values."""
        if self.ticks is not None:
            return self.ticks
        raw = (self.high - self.low) / count
        power = 10.0 ** math.floor(math.log10(raw))
        step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))
        digits = max(0, -math.floor(math.log10(step) + 1e-9))
        first, last = math.ceil(self.low / step - 1e-6), math.floor(self.high / step + 1e-6)
        return tuple((number * step, f"{number * step + 0.0:.{digits}f}") for number in range(first, last + 1))


@dataclass(frozen=True)
class Line:
    """Polyline; NaN breaks it, and a single point between two breaks is a dot."""

    x: np.ndarray
    y: np.ndarray
    color: Color
    width: float = _LINE
    """[px]"""
    dots: bool = False
    """Whether each point is marked."""

    def draw(self, canvas: Image, place: Place) -> None:
        points = place(self.x, self.y)
        thickness = max(1, round(_SUPER * self.width))
        known = np.asarray(np.isfinite(points).all(axis=1))
        for run in np.split(np.arange(len(points)), 1 + np.flatnonzero(known[1:] != known[:-1])):
            if not len(run) or not known[run[0]]:
                continue
            cv2.polylines(canvas, [_fixed(points[run])], False, self.color, thickness, cv2.LINE_AA, _SHIFT)
            for point in points[run] if self.dots else points[run[:1]] if len(run) == 1 else ():
                _disc(canvas, point, _SUPER * (_DOT * self.width if self.dots else self.width), self.color)


@dataclass(frozen=True)
class Bars:
    """Histogram: bars from 0 between edges."""

    edges: np.ndarray
    heights: np.ndarray
    color: Color

    def draw(self, canvas: Image, place: Place) -> None:
        for left, right, height in zip(self.edges[:-1], self.edges[1:], self.heights, strict=True):
            first, second = np.rint(place(np.array([left, right]), np.array([0.0, height]))).astype(int)
            cv2.rectangle(canvas, (int(first[0]) + _BAR_GAP, int(second[1])), (int(second[0]) - _BAR_GAP, int(first[1])), self.color, -1)


@dataclass(frozen=True)
class Rings:
    """Circles around points, to mark optima."""

    x: np.ndarray
    y: np.ndarray
    color: Color

    def draw(self, canvas: Image, place: Place) -> None:
        for point in _fixed(place(self.x, self.y)):
            cv2.circle(canvas, point.tolist(), (_SUPER * _RING) << _SHIFT, self.color, _RING_LINE * _SUPER, cv2.LINE_AA, _SHIFT)


@dataclass(frozen=True)
class Events:
    """Vertical lines at points of time, or discs at the upper end of the panel."""

    x: np.ndarray
    color: Color
    discs: bool = False

    def draw(self, canvas: Image, place: Place) -> None:
        pale = tuple(255 - (255 - part) // 3 for part in self.color)
        for x in place(self.x, np.zeros(len(self.x)))[:, 0]:
            if self.discs:
                _disc(canvas, np.array([x, _EVENT_ROW * _SUPER]), _EVENT * _SUPER, self.color)
            else:
                ends = np.array([[x, 0.0], [x, len(canvas)]])
                cv2.polylines(canvas, [_fixed(ends)], False, pale, _SUPER, cv2.LINE_AA, _SHIFT)


Mark = Line | Bars | Rings | Events


@dataclass(frozen=True)
class Panel:
    """Coordinate system with marks, which are drawn in their order."""

    y: Axis
    marks: Sequence[Mark]
    height: int = 560
    """[px]"""
    grid: bool = True


@dataclass(frozen=True)
class Entry:
    """Legend entry: name and a sample, which is a line, a thin line, or a disc."""

    name: str
    color: Color
    thin: bool = False
    disc: bool = False


def draw_chart(x: Axis, panels: Sequence[Panel], legend: Sequence[Entry]) -> Image:
    """Draw panels above each other with a common x axis, and a legend above them.

    Returns:
        RGB image (H, WIDTH, 3) uint8.
    """
    entries, head = _place_legend(legend)
    height = head + sum(panel.height for panel in panels) + _GAP * (len(panels) - 1) + _BOTTOM
    shapes = np.full((_SUPER * height, _SUPER * WIDTH, 3), 255, np.uint8)
    texts: list[_Text] = []
    top = head
    for number, panel in enumerate(panels):
        _draw_panel(shapes, texts, x, panel, top, number == len(panels) - 1)
        top += panel.height + _GAP
    for left, base, entry in entries:
        ends = _SUPER * np.array([[left, base], [left + _SWATCH - 16, base]], np.float64)
        if entry.disc:
            _disc(shapes, ends.mean(axis=0), 9.0 * _SUPER, entry.color)
        else:
            cv2.polylines(shapes, [_fixed(ends)], False, entry.color, (2 if entry.thin else 6) * _SUPER, cv2.LINE_AA, _SHIFT)
        texts.append(_Text(printable(entry.name), left + _SWATCH, base, "lm", INK))
    picture = PillowImage.fromarray(cv2.resize(shapes, (WIDTH, height), interpolation=cv2.INTER_AREA))
    for text in texts:
        text.draw(picture)
    return np.asarray(picture)


def write_chart(out: Path, picture: Image) -> Path:
    """Write a chart as a PNG file; its folder is created.

    Raises:
        OutputError: The name does not end in .png, or the file cannot be written.
    """
    if out.suffix.lower() != ".png":
        raise OutputError(f"{out} is not a PNG file; its name must end in .png")
    try:
        make_folder(out.parent)
        write_atomically(out, encode_png(picture))
    except OSError as error:
        raise output_error(out, error) from error
    except ValueError as error:
        raise OutputError(f"cannot write {str(out)!r}: {error}; choose another name") from error
    return out


def _draw_panel(shapes: Image, texts: list[_Text], x: Axis, panel: Panel, top: int, lowest: bool) -> None:
    """Draw a panel's grid, marks, frame and ticks; the x axis' texts only below the lowest."""
    right, bottom = WIDTH - _RIGHT, top + panel.height
    inside = np.ascontiguousarray(shapes[_SUPER * top : _SUPER * bottom, _SUPER * _LEFT : _SUPER * right])
    size = np.array([inside.shape[1], inside.shape[0]], np.float64)

    def place(horizontal: np.ndarray, vertical: np.ndarray) -> np.ndarray:
        fraction = np.stack((x.fraction(horizontal), 1.0 - panel.y.fraction(vertical)), axis=1)
        return np.clip(fraction * size, -_FAR, _FAR)

    columns = [(_LEFT + float(x.fraction(np.array(value))) * (right - _LEFT), text) for value, text in x.labelled_ticks(8)]
    rows = [
        (bottom - float(panel.y.fraction(np.array(value))) * panel.height, text)
        for value, text in panel.y.labelled_ticks(max(2, panel.height // 64))
    ]
    if panel.grid:
        for column, _ in columns:
            _straight(inside, (column - _LEFT, 0), (column - _LEFT, panel.height), GRID)
        for row, _ in rows:
            _straight(inside, (0, row - top), (right - _LEFT, row - top), GRID)
    for mark in panel.marks:
        mark.draw(inside, place)
    shapes[_SUPER * top : _SUPER * bottom, _SUPER * _LEFT : _SUPER * right] = inside
    cv2.rectangle(shapes, (_SUPER * _LEFT, _SUPER * top), (_SUPER * right, _SUPER * bottom), INK, _SUPER)
    for row, text in rows:
        _straight(shapes, (_LEFT - _TICK, row), (_LEFT, row), INK)
        texts.append(_Text(text, _LEFT - _TICK - 6, row, "rm", INK))
    texts.append(_Text(panel.y.label, 6, (top + bottom) / 2, "lm", INK, turned=True))
    free = -math.inf
    for column, text in columns:
        _straight(shapes, (column, bottom), (column, bottom + _TICK), INK)
        half = _font().getlength(text) / 2
        if lowest and column - half > free:
            texts.append(_Text(text, column, bottom + _TICK + 4, "ma", INK))
            free = column + half + 12
    if lowest:
        texts.append(_Text(x.label, (_LEFT + right) / 2, bottom + _BOTTOM - 8, "ms", INK))


def _place_legend(legend: Sequence[Entry]) -> tuple[list[tuple[int, int, Entry]], int]:
    """Place entries in lines of the panels' width: left end and middle height [px]; and the height above the panels [px]."""
    entries, left, base = [], _LEFT, 34
    for entry in legend:
        width = _SWATCH + math.ceil(_font().getlength(printable(entry.name))) + 36
        if left > _LEFT and left + width > WIDTH:
            left, base = _LEFT, base + _LEGEND_LINE
        entries.append((left, base, entry))
        left += width
    return entries, base + 38 if entries else 30


def printable(text: str) -> str:
    """One line of text with letters that the font has, "?" for others, shortened in the middle."""
    shown = "".join(letter if letter.isprintable() and ord(letter) < 256 else "?" for letter in text)
    return shown if len(shown) <= _MAX_LABEL else f"{shown[: _MAX_LABEL // 2 - 2]}...{shown[-(_MAX_LABEL // 2 - 1) :]}"


@dataclass(frozen=True)
class _Text:
    text: str
    x: float
    y: float
    anchor: str
    """Pillow's: horizontal l, m, r; vertical a (ascender), m (middle), s (baseline)."""
    color: Color
    turned: bool = False
    """Read from bottom to top; `x` is the left edge then, `y` the middle."""

    def draw(self, picture: PillowImage.Image) -> None:
        if not self.turned:
            ImageDraw.Draw(picture).text((self.x, self.y), self.text, fill=self.color, font=_font(), anchor=self.anchor)
            return
        width, height = math.ceil(_font().getlength(self.text)) + 4, _TEXT + 12
        strip = PillowImage.new("RGB", (width, height), "white")
        ImageDraw.Draw(strip).text((2, height / 2), self.text, fill=self.color, font=_font(), anchor="lm")
        picture.paste(strip.rotate(90, expand=True), (round(self.x), round(self.y - width / 2)))


@functools.cache
def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own font (Aileron), so that charts are the same on every machine."""
    return ImageFont.load_default(_TEXT)


def _fixed(points: np.ndarray) -> np.ndarray:
    """OpenCV's fixed-point coordinates of points (n, 2)."""
    return np.rint(points * (1 << _SHIFT)).astype(np.int32)


def _disc(canvas: Image, point: np.ndarray, radius: float, color: Color) -> None:
    """Filled circle with a thin white rim."""
    centre = _fixed(point).tolist()
    cv2.circle(canvas, centre, round((radius + _SUPER) * (1 << _SHIFT)), (255, 255, 255), -1, cv2.LINE_AA, _SHIFT)
    cv2.circle(canvas, centre, round(radius * (1 << _SHIFT)), color, -1, cv2.LINE_AA, _SHIFT)


def _straight(canvas: Image, start: tuple[float, float], end: tuple[float, float], color: Color) -> None:
    """Thin line between points in final pixels."""
    cv2.polylines(canvas, [_fixed(_SUPER * np.array([start, end], np.float64))], False, color, _SUPER, cv2.LINE_AA, _SHIFT)
