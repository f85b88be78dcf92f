"""Scaling benchmark of physics by instances: time of a tick, contacts and memory of piles of like parts, without pictures.

The part of `arrangement.counts` with the largest number is taken in each of the numbers, in the same bin, dropped in layers, and measured
DROP_TICKS ticks after the drop, while nearly all lie, and as soon as all rest.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Sequence

import numpy as np
import warp as wp

from synpick_warp.cli.commands.doctor import GIB
from synpick_warp.configs.schema import LAYERED, Config
from synpick_warp.factory.assembly import fit_to_catalog
from synpick_warp.factory.memory_plan import plan_memory
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.build import find_drawn
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from tools.bench.physics import BURST, FOREVER, seconds_per_call
from tools.options import Row

DROP_TICKS = 24
"""Ticks from the drop to the measurement: 1.6 s, in which nearly all objects land."""
REST_TICKS = 36
"""Ticks from the first measurement to the second: 4 s after the drop."""
PART = "bracket"
"""Part whose piles are measured if the settings have no counts."""


def vary_number(config: Config, number: int) -> Config:
    """The settings with `number` of the part that there are most of, alone, dropped in layers."""
    counts = config.arrangement.counts or ((PART, 1, 1),)
    part = max(counts, key=lambda row: row[2])[0]
    fill = {"arrangement.counts": ((part, number, number),), "arrangement.max_objects": number, "arrangement.drop": LAYERED}
    objects = {} if config.arrangement.counts else {"objects.embedded": ("industrial",)}
    return config.with_values({"bake.mode": "move"} | fill | objects)


def measure_instances(config: Config, numbers: Sequence[int], min_seconds: float) -> Iterator[Row]:
    """Measure piles of each of the numbers; a measurement is repeated for at least `min_seconds` [s].

    Raises:
        ConfigError: A number does not fit into the bin, or into the device's memory.
    """
    started, device = time.perf_counter(), pick_device(config.bake.device)
    catalog = load_catalog(vary_number(config, max(numbers)))
    bins = make_bins(config.cell.bins)
    piles = [fit_to_catalog(vary_number(config, number), catalog, bins, device, SilentProgress()) for number in numbers]
    for pile in piles:
        yield from _measure_pile(pile, catalog, device, min_seconds)
    yield Row("all measurements", time.perf_counter() - started, "s")


def _measure_pile(config: Config, catalog: Catalog, device: wp.Device, min_seconds: float) -> Iterator[Row]:
    """Rows of worlds with the parts of the settings."""
    worlds, steps = config.bake.worlds, config.physics.steps_per_tick * config.bake.worlds
    before = _memory_in_use(device)
    simulation = Simulation(config, catalog, 1, device, None, range(worlds))
    simulation.scene.settle.rest_ticks = simulation.scene.settle.max_ticks = FOREVER
    physics, name = simulation.physics, f"{config.arrangement.max_objects} instances"
    for state, ticks in (("landing", DROP_TICKS), ("at rest", REST_TICKS)):
        for _ in range(ticks):
            simulation.tick()
        seconds = seconds_per_call(simulation.tick, device, min_seconds, BURST)
        yield Row(f"{name}, {state}: physics of a tick", 1e3 * seconds, "ms")
        yield Row(f"{name}, {state}: world-steps", steps / seconds, "1/s")
        yield Row(f"{name}, {state}: part-steps", steps * config.arrangement.max_objects / seconds, "1/s")
    for what, array in (("contacts", physics.contacts.rigid_contact_count), ("overlaps", physics.overlap_count)):
        yield Row(f"{name}: {what} a world", int(array.numpy()[0]) / worlds)
    yield Row(f"{name}: worlds without overflow", 100.0 * float(np.mean(~physics.solver.constraint_overflow.numpy()[:-1])), "%")
    planned = _planned(config, catalog, device)
    yield Row(f"{name}: memory of the physics", (_memory_in_use(device) - before) / GIB, "GiB")
    yield Row(f"{name}: memory planned for it, at least", planned / GIB, "GiB")


def _memory_in_use(device: wp.Device) -> int:
    """Memory of Warp's arrays on a GPU, or peak memory of the process [bytes]."""
    if device.is_cuda:
        wp.synchronize_device(device)
        return int(wp.get_mempool_used_mem_current(device))
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _planned(config: Config, catalog: Catalog, device: wp.Device) -> int:
    """Memory that the plan has for Newton, the state of the worlds and separating axes [bytes]."""
    pieces = max(len(catalog.bodies[index].pieces) for index in find_drawn(config.arrangement, catalog))
    terms = plan_memory(config, device, 0, pieces)
    return sum(term.size for term in terms if term.name.startswith(("Newton", "the state", "separating")))
