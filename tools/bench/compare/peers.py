"""Peers of the benchmark: which there are, what they need, and the order in which they are measured."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Iterator
from functools import partial

import warp as wp

from synpick_warp.configs.schema import Config, Physics, Tote
from synpick_warp.errors import SynpickError
from synpick_warp.factory.assembly import build_factory
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.system.progress import SilentProgress
from tools.bench import physics
from tools.bench.compare.engines import CONES, Engine, MujocoEngine, make_mujoco_warp, make_ours
from tools.bench.compare.piles import Pile, pick_pile
from tools.bench.compare.rendering import measure_rendering
from tools.bench.compare.sensor import measure_sensor
from tools.bench.compare.simulation import measure_engine
from tools.options import Row, of_part

PEERS = ("mujoco-warp", "mujoco", "sensor-camera")
MODULES = {"mujoco-warp": ("mujoco", "mujoco_warp"), "mujoco": ("mujoco",)}
"""Modules that peers import, besides those of the product."""
PILE_WORLDS = 64
"""Worlds that are settled for the comparison; rendering repeats them, physics takes one of them."""


def check_installed(peers: tuple[str, ...]) -> None:
    """Look for the peers' libraries.

    Raises:
        SynpickError: One is missing.
    """
    modules = dict.fromkeys(module for peer in peers for module in MODULES.get(peer, ()))
    if missing := [module for module in modules if importlib.util.find_spec(module) is None]:
        raise SynpickError(f"--compare {','.join(peers)} needs {' and '.join(missing)}: pip install 'synpick-warp[peers]'")


def measure_peers(config: Config, peers: tuple[str, ...], min_seconds: float) -> Iterator[Row]:
    """Benchmark of peers beside ours, on piles at rest; a peer that fails costs its own rows alone.

    Args:
        config: All settings; physics is measured in `bake.worlds` worlds.
        peers: Names out of `PEERS`.
        min_seconds: Time for which a measurement of rendering is repeated, at least [s].
    """
    if not peers:
        return
    started = time.perf_counter()
    few = config.with_values({"bake.worlds": min(config.bake.worlds, PILE_WORLDS)})
    factory = build_factory(few, SilentProgress())
    _settle(factory.simulation)
    pile = pick_pile(factory.catalog, factory.simulation.record.snapshot)
    yield Row(f"build and settle {few.bake.worlds} worlds", time.perf_counter() - started, "s", part="setup")
    if "sensor-camera" in peers:
        yield from _guard("sensor", partial(measure_sensor, factory, min_seconds))
    if "mujoco-warp" in peers:
        yield from _guard("mujoco-warp", partial(measure_rendering, factory, min_seconds))
    if {"mujoco-warp", "mujoco"} & set(peers):
        yield from _measure_physics(config.physics, config.tote, config.bake.worlds, pile, peers, factory.simulation.device)


def _settle(simulation: Simulation) -> None:
    """Let new worlds drop their piles and come to rest."""
    simulation.scene.settle.rest_ticks = simulation.scene.settle.max_ticks = physics.FOREVER
    for _ in range(physics.FALL_TICKS + physics.SETTLE_TICKS):
        simulation.tick()


def _measure_physics(physics: Physics, tote: Tote, worlds: int, pile: Pile, peers: tuple[str, ...], device: wp.Device) -> Iterator[Row]:
    """Benchmark of physics engines on one pile: ours, then each peer with each friction cone."""

    def measure(make: Callable[[], Engine]) -> Iterator[Row]:
        yield from measure_engine(make(), tote, pile)

    ours = make_ours(physics, tote, pile, worlds, device)
    yield from of_part("ours", measure(lambda: ours))
    if "mujoco" in peers:
        for cone in CONES:
            yield from _guard("mujoco", partial(measure, partial(MujocoEngine, physics, tote, pile, cone)))
    if "mujoco-warp" in peers:
        for cone in CONES:
            make = partial(make_mujoco_warp, physics, tote, pile, worlds, device, cone, ours.peak_contacts)
            yield from _guard("mujoco-warp", partial(measure, make))


def _guard(part: str, measure: Callable[[], Iterator[Row]]) -> Iterator[Row]:
    """Rows of a peer; if it raises an exception, a last row with the reason."""
    try:
        yield from of_part(part, measure())
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0]
        yield Row(f"failed: {type(error).__name__}: {reason}", math.nan, part=part)
