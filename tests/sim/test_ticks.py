"""Tick loop: ticks come in order, physics is ahead as far as it may be, and no snapshot is overwritten while a queue still reads it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from types import SimpleNamespace

import pytest
import warp as wp

from synpick_warp.codes import Phase, Status, column_names
from synpick_warp.factory import memory_plan
from synpick_warp.stages import tick_queue, ticks
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.perception.arrays import Observation, Plan
from synpick_warp.stages.sim.simulate import Simulation, TickRecord
from synpick_warp.stages.sim.worlds import WorldStatus, world_sizes
from synpick_warp.stages.stream import TickReader
from synpick_warp.stages.tick_queue import MAX_LEAD, QUEUE_BYTES, QUEUE_PART, TickQueue, queue_lead, record_bytes
from tests.harness.memory_tables import queued_ticks
from tests.harness.spin import SPINS, spin_kernel
from tests.worlds.small_worlds import catalog, settings

TICKS, WORLDS = 24, 64
PARTS = 2 * ticks.PARTS_IN_FLIGHT + 3
"""Parts of a tick: more than are enqueued ahead."""
PHASE = column_names(Status)["phase"]
SOME_IDLE, ALL_IDLE = 8, 16
"""First tick at whose end a world is idle, and first at whose end all are."""


def new_record(device: wp.Device) -> TickRecord:
    config = settings()
    sizes = world_sizes(WORLDS, config.arrangement.max_objects, config.move.rounds, bodies_per_world=1, cups=1)
    return TickRecord(*(allocate(kind, sizes, device) for kind in (Snapshot, WorldStatus, Observation, Plan)))


class NumberingSimulation:
    """Writes into the record of its n-th tick the number n, from 0 on; keeps the order of all that happens in `events`."""

    def __init__(self, device: wp.Device, episodes: int = WORLDS + 1) -> None:
        self.device, self.count, self.events = device, 0, []
        self.record, self.episodes, self.layout = new_record(device), range(episodes), SimpleNamespace(worlds=WORLDS)
        self.status = self.record.status.table.numpy()

    def tick_parts(self) -> Iterator[None]:
        number = self.count
        self.count += 1
        for _ in range(PARTS - 1):
            yield
        self.events.append(f"tick {number}")
        idle = WORLDS if number >= ALL_IDLE else number >= SOME_IDLE
        self.status[:, PHASE] = Phase.ACT
        self.status[:idle, PHASE] = Phase.IDLE
        self.record.status.table.assign(self.status)
        self.record.snapshot.frame.fill_(number)
        self.record.plan.target.fill_(number)


@pytest.fixture
def simulation(device) -> NumberingSimulation:
    return NumberingSimulation(device)


@pytest.mark.parametrize("batches", [0, 1, 5, 100])
@pytest.mark.parametrize("lead", [None, 0, 1, 5])
def test_ticks_come_in_order_with_their_own_reports_and_snapshots(simulation, lead, batches):
    with ticks.TickLoop(simulation, lead) as loop:
        for number in range(TICKS):
            report, snapshot = loop.advance()
            assert set(report.plan.target.tolist()) == set(snapshot.frame.numpy().tolist()) == {number}
            for _ in range(batches):
                loop.enqueue()


def test_physics_is_one_tick_ahead_until_a_world_is_idle_then_by_the_queue_and_stops_at_the_end(simulation):
    """With a device that has done all that is enqueued, ticks that have begun are counted before and after the next ones are enqueued."""
    lead, begun = 5, []
    with ticks.TickLoop(simulation, lead) as loop:
        for number in range(ALL_IDLE + 1):
            loop.advance()
            for _ in range(lead * PARTS):
                wp.synchronize_device(simulation.device)
                loop.enqueue()
            begun.append(simulation.count - number - 1)
    assert begun[: SOME_IDLE - 1] == [1] * (SOME_IDLE - 1)
    ends = [min(lead, ALL_IDLE - number) for number in range(SOME_IDLE - 1, ALL_IDLE + 1)]
    assert begun[SOME_IDLE - 1 :] == ends


def test_without_waiting_episodes_physics_is_ahead_from_the_start(device):
    simulation = NumberingSimulation(device, episodes=WORLDS)
    with ticks.TickLoop(simulation, max_lead=3) as loop:
        for _ in range(3 * PARTS):
            wp.synchronize_device(device)
            loop.enqueue()
        assert simulation.count == 3


def test_a_cpu_simulates_only_what_is_asked_for():
    simulation = NumberingSimulation(wp.get_device("cpu"))
    with ticks.TickLoop(simulation) as loop:
        for number in range(TICKS):
            assert simulation.count == number
            loop.advance()
            loop.enqueue()


def test_a_slow_renderer_reads_each_snapshot_whole(simulation):
    """The host never waits for the rendering: physics' stream must."""
    device = simulation.device
    busy = wp.zeros(1, dtype=float, device=device)
    wp.launch(spin_kernel, dim=1, inputs=[busy, 1], device=device)  # Loads it.
    pictures = [wp.zeros(WORLDS, dtype=wp.int32, device=device) for _ in range(TICKS)]
    with ticks.TickLoop(simulation, max_lead=2) as loop:
        for picture in pictures:
            _, snapshot = loop.advance()
            wp.launch(spin_kernel, dim=1, inputs=[busy, SPINS], device=device)
            wp.copy(picture, snapshot.frame)
    assert [sorted(set(picture.numpy().tolist())) for picture in pictures] == [[tick] for tick in range(TICKS)]


