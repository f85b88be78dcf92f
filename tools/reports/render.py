"""Measure the renderer: white furnaces, a plane under a lamp, settled piles in both modes, successive frames of still scenes.

Piles settle under the physics; each is seen by camera 0 under the next light map. Exits with 1 if a bound is violated, with 2 if
nothing can be rendered.

    python tools/reports/render.py --models DIR --lights DIR --scenes 10 --size 480x270 --samples 1024 --out DIR --sheet sheet.png
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from synpick_warp.cli.doctor import describe_machine
from synpick_warp.configs.load import COMMAND_LINE, load_config, parse_assignment
from synpick_warp.configs.schema import Config
from synpick_warp.device import pick_device
from synpick_warp.errors import SynpickError
from synpick_warp.viz.preview import write_picture
from tools.reports.render_checks import Row, furnaces, planes
from tools.reports.render_piles import compare_piles
from tools.reports.render_sheet import contact_sheets, strip

PICTURES = (".png", ".jpg", ".jpeg")


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and return the exit code."""
    options = _parse(arguments)
    console = Console(highlight=False)
    started = time.perf_counter()
    try:
        if options.sheet and options.sheet.suffix.lower() not in PICTURES:
            raise SynpickError(f"--sheet is {options.sheet}; its name must end in one of {', '.join(PICTURES)}")
        config = _config(options)
        device = pick_device(config.bake.device)
        rows = furnaces(config, device) + planes(config, device)
        if options.scenes:
            compared, pairs = compare_piles(config, options.sheet is not None, options.noise, device, console.print)
            rows += compared
            for number, pair in enumerate(pairs if options.out else ()):
                write_picture(options.out / f"scene_{number:02d}_{pair.light}.png", np.concatenate(strip(pair), axis=1)[..., ::-1])
            for file in contact_sheets(pairs, options.sheet) if options.sheet else ():
                console.print(f"wrote {file}")
    except SynpickError as error:
        print(f"render_report: {error}", file=sys.stderr)
        return 2
    machine = describe_machine(device)
    _print(console, machine, rows, config, time.perf_counter() - started)
    if options.json:
        record = {
            "machine": dict(machine),
            "samples": config.render.samples,
            "bounces": config.render.bounces,
            "real_objects": bool(options.models),
            "real_lights": bool(options.lights),
            "rows": [dataclasses.asdict(row) for row in rows],
        }
        options.json.write_text(json.dumps(record, indent=1) + "\n")
    return 0 if all(row.holds for row in rows) else 1


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--models", default="", help="folder of BOP models (default: the embedded objects)")
    parser.add_argument("--lights", default="", help="folder of light maps (default: the embedded skies)")
    parser.add_argument("--scenes", type=int, default=2, help="piles to compare (default 2; 0: none)")
    parser.add_argument("--size", default="240x135", help="width and height of their pictures (default 240x135)")
    parser.add_argument("--samples", type=int, default=64, help="paths a pixel of the reference (default 64)")
    parser.add_argument("--device", default="auto", help="cpu, cuda:N or auto (default)")
    parser.add_argument("--seed", type=int, default=0, help="of all draws (default 0)")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="any other setting; may be repeated")
    parser.add_argument("--out", type=Path, help="folder for pictures: fast, reference, and five times their difference")
    parser.add_argument("--sheet", type=Path, help="contact sheet of piles under every light map, PNG or JPEG")
    parser.add_argument("--noise", action="store_true", help="render a second reference, to tell its own noise; takes as long again")
    parser.add_argument("--json", type=Path, help="write the numbers to this file, too")
    return parser.parse_args(arguments)


def _config(options: argparse.Namespace) -> Config:
    overrides: dict[str, object] = dict(parse_assignment(text) for text in options.set)
    overrides |= {
        "bake.mode": "move",
        "bake.models": options.models,
        "bake.lights": options.lights,
        "bake.episodes": max(1, options.scenes),
        "bake.worlds": max(1, options.scenes),
        "bake.device": options.device,
        "bake.seed": options.seed,
        "render.samples": options.samples,
        "cameras.resolution": [int(part) if part.isdecimal() else part for part in options.size.split("x")],
    }
    return load_config(None, overrides, source=COMMAND_LINE)


def _print(console: Console, machine: list[tuple[str, str]], rows: list[Row], config: Config, wall: float) -> None:
    head = Table(show_header=False, box=None)
    for name, value in machine:
        head.add_row(name, value)
    console.print(head)
    width, height = config.cameras.resolution
    title = f"{width} x {height}, {config.render.samples} paths a pixel, {config.render.bounces} bounces, {wall:.0f} s"
    table = Table("renderer", "", "unit", "bound", "", title=title)
    table.columns[1].justify = "right"
    for row in rows:
        table.add_row(row.name, f"{row.value:.3f}", row.unit, row.bound, "" if not row.bound else "holds" if row.holds else "VIOLATED")
    console.print(table)


if __name__ == "__main__":
    sys.exit(main())
