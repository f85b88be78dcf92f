"""Measure piles at rest: simulate arrangements until each has settled, and print speeds, penetration, volume and what fell out.

A world is at rest in the tick in which it begins to act. Its numbers are taken there; then it gets the next arrangement, so that
arrangements may outnumber worlds. Exits with 1 if a bound is violated, with 2 if nothing can be simulated.

    python -m tools.reports.rest --models DIR --arrangements 64 --device cpu
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console

from synpick_warp.cli.doctor import describe_machine
from synpick_warp.codes import Ending, Phase
from synpick_warp.configs.schema import Config
from synpick_warp.device import pick_device
from synpick_warp.errors import SynpickError
from synpick_warp.scenes import build
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.sim.physics import with_enough_worlds
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import TickReader, TickReport
from tools.options import INTERRUPTED, Row, configure, fail, make_parser, print_machine, print_rows, write_json

MOST_SPEED = 0.2
"""Median of the objects' speeds [mm/s]."""
MOST_DEPTH = 1.0
"""99th percentile of the objects' penetration [mm]."""
LEAST_INSIDE = 99.0
"""Share of the objects inside the tote [%]."""
MOST_VOLUME = 7.0
"""Total volume of an arrangement's collision shapes [l]."""
HEAP = 0.1
"""How far above the rim the centre of mass of an object on the heap may lie [m]."""
SAY_EVERY = 10.0
"""Time between two lines about how far it is [s]."""
ROUNDING = 1e-6
"""Relative error of a total volume that was summed in single precision."""


@dataclass(frozen=True, eq=False)
class Pile:
    """One arrangement at rest. Arrays hold one number an object."""

    episode: int
    ticks: int
    """From the drop to rest."""
    redrops: int
    volume: float
    """[l]"""
    energy: float
    """Kinetic energy [J]."""
    tick_speed: np.ndarray
    """Displacement of the centre of mass over the last tick, by its time [mm/s]."""
    speed: np.ndarray
    """Speed of the centre of mass [mm/s]."""
    depth: np.ndarray
    """Deepest penetration [mm]."""
    inside: np.ndarray
    """Whether the centre of mass lies in the tote."""


