"""Report on settled piles: speeds, penetration, volume, energy, and objects inside the tote.

Arrangements are simulated until each has settled. A world is measured in the tick in which it begins to act, and then gets the next
arrangement, so that there may be more arrangements than worlds. Exits with 1 if a bound is violated, with 2 if nothing can be simulated.

    python -m tools.reports.rest --models DIR --arrangements 64 --device cpu
    python -m tools.reports.rest --config full-bin --arrangements 8 --set arrangement.counts={box=150}
"""

import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from rich.console import Console
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Ending, Phase
from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.schema import Physics
from synpick_warp.errors import SynpickError
from synpick_warp.factory.assembly import fit_to_catalog
from synpick_warp.scenes import build
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.sim.physics import with_enough_worlds
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import TickReport, read_tick
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from tools.figures import finish_report
from tools.options import INTERRUPTED, MeasuredRow, configure, fail, make_parser

MAX_SPEED = 0.2
"""Bound of the median speed of objects [mm/s]."""
MAX_DEPTH = 1.0
"""Bound of the 99th percentile of penetration over objects [mm]."""
MIN_INSIDE = 99.0
"""Bound of the fraction of objects inside the tote [%]."""
MAX_VOLUME = 7.0
"""Bound of the total volume of an arrangement's collision shapes [l]."""
HEAP_HEIGHT = 0.1
"""Height above the rim up to which the centre of mass of an object counts as inside [m]."""
PROGRESS_INTERVAL = 10.0
"""Time between two progress lines [s]."""
ROUNDING = 1e-6
"""Relative error of a total volume that was summed in single precision."""
OWN = {
    "arrangements": {"type": int, "default": 64, "help": "count of arrangements to settle (default: 64)"},
    "worlds": {"type": int, "help": "worlds simulated in parallel (default: one for each arrangement)"},
}
"""Options of this report; see `tools.options.OPTIONS`."""


class RestingPile(NamedTuple):
    """Measures of one arrangement at rest; arrays are by object."""

    ticks: int
    """Ticks from the drop to rest."""
    redrops: int
    """Objects dropped again."""
    volume: float
    """Total volume of the collision shapes [l]."""
    energy: float
    """Kinetic energy [J]."""
    tick_speed: np.ndarray
    """Mean speed of the centre of mass over the last tick, by displacement [mm/s]."""
    speed: np.ndarray
    """Instantaneous speed of the centre of mass [mm/s]."""
    depth: np.ndarray
    """Deepest penetration [mm]."""
    inside: np.ndarray
    """Whether the centre of mass lies in the tote."""


