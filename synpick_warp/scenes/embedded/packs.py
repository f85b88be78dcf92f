"""Packaging: procedural cartons, tins and bottles with printed labels, by the table goods.toml. Lengths [m]."""

import functools
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.scenes import modelling
from synpick_warp.scenes.embedded import textures as paint
from synpick_warp.scenes.embedded.textures import Color

SHEET = 1024
"""Width of a texture atlas [px]: about 3 px/mm, the resolution of the cameras at 2 m and full HD."""
SIDES = 48
"""Points per ring of tins and bottles."""
CARTON_EDGE = 0.0015
"""Edge radius of cartons [m]."""
SILVER: Color = (204, 205, 208)

Shape = tuple[modelling.Patch, np.ndarray]
"""Surface of an object and its texture (H, W, 3) uint8."""


@dataclass(frozen=True)
class Label:
    """Texts, colours and picture (see goods.toml) of a printed label, and the seed of its random details."""

    title: list[str]
    subtitle: str
    net: str
    color: Color
    accent: Color
    text: Color
    seed: int
    picture: list[dict[str, Any]]
    food: bool = True
    """Print a table of nutrition facts, instead of directions."""


def make_goods(name: str) -> Shape:
    """Make the object of a table of goods.toml."""
    row = dict(_read_goods()[name])
    label = Label(**{key: row.pop(key) for key in Label.__annotations__ if key in row})
    kind = row.pop("kind")
    return carton(**row, label=label) if kind == "carton" else tin(**row, label=label) if kind == "tin" else bottle(**row, label=label)


@functools.cache
def _read_goods() -> dict[str, dict[str, Any]]:
    return tomllib.loads(Path(__file__).with_name("goods.toml").read_text())


def front(width: int, height: int, label: Label) -> np.ndarray:
    """Draw the front panel: title, picture, net weight."""
    image = paint.blank(width, height, label.color)
    paint.fill(image, (0.0, 0.0, 1.0, 0.05), label.accent)
    paint.fill(image, (0.0, 0.93, 1.0, 1.0), label.accent)
    for group in label.picture:
        for x, y in group.get("at", [(0, 0)]):
            for *shape, red, green, blue in group["marks"]:
                if len(shape) == 3:
                    paint.dot(image, x + shape[0], y + shape[1], shape[2], (red, green, blue))
                else:
                    left, top, right, bottom = shape
                    paint.fill(image, (x + left, y + top, x + right, y + bottom), (red, green, blue))
    lines = len(label.title)
    for row, line in enumerate(label.title):
        paint.write(image, line, (0.06, 0.08 + 0.3 * row / lines, 0.94, 0.08 + 0.3 * (row + 0.95) / lines), label.text)
    paint.write(image, label.subtitle, (0.08, 0.395, 0.92, 0.46), label.text, paint.FONT)
    paint.write(image, label.net, (0.06, 0.86, 0.6, 0.92), label.text, paint.FONT)
    return image


def back(width: int, height: int, label: Label) -> np.ndarray:
    """Draw the back panel: text, and a bar code."""
    image = paint.blank(width, height, paint.PAPER)
    paint.fill(image, (0.0, 0.0, 1.0, 0.16), label.color)
    paint.write(image, " ".join(label.title), (0.06, 0.03, 0.94, 0.13), label.text)
    paint.small_print(image, (0.08, 0.2, 0.92, 0.5), (92, 88, 84), 8, label.seed)
    paint.fill(image, (0.08, 0.53, 0.56, 0.94), label.accent)
    paint.small_print(image, (0.11, 0.56, 0.53, 0.91), paint.legible(label.accent), 7, label.seed + 1)
    paint.bar_code(image, (0.6, 0.72, 0.94, 0.94), label.seed + 2)
    return image


