"""CUDA streams of renderer, encoders and solver: caching, synchronization at a switch, fallback without partitions; the scoped profiler."""

import json
import random
import time
from functools import partial
from typing import ClassVar

import pytest
import warp as wp

from synpick_warp.errors import DeviceError
from synpick_warp.stages import render_streams, timing
from synpick_warp.stages.render_streams import RenderStreams
from synpick_warp.stages.sim.physics import Physics
from tests.builders import bake_boxes
from tests.harness.cuda_model import ModelDevice, ModelStream
from tests.test_bake import TINY


class Partition:
    """Fake SM partition; records the numbers of reserved multiprocessors."""

    reserved: ClassVar[list[int]] = []

    def __init__(self, device: ModelDevice, reserved: int) -> None:
        self.device = device
        self.reserved.append(reserved)

    def make_stream(self, on_reserved: bool = False, priority: int = 0) -> ModelStream:
        return ModelStream(self.device)


class NoStreams(Partition):
    """Fake SM partition of a driver without streams on green contexts."""

    def make_stream(self, on_reserved: bool = False, priority: int = 0) -> ModelStream:
        raise DeviceError("no streams")


@pytest.fixture
def make_streams(monkeypatch):
    """Factory of `RenderStreams` on a fake GPU with 132 multiprocessors and a given class of partitions."""

    def make(kind: type[Partition], seed: int = 0) -> tuple[RenderStreams, ModelDevice]:
        device = ModelDevice(random.Random(seed))
        device.sm_count = 132  # type: ignore[attr-defined]
        monkeypatch.setattr(render_streams, "wp", device.wp)
        monkeypatch.setattr(render_streams, "SmPartition", kind)
        monkeypatch.setattr(Partition, "reserved", [])
        return RenderStreams(device), device  # type: ignore[arg-type]

    return make


def test_each_share_has_streams_that_are_made_once(make_streams):
    streams, _ = make_streams(Partition)
    whole = streams.render, streams.copy, streams.solver
    assert whole[0] is whole[2] is None
    found = []
    for reserved in (2 / 11, 2 / 33, 2 / 11, 0.0, 0.0, 2 / 33):
        streams.confine(reserved)
        found.append((streams.render, streams.copy, streams.solver))
    assert found[0] == found[2]
    assert found[1] == found[5]
    assert found[3] == found[4] == whole
    assert len({id(stream) for each in (found[0], found[1]) for stream in each} | {id(whole[1])}) == 7
    assert Partition.reserved == [24, 8]


def test_only_the_stream_of_the_solver_is_on_the_reserved_multiprocessors(make_streams, monkeypatch):
    made: list[tuple[ModelStream, bool, int]] = []

    def make_stream(partition: Partition, on_reserved: bool = False, priority: int = 0) -> ModelStream:
        made.append((ModelStream(partition.device), on_reserved, priority))
        return made[-1][0]

    monkeypatch.setattr(Partition, "make_stream", make_stream)
    streams, _ = make_streams(Partition)
    streams.confine(0.2)
    assert made == [(streams.render, False, 0), (streams.copy, False, 0), (streams.solver, True, render_streams.HIGH_PRIORITY)]


def test_the_encoders_of_a_batch_wait_for_those_of_the_batch_before(make_streams):
    """Batches that share scratch arrays are encoded one after the other, in whichever order the device executes its streams."""
    for seed in range(50):
        streams, device = make_streams(Partition, seed)
        order = []
        for batch, reserved in enumerate((0.0, 0.2, 0.2, 0.1, 0.0, 0.2, 0.0)):
            streams.confine(reserved)
            for step in ("begin", "end"):
                streams.copy.enqueue(partial(order.append, (batch, step)))
            device.run(device.chance.choice((0, 1, 3)))
        while device.run(1):
            pass
        assert order == [(batch, step) for batch in range(7) for step in ("begin", "end")]


def test_a_gpu_that_cannot_be_divided_is_used_as_a_whole(make_streams):
    streams, _ = make_streams(NoStreams)
    whole = streams.copy
    for reserved in (0.2, 0.0, 0.2):
        streams.confine(reserved)
        assert streams.render is None
        assert streams.copy is whole
        assert streams.solver is None
    assert Partition.reserved == [26]


