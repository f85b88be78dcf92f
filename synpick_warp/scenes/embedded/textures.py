"""Procedural textures of the embedded objects: print, bar codes, wood, metal, foam, peel; and texture atlas packing.

Images are (H, W, 3) uint8, sRGB, RGB order, top row first. Boxes are (left, top, right, bottom) as fractions of the image. All random
numbers have fixed seeds.

For domain randomization (Tobin et al., IROS 2017): carpet, boards, checks, print, clutter, noise, (SIDE, SIDE, 3), of one repeat of a
surface. Image i follows from i alone, and kinds take turns, so that more images keep those before them.
"""

import itertools
from collections.abc import Callable

import cv2
import numpy as np

from synpick_warp.scenes.modelling import Rect

Color = tuple[int, int, int]
Box = tuple[float, float, float, float]

FONT = cv2.FONT_HERSHEY_DUPLEX
BOLD = cv2.FONT_HERSHEY_TRIPLEX
INK: Color = (28, 26, 30)
PAPER: Color = (244, 241, 232)
PADDING = 3
"""Padding around each image of an atlas that repeats its edge, so that filtering does not bleed [px]."""


def blank(width: int, height: int, color: Color) -> np.ndarray:
    """Image of one colour."""
    return np.full((height, width, 3), color, np.uint8)


def legible(background: Color) -> Color:
    """Choose a text colour with contrast to the background: dark on light, light on dark."""
    return INK if 0.3 * background[0] + 0.6 * background[1] + 0.1 * background[2] > 130 else PAPER


def pack(images: dict[str, np.ndarray], width: int) -> tuple[np.ndarray, dict[str, Rect]]:
    """Pack images into a texture atlas of the given width [px], row by row in order; returns atlas and rectangles."""
    places: dict[str, tuple[int, int]] = {}
    x = y = row = 0
    for name, image in images.items():
        high, wide = image.shape[0] + 2 * PADDING, image.shape[1] + 2 * PADDING
        if x and x + wide > width:
            x, y, row = 0, y + row, 0
        places[name] = (x, y)
        x, row = x + wide, max(row, high)
    sheet = np.zeros((y + row, max(width, max(p[0] + images[n].shape[1] + 2 * PADDING for n, p in places.items())), 3), np.uint8)
    rects = {}
    for name, (left, top) in places.items():
        padded = cv2.copyMakeBorder(images[name], PADDING, PADDING, PADDING, PADDING, cv2.BORDER_REPLICATE)
        sheet[top : top + padded.shape[0], left : left + padded.shape[1]] = padded
        right, bottom = left + padded.shape[1] - PADDING, top + padded.shape[0] - PADDING
        rects[name] = (
            (left + PADDING) / sheet.shape[1],
            1 - bottom / sheet.shape[0],
            right / sheet.shape[1],
            1 - (top + PADDING) / sheet.shape[0],
        )
    return sheet, rects


def fill(image: np.ndarray, box: Box, color: Color) -> None:
    """Fill a rectangle of a texture with a colour."""
    left, top, right, bottom = _pixels(image, box)
    image[top:bottom, left:right] = color


def dot(image: np.ndarray, x: float, y: float, radius: float, color: Color) -> None:
    """Draw a disc; the radius is a fraction of the image's shorter side."""
    center = (round(x * image.shape[1]), round(y * image.shape[0]))
    cv2.circle(image, center, max(1, round(radius * min(image.shape[:2]))), color, -1, cv2.LINE_AA)