def side(width: int, height: int, label: Label) -> np.ndarray:
    """Draw the side panel: nutrition facts or directions."""
    image = paint.blank(width, height, label.color)
    if width > height:
        paint.write(image, " ".join(label.title), (0.04, 0.12, 0.6, 0.88), label.text)
        paint.facts(image, (0.68, 0.06, 0.97, 0.94), label.seed + 3)
        return image
    paint.write(image, " ".join(label.title), (0.06, 0.03, 0.94, 0.13), label.text)
    if label.food:
        paint.facts(image, (0.08, 0.16, 0.92, 0.62), label.seed + 3)
    else:
        paint.fill(image, (0.08, 0.16, 0.92, 0.62), paint.PAPER)
        paint.write(image, "Directions", (0.14, 0.18, 0.86, 0.26), paint.INK)
        paint.small_print(image, (0.14, 0.28, 0.86, 0.6), paint.INK, 10, label.seed + 3)
    paint.small_print(image, (0.1, 0.66, 0.9, 0.95), label.text, 9, label.seed + 4)
    return image


def other_side(width: int, height: int, label: Label) -> np.ndarray:
    """Draw the other side panel: title, and text or a bar code."""
    image = paint.blank(width, height, label.accent)
    text = paint.legible(label.accent)
    if width > height:
        paint.write(image, " ".join(label.title), (0.05, 0.12, 0.7, 0.88), text)
        paint.bar_code(image, (0.74, 0.15, 0.97, 0.85), label.seed + 5)
        return image
    paint.write(image, " ".join(label.title), (0.06, 0.06, 0.94, 0.2), text)
    paint.small_print(image, (0.1, 0.3, 0.9, 0.6), text, 8, label.seed + 6)
    paint.write(image, label.net, (0.1, 0.85, 0.9, 0.93), text, paint.FONT)
    return image


def end(width: int, height: int, label: Label) -> np.ndarray:
    """Draw the top or bottom panel of a carton, with the title."""
    image = paint.blank(width, height, label.color)
    paint.fill(image, (0.0, 0.0, 1.0, 0.1), label.accent)
    paint.fill(image, (0.0, 0.9, 1.0, 1.0), label.accent)
    paint.write(image, " ".join(label.title), (0.08, 0.25, 0.92, 0.75), label.text)
    return image


def carton(size: list[float], label: Label) -> Shape:
    """Make a carton; its largest faces are front and back."""
    scale = (SHEET - 8 * paint.PADDING) / (2 * (size[0] + size[1]))
    x, y, z = (round(length * scale) for length in size)
    extent = {"+x": (y, z), "-x": (y, z), "+y": (x, z), "-y": (x, z), "+z": (x, y), "-z": (x, y)}
    thin = "xyz"[int(np.argmin(size))]
    panels = {"+x": side, "-x": other_side, "+y": side, "-y": other_side, "+z": end, "-z": end, f"+{thin}": front, f"-{thin}": back}
    images = {name: panels[name](*extent[name], label) for name in modelling.BOX_FACES}
    texture, at = paint.pack(images, SHEET)
    return modelling.rounded_box((size[0], size[1], size[2]), CARTON_EDGE, at), texture


