"""Embedded objects that are open vessels with walls: bowl, mug, pitcher. Lengths [m]."""

from __future__ import annotations

import numpy as np

from synpick_warp.scenes.embedded import textures as paint
from synpick_warp.scenes.embedded.packs import Shape
from synpick_warp.scenes.modelling import Patch, Rect, ellipse, join, lathe, sections, solid, sweep

SIDES = 48
"""Points per ring of a vessel."""


def bowl() -> Shape:
    """Shape of an enamel bowl: red outside, cream inside, a dark rim; symmetric about its axis."""
    outside = [
        (0.032, -0.0275),
        (0.034, -0.0275),
        (0.0345, -0.0262),
        (0.044, -0.0235),
        (0.058, -0.0150),
        (0.069, -0.0030),
        (0.0765, 0.0110),
    ]
    upper = [(0.0765, 0.0110), (0.0800, 0.0250)]
    rim = [(0.0800, 0.0250), (0.0807, 0.0266), (0.0802, 0.0275), (0.0790, 0.0272), (0.0780, 0.0255)]
    inside = [(0.0780, 0.0255), (0.0742, 0.0110), (0.0668, -0.0024), (0.0560, -0.0136), (0.0425, -0.0215), (0.0260, -0.0240)]
    red, cream, dark = (176, 32, 30), (238, 230, 210), (50, 24, 22)
    images = {"red": paint.blank(16, 16, red), "cream": paint.blank(16, 16, cream), "dark": paint.blank(16, 16, dark)}
    texture, at = paint.pack(images, 128)
    parts = (outside, "red"), (upper, "cream"), (rim, "dark"), (inside, "cream")
    return sections(*((lathe(part, SIDES), at[name]) for part, name in parts), ends=(at["dark"], at["cream"])), texture


def mug() -> Shape:
    """Shape of a mug with a print in front and a handle to the right of it."""
    outside = [(0.0465, -0.0385), (0.0465, -0.02), (0.0465, 0.0), (0.0465, 0.02), (0.0465, 0.0365)]
    foot = [(0.0400, -0.0392), (0.0405, -0.0407), (0.0440, -0.0407), (0.0457, -0.0400), (0.0465, -0.0385)]
    rim = [(0.0465, 0.0365), (0.0465, 0.0395), (0.0458, 0.0405), (0.0438, 0.0405), (0.0430, 0.0395)]
    inside = [(0.0430, 0.0395), (0.0430, 0.0), (0.0430, -0.0310), (0.0405, -0.0350), (0.0360, -0.0365)]
    blue = (36, 96, 132)
    images = {"print": _mug_print(900, 230, blue), "blue": paint.plain(blue, 1401), "cream": paint.plain((240, 236, 224), 1402)}
    texture, at = paint.pack(images, 1024)
    parts = (foot, "blue"), (outside, "print"), (rim, "blue"), (inside, "cream")
    body = sections(*((lathe(part, SIDES), at[name]) for part, name in parts), ends=(at["cream"], at["cream"]))
    return join(body, _handle((0.0446, 0.0247, 0.0255), (0.013, 0.0085), at["blue"])), texture


def pitcher() -> Shape:
    """Shape of an open pitcher with spout, handle and a scale."""
    outside = [(0.054, -0.1190), (0.0555, -0.1170), (0.0580, -0.06), (0.0605, 0.0), (0.0628, 0.05), (0.0648, 0.09), (0.0660, 0.1195)]
    foot = [(0.0500, -0.1205), (0.0505, -0.1212), (0.0530, -0.1212), (0.0540, -0.1190)]
    rim = [(0.0660, 0.1195), (0.0658, 0.1212), (0.0640, 0.1212), (0.0632, 0.1195)]
    inside = [(0.0632, 0.1195), (0.0620, 0.09), (0.0600, 0.05), (0.0577, 0.0), (0.0552, -0.06), (0.0530, -0.1130), (0.0460, -0.1165)]
    blue = (44, 92, 178)
    images = {"scale": _pitcher_scale(960, 560, blue), "blue": paint.plain(blue, 1101)}
    texture, at = paint.pack(images, 1024)
    parts = (foot, "blue"), (outside, "scale"), (rim, "blue"), (inside, "blue")
    body = sections(*((_add_spout(lathe(part, SIDES)), at[name]) for part, name in parts), ends=(at["blue"], at["blue"]))
    wall_tilt = 2.56  # draft angle of the wall [°]
    handle = _handle((0.0597, 0.030, 0.075), (0.024, 0.011), at["blue"]).rotate("y", wall_tilt).translate(0.0, 0.0, 0.012)
    return join(body, handle), texture


def _handle(reach: tuple[float, float, float], section: tuple[float, float], rect: Rect) -> Patch:
    """Handle towards +x, swept along a superellipse, whose ends lie inside the wall.

    Args:
        reach: x of its ends, its extent from there, and half the distance between its ends.
        section: Width and thickness.
        rect: Texture rectangle.
    """
    start, out, half = reach
    angles = np.linspace(np.pi / 2, -np.pi / 2, 33)
    bend = 2 / 2.8
    x = start + (out - section[1] / 2) * np.abs(np.cos(angles).round(12)) ** bend
    z = half * np.sign(np.sin(angles)) * np.abs(np.sin(angles)) ** bend
    path = np.stack([x, np.zeros_like(x), z], axis=1)
    return solid(sweep(path, ellipse(*section, 16, 2.4), np.ones((len(path), 1)), (0.0, 1.0, 0.0)), rect)


def _add_spout(rings: np.ndarray) -> np.ndarray:
    """Form a spout: displace the upper part of the rings towards -x, with a Gaussian profile in azimuth."""
    azimuth = np.arctan2(rings[..., 1], -rings[..., 0])
    height = np.clip((rings[..., 2] - 0.05) / 0.07, 0, 1)
    pull = 0.013 * height**2 * np.exp(-((azimuth / 0.32) ** 2))
    return rings - pull[..., None] * np.array([1.0, 0.0, 0.0])


def _mug_print(width: int, height: int, color: paint.Color) -> np.ndarray:
    """Texture of a mug's outside, with its print."""
    image = paint.blank(width, height, color)
    paint.fill(image, (0.0, 0.0, 1.0, 0.08), (240, 236, 224))
    paint.fill(image, (0.0, 0.92, 1.0, 1.0), (240, 236, 224))
    for angle in np.arange(12) * np.pi / 6:
        paint.dot(image, 0.32 + 0.058 * np.cos(angle), 0.5 + 0.227 * np.sin(angle), 0.055, (246, 190, 60))
    paint.dot(image, 0.32, 0.5, 0.2, (246, 190, 60))
    paint.write(image, "GOOD", (0.405, 0.2, 0.62, 0.5), (240, 236, 224))
    paint.write(image, "MORNING", (0.405, 0.52, 0.62, 0.8), (246, 190, 60))
    return image


def _pitcher_scale(width: int, height: int, color: paint.Color) -> np.ndarray:
    """Texture of a pitcher's outside, with the measuring scale."""
    image = paint.plain(color, 1102)[:64, :64]
    image = np.tile(image, (height // 64 + 1, width // 64 + 1, 1))[:height, :width].copy()
    pale = (222, 232, 248)
    for step in range(1, 9):
        y = 0.93 - 0.09 * step
        paint.fill(image, (0.5, y, 0.5 + (0.055 if step % 2 else 0.09), y + 0.008), pale)
        if step % 2 == 0:
            paint.write(image, f"{step // 2 * 0.5:.1f} l", (0.42, y - 0.03, 0.49, y + 0.035), pale, paint.FONT)
    return image
