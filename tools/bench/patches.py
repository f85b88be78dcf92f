"""Ablation benchmark of the replacements of Newton's parts (`newton_patches`): rate of physics with all of them, and without each.

The same piles fall, come to rest and are stirred in every run, since all variants find the same contacts. Neither perception nor pictures.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from unittest import mock

import newton
import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.stages.sim import physics
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.system.hardware.device import pick_device
from tools.options import Row

WARM_UP_TICKS, TICKS = 8, 80
"""Ticks before the measurement, in which kernels are loaded and graphs captured, and ticks measured: 5 s of an episode."""
NEWTONS_OWN = {
    "the fused solver": ("choose_solver", lambda device: newton.solvers.SolverSteel),
    "the separating broad phase": ("replace_broad_phase", lambda pipeline: None),
    "the launch sizes of the narrow phase": ("resize_blocks", lambda pipeline: None),
}
"""Functions of `stages.sim.physics` that install a replacement, and functions in their place that leave Newton's own."""


def measure_patches(config: Config) -> Iterator[Row]:
    """Rates of physics with all replacements, without each, without any, and with all once more.

    Args:
        config: All settings; the mode is move.
    """
    config = config.with_values({"bake.mode": "move", "bake.episodes": config.bake.worlds})
    catalog, every = load_catalog(config), tuple(NEWTONS_OWN)
    without = {f"without {name}": (name,) for name in every}
    for run, names in {"all": (), **without, "Newton's own parts alone": every, "all, once more": ()}.items():
        with contextlib.ExitStack() as stack:
            for function, own in map(NEWTONS_OWN.__getitem__, names):
                stack.enter_context(mock.patch.object(physics, function, own))
            seconds = _seconds(Simulation(config, catalog, 1, pick_device(config.bake.device)))
        yield Row(f"{run}: world-steps", TICKS * config.physics.steps_per_tick * config.bake.worlds / seconds, "1/s")


def _seconds(simulation: Simulation) -> float:
    """Time of TICKS ticks [s]."""
    started = 0.0
    for tick in range(WARM_UP_TICKS + TICKS):
        if tick == WARM_UP_TICKS:
            wp.synchronize_device(simulation.device)
            started = time.perf_counter()
        simulation.tick()
    wp.synchronize_device(simulation.device)
    return time.perf_counter() - started
