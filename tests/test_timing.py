"""The scoped profiler: what it counts, what it writes, and that it is off by default."""

from __future__ import annotations

import json
import time

import pytest
import warp as wp

from synpick_warp.stages import timing


def test_a_scope_without_recorder_is_one_shared_object():
    assert timing.scope("a") is timing.scope("b")
    with timing.scope("a"):
        pass


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
    assert timing.scope("a") is timing.scope("b")


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
