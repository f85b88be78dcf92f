"""Tests of graph capture in physics: replaying captured graphs gives bitwise the same ticks as launching each kernel."""

from __future__ import annotations

import ctypes
from collections import defaultdict
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
from warp._src.apic.capture import APICapture

from synpick_warp.codes import Task
from synpick_warp.scenes import build
from synpick_warp.stages.sim import physics as physics_module
from synpick_warp.stages.sim.step_log import record_arrays
from synpick_warp.system.hardware.green_contexts import SmPartition
from tests.worlds.sights import SHORT, picking
from tests.worlds.small_worlds import BOX, COARSE, CUBE, catalog, place_cubes, report, settings

WORLDS, TICKS = 8, 5
MAX_TICKS = 60


@pytest.fixture(autouse=True)
def only_launcher(monkeypatch):
    """Exclude threads left over from other tests, which launch no kernels, from the check for other launchers."""
    monkeypatch.setattr(physics_module, "is_only_launcher", lambda: True)


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
@pytest.mark.slow
def test_replayed_ticks_are_those_of_single_launches(device, steps, substeps):
    replayed, launched = fall(device, True, steps, substeps), fall(device, False, steps, substeps)
    np.testing.assert_array_equal(replayed, launched)
    heights = np.array(launched).reshape(TICKS, WORLDS, -1)[:, :, build.GRIPPER_DOFS + 2]
    assert (np.diff(heights[:2], axis=0) < 0.0).all()
    assert heights[-1].min() > 0.02


def test_on_a_cpu_nothing_is_captured_while_another_thread_may_launch_kernels(monkeypatch):
    def capture(*_: object) -> list[wp.Graph]:
        raise AssertionError("captured")

    cpu = wp.get_device("cpu")
    with monkeypatch.context() as patch:
        patch.setattr(physics_module, "is_only_launcher", lambda: False)
        patch.setattr(physics_module.Physics, "_capture", capture)
        launched = fall(cpu, False, 12, 2)
    np.testing.assert_array_equal(fall(cpu, True, 12, 2), launched)


@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.slow
def test_episodes_captured_from_a_later_tick_on_are_those_of_single_launches(monkeypatch, recorded):
    """Compare eager and replayed ticks on the CPU in two worlds of mode pick, until objects are lifted.

    Between ticks objects are loaded, grasps planned and yaws set; within ticks seals attach objects.

    Within a graph, Warp finds a CPU kernel by module and key: kernels of one key with different functions would replace each other.
    """
    cpu, functions = wp.get_device("cpu"), defaultdict(set)
    build_launch_info = APICapture.build_launch_info

    def spy(self: APICapture, kernel: wp.Kernel, module_exec: Any, hooks: Any, *arguments: Any, **options: Any) -> Any:
        functions[kernel.key, module_exec.module_hash].add(ctypes.cast(hooks.forward, ctypes.c_void_p).value)
        return build_launch_info(self, kernel, module_exec, hooks, *arguments, **options)

    monkeypatch.setattr(APICapture, "build_launch_info", spy)

    def run(first: int) -> tuple[list[dict[str, np.ndarray]], bool]:
        """Reports, body states and step records, with graphs from tick `first` on, and whether any was captured."""
        config = settings(bake__worlds=2, bake__episodes=2, arrangement__max_objects=2, **COARSE, **SHORT)
        simulation = picking(config, catalog(BOX, CUBE), cpu, records_physics=recorded)
        found, tasks = [], set()
        for tick in range(MAX_TICKS):
            monkeypatch.setattr(physics_module, "is_only_launcher", lambda tick=tick: tick >= first)
            simulation.tick()
            row = report(simulation.record)
            state = simulation.physics.state
            arrays = {"status": row.status, "measures": row.measures, "body_q": state.body_q.numpy(), "body_qd": state.body_qd.numpy()}
            steps = record_arrays(simulation.record.physics) if recorded else []
            arrays |= {f"step record {index}": array.numpy() for index, array in enumerate(steps)}
            found.append({name: values.copy() for name, values in arrays.items()})
            tasks.update(row.column("task").tolist())
        assert {Task.LOOK, Task.PRESS, Task.LIFT} <= tasks
        return found, bool(simulation.physics._graphs)

    launched, captured = run(MAX_TICKS)
    assert not captured
    replayed, captured = run(3)
    assert captured
    assert len(functions) > 50
    assert {len(each) for each in functions.values()} == {1}
    for one, other in zip(launched, replayed, strict=True):
        for name, values in one.items():
            np.testing.assert_array_equal(other[name], values, err_msg=name)


@pytest.mark.parametrize("streams", [1, 2])
def test_a_solver_on_few_multiprocessors_takes_the_same_steps(device, streams):
    """All ticks request the stream of the reserved multiprocessors, or every second one does."""
    if not device.is_cuda:
        pytest.skip("a CPU has no multiprocessors")
    stream = SmPartition(device, 8).make_stream(on_reserved=True)
    confined = fall(device, True, 12, 2, (None, stream)[-streams:])
    np.testing.assert_array_equal(confined, fall(device, True, 12, 2))


def test_each_solver_stream_is_captured_once_and_only_the_first_period_is_eager(monkeypatch):
    """Two ticks of 4 substeps on the current stream, two on another, one more on the first; then graphs are dropped."""
    physics = place_cubes(settings(physics__steps_per_tick=2, physics__substeps=2), wp.get_device("cpu"), np.eye(7)[[6]])
    calls: list[object] = []
    monkeypatch.setattr(physics, "device", SimpleNamespace(is_cuda=True))
    monkeypatch.setattr(physics, "_run_substeps", lambda *hooks: (calls.append(("run", *hooks[3:])) for _ in range(4)))
    monkeypatch.setattr(physics, "_capture", lambda substeps: calls.append(("capture", len(list(substeps)))) or [f"graph{len(calls)}"] * 2)
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