@dataclass
class RestResults:
    """Results of all arrangements."""

    piles: list[RestingPile] = field(default_factory=list)
    resampled: Counter[str] = field(default_factory=Counter)
    """Arrangements that failed, by ending."""
    given_up: int = 0
    """Episodes whose last arrangement failed."""
    contacts: float = 0.0
    """Most contacts in a tick, the mean of all worlds ..."""
    pairs: float = 0.0
    """... and pairs of shapes whose bounding boxes overlap."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = make_parser(__doc__, "config", "models", "device", "seed", "set", "json", own=OWN).parse_args(arguments)
    console = Console(highlight=False)
    try:
        # Mode move needs no perception; its arrangements may contain an object several times.
        fixed = {"bake.episodes": options.arrangements, "bake.worlds": options.worlds or options.arrangements}
        config = configure(options, {"bake.mode": "move"} | fixed)
        device = pick_device(config.bake.device)
        config = with_enough_worlds(config, device)
        catalog = load_catalog(config, report=console.print)
        config = fit_to_catalog(config, catalog, make_bins(config.cell.bins), device, SilentProgress())
        started = time.perf_counter()
        simulation = Simulation(config, catalog, 1, device)
    except SynpickError as error:
        return fail("reports.rest", error)
    results = RestResults()
    interrupted = False
    try:
        settle(simulation, catalog, results, console.print)
    except KeyboardInterrupt:
        interrupted = True
        print(f"reports.rest: interrupted; {len(results.piles)} of {config.bake.episodes} arrangements are at rest", file=sys.stderr)
    wall = time.perf_counter() - started
    objects = "the models folder's objects" if config.bake.models else "the embedded objects"
    title = f"{config.bake.episodes} arrangements of {objects} in {config.bake.worlds} worlds, seed {config.bake.seed}, {wall:.0f} s"
    rows = report(results, config.physics, bool(config.arrangement.counts))
    code = finish_report("tools.reports.rest", options.json, device, "at rest", title, rows, interrupted=interrupted)
    return INTERRUPTED if interrupted else code


def settle(simulation: Simulation, catalog: Catalog, results: RestResults, report_progress: Callable[[str], None]) -> None:
    """Simulate until every arrangement is at rest or has failed, and add the measured values to `results`."""
    config, physics, reported = simulation.config, simulation.physics, time.perf_counter()
    before: TickReport | None = None
    while True:
        simulation.tick()
        report = read_tick(simulation.record)
        results.contacts = max(results.contacts, int(physics.contacts.rigid_contact_count.numpy()[0]) / config.bake.worlds)
        results.pairs = max(results.pairs, int(physics.overlap_count.numpy()[0]) / config.bake.worlds)
        phase = report.column("phase")
        for world in np.flatnonzero(phase == Phase.OVER):
            results.resampled[Ending(int(report.column("ending")[world])).name.lower()] += 1
            results.given_up += int(report.column("arrangement")[world]) + 1 == config.settle.tries
        resting = np.flatnonzero(phase == Phase.ACT)
        if len(resting):
            assert before is not None  # A pile rests for several ticks before it counts as settled.
            results.piles += _measure(simulation, catalog, before, report, resting)
            _finish_episodes(simulation, resting)
        if (phase == Phase.IDLE).all():
            return
        if time.perf_counter() - reported >= PROGRESS_INTERVAL:
            reported = time.perf_counter()
            report_progress(f"{len(results.piles)} of {config.bake.episodes} arrangements at rest")
        before = report


def _finish_episodes(simulation: Simulation, worlds: np.ndarray) -> None:
    """End the episodes of `worlds` as finished, so that the next tick assigns new ones."""
    state = simulation.state
    for array, value in ((state.phase, Phase.OVER), (state.ending, Ending.FINISHED)):
        host = array.numpy()
        host[worlds] = int(value)
        array.assign(host)


def _measure(simulation: Simulation, catalog: Catalog, before: TickReport, now: TickReport, worlds: np.ndarray) -> list[RestingPile]:
    """Measure the piles of `worlds` at the end of the tick `now`; `before` is the report of the tick before."""
    state, layout = simulation.state, simulation.layout
    tick = simulation.config.physics.tick_time
    progress, slots = state.progress.numpy(), state.body_slot.numpy()
    body_qd = simulation.physics.state.body_qd
    assert body_qd is not None  # Models with rigid bodies have it.
    depths, velocities = state.penetration.numpy(), body_qd.numpy().astype(np.float64)
    piles = []
    for world in worlds:
        instances = np.flatnonzero(now.catalog_index[world] >= 0)
        entries = [catalog.entries[index] for index in now.catalog_index[world][instances]]
        bodies = world * layout.bodies_per_world + build.GRIPPER_BODIES + slots[world][instances]
        centers = np.array([entry.center_of_mass for entry in entries])
        position, rotation = transform_points(now.pose[world][instances], centers)
        last, _ = transform_points(before.pose[world][instances], centers)
        linear, angular = velocities[bodies, :3], velocities[bodies, 3:]
        body_angular = np.einsum("nji,nj->ni", rotation, angular)
        inertia = np.array([entry.inertia for entry in entries])
        mass = np.array([entry.mass for entry in entries])
        energy = (mass * (linear**2).sum(axis=1)).sum() + np.einsum("ni,nij,nj->", body_angular, inertia, body_angular)
        piles.append(
            RestingPile(
                ticks=int(progress[world][0]),
                redrops=int(progress[world][2]),
                volume=1e3 * sum(entry.volume for entry in entries),
                energy=float(0.5 * energy),
                tick_speed=1e3 * np.linalg.norm(position - last, axis=1) / tick,
                speed=1e3 * np.linalg.norm(linear, axis=1),
                depth=1e3 * depths[bodies],
                inside=is_inside(BinSizes.of_tote(simulation.config.tote), position),
            )
        )
    return piles


def transform_points(pose: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transform points (N, 3) by poses (N, 7: x, y, z, quaternion x, y, z, w); returns positions (N, 3) and rotation matrices (N, 3, 3)."""
    rotation = Rotation.from_quat(pose[:, 3:]).as_matrix()
    return pose[:, :3] + np.einsum("nij,nj->ni", rotation, point), rotation


