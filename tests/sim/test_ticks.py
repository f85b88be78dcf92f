"""Tick loop: one tick ahead, in order, and no record is overwritten while a queue still reads it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from synpick_warp.stages import ticks
from synpick_warp.stages.host_copies import HostCopy
from synpick_warp.stages.sim.simulate import RECORDS
from tests.harness.spin import SPINS, spin_kernel

TICKS, WORLDS = 24, 64
PARTS = ticks.PARTS_AHEAD + 6 * ticks.PARTS_PER_BATCH
"""Parts of a tick: more than are enqueued ahead."""


class NumberingSimulation:
    """Fills the record of its n-th tick with n; keeps the order of all that happens in `events`."""

    def __init__(self, device: wp.Device) -> None:
        self.device, self.count, self.events = device, 0, []
        self.records = tuple(SimpleNamespace(snapshot=wp.zeros(WORLDS, dtype=wp.int32, device=device)) for _ in range(RECORDS))

    def tick_parts(self, record: SimpleNamespace) -> Iterator[None]:
        self.count += 1
        number = self.count
        for _ in range(PARTS - 1):
            yield
        self.events.append(f"tick {number}")
        record.snapshot.fill_(number)


class RecordReader(HostCopy):
    """Reads a record of it."""

    def __init__(self, record: SimpleNamespace) -> None:
        super().__init__([record.snapshot])

    def start(self) -> None:
        super().start(None)

    def wait(self) -> np.ndarray:
        return super().wait()[0].copy()


@pytest.fixture
def simulation(device, monkeypatch) -> NumberingSimulation:
    monkeypatch.setattr(ticks, "TickReader", RecordReader)
    return NumberingSimulation(device)


@pytest.mark.parametrize("batches", [0, 1, 5, 100])
def test_ticks_come_in_order_one_ahead(simulation, batches):
    """A tick has begun when the one before is reported; it is enqueued between the batches of that one, and what is left at their end."""
    with ticks.TickLoop(simulation) as loop:
        assert simulation.events == []
        for tick in range(1, TICKS):
            report, snapshot = loop.advance()
            assert set(report.tolist()) == {tick}
            assert simulation.count == tick + 1
            simulation.events.append(f"report {tick}")
            assert snapshot is simulation.records[(tick - 1) % RECORDS].snapshot
            for _ in range(batches):
                loop.enqueue(ticks.PARTS_PER_BATCH)
    is_early = ticks.PARTS_AHEAD + batches * ticks.PARTS_PER_BATCH >= PARTS
    expected = [f"{what} {tick}" for tick in range(1, TICKS) for what in ("tick", "report")]
    assert simulation.events == expected + is_early * [f"tick {TICKS}"]


def test_a_slow_renderer_reads_each_record_whole(simulation):
    """The host never waits for the rendering: physics' stream must."""
    device = simulation.device
    busy = wp.zeros(1, dtype=float, device=device)
    wp.launch(spin_kernel, dim=1, inputs=[busy, 1], device=device)  # Loads it.
    pictures = [wp.zeros(WORLDS, dtype=wp.int32, device=device) for _ in range(TICKS)]
    with ticks.TickLoop(simulation) as loop:
        for picture in pictures:
            _, snapshot = loop.advance()
            wp.launch(spin_kernel, dim=1, inputs=[busy, SPINS], device=device)
            wp.copy(picture, snapshot)
    assert [sorted(set(picture.numpy().tolist())) for picture in pictures] == [[tick] for tick in range(1, TICKS + 1)]


def test_the_last_tick_is_awaited_whatever_ends_the_loop(simulation, monkeypatch):
    awaited = []
    monkeypatch.setattr(wp, "synchronize_stream", awaited.append)
    loop = ticks.TickLoop(simulation)
    with contextlib.suppress(ZeroDivisionError), loop:
        loop.advance()
        raise ZeroDivisionError
    assert awaited == ([loop.stream] if simulation.device.is_cuda else [])
