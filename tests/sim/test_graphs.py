"""Graphs of the physics: ticks that replay them are the same, bit by bit, as ticks whose kernels are launched one by one."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from synpick_warp.scenes import build
from synpick_warp.stages.sim import physics as physics_module
from synpick_warp.system.green_contexts import SmPartition
from tests.worlds.cubes import place_cubes
from tests.worlds.small_worlds import settings

WORLDS, TICKS = 8, 5


def fall(
    device: wp.Device, replays: bool, steps: int, substeps: int, solver_streams: Sequence[wp.Stream | None] = (None,)
) -> list[np.ndarray]:
    """Joint coordinates after each tick of cubes that fall beside the gripper onto the floor, a different one in each world.

    Ticks take turns with the solver streams.
    """
    config = settings(
        bake__worlds=WORLDS,
        arrangement__max_objects=1,
        physics__steps_per_tick=steps,
        physics__substeps=substeps,
        physics__guide_height=0.2,
        physics__deterministic=True,
    )
    turn = np.array([0.3, 0.2, -0.1, 0.927])
    pose = np.tile((0.1, -0.05, 0.06, *turn / np.linalg.norm(turn)), (WORLDS, 1))
    pose[:, 0] += np.linspace(0.0, 0.01, WORLDS)
    physics = place_cubes(config, device, pose)
    found = []
    for tick in range(TICKS):
        physics.solver_stream = solver_streams[tick % len(solver_streams)]
        if not replays:
            physics.clear_graphs()
            physics._period = lambda watcher: steps * substeps  # type: ignore[method-assign]
        physics.tick(lambda current: None)
        assert physics._graphs or not replays
        found.append(physics.state.joint_q.numpy().copy())
    return found


@pytest.mark.parametrize(("steps", "substeps"), [(12, 1), (12, 2), (12, 3), (9, 1)])
def test_replayed_ticks_are_those_of_single_launches(device, steps, substeps):
    replayed, launched = fall(device, True, steps, substeps), fall(device, False, steps, substeps)
    np.testing.assert_array_equal(replayed, launched)
    heights = np.array(launched).reshape(TICKS, WORLDS, -1)[:, :, build.GRIPPER_DOFS + 2]
    assert (np.diff(heights[:2], axis=0) < 0.0).all()
    assert heights[-1].min() > 0.02


def test_on_a_cpu_nothing_is_captured_while_another_thread_may_launch_kernels(monkeypatch):
    def capture(*_: object) -> list[wp.Graph]:
        raise AssertionError("captured")

    monkeypatch.setattr(physics_module, "is_only_launcher", lambda: False)
    monkeypatch.setattr(physics_module.Physics, "_capture", capture)
    cpu = wp.get_device("cpu")
    launched = fall(cpu, False, 12, 2)
    monkeypatch.undo()
    np.testing.assert_array_equal(fall(cpu, True, 12, 2), launched)


@pytest.mark.parametrize("period", [1, 2])
def test_a_solver_on_few_multiprocessors_takes_the_same_steps(device, period):
    """Its stream changes after each tick, or is that of the reserved multiprocessors from the first one on."""
    if not device.is_cuda:
        pytest.skip("a CPU has no multiprocessors")
    stream = SmPartition(device, 8).make_stream(on_reserved=True)
    confined = fall(device, True, 12, 2, (None, stream)[-period:])
    np.testing.assert_array_equal(confined, fall(device, True, 12, 2))


def test_each_solver_stream_is_captured_once_and_only_the_first_period_is_eager(monkeypatch):
    """Two ticks of 4 substeps on the current stream, two on another, one more on the first; then graphs are dropped."""
    physics = place_cubes(settings(physics__steps_per_tick=4, physics__substeps=1), wp.get_device("cpu"), np.eye(7)[[6]])
    calls: list[object] = []
    monkeypatch.setattr(physics, "device", SimpleNamespace(is_cuda=True))
    monkeypatch.setattr(physics, "_run_substeps", lambda *hooks: (calls.append(("run", *hooks[3:])) for _ in range(4)))
    monkeypatch.setattr(physics, "_capture", lambda substeps: calls.append(("capture", len(list(substeps)))) or [f"graph{len(calls)}"] * 4)
    monkeypatch.setattr(wp, "capture_launch", calls.append)

    def tick(stream: str | None) -> list[object]:
        calls.clear()
        physics.solver_stream = stream  # type: ignore[assignment]
        assert len(list(physics.tick_parts(lambda current: None))) == 4
        return calls.copy()

    run, capture = [("run",)] * 2, [("run", None)] * 2 + [("capture", 2)]
    assert tick(None) == [*run, *capture, "graph5", "graph5"]
    assert tick(None) == ["graph5"] * 4
    assert tick("reserved") == [("run", "reserved")] * 2 + [("capture", 2)] + ["graph3"] * 4
    assert tick("reserved") == ["graph3"] * 4
    assert tick(None) == ["graph5"] * 4
    physics.clear_graphs()
    assert tick(None)[:2] == run