@dataclass
class Findings:
    """What came of all arrangements."""

    piles: list[Pile] = field(default_factory=list)
    redrawn: Counter[str] = field(default_factory=Counter)
    """Arrangements drawn again, by ending."""
    given_up: int = 0


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and return the exit code."""
    options = _parse(arguments)
    console = Console(highlight=False)
    try:
        config = _config(options)
        device = pick_device(config.bake.device)
        config = with_enough_worlds(config, device)
        catalog = load_catalog(config, report=console.print)
        started = time.perf_counter()
        simulation = Simulation(config, catalog, 1, device)
    except SynpickError as error:
        return fail("reports.rest", error)
    findings = Findings()
    interrupted = False
    try:
        settle(simulation, catalog, findings, console.print)
    except KeyboardInterrupt:
        interrupted = True
        print(f"reports.rest: interrupted; {len(findings.piles)} of {config.bake.episodes} arrangements are at rest", file=sys.stderr)
    machine = describe_machine(device)
    rows = report(findings)
    wall = time.perf_counter() - started
    print_machine(console, machine)
    objects = "the models folder's objects" if config.bake.models else "the embedded objects"
    title = f"{config.bake.episodes} arrangements of {objects} in {config.bake.worlds} worlds, seed {config.bake.seed}, {wall:.0f} s"
    print_rows(console, "at rest", title, rows)
    record = {
        "machine": dict(machine),
        "arrangements": config.bake.episodes,
        "worlds": config.bake.worlds,
        "seed": config.bake.seed,
        "real_objects": bool(options.models),
        "interrupted": interrupted,
        "seconds": wall,
        "rows": [row.record() for row in rows],
    }
    write_json(options.json, record)
    return INTERRUPTED if interrupted else 0 if all(row.holds for row in rows) else 1


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = make_parser(__doc__, "models", "device", "seed", "set", "json")
    parser.add_argument("--arrangements", type=int, default=64, help="how many to settle (default: 64)")
    parser.add_argument("--worlds", type=int, help="side by side (default: one for each arrangement)")
    return parser.parse_args(arguments)


def _config(options: argparse.Namespace) -> Config:
    # Arrangements of mode move: an object may come several times, and perception is not needed.
    worlds = options.worlds or options.arrangements
    return configure(options, {"bake.mode": "move", "bake.episodes": options.arrangements, "bake.worlds": worlds})


def settle(simulation: Simulation, catalog: Catalog, findings: Findings, say: Callable[[str], None]) -> None:
    """Let every arrangement come to rest or be given up, enter into `findings` what those at rest are like, and say how far it is."""
    config = simulation.config
    said = time.perf_counter()
    record = simulation.records[0]
    reader = TickReader(record)
    before: TickReport | None = None
    while True:
        simulation.tick(record)
        reader.start()
        report = reader.wait()
        phase = report.column("phase")
        for world in np.flatnonzero(phase == Phase.OVER):
            findings.redrawn[Ending(int(report.column("ending")[world])).name.lower()] += 1
            findings.given_up += int(report.column("redraw")[world]) + 1 == config.settle.tries
        resting = np.flatnonzero(phase == Phase.ACT)
        if len(resting):
            assert before is not None  # A pile rests for several ticks before it counts as settled.
            findings.piles += _measure(simulation, catalog, before, report, resting)
            _finish(simulation, resting)
        if (phase == Phase.IDLE).all():
            return
        if time.perf_counter() - said >= SAY_EVERY:
            said = time.perf_counter()
            say(f"{len(findings.piles)} of {config.bake.episodes} arrangements at rest")
        before = report


def _finish(simulation: Simulation, worlds: np.ndarray) -> None:
    """End the episodes of these worlds as if the gripper had done its work, so that the next tick hands out new ones."""
    state = simulation.state
    for array, value in ((state.phase, Phase.OVER), (state.ending, Ending.FINISHED)):
        host = array.numpy()
        host[worlds] = int(value)
        array.assign(host)


def _measure(simulation: Simulation, catalog: Catalog, before: TickReport, now: TickReport, worlds: np.ndarray) -> list[Pile]:
    """Numbers of these worlds at the end of this tick."""
    state, layout = simulation.state, simulation.layout
    tick = simulation.config.physics.step * simulation.config.physics.steps_per_tick
    progress, slots = state.progress.numpy(), state.body_slot.numpy()
    body_qd = simulation.physics.state.body_qd
    assert body_qd is not None  # Newton's models of rigid bodies have it.
    depths, velocities = state.penetration.numpy(), body_qd.numpy().astype(np.float64)
    piles = []
    for world in worlds:
        instances = np.flatnonzero(now.catalog_index[world] >= 0)
        entries = [catalog.entries[index] for index in now.catalog_index[world][instances]]
        bodies = world * layout.bodies_per_world + build.GRIPPER_BODIES + slots[world][instances]
        centers = np.array([entry.center_of_mass for entry in entries])
        place, turn = place_of(now.pose[world][instances], centers)
        last, _ = place_of(before.pose[world][instances], centers)
        linear, angular = velocities[bodies, :3], velocities[bodies, 3:]
        spin = np.einsum("nji,nj->ni", turn, angular)
        inertia = np.array([entry.inertia for entry in entries])
        mass = np.array([entry.mass for entry in entries])
        energy = (mass * (linear**2).sum(axis=1)).sum() + np.einsum("ni,nij,nj->", spin, inertia, spin)
        piles.append(
            Pile(
                episode=int(now.column("episode")[world]),
                ticks=int(progress[world][0]),
                redrops=int(progress[world][2]),
                volume=1e3 * sum(entry.volume for entry in entries),
                energy=float(0.5 * energy),
                tick_speed=1e3 * np.linalg.norm(place - last, axis=1) / tick,
                speed=1e3 * np.linalg.norm(linear, axis=1),
                depth=1e3 * depths[bodies],
                inside=is_inside(simulation.config, place),
            )
        )
    return piles


def place_of(pose: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World positions (N, 3) of `point` (N, 3), given in the frames that `pose` (N, 7) places, and these frames' rotations (N, 3, 3)."""
    x, y, z, w = pose[:, 3:].astype(np.float64).T
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    return pose[:, :3] + np.einsum("nij,nj->ni", turn, point), turn


