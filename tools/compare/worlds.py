"""Determinism check of the simulation: the same episodes, simulated with different world counts, are equal bit by bit.

There is one run per world count, two for the first count, and another one for the last count with physics recorded. On a GPU the two
runs of the first count and that of the last one are repeated without a fixed order of constraint rows (physics.deterministic), to
measure its cost. A GPU simulates at least eight worlds; surplus ones are idle, as in a bake. Exits with 1 if episodes of
deterministic runs differ, with 2 if nothing can be simulated.

    python -m tools.compare worlds --device cuda:0 --models DIR --worlds 8,1,64,512 --episodes 8
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
from synpick_warp.errors import SynpickError
from synpick_warp.factory.assembly import build_factory
from synpick_warp.stages.stream import TickReader
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from tools.options import configure, fail, make_parser, write_json

WARM_TICKS = 3
"""First ticks, which are not timed: kernels are loaded and the steps captured."""
SIZE = (320, 180)
"""Width and height of rendered views [px]; none is rendered but the images of perception."""

Ticks = dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]]
"""(episode, arrangement) -> state after each tick: (catalog indices (instance) int32, poses (instance + fixture, 7) float32)."""


@dataclass(frozen=True)
class Run:
    """Run of a simulation, compared with the first one of the same physics.deterministic: median tick [ms], ticks compared, episodes that
    differ, first tick that does (-1: none), largest displacement [mm].
    """

    worlds: int
    """World count as requested."""
    deterministic: bool
    recorded: bool
    """Whether physics was recorded."""
    tick: float
    """Median time of a tick [ms]."""
    ticks: int
    """Ticks compared, over all arrangements of all episodes."""
    differing: int
    """Arrangements of episodes that differ."""
    first: int
    """Tick of the first difference within an episode; -1: none."""
    largest: float
    """Largest displacement of an object or a fixture from its position in the first run [mm]."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = _parse(arguments)
    console = Console(highlight=False)
    try:
        runs = compare_worlds(_config(options), options.worlds, options.ticks, console)
    except SynpickError as error:
        return fail("compare worlds", error)
    _print(console, runs)
    write_json(options.json, [dataclasses.asdict(run) for run in runs])
    return int(any(run.differing for run in runs if run.deterministic))


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser(__doc__, "device", "models", "set", "json")
    parser.add_argument("--worlds", type=_world_counts, default=(8, 1, 64), help="world counts of the runs (default: 8,1,64)")
    parser.add_argument("--episodes", type=int, default=8, help="episodes of each run (default: 8)")
    parser.add_argument("--ticks", type=int, default=1000, help="maximum ticks of a run (default: 1000)")
    return parser.parse_args(arguments)


def _world_counts(text: str) -> tuple[int, ...]:
    """Comma-separated world counts; argparse's error unless all are above 0."""
    counts = tuple(int(part) for part in text.split(",") if part.isdecimal())
    if not counts or min(counts) < 1 or len(counts) != text.count(",") + 1:
        raise argparse.ArgumentTypeError(f"{text} is not a list of world counts, such as 8,1,64")
    return counts


def _config(options: argparse.Namespace) -> Config:
    """Settings of the options: zarr only, small images."""
    return configure(options, {"bake.episodes": options.episodes, "bake.formats": ["zarr"]}, {"cameras.resolution": SIZE})


def compare_worlds(config: Config, worlds: tuple[int, ...], max_ticks: int, console: Console) -> list[Run]:
    """Simulate all runs and compare each with the first one that has the same setting of physics.deterministic.

    Args:
        config: All settings but the world count.
        worlds: World counts; the first one is simulated twice.
        max_ticks: Ticks of a run, at most; episodes are compared as far as both runs came.
        console: Gets a line about each run.

    Raises:
        SynpickError: Device or models cannot be used.
    """
    runs = []
    for deterministic in (True, False) if pick_device(config.bake.device).is_cuda else (True,):
        run_config = config.with_values({"physics.deterministic": deterministic})
        reference: Ticks | None = None
        for count in (worlds[0], *(worlds if deterministic else worlds[:: max(1, len(worlds) - 1)])):
            ticks, tick_time = simulate(run_config, count, max_ticks)
            reference = reference or ticks
            runs.append(Run(count, deterministic, False, tick_time, *compare(reference, ticks)))
            console.print(_line(runs[-1]))
        if deterministic:
            ticks, tick_time = simulate(run_config, worlds[-1], max_ticks, records=True)
            runs.append(Run(worlds[-1], deterministic, True, tick_time, *compare(reference or ticks, ticks)))
            console.print(_line(runs[-1]))
    return runs


