"""Pictures of an evaluation: recall curves, error against visibility and speed, the paper's trajectory plot, sweep of the filter's weight.

All are drawn before the first is written, from charts as `system.codecs.charts` renders them. Lengths are in metres, as everywhere in the
evaluation; axes say what they show. A missed detection has the error infinity.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from synpick_warp.apps.evaluation.errors import LIMIT, METRICS, Model, Scores, score
from synpick_warp.apps.evaluation.tables import summarize
from synpick_warp.apps.evaluation.tracking import AlphaSweep, find_tracks, split_by_mode, sweep_alpha, track_of_instance
from synpick_warp.apps.evaluation.truth import PoseTable, Truth
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.writing.files import output_errors, write_atomically
from synpick_warp.system.codecs.charts import INK, PALETTE, SOFT, Legend, Spec, axis, chart, line, panel, points, render_charts
from synpick_warp.system.inputs.files import make_folder

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
BINS: dict[str, tuple[Sequence[float], float, str]] = {
    "visibility": (tuple(round(0.1 * number, 1) for number in range(11)), 100.0, "Visible fraction [%]"),
    "speed": ((0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0), _CENTIMETERS, "Speed of the object [cm/s]"),
}
"""Field of `Truth` -> edges of bins, finer than the bands of tables, factor of the edges in the texts of the axis, and its title. Values
beyond count in the outermost bins."""


def plot_trajectory(
    truth: PoseTable,
    estimates: PoseTable,
    filtered: Mapping[str, PoseTable],
    *,
    attempts: Sequence[int] = (),
    method: str = "Estimate",
) -> Spec:
    """Trajectory plot of the paper: x, y and z of one instance in the camera frame over the frames of an episode.

    Tables have one row an image; up to 5 missing images of the estimates are bridged, longer gaps stay open. `filtered`: name, such as
    "Filter alpha 0.05" -> filtered estimates; `attempts`: frames in which picks were attempted, marked in red. Raises DatasetError if a
    table has several rows of an image.
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
    """Accuracy-threshold curves: fraction of instances within the threshold, from each method's errors (N,) [m], infinity for misses."""
    threshold = np.linspace(0.0, LIMIT, 1001)
    curves = {name: np.searchsorted(np.sort(one), threshold, side="right") / len(one) for name, one in errors.items()}
    legend = _legend(curves)
    lines = [points(line(_CURVE, legend.color(name)), 0.0, 100.0, 100 * one, x=_CENTIMETERS * threshold) for name, one in curves.items()]
    x = axis("x", f"{metric} threshold [cm]", 0.0, _CENTIMETERS * LIMIT, tickCount=5)
    return chart(x, [panel(axis("y", "Recall [%]", 0.0, 100.0), 300, lines)])


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


def plot_error(kind: str, values: np.ndarray, errors: Mapping[str, np.ndarray], metric: str) -> Spec:
    """Error against visible fraction or speed (N,), a key of BINS, in bins that are drawn equally wide: above, median and quartiles of each
    method [cm]; below, the share of all instances [%]. Errors (N,) [m] are infinity for misses, which count as `LIMIT` as larger errors do.
    """
    edges, scale, label = BINS[kind]
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
    return Legend(dict(zip(names, _colors(len(names)), strict=True)))


Track = tuple[int, int]
"""Scene and instance."""
SWEEP_VERTICES = 1000
"""Largest number of a model's vertices in a sweep, which scores each method ten times."""
_FILES = {"ADD": "add", "ADD-S": "add_s", "ADD(-S)": "add_or_s"}
"""Metric -> its name in file names."""
_KNOWN = 0.5
"""Smallest fraction of a track's images that each method has estimated, of a track that is chosen."""


@dataclass(frozen=True, eq=False)
class Method:
    """Estimates of one method."""

    name: str
    poses: PoseTable
    filtered: PoseTable | None
    """The same through the tracking filter; None: without one."""
    alpha: float | None
    """The filter's weight."""

    def variants(self) -> list[tuple[str, PoseTable]]:
        """(name, pose table) of the estimates as they came, and filtered if there is a filter."""
        return [(self.name, self.poses)] + ([] if self.filtered is None else [(self.filtered_name, self.filtered)])

    @property
    def filtered_name(self) -> str:
        """Name of the filtered estimates in figures: name and alpha."""
        return f"{self.name} + EMA {self.alpha:g}"


@dataclass(frozen=True, eq=False)
class Settings:
    """Settings by which the methods were scored: models by obj_id, least visible fraction, number of failures shown."""

    models: Mapping[int, Model]
    min_visibility: float
    top: int


def draw_figures(
    truth: Truth,
    methods: Sequence[Method],
    scores: Sequence[Scores],
    settings: Settings,
    track: Track | None = None,
    attempts: Mapping[int, Sequence[int]] | None = None,
) -> dict[str, bytes]:
    """Draw all pictures: file name -> PNG file, of methods with different names, and of scores to compare, at least one, all with the same
    targets.

    The trajectory is that of a track, or of those that all methods have the one that moves farthest; there is none if all methods have no
    track of two images in common, and no error by visibility or speed if none is known. `attempts`: episode -> frames of its pick attempts.
    Raises ConfigError if ground truth or a method lacks the track, and ChartError if the charts' library cannot run.
    """
    charts = _draw_errors(truth, scores)
    world, to_world = replace(truth, poses=truth.motion.to_world(truth.poses)), truth.motion.to_world
    tracked = [replace(one, poses=to_world(one.poses), filtered=one.filtered and to_world(one.filtered)) for one in methods]
    chosen = _farthest_track(world, tracked, settings.min_visibility) if track is None else track
    names = file_names([method.name for method in methods])
    if chosen is not None:
        rows = _track_rows(truth, chosen)
        frames = (attempts or {}).get(int(truth.episode[rows[0]]), ())
        for method, name in zip(tracked, names, strict=True):
            ending = f"scene_{chosen[0]:06d}_instance_{chosen[1]}"
            charts[f"trajectory_{name}_{ending}.png"] = _draw_trajectory(world.poses.select(rows), method, chosen, frames)
    for method, name in zip(methods, names, strict=True):
        if method.filtered is not None:
            charts[f"alpha_sweep_{name}.png"] = plot_sweep(_sweep(truth, method, settings), "ADD-S AUC [%]")
    return dict(zip(charts, render_charts(list(charts.values())), strict=True))


