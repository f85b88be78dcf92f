"""Report on the renderer: white furnace tests, irradiance of a plane under a lamp, denoised against path-traced images, flicker.

Piles settle under the physics; each is rendered by camera 0 under the next light map. Exits with 1 if a bound is violated, with 2 if
nothing can be rendered.

    python -m tools.reports.render --models DIR --lights DIR --scenes 10 --size 480x270 --samples 1024 --out DIR --sheet sheet.png
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console

from synpick_warp.apps.viz.drawing import write_picture
from synpick_warp.errors import SynpickError
from synpick_warp.system.hardware.device import pick_device
from tools.figures import finish_report
from tools.options import configure, fail, make_parser
from tools.reports.render_checks import measure_furnaces, measure_planes
from tools.reports.render_piles import compare_piles
from tools.reports.render_sheet import image_strip, write_sheets

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
SHARED = ("models", "lights", "device", "seed", "set", "json", "size")
OWN = {
    "scenes": {"type": int, "default": 2, "help": "piles to compare (default: 2; 0: none)"},
    "samples": {"type": int, "default": 64, "help": "paths per pixel of the reference (default: 64)"},
    "out": {"type": Path, "help": "folder for images: denoised, reference, and five times their difference"},
    "sheet": {"type": Path, "help": "contact sheet of piles under every light map, PNG or JPEG"},
    "noise": {"action": "store_true", "help": "render a second reference, to measure its noise; doubles the time"},
}
"""Options of this report; see `tools.options.OPTIONS`."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = make_parser(__doc__, *SHARED, own=OWN, size="240x135").parse_args(arguments)
    console = Console(highlight=False)
    started = time.perf_counter()
    try:
        if options.sheet and options.sheet.suffix.lower() not in IMAGE_SUFFIXES:
            raise SynpickError(f"--sheet is {options.sheet}; its name must end in one of {', '.join(IMAGE_SUFFIXES)}")
        piles = max(1, options.scenes)
        fixed = {"bake.mode": "move", "bake.episodes": piles, "bake.worlds": piles, "render.samples": options.samples}
        config = configure(options, fixed)
        device = pick_device(config.bake.device)
        rows = measure_furnaces(config, device) + measure_planes(config, device)
        if options.scenes:
            pile_rows, pairs = compare_piles(config, options.sheet is not None, options.noise, device, console.print)
            rows += pile_rows
            for index, pair in enumerate(pairs if options.out else ()):
                write_picture(options.out / f"scene_{index:02d}_{pair.light}.png", np.concatenate(image_strip(pair), axis=1)[..., ::-1])
            for file in write_sheets(pairs, options.sheet) if options.sheet else ():
                console.print(f"wrote {file}")
    except SynpickError as error:
        return fail("reports.render", error)
    width, height = config.cameras.resolution
    seconds = time.perf_counter() - started
    title = f"{width} x {height}, {config.render.samples} paths per pixel, {config.render.bounces} bounces, {seconds:.0f} s"
    return finish_report("tools.reports.render", options.json, device, "renderer", title, rows)


if __name__ == "__main__":
    sys.exit(main())
