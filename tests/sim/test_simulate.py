"""Whole worlds: the same episode everywhere and always, what physics must hold, and how episodes end."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from synpick_warp.codes import Ending, Phase
from synpick_warp.scenes import build
from synpick_warp.stages.constants import GRIPPER_HOME
from synpick_warp.stages.sim import arrange
from synpick_warp.stages.sim.physics import with_enough_worlds
from synpick_warp.stages.sim.simulate import Simulation
from tests.twins.raycast import rotation_of
from tests.worlds.small_worlds import ANGLE, BOX, COARSE, CUBE, catalog, report, run_ticks, settings

EPISODES = 3
LIGHTS = 3
# Coarse, where only sameness or ends count.
LONGEST = 150


def track(device, worlds: int, disturb=None, episodes: int = EPISODES) -> dict[tuple[int, int], list[bytes]]:
    """Results of every tick by (episode, arrangement) in a number of worlds; `disturb(simulation, tick)` runs before each tick."""
    config = settings(bake__worlds=worlds, bake__episodes=episodes, **COARSE)
    simulation = Simulation(config, catalog(), LIGHTS, device)
    ticks = defaultdict(list)
    for tick in range(LONGEST):
        if disturb:
            disturb(simulation, tick)
        simulation.tick()
        seen, snapshot = report(simulation.record), simulation.record.snapshot
        fixtures, light, turn = snapshot.fixture_pose.numpy(), snapshot.light.numpy(), snapshot.light_yaw.numpy()
        exposure = snapshot.light_exposure.numpy()
        for world in range(worlds):
            address = (int(seen.column("episode")[world]), int(seen.column("arrangement")[world]))
            full = seen.catalog_index[world] >= 0
            parts = (
                seen.status[world],
                seen.catalog_index[world],
                seen.pose[world][full],
                fixtures[world],
                light[world],
                turn[world],
                exposure[world],
            )
            ticks[address].append(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))
        if (seen.column("phase") == Phase.IDLE).all():
            return ticks
    raise AssertionError("the worlds did not come to an end")


@pytest.fixture(scope="module")
def alone(device):
    """All episodes one after the other in one world."""
    return track(device, 1)


@pytest.fixture(scope="module")
def together(device):
    """Each episode in a world of its own, all new."""
    return track(device, EPISODES)


def delivered(ticks) -> dict[tuple[int, int], list[bytes]]:
    return {address: rows for address, rows in ticks.items() if address[0] >= 0}


# ---- the same everywhere ----


def test_an_episode_is_the_same_in_a_used_world_and_in_a_new_one_to_the_bit(alone, together):
    """The second and third episode of a world equal the first ones of other worlds, at every tick."""
    assert {episode for episode, _ in delivered(alone)} == set(range(EPISODES))
    assert delivered(alone) == delivered(together)


def test_an_episode_is_the_same_whatever_runs_beside_it(device, together):
    assert delivered(track(device, 2)) == delivered(together)


def test_an_episode_is_the_same_every_time(device, alone):
    assert delivered(track(device, 1, episodes=1)).items() <= delivered(alone).items()


def test_episodes_differ(together):
    assert len({tuple(rows) for rows in delivered(together).values()}) == len(delivered(together))


def test_a_world_that_was_not_finite_is_as_good_as_new(device):
    """Poisoned with NaN while another world runs: the next arrangement there, and the other world, know nothing of it."""

    def poison(simulation: Simulation, tick: int) -> None:
        if tick == 3:
            coordinates = simulation.physics.state.joint_q.numpy()
            coordinates[: simulation.layout.coords_per_world] = np.nan
            simulation.physics.state.joint_q.assign(coordinates)

    def end(simulation: Simulation, tick: int) -> None:
        if tick == 3:
            for array, value in ((simulation.state.phase, Phase.OVER), (simulation.state.ending, Ending.UNSETTLED)):
                values = array.numpy()
                values[0] = value
                array.assign(values)

    poisoned, ended = track(device, 2, poison, episodes=2), track(device, 2, end, episodes=2)
    last = np.frombuffer(poisoned[0, 0][-1][:8], np.int32)
    assert last.tolist() == [Phase.OVER, Ending.NOT_FINITE]
    assert poisoned[0, 1] == ended[0, 1]
    assert poisoned[1, 0] == ended[1, 0]


# ---- what a tick leaves ----


@pytest.fixture(scope="module")
def resting(device):
    """Four piles with the solver's own settings: reports, energies while they settle (tick, world), and the simulation at its end."""
    config = settings(bake__worlds=4, bake__episodes=4, settle__rest_ticks=3, settle__relax_time=3.0)
    simulation = Simulation(config, catalog(), LIGHTS, device)
    reports, energies = [], []
    for _ in range(LONGEST):
        reports += run_ticks(simulation, 1)
        energies.append(np.where(reports[-1].column("phase") == Phase.SETTLE, energy(simulation, reports[-1]), np.nan))
        if (reports[-1].column("phase") != Phase.SETTLE).all():
            break
    return config, reports, np.array(energies), simulation


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


def corners(entry: int, pose: np.ndarray) -> np.ndarray:
    return catalog().entries[entry].mesh.vertices @ rotation_of(pose[3:].astype(float)).T + pose[:3]


def test_piles_come_to_rest_on_the_floor(resting):
    config, reports, _, _ = resting
    last = reports[-1]
    assert (last.column("phase") == Phase.ACT).any()
    assert not last.column("ending").any()
    for world, instance in zip(*np.nonzero(last.catalog_index >= 0), strict=True):
        low = corners(last.catalog_index[world, instance], last.pose[world, instance])
        # Nothing sinks into the floor, or hangs higher than the pile's objects could carry it.
        assert low[:, 2].min() > -1e-3
        assert low[:, 2].min() < 0.15
        assert (np.abs(low[:, :2]).max(axis=0) < np.array(config.tote.rim_size) / 2).all()


