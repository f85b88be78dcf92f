"""Whole worlds: what physics must hold, and how episodes end; captured graphs give bitwise the ticks of single launches. That an episode
is the same in any world: `test_trajectory_bake`."""

import ctypes
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
from warp._src.apic.capture import APICapture

from synpick_warp.codes import Ending, Phase, Task
from synpick_warp.scenes import build
from synpick_warp.stages.constants import GRIPPER_HOME
from synpick_warp.stages.sim import arrange
from synpick_warp.stages.sim import physics as physics_module
from synpick_warp.stages.sim.physics import VELOCITY_LIMIT_FRACTION, with_enough_worlds
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.step_log import record_arrays
from synpick_warp.system.hardware.device import SmPartition
from tests.twins.raycast import rotation_of
from tests.worlds.hanging import COARSE as STEPWISE
from tests.worlds.small_worlds import ANGLE, BOX, COARSE, CUBE, SHORT, catalog, picking, place_cubes, report, run_ticks, settings

LONGEST = 150


# ---- what a tick leaves ----


@pytest.fixture(scope="module")
def resting(device):
    """Four piles with the solver's own settings: reports, and energies while they settle (tick, world)."""
    config = settings(bake__worlds=4, bake__episodes=4, settle__rest_ticks=3, settle__relax_time=3.0)
    simulation = Simulation(config, catalog(), 1, device)
    reports, energies = [], []
    for _ in range(LONGEST):
        reports += run_ticks(simulation, 1)
        energies.append(np.where(reports[-1].column("phase") == Phase.SETTLE, energy(simulation, reports[-1]), np.nan))
        if (reports[-1].column("phase") != Phase.SETTLE).all():
            break
    return config, reports, np.array(energies)


def energy(simulation: Simulation, seen) -> np.ndarray:
    """Kinetic and potential energy of each world's objects [J]; velocities are those of the centres of mass."""
    model, layout = simulation.physics.model, simulation.layout
    mass, center, inertia = model.body_mass.numpy(), model.body_com.numpy(), model.body_inertia.numpy()
    velocity, pose = simulation.physics.state.body_qd.numpy().astype(float), simulation.physics.state.body_q.numpy().astype(float)
    slot, total = simulation.state.body_slot.numpy(), np.zeros(layout.worlds)
    for world, instance in zip(*np.nonzero(seen.catalog_index >= 0), strict=True):
        body = world * layout.bodies_per_world + build.GRIPPER_BODIES + slot[world, instance]
        turn = rotation_of(pose[body, 3:])
        height = (turn @ center[body] + pose[body, :3])[2]
        spin = turn.T @ velocity[body, 3:]
        total[world] += mass[body] * (simulation.config.physics.gravity * height + 0.5 * velocity[body, :3] @ velocity[body, :3])
        total[world] += 0.5 * spin @ inertia[body] @ spin
    return total


def test_something_lies_on_the_floor_in_every_world_and_nothing_below(resting):
    _, reports, _ = resting
    assert (reports[-1].column("phase") == Phase.ACT).any()
    assert not reports[-1].column("ending").any()
    objects = catalog().entries
    for world in range(4):
        last = [report for report in reports if report.column("phase")[world] == Phase.SETTLE][-1]
        there = zip(last.catalog_index[world], last.pose[world].astype(float), strict=True)
        low = [(objects[entry].mesh.vertices @ rotation_of(pose[3:])[2] + pose[2]).min() for entry, pose in there if entry >= 0]
        assert min(low) == pytest.approx(0.0, abs=1e-3)
        assert max(low) < 0.15


def test_energy_never_grows(resting):
    """From the drop to rest, by no more than what pushing bodies apart gives: a lift of 1 mm."""
    config, _, energies = resting
    heaviest = config.arrangement.max_objects * max(entry.mass for entry in catalog().entries)
    assert np.nanmax(np.diff(energies, axis=0)) < 1e-3 * heaviest * config.physics.gravity
    for world in energies.T:
        settling = world[np.isfinite(world)]
        assert settling[-1] < 0.5 * settling[0]


def test_the_gripper_waits_outside_and_then_stands_above_the_first_corner(device):
    config = settings(arrangement__max_objects=1, **COARSE)
    simulation, seen = Simulation(config, catalog(CUBE), 1, device), []
    while not seen or seen[-1].column("phase")[0] != Phase.IDLE:
        seen += run_ticks(simulation, 1)
        assert len(seen) < LONGEST
    live, frames, endings = (np.array([row.column(name)[0] for row in seen]) for name in ("live", "frame", "ending"))
    first, count = int(live.argmax()), int(live.sum())
    assert live.tolist() == [0] * first + [1] * count + [0] * (len(live) - first - count)
    assert frames[first : first + count].tolist() == list(range(count))
    assert endings[first + count - 2 : first + count].tolist() == [Ending.RUNNING, Ending.FINISHED]
    fixtures = np.array([row.snapshot.fixture_pose[0, 1:, :3] for row in seen])
    assert (fixtures[:first, 0, 0] > 1.0).all()
    corner = config.move.corner * np.array(config.tote.floor_size) / 2
    np.testing.assert_allclose(np.abs(fixtures[first, :, :2]), np.tile(corner, (2, 1)), atol=1e-4)
    assert fixtures[first, 0, 2] == pytest.approx(config.move.start_height + config.gripper.cup_length, abs=1e-4)
    assert (seen[-1].catalog_index == -1).all()


