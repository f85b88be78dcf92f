"""Report on picking sequences of the modes pick and target: frames, visibility, outcomes, seal forces and speeds, beside the paper's.

Both modes run in one simulation. Views are rasterized but not shaded: visibility needs pixel counts alone. Exits with 1 if a bound is
violated, with 2 if nothing can be simulated. After --max-seconds, or Ctrl-C, the table covers the sequences that have ended.

    python -m tools.reports.pick --models DIR --device cuda:0 --episodes 64 --json picks.json
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table

from synpick_warp.cli.commands import parse_resolution
from synpick_warp.cli.doctor import describe_machine
from synpick_warp.codes import Phase
from synpick_warp.configs.schema import MIXED, Config
from synpick_warp.configs.schema import MODES as MIX
from synpick_warp.errors import SynpickError
from synpick_warp.factory.assembly import Factory, build_factory
from synpick_warp.progress import SilentProgress
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.host_copies import HostCopy
from synpick_warp.stages.render.view_setup import make_views, pair_views
from synpick_warp.stages.stream import TickReport
from synpick_warp.stages.ticks import TickLoop
from synpick_warp.system.device import pick_device
from tools.options import INTERRUPTED, configure, fail, make_names_parser, make_parser, print_machine, write_json
from tools.reports.pick_tally import MODES, PAPER, ModeRow, Tally, report, sum_visibility

WORLDS_PER_SEQUENCE = 1.25
"""Worlds per requested sequence if modes are sampled at random: of 160 worlds, one sample in forty has fewer than 64 of a mode."""
EPISODES_PER_WORLD = 64
"""Episodes available to each world: more than it can finish."""
PROGRESS_INTERVAL = 10.0
"""Time between two progress lines [s]."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    started = time.perf_counter()
    options = _parse(arguments)
    console = Console(highlight=False)
    try:
        config = _config(options)
        device = pick_device(config.bake.device)
        factory = build_factory(config, SilentProgress())
    except SynpickError as error:
        return fail("reports.pick", error)
    tally = Tally(config, factory.catalog, options.modes, options.episodes)
    visibility = None if options.no_visibility else VisibilityCounter(factory)
    meter, interrupted = Meter(tally, console.print), False
    try:
        for _ in simulate(factory, visibility, tally):
            meter.count_tick()
            if options.max_seconds and time.perf_counter() - started > options.max_seconds:
                console.print(f"time limit of {options.max_seconds:g} s reached")
                break
    except KeyboardInterrupt:
        interrupted = True
        print("reports.pick: interrupted", file=sys.stderr)
    rows = report(tally)
    worlds = factory.simulation.layout.worlds
    rates = {"worlds": worlds, "ticks": meter.ticks, "seconds": meter.seconds, "ticks/s": meter.ticks / meter.seconds}
    machine = describe_machine(device)
    print_report(console, machine, rows, tally, rates)
    record = {
        "machine": dict(machine),
        "seed": config.bake.seed,
        "real_objects": bool(options.models),
        "interrupted": interrupted,
        **rates,
        "resampled": tally.resampled,
        "rows": [row.to_dict() for row in rows],
        "sequences": [vars(sequence) for mode in options.modes for sequence in tally.sequences(mode)],
    }
    write_json(options.json, record)
    return INTERRUPTED if interrupted else 0 if all(all(row.holds.values()) for row in rows) and tally.complete() else 1


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = make_parser(__doc__, "models", "device", "seed", "set", "json")
    parser.add_argument("--modes", type=make_names_parser(MODES, "picking mode"), default=tuple(MODES), help=f"default: {','.join(MODES)}")
    parser.add_argument("--episodes", type=int, default=64, help="sequences of each mode (default: 64)")
    parser.add_argument(
        "--worlds",
        type=int,
        default=0,
        help=f"worlds simulated in parallel (default: {WORLDS_PER_SEQUENCE:g} for each sequence, 1 with one mode)",
    )
    parser.add_argument(
        "--visibility-resolution", default="640x360", help="WIDTHxHEIGHT of the views in which pixels are counted [px] (default: 640x360)"
    )
    parser.add_argument("--no-visibility", action="store_true", help="render no views, and report no visibility")
    parser.add_argument(
        "--max-seconds", type=float, default=0.0, help="stop after this time, and report the sequences that have ended [s] (default: never)"
    )
    return parser.parse_args(arguments)


def _config(options: argparse.Namespace) -> Config:
    mixed = len(options.modes) > 1
    worlds = options.worlds or round(options.episodes * (WORLDS_PER_SEQUENCE * len(options.modes) if mixed else 1))
    fixed = {
        "bake.mode": MIXED if mixed else options.modes[0],
        "bake.mix": tuple(float(mode in options.modes) for mode in MIX),
        "bake.worlds": worlds,
        "bake.episodes": worlds * EPISODES_PER_WORLD if mixed else options.episodes,
        "cameras.resolution": parse_resolution(options.visibility_resolution),
    }
    return configure(options, fixed)