def test_something_lies_on_the_floor_in_every_world(resting):
    _, reports, _, _ = resting
    for world in range(4):
        last = [report for report in reports if report.column("phase")[world] == Phase.SETTLE][-1]
        lowest = min(
            corners(entry, pose)[:, 2].min() for entry, pose in zip(last.catalog_index[world], last.pose[world], strict=True) if entry >= 0
        )
        assert lowest == pytest.approx(0.0, abs=1e-3)


def test_energy_never_grows(resting):
    """From the drop to rest, by no more than what pushing bodies apart gives: a lift of 1 mm."""
    config, _, energies, _ = resting
    heaviest = config.arrangement.max_objects * max(entry.mass for entry in catalog().entries)
    assert np.nanmax(np.diff(energies, axis=0)) < 1e-3 * heaviest * config.physics.gravity
    for world in energies.T:
        settling = world[np.isfinite(world)]
        assert settling[-1] < 0.5 * settling[0]


def test_a_settled_pile_hardly_sinks_in(resting):
    config, _, _, simulation = resting
    arrange.measure_penetration(simulation.state, simulation.physics)
    assert simulation.state.penetration.numpy().max() < min(2e-3, config.settle.stuck_depth)


def test_the_gripper_waits_outside_and_then_stands_above_the_first_corner(device):
    config = settings(arrangement__max_objects=1, **COARSE)
    simulation = Simulation(config, catalog(CUBE), 1, device)
    seen = []
    for _ in range(LONGEST):
        simulation.tick()
        seen.append((report(simulation.record), simulation.record.snapshot.fixture_pose.numpy()[0].copy()))
        if seen[-1][0].column("phase")[0] == Phase.IDLE:
            break
    live = [bool(row.column("live")[0]) for row, _ in seen]
    frames = [int(row.column("frame")[0]) for row, _ in seen]
    first, count = live.index(True), sum(live)
    assert live == [False] * first + [True] * count + [False] * (len(live) - first - count)
    assert frames[first : first + count] == list(range(count))
    assert [int(row.column("ending")[0]) for row, _ in seen[first + count - 2 :][:2]] == [Ending.RUNNING, Ending.FINISHED]
    assert (np.array([pose[1, 0] for _, pose in seen[:first]]) > 1.0).all()
    corner = config.move.corner * np.array(config.tote.floor_size) / 2
    np.testing.assert_allclose(np.abs(seen[first][1][1:, :2]), np.tile(corner, (2, 1)), atol=1e-4)
    assert seen[first][1][1, 2] == pytest.approx(config.move.start_height + config.gripper.cup_length, abs=1e-4)
    assert (seen[-1][0].catalog_index == -1).all()


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
    restarted = np.arange(layout.worlds + 1) == world
    for array, values in (
        (state.variant, variant),
        (state.catalog_index, entries),
        (state.restarted, restarted),
        (physics.state.joint_q, q),
        (physics.state.joint_qd, qd),
    ):
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


def test_a_box_falls_as_galilei_says(bench):
    placed(bench, 0, 0, [0.0, 0.0, 0.9, 0.0, 0.0, 0.0, 1.0])
    placed(bench, 1, 0, [0.0, 0.0, 0.9, 0.0, 0.0, 0.0, 1.0], speed=(0, 0, 1.0, 0, 0, 0))
    physics = bench.config.physics
    time = 3 * physics.steps_per_tick * physics.step
    way = physics.gravity * time**2 / 2
    # A semi-implicit step is at most one step ahead.
    ahead = physics.gravity * time * physics.step
    poses = advance(bench, 3)
    assert 0.9 - poses[0, 2] == pytest.approx(way, abs=ahead)
    assert 0.9 + time - poses[1, 2] == pytest.approx(way, abs=ahead)


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


def test_a_pile_without_time_is_unsettled(device):
    config = settings(settle__max_time=0.1, settle__tries=2, bake__episodes=1, **COARSE)
    seen = run_ticks(Simulation(config, catalog(ANGLE), 1, device), 6)
    rows = [(int(row.column("phase")[0]), int(row.column("ending")[0]), int(row.column("arrangement")[0])) for row in seen]
    settle = (Phase.SETTLE, Ending.RUNNING)
    over = (Phase.OVER, Ending.UNSETTLED)
    ticks = int(np.ceil(0.1 / (config.physics.step * config.physics.steps_per_tick)))
    expected = [(*settle, 0)] * (ticks - 1) + [(*over, 0)] + [(*settle, 1)] * (ticks - 1) + [(*over, 1)]
    assert rows[: 2 * ticks] == expected
    assert [row[0] for row in rows[2 * ticks :]] == [Phase.IDLE] * (6 - 2 * ticks)


@pytest.mark.parametrize(("cuda", "asked", "made"), [(True, 1, 8), (True, 7, 8), (True, 8, 8), (True, 64, 64), (False, 1, 1)])
def test_a_gpu_gets_worlds_enough_that_their_number_does_not_matter(cuda, asked, made):
    config = with_enough_worlds(settings(bake__worlds=asked), SimpleNamespace(is_cuda=cuda))  # pyright: ignore[reportArgumentType]
    assert config.bake.worlds == made
    assert replace(config, bake=replace(config.bake, worlds=asked)) == settings(bake__worlds=asked)
