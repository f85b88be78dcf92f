"""Whole episodes, from the first look to the empty tote, and what is recorded of every step and tick: against poses, free fall, statics.

The laws of motion and of impedance, in every step of a baked episode, are checked by tools.checks.trajectory (`test_trajectory_bake`).
"""

import itertools

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Ending, Outcome, Phase, Task
from synpick_warp.kernels.sim import step_log
from synpick_warp.kernels.state import Contacts
from synpick_warp.scenes import build
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import TickReader, TickReport, read_tick
from tests.twins.raycast import rotation_of
from tests.worlds.kernel_worlds import filled
from tests.worlds.small_worlds import ANGLE, BOX, CALM, COARSE, CUBE, SHORT, catalog, picking, run_ticks, settings

LONGEST = 200
GRAVITY = 9.81


class Log:
    """All reports of a run with copies of what is recorded, one world."""

    def __init__(self, simulation: Simulation, ticks: int = LONGEST) -> None:
        self.simulation, self.objects = simulation, simulation.catalog
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

    def live(self) -> list[TickReport]:
        """Reports of frames."""
        return [row for row in self.reports if row.column("live")[0]]


@pytest.fixture(scope="module")
def moved(device) -> Log:
    """A cube and a box, from their fall to the end of an episode of moving."""
    return Log(Simulation(settings(arrangement__max_objects=3), catalog(CUBE, BOX), 1, device, records_physics=True))


@pytest.fixture(scope="module")
def picked(device) -> Log:
    """A cube and a box, picked one after the other, at the paper's step."""
    return Log(picking(settings(arrangement__max_objects=2, **SHORT | CALM), catalog(BOX, CUBE), device, records_physics=True))


# ---- an episode of picking ----


def test_a_pick_episode_runs_to_its_end(picked):
    outcomes, live = picked.column("outcome"), picked.column("live") == 1
    assert [Outcome(code) for code in outcomes[outcomes > 0]] == [Outcome.TARGET_PICKED] * len(picked.objects)
    (last,) = np.flatnonzero(picked.column("phase") == Phase.OVER)
    assert Ending(picked.column("ending")[last]) is Ending.EMPTIED
    assert live[last], "the picture of the empty tote belongs to the episode"
    assert picked.column("frame")[live].tolist() == list(range(live.sum()))
    tasks = picked.column("task")[live]
    once = [Task.LOOK, Task.APPROACH, Task.DESCEND, Task.PRESS, Task.LIFT]
    assert tasks[np.insert(np.diff(tasks) != 0, 0, True)].tolist() == once * len(picked.objects) + [Task.LOOK]


def test_the_seal_bears_the_weight_at_the_end_of_the_lift(picked):
    for row, following in itertools.pairwise(picked.reports):
        if following.column("outcome")[0]:
            weight = picked.objects.entries[row.catalog_index[0][following.column("target")[0]]].mass * GRAVITY
            assert row.measure("peak_force")[0] == pytest.approx(weight, rel=0.03)
            assert row.column("hits")[0] == 10


def test_the_first_two_frames_show_the_same_pile(picked):
    """Looking takes no time, and the gripper that appears touches nothing."""
    first, second, *_ = picked.live()
    np.testing.assert_allclose(first.pose[0, :, :3], second.pose[0, :, :3], atol=2e-3)


def test_there_must_be_something_to_look_at(device):
    with pytest.raises(ValueError, match="render_scene"):
        Simulation(settings(**SHORT), catalog(), 1, device)


# ---- records of steps ----


@pytest.mark.parametrize("run", ["moved", "picked"])
def test_the_last_step_is_what_the_tick_shows_to_the_bit(run, request, device):
    """Or, where a body is held, what the tick before shows."""
    log = request.getfixturevalue(run)
    seen, before = 0, None
    for row, steps in zip(log.reports, log.steps, strict=True):
        there = row.catalog_index[0] >= 0
        last, shown = steps["pose"][0, -1][there], row.pose[0][there]
        same = (last == shown).all(axis=1)
        if not same.all():
            np.testing.assert_array_equal(shown[~same], before[0][there][~same])
            np.testing.assert_allclose(shown[:, :3], last[:, :3], rtol=0.0, atol=1e-5)
        seen, before = seen + same.sum(), row.pose
        # Whoever has just been put above a grasp or sent home has not got there by physics.
        if row.column("live")[0] and not row.column("outcome")[0] and row.column("frame")[0]:
            assert steps["gripper_pose"][0, -1].tobytes() == row.snapshot.fixture_pose[0, 1:].tobytes()
    assert seen > 10


@pytest.mark.parametrize("run", ["moved", "picked"])
def test_what_is_not_there_is_not_a_number(run, request, device):
    log = request.getfixturevalue(run)
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


def test_seals_bear_loads_in_the_lift_alone(picked):
    loads, held, tasks = picked.all("seal_force"), picked.all("attached").astype(bool), picked.all("task")
    assert not loads[~held & ~np.isnan(loads)].any()
    assert {Task.LIFT, Task.PRESS, Task.DESCEND, Task.APPROACH} <= set(tasks.tolist())
    assert set(tasks[held.any(axis=1)].tolist()) == {Task.LIFT}