def test_the_last_tick_is_awaited_whatever_ends_the_loop(simulation, monkeypatch):
    awaited = []
    monkeypatch.setattr(wp, "synchronize_stream", awaited.append)
    loop = ticks.TickLoop(simulation)
    with contextlib.suppress(ZeroDivisionError), loop:
        loop.advance()
        raise ZeroDivisionError
    assert awaited == ([loop.stream] if simulation.device.is_cuda else [])


def test_queued_ticks_keep_their_arrays_while_others_are_put(device):
    """Every array of the record is filled with the tick's number, and read after the queue was filled."""
    record = new_record(device)
    parts = {name: getattr(record, name) for name in ("snapshot", "observation", "plan")}
    queue = TickQueue(record, 3)
    for tick in range(3):
        for array in (array for part in parts.values() for array in vars(part).values()):
            array.zero_()
            array.view(wp.float32 if array.dtype == wp.transformf else array.dtype).fill_(tick)
        record.status.table.fill_(tick)
        queue.put(tick)
    for tick in range(3):
        report, snapshot = queue.get(tick)
        for array in vars(snapshot).values():
            assert (array.numpy() == tick).all()
        for part in (report.observation, report.plan):
            assert all((values == tick).all() for values in vars(part).values())
        assert (report.status == tick).all()
        assert (queue.phase(tick) == tick).all()


def test_the_queue_fits_its_memory_and_has_no_lead_on_a_cpu():
    cuda, cpu = SimpleNamespace(is_cuda=True, total_memory=QUEUE_PART * QUEUE_BYTES), SimpleNamespace(is_cuda=False)
    assert queue_lead(1000, cuda) == MAX_LEAD
    assert queue_lead(QUEUE_BYTES // 10, cuda) == 9
    assert queue_lead(10 * QUEUE_BYTES, cuda) == 1
    larger, smaller = (SimpleNamespace(is_cuda=True, total_memory=int(factor * cuda.total_memory)) for factor in (2, 0.5))
    assert queue_lead(QUEUE_BYTES // 10, larger) == 9
    assert queue_lead(QUEUE_BYTES // 10, smaller) == 4
    assert queue_lead(1000, cpu) == 0
    record = new_record(wp.get_device("cpu"))
    arrays = [array for part in vars(record).values() if part is not None for array in vars(part).values()]
    assert record_bytes(record) == size_of(arrays)


@pytest.mark.parametrize("formats", [["bop"], ["zarr"]])
def test_the_memory_plan_counts_the_queue(device, monkeypatch, formats):
    """A queue of 200 ticks, to the byte: with another size of a record it would have fewer or more."""
    config = settings(bake__worlds=8, bake__formats=formats)
    record = Simulation(config, catalog(), 1, device, records_physics=formats == ["zarr"]).record
    monkeypatch.setattr(tick_queue, "QUEUE_PART", 1)
    monkeypatch.setattr(tick_queue, "QUEUE_BYTES", 200 * record_bytes(record))
    gpu = SimpleNamespace(is_cuda=True, total_memory=QUEUE_BYTES)
    assert queued_ticks(config, gpu) == 200
    monkeypatch.setattr(tick_queue, "QUEUE_BYTES", 200 * record_bytes(record) - 1)
    assert queued_ticks(config, gpu) == 199
    slots = queued_ticks(config, device)
    planned = {term.name: term.size for term in memory_plan.plan_memory(config, device)}
    assert planned[f"a queue of {slots} ticks"] == slots * size_of(vars(record.snapshot).values())
    assert planned[f"reports of {slots} ticks"] == slots * size_of(TickReader.reported(record))


def size_of(arrays: Iterable[wp.array]) -> int:
    """Size of arrays [bytes]."""
    return sum(array.numpy().nbytes for array in arrays)
