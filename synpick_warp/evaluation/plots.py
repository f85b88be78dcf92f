"""Plots of the evaluation: the paper's trajectory plot, recall curves, error against visibility and speed, sweep curves.

Each function returns an RGB image (H, W, 3) uint8; `charts.write_chart` writes it as PNG. Lengths are in metres, as everywhere in the
evaluation; axes say what they show. A missed detection has the error infinity.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from synpick_warp.errors import DatasetError
from synpick_warp.evaluation.auc import LIMIT
from synpick_warp.evaluation.charts import (
    INK,
    PALETTE,
    SOFT,
    Axis,
    Bars,
    Color,
    Entry,
    Events,
    Image,
    Line,
    Mark,
    Panel,
    Rings,
    draw_chart,
)
from synpick_warp.evaluation.poses import PoseTable
from synpick_warp.evaluation.tracking.sweep import AlphaSweep

_CENTIMETERS = 100.0
_RAW: Color = (170, 178, 188)
"""Colour of unfiltered estimates: behind everything else."""
_MAX_BRIDGE = 5
"""Largest number of missing frames that a trajectory's curve bridges; longer gaps stay open."""
_EVENT: Color = (200, 40, 40)
_BESIDE = 0.5
"""Part of a bin's width in which the methods stand beside each other."""
_WHISKER = 9.0
"""Width of the line from the lower to the upper quartile [px]."""
VISIBILITY_BINS = tuple(round(0.1 * number, 1) for number in range(11))
"""Default bin edges of the visible fraction: finer than the bands of tables."""
SPEED_BINS = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Default bin edges of an object's speed [m/s], finer than the bands of tables; all columns have the same width."""


def plot_trajectory(
    truth: PoseTable,
    estimates: PoseTable,
    filtered: Mapping[str, PoseTable],
    *,
    attempts: Sequence[int] = (),
    method: str = "Estimate",
) -> Image:
    """Trajectory plot of the paper: x, y and z of one instance in the camera frame over the frames of an episode.

    Args:
        truth: True poses of the instance, one row an image.
        estimates: Estimates as the method gave them, one row an image; up to 5 missing images are bridged, longer gaps stay open.
        filtered: Name, such as "Filter alpha 0.05" -> filtered estimates.
        attempts: Frames in which picks were attempted, marked in red.
        method: Name of the method.

    Raises:
        DatasetError: A table has several rows of an image, or there is nothing to draw.
    """
    named = {"Ground truth": truth, method: estimates, **filtered}
    if len(named) != 2 + len(filtered):
        raise DatasetError(f"two curves have the same name; names are Ground truth, {method}, {', '.join(filtered)}: choose others")
    if not len(truth) or not len(estimates):
        raise DatasetError("a trajectory needs at least one true and one estimated pose; choose an instance that was estimated")
    curves = {name: _curve(table, name) for name, table in named.items()}
    colors = {"Ground truth": INK, method: _RAW} | dict(zip(filtered, _colors(len(filtered)), strict=True))
    order = [method, *filtered, "Ground truth"]
    panels = []
    for axis, letter in enumerate("xyz"):
        limits = _trajectory_limits([curves[name][1][:, axis] for name in ("Ground truth", *filtered)], curves[method][1][:, axis])
        lines = [Line(curves[name][0], curves[name][1][:, axis], colors[name], 2.0 if name == method else 3.0) for name in order]
        at = np.asarray(attempts, np.float64)
        events = [Events(at, _EVENT)] if len(attempts) else []
        discs = [Events(at, _EVENT, discs=True)] if len(attempts) and axis == 0 else []
        panels.append(Panel(Axis(f"{letter} [m]", *limits), [*events, *lines, *discs], 330))
    legend = [Entry(name, colors[name]) for name in named] + ([Entry("Pick attempt", _EVENT, disc=True)] if len(attempts) else [])
    images = np.concatenate([table.image for table in named.values()])
    first, last = int(images.min()), int(images.max())
    return draw_chart(Axis("Frame", first, max(last, first + 1)), panels, legend)


