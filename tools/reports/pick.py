"""Measure sequences of picking: simulate episodes of the modes pick and target, and print a table beside the paper's.

Both modes run in one simulation. Pictures are not shaded; their hits and counts are all that visibility needs. Exits with 1 if a
bound is violated, with 2 if nothing can be simulated. When time is up, the table is of the sequences that have ended.

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
from synpick_warp.device import pick_device
from synpick_warp.errors import SynpickError
from synpick_warp.pipeline import Factory, build_factory
from synpick_warp.progress import SilentProgress
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.render.annotate import annotate
from synpick_warp.stages.render.view_setup import make_views
from synpick_warp.stages.sim.simulate import RECORDS
from synpick_warp.stages.stream import HostCopy, TickReader, TickReport
from tools.options import INTERRUPTED, configure, fail, make_parser, names_of, print_machine, write_json
from tools.reports.pick_tally import MODES, PAPER, ModeRow, Tally, report, visible_shares

SPARE = 1.25
"""With both modes drawn at random, so many worlds for each wanted sequence: with 160, one draw in forty has less than 64 of a mode."""
RUNS = 64
"""Episode numbers for each world: more than there is time for."""
SAY_EVERY = 10.0
"""Time between two lines about how far it is [s]."""


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and return the exit code."""
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
    eyes = None if options.no_visibility else Eyes(factory)
    meter, interrupted = Meter(tally, console.print), False
    try:
        for _ in simulate(factory, eyes, tally):
            meter.count()
            if options.max_seconds and time.perf_counter() - started > options.max_seconds:
                console.print(f"{options.max_seconds:g} s are over")
                break
    except KeyboardInterrupt:
        interrupted = True
        print("reports.pick: interrupted", file=sys.stderr)
    rows = report(tally)
    worlds = factory.simulation.layout.worlds
    pace = {"worlds": worlds, "ticks": meter.ticks, "seconds": meter.seconds, "ticks/s": meter.ticks / meter.seconds}
    machine = describe_machine(device)
    tables(console, machine, rows, tally, pace)
    record = {
        "machine": dict(machine),
        "seed": config.bake.seed,
        "real_objects": bool(options.models),
        "interrupted": interrupted,
        **pace,
        "redrawn": tally.redrawn,
        "rows": [row.record() for row in rows],
        "sequences": [vars(sequence) for mode in options.modes for sequence in tally.sequences(mode)],
    }
    write_json(options.json, record)
    return INTERRUPTED if interrupted else 0 if all(all(row.holds.values()) for row in rows) and tally.complete() else 1


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = make_parser(__doc__, "models", "device", "seed", "set", "json")
    parser.add_argument("--modes", type=names_of(MODES, "mode of picking"), default=tuple(MODES), help=f"default: {','.join(MODES)}")
    parser.add_argument("--episodes", type=int, default=64, help="sequences of each mode (default: 64)")
    parser.add_argument("--worlds", type=int, default=0, help=f"side by side (default: {SPARE:g} for each sequence, 1 with one mode)")
    parser.add_argument("--visibility-resolution", default="640x360", help="of the views in which pixels are counted (default: 640x360)")
    parser.add_argument("--no-visibility", action="store_true", help="render no views")
    parser.add_argument("--max-seconds", type=float, default=0.0, help="stop after this time, with what has ended [s] (default: never)")
    return parser.parse_args(arguments)


def _config(options: argparse.Namespace) -> Config:
    mixed = len(options.modes) > 1
    worlds = options.worlds or round(options.episodes * (SPARE * len(options.modes) if mixed else 1))
    fixed = {
        "bake.mode": MIXED if mixed else options.modes[0],
        "bake.mix": tuple(float(mode in options.modes) for mode in MIX),
        "bake.worlds": worlds,
        "bake.episodes": worlds * RUNS if mixed else options.episodes,
        "cameras.resolution": parse_resolution(options.visibility_resolution),
    }
    return configure(options, fixed)


