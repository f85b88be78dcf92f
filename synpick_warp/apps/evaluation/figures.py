"""Pictures of an evaluation: recall curves, error against visibility and speed, the paper's trajectory plot, sweep of the filter's weight.

All are drawn before the first is written.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from synpick_warp.apps.evaluation.models import Model
from synpick_warp.apps.evaluation.plots import plot_error_by_speed, plot_error_by_visibility, plot_recall, plot_sweep, plot_trajectory
from synpick_warp.apps.evaluation.poses import PoseTable
from synpick_warp.apps.evaluation.scoring import METRICS, Scores, score
from synpick_warp.apps.evaluation.tables import summarize
from synpick_warp.apps.evaluation.tracking import AlphaSweep, find_tracks, split_by_mode, sweep_alpha, track_of_instance
from synpick_warp.apps.evaluation.truth import Truth
from synpick_warp.errors import ConfigError, OutputError
from synpick_warp.exporters.writing.files import output_errors, write_atomically
from synpick_warp.system.codecs.charts import Spec, render_charts
from synpick_warp.system.inputs.paths import make_folder

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
    """Draw all pictures.

    Args:
        truth: Ground truth.
        methods: Methods; names differ.
        scores: Scores to compare, at least one, all with the same targets.
        settings: How they were scored.
        track: Track of the trajectory plot; None: of the tracks that all methods have, the one that moves farthest.
        attempts: Episode -> frames of its pick attempts.

    Returns:
        File name -> PNG file. There is no trajectory if all methods have no track of two images in common, and no error by visibility
        or speed if none is known.

    Raises:
        ConfigError: The track is not in the ground truth, or a method has no estimate of it.
        ChartError: The charts' library cannot run.
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
    visibility, speed = truth.visibility[target], truth.speed[target]
    known, rated = np.isfinite(speed), np.isfinite(visibility)
    pictures = {}
    for metric in METRICS:
        errors = {each.name: each.errors[metric] for each in scores}
        pictures[f"recall_{_FILES[metric]}.png"] = plot_recall(errors, metric)
        if rated.any():
            shown = {name: values[rated] for name, values in errors.items()}
            pictures[f"error_by_visibility_{_FILES[metric]}.png"] = plot_error_by_visibility(visibility[rated], shown, metric)
        if known.any():
            moving = {name: values[known] for name, values in errors.items()}
            pictures[f"error_by_speed_{_FILES[metric]}.png"] = plot_error_by_speed(speed[known], moving, metric)
    return pictures


def _draw_trajectory(truth: PoseTable, method: Method, track: Track, attempts: Sequence[int]) -> Spec:
    """Specification of the figure of a method's estimates along one track."""
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
    """Rows of the ground truth of a track (n,)."""
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


def check_folder(folder: Path) -> None:
    """Check that the folder for pictures is new or empty, and below a folder; whether it can be written is not tested.

    Raises:
        OutputError: It is not, or cannot be read.
    """
    try:
        if os.path.lexists(folder) and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(f"--plots is {folder}; allowed: a new folder, or an empty one")
        parent = next(path for path in folder.absolute().parents if os.path.lexists(path))
    except (OSError, ValueError) as error:
        raise OutputError(f"--plots is {folder}: {getattr(error, 'strerror', None) or error}; name another folder") from error
    if not parent.is_dir():
        raise OutputError(f"--plots is {folder}, but {parent} is a file; name another folder")


def write_figures(folder: Path, pictures: Mapping[str, bytes]) -> Iterator[Path]:
    """Write PNG files to a folder, which is created; yields the path of each once it is written.

    Raises:
        OutputError: A file cannot be written.
    """
    for name, picture in pictures.items():
        with output_errors(folder / name):
            make_folder(folder)
            write_atomically(folder / name, picture)
        yield folder / name
