"""HDR environment maps: the equirectangular parameterization that all of them share, resampling, and their suns and lamps.

Row 0 looks up (+z); azimuth atan2(y, x) lies at the fraction u = azimuth / 2π + 0.5 of the width. The sun that an sIBL set names replaces
what its map shows there, and lamps, the small and bright lights, are split from the rest, so that no light counts twice: renderer and USD
export treat a sun as a light of its own, and the renderer samples each lamp with shadow rays of its own, the rest with paths. Unlike a
median cut (Debevec, 2005), which turns the whole map into lights, this takes what exceeds a contrast threshold, by a mode search (mean
shift; Comaniciu and Meer, 2002).
"""

import functools
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from synpick_warp.scenes.types import Sun
from synpick_warp.system.linear_algebra import DECIMALS, dot, eigh, matmul, norm

BACKGROUND_ROWS = 256
"""Rows of the background, which cameras see out of focus; 0.7° a texel is fine enough to tell lamps apart."""
WHITE_VALUE = 1.25
"""Auto-exposure target: display value (linear) of a white diffuse surface that faces up, under the unoccluded map."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Luminance weights of linear RGB (Rec. 709)."""


def map_directions(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (rows, 2 rows, 3) of a map's texel centres and their solid angles (rows, 2 rows) [sr], read-only.

    Results for up to `BACKGROUND_ROWS` rows are cached; those for larger maps would take too much memory.
    """
    return _cached_directions(rows) if rows <= BACKGROUND_ROWS else _compute_directions(rows)


def _compute_directions(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions (rows, 2 rows, 3) and solid angles of an equirectangular map's pixels, read-only; uncached `map_directions`."""
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    azimuth = ((np.arange(2 * rows) + 0.5) / (2 * rows) - 0.5) * 2.0 * np.pi
    (down, out), (x, y) = (np.round([np.cos(angle), np.sin(angle)], DECIMALS) for angle in (polar, azimuth))
    directions = np.stack([np.outer(out, x), np.outer(out, y), np.repeat(down[:, None], 2 * rows, axis=1)], axis=-1)
    edges = np.cos(np.arange(rows + 1) / rows * np.pi).round(DECIMALS)
    solid_angles = np.repeat((edges[:-1] - edges[1:])[:, None], 2 * rows, axis=1) * (2.0 * np.pi / (2 * rows))
    for values in (directions, solid_angles):
        values.setflags(write=False)
    return directions, solid_angles


_cached_directions = functools.cache(_compute_directions)


def resize_map(radiance: np.ndarray, rows: int) -> np.ndarray:
    """Resample a map to `rows` rows and twice as many columns: by area where it shrinks, so that energy is kept; float64."""
    if rows <= radiance.shape[0]:
        return cv2.resize(radiance.astype(np.float32), (2 * rows, rows), interpolation=cv2.INTER_AREA).astype(np.float64)
    return _interpolate(_interpolate(radiance.astype(np.float64), rows, 0), 2 * rows, 1)


def _interpolate(values: np.ndarray, count: int, axis: int) -> np.ndarray:
    """Linear interpolation along an axis, from centre to centre; OpenCV's, by Intel's IPP, depends on the processor."""
    at = ((np.arange(count) + 0.5) * (values.shape[axis] / count) - 0.5).clip(0, values.shape[axis] - 1)
    low = at.astype(int)
    high = np.minimum(low + 1, values.shape[axis] - 1)
    share = (at - low).reshape([-1 if each == axis else 1 for each in range(values.ndim)])
    return values.take(low, axis) * (1.0 - share) + values.take(high, axis) * share


SUN_SEARCH_RADIUS = np.radians(15.0)
"""Texels within this angle of its direction can belong to the sun [rad]."""
SUN_CONTRAST = 4.0
"""The part of a texel's luminance above this multiple of the map's mean belongs to the sun."""
MAX_SUN_TANGENT = np.tan(np.radians(4.0)).round(DECIMALS)
"""Tangent of the maximum angular radius of a sun that is a light of its own. A larger one is drawn into the map as a disc."""
SOLAR_TANGENT = np.tan(np.radians(0.267)).round(DECIMALS)
"""Tangent of the real sun's angular radius: the minimum for an sIBL set's sun."""


class ExtractedSun(NamedTuple):
    """Sun of an environment map, and the map without it."""

    rest: np.ndarray
    """The map without the sun (rows, 2 rows, 3)."""
    direction: np.ndarray
    """Unit direction to the sun (3)."""
    irradiance: np.ndarray
    """Irradiance on a surface that faces the sun (3); zero if the map is not bright there."""
    radius_tangent: float


def extract_sun(radiance: np.ndarray, direction: np.ndarray) -> ExtractedSun:
    """Split a map (rows, 2 rows, 3) into the bright light around a unit direction (3), above the horizon, and the rest."""
    directions, solid_angles = map_directions(radiance.shape[0])
    luminance = dot(radiance, LUMINANCE)
    fraction = sun_fraction(radiance, direction)
    weight = fraction * luminance * solid_angles
    if weight.sum() <= 0.0:
        return ExtractedSun(radiance, np.array([0.0, 0.0, 1.0]), np.zeros(3), 0.0)
    center = (weight[..., None] * directions).sum(axis=(0, 1))
    center /= norm(center)
    irradiance = (radiance * (fraction * solid_angles)[..., None]).sum(axis=(0, 1))
    return ExtractedSun(radiance * (1.0 - fraction)[..., None], center, irradiance, disc_radius_tangent(weight, center))


def sun_fraction(radiance: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Fraction (rows, 2 rows) of each texel's radiance that belongs to the sun about a unit direction (3), from 0 to below 1.

    1 - t / luminance within SUN_SEARCH_RADIUS, above the horizon and where luminance exceeds t = SUN_CONTRAST · the map's mean; else 0.
    """
    directions, solid_angles = map_directions(radiance.shape[0])
    luminance = dot(radiance, LUMINANCE)
    threshold = SUN_CONTRAST * (luminance * solid_angles).sum() / (4.0 * np.pi)
    near = dot(directions, direction) > np.cos(SUN_SEARCH_RADIUS).round(DECIMALS)
    near &= (directions[..., 2] > 0.0) & (luminance > threshold)
    return np.where(near, 1.0 - threshold / np.maximum(luminance, 1e-12), 0.0)


def disc_radius_tangent(weight: np.ndarray, direction: np.ndarray) -> float:
    """Tangent of the angular radius of a uniform disc about a unit direction (3) with the second moment of texel weights, luminance times
    solid angle (rows, 2 rows)."""
    directions, _ = map_directions(len(weight))
    # The mean squared sine over a disc is half the squared sine of its radius.
    sine = np.sqrt(np.clip(2.0 * (weight * (1.0 - dot(directions, direction) ** 2)).sum() / weight.sum(), 0.0, 0.25))
    return float(sine / np.sqrt(1.0 - sine**2))


def replace_sun(radiance: np.ndarray, sun: Sun) -> ExtractedSun:
    """Replace the bright place of a map (rows, 2 rows, 3) by the sun that its sIBL set names.

    The sun has the set's direction and colour; its luminance is the larger one of the set's sun and the light it replaces: a clipped map
    lacks light, while a map that holds its sun unclipped is more exact than a number set by eye. Its angular radius is that of the
    light it replaces, but no less than the real sun's.
    """
    taken = extract_sun(radiance, sun.direction)
    gain = max(1.0, float(dot(taken.irradiance, LUMINANCE) / dot(sun.irradiance, LUMINANCE)))
    return ExtractedSun(taken.rest, sun.direction, gain * sun.irradiance, max(taken.radius_tangent, float(SOLAR_TANGENT)))


def draw_sun_disc(bright: np.ndarray, direction: np.ndarray, irradiance: np.ndarray, radius_tangent: float) -> np.ndarray:
    """Render a sun as a uniform disc into a black map (rows, 2 rows, 3), with the given irradiance (3) on a surface that faces it, about a
    unit direction (3) above the horizon. `bright`: texels where the map is bright (rows, 2 rows) bool. If any lies in the disc, the disc
    keeps only these: hills hide the rest. `radius_tangent`: tangent of the disc's angular radius; the disc has at least one texel."""
    directions, solid_angles = map_directions(len(bright))
    cosine = np.where(directions[..., 2] > 0.0, dot(directions, direction), -1.0)
    inside = cosine >= min(1.0 / np.sqrt(1.0 + radius_tangent**2), cosine.max())
    if (inside & bright).any():
        inside &= bright
    return inside[..., None] * irradiance / (cosine * solid_angles)[inside].sum()


LAMP_RADIUS = np.radians(6.0)
"""Radius of the search window [rad]: light within this angle of a lamp's center belongs to it. Wider light is split into several lamps.
Windows of 4 and 9 degrees cost 0.1 to 0.6 dB in PSNR."""
LAMP_CONTRAST = SUN_CONTRAST
"""The part of a texel's luminance above this multiple of the map's mean belongs to a lamp, as to a sun."""
MIN_LAMP_SHARE = 0.03
"""Minimum share of a lamp in the irradiance of a surface that faces up; weaker ones stay in the map, which paths sample. 1 %
has 0.1 dB more in PSNR, with 1.6 times as many lamps."""
MIN_LAMP_HEIGHT = 0.15
"""Minimum z of the texel at which a search starts, and of a lamp's direction; light from lower ones does not reach into a tote."""
SEARCH_BLUR = 4.0
"""Standard deviation of the blur of the map, whose brightest texel starts a search [texels]: a lamp's middle, not a single texel."""
SHIFTS = 4
"""Iterations of the mean shift."""
DISC_RINGS, DISC_SPOKES = 16, 64
"""Points along the radius and around a disc from which its sample points are averaged."""


class Lamp(NamedTuple):
    """Lamp: a small and bright light of an environment map, or a part of one."""

    direction: np.ndarray
    """Unit direction to its center (3)."""
    irradiance: np.ndarray
    """Irradiance on a surface that faces it (3)."""
    radius_tangent: float
    """Tangent of the angular radius of the uniform disc with the same second moment."""
    points: np.ndarray
    """Sample points (points, 3): unit directions to parts of equal irradiance; see `stratify_light`."""


def extract_lamps(radiance: np.ndarray, max_lamps: int, points: int, whole: np.ndarray | None = None) -> tuple[np.ndarray, list[Lamp]]:
    """Split a map (rows, 2 rows, 3) into at most `max_lamps` lamps above the horizon and the rest. `points`: sample points of each, a power
    of two. `whole`: the map (rows, 2 rows, 3) that contrast and shares refer to, if a sun was taken from it before; None: `radiance`.
    Returns the map without the lamps, and the lamps, those with the largest irradiance of a surface that faces up first."""
    directions, solid_angles = map_directions(len(radiance))
    luminance = dot(radiance, LUMINANCE)
    total = solid_angles * (luminance if whole is None else dot(whole, LUMINANCE))
    threshold = LAMP_CONTRAST * total.sum() / (4.0 * np.pi)
    min_irradiance = MIN_LAMP_SHARE * (total * np.maximum(directions[..., 2], 0.0)).sum()
    high = directions[..., 2] > MIN_LAMP_HEIGHT
    left, found = luminance, []
    # Searches find lamps by radiance, not by irradiance: twice as many leave some to choose from.
    for _ in range(2 * max_lamps):
        bright = np.maximum(left - threshold, 0.0)
        # Searches start at texels above the threshold: a window around any other could be empty.
        blurred = np.where(high & (bright > 0.0), _blur(bright), 0.0)
        if blurred.max() <= 0.0:
            break
        excess = _shift_window(bright, directions[np.unravel_index(blurred.argmax(), blurred.shape)])
        left = left - excess
        flux, upward = (float((excess * solid_angles * factor).sum()) for factor in (1.0, directions[..., 2]))
        if upward >= max(min_irradiance, MIN_LAMP_HEIGHT * flux):
            found.append((upward, excess))
    found = sorted(found, key=lambda pair: -pair[0])[:max_lamps]
    fractions = [excess / np.maximum(luminance, 1e-12) for _, excess in found]
    lamps = [_build_lamp(radiance * fraction[..., None], points) for fraction in fractions]
    return radiance * (1.0 - sum(fractions, np.zeros_like(luminance)))[..., None], lamps


def _blur(bright: np.ndarray) -> np.ndarray:
    """Gaussian blur of a map (rows, 2 rows) by SEARCH_BLUR [texels]. OpenCV's and SciPy's weights have digits of the processor."""
    reach = np.arange(-round(4 * SEARCH_BLUR), round(4 * SEARCH_BLUR) + 1)
    weights = np.exp(-0.5 * (reach / SEARCH_BLUR) ** 2).round(DECIMALS)
    for axis in (0, 1):
        bright = ndimage.correlate1d(bright, weights / weights.sum(), axis, mode="mirror")
    return bright


def _shift_window(bright: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Mean shift of the search window, from the unit direction `center` (3) of a texel above the threshold.

    Returns the excess luminance `bright` (rows, 2 rows) inside the final window, 0 outside.
    """
    directions, solid_angles = map_directions(len(bright))
    result = bright
    for _ in range(SHIFTS):
        first, last = (np.arccos(center[2]) + np.array([-LAMP_RADIUS, LAMP_RADIUS])) / np.pi * len(bright)
        rows = slice(max(int(first) - 1, 0), int(last) + 2)  # Others are farther from the center.
        inside = (dot(directions[rows], center) > np.cos(LAMP_RADIUS).round(DECIMALS)) & (directions[rows, :, 2] > 0.0)
        excess = np.where(inside, bright[rows], 0.0)
        if not excess.any():
            break
        result = np.pad(excess, ((rows.start, len(bright) - rows.start - len(excess)), (0, 0)))
        center = ((excess * solid_angles[rows])[..., None] * directions[rows]).sum(axis=(0, 1))
        center /= norm(center)
    return result


def _build_lamp(radiance: np.ndarray, points: int) -> Lamp:
    """Build a lamp from a map (rows, 2 rows, 3) that is black elsewhere."""
    directions, solid_angles = map_directions(len(radiance))
    weight = (dot(radiance, LUMINANCE)) * solid_angles
    center = (weight[..., None] * directions).sum(axis=(0, 1))
    center /= norm(center)
    irradiance = (radiance * solid_angles[..., None]).sum(axis=(0, 1))
    lit = weight > 0.0
    samples = stratify_light(weight[lit], directions[lit], points)
    return Lamp(center, irradiance, disc_radius_tangent(weight, center), samples)


def sample_disc(direction: np.ndarray, radius_tangent: float, count: int) -> np.ndarray:
    """Stratified sample points of a uniform disc about a unit direction (3): unit directions (count, 3), as those of `stratify_light`."""
    radius = radius_tangent * np.sqrt((np.arange(DISC_RINGS) + 0.5) / DISC_RINGS)
    angle = 2.0 * np.pi * (np.arange(DISC_SPOKES) + 0.5) / DISC_SPOKES
    across = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    across /= norm(across)
    side = np.stack([across, np.cross(direction, across)])
    # A slight eccentricity makes the first principal axis unique; of a disc, eigenvalue solvers return an arbitrary one.
    offsets = (1.0, 0.999) * (radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1).round(DECIMALS)).reshape(-1, 2)
    directions = direction + matmul(offsets, side)
    return stratify_light(np.ones(len(directions)), directions / norm(directions)[:, None], count)


def stratify_light(weight: np.ndarray, directions: np.ndarray, count: int) -> np.ndarray:
    """Stratified sample points of a light of unit directions (n, 3), by recursive bisection into `count` parts, a power of two, of equal
    weight along the principal axis (a k-d tree). `weight`: weights of the light's texels (n), positive.

    Returns unit directions to the parts' centers (count, 3). Bit k of a point's index says in which half of the k-th bisection it lies, so
    that any aligned run of 2^k points has one in each of the 2^k parts of the first k bisections."""
    mean = (weight[:, None] * directions).sum(axis=0) / weight.sum()
    if count == 1:
        return (mean / norm(mean))[None]
    offset = directions - mean
    axis = eigh(matmul((weight[:, None] * offset).T, offset))[1][:, -1]
    # Eigenvalue solvers differ in the sign of eigenvectors.
    axis *= np.sign(axis[np.abs(axis).argmax()])
    order = np.argsort(dot(offset, axis), kind="stable")
    weight, directions = weight[order], directions[order]
    total = np.cumsum(weight)
    middle = int(np.searchsorted(total, 0.5 * total[-1]))
    # The texel that contains the median is shared between both halves.
    excess = total[middle] - 0.5 * total[-1]
    lower, upper = weight[: middle + 1].copy(), weight[middle:].copy()
    lower[-1] -= excess
    upper[0] = excess
    halves = []
    for part, texels in ((lower, directions[: middle + 1]), (upper, directions[middle:])):
        lit = part > 0.0
        halves.append(stratify_light(part[lit], texels[lit], count // 2))
    return np.stack(halves, axis=1).reshape(count, 3)