def write(image: np.ndarray, text: str, box: Box, color: Color, font: int = BOLD) -> None:
    """Write one line of text centred in a box, as large as it allows."""
    left, top, right, bottom = _pixels(image, box)
    (wide, high), below = cv2.getTextSize(text, font, 1.0, 1)
    scale = min((right - left) / wide, (bottom - top) / (high + below))
    (wide, high), _ = cv2.getTextSize(text, font, scale, 1)
    origin = ((left + right - wide) // 2, (top + bottom + high) // 2)
    cv2.putText(image, text, origin, font, scale, color, max(1, round(1.6 * scale)), cv2.LINE_AA)


def small_print(image: np.ndarray, box: Box, color: Color, rows: int, seed: int) -> None:
    """Draw lines of illegible words."""
    rng = np.random.default_rng(seed)
    left, top, right, bottom = _pixels(image, box)
    pitch = (bottom - top) / rows
    for row in range(rows):
        x, y = float(left), round(top + pitch * (row + 0.5))
        end = right if row < rows - 1 else left + (right - left) * 0.6
        while x < end - pitch:
            length = min(pitch * rng.uniform(0.6, 3.2), end - x)
            cv2.line(image, (round(x), y), (round(x + length), y), color, max(1, round(pitch * 0.38)))
            x += length + pitch * 0.6


def bar_code(image: np.ndarray, box: Box, seed: int) -> None:
    """Draw a bar code with its digits, on white."""
    rng = np.random.default_rng(seed)
    fill(image, box, (252, 252, 252))
    left, top, right, bottom = _pixels(image, box)
    bars = np.repeat(np.arange(58) % 2, rng.integers(1, 4, 58))
    columns = np.arange(left + 4, right - 4)
    dark = bars[(np.arange(len(columns)) * len(bars)) // max(len(columns), 1)] == 0
    image[top + 3 : bottom - max(4, (bottom - top) // 4), columns[dark]] = INK
    digits = "".join(str(digit) for digit in rng.integers(0, 10, 12))
    write(image, digits, (box[0] + 0.01, box[3] - (box[3] - box[1]) * 0.22, box[2] - 0.01, box[3]), INK, FONT)


def facts(image: np.ndarray, box: Box, seed: int) -> None:
    """Draw a table of nutrition facts."""
    rng = np.random.default_rng(seed)
    fill(image, box, (250, 249, 244))
    left, top, right, bottom = _pixels(image, box)
    cv2.rectangle(image, (left, top), (right - 1, bottom - 1), INK, 2)
    table = image[top + 3 : bottom - 3, left + 4 : right - 4]
    write(table, "Nutrition Facts", (0.02, 0.01, 0.98, 0.14), INK)
    fill(table, (0.0, 0.15, 1.0, 0.18), INK)
    names = ("Energy", "Fat", "Saturates", "Salt", "Carbohydrate", "Fibre", "Sugars", "Protein")
    for row, name in enumerate(names):
        y = 0.2 + 0.1 * row
        write(table, f"{name:<13}", (0.02, y + 0.01, 0.6, y + 0.095), INK, FONT)
        write(table, f"{rng.integers(1, 60)} g", (0.72, y + 0.01, 0.98, y + 0.095), INK, FONT)
        fill(table, (0.0, y + 0.095, 1.0, y + 0.105), (120, 118, 120))


def grain(width: int, height: int, scale: tuple[float, float], seed: int) -> np.ndarray:
    """Value noise (H, W) in 0..1, with features of the given width and height [px]."""
    rng = np.random.default_rng(seed)
    coarse = rng.random((max(2, round(height / scale[1])), max(2, round(width / scale[0])))).astype(np.float32)
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(smooth, 0.0, 1.0)


def plain(color: Color, seed: int, roughness: float = 0.04) -> np.ndarray:
    """Texture of moulded plastic: one colour with faint specks."""
    size = 128
    noise = 0.6 * grain(size, size, (2, 2), seed) + 0.4 * grain(size, size, (24, 24), seed + 1) - 0.5
    return _to_uint8(np.array(color, np.float32) * (1 + 2 * roughness * noise[..., None]))


def brushed(width: int, height: int, color: Color, seed: int) -> np.ndarray:
    """Texture of brushed metal: fine horizontal scratches."""
    noise = 0.7 * grain(width, height, (60, 1.5), seed) + 0.3 * grain(width, height, (width / 2, 6), seed + 1) - 0.5
    return _to_uint8(np.array(color, np.float32) * (1 + 0.3 * noise[..., None]))


def rings(size: int, colors: tuple[Color, Color], count: float) -> np.ndarray:
    """Texture of concentric grooves of two colours, rotationally symmetric."""
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    radius = np.hypot(*np.meshgrid(axis, axis))
    wave = (0.5 + 0.5 * np.cos(radius * 2 * np.pi * count))[..., None]
    return _to_uint8(np.array(colors[0], np.float32) * wave + np.array(colors[1], np.float32) * (1 - wave))


def wood(width: int, height: int, seed: int) -> np.ndarray:
    """Wood along its vertical grain; symmetric under rotation by 180°, so that a block with it is symmetric, too."""
    x = np.linspace(-1.0, 1.0, width, dtype=np.float32)[None]
    warp = 0.45 * (_symmetrize(grain(width, height, (width / 2, height / 2.5), seed)) - 0.5)
    year = 0.5 + 0.5 * np.sin(2 * np.pi * (4.0 * (np.abs(x) + 0.2 * warp) + 2.0 * warp))
    fibre = _symmetrize(grain(width, height, (1.5, 40), seed + 1)) - 0.5
    tone = np.clip(0.45 + 0.4 * (year**3 - 0.4) + 0.7 * fibre, 0, 1)[..., None]
    return _to_uint8(np.array((146, 98, 52), np.float32) * tone + np.array((220, 180, 124), np.float32) * (1 - tone))


def end_grain(size: int, seed: int) -> np.ndarray:
    """Texture of wood across the grain: growth rings around the centre, symmetric under rotation by 90°."""
    axis = np.linspace(-1.0, 1.0, size, dtype=np.float32)
    radius = np.hypot(*np.meshgrid(axis, axis))
    warp = grain(size, size, (size / 4, size / 4), seed)
    warp = (warp + np.rot90(warp) + np.rot90(warp, 2) + np.rot90(warp, 3)) / 4 - 0.5
    year = (0.5 + 0.5 * np.sin(2 * np.pi * 9 * (radius + 0.12 * warp)))[..., None]
    return _to_uint8(np.array((138, 92, 50), np.float32) * year + np.array((206, 164, 110), np.float32) * (1 - year))


def foam(width: int, height: int, color: Color, seed: int) -> np.ndarray:
    """Texture of fine-pored foam, symmetric under rotation by 180°."""
    pores = _symmetrize(grain(width, height, (3, 3), seed))
    blotch = _symmetrize(grain(width, height, (30, 30), seed + 1)) - 0.5
    tone = 1 - np.clip(0.42 - pores, 0, 1) + 0.12 * blotch
    return _to_uint8(np.array(color, np.float32) * tone[..., None])


def peel(width: int, height: int, seed: int) -> np.ndarray:
    """Unrolled banana peel: stem at the top, green below it, brown streaks and specks, a dark lower tip."""
    y = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None]
    streak = grain(width, height, (7, 130), seed)
    blotch = grain(width, height, (10, 16), seed + 1)
    yellow, green, brown = (np.array(c, np.float32) for c in ((238, 200, 62), (150, 170, 60), (84, 58, 30)))
    unripe = np.clip(1 - y / 0.22, 0, 1)[..., None]
    color = yellow * (1 - unripe) + green * unripe
    edges = 0.5 + 0.5 * np.cos(2 * np.pi * 5 * np.linspace(0, 1, width, dtype=np.float32))[None]
    spots = np.clip((blotch - 0.8) * 8, 0, 1) + np.clip((streak - 0.86) * 6, 0, 1) + 0.25 * edges**12
    tips = np.clip(1 - y / 0.035, 0, 1) + np.clip((y - 0.955) / 0.03, 0, 1)
    fraction = np.clip(0.75 * spots + tips, 0, 1)[..., None]
    return _to_uint8((color * (1 - fraction) + brown * fraction) * (0.94 + 0.12 * streak[..., None]))


def _symmetrize(noise: np.ndarray) -> np.ndarray:
    """Noise made symmetric under a half-turn."""
    return (noise + noise[::-1, ::-1]) / 2


def _pixels(image: np.ndarray, box: Box) -> tuple[int, int, int, int]:
    """Sides of a box in pixels: left, top, right, bottom."""
    high, wide = image.shape[:2]
    return round(box[0] * wide), round(box[1] * high), round(box[2] * wide), round(box[3] * high)


def _to_uint8(image: np.ndarray) -> np.ndarray:
    return np.clip(image, 0, 255).astype(np.uint8)


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
    """Checkerboard or stripes in two colours, with grain."""
    count = int(rng.integers(2, 16))
    place = np.arange(SIDE) * count * 2 // SIDE
    along = place[:, None] if rng.random() < 0.7 else np.zeros((SIDE, 1), int)
    base = _blend(_color(rng), _color(rng), ((along + place) % 2).astype(float))
    return np.clip(base * (0.85 + 0.3 * grain(SIDE, SIDE, (3, 20), seed)[..., None]), 0, 255).astype(np.uint8)


def _stone(rng: np.random.Generator, seed: int) -> np.ndarray:
    """Multi-octave noise in two or more colours: stone or patterned cloth."""
    image = _blend(_color(rng), _color(rng), grain(SIDE, SIDE, (4, 4), seed))
    for octave in range(int(rng.integers(1, 4))):
        size = 12.0 * 3.0**octave
        mask = np.clip(8 * (grain(SIDE, SIDE, (size, size), seed + octave + 1) - rng.uniform(0.4, 0.7)), 0, 1)[..., None]
        image = (image * (1 - mask) + np.array(_color(rng)) * mask).astype(np.uint8)
    return image


def _print(rng: np.random.Generator, seed: int) -> np.ndarray:
    """Printed labels: large letters, small print, bar codes and tables."""
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
