"""Evaluation tables: AUC per object, mode, camera, visibility and speed band, several methods side by side, as text, LaTeX, CSV or JSON.

A row for a group of instances is the mean over its objects of each object's area, as in the paper (class-wise average); `mean` is that of
all instances. Areas and recalls are in percent.
"""

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from synpick_warp.apps.evaluation.errors import CONVENTIONS, LIMIT, METRICS, Scores, band_indices, error_bands, recall_curve
from synpick_warp.apps.evaluation.truth import Truth
from synpick_warp.system.codecs.tables import Column, Table, to_csv, to_latex, to_text

FORMATS = ("text", "latex", "csv", "json")
GROUPS = ("object", "mode", "camera", "visibility", "speed")
BANDS = {"visibility": ((0.0, 0.1, 0.25, 0.5, 0.75, 1.0), "visible"), "speed": ((0.0, 0.01, 0.05, 0.1, 0.25, 0.5, math.inf), "m/s")}
"""Field of `Truth` -> limits of its bands, and their unit; the first band of speed holds what rests."""
THRESHOLDS = np.linspace(0.0, LIMIT, 51)
"""Thresholds of the recall curves [m]."""
COLUMNS = tuple(f"{metric} {convention}" for metric in METRICS for convention in CONVENTIONS)
_PERCENT = 100.0


@dataclass(frozen=True)
class ScoreRow:
    """Row of a table: group of instances, their number, and each method's scores by column."""

    group: str
    """What instances are grouped by: one of GROUPS, or "mean"."""
    label: str
    targets: int
    cells: tuple[dict[str, float], ...]
    """For each method: column -> value. AUC by metric and convention [%], `recall` (ADD(-S) below 0.1 m) [%], and the medians of the found
    instances `rotation` [°] and `translation` [mm]; NaN: nothing found."""


def summarize(truth: Truth, scores: Sequence[Scores], names: Mapping[int, str], groups: Sequence[str] = GROUPS) -> list[ScoreRow]:
    """Rows of methods with the same targets, by groups in this order, with names by obj_id; groups without instances are left out."""
    target = scores[0].target
    object_ids = truth.poses.object_id[target]

    def row(group: str, label: str, inside: np.ndarray) -> ScoreRow:
        return ScoreRow(group, label, int(inside.sum()), tuple(_cells(inside, object_ids, each) for each in scores))

    rows = []
    for group in groups:
        for label, inside in _labels(group, truth, target, names):
            if inside.any():
                rows.append(row(group, label, inside))
    return [*rows, row("mean", "mean", np.ones(len(target), bool))]


def _labels(group: str, truth: Truth, target: np.ndarray, names: Mapping[int, str]) -> list[tuple[str, np.ndarray]]:
    """(name, mask (T,)) of each group of instances."""
    values = (truth.poses.object_id if group == "object" else getattr(truth, group))[target]
    if group not in BANDS:
        name = {"object": lambda value: names.get(int(value), f"obj_{value:06d}"), "mode": str, "camera": "camera {}".format}[group]
        return [(name(value), values == value) for value in np.unique(values)]
    edges, unit = BANDS[group]
    index = band_indices(values, edges)
    names_of_bands = (f"over {low:g} {unit}" if math.isinf(high) else f"{low:g} to {high:g} {unit}" for low, high in pairwise(edges))
    return [(name, index == band) for band, name in enumerate(names_of_bands)]


def _cells(inside: np.ndarray, object_ids: np.ndarray, scores: Scores) -> dict[str, float]:
    """Columns of one method for the instances of a mask (T,)."""
    members = [inside & (object_ids == object_id) for object_id in np.unique(object_ids[inside])]
    cells = {}
    for metric in METRICS:
        for convention, area in CONVENTIONS.items():
            cells[f"{metric} {convention}"] = _PERCENT * _mean([area(scores.errors[metric][rows]) for rows in members])
    cells["recall"] = _PERCENT * _mean([float(np.isfinite(scores.errors["ADD(-S)"][rows]).mean()) for rows in members])
    cells["rotation"] = _median(scores.rotation[inside])
    cells["translation"] = 1e3 * _median(scores.translation[inside])
    return cells


