"""Statistics of measured or simulated depth against rendered depth: bias, standard deviation, holes, correlation, by sequence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares

from tools.options import Row
from tools.reports.real_frames import RealFrame
from tools.reports.sensor.alignment import distances, inside, robust_deviation
from tools.reports.sensor.scene import METRES, Rendered

ANGLES = (0, 20, 35, 50, 65, 80)
"""Bounds of the angle of incidence [°]."""
OUTLINES = (0.0, 3.0, 6.0, 12.0, np.inf)
"""Bounds of the distance to the outline of an object [px]."""
ALBEDOS = (0, 50, 100, 150, 256)
"""Bounds of the base colour, mean of three channels, sRGB to 255."""
LAGS = (1, 4, 8, 16)
"""Distances in a row at which the correlation of noise is taken [px]."""
RING = 16
"""Distance to the objects up to which the plane behind them is compared [px]."""
_ON_PLANE = 0.025
"""Largest distance of measured points from the plane that count as points of it [m]."""
_CELL = 6
"""Width of the cells of the angle of incidence in the fit of noise [°]."""
_FEWEST = 200
"""Fewest pixels of a cell."""
_MILLIMETRES = 1e3


@dataclass(frozen=True, eq=False)
class Samples:
    """Pixel samples (P) of the objects of one sequence, with and without depth."""

    off: np.ndarray
    """Measured minus rendered depth [mm]; NaN: a hole."""
    depth: np.ndarray
    """Rendered depth [m]."""
    angle: np.ndarray
    """Angle of incidence [°]."""
    outline: np.ndarray
    """Distance to the outline [px]."""
    albedo: np.ndarray
    """From 0 to 255."""
    object_id: np.ndarray

    @property
    def hole(self) -> np.ndarray:
        """Pixels without depth."""
        return np.isnan(self.off)

    @property
    def scaled(self) -> np.ndarray:
        """Depth error scaled to 1 m at constant disparity error [mm]: the error divided by the square of the depth in metres."""
        return self.off / self.depth**2

    def select(self, rows: np.ndarray) -> Samples:
        """Some of the pixels."""
        return Samples(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @property
    def inner(self) -> Samples:
        """Pixels with depth, far from the outline, where no neighbour's depth is mixed in."""
        return self.select(~self.hole & (self.outline >= 5))


