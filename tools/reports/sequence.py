"""Report on image quality in episodes: PSNR of denoised frames, with light histories as in a bake, against path-traced references.

Light histories (`render.history`) average the light of resting surfaces over the frames of an episode, so single frames, as in
`tools.reports.render`, do not show the quality of a bake. Here every frame of camera 0 is denoised, from the first one on, and those of
`--frames` are rendered twice more as references, with half of `--samples` each: the product of the two differences estimates the error
without the references' noise. Exits with 1 if a bound is violated, with 2 if nothing can be rendered.

    python -m tools.reports.sequence --models DIR --lights DIR --size 640x360 --frames 0,8,30 --samples 256 --sheet sheet.png

With `--references DIR` references are cached: another run with other settings of the denoiser takes a tenth of the time.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console

from synpick_warp.codes import Phase
from synpick_warp.configs.schema import FAST, Config
from synpick_warp.errors import SynpickError
from synpick_warp.factory.assembly import build_stages
from synpick_warp.factory.memory_plan import check_memory, explain_shortage, plan_memory
from synpick_warp.factory.sizes import fit_to_device
from synpick_warp.stages.stream import read_tick
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from tools.figures import finish_report
from tools.options import Row, configure, fail, make_parser, positive_count, writable_file
from tools.reports.reference_store import ReferenceStore, existing_folder
from tools.reports.render_checks import Studio, first_camera
from tools.reports.render_piles import Pair, summarize_pairs
from tools.reports.render_sheet import write_sheets

MIN_PSNR = 35.0
"""Bound of the mean PSNR over all compared frames [dB]."""


def _frames(text: str) -> tuple[int, ...]:
    """Type of an option: frame indices joined by commas."""
    parts = text.split(",")
    if not all(part.isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f"{text} are no frames; allowed: numbers from 0 on, such as 0,8,30")
    return tuple(sorted({int(part) for part in parts}))


SHARED = ("models", "lights", "device", "seed", "set", "json", "size")
OWN = {
    "episodes": {"type": positive_count, "default": 1, "help": "episodes, each in a world of its own (default: 1)"},
    "mode": {"default": "pick", "help": "bake.mode (default: pick)"},
    "frames": {"type": _frames, "default": (0, 8, 30), "help": "frames to compare, comma-separated (default: 0,8,30)"},
    "samples": {"type": positive_count, "default": 256, "help": "paths per pixel of both references together (default: 256)"},
    "sheet": {"type": writable_file, "help": "contact sheet: denoised, reference, and five times their difference"},
    "references": {"type": existing_folder, "help": "folder in which references are cached between runs"},
}
"""Options of this report; see `tools.options.OPTIONS`."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = make_parser(__doc__, *SHARED, own=OWN, size="480x270").parse_args(arguments)
    console = Console(highlight=False)
    started = time.perf_counter()
    rows: list[Row] = []
    pairs: list[Pair] = []
    missing = set(options.frames)
    try:
        worlds = {"bake.episodes": options.episodes, "bake.worlds": options.episodes}
        config = configure(options, worlds | {"bake.mode": options.mode, "render.samples": options.samples})
        config = config.with_values(first_camera(config.cameras))
        device = pick_device(config.bake.device)
        for frame, pair in compare_frames(config, options.frames, options.references):
            pairs.append(pair)
            missing.discard(frame)
            rows.append(Row(f"frame {frame}, {pair.light}: denoised against reference", pair.quality, "dB"))
            rows.append(Row(f"frame {frame}, {pair.light}: bias of mean radiance", pair.bias, "%"))
            console.print(
                f"{time.perf_counter() - started:6.0f} s  frame {frame:4}  {pair.light}: {pair.quality:.2f} dB, {pair.bias:+.2f} %"
            )
        if missing:
            raise SynpickError(f"no episode has frame {min(missing)} of --frames; name earlier ones")
        for file in write_sheets(pairs, options.sheet) if options.sheet else ():
            console.print(f"wrote {file}")
    except SynpickError as error:
        return fail("reports.sequence", error)
    rows += summarize_pairs(pairs, MIN_PSNR)
    width, height = config.cameras.resolution
    title = f"{config.bake.mode}, {width} x {height}, {config.render.samples} paths per pixel, {time.perf_counter() - started:.0f} s"
    return finish_report("tools.reports.sequence", options.json, device, "frames of episodes", title, rows)


def compare_frames(config: Config, frames: tuple[int, ...], cache: Path | None = None) -> Iterator[tuple[int, Pair]]:
    """Simulate episodes and render camera 0; yields (frame, denoised image and reference) for the given frames of each episode.

    Args:
        config: All settings; one episode per world.
        frames: Indices of frames.
        cache: Folder in which references are cached; None: no caching.
    """
    device = pick_device(config.bake.device)
    fitted = fit_to_device(config.with_values({"render.mode": FAST}), device, config.bake.episodes)
    check_memory(plan_memory(fitted, device), device)
    with explain_shortage(fitted):
        stages = build_stages(fitted, device, SilentProgress(), range(config.bake.episodes))
    denoised, store = Studio(stages.groups[0].renderer), ReferenceStore(cache, config, stages.groups[0].renderer.scene)
    simulation, names = stages.simulation, stages.light_table.name
    while True:
        simulation.tick()
        report = read_tick(simulation.record)
        snapshot, shown = simulation.record.snapshot, report.column("frame")
        for world in np.flatnonzero(report.column("live")).tolist():
            if shown[world] <= max(frames):
                shot = denoised.render(snapshot, world, 0)
                if shown[world] in frames:
                    light = str(names[int(snapshot.light.numpy()[world])])
                    first, second = store.get(snapshot, world)
                    yield int(shown[world]), Pair(light, shot, first, float(shot.radiance.mean()), second)
        phase = report.column("phase")
        if ((phase == Phase.IDLE) | ((phase == Phase.ACT) & (shown >= max(frames)))).all():
            return


if __name__ == "__main__":
    sys.exit(main())