def is_inside(config: Config, place: np.ndarray) -> np.ndarray:
    """Whether points (N, 3) lie above the floor, within the rim's opening, and at most `HEAP` above the rim."""
    rim = np.array(config.tote.rim_size) / 2
    height = config.tote.outer_size[2] - config.tote.wall
    return (np.abs(place[:, :2]) < rim).all(axis=1) & (place[:, 2] > 0.0) & (place[:, 2] < height + HEAP)


def report(findings: Findings) -> list[Row]:
    """The lines of the report; with no pile at rest the bounds are violated."""
    piles = findings.piles

    def over_objects(name: str) -> np.ndarray:
        return np.concatenate([getattr(pile, name) for pile in piles]) if piles else np.full(1, np.nan)

    def over_piles(name: str) -> np.ndarray:
        return np.array([getattr(pile, name) for pile in piles]) if piles else np.full(1, np.nan)

    ticks, volume, energy = over_piles("ticks"), over_piles("volume"), 1e6 * over_piles("energy")
    speed, tick_speed, depth = over_objects("speed"), over_objects("tick_speed"), over_objects("depth")
    inside = 100.0 * float(over_objects("inside").mean())
    return [
        Row("arrangements at rest", len(piles), ""),
        Row("arrangements given up", findings.given_up, "", "= 0", findings.given_up == 0),
        *(Row(f"drawn again: {name}", count, "") for name, count in sorted(findings.redrawn.items())),
        Row("objects", sum(len(pile.speed) for pile in piles), ""),
        Row("objects dropped again", sum(pile.redrops for pile in piles), ""),
        *_percentiles("ticks to rest", ticks, "", (50, 90, 100)),
        Row("total volume, mean", float(volume.mean()), "l"),
        _bounded("total volume, max", float(volume.max()), "l", MOST_VOLUME * (1 + ROUNDING), f"<= {MOST_VOLUME:g}"),
        *_percentiles("speed, instantaneous", speed, "mm/s", (50, 90, 99), MOST_SPEED),
        *_percentiles("speed, by displacement over a tick", tick_speed, "mm/s", (50, 90, 99), MOST_SPEED),
        *_percentiles("penetration", depth, "mm", (50,)),
        _bounded("penetration, 99 %", float(np.percentile(depth, 99)), "mm", MOST_DEPTH, f"< {MOST_DEPTH:g}"),
        *_percentiles("penetration", depth, "mm", (100,)),
        Row("objects inside the tote", inside, "%", f">= {LEAST_INSIDE:g}", inside >= LEAST_INSIDE),
        *_percentiles("kinetic energy of a world", energy, "µJ", (50, 90, 100)),
    ]


def _bounded(name: str, value: float, unit: str, most: float, bound: str) -> Row:
    return Row(name, value, unit, bound, value < most)  # NaN violates it.


def _percentiles(name: str, values: np.ndarray, unit: str, which: tuple[int, ...], most_median: float | None = None) -> list[Row]:
    names = {50: "median", 100: "max"}
    rows = [Row(f"{name}, {names.get(level, f'{level} %')}", float(np.percentile(values, level)), unit) for level in which]
    if most_median is not None:
        rows[0] = _bounded(rows[0].name, rows[0].value, unit, most_median, f"< {most_median:g}")
    return rows


if __name__ == "__main__":
    sys.exit(main())
