"""Tick loop: ticks come in order, physics is ahead as far as it may be, and no snapshot is overwritten while a queue still reads it.

First on the device; then on a model of a GPU that executes its streams in random order.
"""

import contextlib
import itertools
import random
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import Phase, Status, column_names
from synpick_warp.factory import memory_plan
from synpick_warp.stages import ticks, view_ring
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.perception.images import Observation, Plan
from synpick_warp.stages.sim.simulate import Simulation, TickRecord
from synpick_warp.stages.sim.worlds import WorldStatus, world_sizes
from synpick_warp.stages.stream import TickReader
from synpick_warp.stages.ticks import MAX_LEAD, QUEUE_BYTES, QUEUE_PART, TickQueue, queue_lead, record_bytes
from tests.harness.cuda_model import ModelArray, ModelDevice
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
    monkeypatch.setattr(ticks, "QUEUE_PART", 1)
    monkeypatch.setattr(ticks, "QUEUE_BYTES", 200 * record_bytes(record))
    gpu = SimpleNamespace(is_cuda=True, total_memory=QUEUE_BYTES)
    assert queued_ticks(config, gpu) == 200
    monkeypatch.setattr(ticks, "QUEUE_BYTES", 200 * record_bytes(record) - 1)
    assert queued_ticks(config, gpu) == 199
    slots = queued_ticks(config, device)
    planned = {term.name: term.size for term in memory_plan.plan_memory(config, device)}
    assert planned[f"a queue of {slots} ticks"] == slots * size_of(vars(record.snapshot).values())
    assert planned[f"reports of {slots} ticks"] == slots * size_of(TickReader.reported(record))


def size_of(arrays: Iterable[wp.array]) -> int:
    """Size of arrays [bytes]."""
    return sum(array.numpy().nbytes for array in arrays)


# ---- on a model of a GPU ----

NAMES = [item.name for item in fields(Snapshot)]
UNFINISHED = -1
"""Value of all arrays of a record while a tick is simulated."""
TRIALS = 150


class ModelReader:
    """`TickReader` of a record whose only reported array is a pair: the tick's number, and the phases of the worlds."""

    def __init__(self, record: SimpleNamespace, target: list[ModelArray]) -> None:
        self.copy = view_ring.HostCopy(self.reported(record), target)

    @staticmethod
    def reported(record: SimpleNamespace) -> list[Any]:
        return [record.status]

    def start(self) -> None:
        self.copy.start(None)

    def phase(self) -> np.ndarray | None:
        return self.copy.target[0].numpy()[1] if self.copy.is_done else None

    def wait(self) -> Any:
        return self.copy.wait()[0]


class ModelSimulation:
    """Writes the number of each tick, from 0 on, into all arrays of its record; world w is idle from tick `ends[w]` on."""

    def __init__(self, device: ModelDevice, ends: list[int], waiting: int, parts: int) -> None:
        self.device, self.ends, self.parts, self.count = device, np.array(ends), parts, 0
        self.episodes, self.layout = range(len(ends) + waiting), SimpleNamespace(worlds=len(ends))
        snapshot = SimpleNamespace(**{name: ModelArray(device) for name in NAMES})
        self.record = SimpleNamespace(snapshot=snapshot, status=ModelArray(device))

    def phases(self, tick: int) -> np.ndarray:
        return np.where(tick < self.ends, Phase.ACT, Phase.IDLE)

    def tick_parts(self) -> Iterator[None]:
        tick = self.count
        self.count += 1
        for _ in range(self.parts - 1):
            self.device.stream.enqueue(lambda: self._write(UNFINISHED))
            yield
        self.device.stream.enqueue(lambda: self._write(tick))

    def _write(self, tick: int) -> None:
        for array in vars(self.record.snapshot).values():
            array.value = tick
        self.record.status.value = tick, self.phases(tick)


