"""Panels of an attempt's figure: explanation in sentences, table of objects, plot of the seal force over time."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from synpick_warp.apps.viz.drawing import FONT, INK, Image, blank, instance_color, put_text, shorten
from synpick_warp.apps.viz.explain_graph import GREY, RED, disc
from synpick_warp.apps.viz.explain_record import SeenAttempt, break_force, choice_words, labels, seal_words, suction_kind
from synpick_warp.configs.cell.gripper import Suction
from synpick_warp.configs.episodes.manipulation import Pick, Target
from synpick_warp.system.codecs.charts import Spec, axis, limit, line, points, theme

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
_BLUE, _RED, _SOFT = "#145aaa", "#c83c3c", "#6e6e6e"
"""Colours of the plot."""
_FONT = 13
"""Font size of the plot [px]."""
_DOT = 40.0
"""Area of a tick's disc [px²]."""
_MAX_DOTS = 200
"""Fewest ticks of a lift whose curve has no dots, which would hide it."""
_COLUMNS = ((0, "object"), (236, "above"), (296, "area"), (356, "pixels"), (416, "point"))
"""Position [px] and heading of the table's columns."""


def draw_words(attempt: SeenAttempt, names: Mapping[int, str], rules: tuple[Target, Pick], suction: Suction) -> Image:
    """Draw the explanation in sentences, and below it the table of objects, ranked by the choice rule."""
    lines = [(line, INK) for text in choice_words(attempt, names, *rules) for line in wrapped(text, TEXT, WORDS_WIDTH)]
    lines += [(line, INK) for text in seal_words(attempt, names, suction) for line in wrapped(text, TEXT, WORDS_WIDTH)]
    outcome = attempt.sentence[:1].upper() + attempt.sentence[1:]
    lines += [(line, GREEN if attempt.picked else RED) for line in wrapped(outcome, TEXT, WORDS_WIDTH)]
    canvas = blank(WORDS_WIDTH, LINE * (len(lines) + len(attempt.seen) + 3))
    for number, (text, color) in enumerate(lines):
        put_text(canvas, text, (0, LINE * number + 16), TEXT, color)
    if attempt.seen:
        _draw_table(canvas, attempt, names, LINE * (len(lines) + 1))
    return canvas


def _draw_table(canvas: Image, attempt: SeenAttempt, names: Mapping[int, str], top: int) -> None:
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
        name = shorten(f"{short[one.instance]} {names.get(one.object_id, '')}", _COLUMNS[1][0] - 30, TEXT)
        kind = ("pole", "centr.", "half", "drawn")[suction_kind(one)]
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


def load_chart(attempt: SeenAttempt, suction: Suction, tick_time: float, width: int, height: int) -> Spec:
    """Chart of the seal force over time, with the break force; size in pixels, whose height is kept in its limits.

    `tick_time`: time between two frames [s].
    """
    height = max(PLOT_HEIGHT, min(height, _MAX_PLOT_HEIGHT))
    size = {"width": width, "height": height, "autosize": {"type": "fit", "contains": "padding"}, "padding": 2, "background": "white"}
    text = {"color": _SOFT, "fontSize": _FONT}
    title = {**text, "text": "seal force [N] (the largest, if several)", "anchor": "start", "fontWeight": "normal"}
    breaks = break_force(attempt, suction)
    if not attempt.peak_force or not attempt.hits:
        said = {"type": "text", "text": "no force: nothing was engaged", **text}
        return {**size, "title": title, "data": {"values": [{}]}, "mark": said, "config": theme(_FONT)}
    span = tick_time * max(1, len(attempt.peak_force) - 1)
    peak = 1.25 * max(breaks, *attempt.peak_force)
    y = axis("y", None, 0.0, peak, tickCount=4)
    times = np.linspace(0.0, span, max(2, len(attempt.peak_force)))[: len(attempt.peak_force)]
    label = {"align": "left", "baseline": "bottom", "x": 8, "dy": -3, "color": _RED, "fontSize": _FONT}
    rule = limit({"y": {**y, "field": "limit"}, "x": None}, breaks, f"breaks at {breaks:.3g} N", {"color": _RED, "strokeWidth": 2}, label)
    curve = line(2.5, {"value": _BLUE}, dots=_DOT if len(times) < _MAX_DOTS else 0.0)
    x = axis("x", "time since the suction was switched on [s]", -0.01 * span, 1.01 * span, tickCount=8)
    return {
        **size,
        "title": title,
        "config": theme(_FONT),
        "encoding": {"x": x, "y": y},
        "layer": [rule, points(curve, 0.0, peak, attempt.peak_force, x=times)],
    }