def plot_recall(errors: Mapping[str, np.ndarray], *, metric: str = "ADD-S", max_error: float = LIMIT) -> Image:
    """Accuracy-threshold curves: the fraction of instances with an error of at most the threshold.

    Args:
        errors: Name of a method or an object -> errors of all instances (N,) [m], infinity for misses; a name may tell the area.
        metric: Name of the error.
        max_error: Largest threshold [m].
    """
    threshold = np.linspace(0.0, max_error, 1001)
    curves = {name: np.searchsorted(np.sort(_checked(name, one)), threshold, side="right") / len(one) for name, one in errors.items()}
    colors = _colors(len(curves))
    lines = [Line(_CENTIMETERS * threshold, 100 * one, color, 3.5) for one, color in zip(curves.values(), colors, strict=True)]
    x = Axis(f"{metric} threshold [cm]", 0.0, _CENTIMETERS * max_error)
    return draw_chart(x, [Panel(Axis("Recall [%]", 0.0, 100.0), lines, 640)], _entries(curves, colors))


def plot_error_by_visibility(
    visibility: np.ndarray, errors: Mapping[str, np.ndarray], *, metric: str = "ADD-S", edges: Sequence[float] = VISIBILITY_BINS
) -> Image:
    """Error against the visible fraction of instances (N,), from 0 to 1; otherwise as `plot_error_by_speed`."""
    ticks = [f"{100 * edge:g}" for edge in edges]
    return _plot_bins(np.asarray(visibility, np.float64), errors, metric, np.asarray(edges, np.float64), ticks, "Visible fraction [%]")


def plot_error_by_speed(
    speed: np.ndarray, errors: Mapping[str, np.ndarray], *, metric: str = "ADD-S", edges: Sequence[float] = SPEED_BINS
) -> Image:
    """Error against speed: median and quartiles of each bin, and below them the number of instances.

    Args:
        speed: Speed of each true instance (N,) [m/s].
        errors: Name of a method -> error of each instance (N,) [m]; infinity for misses, which count as `LIMIT` as larger errors do.
        metric: Name of the error.
        edges: Rising bin edges [m/s]; values beyond them count in the outermost bins.
    """
    ticks = [f"{_CENTIMETERS * edge:g}" for edge in edges]
    return _plot_bins(np.asarray(speed, np.float64), errors, metric, np.asarray(edges, np.float64), ticks, "Speed of the object [cm/s]")


def plot_sweep(sweep: AlphaSweep, *, score: str = "ADD-S AUC") -> Image:
    """Score against the filter's weight for each mode; rings mark the optima, thin lines the unfiltered scores."""
    alphas, colors = np.array(sweep.alphas), _colors(len(sweep.modes))
    marks: list[Mark] = []
    for raw, color in zip(sweep.unfiltered, colors, strict=True):
        marks.append(Line(np.array([1e-9, 1e9]), np.full(2, raw), _lighten(color), 1.5))
    for mode, scores, color in zip(sweep.modes, sweep.scores, colors, strict=True):
        best = sweep.best(mode)
        marks += [Line(alphas, scores, color, 3.5, dots=True), Rings(np.array(best[:1]), np.array(best[1:]), color)]
    low, high = _padded(np.concatenate((sweep.scores.ravel(), sweep.unfiltered)), 0.1)
    x = Axis(
        "alpha (weight of the new estimate)", alphas[0] / 1.2, alphas[-1] * 1.2, True, tuple((one, f"{one:g}") for one in sweep.alphas)
    )
    legend = _entries([f"{mode}: best {sweep.best(mode)[0]:g}" for mode in sweep.modes], colors)
    legend.append(Entry("Without filter", _RAW, thin=True))
    return draw_chart(x, [Panel(Axis(score, low, high), marks, 640)], legend)