@pytest.fixture
def make_device(monkeypatch) -> Callable[[int], ModelDevice]:
    """Factory that replaces Warp by the model of a GPU, which executes queued operations whenever the host sleeps."""

    def make(seed: int) -> ModelDevice:
        device = ModelDevice(random.Random(seed))
        clock = itertools.count(step=view_ring.PAUSE_SECONDS)
        time = SimpleNamespace(sleep=lambda _: device.run(device.chance.choice((0, 1, 3, 30))), monotonic=lambda: next(clock))
        for module in (ticks, view_ring):
            monkeypatch.setattr(module, "wp", device.wp)
        monkeypatch.setattr(view_ring, "time", time)
        monkeypatch.setattr(ticks, "TickReader", ModelReader)
        monkeypatch.setattr(ticks, "allocate_slots", partial(allocate_slots, device))
        return device

    return make


def allocate_slots(device: ModelDevice, arrays: list[ModelArray], slots: int, *_: object, **__: object) -> list[list[ModelArray]]:
    return [[ModelArray(device) for _ in arrays] for _ in range(slots)]


def test_renderer_and_host_read_whole_ticks_in_order_whatever_the_device_does_first(make_device):
    for seed in range(TRIALS):
        run_trial(make_device(seed))


def run_trial(device: ModelDevice) -> None:
    """Random worlds, lengths of episodes, leads, parts of a tick, batches, and rates of the streams."""
    chance = device.chance
    ends = [chance.randint(1, 30) for _ in range(chance.randint(1, 6))]
    simulation = ModelSimulation(device, ends, chance.choice((0, 3)), chance.choice((1, 2, 5, 66)))
    lead, rendered = chance.choice((0, 1, 2, 7, 50)), []
    with ticks.TickLoop(simulation, lead) as loop:
        for tick in range(max(ends) + 1):
            (number, phases), snapshot = loop.advance()
            assert number == tick
            assert (phases == simulation.phases(tick)).all()
            assert simulation.count <= tick + 1 + lead
            for _ in range(chance.randint(0, 3)):
                for _ in range(chance.choice((0, 5, 50))):
                    device.stream.enqueue(lambda: None)
                device.stream.enqueue(lambda tick=tick, snapshot=snapshot: rendered.append((tick, values(snapshot))))
                loop.enqueue()
                device.run(chance.choice((0, 10, 100)))
    while device.run(1):
        pass
    assert not any(stream.queue for stream in device.streams)
    assert rendered == [(tick, {tick}) for tick, _ in rendered]


def values(snapshot: Snapshot) -> set[int]:
    """Values of all arrays of a snapshot."""
    return {getattr(snapshot, name).value for name in NAMES}


class RefilledSimulation(ModelSimulation):
    """Model whose worlds run episodes of given lengths [ticks], from a list after another."""

    def __init__(self, device: ModelDevice, worlds: int, episodes: list[int], parts: int) -> None:
        super().__init__(device, [0] * worlds, 0, parts)
        self.episodes, self.left, self.ran, self.past = list(episodes), [0] * worlds, 0, []

    def restart(self, episodes: list[int]) -> None:
        assert not self.episodes
        self.episodes = list(episodes)

    def tick_parts(self) -> Iterator[None]:
        for world, left in enumerate(self.left):
            if not left and self.episodes:
                left, self.ran = self.episodes.pop(0), self.ran + 1
            self.left[world] = max(0, left - 1)
            self.past.append(Phase.ACT if left else Phase.IDLE)
        yield from super().tick_parts()

    def phases(self, tick: int) -> np.ndarray:
        worlds = self.layout.worlds
        return np.array(self.past[tick * worlds : (tick + 1) * worlds])


def test_idle_worlds_run_further_lists_whenever_they_come(make_device):
    """Each list comes at a random time after it was asked for, at last when the loop waits; every episode runs once, to its end."""
    for seed in range(TRIALS):
        device = make_device(seed)
        chance = device.chance
        lists = [[chance.randint(1, 8) for _ in range(chance.randint(1, 5))] for _ in range(chance.randint(1, 4))]
        simulation = RefilledSimulation(device, chance.randint(1, 4), lists[0], chance.choice((1, 2, 30)))
        rest, lead, busy = lists[1:], chance.choice((0, 1, 7, 50)), 0

        def more(wait: bool, chance=chance, rest=rest) -> list[int]:
            return rest.pop(0) if rest and (wait or chance.random() < 0.2) else []

        with ticks.TickLoop(simulation, lead, more) as loop:
            for tick in itertools.count():
                (number, phases), _ = loop.advance()
                assert number == tick
                busy += int((phases == Phase.ACT).sum())
                if (phases == Phase.IDLE).all() and not loop.refill():
                    break
        assert not rest
        assert simulation.ran == sum(map(len, lists))
        assert busy == sum(map(sum, lists))


