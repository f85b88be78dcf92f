"""Measure the renderer: white furnaces, a plane under a lamp, settled piles in both modes, successive frames of still scenes.

Piles settle under the physics; each is seen by camera 0 under the next light map. Exits with 1 if a bound is violated, with 2 if
nothing can be rendered.

    python -m tools.reports.render --models DIR --lights DIR --scenes 10 --size 480x270 --samples 1024 --out DIR --sheet sheet.png
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console

from synpick_warp.cli.doctor import describe_machine
from synpick_warp.configs.schema import Config
from synpick_warp.device import pick_device
from synpick_warp.errors import SynpickError
from synpick_warp.viz.preview import write_picture
from tools.options import configure, fail, make_parser, print_machine, print_rows, write_json
from tools.reports.render_checks import furnaces, planes
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
        return fail("reports.render", error)
    machine = describe_machine(device)
    print_machine(console, machine)
    width, height = config.cameras.resolution
    seconds = time.perf_counter() - started
    title = f"{width} x {height}, {config.render.samples} paths per pixel, {config.render.bounces} bounces, {seconds:.0f} s"
    print_rows(console, "renderer", title, rows)
    record = {
        "machine": dict(machine),
        "samples": config.render.samples,
        "bounces": config.render.bounces,
        "real_objects": bool(options.models),
        "real_lights": bool(options.lights),
        "rows": [row.record() for row in rows],
    }
    write_json(options.json, record)
    return 0 if all(row.holds for row in rows) else 1


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = make_parser(__doc__, "models", "lights", "device", "seed", "set", "json")
    parser.add_argument("--scenes", type=int, default=2, help="piles to compare (default: 2; 0: none)")
    parser.add_argument("--size", default="240x135", help="width and height of their pictures (default: 240x135)")
    parser.add_argument("--samples", type=int, default=64, help="paths per pixel of the reference (default: 64)")
    parser.add_argument("--out", type=Path, help="folder for pictures: denoised, reference, and five times their difference")
    parser.add_argument("--sheet", type=Path, help="contact sheet of piles under every light map, PNG or JPEG")
    parser.add_argument("--noise", action="store_true", help="render a second reference, to measure its own noise; takes as long again")
    return parser.parse_args(arguments)


def _config(options: argparse.Namespace) -> Config:
    fixed = {
        "bake.mode": "move",
        "bake.episodes": max(1, options.scenes),
        "bake.worlds": max(1, options.scenes),
        "render.samples": options.samples,
        "cameras.resolution": [int(part) if part.isdecimal() else part for part in options.size.split("x")],
    }
    return configure(options, fixed)


if __name__ == "__main__":
    sys.exit(main())