def wrapper(width: int, height: int, label: Label, *, twice: bool = False) -> np.ndarray:
    """Draw an unrolled label: front in the middle, text and table left and right; or the front twice, 180° apart."""
    if twice:
        half = front(width // 2, height, label)
        return np.concatenate([half, half], axis=1)
    third = width // 3
    left, middle, right = back(third, height, label), front(width - 2 * third, height, label), side(third, height, label)
    paint.fill(left, (0.0, 0.0, 1.0, 0.05), label.accent)
    return np.concatenate([left, middle, right], axis=1)


def tin(
    ring: list[float],
    height: float,
    label: Label,
    top: dict[str, Any],
    bottom: dict[str, Any],
    *,
    twice: bool = False,
    sides: bool = False,
) -> Shape:
    """Make a tin: metal rims at both ends, the label between them. `ring`: width and depth of an ellipse, or width, depth and radius of the
    corners of a rounded rectangle [m]. `top`: print of the upper end: see `_draw_end`. `twice`: whether the label has its front twice.
    `sides`: whether the label has its sides alone; the front is printed on the lid."""
    across, deep, *radius = ring
    outline = modelling.rounded_rectangle(across, deep, radius[0], 10) if radius else modelling.ellipse(across, deep, SIDES)
    # As wide as the texture atlas without padding, as high as the tin between its rims.
    width = SHEET - 2 * paint.PADDING
    high = round(width * (height - 0.008) / np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1).sum())
    if sides:
        third = width // 3
        panels = [draw(wide, high, label) for draw, wide in ((other_side, third), (side, width - 2 * third), (other_side, third))]
        printed = np.concatenate(panels, axis=1)
    else:
        printed = wrapper(width, high, label, twice=twice)
    images = {"label": printed, "metal": paint.brushed(256, 64, SILVER, label.seed + 8)}
    texture, at = paint.pack(images | {"top": _draw_end(top, label), "bottom": _draw_end(bottom, label)}, SHEET)
    half = height / 2
    narrow = 1 - 0.0012 / np.abs(outline).max()

    def level(scale: float, z: float) -> np.ndarray:
        """The outline, scaled, at a height [m]."""
        return modelling.at_height(outline * scale, z)

    lower = np.stack([level(0.93, -half + 0.002), level(0.95, -half), level(0.99, -half), level(1.0, -half + 0.001)])
    lower = np.concatenate([lower, np.stack([level(1.0, -half + 0.003), level(narrow, -half + 0.004)])])
    upper = lower[::-1] * (1, 1, -1)
    body = np.stack([lower[-1], *(level(narrow, z) for z in np.linspace(-half, half, 5)[1:-1]), upper[0]])
    parts = (lower, at["metal"]), (body, at["label"]), (upper, at["metal"])
    return modelling.sections(*parts, ends=(at["bottom"], at["top"])), texture


def _draw_end(end: dict[str, Any], label: Label) -> np.ndarray:
    """Draw the end of a tin: `front`, the front panel of this side [px]; `count` concentric grooves of two colours, `rings`; or scratched
    grooves with a line of print, `stamp`, unless it is empty."""
    if "front" in end:
        return front(end["front"], end["front"], label)
    size = 256
    if "rings" in end:
        return paint.rings(size, end["rings"], end["count"])
    grooves = paint.rings(size, (SILVER, (140, 141, 146)), 3.0)
    image = (0.6 * grooves + 0.4 * paint.brushed(size, size, SILVER, end["seed"])).astype(np.uint8)
    if end["stamp"]:
        paint.write(image, end["stamp"], (0.25, 0.42, 0.75, 0.58), (70, 72, 80), paint.FONT)
    return image


def bottle(
    levels: list[list[float]],
    neck: list[tuple[float, float]],
    band: tuple[int, int],
    label_height: int,
    body: dict[str, Any],
    cap: dict[str, Any],
    label: Label,
) -> Shape:
    """Make a bottle with a screw cap. `levels`: cross-sections (width, depth, superellipse exponent, z) of the body from the bottom to the
    neck [m]. `neck`: (radius, z) of the cap's profile, from its lower edge to its top [m]. `band`: first and last level with the label.
    `label_height`: [px]. `body`: colour and seed of the body's plastic."""
    images = {"label": wrapper(SHEET - 6, label_height, label), "body": paint.plain(**body), "cap": paint.plain(**cap)}
    texture, at = paint.pack(images, SHEET)
    rings = np.stack([modelling.at_height(modelling.ellipse(width, depth, SIDES, exponent), z) for width, depth, exponent, z in levels])
    first, last = band
    parts = (rings[: first + 1], at["body"]), (rings[first : last + 1], at["label"]), (rings[last:], at["body"])
    return modelling.join(
        modelling.sections(*parts, ends=(at["body"], at["body"])), modelling.solid(modelling.lathe(neck, SIDES), at["cap"])
    ), texture