def test_records_change_nothing(moved, device):
    bare = Simulation(settings(arrangement__max_objects=3), catalog(CUBE, BOX), 1, device)
    for expected, found in zip(moved.reports, run_ticks(bare, len(moved.reports)), strict=True):
        assert found.status.tobytes() == expected.status.tobytes()
        assert found.pose.tobytes() == expected.pose.tobytes()


def test_ticks_say_what_the_status_says(picked):
    for row, ticks in zip(picked.reports, picked.ticks, strict=True):
        for name in ("phase", "task", "attempt", "outcome", "target", "hits"):
            assert ticks[name][0] == row.column(name)[0]
        assert ticks["peak_force"][0] == row.measure("peak_force")[0]
        for name in ("attached", "engaged"):
            assert (1 << np.flatnonzero(ticks[name][0])).sum() == getattr(row, name)[0, 0]
            assert ticks[name].shape == row.catalog_index.shape


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


# ---- support: who lies on whom ----

BAR = ((0.2, 0.05, 0.02),)
LEANING = [float(value) for value in Rotation.from_euler("y", -20, degrees=True).as_quat()]
UPRIGHT = [0.0, 0.0, 0.0, 1.0]
SCENES = {
    "stack": {0: (0.0, 0.0, 0.025), 1: (0.01, 0.0, 0.075), 2: (0.0, 0.1, 0.01)},
    "bridge": {0: (-0.06, 0.0, 0.025), 1: (0.06, 0.0, 0.025), 2: (0.0, 0.0, 0.06)},
    "leaning": {0: (0.08, 0.0, 0.025), 1: (-0.1, 0.1, 0.025), 2: (0.0, 0.0, 0.046)},
}
"""Position [m] of a cube, another, and a bar; the last leans on the first cube's edge."""


@pytest.fixture(scope="module")
def rested(device) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Support (object, supporter) [N] in each scene, at rest, and weights of the objects [N]; the last supporter is the bin."""
    objects = catalog(CUBE, CUBE, BAR)
    given = {"arrangement__max_objects": 3, "arrangement__volume": 1e-3, "settle__min_time": 3.0, "move__repeats": False}
    simulation = Simulation(settings(bake__worlds=3, bake__episodes=3, bop__graph=True, **given), objects, 1, device)
    simulation.tick()
    physics, layout = simulation.physics, simulation.layout
    chosen, slot = simulation.state.catalog_index.numpy(), simulation.state.body_slot.numpy()
    places, speeds = (array.numpy() for array in (physics.state.joint_q, physics.state.joint_qd))
    for world, scene in enumerate(SCENES.values()):
        for instance, which in enumerate(chosen[world]):
            turn = LEANING if scene is SCENES["leaning"] and which == 2 else UPRIGHT
            first = world * layout.coords_per_world + build.GRIPPER_DOFS + 7 * slot[world, instance]
            places[first : first + 7] = [*scene[which], *turn]
    speeds[:] = 0.0
    physics.state.joint_q.assign(places)
    physics.state.joint_qd.assign(speeds)
    physics.refresh_poses()
    for _ in range(12):
        simulation.tick()
    report = read_tick(simulation.record)
    assert (report.column("phase") == Phase.SETTLE).all()
    assert report.steps == {}
    assert report.tick["support"].shape == (3, 3, 3)
    result = {}
    for world, name in enumerate(SCENES):
        order = np.argsort(chosen[world])
        result[name] = np.column_stack([report.tick["support"][world][np.ix_(order, order)], report.tick["static_support"][world][order]])
    return result, GRAVITY * np.array([entry.mass for entry in objects.entries])


@pytest.mark.parametrize("name", SCENES)
def test_what_rests_is_carried_by_its_weight(rested, name):
    """Upward forces on each object, less those with which it carries others, sum to m g; those of a pair are opposite."""
    support, weights = rested[0][name], rested[1]
    np.testing.assert_allclose(support.sum(axis=1), weights, rtol=0.02)
    np.testing.assert_array_equal(support[:, :3], -support[:, :3].T)


def test_supporters_are_what_lies_below(rested):
    support, weights = rested
    cube, _, bar = weights
    np.testing.assert_allclose(support["stack"], [[0, -cube, 0, 2 * cube], [cube, 0, 0, 0], [0, 0, 0, bar]], atol=0.02 * cube)
    np.testing.assert_allclose(
        support["bridge"], [[0, 0, -bar / 2, cube + bar / 2], [0, 0, -bar / 2, cube + bar / 2], [bar / 2, bar / 2, 0, 0]], atol=0.05 * bar
    )
    leaning = support["leaning"]
    assert 0.2 * bar < leaning[2, 0] < 0.8 * bar
    assert leaning[2, 0] + leaning[2, 3] == pytest.approx(bar, rel=0.02)
    assert leaning[1].tolist()[:3] == [0.0, 0.0, 0.0]
