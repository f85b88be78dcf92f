"""Panels of an attempt's figure: explanation in sentences, table of objects, plot of the seal force over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from synpick_warp.configs.schema import Config
from synpick_warp.viz.drawing import FONT, INK, Image, instance_color, put_text
from synpick_warp.viz.explain_graph import GREY, RED, disc, fixed
from synpick_warp.viz.explain_record import Attempt, break_force, choice_words, labels, seal_words, suction_kind

WORDS_WIDTH = 470
"""Width of the text and the table [px]."""
PLOT_HEIGHT = 190
_MAX_PLOT_HEIGHT = 260
"""Minimum and maximum height of the plot [px]."""
LINE = 22
"""Height of a line of text [px]."""
TEXT = 0.46
"""Font scale of text (OpenCV)."""
SMALL = 0.42
GREEN = (60, 130, 30)
SOFT = (110, 110, 110)
_BLUE = (170, 90, 20)
_COLUMNS = ((0, "object"), (236, "above"), (296, "share"), (356, "pixels"), (416, "point"))
"""Position [px] and heading of the table's columns."""


def draw_words(attempt: Attempt, names: Mapping[int, str], config: Config) -> Image:
    """Draw the explanation in sentences, and below it the table of objects, ranked by the choice rule."""
    lines = [(line, INK) for text in choice_words(attempt, names, config) for line in wrapped(text, TEXT, WORDS_WIDTH)]
    lines += [(line, INK) for text in seal_words(attempt, names, config) for line in wrapped(text, TEXT, WORDS_WIDTH)]
    outcome = attempt.sentence[:1].upper() + attempt.sentence[1:]
    lines += [(line, GREEN if attempt.picked else RED) for line in wrapped(outcome, TEXT, WORDS_WIDTH)]
    canvas = np.full((LINE * (len(lines) + len(attempt.seen) + 3), WORDS_WIDTH, 3), 255, np.uint8)
    for number, (text, color) in enumerate(lines):
        put_text(canvas, text, (0, LINE * number + 16), TEXT, color)
    if attempt.seen:
        _draw_table(canvas, attempt, names, LINE * (len(lines) + 1))
    return canvas


def _draw_table(canvas: Image, attempt: Attempt, names: Mapping[int, str], top: int) -> None:
    """Draw the table of objects, in place; the target's row is highlighted."""
    short = labels(attempt)
    for x, text in _COLUMNS:
        put_text(canvas, text, (x, top + 16), TEXT, SOFT)
    cv2.line(canvas, (0, top + LINE + 1), (WORDS_WIDTH, top + LINE + 1), GREY, 1)
    for number, one in enumerate(attempt.ranked()):
        y = top + LINE * (number + 1) + 18
        target = one.instance == attempt.target
        if target:
            canvas[y - 15 : y + 7] = (225, 240, 225) if attempt.picked else (228, 228, 245)
        disc(canvas, (8, y - 5), 7, INK)
        disc(canvas, (8, y - 5), 6, instance_color(one.instance))
        name = fitted(f"{short[one.instance]} {names.get(one.object_id, '')}", TEXT, _COLUMNS[1][0] - 30)
        kind = ("pole", "centr.", "half")[suction_kind(one)]
        cells = ((22, name), (244, f"{len(one.ancestors)}"), (296, f"{one.visible_fraction:.2f}"), (356, f"{one.visible}"), (416, kind))
        for x, text in cells:
            put_text(canvas, text, (x, y), TEXT, INK, 2 if target and x == 22 else 1)


def wrapped(text: str, size: float, width: int) -> list[str]:
    """Wrap text to lines of at most that width [px]; all but the first are indented."""
    lines: list[str] = []
    current = ""
    for word in text.split():
        longer = f"{current} {word}" if current.strip() else current + word
        if current.strip() and cv2.getTextSize(longer, FONT, size, 1)[0][0] > width:
            lines.append(current)
            current = f"    {word}"
        else:
            current = longer
    return [*lines, current]


def fitted(text: str, size: float, width: int) -> str:
    """Truncate text to that width [px]."""
    if cv2.getTextSize(text, FONT, size, 2)[0][0] <= width:
        return text
    while text and cv2.getTextSize(text + "..", FONT, size, 2)[0][0] > width:
        text = text[:-1]
    return text + ".."


def draw_load(attempt: Attempt, config: Config, width: int, height: int) -> Image:
    """Plot the seal force over time, with the break force."""
    height = max(PLOT_HEIGHT, min(height, _MAX_PLOT_HEIGHT))
    canvas = np.full((height, width, 3), 255, np.uint8)
    left, right, top, bottom = 52, width - 12, 26, height - 40
    put_text(canvas, "seal force [N] (the largest, if several)", (0, 14), TEXT, SOFT)
    cv2.line(canvas, (left, bottom), (right, bottom), INK, 1)
    cv2.line(canvas, (left, top), (left, bottom), INK, 1)
    if not attempt.peak_force or not attempt.hits:
        put_text(canvas, "no force: nothing was engaged", (left + 20, (top + bottom) // 2), TEXT, SOFT)
        return canvas
    tick = config.physics.step * config.physics.steps_per_tick
    limit = break_force(attempt, config)
    span, peak = tick * max(1, len(attempt.peak_force) - 1), 1.12 * max(limit, *attempt.peak_force)

    def place(time: float, load: float) -> tuple[float, float]:
        return left + (right - left) * time / span, bottom - (bottom - top) * load / peak

    for value in ticks(peak, 4):
        x, y = place(0.0, value)
        cv2.line(canvas, (round(x) - 4, round(y)), (right, round(y)), (228, 228, 228) if value else INK, 1)
        text = f"{value:g}"
        put_text(canvas, text, (left - 9 - cv2.getTextSize(text, FONT, SMALL, 1)[0][0], round(y) + 5), SMALL, INK)
    for value in ticks(span, 8):
        x, _ = place(value, 0.0)
        cv2.line(canvas, (round(x), bottom), (round(x), bottom + 4), INK, 1)
        put_text(canvas, f"{value:g}", (round(x) - 8, bottom + 18), SMALL, INK)
    put_text(canvas, "time since the suction was switched on [s]", (left + 4, height - 6), SMALL, SOFT)
    y = round(place(0.0, limit)[1])
    cv2.line(canvas, (left, y), (right, y), RED, 2)
    put_text(canvas, f"breaks at {limit:g} N", (left + 8, y - 6), SMALL, RED)
    points = [place(tick * number, load) for number, load in enumerate(attempt.peak_force)]
    cv2.polylines(canvas, [fixed(np.array(points))], False, _BLUE, 2, cv2.LINE_AA, 4)
    for point in points:
        disc(canvas, point, 3, _BLUE)
    return canvas


def ticks(maximum: float, count: int) -> Sequence[float]:
    """Axis ticks from 0 to `maximum`, about `count`, at steps of 1, 2 or 5 times a power of ten."""
    raw = maximum / count
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw)
    return [float(round(step * number, 9)) for number in range(int(maximum / step + 1e-9) + 1)]
