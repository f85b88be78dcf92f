"""What is recorded of every step: against the tick's own poses, the laws of motion, and the impedance law."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Outcome, Phase, Task
from synpick_warp.kernels.sim import step_log
from synpick_warp.kernels.state import Contacts
from synpick_warp.scenes import build
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import TickReader, TickReport, tick_batch
from tests.twins import gripper as twin
from tests.twins.raycast import rotation_of
from tests.worlds.kernel_worlds import filled
from tests.worlds.sights import CALM, SHORT, picking
from tests.worlds.small_worlds import ANGLE, BOX, COARSE, CUBE, catalog, settings

LONGEST = 200
GRAVITY = 9.81


class Log:
    """All reports of a run with copies of what is recorded, one world."""

    def __init__(self, simulation: Simulation, ticks: int = LONGEST) -> None:
        self.reports: list[TickReport] = []
        self.steps: list[dict[str, np.ndarray]] = []
        self.ticks: list[dict[str, np.ndarray]] = []
        reader = TickReader(simulation.record)
        for _ in range(ticks):
            simulation.tick()
            reader.start()
            made = reader.wait()
            self.reports.append(made)
            self.steps.append({name: values.copy() for name, values in made.steps.items()})
            self.ticks.append({name: values.copy() for name, values in made.tick.items()})
            if (made.column("phase") == Phase.IDLE).all():
                return

    def column(self, name: str) -> np.ndarray:
        return np.array([row.column(name)[0] for row in self.reports])

    def all(self, name: str) -> np.ndarray:
        """Of all steps, one after the other (step, ...)."""
        return np.concatenate([steps[name][0] for steps in self.steps])


@pytest.fixture(scope="module")
def moved(device) -> tuple[Log, Simulation]:
    """A cube and a box, from their fall to the end of an episode of moving."""
    simulation = Simulation(settings(arrangement__max_objects=3), catalog(CUBE, BOX), 1, device, records_physics=True)
    return Log(simulation), simulation


@pytest.fixture(scope="module")
def picked(device) -> tuple[Log, Simulation]:
    """The same pile, picked."""
    simulation = picking(settings(arrangement__max_objects=2, **SHORT), catalog(BOX, CUBE), device, records_physics=True)
    return Log(simulation), simulation


def masses(log: Log, objects: Catalog) -> np.ndarray:
    """Mass of each instance in each tick [kg], NaN for none."""
    table = np.append([entry.mass for entry in objects.entries], np.nan)
    return np.array([table[row.catalog_index[0]] for row in log.reports])


@pytest.mark.parametrize("run", ["moved", "picked"])
def test_the_last_step_is_what_the_tick_shows_to_the_bit(run, request, device):
    log, _ = request.getfixturevalue(run)
    seen = 0
    for row, steps in zip(log.reports, log.steps, strict=True):
        there = row.catalog_index[0] >= 0
        assert steps["pose"][0, -1][there].tobytes() == row.pose[0][there].tobytes()
        seen += there.sum()
        # Whoever has just been put above a grasp or sent home has not got there by physics.
        if row.column("live")[0] and not row.column("outcome")[0] and row.column("frame")[0]:
            assert steps["gripper_pose"][0, -1].tobytes() == row.snapshot.fixture_pose[0, 1:].tobytes()
    assert seen > 10


@pytest.mark.parametrize("run", ["moved", "picked"])
def test_what_is_not_there_is_not_a_number(run, request, device):
    log, _ = request.getfixturevalue(run)
    names = [name for name, values in log.steps[0].items() if values.dtype.kind == "f"]
    for row, steps, before in zip(log.reports[1:], log.steps[1:], log.reports[:-1], strict=True):
        there = (before.catalog_index[0] >= 0) if before.column("phase")[0] in (Phase.SETTLE, Phase.ACT) else (row.catalog_index[0] >= 0)
        for name in names:
            values = steps[name][0]
            if name.startswith("gripper") or values.shape[1:2] != there.shape or name in ("setpoint", "impedance_force"):
                continue
            assert np.isfinite(values[:, there]).all(), name
            assert np.isnan(values[:, ~there]).all(), name
        assert not steps["attached"][0][:, ~there].any()
        for name in ("gripper_pose", "gripper_velocity", "gripper_contact_force", "gripper_contact_load", "impedance_force"):
            assert np.isfinite(steps[name]).all(), name


@pytest.mark.parametrize("run", ["moved", "picked"])
def test_momentum_changes_by_contacts_and_weight(run, request, device):
    """m (v' - v) / h = F_contact - m g, in every step of every object that no seal holds: impacts, piles, what the gripper pushes."""
    log, simulation = request.getfixturevalue(run)
    step = simulation.config.physics.step
    objects = catalog(CUBE, BOX) if run == "moved" else catalog(BOX, CUBE)
    weights = np.repeat(masses(log, objects), simulation.config.physics.steps_per_tick, axis=0)
    velocity, force, held = log.all("velocity").astype(float), log.all("contact_force").astype(float), log.all("attached").astype(bool)
    phase = np.repeat(log.column("phase"), simulation.config.physics.steps_per_tick)
    change = weights[1:, :, None] * (np.diff(velocity, axis=0) / step + [0.0, 0.0, GRAVITY]) - force[1:]
    free = ~held[1:] & ~held[:-1] & (phase[1:] == Phase.ACT)[:, None] & np.isfinite(change).all(axis=2)
    assert free.sum() > 500
    assert force[1:][free].max() > 0.5
    np.testing.assert_allclose(change[free], 0.0, atol=2e-4)


def test_an_object_that_lies_alone_is_carried_by_its_weight(device):
    """On the floor: the forces of its contacts sum to m g upwards, and no less is the sum of their sizes."""
    objects = catalog(CUBE)
    simulation = Simulation(settings(arrangement__max_objects=1), objects, 1, device, records_physics=True)
    log = Log(simulation, 20)
    weight = objects.entries[0].mass * GRAVITY
    first = int(np.flatnonzero(log.column("live"))[0])
    np.testing.assert_allclose(log.steps[first]["contact_force"][0, :, 0], np.tile([0.0, 0.0, weight], (33, 1)), atol=1e-3 * weight)
    assert (log.steps[first]["contact_load"][0, :, 0] >= weight * (1.0 - 1e-3)).all()
    drop = log.ticks[first]["drop_pose"][0, 0]
    assert drop[2] > simulation.config.tote.outer_size[2] - simulation.config.tote.wall
    # It fell freely from there: in n solver steps of h by h² g n (n + 1) / 2.
    physics = simulation.config.physics
    fallen = drop[2] - log.steps[0]["pose"][0, :, 0, 2]
    count = physics.substeps * np.arange(1, 34)
    np.testing.assert_allclose(fallen, (physics.step / physics.substeps) ** 2 * GRAVITY * count * (count + 1) / 2, atol=1e-5)
    np.testing.assert_array_equal(log.steps[0]["contact_force"][0], 0.0)


def test_velocities_are_those_of_poses(device):
    """Of the centre of mass, which is not the origin, and about the world's axes: an L that falls and spins, one solver step a step."""
    objects = catalog(ANGLE)
    simulation = Simulation(settings(arrangement__max_objects=1, **COARSE), objects, 1, device, records_physics=True)
    (entry,), step = objects.entries, simulation.config.physics.step
    Log(simulation, 1)
    slot = int(simulation.state.body_slot.numpy()[0, 0])
    speeds = simulation.physics.state.joint_qd.numpy()
    first = build.GRIPPER_DOFS + build.FREE_DOFS * slot
    speeds[first : first + 6] = [0.1, -0.2, 1.0, 3.0, -2.0, 4.0]
    simulation.physics.state.joint_qd.assign(speeds)
    simulation.physics.refresh_poses()
    (steps,) = Log(simulation, 1).steps
    pose = steps["pose"][0, :, 0].astype(float)
    center = pose[:, :3] + np.array([rotation_of(one) @ entry.center_of_mass for one in pose[:, 3:]])
    np.testing.assert_allclose(np.diff(center, axis=0) / step, steps["velocity"][0, 1:, 0], atol=2e-4)
    assert np.abs(np.diff(pose[:, :3], axis=0) / step - steps["velocity"][0, 1:, 0]).max() > 1e-2
    turns = np.array([spin(before, after) for before, after in zip(pose[:-1, 3:], pose[1:, 3:], strict=True)]) / step
    np.testing.assert_allclose(turns, steps["angular_velocity"][0, 1:, 0], atol=5e-3)
    assert np.linalg.norm(turns, axis=1).min() > 5.0


def spin(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Rotation vector from one orientation to the other, in the world's axes [rad]."""
    return (Rotation.from_quat(after) * Rotation.from_quat(before).inv()).as_rotvec()


@pytest.mark.parametrize("run", ["moved", "picked"])
def test_the_force_is_the_impedance_law_of_goal_pose_and_velocity(run, request, device):
    """Of the step's goal, and of pose and velocity at its beginning."""
    log, simulation = request.getfixturevalue(run)
    config = simulation.config
    section = config.move if run == "moved" else config.pick
    law = (section.stiffness, section.damping, section.force, config.gripper.finger_mass + config.gripper.cup_mass, config.physics.step)
    checked = 0
    for row, steps in zip(log.reports, log.steps, strict=True):
        goal, force = steps["setpoint"][0], steps["impedance_force"][0]
        drawn = np.isfinite(goal[:, 0])
        assert not force[~drawn].any()
        place, velocity = steps["gripper_pose"][0, :, 0, :3], steps["gripper_velocity"][0, :, 0]
        for step in 1 + np.flatnonzero(drawn[1:]):
            expected = twin.force(goal[step].astype(float) - place[step - 1], velocity[step - 1].astype(float), *law)
            np.testing.assert_allclose(force[step], expected, rtol=2e-4, atol=2e-3)
            checked += 1
        assert not drawn.any() or row.column("live")[0]
    assert checked > 200


def test_seal_loads_are_those_of_the_attempts(picked):
    """The largest of a tick's steps is the load that attempts tell of, to the bit; what hangs bears its weight at last."""
    log, _ = picked
    loads = log.all("seal_force").reshape(len(log.reports), -1)
    peak = np.nanmax(np.where(np.isnan(loads), 0.0, loads), axis=1)
    assert peak.tolist() == [float(row.measure("peak_force")[0]) for row in log.reports]
    assert peak.max() > 0.5
    held = log.all("attached").astype(bool)
    assert not log.all("seal_force")[~held & ~np.isnan(log.all("seal_force"))].any()
    assert {Task.LIFT, Task.PRESS, Task.DESCEND, Task.APPROACH} <= set(log.all("task").tolist())
    assert set(log.all("task")[held.any(axis=1)].tolist()) == {Task.LIFT}


def test_ticks_say_what_the_status_says(picked):
    log, _ = picked
    for row, ticks in zip(log.reports, log.ticks, strict=True):
        for name in ("phase", "task", "attempt", "outcome", "target", "hits"):
            assert ticks[name][0] == row.column(name)[0]
        assert ticks["peak_force"][0] == row.measure("peak_force")[0]
        for name in ("attached", "engaged"):
            assert (1 << np.flatnonzero(ticks[name][0])).sum() == getattr(row, name)[0, 0]
            assert ticks[name].shape == row.catalog_index.shape


def test_a_batch_has_the_live_worlds_arrays(moved):
    log, _ = moved
    row = next(row for row in log.reports if row.column("live")[0])
    batch = tick_batch(row, np.array([4, 5], np.int32), 0.066)
    assert batch.steps.keys() == row.steps.keys()
    assert batch.steps["pose"].shape == (1, 33, 3, 7)
    assert batch.tick["drop_pose"].shape == (1, 3, 7)


def episodes(device, worlds: int, recorded: bool) -> dict[tuple[int, int], bytes]:
    """Results of each live tick of each episode in a number of worlds."""
    config = settings(bake__worlds=worlds, bake__episodes=3, **COARSE)
    simulation = Simulation(config, catalog(), 1, device, records_physics=recorded)
    reader, made = TickReader(simulation.record), {}
    for _ in range(LONGEST):
        simulation.tick()
        reader.start()
        row = reader.wait()
        batch = tick_batch(row, np.array([1, 2, 3], np.int32), 0.064)
        for world in range(len(batch)):
            there = batch.object_id[world] >= 0
            parts = [batch.pose[world][there], *(values[world] for values in batch.steps.values())]
            parts += [values[world][there] if name == "drop_pose" else values[world] for name, values in batch.tick.items()]
            made[int(batch.episode[world]), int(batch.frame[world])] = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
        if (row.column("phase") == Phase.IDLE).all():
            return made
    raise AssertionError("the worlds did not come to an end")


def test_a_record_is_the_same_in_any_world_and_changes_nothing(device):
    alone = episodes(device, 1, True)
    assert {episode for episode, _ in alone} == {0, 1, 2}
    assert episodes(device, 3, True) == alone
    bare = episodes(device, 3, False)
    assert bare.keys() == alone.keys()
    assert all(alone[key].startswith(poses) for key, poses in bare.items())


def test_without_steps_there_are_ticks_alone(device):
    config = settings(arrangement__max_objects=1, trajectory__steps=False, **COARSE)
    log = Log(Simulation(config, catalog(CUBE), 1, device, records_physics=True), 1)
    assert log.steps == [{}]
    assert log.ticks[0]["drop_pose"].shape == (1, 1, 7)


def test_sums_of_contact_forces_are_exact_and_opposite(device):
    """Contacts 0 and 1 between bodies 0 and 1, contact 2 of body 1 with the world, one that is not finite, one beyond the count."""
    force = np.zeros((5, 6), np.float32)
    force[:, :3] = [[1.0, -2.0, 2.0], [0.5, 0.0, 0.0], [0.0, 0.0, 8.0], [np.nan, 1.0, 1.0], [100.0, 0.0, 0.0]]
    shapes = np.array([[0, 1], [1, 0], [1, 2], [0, 1], [0, 1]], np.int32)
    total = wp.zeros((2, 4), dtype=wp.int64, device=device)
    values = {"shape_body": [0, 1, -1], "count": [4], "shape0": shapes[:, 0], "shape1": shapes[:, 1]}
    contacts = filled(Contacts(), {name: wp.array(value, dtype=int, device=device) for name, value in values.items()})
    forces = wp.array(force, dtype=wp.spatial_vector, device=device)
    launch(step_log.sum_contacts_kernel, 5, contacts=contacts, contact_force=forces, total=total)
    np.testing.assert_array_equal(total.numpy() / float(step_log.COUNTS_PER_NEWTON), [[0.5, -2.0, 2.0, 3.5], [-0.5, 2.0, 6.0, 11.5]])


def test_four_cups_pick_a_box_and_share_its_weight(device):
    cups = [[0.05, 0.04], [-0.05, 0.04], [-0.05, -0.04], [0.05, -0.04]]
    objects = catalog(((0.2, 0.16, 0.05),))
    array = {"gripper__kind": "suction_array", "gripper__cups": cups, "gripper__cup_width": 0.036}
    array |= {"arrangement__max_objects": 1, "arrangement__volume": 2e-3}
    log = Log(picking(settings(**SHORT | CALM, **array), objects, device, records_physics=True))
    (end,) = np.flatnonzero(log.column("outcome"))
    assert [log.column(name)[end] for name in ("outcome", "hits", "sealed")] == [Outcome.TARGET_PICKED, 40, 0b1111]
    assert log.reports[end].attached.tolist() == [[1]]
    force, weight = log.steps[end - 1]["cup_force"][0, -1], objects.entries[0].mass * GRAVITY
    np.testing.assert_allclose(force[:4], weight / 4, rtol=0.1)
    assert force.sum() == pytest.approx(weight, rel=0.03)
    assert force[4:].tolist() == [0.0] * 12
    assert log.steps[end - 1]["seal_force"][0, -1, 0] == force.max()
