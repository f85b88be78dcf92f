"""Procedural textures of surfaces for domain randomization (Tobin et al., IROS 2017): carpet, boards, checks, print, clutter, noise.

Images are (SIDE, SIDE, 3) uint8, sRGB, RGB order, of one repeat of a surface. Image i follows from i alone, and kinds take turns, so that
more images keep those before them.
"""

import itertools
from collections.abc import Callable

import cv2
import numpy as np

from synpick_warp.scenes.embedded.textures import Color, bar_code, blank, facts, grain, small_print, wood, write

SIDE = 512
"""Width and height [px]: texels of 2 mm for a repeat of 1 m."""
SHADES = 2.0
"""Exponent by which saturations are drawn: most surfaces are nearly grey."""
WORDS = ("NEW", "SALE", "COFFEE", "2 FOR 1", "OPEN", "HELLO", "No. 7", "FRESH", "PLUS")

_Maker = Callable[[np.random.Generator, int], np.ndarray]


def _color(rng: np.random.Generator) -> Color:
    """Colour of any hue and value, mostly of low saturation."""
    hsv = np.array([[[rng.integers(0, 180), 255 * rng.random() ** SHADES, 255 * rng.uniform(0.05, 1.0)]]]).astype(np.uint8)
    red, green, blue = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0].tolist()
    return red, green, blue


def _blend(first: Color, second: Color, weight: np.ndarray) -> np.ndarray:
    """Image between two colours, by weights (H, W) of the second."""
    share = weight[..., None]
    return np.clip(np.array(first) * (1 - share) + np.array(second) * share, 0, 255).astype(np.uint8)


def _near(color: Color, rng: np.random.Generator, factor: float) -> Color:
    """The colour, lighter or darker by up to a factor."""
    scale = factor ** rng.uniform(-1.0, 1.0)
    red, green, blue = (min(255, round(scale * part)) for part in color)
    return red, green, blue


def _laminate(rng: np.random.Generator, seed: int) -> np.ndarray:
    """Plain surface with faint specks and stains."""
    color = _color(rng)
    noise = 0.7 * grain(SIDE, SIDE, (2, 2), seed) + 0.3 * grain(SIDE, SIDE, (90, 90), seed + 1)
    return _blend(color, _near(color, rng, 1.5), noise)


def _carpet(rng: np.random.Generator, seed: int) -> np.ndarray:
    """Loops of two colours in rows."""
    color, size = _color(rng), rng.uniform(2.0, 9.0)
    loops = 0.6 * grain(SIDE, SIDE, (size, size), seed) + 0.4 * grain(SIDE, SIDE, (2, 2), seed + 1)
    rows = 0.5 + 0.5 * np.sin(np.arange(SIDE) * 2 * np.pi / rng.uniform(5, 16))
    return _blend(_near(color, rng, 1.3), _near(color, rng, 4.0), np.clip(loops * (0.5 + rows[:, None]), 0, 1))


def _boards(rng: np.random.Generator, seed: int) -> np.ndarray:
    """Wooden boards side by side, each of its own shade and stain."""
    count = int(rng.integers(1, 7))
    stain = np.array(_color(rng)) / 255.0 * rng.uniform(0.6, 1.3)
    edges = np.linspace(0, SIDE, count + 1).round().astype(int)
    pairs = enumerate(itertools.pairwise(edges))
    boards = [wood(right - left, SIDE, seed + index) * rng.uniform(0.6, 1.0) for index, (left, right) in pairs]
    mixed = np.concatenate(boards, axis=1) * (0.35 + 0.65 * stain)
    return np.clip(mixed, 0, 255).astype(np.uint8)


def _checks(rng: np.random.Generator, seed: int) -> np.ndarray:
    """Squares or stripes of two colours, as tiles, table cloths and chess boards have."""
    count = int(rng.integers(2, 16))
    place = np.arange(SIDE) * count * 2 // SIDE
    along = place[:, None] if rng.random() < 0.7 else np.zeros((SIDE, 1), int)
    base = _blend(_color(rng), _color(rng), ((along + place) % 2).astype(float))
    return np.clip(base * (0.85 + 0.3 * grain(SIDE, SIDE, (3, 20), seed)[..., None]), 0, 255).astype(np.uint8)


