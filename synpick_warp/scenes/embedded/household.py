"""Household objects: vessels with walls (bowl, mug, pitcher), banana, drill, wood block, scissors, marker, clamps, foam. Lengths [m]."""

import numpy as np
from scipy.interpolate import CubicSpline

from synpick_warp.scenes.embedded import textures as paint
from synpick_warp.scenes.embedded.packs import Shape
from synpick_warp.scenes.modelling import (
    BOX_FACES,
    Patch,
    Rect,
    at_height,
    ellipse,
    join,
    lathe,
    rounded_box,
    sections,
    solid,
    sweep,
    torus,
)

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
    """Handle towards +x, swept along a superellipse, whose ends lie inside the wall. `reach`: x of its ends, its extent from there, and
    half the distance between its ends. `section`: width and thickness."""
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
    image = paint.plain(color, 1102)[:64, :64]
    image = np.tile(image, (height // 64 + 1, width // 64 + 1, 1))[:height, :width].copy()
    pale = (222, 232, 248)
    for step in range(1, 9):
        y = 0.93 - 0.09 * step
        paint.fill(image, (0.5, y, 0.5 + (0.055 if step % 2 else 0.09), y + 0.008), pale)
        if step % 2 == 0:
            paint.write(image, f"{step // 2 * 0.5:.1f} l", (0.42, y - 0.03, 0.49, y + 0.035), pale, paint.FONT)
    return image


Points = list[tuple[float, float]]

BLACK = (38, 38, 42)
ORANGE = (236, 112, 28)
STEEL = (186, 189, 194)


def banana() -> Shape:
    """Shape of a banana, lying flat: a tube of pentagonal section along an arc."""
    angle = np.radians(np.linspace(-62, 62, 33))
    bend_radius = 0.1065
    path = np.stack([bend_radius * np.cos(angle), bend_radius * np.sin(angle), np.zeros_like(angle)], axis=1)
    fraction = np.linspace(0, 1, len(angle))
    knots = [0.0, 0.02, 0.07, 0.2, 0.5, 0.75, 0.87, 0.92, 0.98, 1.0]
    radius = np.interp(fraction, knots, [0.0035, 0.0058, 0.0110, 0.0165, 0.0182, 0.0160, 0.0095, 0.0058, 0.0050, 0.0062])
    angles = 2 * np.pi * np.arange(25) / 25
    section = (1 + 0.045 * np.cos(5 * angles))[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    texture, at = paint.pack({"peel": paint.peel(384, 768, 1000), "tip": paint.plain((70, 50, 28), 1002)}, 640)
    rings = sweep(path, section, radius[:, None], (0.0, 0.0, 1.0))
    return sections((rings, at["peel"]), ends=(at["tip"], at["tip"])).rotate("z", 25.0), texture


def drill() -> Shape:
    """Shape of a cordless drill, lying on its side."""
    images = {
        "motor": _drill_label(),
        "black": paint.plain(BLACK, 1501),
        "orange": paint.plain(ORANGE, 1502),
        "steel": paint.brushed(128, 64, STEEL, 1503),
    }
    texture, at = paint.pack(images, 1024)
    motor = [(0.0285, -0.078), (0.0285, -0.05), (0.0285, -0.02), (0.0285, 0.0)]
    tail = [(0.014, -0.092), (0.022, -0.0905), (0.027, -0.0850), (0.0285, -0.078)]
    nose = [(0.0285, 0.0), (0.0275, 0.018), (0.0235, 0.034), (0.021, 0.035)]
    parts = (tail, "black"), (motor, "motor"), (nose, "black")
    housing = sections(*((lathe(part, 40), at[name]) for part, name in parts), ends=(at["black"], at["black"]))
    jaws = [(0.0200, 0.030), (0.0212, 0.033), (0.0212, 0.055), (0.0190, 0.058), (0.0120, 0.087), (0.0085, 0.092)]
    chuck = solid(lathe(jaws, 40), at["steel"])
    grip = [
        (-0.040, 0.040, 0.034, -0.072),
        (-0.037, 0.036, 0.032, -0.050),
        (-0.035, 0.036, 0.033, -0.020),
        (-0.033, 0.039, 0.035, 0.010),
        (-0.031, 0.046, 0.038, 0.032),
        (-0.030, 0.052, 0.040, 0.052),
    ]
    handle = np.stack([at_height(ellipse(width, depth, 32, 2.6) + np.array([x, 0.0]), z) for x, width, depth, z in grip])
    battery = rounded_box((0.114, 0.0565, 0.030), 0.006, dict.fromkeys(BOX_FACES, at["black"])).translate(-0.034, 0.0, -0.0787)
    foot = rounded_box((0.098, 0.050, 0.012), 0.004, dict.fromkeys(BOX_FACES, at["orange"])).translate(-0.036, 0.0, -0.0600)
    trigger = rounded_box((0.016, 0.016, 0.028), 0.004, dict.fromkeys(BOX_FACES, at["orange"])).translate(-0.010, 0.0, 0.020)
    barrel = join(housing, chuck).rotate("y", 90.0).translate(0.0, 0.0, 0.0652)
    return join(barrel, solid(handle, at["black"]), battery, foot, trigger).rotate("x", -90.0), texture


def wood_block() -> Shape:
    """Shape of a square block with four equal sides and two equal ends, so that it is symmetric."""
    texture, at = paint.pack({"side": paint.wood(300, 706, 1600), "end": paint.end_grain(300, 1602)}, 624)
    rects = {name: at["end" if name[1] == "z" else "side"] for name in BOX_FACES}
    return rounded_box((0.0875, 0.0875, 0.206), 0.002, rects), texture


def foam_block() -> Shape:
    """Shape of a foam brick; opposite faces are equal, so that it is symmetric."""
    color = (178, 66, 44)
    images = {"x": paint.foam(312, 202, color, 2100), "y": paint.foam(208, 202, color, 2102), "z": paint.foam(208, 312, color, 2104)}
    texture, at = paint.pack(images, 540)
    return rounded_box((0.0515, 0.0775, 0.0505), 0.003, {name: at[name[1]] for name in BOX_FACES}), texture


def scissors() -> Shape:
    """Shape of scissors, nearly closed, with one larger loop."""
    images = {
        "steel": paint.brushed(256, 64, STEEL, 1700),
        "grip": paint.plain((36, 78, 160), 1701),
        "screw": paint.plain((120, 122, 128), 1702),
    }
    texture, at = paint.pack(images, 512)
    parts = []
    for side, center, radii in ((-1.0, (-0.0270, -0.0660), (0.0150, 0.0240)), (1.0, (0.0250, -0.0640), (0.0175, 0.0305))):
        height = 0.0013 * side
        loop = _loop(center, radii, (0.0152, 0.0110), at["grip"])
        neck = [(center[0] * 0.92, center[1] + radii[1]), (side * 0.013, -0.026), (side * 0.006, -0.010)]
        grip = _bar(neck, 0.0, [0.0130, 0.0105, 0.0070], [0.0120, 0.0125, 0.0110], at["grip"])
        spine = [(side * 0.0095, -0.018), (0.0, 0.0), (-side * 0.0040, 0.020), (-side * 0.0042, 0.060), (-side * 0.0010, 0.0995)]
        blade = _bar(spine, height, [0.0024, 0.0026, 0.0024, 0.0018, 0.0008], [0.0090, 0.0130, 0.0120, 0.0088, 0.0018], at["steel"])
        parts += [loop, grip, blade]
    screw = solid(lathe([(0.0042, -0.0034), (0.0048, -0.0030), (0.0048, 0.0030), (0.0042, 0.0034)], 20), at["screw"])
    return join(*parts, screw), texture


def marker() -> Shape:
    """Shape of a thick marker along y; with bands of colour and no print, so that it is symmetric about its axis."""
    bands = paint.blank(16, 256, (240, 240, 236))
    paint.fill(bands, (0.0, 0.0, 1.0, 0.06), (200, 30, 36))
    paint.fill(bands, (0.0, 0.30, 1.0, 0.34), (28, 28, 32))
    paint.fill(bands, (0.0, 0.38, 1.0, 0.62), (200, 30, 36))
    paint.fill(bands, (0.0, 0.66, 1.0, 0.70), (28, 28, 32))
    images = {"bands": bands, "cap": paint.blank(16, 16, (30, 30, 34)), "plug": paint.blank(16, 16, (200, 30, 36))}
    texture, at = paint.pack(images, 128)
    plug = [(0.0060, -0.0605), (0.0075, -0.0602), (0.0085, -0.0585), (0.0086, -0.0550), (0.0094, -0.0545)]
    barrel = [(0.0094, -0.0545), (0.0094, -0.02), (0.0094, 0.0140)]
    lid = [(0.0094, 0.0140), (0.0103, 0.0145), (0.0103, 0.0200), (0.0100, 0.0215), (0.0100, 0.0450), (0.0093, 0.0590), (0.0080, 0.0605)]
    parts = (plug, "plug"), (barrel, "bands"), (lid, "cap")
    patch = sections(*((lathe(part, 32), at[name]) for part, name in parts), ends=(at["plug"], at["cap"]))
    return patch.rotate("x", -90.0), texture


def clamp() -> Shape:
    """Shape of a spring clamp along y."""
    return _clamp(0.171, 0.120, 0.0380, 1900)


def large_clamp() -> Shape:
    """Shape of a larger spring clamp, along x."""
    patch, texture = _clamp(0.210, 0.164, 0.0345, 2000)
    return patch.rotate("z", -90.0), texture


def _clamp(length: float, width: float, depth: float, seed: int) -> Shape:
    """Shape of a spring clamp along y, symmetric under a rotation by 180° about y."""
    images = {"black": paint.plain(BLACK, seed), "orange": paint.plain(ORANGE, seed + 1), "steel": paint.plain(STEEL, seed + 2)}
    texture, at = paint.pack(images, 512)
    points = ((-0.445, -0.48), (-0.40, -0.40), (-0.30, -0.20), (-0.13, 0.02), (-0.095, 0.13), (-0.125, 0.26), (-0.09, 0.39), (-0.035, 0.48))
    spine = [(x * width, y * length) for x, y in points]
    depths = [depth * factor for factor in (0.55, 0.75, 0.80, 0.95, 0.95, 0.85, 0.70, 0.55)]
    widths = [0.098 * width * factor for factor in (0.6, 1.0, 1.0, 1.2, 1.15, 0.95, 0.75, 0.6)]
    rings = _bar_rings(spine, 0.0, depths, widths)
    sleeve = len(rings) * 2 // 5
    arm = sections((rings[: sleeve + 1], at["orange"]), (rings[sleeve:], at["black"]), ends=(at["orange"], at["black"]))
    pad = rounded_box((0.055 * width, 0.11 * length, 0.75 * depth), 0.0022, dict.fromkeys(BOX_FACES, at["orange"]))
    half = join(arm, pad.translate(-0.036 * width, 0.445 * length, 0.0))
    coil = [(0.055 * width, -depth / 2), (0.065 * width, -0.47 * depth), (0.065 * width, 0.47 * depth), (0.055 * width, depth / 2)]
    pin = solid(lathe(coil, 28), at["steel"]).translate(0.0, 0.075 * length, 0.0)
    return join(half, half.rotate("y", 180.0), pin), texture


def _bar_rings(spine: Points, z: float, depths: list[float], widths: list[float]) -> np.ndarray:
    """Rings of a smooth bar: a superellipse swept along a cubic spline in the plane at height z; depth (along z) and width per point."""
    points = np.array(spine)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    fine = np.linspace(0.0, length[-1], 8 * (len(spine) - 1) + 1)
    path = np.column_stack([CubicSpline(length, points)(fine), np.full(len(fine), z)])
    scales = np.stack([np.interp(fine, length, depths), np.interp(fine, length, widths)], axis=1)
    return sweep(path, ellipse(1.0, 1.0, 16, 3.4), scales, (0.0, 0.0, 1.0))


def _bar(spine: Points, z: float, depths: list[float], widths: list[float], rect: Rect) -> Patch:
    """Closed bar along a spine, as a patch with texture coordinates in `rect`. See `_bar_rings`."""
    return solid(_bar_rings(spine, z, depths, widths), rect)


def _loop(center: tuple[float, float], radii: tuple[float, float], section: tuple[float, float], rect: Rect) -> Patch:
    """A closed oval ring in the plane z = 0; section: depth (along z) and width."""
    angle = 2 * np.pi * np.arange(-1, 37) / 36
    path = np.stack([center[0] + radii[0] * np.cos(angle), center[1] + radii[1] * np.sin(angle), np.zeros_like(angle)], axis=1)
    return torus(sweep(path, ellipse(*section, 14, 2.4), np.ones((len(path), 1)), (0.0, 0.0, 1.0))[1:-1], rect)


def _drill_label() -> np.ndarray:
    """Unrolled label of the motor, with its axis upward; the same print on both sides of the drill."""
    flank = paint.blank(300, 330, ORANGE)
    paint.fill(flank, (0.0, 0.0, 1.0, 0.16), BLACK)
    paint.fill(flank, (0.0, 0.84, 1.0, 1.0), BLACK)
    paint.write(flank, "POWER DRILL", (0.06, 0.28, 0.94, 0.5), BLACK)
    paint.write(flank, "18 V", (0.3, 0.52, 0.7, 0.76), (250, 248, 240))
    for x in np.linspace(0.08, 0.32, 6):
        paint.fill(flank, (x, 0.04, x + 0.02, 0.12), (12, 12, 14))
    one, other = np.rot90(flank), np.rot90(flank, -1)
    middle = other.shape[1] // 2
    return np.ascontiguousarray(np.concatenate([other[:, middle:], one, other[:, :middle]], axis=1))