@pytest.mark.parametrize("lead", [1, 5])
def test_while_the_host_waits_for_a_tick_parts_of_the_next_are_enqueued(make_device, lead):
    """Otherwise a GPU would be idle from the end of each tick until the host asks for the next one."""
    device = make_device(0)
    simulation = ModelSimulation(device, [20], 0, 2 * ticks.PARTS_IN_FLIGHT + 3)
    view_ring.time.sleep = lambda _: device.run(1)
    with ticks.TickLoop(simulation, lead) as loop:
        for tick in range(15):
            loop.advance()
            assert simulation.count == tick + 2
            assert len(loop.stream.queue) >= ticks.PARTS_IN_FLIGHT


@pytest.mark.parametrize(("waiting", "max_lead", "safe_lead"), [(3, 1, 512), (0, 10, 512), (0, 200, 512), (0, 200, 60)])
def test_physics_gets_a_share_of_the_device_while_the_renderer_waits_or_the_lead_is_short(
    make_device, monkeypatch, waiting, max_lead, safe_lead
):
    """First physics is the bottleneck: the device executes nothing until the host waits. Then it executes all work between two ticks."""
    monkeypatch.setattr(ticks, "SAFE_LEAD", safe_lead)
    device = make_device(0)
    view_ring.time.sleep = lambda _: device.run(1)
    simulation = ModelSimulation(device, [2000], waiting, 5)
    with ticks.TickLoop(simulation, max_lead) as loop:
        for _ in range(5):
            loop.advance()
            assert loop.reserved_share == ticks.PHYSICS_SHARE
        shares, leads = [], []
        for _ in range(150):
            for _ in range(5):
                while device.run(1):
                    pass
                loop.enqueue()
            loop.advance()
            shares.append(loop.reserved_share)
            leads.append(loop._simulated - loop._taken)
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] == 0.0
    threshold = min(safe_lead, loop.lead // 2)
    assert [share > 0.0 for share in shares] == [lead < threshold for lead in leads]
    assert (shares.count(ticks.PHYSICS_SHARE) > 1) == (loop.lead > 100)


def test_physics_that_has_nothing_left_to_do_gets_no_share(make_device):
    device = make_device(0)
    with ticks.TickLoop(ModelSimulation(device, [3], 0, 2), 10) as loop:
        shares = []
        for _ in range(4):
            loop.advance()
            shares.append(loop.reserved_share)
    assert shares[0] == ticks.PHYSICS_SHARE
    assert shares[-1] == 0.0


@pytest.mark.parametrize(("busy", "is_confined"), [(16, True), (17, False)])
def test_the_solver_is_restricted_to_reserved_multiprocessors_if_few_worlds_are_busy(make_device, busy, is_confined):
    """A GPU with 11 multiprocessors reserves 2, for 8 worlds each; a third of the worlds is idle."""
    device = make_device(0)
    device.sm_count = 11
    view_ring.time.sleep = lambda _: device.run(1)
    simulation = ModelSimulation(device, [50] * busy + [0] * (busy // 2), 0, 2)
    simulation.physics = SimpleNamespace(solver_stream=None)
    with ticks.TickLoop(simulation, 10) as loop:
        loop.confine_solver("reserved")
        assert simulation.physics.solver_stream is None
        for _ in range(3):
            loop.advance()
        loop.confine_solver("reserved")
        assert simulation.physics.solver_stream == ("reserved" if is_confined else None)
        loop.confine_solver(None)
        assert simulation.physics.solver_stream is None