# ---- known answers ----


def placed(simulation: Simulation, world: int, entry: int, place, speed=(0, 0, 0, 0, 0, 0)) -> None:
    """Give a world one object, at a pose and speed, in its first slot; the gripper is at home."""
    state, layout, physics = simulation.state, simulation.layout, simulation.physics
    variant, entries = np.full(layout.worlds * layout.bodies_per_world, -1, np.int32), state.catalog_index.numpy()
    variant[world * layout.bodies_per_world + build.GRIPPER_BODIES] = simulation.scene.catalog.variant.numpy()[entry]
    entries[world] = [entry] + [-1] * (layout.instances - 1)
    q, qd = physics.state.joint_q.numpy(), physics.state.joint_qd.numpy()
    first, first_d = (world * size + build.GRIPPER_DOFS for size in (layout.coords_per_world, layout.dofs_per_world))
    q[first : first + 7], qd[first_d : first_d + 6] = place, speed
    q[first - build.GRIPPER_DOFS : first - 1] = GRIPPER_HOME
    arrays = (state.variant, state.catalog_index, state.restarted, physics.state.joint_q, physics.state.joint_qd)
    for array, values in zip(arrays, (variant, entries, np.arange(layout.worlds + 1) == world, q, qd), strict=True):
        array.assign(values)
    physics.load(state.variant, state.restarted)


@pytest.fixture(scope="module")
def bench(device):
    """Two worlds with a box each for experiments; the solver's own settings."""
    return Simulation(settings(bake__worlds=2, arrangement__max_objects=1), catalog(BOX), 1, device)


def test_an_object_moves_as_in_a_new_world_whatever_its_slot_had_before(device):
    """Newton's bound of a body, which limits its patches of friction, counts shapes that an object of fewer pieces leaves unused."""
    kinds = ANGLE, (*ANGLE, (0.05, 0.05, 0.05)), (*ANGLE, (0.09, 0.09, 0.09))
    simulation = Simulation(settings(bake__worlds=2, arrangement__max_objects=1), catalog(*kinds), 1, device)
    for world, entry in ((0, 2), (0, 0), (1, 0)):
        placed(simulation, world, entry, [0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 1.0])
    used, new = simulation.physics.solver._friction_patches.body_radius.numpy().reshape(2, -1)[:, build.GRIPPER_BODIES]
    assert used == new


def advance(simulation: Simulation, ticks: int) -> np.ndarray:
    """Poses (world, 7) of the first slots after a number of ticks of physics alone; a view of the state."""
    for _ in range(ticks):
        simulation.physics.tick(simulation._drive)
    return simulation.physics.state.body_q.numpy().reshape(simulation.layout.worlds, -1, 7)[:, build.GRIPPER_BODIES]


def test_a_box_comes_to_rest_flat_on_the_floor(bench):
    """From a tilt about x and from one about y: on the nearest face, half the box's size above the floor."""
    tilt, upright = np.radians(8) / 2, np.pi / 4
    placed(bench, 0, 0, [0.0, 0.0, 0.05, np.sin(tilt), 0.0, 0.0, np.cos(tilt)])
    placed(bench, 1, 0, [0.05, 0.02, 0.05, 0.0, np.sin(upright + tilt), 0.0, np.cos(upright + tilt)])
    poses = advance(bench, 15).copy()
    for pose, axis in zip(poses, (2, 0), strict=True):
        assert pose[2] == pytest.approx(BOX[0][axis] / 2, abs=5e-4)
        up = rotation_of(pose[3:].astype(float))[2]
        assert abs(up[axis]) == pytest.approx(1.0, abs=1e-4)
    after = advance(bench, 3)
    assert np.abs(after - poses).max() < 2e-4


def test_depth_is_how_far_a_box_sinks_into_the_floor(bench):
    placed(bench, 0, 0, [0.0, 0.0, BOX[0][2] / 2 - 3e-3, 0.0, 0.0, 0.0, 1.0])
    placed(bench, 1, 0, [0.0, 0.0, BOX[0][2] / 2 + 1e-3, 0.0, 0.0, 0.0, 1.0])
    bench.physics.pipeline.collide(bench.physics.state, bench.physics.contacts)
    arrange.measure_penetration(bench.state, bench.physics)
    depth = bench.state.penetration.numpy().reshape(2, -1)[:, build.GRIPPER_BODIES]
    np.testing.assert_allclose(depth, [3e-3, 0.0], atol=5e-5)


