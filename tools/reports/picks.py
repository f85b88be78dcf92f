"""Report on simulated picks: how well SuctionNet's analytic scores predict them, with a calibration curve and a heat map of each score.

Reads a data set with the format picks. AUC, share of successes and calibration error have 95 % intervals by resampling states. Exits with 2
if there are no picks.

    python -m tools.reports.picks DATA --json picks.json --picture picks.png --map map.png
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import Any

from synpick_warp.apps.report.picks import calibration_spec
from synpick_warp.apps.statistics.picks import PickFigures, picks_figures, picks_tables
from synpick_warp.apps.viz.picks import write_pick_sheet
from synpick_warp.dataset.reading import open_data_set
from synpick_warp.errors import SynpickError
from synpick_warp.system.codecs.charts import WIDTH, render_charts, theme
from synpick_warp.system.codecs.tables import to_text
from tools.options import fail, positive_count, writable_file


def to_json(figures: PickFigures) -> str:
    """Figures as JSON; undefined numbers are null."""
    return json.dumps(_plain(dataclasses.asdict(figures)), allow_nan=False, indent=2) + "\n"


def _plain(value: Any) -> Any:
    """Value of JSON: arrays as lists, NaN as None."""
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def main(arguments: list[str] | None = None) -> int:
    """Print the tables of a data set; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="data set with the format picks")
    parser.add_argument("--json", type=writable_file, metavar="FILE", help="also write the figures to this file")
    parser.add_argument("--picture", type=writable_file, metavar="FILE", help="write the calibration curve to this PNG file")
    parser.add_argument("--map", type=writable_file, metavar="FILE", help="draw heat maps of a state, and a failed pick, to this file")
    parser.add_argument("--draws", type=positive_count, default=1000, help="bootstrap samples (default: 1000)")
    given = parser.parse_args(arguments)
    try:
        data_set = open_data_set(given.folder)
        figures = picks_figures(data_set, given.draws)
        print(
            f"{figures.trials:,} trials of {figures.candidates:,} candidates in {figures.states:,} states of {figures.episodes:,} episodes"
            f" ({figures.left_out:,} more: own grasps of episodes, or without outcome)\n"
        )
        for table in picks_tables(figures):
            print(table.title)
            for block in to_text(table):
                print("\n".join(block) + "\n")
        if given.json:
            given.json.write_text(to_json(figures), encoding="utf-8")
        if given.picture:
            given.picture.write_bytes(
                render_charts([{"width": WIDTH, **calibration_spec(figures), "background": "white", "config": theme(15)}])[0]
            )
        if given.map:
            write_pick_sheet(data_set, given.map, None)
    except SynpickError as error:
        return fail("picks", error)
    return 0


if __name__ == "__main__":
    sys.exit(main())
