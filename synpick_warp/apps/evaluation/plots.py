"""Plots of the evaluation: the paper's trajectory plot, recall curves, error against visibility and speed, sweep curves.

Each function returns a chart as `system.codecs.charts` renders it. Lengths are in metres, as everywhere in the evaluation; axes say what
they show. A missed detection has the error infinity.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from synpick_warp.apps.evaluation.auc import LIMIT
from synpick_warp.apps.evaluation.poses import PoseTable
from synpick_warp.apps.evaluation.tracking import AlphaSweep
from synpick_warp.errors import DatasetError
from synpick_warp.system.codecs.charts import INK, PALETTE, SOFT, Legend, Spec, axis, chart, line, panel, points

_CENTIMETERS = 100.0
_RAW = "#aab2bc"
"""Colour of unfiltered estimates: behind everything else."""
_MAX_BRIDGE = 5
"""Largest number of missing frames that a trajectory's curve bridges; longer gaps stay open."""
_EVENT, _EVENT_LINE = "#c82828", "#edb8b8"
_BESIDE = 0.5
"""Part of a bin's width in which the methods stand beside each other."""
_WHISKER = 4.5
"""Width of the line from the lower to the upper quartile [px]."""
_CURVE, _DOT = 1.75, 61.0
"""Width of a curve [px], and area of the discs on it [px²]."""
VISIBILITY_BINS = tuple(round(0.1 * number, 1) for number in range(11))
"""Bin edges of the visible fraction: finer than the bands of tables."""
SPEED_BINS = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Bin edges of an object's speed [m/s], finer than the bands of tables; values beyond count in the outermost bins."""


def plot_trajectory(
    truth: PoseTable,
    estimates: PoseTable,
    filtered: Mapping[str, PoseTable],
    *,
    attempts: Sequence[int] = (),
    method: str = "Estimate",
) -> Spec:
    """Trajectory plot of the paper: x, y and z of one instance in the camera frame over the frames of an episode.

    Args:
        truth: True poses of the instance, one row an image.
        estimates: Estimates as the method gave them, one row an image; up to 5 missing images are bridged, longer gaps stay open.
        filtered: Name, such as "Filter alpha 0.05" -> filtered estimates.
        attempts: Frames in which picks were attempted, marked in red.
        method: Name of the method.

    Raises:
        DatasetError: A table has several rows of an image.
    """
    named = {"Ground truth": truth, method: estimates, **filtered}
    curves = {name: _curve(table, name) for name, table in named.items()}
    order = [method, *filtered, "Ground truth"]
    colors = {"Ground truth": INK, method: _RAW, **dict(zip(filtered, _colors(len(filtered)), strict=True))}
    event = next(name for name in ("Pick attempt", "Pick attempt ", "Pick attempt  ") if name not in colors)
    legend = Legend(colors | ({event: _EVENT} if len(attempts) else {}), disc=event)
    images = np.concatenate([table.image for table in named.values()])
    first, last = int(images.min()), int(images.max())
    at = [frame for frame in attempts if first <= frame <= last]
    panels = []
    for axis_index, letter in enumerate("xyz"):
        known = [curves[name][1][:, axis_index] for name in ("Ground truth", *filtered)]
        low, high = _trajectory_limits(known, curves[method][1][:, axis_index])
        rule = {"mark": {"type": "rule", "color": _EVENT_LINE}, "encoding": {"y": None}}
        layers = [points(rule, low, high, [low] * len(at), x=at)]
        for name in order:
            frames, places = curves[name]
            layers.append(points(line(1.0 if name == method else 1.5, legend.color(name)), low, high, places[:, axis_index], x=frames))
        if len(attempts) and axis_index == 0:
            disc = {"mark": {"type": "circle", "size": 110, "opacity": 1, "yOffset": 6}, "encoding": {"color": legend.color(event)}}
            layers.append(points(disc, low, high, [high] * len(at), x=at))
        panels.append(panel(axis("y", f"{letter} [m]", low, high, tickCount=4), 150, layers))
    return chart(axis("x", "Frame", first, max(last, first + 1), tickCount=5), panels)


