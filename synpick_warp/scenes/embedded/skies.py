"""The embedded HDR environment maps: six procedural skies and interiors. Radiance in arbitrary units; a white wall is about 1."""

from functools import cache

import numpy as np

from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.system.linear_algebra import dot

HEIGHT = 128
"""Rows of an embedded map; it has twice as many columns."""

Rgb = tuple[float, float, float]


@cache
def skies() -> tuple[EnvironmentMap, ...]:
    """Make the embedded environment maps, sorted by name; deterministic, once a process, so read only."""
    view, _ = map_directions(HEIGHT)
    functions = {
        "low_sun": _low_sun,
        "mixed_lamps": _mixed_lamps,
        "overcast": _overcast,
        "softboxes": _softboxes,
        "warehouse": _warehouse,
        "window": _window,
    }
    maps = {name: np.maximum(make(view), 0.0).astype(np.float32) for name, make in sorted(functions.items())}
    for radiance in maps.values():
        radiance.flags.writeable = False
    return tuple(EnvironmentMap(name, radiance) for name, radiance in maps.items())


def _overcast(view: np.ndarray) -> np.ndarray:
    """CIE overcast sky, with (1 + 2 sin h) / 3 of the zenith's radiance at elevation h, over a grey ground."""
    sky = np.array((1.55, 1.65, 1.80)) * ((1 + 2 * np.clip(view[..., 2:], 0, 1)) / 3)
    return _ground(view, sky, (0.28, 0.27, 0.25))


def _low_sun(view: np.ndarray) -> np.ndarray:
    """A clear sky, blue above and pale at the horizon, and a low warm sun."""
    up = np.clip(view[..., 2:], 0, 1)
    near = dot(view, _direction(35.0, 22.0))
    sky = np.array((0.22, 0.42, 0.90)) * up**0.5 + np.array((0.95, 0.88, 0.76)) * (1 - up) ** 4 * 0.8
    glow = np.array((1.0, 0.72, 0.40)) * (1.6 * np.exp((near - 1) * 18) + 0.25 * np.exp((near - 1) * 3))[..., None]
    sun = np.array((1.0, 0.82, 0.58)) * (900 * np.exp((near - 1) * 2600))[..., None]
    return _ground(view, sky + glow + sun, (0.34, 0.28, 0.21))


def _softboxes(view: np.ndarray) -> np.ndarray:
    """Radiance of a dim studio with two large panels overhead and a small one behind."""
    room = _room(view, (0.16, 0.16, 0.17), (0.10, 0.10, 0.10))
    room += np.array((15.0, 14.6, 14.0)) * _panel(view, (0.9, 0.2), (0.42, 0.62), 0.06)
    room += np.array((8.5, 8.9, 9.6)) * _panel(view, (-0.9, -0.3), (0.38, 0.55), 0.06)
    return room + np.array((5.0, 5.0, 5.0)) * _panel(view, (0.1, -1.9), (0.6, 0.25), 0.06)


def _warehouse(view: np.ndarray) -> np.ndarray:
    """Radiance of a hall with five rows of ceiling lamps."""
    hall = _room(view, (0.34, 0.35, 0.35), (0.22, 0.21, 0.20))
    for row in np.linspace(-2.0, 2.0, 5):
        for place in np.linspace(-2.4, 2.4, 7):
            hall += np.array((13.0, 13.4, 12.6)) * _panel(view, (place, row), (0.22, 0.05), 0.025)
    return hall


def _window(view: np.ndarray) -> np.ndarray:
    """A room with a large window on its +y side, sky in its upper part and trees in its lower."""
    room = _room(view, (0.30, 0.28, 0.25), (0.20, 0.16, 0.12))
    depth = np.maximum(view[..., 1], 1e-6)
    across, rise = view[..., 0] / depth, view[..., 2] / depth
    frame = _step(0.85 - np.abs(across), 0.03) * _step(0.62 - np.abs(rise - 0.55), 0.03) * _step(view[..., 1], 0.02)
    bars = 1 - (_step(0.03 - np.abs(across), 0.012) + _step(0.025 - np.abs(rise - 0.62), 0.012)).clip(0, 1)
    sky, trees = (_step(side, 0.12)[..., None] for side in (rise - 0.25, 0.25 - rise))
    outside = np.array((7.0, 8.2, 10.5)) * sky + np.array((1.4, 1.9, 1.0)) * trees
    bounce = np.clip(-view[..., 1], 0, 1)[..., None] ** 2 * np.array((0.45, 0.44, 0.42))
    return room + bounce + outside * (frame * bars)[..., None]


def _mixed_lamps(view: np.ndarray) -> np.ndarray:
    """A warm lamp on one side, a cold panel on the other, a greenish fluorescent tube overhead."""
    room = _room(view, (0.20, 0.19, 0.19), (0.13, 0.12, 0.11))
    for azimuth, elevation, width, color in ((200.0, 38.0, 260.0, (46.0, 27.0, 11.0)), (320.0, 30.0, 420.0, (30.0, 16.0, 6.0))):
        room += np.array(color) * np.exp((dot(view, _direction(azimuth, elevation)) - 1) * width)[..., None]
    room += np.array((5.5, 7.4, 10.8)) * _panel(view, (1.25, 0.6), (0.5, 0.5), 0.08)
    return room + np.array((6.6, 7.8, 6.2)) * _panel(view, (-0.2, -0.4), (0.06, 1.1), 0.04)


def _room(view: np.ndarray, walls: Rgb, floor: Rgb) -> np.ndarray:
    """Radiance of a plain room: walls that get brighter upward, over a floor."""
    return _ground(view, np.array(walls) * (0.7 + 0.6 * np.clip(view[..., 2:], 0, 1)), floor)


def _ground(view: np.ndarray, above: np.ndarray, color: Rgb) -> np.ndarray:
    """Composite radiance `above` the horizon with a ground of one colour; the soft horizon is just below eye height."""
    fraction = _step(view[..., 2] + 0.02, 0.03)[..., None]
    return above * fraction + np.array(color) * (0.75 - 0.25 * view[..., 2:]) * (1 - fraction)


def _panel(view: np.ndarray, center: tuple[float, float], half: tuple[float, float], soft: float) -> np.ndarray:
    """Coverage (H, W, 1) by a horizontal panel at height 1: centre and half size in units of that height."""
    height = np.maximum(view[..., 2], 1e-6)
    x, y = view[..., 0] / height - center[0], view[..., 1] / height - center[1]
    inside = _step(half[0] - np.abs(x), soft) * _step(half[1] - np.abs(y), soft) * _step(view[..., 2] - 0.1, 0.05)
    return inside[..., None]


def _step(value: np.ndarray, width: float) -> np.ndarray:
    """Smoothstep from 0 to 1, over ± `width` about zero."""
    t = np.clip(value / width * 0.5 + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def _direction(azimuth: float, elevation: float) -> np.ndarray:
    """Unit direction from azimuth and elevation [°]."""
    phi, theta = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.sin(theta)])
