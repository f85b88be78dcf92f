"""Evaluation tables: AUC per object, mode, camera, visibility and speed band, several methods side by side, as text, LaTeX, CSV or JSON.

A row for a group of instances is the mean over its objects of each object's area, as in the paper (class-wise average); `mean` is that of
all instances. Areas and recalls are in percent.
"""

from __future__ import annotations

import csv
import io
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from synpick_warp.evaluation.auc import CONVENTIONS, LIMIT, band_indices, error_bands, recall_curve
from synpick_warp.evaluation.scoring import METRICS, Scores
from synpick_warp.evaluation.truth import Truth

FORMATS = ("text", "latex", "csv", "json")
GROUPS = ("object", "mode", "camera", "visibility", "speed")
VISIBILITY_EDGES = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0)
"""Limits of the bands of the visible fraction."""
SPEED_EDGES = (0.0, 0.01, 0.05, 0.1, 0.25, 0.5, math.inf)
"""Limits of the bands of the object's speed [m/s]; the first holds what rests."""
THRESHOLDS = np.linspace(0.0, LIMIT, 51)
"""Thresholds of the recall curves [m]."""
COLUMNS = tuple(f"{metric} {convention}" for metric in METRICS for convention in CONVENTIONS)
_PERCENT = 100.0


@dataclass(frozen=True)
class Row:
    """Scores of all methods for a group of instances."""

    group: str
    """What instances are grouped by: one of GROUPS, or "mean"."""
    label: str
    """The group's name in the table."""
    targets: int
    """Number of instances to be found."""
    cells: tuple[dict[str, float], ...]
    """For each method: column -> value. AUC by metric and convention [%], `recall` (ADD(-S) below 0.1 m) [%], and the medians of the found
    instances `rotation` [°] and `translation` [mm]; NaN: nothing found."""


def summarize(truth: Truth, scores: Sequence[Scores], names: Mapping[int, str], groups: Sequence[str] = GROUPS) -> list[Row]:
    """Rows of the table; groups without instances are left out.

    Args:
        truth: Ground truth.
        scores: Scores of the methods, all with the same targets.
        names: Names of objects by obj_id.
        groups: What instances are grouped by, in order.
    """
    target = scores[0].target
    object_ids = truth.poses.object_id[target]
    rows = []
    for group in groups:
        for label, inside in _labels(group, truth, target, names):
            if inside.any():
                rows.append(_row(group, label, inside, object_ids, scores))
    return [*rows, _row("mean", "mean", np.ones(len(target), bool), object_ids, scores)]


def _labels(group: str, truth: Truth, target: np.ndarray, names: Mapping[int, str]) -> list[tuple[str, np.ndarray]]:
    """Name and mask (T,) of every group of instances."""
    if group == "object":
        values = truth.poses.object_id[target]
        return [(names.get(int(value), f"obj_{value:06d}"), values == value) for value in np.unique(values)]
    if group == "mode":
        return [(str(value), truth.mode[target] == value) for value in np.unique(truth.mode[target])]
    if group == "camera":
        return [(f"camera {value}", truth.camera[target] == value) for value in np.unique(truth.camera[target])]
    edges, values, unit = (
        (VISIBILITY_EDGES, truth.visibility[target], "visible") if group == "visibility" else (SPEED_EDGES, truth.speed[target], "m/s")
    )
    index = band_indices(values, edges)
    return [(f"{_interval(low, high)} {unit}", index == band) for band, (low, high) in enumerate(pairwise(edges))]


def _interval(low: float, high: float) -> str:
    return f"over {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"


def _row(group: str, label: str, inside: np.ndarray, object_ids: np.ndarray, scores: Sequence[Scores]) -> Row:
    return Row(group, label, int(inside.sum()), tuple(_cells(inside, object_ids, each) for each in scores))


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
    """Median of the finite values; NaN without."""
    found = values[np.isfinite(values)]
    return float(np.median(found)) if len(found) else math.nan


def render(rows: Sequence[Row], truth: Truth, scores: Sequence[Scores], style: str, convention: str = "exact") -> str:
    """Write the table.

    Args:
        rows: From `summarize`.
        truth: Ground truth.
        scores: Scores of the methods.
        style: One of FORMATS. CSV and JSON have both conventions, JSON recall curves and bands of each object, too.
        convention: Convention of the areas in text and LaTeX.
    """
    if style == "csv":
        return _csv(rows, scores)
    if style == "json":
        return _json(rows, truth, scores)
    return (_text if style == "text" else _latex)(rows, [each.name for each in scores], convention)