def plot_recall(errors: Mapping[str, np.ndarray], metric: str) -> Spec:
    """Accuracy-threshold curves: the fraction of instances with an error of at most the threshold.

    Args:
        errors: Name of a method -> errors of all instances (N,) [m], infinity for misses; the legend shows the names.
        metric: Name of the error.
    """
    threshold = np.linspace(0.0, LIMIT, 1001)
    curves = {name: np.searchsorted(np.sort(one), threshold, side="right") / len(one) for name, one in errors.items()}
    legend = _legend(curves)
    lines = [points(line(_CURVE, legend.color(name)), 0.0, 100.0, 100 * one, x=_CENTIMETERS * threshold) for name, one in curves.items()]
    x = axis("x", f"{metric} threshold [cm]", 0.0, _CENTIMETERS * LIMIT, tickCount=5)
    return chart(x, [panel(axis("y", "Recall [%]", 0.0, 100.0), 300, lines)])


def plot_error_by_visibility(visibility: np.ndarray, errors: Mapping[str, np.ndarray], metric: str) -> Spec:
    """Error against the visible fraction of instances (N,), from 0 to 1: the panels and arguments of `plot_error_by_speed`."""
    return _plot_bins(visibility, errors, metric, VISIBILITY_BINS, 100.0, "Visible fraction [%]")


def plot_error_by_speed(speed: np.ndarray, errors: Mapping[str, np.ndarray], metric: str) -> Spec:
    """Error against speed, in bins: above, median and quartiles of each method [cm]; below, the share of all instances [%].

    Args:
        speed: Speed of each true instance (N,) [m/s].
        errors: Name of a method -> error of each instance (N,) [m]; infinity for misses, which count as `LIMIT` as larger errors do.
        metric: Name of the error.
    """
    return _plot_bins(speed, errors, metric, SPEED_BINS, _CENTIMETERS, "Speed of the object [cm/s]")


def plot_sweep(sweep: AlphaSweep, score: str) -> Spec:
    """Score against the filter's weight for each mode; rings mark the optima, thin lines the unfiltered scores."""
    alphas, colors = np.array(sweep.alphas), _colors(len(sweep.modes))
    names = {mode: f"{mode}: best {sweep.best(mode)[0]:g}" for mode in sweep.modes}
    legend = Legend({**dict(zip(names.values(), colors, strict=True)), "Without filter": _RAW})
    low, high = _padded(np.concatenate((sweep.scores.ravel(), sweep.unfiltered)), 0.1)
    layers = [
        points({"mark": {"type": "rule", "color": color, "opacity": 0.5}, "encoding": {"x": None}}, low, high, [float(raw)])
        for raw, color in zip(sweep.unfiltered, colors, strict=True)
    ]
    for mode, scores in zip(sweep.modes, sweep.scores, strict=True):
        ring = {"mark": {"type": "point", "size": 200, "strokeWidth": 1.5, "opacity": 1}, "encoding": {"color": legend.color(names[mode])}}
        best, score_there = sweep.best(mode)
        layers += [points(line(_CURVE, legend.color(names[mode]), dots=_DOT), low, high, scores, x=alphas)]
        layers += [points(ring, low, high, [score_there], x=[best])]
    layers.append({"data": {"values": []}, "mark": "line", "encoding": {"color": legend.color("Without filter")}})
    x = axis("x", "alpha (weight of the new estimate)", alphas[0] / 1.2, alphas[-1] * 1.2)
    x["axis"] = {"values": alphas.tolist(), "format": "~g", "labelOverlap": True}
    x["scale"] |= {"type": "log"}
    return chart(x, [panel(axis("y", score, low, high), 300, layers)])