def test_the_exit_waits_for_both_streams_whatever_ends_the_loop(make_streams, monkeypatch):
    streams, _ = make_streams(Partition)
    awaited = []
    monkeypatch.setattr(render_streams.wp, "synchronize_stream", awaited.append, raising=False)
    streams.confine(0.2)
    with pytest.raises(ZeroDivisionError), streams:
        raise ZeroDivisionError
    assert awaited == [streams.render, streams.copy]


def test_the_solver_runs_on_the_reserved_multiprocessors_while_there_are_views(tmp_path, monkeypatch):
    """On a CPU: `confine` is replaced to provide a marker as stream, which is removed before physics sees it."""
    monkeypatch.setattr(RenderStreams, "confine", lambda self, share: setattr(self, "solver", "reserved"))
    tick_parts, given = Physics.tick_parts, []

    def spy(self, *arguments):
        given.append(self.solver_stream)
        self.solver_stream = None
        return tick_parts(self, *arguments)

    monkeypatch.setattr(Physics, "tick_parts", spy)
    summary = bake_boxes(tmp_path / "out", TINY | {"bake.worlds": 1, "bake.episodes": 1, "bake.device": "cpu"})
    frames = summary.views // 3
    assert len(given) > frames
    first = given.index("reserved")
    assert first > 1
    assert given == [None] * first + ["reserved"] * (len(given) - first)
    assert frames - 1 <= len(given) - first <= frames


# ---- the scoped profiler ----


def test_scopes_are_counted_by_their_path():
    with timing.record() as recorder:
        for _ in range(3):
            with timing.scope("tick"):
                with timing.scope("render"):
                    time.sleep(0.002)
                with timing.scope("write"):
                    pass
        with timing.scope("render"):
            pass
    calls = {path: stage.calls for path, stage in recorder.times.items()}
    assert calls == {("tick",): 3, ("tick", "render"): 3, ("tick", "write"): 3, ("render",): 1}
    times = {path: stage.host for path, stage in recorder.times.items()}
    assert recorder.wall >= times["tick",] >= times["tick", "render"] + times["tick", "write"]
    assert times["tick", "render"] >= 3 * 0.002


def test_a_scope_that_raises_is_counted_and_left():
    with timing.record() as recorder:
        with pytest.raises(ValueError, match="no"), timing.scope("outer"), timing.scope("inner"):
            raise ValueError("no")
        with timing.scope("after"):
            pass
    assert list(recorder.times) == [("outer",), ("outer", "inner"), ("after",)]
    assert timing.scope("a") is timing.scope("b"), "without a recorder a scope is one shared object"
    with timing.scope("a"):
        pass
    assert len(recorder.times) == 3


def test_recorders_do_not_nest():
    with timing.record(), pytest.raises(RuntimeError, match="already"), timing.record():
        pass
    with timing.record():
        pass


def test_the_trace_has_every_scope_in_time(tmp_path):
    with timing.record() as recorder, timing.scope("outer"), timing.scope("inner"):
        time.sleep(0.001)
    recorder.write_trace(tmp_path / "profile.json")
    events = [event for event in json.loads((tmp_path / "profile.json").read_text())["traceEvents"] if event["ph"] == "X"]
    inner, outer = events
    assert (inner["name"], outer["name"]) == ("inner", "outer")
    assert outer["ts"] <= inner["ts"]
    assert inner["ts"] + inner["dur"] <= outer["ts"] + outer["dur"]
    assert inner["dur"] >= 1000


def test_a_long_trace_is_cut_but_counted(monkeypatch, tmp_path):
    monkeypatch.setattr(timing, "MAX_SPANS", 2)
    with timing.record() as recorder:
        for _ in range(5):
            with timing.scope("a"):
                pass
    recorder.write_trace(tmp_path / "profile.json")
    assert recorder.times["a",].calls == 5
    assert (tmp_path / "profile.json").read_text().count('"ph": "X"') == 2


def test_device_time_is_measured_on_a_gpu(device, monkeypatch):
    monkeypatch.setattr(timing, "MAX_PENDING", 4)
    array = wp.zeros(1 << 20, dtype=float, device=device)
    with timing.record() as recorder:
        for _ in range(10):
            with timing.scope("fill", device):
                array.fill_(1.0)
    stage = recorder.times["fill",]
    assert stage.calls == 10
    assert (stage.device > 0.0) == device.is_cuda