class Eyes:
    """Counts the pixels of every instance in every camera's view of live worlds; the numbers come one tick later."""

    def __init__(self, factory: Factory) -> None:
        stream = factory.stream
        self.renderer, self.out, self.batch, self.cameras = stream.renderer, stream.buffers[0], stream.batch, stream.cameras
        device = factory.simulation.device
        views = -(-factory.simulation.layout.worlds * self.cameras // self.batch) * self.batch
        self.lists = [wp.zeros(views, dtype=wp.int32, device=device) for _ in range(2)]
        self.pixels = wp.zeros((views, *self.out.pixels.shape[1:]), dtype=wp.int32, device=device)
        self.copy = HostCopy([self.pixels])
        self.world = np.zeros(0, dtype=np.int32)

    def look(self, snapshot: Snapshot, report: TickReport) -> None:
        """Begin to count what this tick's views show."""
        self.world = np.repeat(np.flatnonzero(report.column("live")), self.cameras).astype(np.int32)
        for target, values in zip(self.lists, (self.world, np.arange(len(self.world)) % self.cameras), strict=True):
            target.assign(np.pad(values, (0, target.shape[0] - len(values))).astype(np.int32))
        for first in range(0, len(self.world), self.batch):
            count = min(self.batch, len(self.world) - first)
            world, camera = (_part(values, first, count) for values in self.lists)
            views = make_views(world, camera, count, self.renderer.instances)
            self.renderer.render_gbuffer(snapshot, views, self.out)
            annotate(self.renderer.scene, self.renderer.bodies, views, self.out)
            wp.copy(_part(self.pixels, first, count), _part(self.out.pixels, 0, count))
        self.copy.start(None)

    def wait(self) -> dict[int, tuple[float, int, int]]:
        """What the last `look` has counted: sum of visible shares, instances and views of each world that was live."""
        if not len(self.world):
            return {}
        (pixels,) = self.copy.wait()
        shares, instances = visible_shares(pixels[: len(self.world)])
        each = slice(None, None, self.cameras)
        sums = [values.reshape(-1, self.cameras).sum(axis=1) for values in (shares, instances)]
        return {int(world): (float(share), int(count), self.cameras) for world, share, count in zip(self.world[each], *sums, strict=True)}


def _part(array: wp.array, first: int, count: int) -> Any:
    return array[first : first + count]


class Meter:
    """Counts ticks, and says how far it is, now and then."""

    def __init__(self, tally: Tally, say: Callable[[str], None]) -> None:
        self.tally, self.say = tally, say
        self.ticks = 0
        self.begun = self.said = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Since the first tick began."""
        return time.perf_counter() - self.begun

    def count(self) -> None:
        """One tick more."""
        self.ticks += 1
        if time.perf_counter() - self.said >= SAY_EVERY:
            self.said = time.perf_counter()
            ended = ", ".join(f"{len(self.tally.sequences(mode))} of {self.tally.wanted} {mode}" for mode in self.tally.modes)
            self.say(f"{ended} sequences; {self.ticks} ticks, {self.ticks / self.seconds:.2f} ticks/s")


def simulate(factory: Factory, eyes: Eyes | None, tally: Tally) -> Iterator[None]:
    """Tick until all sequences that count have ended; yields after each tick.

    The device works on the next tick while the host counts this one, as in a bake.
    """
    simulation = factory.simulation
    readers = [TickReader(record) for record in simulation.records]
    simulation.tick(simulation.records[0])
    readers[0].start()
    waiting: TickReport | None = None
    ticks = 0
    while not tally.complete():
        current, following = ticks % RECORDS, (ticks + 1) % RECORDS
        simulation.tick(simulation.records[following])
        readers[following].start()
        now = readers[current].wait()
        if waiting is not None:
            tally.see(waiting, eyes.wait() if eyes is not None else {})
        if eyes is not None:
            eyes.look(simulation.records[current].snapshot, now)
        waiting = now
        ticks += 1
        yield
        if (now.column("phase") == Phase.IDLE).all():
            tally.see(now, eyes.wait() if eyes is not None else {})
            return


def tables(console: Console, machine: list[tuple[str, str]], rows: list[ModeRow], tally: Tally, pace: dict[str, float]) -> None:
    """Print machine and report."""
    resampled = ", ".join(f"{count} {name}" for name, count in tally.redrawn.items()) or "none"
    print_machine(console, [*machine, ("arrangements resampled", resampled)])
    title = f"{pace['worlds']:.0f} worlds, {pace['ticks']:.0f} ticks in {pace['seconds']:.0f} s, {pace['ticks/s']:.2f} ticks/s"
    table = Table("picking", *(text for mode in tally.modes for text in (mode, "paper")), "unit", "bound", "", title=title)
    table.columns[0].no_wrap = True
    for column in table.columns[1:-3]:
        column.justify = "right"
    for row in rows:
        paper = PAPER.get(row.name, {})
        cells = [text for mode in tally.modes for text in (_text(row.values[mode]), _text(paper.get(mode)))]
        table.add_row(row.name, *cells, row.unit, row.bound, "" if not row.bound else "holds" if all(row.holds.values()) else "VIOLATED")
    console.print(table)


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


if __name__ == "__main__":
    sys.exit(main())