def test_guide_walls_stop_what_flies_while_they_stand(bench):
    """One world has its guides, the other not; both boxes fly sideways above the rim."""
    bench.state.progress.assign(np.array([[0, 0, 0, 1], [0, 0, 0, 0]], np.int32))
    arrange.place_bins(bench.scene, bench.state, bench.physics)
    for world in range(2):
        placed(bench, world, 0, [0.0, 0.0, 0.45, 0.0, 0.0, 0.0, 1.0], speed=(3.0, 0, 0, 0, 0, 0))
    poses = advance(bench, 3)
    rim = bench.config.tote.rim_size[0] / 2
    assert poses[0, 0] < rim
    assert poses[1, 0] > rim


LIMIT = 4.0
# Velocities at the start [m/s]: without rows, with idle rows, beyond the limit in one axis and in two.
VELOCITIES = np.array([[1.0, 0.5, -0.7], [0.0, 3.0, 0.0], [9.0, 0.0, 1.0], [0.0, -7.0, 6.0]])


def test_speeds_along_each_axis_are_limited_in_the_first_step_and_others_are_kept(device):
    """Cubes thrown without gravity far above the tote; slow ones have no constraint rows for it."""
    assert np.abs(VELOCITIES[0]).max() < VELOCITY_LIMIT_FRACTION * LIMIT < np.abs(VELOCITIES[1]).max() < LIMIT
    worlds, first = len(VELOCITIES), build.GRIPPER_DOFS
    room = {"arrangement__max_objects": 1, "physics__guide_height": 0.2}
    config = settings(bake__worlds=worlds, physics__gravity=0.0, physics__max_speed=LIMIT, **room, **STEPWISE)
    physics = place_cubes(config, device, np.tile((0.1, -0.2, 3.0, 0.0, 0.0, 0.0, 1.0), (worlds, 1)), VELOCITIES)
    for _ in range(2):
        physics.tick(lambda current: None)
        found = physics.state.joint_qd.numpy().reshape(worlds, -1)[:, first : first + 3]
        np.testing.assert_allclose(found, np.clip(VELOCITIES, -LIMIT, LIMIT), atol=1e-3)


# ---- ends ----


@pytest.mark.parametrize(
    ("key", "room", "ending"),
    [
        ("physics__contacts_per_world", 16, Ending.CONTACT_OVERFLOW),
        ("physics__pairs_per_world", 16, Ending.PAIR_OVERFLOW),
        ("physics__rows_per_world", 48, Ending.SOLVER_OVERFLOW),
    ],
)
def test_too_little_room_for_contacts_ends_episodes(device, key, room, ending):
    """Contacts, pairs or rows that find no room are never lost in silence."""
    config = settings(arrangement__max_objects=12, arrangement__volume=3e-3, settle__tries=1, **COARSE | {key: room})
    simulation = Simulation(config, catalog(BOX, CUBE), 1, device)
    endings = [int(row.column("ending")[0]) for row in run_ticks(simulation, 20)]
    assert ending in endings


@pytest.mark.parametrize(("cuda", "asked", "made"), [(True, 1, 8), (True, 7, 8), (True, 8, 8), (True, 64, 64), (False, 1, 1)])
def test_a_gpu_gets_worlds_enough_that_their_number_does_not_matter(cuda, asked, made):
    config = with_enough_worlds(settings(bake__worlds=asked), SimpleNamespace(is_cuda=cuda))  # pyright: ignore[reportArgumentType]
    assert config.bake.worlds == made
    assert replace(config, bake=replace(config.bake, worlds=asked)) == settings(bake__worlds=asked)


# ---- graph capture ----

CUBES, TICKS = 4, 5
MAX_TICKS = 24
"""Ticks in which one object is picked: both worlds lift it from tick 13 on."""


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
        bake__worlds=CUBES,
        arrangement__max_objects=1,
        physics__steps_per_tick=steps,
        physics__substeps=substeps,
        physics__guide_height=0.2,
        physics__deterministic=True,
    )
    turn = np.array([0.3, 0.2, -0.1, 0.927])
    pose = np.tile((0.1, -0.05, 0.06, *turn / np.linalg.norm(turn)), (CUBES, 1))
    pose[:, 0] += np.linspace(0.0, 0.01, CUBES)
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


@pytest.mark.parametrize(("steps", "substeps"), [(12, 1), (12, 3), (9, 1)])
@pytest.mark.slow
def test_replayed_ticks_are_those_of_single_launches(device, steps, substeps):
    replayed, launched = fall(device, True, steps, substeps), fall(device, False, steps, substeps)
    np.testing.assert_array_equal(replayed, launched)
    heights = np.array(launched).reshape(TICKS, CUBES, -1)[:, :, build.GRIPPER_DOFS + 2]
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


@pytest.mark.slow
def test_episodes_captured_from_a_later_tick_on_are_those_of_single_launches(monkeypatch):
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
        simulation = picking(config, catalog(BOX, CUBE), cpu, records_physics=True)
        found, tasks = [], set()
        for tick in range(MAX_TICKS):
            monkeypatch.setattr(physics_module, "is_only_launcher", lambda tick=tick: tick >= first)
            simulation.tick()
            row = report(simulation.record)
            state = simulation.physics.state
            arrays = {"status": row.status, "measures": row.measures, "body_q": state.body_q.numpy(), "body_qd": state.body_qd.numpy()}
            steps = record_arrays(simulation.record.physics)
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
