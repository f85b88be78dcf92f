"""Report on the difficulty of data sets: occlusion, speed and shininess of their objects, side by side.

python -m tools.reports.difficulty TEST HARD          # data sets of the format bop or shards
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from synpick_warp.apps.evaluation.truth import Truth, read_truth
from synpick_warp.dataset.reading import DataSet, open_data_set
from synpick_warp.errors import SynpickError
from tools.figures import describe_run, write_run
from tools.options import MeasuredRow, fail, make_parser

OCCLUDED = 0.5
"""Visible fraction below which an instance counts as occluded."""
MOVING = 0.05
"""Speed above which an object counts as moving [m/s]: half of the paper's gripper speed in mode move."""
ALL = "all"
"""Name of the row over all modes."""


def measure_difficulty(truth: Truth) -> dict[str, dict[str, float]]:
    """Statistics of a data set by mode, and of all modes, over the rows of its ground truth: mode -> name -> value."""
    groups = {ALL: np.ones(len(truth), bool), **{str(mode): truth.mode == mode for mode in np.unique(truth.mode)}}
    return {name: _statistics(truth, rows) for name, rows in groups.items()}


def _statistics(truth: Truth, rows: np.ndarray) -> dict[str, float]:
    """Difficulty of a selection of rows: episodes, instances a view, visibility and speed, by name."""
    visibility, speed = truth.visibility[rows], truth.speed[rows]
    # An object that is in a single frame has no speed.
    speed = speed[np.isfinite(speed)]
    images = len(np.unique(np.stack([truth.poses.scene[rows], truth.poses.image[rows]]), axis=1).T)
    return {
        "episodes": len(np.unique(truth.episode[rows])),
        "instances a view": rows.sum() / images,
        "mean visibility": float(visibility.mean()),
        f"below {OCCLUDED:g} [%]": 100.0 * float((visibility < OCCLUDED).mean()),
        f"above {MOVING:g} m/s [%]": 100.0 * float((speed > MOVING).mean()),
        "median speed of these [m/s]": float(np.median(speed[speed > MOVING])) if (speed > MOVING).any() else 0.0,
        "95th percentile of speed [m/s]": float(np.quantile(speed, 0.95)) if len(speed) else 0.0,
    }


def describe_materials(data_set: DataSet) -> str:
    """Mean metallic factor and roughness of the data set's object table."""
    rows = data_set.config.object_rows
    if not rows:
        return "no object table"
    metallic, roughness = (np.mean([getattr(row, name) for row in rows]) for name in ("metallic", "roughness"))
    return f"object table: metallic {metallic:.2f}, roughness {roughness:.2f} on average"


def main() -> int:
    """Print a table for each data set."""
    parser = make_parser(__doc__, "json")
    parser.add_argument("datasets", type=Path, nargs="+", metavar="DATA", help="folder of a data set, format bop or shards")
    options, console, rows = parser.parse_args(), Console(), list[MeasuredRow]()
    for folder in options.datasets:
        try:
            data_set = open_data_set(folder)
            found = measure_difficulty(read_truth(data_set))
            title = f"{folder} ({describe_materials(data_set)})"
        except SynpickError as error:
            return fail("reports.difficulty", error)
        console.print(title, soft_wrap=True, highlight=False, markup=False)
        table = Table("", *found)
        for name in found[ALL]:
            table.add_row(escape(name), *(f"{values[name]:.4g}" for values in found.values()))
            rows += [MeasuredRow(f"{mode}: {name}", values[name], part=folder.name) for mode, values in found.items()]
        console.print(table)
    write_run(options.json, describe_run("tools.reports.difficulty", [], rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
