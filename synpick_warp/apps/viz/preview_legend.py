"""Labels of boxes that do not overlap, and the legend of a view: mode, light, and the object of each label."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from synpick_warp.apps.viz.drawing import Image, instance_color, put_lines, put_text, readable_on, short_labels, shorten, text_size

LABEL = 0.42
"""Font scale of a box's label."""
_PAD = 2
"""Margin of a label's text [px]."""
_STEP = 6
"""Distance of the places that are tried where none in or around the box is free [px]."""
_TEXT = 0.42
"""Font scale of the legend."""
_SPACE = 8
"""Space between facts and objects [px]."""
LINE = 17
"""Height of a line of the legend [px]."""
_SWATCH = 30
"""Width of a coloured label in the legend [px]."""
COLUMN = 240
"""Width of a column of the legend [px]."""
_COLUMNS = 2
"""Most columns of a legend."""
_FACTS = 2
"""Lines above the objects: episode, mode, time; light."""
_SHADE = 0.85
"""Brightness of a label's ground, of the instance's colour: with contrast to the box's line."""
PAPER, SOFT = (230, 230, 230), (150, 150, 150)


class Box(NamedTuple):
    """Rectangle: left upper corner, width and height [px]."""

    x: float
    y: float
    width: float
    height: float

    def meets(self, other: Box) -> bool:
        """Whether two rectangles overlap; common edges do not count."""
        return (
            self.x < other.x + other.width
            and other.x < self.x + self.width
            and self.y < other.y + other.height
            and other.y < self.y + self.height
        )


def place_labels(boxes: Sequence[Box], sizes: Sequence[tuple[int, int]], area: tuple[int, int]) -> list[Box | None]:
    """Place a label for each box so that none overlaps another: in the box, else at it, else as near as there is room.

    Small boxes come first, as they have the fewest places.

    Args:
        boxes: Boxes in the image.
        sizes: Width and height of each label [px].
        area: Width and height of the image [px].

    Returns:
        The labels' rectangles; None: there is no room left.
    """
    placed: list[Box | None] = [None] * len(boxes)
    for index in sorted(range(len(boxes)), key=lambda index: boxes[index].width * boxes[index].height):
        taken = [label for label in placed if label is not None]
        tried = (Box(x, y, *sizes[index]) for x, y in _places(boxes[index], sizes[index], area))
        placed[index] = next((label for label in tried if not any(label.meets(other) for other in taken)), None)
    return placed