def _mean(values: list[float]) -> float:
    return statistics.fmean(values) if values else math.nan


def _median(values: np.ndarray) -> float:
    found = values[np.isfinite(values)]
    return float(np.median(found)) if len(found) else math.nan


def render(rows: Sequence[ScoreRow], truth: Truth, scores: Sequence[Scores], style: str, convention: str = "exact") -> str:
    """Write the table as text, in one of FORMATS; `convention` is that of the areas in text and LaTeX, whereas CSV and JSON have both, and
    JSON recall curves and bands of each object, too."""
    if style == "csv":
        return to_csv(_long(rows, scores), exact=True)
    if style == "json":
        return _json(rows, truth, scores)
    names, areas = [each.name for each in scores], {f"{metric} {convention}": metric for metric in METRICS}
    if style == "latex":
        said = f"% AUC to {LIMIT:g} m [%], convention {convention}; needs \\usepackage{{booktabs}}\n"
        return said + to_latex(_wide([replace(row, label="Mean") if row.group == "mean" else row for row in rows], names, areas, "Object"))
    [lines] = to_text(_wide(rows, names, areas | {"recall": "recall", "rotation": "°", "translation": "mm"}, "", targets=True))
    lines += [
        "",
        f"AUC of ADD, ADD-S and ADD(-S) to {LIMIT:g} m [%], convention {convention}; a group's is the mean over its objects; recall",
    ]
    return "\n".join([*lines, "of ADD(-S) below it [%]; medians of rotation and translation error of what was found"]) + "\n"


def _wide(rows: Sequence[ScoreRow], names: Sequence[str], shown: Mapping[str, str], label: str, targets: bool = False) -> Table:
    """A row for each group, in which methods stand beside each other; `shown` are columns with their labels."""
    keys = (Column("label", label=label), *([Column("targets", ",")] if targets else []))
    columns = (*keys, *(Column(name, ".1f", each) for _ in names for name, each in shown.items()))
    spans = ((name, range(at, at + len(shown))) for name, at in zip(names, range(len(keys), len(columns), len(shown)), strict=True))
    starts = (number for number, row in enumerate(rows) if not number or row.group != rows[number - 1].group)
    table = Table("scores", "", columns, spans=tuple(spans), sections=frozenset(starts))
    for row in rows:
        head = (row.label, row.targets) if targets else (row.label,)
        table.rows.append((*head, *(_known(cells[name]) for cells in row.cells for name in shown)))
    return table


def _long(rows: Sequence[ScoreRow], scores: Sequence[Scores]) -> Table:
    """Table with a row for each group and method, and all columns."""
    columns = [Column(name) for name in ("group", "label", "targets", "method")] + [Column(name, digits=".6g") for name in rows[0].cells[0]]
    by_method = [(row, each, cells) for row in rows for each, cells in zip(scores, row.cells, strict=True)]
    values = [(row.group, row.label, row.targets, each.name, *map(_known, cells.values())) for row, each, cells in by_method]
    return Table("scores", "", tuple(columns), values)


def _known(value: float) -> float | None:
    """Value for JSON: NaN becomes None."""
    return None if math.isnan(value) else value


def _json(rows: Sequence[ScoreRow], truth: Truth, scores: Sequence[Scores]) -> str:
    """JSON of all results: both conventions, recall curves, error bands by visibility and speed."""
    methods = []
    for index, each in enumerate(scores):
        table = [{"group": row.group, "label": row.label, "targets": row.targets, **row.cells[index]} for row in rows]
        curves = {metric: recall_curve(errors, THRESHOLDS).tolist() for metric, errors in each.errors.items()}
        bands = {
            name: {
                metric: [vars(band) for band in error_bands(errors, getattr(truth, name)[each.target], edges)]
                for metric, errors in each.errors.items()
            }
            for name, (edges, _) in BANDS.items()
        }
        methods.append({"method": each.name, "seconds_per_image": each.seconds, "rows": table, "recall": curves, "bands": bands})
    content = {"limit": LIMIT, "thresholds": THRESHOLDS.tolist(), "methods": methods}
    return json.dumps(_finite(content), indent=1) + "\n"


def _finite(content: object) -> object:
    """Content with null for numbers that JSON lacks (NaN, infinity)."""
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