def _plot_bins(values: np.ndarray, errors: Mapping[str, np.ndarray], metric: str, edges: np.ndarray, ticks: list[str], label: str) -> Image:
    """Median and quartiles of errors by bins of equal width on the page, whatever their width in values."""
    if len(edges) < 2 or not (np.diff(edges) > 0).all():
        raise DatasetError(f"bin edges {edges.tolist()} are not allowed; give at least two, rising")
    if values.ndim != 1 or not np.isfinite(values).all():
        raise DatasetError(f"values for {label} are not finite numbers; leave out instances without one")
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    counts = np.bincount(index, minlength=len(edges) - 1)
    marks: list[Mark] = []
    lines: list[Mark] = []
    colors, top = _colors(len(errors)), 0.0
    middle = np.arange(len(counts)) + 0.5
    for number, ((name, one), color) in enumerate(zip(errors.items(), colors, strict=True)):
        if len(_checked(name, one)) != len(values):
            raise DatasetError(f"{name} has {len(one)} errors for {len(values)} instances; give infinity for misses")
        quartiles = _CENTIMETERS * np.array(list(_quartiles(np.minimum(one, LIMIT), index, len(counts)))).T
        # Beside each other, since quartiles of several methods on one place hide each other.
        place = middle + _BESIDE * (number - (len(errors) - 1) / 2) / max(1, len(errors))
        ends = np.stack((quartiles[0], quartiles[2], np.full(len(counts), np.nan)), axis=1)
        marks.append(Line(np.repeat(place, 3), ends.ravel(), _lighten(color), _WHISKER))
        lines.append(Line(place, quartiles[1], color, 3.5, dots=True))
        top = max(top, np.nanmax(quartiles[2], initial=0.0))
    x = Axis(label, 0.0, len(counts), ticks=tuple((float(place), text) for place, text in enumerate(ticks)))
    error = Panel(Axis(f"{metric} error [cm]", 0.0, max(1.04 * top, 0.1)), [*marks, *lines], 560)
    bars = Bars(np.arange(len(edges), dtype=np.float64), 100 * counts / max(1, len(values)), SOFT)
    share = Panel(Axis("Instances [%]", 0.0, max(1.0, 110 * counts.max() / max(1, len(values)))), [bars], 250)
    return draw_chart(x, [error, share], _entries(errors, colors))


def _quartiles(errors: np.ndarray, index: np.ndarray, count: int) -> Iterator[np.ndarray]:
    """Lower quartile, median and upper quartile (3,) of each bin; NaN where it is empty."""
    for number in range(count):
        members = errors[index == number]
        yield np.percentile(members, (25, 50, 75)) if len(members) else np.full(3, np.nan)


def _checked(name: str, errors: np.ndarray) -> np.ndarray:
    """Check errors (N,): at least one, none negative or NaN."""
    errors = np.asarray(errors)
    if errors.ndim != 1 or not len(errors) or not (errors >= 0.0).all():
        raise DatasetError(f"errors of {name} have shape {errors.shape} or a value that is no error; give one number >= 0 an instance")
    return errors


def _curve(table: PoseTable, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Frames (n,) and translations (n, 3) [m] in the order of time, with a row of NaN where more than `_MAX_BRIDGE` frames are missing."""
    order = np.argsort(table.image, kind="stable")
    steps = np.diff(table.image[order])
    if not (steps > 0).all():
        raise DatasetError(f"{name} has several rows of an image; a trajectory is of one instance: select the rows of one track")
    gaps = 1 + np.flatnonzero(steps > 1 + _MAX_BRIDGE)
    frames = np.insert(table.image[order].astype(np.float64), gaps, np.nan)
    return frames, np.insert(table.translation[order], gaps, np.nan, axis=0)


def _trajectory_limits(smooth: list[np.ndarray], raw: np.ndarray) -> tuple[float, float]:
    """Range of an axis: all of truth and filter, and the estimates but for 1 % at either end, which may be far outliers."""
    known = raw[np.isfinite(raw)]
    return _padded(np.concatenate([*(one[np.isfinite(one)] for one in smooth), np.percentile(known, (1, 99))]), 0.08)


def _padded(values: np.ndarray, margin: float) -> tuple[float, float]:
    """Range of values with a margin, which is a fraction of it; never empty."""
    low, high = float(values.min()), float(values.max())
    span = max(high - low, 0.01 * max(1.0, abs(high)))
    middle = (low + high) / 2
    return middle - (0.5 + margin) * span, middle + (0.5 + margin) * span


def _colors(count: int) -> list[Color]:
    """Colours of curves; more than the palette has are repeated, darker."""
    rounds = [tuple(part // (1 + turn) for part in color) for turn in range(1 + count // len(PALETTE)) for color in PALETTE]
    return [(red, green, blue) for red, green, blue in rounds[:count]]


def _entries(names: Iterable[str], colors: list[Color]) -> list[Entry]:
    """Legend of curves."""
    return [Entry(name, color) for name, color in zip(names, colors, strict=True)]


def _lighten(color: Color) -> Color:
    """Half way to white."""
    red, green, blue = ((255 + part) // 2 for part in color)
    return red, green, blue