def _stone(rng: np.random.Generator, seed: int) -> np.ndarray:
    """Noise of several scales in two or more colours, as of stone, cloth with a pattern, or rubbish."""
    image = _blend(_color(rng), _color(rng), grain(SIDE, SIDE, (4, 4), seed))
    for octave in range(int(rng.integers(1, 4))):
        size = 12.0 * 3.0**octave
        mask = np.clip(8 * (grain(SIDE, SIDE, (size, size), seed + octave + 1) - rng.uniform(0.4, 0.7)), 0, 1)[..., None]
        image = (image * (1 - mask) + np.array(_color(rng)) * mask).astype(np.uint8)
    return image


def _print(rng: np.random.Generator, seed: int) -> np.ndarray:
    """Sheets with large letters, small print, bar codes and tables, as packages and papers have."""
    image = blank(SIDE, SIDE, _color(rng))
    for index in range(int(rng.integers(5, 12))):
        wide, high = rng.uniform(0.12, 0.5, 2)
        left, top = rng.uniform(0, 1 - wide), rng.uniform(0, 1 - high)
        box = (left, top, left + wide, top + high)
        kind = int(rng.integers(0, 5))
        if kind == 0:
            bar_code(image, (left, top, left + max(wide, 0.25), top + high), seed + index)
        elif kind == 1:
            facts(image, (left, top, left + max(wide, 0.2), top + max(high, 0.25)), seed + index)
        elif kind == 2:
            small_print(image, box, _color(rng), int(rng.integers(4, 16)), seed + index)
        else:
            _shape(image, rng)
            write(image, WORDS[rng.integers(len(WORDS))], box, _color(rng))
    return image


def _shape(image: np.ndarray, rng: np.random.Generator) -> None:
    """Draw a turned rectangle, an ellipse, or a cable, with a shadow beside it."""
    center, size = rng.uniform(0, SIDE, 2), np.exp(rng.uniform(np.log(8), np.log(180), 2))
    kind, color, angle = rng.integers(0, 3), _color(rng), rng.uniform(0, 180)
    for offset, tint in ((rng.uniform(2, 7), tuple(0.35 * image.mean(axis=(0, 1)))), (0.0, color)):
        at = center + offset
        if kind == 0:
            corners = cv2.boxPoints(((float(at[0]), float(at[1])), (float(size[0]), float(size[1])), float(angle)))
            cv2.fillConvexPoly(image, corners.round().astype(np.int32), tint, cv2.LINE_AA)
        elif kind == 1:
            axes = (round(float(size[0]) / 2), round(float(size[1]) / 2))
            cv2.ellipse(image, (round(float(at[0])), round(float(at[1]))), axes, float(angle), 0, 360, tint, -1, cv2.LINE_AA)
        else:
            t = np.linspace(0, 2 * np.pi, 60)
            waves = size[:, None] * 1.5 * np.stack([np.sin(t * 0.7 + angle), np.cos(t * 0.45 + 2 * angle)])
            cv2.polylines(image, [(at[:, None] + waves).T.round().astype(np.int32)], False, tint, int(1 + size[1] % 7), cv2.LINE_AA)


def _clutter(rng: np.random.Generator, seed: int) -> np.ndarray:
    """A plain, woven or wooden surface with things that lie on it, seen from above: papers, cables, keys, plates."""
    image = (_laminate, _carpet, _boards)[int(rng.integers(0, 3))](rng, seed).copy()
    for _ in range(int(rng.integers(5, 45))):
        _shape(image, rng)
    if rng.random() < 0.4:
        left, top, pitch = (int(value) for value in (*rng.integers(0, SIDE // 2, 2), rng.integers(12, 24)))
        image[top : top + 5 * pitch, left : left + 14 * pitch] = _near((30, 30, 32), rng, 1.5)
        for column in range(14):
            for row in range(5):
                x, y = left + column * pitch + 2, top + row * pitch + 2
                image[y : y + pitch - 4, x : x + pitch - 4] = _near((60, 60, 64), rng, 1.2)
    return image


KINDS: tuple[_Maker, ...] = (_laminate, _carpet, _clutter, _boards, _print, _checks, _stone, _clutter)
"""Makers of the images, in turn."""


def surface_textures(count: int, first: int = 0) -> tuple[np.ndarray, ...]:
    """The images `first` to `first + count - 1`, each (SIDE, SIDE, 3) uint8."""
    indices = range(first, first + count)
    return tuple(KINDS[index % len(KINDS)](np.random.default_rng([SIDE, index]), 100 * index) for index in indices)