def is_inside(sizes: BinSizes, position: np.ndarray) -> np.ndarray:
    """Whether positions (N, 3) lie above the floor, within the rim's opening, and at most `HEAP_HEIGHT` above the rim."""
    rim = np.array(sizes.opening) / 2
    return (np.abs(position[:, :2]) < rim).all(axis=1) & (position[:, 2] > 0.0) & (position[:, 2] < sizes.height + HEAP_HEIGHT)


def report(results: RestResults, physics: Physics, any_volume: bool) -> list[MeasuredRow]:
    """Rows of the report. Bounds are violated if no pile came to rest; `any_volume` lifts the bound of the total volume, which fills by
    `arrangement.counts` need not keep."""
    piles = results.piles

    def over_objects(name: str) -> np.ndarray:
        return np.concatenate([getattr(pile, name) for pile in piles]) if piles else np.full(1, np.nan)

    def over_piles(name: str) -> np.ndarray:
        return np.array([getattr(pile, name) for pile in piles]) if piles else np.full(1, np.nan)

    ticks, volume, energy = over_piles("ticks"), over_piles("volume"), 1e6 * over_piles("energy")
    speed, tick_speed, depth = over_objects("speed"), over_objects("tick_speed"), over_objects("depth")
    inside = 100.0 * float(over_objects("inside").mean())
    limited = _bounded("total volume, max", float(volume.max()), "l", MAX_VOLUME * (1 + ROUNDING), f"<= {MAX_VOLUME:g}")
    largest = MeasuredRow(limited.name, limited.value, "l") if any_volume else limited
    return [
        MeasuredRow("arrangements at rest", len(piles), ""),
        MeasuredRow("arrangements given up", results.given_up, "", "= 0", results.given_up == 0),
        *(MeasuredRow(f"arrangements resampled: {name}", count, "") for name, count in sorted(results.resampled.items())),
        MeasuredRow("objects", sum(len(pile.speed) for pile in piles), ""),
        MeasuredRow("objects dropped again", sum(pile.redrops for pile in piles), ""),
        *_percentiles("ticks to rest", ticks, "", (50, 90, 100)),
        MeasuredRow("total volume, mean", float(volume.mean()), "l"),
        largest,
        *_percentiles("speed, instantaneous", speed, "mm/s", (50, 90, 99), MAX_SPEED),
        *_percentiles("speed, by displacement over a tick", tick_speed, "mm/s", (50, 90, 99), MAX_SPEED),
        *_percentiles("penetration", depth, "mm", (50,)),
        _bounded("penetration, 99 %", float(np.percentile(depth, 99)), "mm", MAX_DEPTH),
        *_percentiles("penetration", depth, "mm", (100,)),
        MeasuredRow("objects inside the tote", inside, "%", f">= {MIN_INSIDE:g}", inside >= MIN_INSIDE),
        *_percentiles("kinetic energy of a world", energy, "µJ", (50, 90, 100)),
        _bounded("contacts a world, most in a tick", results.contacts, "", physics.contacts_per_world),
        _bounded("pairs of shapes a world, most in a tick", results.pairs, "", physics.pairs_per_world),
    ]


def _bounded(name: str, value: float, unit: str, limit: float, bound: str = "") -> MeasuredRow:
    """Row of a value that must be below `limit`; NaN violates it."""
    return MeasuredRow(name, value, unit, bound or f"< {limit:g}", value < limit)


def _percentiles(name: str, values: np.ndarray, unit: str, which: tuple[int, ...], max_median: float | None = None) -> list[MeasuredRow]:
    """Rows of percentiles of values; with `max_median` the first one, the median, must be below it."""
    names = {50: "median", 100: "max"}
    rows = [MeasuredRow(f"{name}, {names.get(level, f'{level} %')}", float(np.percentile(values, level)), unit) for level in which]
    if max_median is not None:
        rows[0] = _bounded(rows[0].name, rows[0].value, unit, max_median)
    return rows


if __name__ == "__main__":
    sys.exit(main())
