"""Benchmarks of physics alone: scaling with the number of equal workpieces, timed from DROP_TICKS ticks after they are dropped, without
gripper; and with and without our replacements of Newton's components."""

import contextlib
import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any
from unittest import mock

import newton
import numpy as np
import warp as wp

from synpick_warp.cli.commands.doctor import GIB
from synpick_warp.configs.episodes.objects import Counts
from synpick_warp.configs.schema import LAYERED
from synpick_warp.factory.assembly import fit_to_catalog
from synpick_warp.factory.memory_plan import plan_memory
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.build import find_drawn
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.sim import physics
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.system.progress import SilentProgress
from tools.bench.run import FOREVER, Bench
from tools.options import MeasuredRow

DROP_TICKS, REST_TICKS = 24, 36
"""Ticks from the drop to the first measurement (1.6 s: nearly all objects have landed), and from its end to the second (2.4 s: objects
should be at rest, which is not checked)."""
PART = "bracket"
"""Workpiece whose piles are measured if the settings have no counts."""
INSTANCES = (10, 32, 64, 128, 251)
"""Default numbers of instances; the last is the largest that segmentation ids have room for."""
WARM_UP_TICKS, TICKS = 8, 80
"""Ticks before a measurement of replacements, in which kernels are loaded and graphs captured; and ticks measured, 5 s of an episode."""
NEWTONS_OWN = {
    "the fused solver": ("choose_solver", lambda device: newton.solvers.SolverSteel),
    "the separating broad phase": ("replace_broad_phase", lambda pipeline: None),
    "the launch sizes of the narrow phase": ("resize_blocks", lambda pipeline: None),
}
"""Replacement -> function of `stages.sim.physics` that installs it, and one to put in its place, which keeps Newton's own component."""


# ---- growth ----


def number_settings(counts: Counts, number: int) -> dict[str, Any]:
    """Settings by which `number` copies of one workpiece are dropped, in layers: of the one with the largest number in `counts`."""
    part = max(counts or ((PART, 1, 1),), key=lambda row: row[2])[0]
    fill = {"arrangement.counts": ((part, number, number),), "arrangement.max_objects": number, "arrangement.drop": LAYERED}
    return {"bake.mode": "move"} | fill | ({} if counts else {"objects.embedded": ("industrial",)})


def measure_growth(bench: Bench) -> Iterator[MeasuredRow]:
    """Time of a tick, contacts and memory of piles of equal workpieces in one bin, DROP_TICKS after the drop and REST_TICKS later. Raises
    ConfigError: a number does not fit into the bin, or into the device's memory."""
    config, device = bench.config, bench.device
    varied = [config.with_values(number_settings(config.arrangement.counts, number)) for number in bench.instances or INSTANCES]
    catalog, bins = load_catalog(max(varied, key=lambda each: each.arrangement.max_objects)), make_bins(config.cell.bins)
    for fitted in [fit_to_catalog(each, catalog, bins, device, SilentProgress()) for each in varied]:
        yield from _measure_equal_parts(replace(bench, config=fitted), catalog)


def _measure_equal_parts(bench: Bench, catalog: Catalog) -> Iterator[MeasuredRow]:
    """Rows of landing and of resting workpieces, of contacts, of overlapping bounding boxes (broad phase) and of memory."""
    config, device = bench.config, bench.device
    worlds, before = config.bake.worlds, _memory_in_use(device)
    simulation, name = Simulation(config, catalog, 1, device, None, range(worlds)), f"{config.arrangement.max_objects} instances"
    simulation.scene.settle.rest_ticks = simulation.scene.settle.max_ticks = FOREVER
    steps = config.physics.steps_per_tick * worlds
    for state, ticks in (("landing", DROP_TICKS), ("at rest", REST_TICKS)):
        for _ in range(ticks):
            simulation.tick()
        seconds = bench.seconds_per_call(simulation.tick)
        yield MeasuredRow(f"{name}, {state}: physics of a tick", 1e3 * seconds, "ms")
        yield MeasuredRow(f"{name}, {state}: world-steps", steps / seconds, "1/s")
        yield MeasuredRow(f"{name}, {state}: part-steps", steps * config.arrangement.max_objects / seconds, "1/s")
    own = simulation.physics
    for what, array in (("contacts", own.contacts.rigid_contact_count), ("overlaps", own.overlap_count)):
        yield MeasuredRow(f"{name}: {what} a world", int(array.numpy()[0]) / worlds)
    overflow = own.solver.constraint_overflow.numpy()[:-1]  # The last entry is that of bodies outside of all worlds.
    yield MeasuredRow(f"{name}: worlds without overflow", 100.0 * float(np.mean(~overflow)), "%")
    yield MeasuredRow(f"{name}: memory of the physics", (_memory_in_use(device) - before) / GIB, "GiB")
    pieces = max(len(catalog.bodies[index].pieces) for index in find_drawn(config.arrangement, catalog))
    terms = [term for term in plan_memory(config, device, 0, pieces) if term.name.startswith(("Newton", "the state", "separating"))]
    yield MeasuredRow(f"{name}: memory planned for it, at least", sum(term.size for term in terms) / GIB, "GiB")


def _memory_in_use(device: wp.Device) -> int:
    """Memory in use of Warp's pool on a GPU; on the CPU the peak resident set of the process [bytes]."""
    if device.is_cuda:
        wp.synchronize_device(device)
        return int(wp.get_mempool_used_mem_current(device))
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


# ---- replacements of Newton's components ----


def measure_patches(bench: Bench) -> Iterator[MeasuredRow]:
    """Ablation study: rates of physics in mode move with all replacements (`newton_patches`), without each, without any, and with all again
    to show the noise.

    The same piles fall, come to rest and are stirred in every run, since all variants find the same contacts.
    """
    config = bench.config.with_values({"bake.mode": "move", "bake.episodes": bench.config.bake.worlds})
    catalog, every = load_catalog(config), tuple(NEWTONS_OWN)
    without = {f"without {name}": (name,) for name in every}
    for name, left_out in {"all": (), **without, "Newton's own parts alone": every, "all, once more": ()}.items():
        with contextlib.ExitStack() as stack:
            for function, own in map(NEWTONS_OWN.__getitem__, left_out):
                stack.enter_context(mock.patch.object(physics, function, own))
            seconds = _time_stirring(Simulation(config, catalog, 1, bench.device))
        yield MeasuredRow(f"{name}: world-steps", TICKS * config.physics.steps_per_tick * config.bake.worlds / seconds, "1/s")


def _time_stirring(simulation: Simulation) -> float:
    """Time of TICKS ticks in which the gripper stirs [s], after the warm-up."""
    for _ in range(WARM_UP_TICKS):
        simulation.tick()
    wp.synchronize_device(simulation.device)
    started = time.perf_counter()
    for _ in range(TICKS):
        simulation.tick()
    wp.synchronize_device(simulation.device)
    return time.perf_counter() - started