class VisibilityCounter:
    """Pixel counts of every instance in every view of live worlds, for visible fractions; results arrive one tick later."""

    def __init__(self, factory: Factory) -> None:
        stream = factory.stream
        self.renderer, self.out, self.batch, self.cameras = stream.renderer, stream.buffers[0], stream.batch, stream.cameras
        device = factory.simulation.device
        views = -(-factory.simulation.layout.worlds * self.cameras // self.batch) * self.batch
        self.lists = [wp.zeros(views, dtype=wp.int32, device=device) for _ in range(2)]
        self.pixels = wp.zeros((views, *self.out.pixels.shape[1:]), dtype=wp.int32, device=device)
        self.copy = HostCopy([self.pixels])
        self.world = np.zeros(0, dtype=np.int32)

    def start(self, snapshot: Snapshot, report: TickReport) -> None:
        """Begin to count the pixels of a tick's views."""
        self.world, camera = pair_views(np.flatnonzero(report.column("live")), np.arange(self.cameras))
        for target, values in zip(self.lists, (self.world, camera), strict=True):
            target.assign(np.pad(values, (0, target.shape[0] - len(values))))
        for first in range(0, len(self.world), self.batch):
            count = min(self.batch, len(self.world) - first)
            world, camera = (_slice(values, first, count) for values in self.lists)
            views = make_views(world, camera, count, self.renderer.instances)
            self.renderer.render_gbuffer(snapshot, views, self.out)
            self.renderer.annotator.annotate(self.renderer.bodies, views, self.out)
            wp.copy(_slice(self.pixels, first, count), _slice(self.out.pixels, 0, count))
        self.copy.start(None)

    def wait(self) -> dict[int, tuple[float, int, int]]:
        """Result of the last `start`: world -> (sum of visible fractions, instances, views), for each world that was live."""
        if not len(self.world):
            return {}
        (pixels,) = self.copy.wait()
        fractions, instances = sum_visibility(pixels[: len(self.world)])
        sums = [values.reshape(-1, self.cameras).sum(axis=1) for values in (fractions, instances)]
        return {
            int(world): (float(total), int(count), self.cameras)
            for world, total, count in zip(self.world[:: self.cameras], *sums, strict=True)
        }


def _slice(array: wp.array, first: int, count: int) -> Any:
    """Rows `first` to `first + count` of an array."""
    return array[first : first + count]


class Meter:
    """Progress meter: counts ticks and reports ended sequences at intervals."""

    def __init__(self, tally: Tally, report_progress: Callable[[str], None]) -> None:
        self.tally, self.report_progress = tally, report_progress
        self.ticks = 0
        self.started = self.reported = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time since the first tick began [s]."""
        return time.perf_counter() - self.started

    def count_tick(self) -> None:
        """Count a tick, and report progress if the interval is over."""
        self.ticks += 1
        if time.perf_counter() - self.reported >= PROGRESS_INTERVAL:
            self.reported = time.perf_counter()
            ended = ", ".join(f"{len(self.tally.sequences(mode))} of {self.tally.count} {mode}" for mode in self.tally.modes)
            self.report_progress(f"{ended} sequences; {self.ticks} ticks, {self.ticks / self.seconds:.2f} ticks/s")


def simulate(factory: Factory, visibility: VisibilityCounter | None, tally: Tally) -> Iterator[None]:
    """Simulate until all selected sequences have ended; yields after each tick.

    A GPU simulates the next tick while the host evaluates this one, as in a bake.
    """
    pending: TickReport | None = None
    with TickLoop(factory.simulation) as ticks:
        while not tally.complete():
            now, snapshot = ticks.advance()
            if pending is not None:
                tally.add_tick(pending, visibility.wait() if visibility is not None else {})
            if visibility is not None:
                visibility.start(snapshot, now)
            pending = now
            yield
            if (now.column("phase") == Phase.IDLE).all():
                tally.add_tick(now, visibility.wait() if visibility is not None else {})
                return


def print_report(console: Console, machine: list[tuple[str, str]], rows: list[ModeRow], tally: Tally, rates: dict[str, float]) -> None:
    """Print the machine and the table of the report, with the paper's values beside ours."""
    resampled = ", ".join(f"{count} {name}" for name, count in tally.resampled.items()) or "none"
    print_machine(console, [*machine, ("arrangements resampled", resampled)])
    title = f"{rates['worlds']:.0f} worlds, {rates['ticks']:.0f} ticks in {rates['seconds']:.0f} s, {rates['ticks/s']:.2f} ticks/s"
    table = Table("picking", *(text for mode in tally.modes for text in (mode, "paper")), "unit", "bound", "", title=title)
    table.columns[0].no_wrap = True
    for column in table.columns[1:-3]:
        column.justify = "right"
    for row in rows:
        paper = PAPER.get(row.name, {})
        cells = [text for mode in tally.modes for text in (_format(row.values[mode]), _format(paper.get(mode)))]
        table.add_row(row.name, *cells, row.unit, row.bound, "" if not row.bound else "holds" if all(row.holds.values()) else "VIOLATED")
    console.print(table)


def _format(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


if __name__ == "__main__":
    sys.exit(main())
