"""Simulated depth of a sensor preset beside that of the real camera, as a table by sequence, cross-validation, and pictures.

    python -m tools.reports.sensor --real FRAMES --models MODELS [--pictures DIR]

Each instance is first aligned to measured depth, as annotated poses are off by 1 to 2 mm, which would count as bias; objects whose
annotation is exact (`--exact`) show the bias before it. A second table has the cross-validation: noise and grazing angle are fitted to one
sequence, and deviation and holes of the other are predicted, in both directions.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from synpick_warp.configs.calibration.sensor_presets import SENSORS
from synpick_warp.configs.cell.sensors import DepthSensor
from synpick_warp.errors import SynpickError
from tools.figures import describe_run, write_run
from tools.options import Row, configure, fail, make_parser, of_part
from tools.reports.real_frames import RealFrame, read_frames
from tools.reports.sensor.alignment import align
from tools.reports.sensor.cross_validation import cross_validate
from tools.reports.sensor.measure import collect, statistics
from tools.reports.sensor.pictures import write_pictures
from tools.reports.sensor.scene import RealScenes, Rendered, annotated_poses

MEASURED, SIMULATED = "measured", "simulated"


def compare(frames: Sequence[RealFrame], rendered: Rendered) -> list[Row]:
    """Statistics of measured and simulated depth of each sequence."""
    rows: list[Row] = []
    for sequence in sorted({frame.sequence for frame in frames}):
        chosen = [row for row, frame in enumerate(frames) if frame.sequence == sequence]
        for source, counts in ((MEASURED, [frame.depth for frame in frames]), (SIMULATED, list(rendered.sensor))):
            rows += of_part(f"{sequence:04d} {source}", statistics(frames, rendered, counts, chosen))
    return rows


def annotation_bias(frames: Sequence[RealFrame], rendered: Rendered, exact: Sequence[int]) -> list[Row]:
    """Median of measured minus rendered depth at annotated poses, of objects whose frames are exactly known."""
    samples = collect(frames, rendered, [frame.depth for frame in frames], range(len(frames))).inner
    parts = [(index, samples.select(samples.object_id == index)) for index in exact if (samples.object_id == index).any()]
    return [
        Row(f"object {index}: bias at the annotated pose", float(np.median(part.off)), "mm", part="annotation") for index, part in parts
    ]


def print_table(console: Console, rows: Sequence[Row]) -> None:
    """Print a table with a line for each figure, and a column for each part."""
    columns = list(dict.fromkeys(row.part for row in rows))
    table = Table("", "unit", *columns)
    values = {(row.name, row.part): row for row in rows}
    for name in dict.fromkeys(row.name for row in rows):
        found = [values.get((name, column)) for column in columns]
        unit = next(row.unit for row in found if row is not None)
        table.add_row(name, unit, *("" if row is None or np.isnan(row.value) else f"{row.value:.2f}" for row in found))
    if columns:
        console.print(table)


def make_options() -> argparse.ArgumentParser:
    """Options of the command line."""
    parser = make_parser(__doc__, "json", "seed", "set")
    parser.add_argument("--real", type=Path, required=True, metavar="DIR", help="annotated frames, as tools.reports.real_frames reads them")
    parser.add_argument("--models", dest="objects", type=Path, required=True, metavar="DIR", help="folder of BOP models of their objects")
    parser.add_argument("--preset", choices=SENSORS, default="xtion", help="sensor that is simulated (default: %(default)s)")
    parser.add_argument("--exact", type=int, nargs="*", default=[1, 14], help="objects whose annotation is exact (default: 1 14)")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write measured, simulated and their difference of each sequence")
    return parser


def main() -> int:
    """Print the table."""
    options, console = make_options().parse_args(), Console(soft_wrap=True)
    try:
        sensor = configure(options, {"depth_sensor.preset": options.preset}).depth_sensor
        frames = read_frames(options.real)
        scenes = RealScenes(frames, options.objects)
        poses = [annotated_poses(frame) for frame in frames]
        bias = annotation_bias(frames, scenes.render(poses, DepthSensor(shadows=False)), options.exact)
        aligned = align(scenes, poses)
        rendered = scenes.render(aligned, sensor, options.seed)
        tables = [compare(frames, rendered), cross_validate(scenes, aligned, sensor, options.seed), bias]
        if options.pictures is not None:
            write_pictures(options.pictures, frames, rendered)
    except SynpickError as error:
        return fail("reports.sensor", error)
    for rows in tables:
        print_table(console, rows)
    write_run(options.json, describe_run("tools.reports.sensor", [], [row for rows in tables for row in rows]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
