"""Simulate the same episodes in different numbers of worlds, and tell whether they are the same bit by bit, and what that costs.

Each number of worlds gives a run, the first one two, and the last one a further one with physics recorded; on a GPU the first number's
two and the last one's are made again without the solver's rows in a fixed order (physics.deterministic). A GPU never has fewer than
eight worlds: one that is asked for is simulated beside seven idle ones, as in a bake. Exits with 1 if episodes differ that should
not, with 2 if nothing can be simulated.

    python -m tools.checks.compare_worlds --device cuda:0 --models DIR --worlds 8,1,64,512 --episodes 8
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import sys
import time
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table

from synpick_warp.codes import Phase
from synpick_warp.configs.schema import Config
from synpick_warp.device import pick_device
from synpick_warp.errors import SynpickError
from synpick_warp.pipeline import build_factory
from synpick_warp.progress import SilentProgress
from synpick_warp.stages.stream import TickReader
from tools.options import configure, fail, make_parser, write_json

WARM_TICKS = 3
"""First ticks whose time does not count: kernels are loaded, the steps recorded."""
SIZE = (320, 180)
"""Of the pictures, of which only those for looking are made [px]."""

Ticks = dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]]
"""By (episode, redraw): what each tick left, as (catalog indices (instance) int32, poses (instance + fixture, 7) float32)."""


@dataclass(frozen=True)
class Run:
    """One run, held against the first of its kind."""

    worlds: int
    """Asked for."""
    deterministic: bool
    recorded: bool
    tick: float
    """Median time of a tick [ms]."""
    ticks: int
    """Compared, of all episodes and redraws."""
    differing: int
    """Episodes and redraws that are not the same."""
    first: int
    """Tick of an episode in which the first difference shows; -1: none."""
    largest: float
    """Largest distance of an object or a fixture from where it is in the first run [mm]."""


def main(arguments: list[str] | None = None) -> int:
    """Simulate, compare, print, and return the exit code."""
    options = _parse(arguments)
    console = Console(highlight=False)
    try:
        runs = compare_worlds(_config(options), options.worlds, options.ticks, console)
    except SynpickError as error:
        return fail("compare_worlds", error)
    _print(console, runs)
    write_json(options.json, [dataclasses.asdict(run) for run in runs])
    return int(any(run.differing for run in runs if run.deterministic))


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = make_parser(__doc__, "device", "models", "set", "json")
    parser.add_argument("--worlds", type=_numbers, default=(8, 1, 64), help="world counts, one for each run (default: 8,1,64)")
    parser.add_argument("--episodes", type=int, default=8, help="episodes of each run (default: 8)")
    parser.add_argument("--ticks", type=int, default=1000, help="ticks of a run at most (default: 1000)")
    return parser.parse_args(arguments)


def _numbers(text: str) -> tuple[int, ...]:
    numbers = tuple(int(part) for part in text.split(",") if part.isdecimal())
    if not numbers or min(numbers) < 1 or len(numbers) != text.count(",") + 1:
        raise argparse.ArgumentTypeError(f"{text} is no list of numbers of worlds, such as 8,1,64")
    return numbers


def _config(options: argparse.Namespace) -> Config:
    return configure(options, {"bake.episodes": options.episodes, "bake.formats": ["zarr"]}, {"cameras.resolution": SIZE})


def compare_worlds(config: Config, worlds: tuple[int, ...], most_ticks: int, console: Console) -> list[Run]:
    """All runs, each held against the first one of its kind.

    Args:
        config: All settings but the number of worlds.
        worlds: Numbers of worlds, the first one first and again.
        most_ticks: Of a run; episodes are compared as far as both runs came.
        console: Told of each run.

    Raises:
        SynpickError: Device or models cannot be used.
    """
    runs = []
    for deterministic in (True, False) if pick_device(config.bake.device).is_cuda else (True,):
        kind = dataclasses.replace(config, physics=dataclasses.replace(config.physics, deterministic=deterministic))
        reference: Ticks | None = None
        for count in (worlds[0], *(worlds if deterministic else worlds[:: max(1, len(worlds) - 1)])):
            seen, tick = simulate(kind, count, most_ticks)
            reference = reference or seen
            runs.append(Run(count, deterministic, False, tick, *compare(reference, seen)))
            console.print(_line(runs[-1]))
        if deterministic:
            seen, tick = simulate(kind, worlds[-1], most_ticks, records=True)
            runs.append(Run(worlds[-1], deterministic, True, tick, *compare(reference or seen, seen)))
            console.print(_line(runs[-1]))
    return runs


def simulate(config: Config, worlds: int, most_ticks: int, records: bool = False) -> tuple[Ticks, float]:
    """What every tick of every episode left, and the median time of a tick [ms]."""
    config = dataclasses.replace(config, bake=dataclasses.replace(config.bake, worlds=worlds))
    simulation = build_factory(config, SilentProgress(), records_physics=records).simulation
    readers = [TickReader(record) for record in simulation.records]
    ticks: Ticks = defaultdict(list)
    times = []
    for number in range(most_ticks):
        record, reader = simulation.records[number % len(readers)], readers[number % len(readers)]
        started = time.perf_counter()
        simulation.tick(record)
        wp.synchronize_device(simulation.device)
        times.append(1e3 * (time.perf_counter() - started))
        if _note(reader, ticks):
            break
    return ticks, statistics.median(times[WARM_TICKS:] or times)


def _note(reader: TickReader, ticks: Ticks) -> bool:
    """Add what a tick left; returns whether all worlds are idle."""
    reader.start()
    report = reader.wait()
    episode, redraw, phase = (report.column(name) for name in ("episode", "redraw", "phase"))
    for world in np.flatnonzero(phase != Phase.IDLE):
        full = report.catalog_index[world] >= 0
        poses = np.concatenate((report.pose[world][full], report.snapshot.fixture_pose[world]))
        ticks[int(episode[world]), int(redraw[world])].append((report.catalog_index[world], poses))
    return bool((phase == Phase.IDLE).all())


def compare(reference: Ticks, other: Ticks) -> tuple[int, int, int, float]:
    """Ticks compared, episodes and redraws that differ, the first tick that does (-1: none), and the largest distance [mm].

    Only what both runs came to is compared; two that part do so in a tick that both have.
    """
    count, largest = 0, 0.0
    unlike = {}
    for address in reference.keys() & other.keys():
        pairs = list(zip(reference[address], other[address], strict=False))
        count += len(pairs)
        apart = [tick for tick, (a, b) in enumerate(pairs) if not (np.array_equal(a[0], b[0]) and np.array_equal(a[1], b[1]))]
        if apart:
            unlike[address] = apart[0]
        distances = [np.linalg.norm(a[1][:, :3] - b[1][:, :3], axis=1).max() for a, b in pairs if a[1].shape == b[1].shape]
        largest = max([largest, *(1e3 * float(distance) for distance in distances)])
    return count, len(unlike), min(unlike.values(), default=-1), largest


def _line(run: Run) -> str:
    same = "all the same"
    if run.differing:
        same = f"{run.differing} episodes differ, first in tick {run.first}, by up to {run.largest:.3g} mm"
    return f"{run.worlds} worlds{', recorded' if run.recorded else ''}: {run.tick:.1f} ms a tick, {run.ticks} ticks compared, {same}"


def _print(console: Console, runs: list[Run]) -> None:
    table = Table("ordered", "recorded", "worlds", "ms a tick", "ticks", "differ", "first in tick", "by [mm]")
    for run in runs:
        flags = ("yes" if flag else "no" for flag in (run.deterministic, run.recorded))
        first = str(run.first) if run.differing else ""
        table.add_row(*flags, str(run.worlds), f"{run.tick:.1f}", str(run.ticks), str(run.differing), first, f"{run.largest:.3g}")
    console.print(table)


if __name__ == "__main__":
    sys.exit(main())