def simulate(config: Config, worlds: int, max_ticks: int, records: bool = False) -> tuple[Ticks, float]:
    """Simulate all episodes; returns the state after each tick, and the median time of a tick [ms]."""
    config = config.with_values({"bake.worlds": worlds})
    simulation = build_factory(config, SilentProgress(), records_physics=records).simulation
    reader = TickReader(simulation.record)
    ticks: Ticks = defaultdict(list)
    times = []
    for _ in range(max_ticks):
        started = time.perf_counter()
        simulation.tick()
        wp.synchronize_device(simulation.device)
        times.append(1e3 * (time.perf_counter() - started))
        if _append_tick(reader, ticks):
            break
    return ticks, statistics.median(times[WARM_TICKS:] or times)


def _append_tick(reader: TickReader, ticks: Ticks) -> bool:
    """Append the state after a tick to `ticks`; returns whether all worlds are idle."""
    reader.start()
    report = reader.wait()
    episode, arrangement, phase = (report.column(name) for name in ("episode", "arrangement", "phase"))
    for world in np.flatnonzero(phase != Phase.IDLE):
        present = report.catalog_index[world] >= 0
        poses = np.concatenate((report.pose[world][present], report.snapshot.fixture_pose[world]))
        ticks[int(episode[world]), int(arrangement[world])].append((report.catalog_index[world], poses))
    return bool((phase == Phase.IDLE).all())


def compare(reference: Ticks, other: Ticks) -> tuple[int, int, int, float]:
    """Compare two runs; returns ticks compared, arrangements that differ, the first differing tick (-1: none), largest displacement [mm].

    Only ticks that both runs have are compared; runs that diverge do so in one of these.
    """
    count, largest = 0, 0.0
    first_differing = {}
    for key in reference.keys() & other.keys():
        pairs = list(zip(reference[key], other[key], strict=False))
        count += len(pairs)
        differing = [tick for tick, (a, b) in enumerate(pairs) if not (np.array_equal(a[0], b[0]) and np.array_equal(a[1], b[1]))]
        if differing:
            first_differing[key] = differing[0]
        distances = [np.linalg.norm(a[1][:, :3] - b[1][:, :3], axis=1).max() for a, b in pairs if a[1].shape == b[1].shape]
        largest = max([largest, *(1e3 * float(distance) for distance in distances)])
    return count, len(first_differing), min(first_differing.values(), default=-1), largest


def _line(run: Run) -> str:
    """One line on a run: worlds, time of a tick, differing episodes."""
    verdict = "all equal"
    if run.differing:
        verdict = f"{run.differing} episodes differ, first in tick {run.first}, by up to {run.largest:.3g} mm"
    return f"{run.worlds} worlds{', recorded' if run.recorded else ''}: {run.tick:.1f} ms a tick, {run.ticks} ticks compared, {verdict}"


def _print(console: Console, runs: list[Run]) -> None:
    """Print the table of runs."""
    table = Table("ordered", "recorded", "worlds", "ms a tick", "ticks", "differing", "first in tick", "by up to [mm]")
    for run in runs:
        flags = ("yes" if flag else "no" for flag in (run.deterministic, run.recorded))
        first = str(run.first) if run.differing else ""
        table.add_row(*flags, str(run.worlds), f"{run.tick:.1f}", str(run.ticks), str(run.differing), first, f"{run.largest:.3g}")
    console.print(table)


if __name__ == "__main__":
    sys.exit(main())