def _text(rows: Sequence[Row], names: Sequence[str], convention: str) -> str:
    """Aligned columns, a block for each method."""
    columns = [f"{metric} {convention}" for metric in METRICS]
    extra = ("recall", "rotation", "translation")
    heads = [*METRICS, "recall", "°", "mm"]
    lines = [["", "targets"] + heads * len(names)]
    for row in rows:
        values = [cells[column] for cells in row.cells for column in (*columns, *extra)]
        lines.append([row.label, f"{row.targets:,}", *("-" if math.isnan(value) else f"{value:.1f}" for value in values)])
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    for index, name in enumerate(names):  # A method's name must fit above its columns.
        first = 2 + index * len(heads)
        room = sum(widths[first : first + len(heads)]) + 2 * (len(heads) - 1)
        widths[first] += max(0, len(name) - room)
    start = sum(widths[:2]) + 2
    spans = [sum(widths[2 + i * len(heads) : 2 + (i + 1) * len(heads)]) + 2 * (len(heads) - 1) for i in range(len(names))]
    head = " " * start + "".join(f"  {name:<{span}}" for name, span in zip(names, spans, strict=True))
    output, previous = [head.rstrip()], ""
    for row, line in zip([None, *rows], lines, strict=True):
        if row is not None and row.group != previous:
            output.append("")
            previous = row.group
        cells = [f"{line[0]:<{widths[0]}}", *(f"{cell:>{width}}" for cell, width in zip(line[1:], widths[1:], strict=True))]
        output.append("  ".join(cells).rstrip())
    output += [
        "",
        f"AUC of ADD, ADD-S and ADD(-S) to {LIMIT:g} m [%], convention {convention}; a group's is the mean over its objects; recall",
    ]
    output += ["of ADD(-S) below it [%]; medians of rotation and translation error of what was found"]
    return "\n".join(output) + "\n"


def _latex(rows: Sequence[Row], names: Sequence[str], convention: str) -> str:
    """The paper's table: booktabs, ADD, ADD-S and ADD(-S) of each method."""
    columns, width = [f"{metric} {convention}" for metric in METRICS], len(METRICS)
    heads = " & ".join(f"\\multicolumn{{{width}}}{{c}}{{{_escape(name)}}}" for name in names)
    rules = "".join(f"\\cmidrule(lr){{{2 + width * index}-{1 + width * (index + 1)}}}" for index in range(len(names)))
    lines = [
        f"% AUC to {LIMIT:g} m [%], convention {convention}; needs \\usepackage{{booktabs}}",
        f"\\begin{{tabular}}{{l{'r' * width * len(names)}}}",
        "\\toprule",
        f" & {heads} \\\\",
        rules,
        f"Object & {' & '.join([*METRICS] * len(names))} \\\\",
    ]
    previous = ""
    for row in rows:
        if row.group != previous:
            lines.append("\\midrule")
            previous = row.group
        values = ["--" if math.isnan(cells[column]) else f"{cells[column]:.1f}" for cells in row.cells for column in columns]
        lines.append(f"{_escape('Mean' if row.group == 'mean' else row.label)} & {' & '.join(values)} \\\\")
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}"]) + "\n"


_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"} | {sign: f"\\{sign}" for sign in "&%$#_{}"}


def _escape(text: str) -> str:
    """Text of any characters as LaTeX."""
    return "".join(_LATEX.get(sign, sign) for sign in text)


def _csv(rows: Sequence[Row], scores: Sequence[Scores]) -> str:
    """One line per group and method."""
    output = io.StringIO()
    writer = csv.writer(output, lineterminator="\n")
    columns = list(rows[0].cells[0])
    writer.writerow(["group", "label", "targets", "method", *columns])
    for row in rows:
        for each, cells in zip(scores, row.cells, strict=True):
            values = ["" if math.isnan(cells[column]) else f"{cells[column]:.6g}" for column in columns]
            writer.writerow([row.group, row.label, row.targets, each.name, *values])
    return output.getvalue()


def _json(rows: Sequence[Row], truth: Truth, scores: Sequence[Scores]) -> str:
    """Everything: both conventions, recall curves, error bands by visibility and speed."""
    methods = []
    for index, each in enumerate(scores):
        table = [{"group": row.group, "label": row.label, "targets": row.targets, **row.cells[index]} for row in rows]
        curves = {metric: recall_curve(errors, THRESHOLDS).tolist() for metric, errors in each.errors.items()}
        bands = {
            name: {
                metric: [vars(band) for band in error_bands(errors, values[each.target], edges)] for metric, errors in each.errors.items()
            }
            for name, values, edges in (("visibility", truth.visibility, VISIBILITY_EDGES), ("speed", truth.speed, SPEED_EDGES))
        }
        methods.append({"method": each.name, "seconds_per_image": each.seconds, "rows": table, "recall": curves, "bands": bands})
    content = {"limit": LIMIT, "thresholds": THRESHOLDS.tolist(), "methods": methods}
    return json.dumps(_finite(content), indent=1) + "\n"


def _finite(content: object) -> object:
    """The same content with null for numbers that JSON lacks."""
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