def collect(frames: Sequence[RealFrame], rendered: Rendered, counts: Sequence[np.ndarray], rows: Sequence[int]) -> Samples:
    """Collect the pixels of the objects of some frames at which annotation and rendering agree on the object.

    Args:
        frames: All frames.
        rendered: Their renderings.
        counts: Measured or simulated depth of each (H, W) [0.1 mm].
        rows: Frames that are collected.
    """
    parts = []
    for row in rows:
        off = np.where(counts[row] > 0, METRES * counts[row] - rendered.depth[row], np.nan)
        angle = np.degrees(np.arccos(np.clip(rendered.cosine[row], 0.0, 1.0)))
        for index, object_id in enumerate(frames[row].object_ids):
            mask = (rendered.owner[row] == index) & frames[row].mask(index)
            outline = distances(rendered.owner[row] == index)
            images = (_MILLIMETRES * off, rendered.depth[row], angle, outline, 255.0 * rendered.albedo[row])
            parts.append([*(image[mask] for image in images), np.full(np.count_nonzero(mask), object_id)])
    return Samples(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def ring_holes(frames: Sequence[RealFrame], rendered: Rendered, counts: Sequence[np.ndarray], rows: Sequence[int]) -> float:
    """Rate of holes in the plane within RING px of the objects, where measured depth is that of the plane or a hole."""
    holes = pixels = 0
    for row in rows:
        near = distances(rendered.owner[row] < 0) <= RING
        measured = frames[row].depth
        plane = (np.abs(METRES * measured - rendered.depth[row]) < _ON_PLANE) | (measured == 0)
        use = near & plane & (rendered.owner[row] == -1)
        holes, pixels = holes + int(((counts[row] == 0) & use).sum()), pixels + int(use.sum())
    return holes / max(1, pixels)


def correlation(frames: Sequence[RealFrame], rendered: Rendered, counts: Sequence[np.ndarray], rows: Sequence[int]) -> dict[int, float]:
    """Autocorrelation of depth errors along image rows, by distance [px]; NaN without errors."""
    products = dict.fromkeys(LAGS, 0.0)
    pairs = dict.fromkeys(LAGS, 0)
    squares = pixels = 0.0
    for row in rows:
        for index in range(len(frames[row].object_ids)):
            use = inside(rendered, row, index) & (counts[row] > 0) & frames[row].mask(index)
            off = _MILLIMETRES * (METRES * counts[row] - np.where(use, rendered.depth[row], 0.0))
            if not use.any():
                continue
            off -= np.median(off[use])
            bound = 4.0 * robust_deviation(off[use])
            off = np.where(use, np.clip(off, -bound, bound), 0.0)
            squares, pixels = squares + float((off**2).sum()), pixels + np.count_nonzero(use)
            for lag in LAGS:
                products[lag] += float((off[:, lag:] * off[:, :-lag]).sum())
                pairs[lag] += int((use[:, lag:] & use[:, :-lag]).sum())
    variance = squares / pixels if squares else float("nan")
    return {lag: products[lag] / max(1, pairs[lag]) / variance for lag in LAGS}


def lever_of(angle: np.ndarray, depth: np.ndarray, focal: float) -> np.ndarray:
    """Depth error at 1 m of a lateral error of one pixel [mm/px]: tan θ / (f z)."""
    return _MILLIMETRES * np.tan(np.radians(angle)) / (focal * depth)


def fit_noise(samples: Samples, focal: float) -> tuple[float, float]:
    """Fit axial and lateral noise: variance at 1 m s² + (l tan θ / (f z))², over cells of object and angle of incidence, by robust least
    squares.

    Args:
        samples: Pixels of a sequence.
        focal: Focal length f [px].

    Returns:
        Axial deviation s at 1 m [mm], and lateral deviation l [px].
    """
    inner = samples.inner
    cells = [
        part
        for index in np.unique(inner.object_id)
        for low in range(0, 78, _CELL)
        if len((part := inner.select((inner.object_id == index) & (inner.angle >= low) & (inner.angle < low + _CELL))).off) >= _FEWEST
    ]
    lever = np.array([np.median(lever_of(part.angle, part.depth, focal)) for part in cells])
    found, weight = np.array([robust_deviation(part.scaled) for part in cells]), np.sqrt([len(part.off) for part in cells])
    fit = least_squares(
        lambda guess: weight * (np.hypot(guess[0], guess[1] * lever) - found), (1.5, 1.0), loss="soft_l1", f_scale=float(np.median(weight))
    )
    axial, lateral = np.abs(fit.x).tolist()
    return axial, lateral


def statistics(frames: Sequence[RealFrame], rendered: Rendered, counts: Sequence[np.ndarray], rows: Sequence[int]) -> Iterator[Row]:
    """Statistics of a sequence, as rows of a report."""
    samples = collect(frames, rendered, counts, rows)
    inner = samples.inner
    axial, lateral = fit_noise(samples, float(frames[0].intrinsics[0, 0]))
    yield Row("bias", float(np.median(inner.off)), "mm")
    yield Row("sigma", robust_deviation(inner.off), "mm")
    yield Row("sigma at 1 m", robust_deviation(inner.scaled), "mm")
    yield Row("sigma at 1 m, axial part", axial, "mm")
    yield Row("lateral noise", lateral, "px")
    yield Row("holes on objects", 100.0 * float(samples.hole.mean()), "%")
    yield Row(f"holes in the plane, to {RING} px", 100.0 * ring_holes(frames, rendered, counts, rows), "%")
    for low, high in pairwise(ANGLES):
        part = inner.select((inner.angle >= low) & (inner.angle < high))
        yield Row(f"sigma at 1 m, {low} to {high}°", robust_deviation(part.scaled) if len(part.off) >= _FEWEST else float("nan"), "mm")
    yield from _holes(samples, samples.outline, OUTLINES, "px from the outline")
    away = samples.select(samples.outline > OUTLINES[2])
    yield from _holes(away, away.angle, (*ANGLES, 90), "°")
    yield from _holes(away, away.albedo, ALBEDOS, "of 255 albedo")
    for lag, value in correlation(frames, rendered, counts, rows).items():
        yield Row(f"correlation at {lag} px", value)
    for index in np.unique(samples.object_id):
        part = samples.select(samples.object_id == index)
        yield Row(f"object {index}: bias", float(np.median(part.inner.off)), "mm")
        yield Row(f"object {index}: sigma at 1 m", robust_deviation(part.inner.scaled), "mm")
        yield Row(f"object {index}: holes", 100.0 * float(part.hole.mean()), "%")


def _holes(samples: Samples, values: np.ndarray, bounds: Sequence[float], unit: str) -> Iterator[Row]:
    """Rates of holes by bins of a property; NaN where too few pixels are."""
    for low, high in pairwise(bounds):
        part = samples.hole[(values >= low) & (values < high)]
        name = f"holes, {low:g} to {high:g} {unit}" if np.isfinite(high) else f"holes, over {low:g} {unit}"
        yield Row(name, 100.0 * float(part.mean()) if len(part) >= _FEWEST else float("nan"), "%")