def _draw_errors(truth: Truth, scores: Sequence[Scores]) -> dict[str, Spec]:
    """Specifications of the error figures, of all methods together, by file name."""
    target = scores[0].target
    pictures = {}
    for metric in METRICS:
        errors = {each.name: each.errors[metric] for each in scores}
        pictures[f"recall_{_FILES[metric]}.png"] = plot_recall(errors, metric)
        for kind in BINS:
            values = getattr(truth, kind)[target]
            if (known := np.isfinite(values)).any():
                shown = {name: error[known] for name, error in errors.items()}
                pictures[f"error_by_{kind}_{_FILES[metric]}.png"] = plot_error(kind, values[known], shown, metric)
    return pictures


def _draw_trajectory(truth: PoseTable, method: Method, track: Track, attempts: Sequence[int]) -> Spec:
    rows = _estimated_rows(truth, method)
    if not len(rows):
        raise ConfigError(f"--track is {track[0]}:{track[1]}; {method.name} has no estimate of it; choose another one")
    filtered = {} if method.filtered is None else {method.filtered_name: method.filtered.select(rows)}
    label = f"{method.name} " if method.name == "Ground truth" else method.name
    return plot_trajectory(truth, method.poses.select(rows), filtered, attempts=attempts, method=label)


def _estimated_rows(truth: PoseTable, method: Method) -> np.ndarray:
    """Rows of a method's track of an instance (n,), sorted by image."""
    rows = np.flatnonzero((method.poses.scene == truth.scene[0]) & (method.poses.object_id == truth.object_id[0]))
    part = method.poses.select(rows)
    return rows[track_of_instance(truth, part, find_tracks(part))]


def _track_rows(truth: Truth, track: Track) -> np.ndarray:
    rows = np.flatnonzero((truth.poses.scene == track[0]) & (truth.poses.instance == track[1]))
    if not len(rows):
        raise ConfigError(f"--track is {track[0]}:{track[1]}; the data set has no such scene and instance; give SCENE:INSTANCE")
    return rows


def _farthest_track(truth: Truth, methods: Sequence[Method], min_visibility: float) -> Track | None:
    """Of the tracks that all methods have in half of their images, the one with the longest diagonal of a box around its positions.

    Images count in which the instance is visible enough, so that what falls out of sight is no motion; a track has two of them. If none is
    known so well, it is the farthest that all methods have in any image. None: there is no such track.
    """
    seen = np.flatnonzero(truth.shown(min_visibility))
    keys = np.stack((truth.poses.scene[seen], truth.poses.instance[seen]), axis=1)
    tracks, index, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    order = seen[np.argsort(index.ravel(), kind="stable")]
    starts = np.cumsum(count) - count
    place = truth.poses.translation[order]
    size = np.maximum.reduceat(place, starts) - np.minimum.reduceat(place, starts)
    fallback = None
    for number in np.argsort(-np.linalg.norm(size, axis=1), kind="stable"):
        track = int(tracks[number, 0]), int(tracks[number, 1])
        poses = truth.poses.select(_track_rows(truth, track))
        known = min(len(_estimated_rows(poses, method)) for method in methods)
        if count[number] > 1 and known >= _KNOWN * len(poses):
            return track
        fallback = track if fallback is None and known and count[number] > 1 else fallback
    return fallback


def _sweep(truth: Truth, method: Method, settings: Settings) -> AlphaSweep:
    """ADD-S AUC of each mode for each weight of the filter."""
    thinned = {object_id: model.thinned(SWEEP_VERTICES) for object_id, model in settings.models.items()}
    target = truth.shown(settings.min_visibility)
    seen = set(truth.mode[target].tolist())
    modes = {int(scene): str(mode) for scene, mode in zip(truth.poses.scene, truth.mode, strict=True) if mode in seen}
    poses = truth.motion.to_world(method.poses.select(np.isin(method.poses.scene, list(modes))))

    def score_of(mode: str, estimates: PoseTable) -> float:
        part = truth.select(truth.mode == mode)
        scores = score(method.name, part, truth.motion.to_camera(estimates), thinned, settings.min_visibility, settings.top)
        return summarize(part, [scores], {}, ())[-1].cells[0]["ADD-S exact"]

    return sweep_alpha(split_by_mode(poses, modes), score_of)


def file_names(names: Sequence[str]) -> list[str]:
    """Names of methods as parts of file names, all different."""
    plain = [re.sub("[^A-Za-z0-9.-]+", "_", name).strip("_.")[:60] or "method" for name in names]
    return plain if len({name.lower() for name in plain}) == len(plain) else [f"{number}_{name}" for number, name in enumerate(plain, 1)]


def write_figures(folder: Path, pictures: Mapping[str, bytes]) -> Iterator[Path]:
    """Write PNG files to a folder, which is created; yields their paths. Raises OutputError if a file cannot be written."""
    for name, picture in pictures.items():
        with output_errors(folder / name):
            make_folder(folder)
            write_atomically(folder / name, picture)
        yield folder / name
