"""Scaling benchmark of physics by instances: time of a tick, contacts and memory of piles of like parts, without pictures.

The part of `arrangement.counts` with the largest number is taken in each of the numbers, in the same bin, dropped in layers, and measured
DROP_TICKS ticks after the drop, while nearly all lie, and as soon as all rest.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.cli.commands.doctor import GIB
from synpick_warp.configs.episodes.objects import Counts
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


def number_settings(counts: Counts, number: int) -> dict[str, Any]:
    """Settings of `number` of the part of `counts` that there are most of, alone, dropped in layers."""
    part = max(counts or ((PART, 1, 1),), key=lambda row: row[2])[0]
    fill = {"arrangement.counts": ((part, number, number),), "arrangement.max_objects": number, "arrangement.drop": LAYERED}
    return {"bake.mode": "move"} | fill | ({} if counts else {"objects.embedded": ("industrial",)})


def measure_instances(config: Config, numbers: Sequence[int], min_seconds: float) -> Iterator[Row]:
    """Measure piles of each of the numbers; a measurement is repeated for at least `min_seconds` [s].

    Raises:
        ConfigError: A number does not fit into the bin, or into the device's memory.
    """
    started, device = time.perf_counter(), pick_device(config.bake.device)
    varied = [config.with_values(number_settings(config.arrangement.counts, number)) for number in numbers]
    catalog = load_catalog(max(varied, key=lambda each: each.arrangement.max_objects))
    bins = make_bins(config.cell.bins)
    piles = [_Pile(fit_to_catalog(each, catalog, bins, device, SilentProgress()), catalog, device) for each in varied]
    for pile in piles:
        yield from pile.measure(min_seconds)
    yield Row("all measurements", time.perf_counter() - started, "s")


def _memory_in_use(device: wp.Device) -> int:
    """Memory of Warp's arrays on a GPU, or peak memory of the process [bytes]."""
    if device.is_cuda:
        wp.synchronize_device(device)
        return int(wp.get_mempool_used_mem_current(device))
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@dataclass(frozen=True, eq=False)
class _Pile:
    """Worlds with piles of a number of like parts."""

    config: Config
    catalog: Catalog
    device: wp.Device

    def measure(self, min_seconds: float) -> Iterator[Row]:
        """Rows of landing and resting parts, each repeated for at least `min_seconds` [s], of contacts and of memory."""
        config = self.config
        worlds, steps = config.bake.worlds, config.physics.steps_per_tick * config.bake.worlds
        before = _memory_in_use(self.device)
        simulation = Simulation(config, self.catalog, 1, self.device, None, range(worlds))
        simulation.scene.settle.rest_ticks = simulation.scene.settle.max_ticks = FOREVER
        physics, name = simulation.physics, f"{config.arrangement.max_objects} instances"
        for state, ticks in (("landing", DROP_TICKS), ("at rest", REST_TICKS)):
            for _ in range(ticks):
                simulation.tick()
            seconds = seconds_per_call(simulation.tick, self.device, min_seconds, BURST)
            yield Row(f"{name}, {state}: physics of a tick", 1e3 * seconds, "ms")
            yield Row(f"{name}, {state}: world-steps", steps / seconds, "1/s")
            yield Row(f"{name}, {state}: part-steps", steps * config.arrangement.max_objects / seconds, "1/s")
        for what, array in (("contacts", physics.contacts.rigid_contact_count), ("overlaps", physics.overlap_count)):
            yield Row(f"{name}: {what} a world", int(array.numpy()[0]) / worlds)
        yield Row(f"{name}: worlds without overflow", 100.0 * float(np.mean(~physics.solver.constraint_overflow.numpy()[:-1])), "%")
        yield Row(f"{name}: memory of the physics", (_memory_in_use(self.device) - before) / GIB, "GiB")
        yield Row(f"{name}: memory planned for it, at least", self.planned() / GIB, "GiB")

    def planned(self) -> int:
        """Memory that the plan has for Newton, the state of the worlds and separating axes [bytes]."""
        pieces = max(len(self.catalog.bodies[index].pieces) for index in find_drawn(self.config.arrangement, self.catalog))
        terms = plan_memory(self.config, self.device, 0, pieces)
        return sum(term.size for term in terms if term.name.startswith(("Newton", "the state", "separating")))