def _plot_bins(values: np.ndarray, errors: Mapping[str, np.ndarray], metric: str, edges: Sequence[float], scale: float, label: str) -> Spec:
    """Chart of errors by bins, drawn equally wide: median and quartiles of each method above, the share of instances [%] below.

    `scale`: factor of the edges in the texts of the axis.
    """
    ticks = [f"{scale * edge:g}" for edge in edges]
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    counts = np.bincount(index, minlength=len(edges) - 1)
    legend, columns = _legend(errors), len(edges) - 1
    whiskers, lines, top = [], [], 0.1
    for number, (name, one) in enumerate(errors.items()):
        lower, median, upper = _CENTIMETERS * np.array(list(_quartiles(np.minimum(one, LIMIT), index, columns))).T
        # Beside each other, since quartiles of several methods on one place hide each other.
        place = np.arange(columns) + 0.5 + _BESIDE * (number - (len(errors) - 1) / 2) / max(1, len(errors))
        top = max(top, 1.04 * np.nanmax(upper, initial=0.0))
        bar = {"mark": {"type": "rule", "strokeWidth": _WHISKER, "opacity": 0.5}, "encoding": {"y2": {"field": "y2"}}}
        bar["encoding"]["color"] = legend.color(name)
        filled = np.isfinite(median)
        whiskers.append(points(bar, 0.0, 1e3, lower[filled], y2=upper[filled], x=place[filled]))
        lines.append(points(line(_CURVE, legend.color(name), dots=_DOT), 0.0, 1e3, median, x=place))
    error = panel(axis("y", f"{metric} error [cm]", 0.0, top, tickCount=5), 270, [*whiskers, *lines])
    share = 100 * counts / max(1, len(values))
    inset = 0.02
    bars = {"mark": {"type": "rect", "color": SOFT}, "encoding": {"x2": {"field": "x2"}, "y2": {"datum": 0}}}
    bars = points(bars, 0.0, 100.0, share, x=np.arange(columns) + inset, x2=np.arange(columns) + 1 - inset)
    part = panel(axis("y", "Instances [%]", 0.0, max(1.0, 1.1 * share.max()), tickCount=3), 120, [bars])
    # The texts of edges are numbers.
    x = axis("x", label, 0.0, columns, values=list(range(len(edges))), labelExpr=f"{ticks}[datum.value]", labelOverlap=True)
    return chart(x, [error, part])


def _quartiles(errors: np.ndarray, index: np.ndarray, count: int) -> Iterator[np.ndarray]:
    """Lower quartile, median and upper quartile (3,) of each bin; NaN where it is empty."""
    for number in range(count):
        members = errors[index == number]
        yield np.percentile(members, (25, 50, 75)) if len(members) else np.full(3, np.nan)


def _curve(table: PoseTable, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Frames (n,) and translations (n, 3) [m] in the order of time, with NaN where more than `_MAX_BRIDGE` are missing."""
    order = np.argsort(table.image, kind="stable")
    steps = np.diff(table.image[order])
    if not (steps > 0).all():
        raise DatasetError(f"{name} has several rows of an image; a trajectory is of one instance: select the rows of one track")
    gaps = 1 + np.flatnonzero(steps > 1 + _MAX_BRIDGE)
    frames = np.insert(table.image[order], gaps, table.image[order][gaps - 1] + 1)
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


def _colors(count: int) -> list[str]:
    """Colours of curves; more than the palette has are repeated, darker."""
    rounds = [(color, 1 + turn) for turn in range(1 + count // len(PALETTE)) for color in PALETTE]
    return ["#" + "".join(f"{int(color[at : at + 2], 16) // dim:02x}" for at in (1, 3, 5)) for color, dim in rounds[:count]]


def _legend(names: Mapping[str, object]) -> Legend:
    """Legend that gives each name its own colour, in their order."""
    return Legend(dict(zip(names, _colors(len(names)), strict=True)))
