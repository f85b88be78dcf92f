"""Cross-validation of the sensor model over sequences: noise and grazing angle fitted to one predict deviation and holes of another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from synpick_warp.configs.cell.sensors import DepthSensor
from tools.options import Row
from tools.reports.real_frames import RealFrame
from tools.reports.sensor.alignment import robust_deviation
from tools.reports.sensor.measure import Samples, collect, fit_noise, lever_of
from tools.reports.sensor.scene import RealScenes

GRAZING = (73.0, 76.0, 79.0, 82.0, 85.0, 89.0)
"""Grazing angles that are simulated [°], to the limit of the setting; between them the rate of holes is interpolated."""


def cross_validate(scenes: RealScenes, poses: Sequence[np.ndarray], sensor: DepthSensor, seed: int = 0) -> list[Row]:
    """Fit noise and grazing angle to each sequence, and predict each other one.

    Args:
        scenes: The frames, of at least two sequences; of one, there are no rows.
        poses: Of each frame, object to camera (N, 4, 4) [m], aligned.
        sensor: The settings that are not fitted.
        seed: Seed of the noise.

    Returns:
        Rows whose part is the pair of sequences.
    """
    frames = scenes.frames
    chosen = {name: _rows_of(frames, name) for name in sorted({frame.sequence for frame in frames})}
    if len(chosen) < 2:
        return []
    rates: dict[int, list[float]] = {name: [] for name in chosen}
    samples: dict[int, Samples] = {}
    for angle in GRAZING:
        rendered = scenes.render(poses, replace(sensor, grazing_angle=angle), seed)
        for name, rows in chosen.items():
            samples[name] = collect(frames, rendered, [frame.depth for frame in frames], rows)
            rates[name].append(hole_rate(collect(frames, rendered, list(rendered.sensor), rows)))
    focal = float(frames[0].intrinsics[0, 0])
    found: list[Row] = []
    for fitted, tested in permutations(chosen, 2):
        part = f"fit {fitted:04d}, test {tested:04d}"
        axial, lateral = fit_noise(samples[fitted], focal)
        angle = fit_angle(rates[fitted], hole_rate(samples[fitted]))
        sigma = predict_deviation(samples[tested], focal, axial, lateral)
        holes = float(np.interp(angle, GRAZING, rates[tested]))
        found += [
            Row("fitted: axial noise at 1 m", axial, "mm", part=part),
            Row("fitted: lateral noise", lateral, "px", part=part),
            Row("fitted: grazing angle", angle, "°", part=part),
            *_compare("sigma at 1 m", sigma, robust_deviation(samples[tested].inner.scaled), "mm", part),
            *_compare("holes on objects", holes, hole_rate(samples[tested]), "%", part),
        ]
    return found


def _rows_of(frames: Sequence[RealFrame], sequence: int) -> list[int]:
    """Rows of the frames of a sequence."""
    return [row for row, frame in enumerate(frames) if frame.sequence == sequence]


def hole_rate(samples: Samples) -> float:
    """Rate of holes on objects [%]."""
    return 100.0 * float(samples.hole.mean())


def fit_angle(rates: Sequence[float], measured: float) -> float:
    """Grazing angle [°] at which the simulated rate of holes is the measured one; the nearest of GRAZING if none is.

    Args:
        rates: Rates at GRAZING [%], which fall.
        measured: Measured rate [%].
    """
    return float(np.interp(measured, rates[::-1], GRAZING[::-1]))


def predict_deviation(samples: Samples, focal: float, axial: float, lateral: float) -> float:
    """Robust standard deviation at 1 m [mm] that the law of `fit_noise` predicts for the pixels of a sequence."""
    inner = samples.inner
    deviation = np.hypot(axial, lateral * lever_of(inner.angle, inner.depth, focal))
    return robust_deviation(deviation * np.random.default_rng(0).normal(size=len(deviation)))


def _compare(name: str, predicted: float, measured: float, unit: str, part: str) -> list[Row]:
    """Rows of a predicted and a measured figure, and how far the first is off."""
    off = 100.0 * (predicted / measured - 1.0) if measured else float("nan")
    return [
        Row(f"{name}: predicted", predicted, unit, part=part),
        Row(f"{name}: measured", measured, unit, part=part),
        Row(f"{name}: prediction off by", off, "%", part=part),
    ]