def _places(box: Box, size: tuple[int, int], area: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Corners of a label's places in the image, the best ones first."""
    room = area[0] - size[0], area[1] - size[1]
    if min(room) < 0:
        return
    inside = box.x + box.width - size[0], box.y + box.height - size[1]
    near = [(box.x, box.y), (inside[0], box.y), (box.x, inside[1]), inside]
    near += [(box.x, box.y - size[1]), (box.x, box.y + box.height), (box.x - size[0], box.y), (box.x + box.width, box.y)]
    for x, y in near:
        yield round(min(max(x, 0), room[0])), round(min(max(y, 0), room[1]))
    middle = box.x + (box.width - size[0]) / 2, box.y + (box.height - size[1]) / 2
    grid = [(x, y) for x in range(0, room[0] + 1, _STEP) for y in range(0, room[1] + 1, _STEP)]
    yield from sorted(grid, key=lambda place: (place[0] - middle[0]) ** 2 + (place[1] - middle[1]) ** 2)


def label_texts(truth: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> list[str]:
    """Short label of each instance of a view: obj_id, with a letter where several share it."""
    instances = [record.get("instance_id", index) for index, (record, _) in enumerate(truth)]
    labels = short_labels(zip(instances, (record["obj_id"] for record, _ in truth), strict=True))
    return [labels[instance] for instance in instances]


def draw_labels(image: Image, boxes: Sequence[Box], texts: Sequence[str], colors: Sequence[tuple[int, int, int]]) -> None:
    """Draw labels of boxes on their instances' colours, in place; a line leads from a label outside its box to it. Those without room are
    left out."""
    sizes = [(width + 2 * _PAD, height + 2 * _PAD) for width, height in (text_size(text, LABEL) for text in texts)]
    for box, place, text, color in zip(boxes, place_labels(boxes, sizes, image.shape[1::-1]), texts, colors, strict=True):
        if place is None:
            continue
        if not place.meets(Box(box.x - 1, box.y - 1, box.width + 2, box.height + 2)):
            start, end = ((round(each.x + each.width / 2), round(each.y + each.height / 2)) for each in (place, box))
            cv2.line(image, start, end, _ground(color), 1, cv2.LINE_AA)
        _put_label(image, text, place, color)


def _ground(color: tuple[int, int, int]) -> tuple[int, int, int]:
    """Darkened colour (BGR), as ground of a label."""
    blue, green, red = (round(_SHADE * value) for value in color)
    return blue, green, red


def _put_label(image: Image, text: str, place: Box, color: tuple[int, int, int]) -> None:
    """Draw text into a box of the darkened colour."""
    low = round(place.x), round(place.y)
    high = round(place.x + place.width) - 1, round(place.y + place.height) - 1
    cv2.rectangle(image, low, high, _ground(color), -1)
    put_text(image, text, (low[0] + _PAD, high[1] - _PAD), LABEL, readable_on(_ground(color)))


def legend_width(height: int, instances: int) -> int:
    """Width of legends of a height [px] with up to `instances` instances [px]: one column or several."""
    return COLUMN * (1 if instances <= _rows(height, _FACTS) else _COLUMNS)


def _rows(height: int, facts: int) -> int:
    """Number of instances that the legend's height has space for, below the facts."""
    return max(1, (height - LINE * facts - _SPACE) // LINE)


def draw_legend(
    size: tuple[int, int],
    facts: Sequence[str],
    truth: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]],
    names: Mapping[int, str],
) -> Image:
    """Draw the legend of a view, a new image: facts, then label, name and visible fraction of each instance, the most visible first.

    Args:
        size: Width and height [px]; what does not fit is counted.
        facts: Lines at the top.
        truth: Records of scene_gt and scene_gt_info of each instance.
        names: obj_id -> name; it may lack some.
    """
    panel = np.zeros((size[1], size[0], 3), np.uint8)
    put_lines(panel, (shorten(fact, size[0] - 12, _TEXT) for fact in facts), (6, LINE - 3), LINE, _TEXT, PAPER)
    texts = label_texts(truth)
    order = sorted(range(len(truth)), key=lambda index: (-np.nan_to_num(truth[index][1]["visib_fract"]), index))
    top, rows, columns = LINE * len(facts) + _SPACE, _rows(size[1], len(facts)), size[0] // COLUMN
    shown = order if len(order) <= rows * columns else order[: rows * columns - 1]
    for place, index in enumerate(shown):
        record, info = truth[index]
        x, y = 6 + COLUMN * (place // rows), top + LINE * (place % rows)
        color = instance_color(record.get("instance_id", index))
        _put_label(panel, texts[index], Box(x, y, max(_SWATCH, text_size(texts[index], LABEL)[0] + 2 * _PAD), LINE - 3), color)
        name = names.get(record["obj_id"], "") or f"object {record['obj_id']}"
        hidden = info["px_count_visib"] == 0
        unknown = math.isnan(info["visib_fract"])
        seen = "" if unknown else "hidden" if hidden else f"{info['visib_fract']:.2f}"
        put_text(panel, seen, (x + _SWATCH + 8, y + LINE - 6), _TEXT, SOFT)
        put_text(panel, shorten(name, COLUMN - _SWATCH - 58, _TEXT), (x + _SWATCH + 48, y + LINE - 6), _TEXT, SOFT if hidden else PAPER)
    if len(shown) < len(order):
        place = (6 + COLUMN * (columns - 1), top + LINE * rows - 6)
        put_text(panel, f"and {len(order) - len(shown)} more", place, _TEXT, SOFT)
    return panel
