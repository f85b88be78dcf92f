"""When a pile rests, what is dropped again, and how episodes end: scripted bodies, without a physics engine."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Ending, Lost, Phase, Stream
from synpick_warp.kernels.sim import rest
from synpick_warp.stages.sim import arrange
from tests.twins import rng
from tests.worlds.kernel_worlds import GUIDES, SHAPES, KernelWorlds

SEED = 11
INSIDE = np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 1.0])


def made(device, worlds: int = 1, objects: int = 2, **settings) -> KernelWorlds:
    """Worlds in which `objects` instances lie in the tote and rest."""
    compound, radius = np.array([0, 1, 0]), np.array([0.05, 0.1, 0.2])
    result = KernelWorlds(device, worlds, 3, 4, 4, 2, compound=compound, radius=radius, **settings)
    entry, slot = np.full((worlds, 4), -1), np.zeros((worlds, 4))
    entry[:, :objects] = (np.arange(objects) % 2) * 2
    slot[:, :objects] = np.arange(objects)
    result.begin(Phase.SETTLE)
    result.set(result.state.catalog_index, entry)
    result.set(result.state.body_slot, slot)
    result.set(result.state.progress, [0, 0, 0, 1])
    result.set(result.state.previous_pose, INSIDE)
    for world in range(worlds):
        for instance in range(objects):
            result.place(world, instance, INSIDE)
    return result


def touch(worlds: KernelWorlds, contacts: list[dict], room: int = 8) -> None:
    """Give the pipeline's contacts; what a contact leaves open is zero."""
    values = {
        "shape0": (-1, int),
        "shape1": (-1, int),
        "point0": ((0, 0, 0), wp.vec3),
        "point1": ((0, 0, 0), wp.vec3),
        "normal": ((0, 0, 1), wp.vec3),
        "margin0": (0, float),
        "margin1": (0, float),
    }
    for name, (default, dtype) in values.items():
        rows = np.array([contact.get(name, default) for contact in contacts] + [default] * (room - len(contacts)))
        setattr(worlds.physics.contacts, f"rigid_contact_{name}", wp.array(rows, dtype=dtype, device=worlds.device))
    worlds.physics.contacts.rigid_contact_max = room
    worlds.physics.contacts.rigid_contact_count = wp.array([len(contacts)], dtype=int, device=worlds.device)


def judge(worlds: KernelWorlds, shift: float = 0.0, contacts: list[dict] | None = None, restless: float = 0.0) -> None:
    """One tick in which the first instance of every world moves by `shift`."""
    touch(worlds, contacts or [])
    previous = worlds.state.previous_pose.numpy()
    for world in range(worlds.worlds):
        previous[world, 0, :3] = worlds.physics.state.body_q.numpy()[world * worlds.bodies + 2, :3]
        previous[world, 0, 0] += shift
    worlds.set(worlds.state.previous_pose, previous)
    arrange.judge_settling(worlds.scene, worlds.state, worlds.physics, SEED, restless)
    arrange.judge_episodes(worlds.scene, worlds.state, worlds.attempts, worlds.observation, worlds.physics)


def state_of(worlds: KernelWorlds, world: int = 0) -> tuple[int, int, list[int]]:
    state = worlds.state
    return int(state.phase.numpy()[world]), int(state.ending.numpy()[world]), state.progress.numpy()[world].tolist()


def turned(axis: int, angle: float) -> np.ndarray:
    pose = INSIDE.copy()
    pose[3 + axis], pose[6] = np.sin(angle / 2), np.cos(angle / 2)
    return pose


# ---- how deep, how far ----


def test_depth_of_contacts(device):
    """Body of the world's first slot sunk into a fixed shape and into a body; the deepest counts for each."""
    worlds = made(device)
    bodies = np.full(SHAPES, -1)
    bodies[4], bodies[5] = 2, 3
    worlds.set(worlds.physics.model.shape_body, bodies)
    pose = turned(2, np.pi / 2)
    worlds.place(0, 0, pose)
    # In the world the body's point is (0, 0.03, 0.05 - 0.04).
    low = {"shape0": 0, "shape1": 4, "point0": (0, 0, 0.02), "point1": (0.03, 0, -0.04)}
    thick = {
        "shape0": 4,
        "shape1": 0,
        "normal": (0, 0, -1),
        "point0": (0, 0, -0.04),
        "point1": (0, 0, 0.01),
        "margin0": 0.002,
        "margin1": 0.003,
    }
    apart = {"shape0": 5, "shape1": 0, "normal": (0, 0, -1), "point1": (0, 0, 0.01)}
    touch(worlds, [low, thick, apart])
    arrange.measure_penetration(worlds.state, worlds.physics)
    expected = np.zeros(worlds.bodies)
    expected[2] = 0.01
    np.testing.assert_allclose(worlds.state.penetration.numpy(), expected, atol=1e-7)
    touch(worlds, [thick])
    arrange.measure_penetration(worlds.state, worlds.physics)
    assert worlds.state.penetration.numpy()[2] == pytest.approx(0.005, abs=1e-7)


def test_contacts_beyond_the_count_do_not_exist(device):
    worlds = made(device)
    worlds.set(worlds.physics.model.shape_body, 2)
    touch(worlds, [{"shape0": 0, "margin0": 0.5}] * 3)
    worlds.physics.contacts.rigid_contact_count.zero_()
    arrange.measure_penetration(worlds.state, worlds.physics)
    assert (worlds.state.penetration.numpy() == 0.0).all()


@given(
    move=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
    angle=st.floats(0.0, np.pi),
    axis=st.integers(0, 2),
    flip=st.booleans(),
    start=st.floats(-3.0, 3.0),
)
def test_shift_of_known_motions(move, angle, axis, flip, start, device):
    """|Δp| + angle · radius, whichever of a quaternion's two signs comes."""
    worlds = made(device)
    before, after = turned(axis, start), turned(axis, start + angle)
    after[:3] += move
    if flip:
        after[3:] *= -1
    worlds.set(worlds.state.previous_pose, before)
    worlds.place(0, 0, after)
    worlds.place(0, 1, before)
    arrange.measure_displacement(worlds.scene, worlds.state, worlds.physics)
    shift = worlds.state.displacement.numpy()[0]
    assert shift[0] == pytest.approx(np.linalg.norm(move) + angle * worlds.radius[0], abs=2e-5)
    assert shift[1] == pytest.approx(0.0, abs=1e-6)
    arrange.measure_displacement(worlds.scene, worlds.state, worlds.physics)
    assert worlds.state.displacement.numpy()[0, 0] == pytest.approx(0.0, abs=1e-6)


def test_shift_bounds_how_far_any_point_of_the_sphere_moved(device):
    numbers = np.random.default_rng(0)
    worlds = made(device)
    for _ in range(20):
        turn = numbers.normal(size=4)
        after = np.concatenate([numbers.uniform(-0.1, 0.1, 3), turn / np.linalg.norm(turn)])
        worlds.set(worlds.state.previous_pose, [0, 0, 0, 0, 0, 0, 1])
        worlds.place(0, 0, after)
        arrange.measure_displacement(worlds.scene, worlds.state, worlds.physics)
        points = numbers.normal(size=(500, 3))
        points *= worlds.radius[0] / np.linalg.norm(points, axis=1, keepdims=True)
        cross = 2 * np.cross(after[3:6], points)
        moved = cross * after[6] + np.cross(after[3:6], cross) + after[:3]
        assert np.linalg.norm(moved, axis=1).max() <= worlds.state.displacement.numpy()[0, 0] + 1e-6


# ---- rest ----


def test_guides_fall_after_some_ticks_at_rest_and_then_the_gripper_acts(device):
    worlds = made(device)
    settle = worlds.scene.settle
    seen = []
    while state_of(worlds)[0] == Phase.SETTLE and len(seen) < 20:
        judge(worlds)
        seen.append(state_of(worlds))
    until = max(settle.min_ticks, settle.rest_ticks)
    assert [progress[3] for _, _, progress in seen] == [1] * (until - 1) + [0] * (settle.rest_ticks + 1)
    assert [phase for phase, _, _ in seen] == [Phase.SETTLE] * (until + settle.rest_ticks - 1) + [Phase.ACT]
    assert [progress[0] for _, _, progress in seen] == list(range(1, len(seen) + 1))


def test_a_motion_starts_the_count_again(device):
    worlds = made(device, settle={"min_ticks": 0, "rest_ticks": 3})
    for shift, resting in [(0.0, 1), (0.0, 2), (2e-4, 0), (0.5e-4, 1), (2e-4, 0), (0.0, 1), (0.0, 2)]:
        judge(worlds, shift)
        assert state_of(worlds)[2][1] == resting
        assert state_of(worlds)[2][3] == 1
    judge(worlds)
    assert state_of(worlds)[2][3] == 0


def test_late_piles_may_buzz_a_little(device):
    worlds = made(device, settle={"min_ticks": 0, "rest_ticks": 2, "late_ticks": 6})
    for _ in range(6):
        judge(worlds, 5e-4)
        assert state_of(worlds)[2][1] == 0
    judge(worlds, 5e-4)
    assert state_of(worlds)[2][1] == 1
    judge(worlds, 2e-3)
    assert state_of(worlds)[2][1] == 0


@pytest.mark.parametrize(
    ("objects", "restless", "shift", "rests"),
    [
        (2, 0.5, 5e-4, 1),
        (2, 0.49, 5e-4, 0),
        (2, 0.5, 2e-3, 0),
        (4, 0.25, 5e-4, 1),
        (4, 0.24, 5e-4, 0),
        (4, 0.0, 5e-4, 0),
        (4, 0.0, 0.5e-4, 1),
    ],
)
def test_a_fraction_of_the_objects_may_be_restless(device, objects, restless, shift, rests):
    """Known: one object moves, which is half or a quarter of them; beyond the relaxed bound none may."""
    worlds = made(device, objects=objects, settle={"min_ticks": 0, "rest_ticks": 2})
    judge(worlds, shift, restless=restless)
    assert state_of(worlds)[2][1] == rests


def test_an_empty_tote_is_at_rest(device):
    worlds = made(device, objects=0)
    for _ in range(10):
        judge(worlds)
    assert state_of(worlds)[0] == Phase.ACT


def test_a_pile_that_never_rests_ends_its_episode(device):
    worlds = made(device, settle={"max_ticks": 7})
    for _ in range(6):
        judge(worlds, 0.01)
        assert state_of(worlds)[:2] == (Phase.SETTLE, Ending.RUNNING)
    judge(worlds, 0.01)
    assert state_of(worlds)[:2] == (Phase.OVER, Ending.UNSETTLED)


@pytest.mark.parametrize("phase", [Phase.EMPTY, Phase.ACT, Phase.OVER, Phase.IDLE])
def test_only_settling_worlds_are_judged_for_rest(device, phase):
    worlds = made(device)
    worlds.begin(phase)
    worlds.place(0, 0, [5.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    before = worlds.physics.state.joint_q.numpy().copy()
    for _ in range(10):
        judge(worlds)
    assert state_of(worlds) == (phase, Ending.RUNNING, [0, 0, 0, 1])
    np.testing.assert_array_equal(worlds.physics.state.joint_q.numpy(), before)


def test_guides_stand_or_are_far_above_everything(device):
    worlds = made(device, worlds=2)
    worlds.set(worlds.physics.model.shape_transform, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0])
    worlds.set(worlds.state.progress, [[0, 0, 0, 1], [0, 0, 0, 0]])
    arrange.place_bins(worlds.scene, worlds.state, worlds.physics)
    poses = worlds.physics.model.shape_transform.numpy().reshape(2, SHAPES, 7)
    others = np.delete(poses, GUIDES, axis=1)
    assert (others == [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]).all()
    assert (poses[0, list(GUIDES)] == [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]).all()
    assert (poses[1, list(GUIDES)] == [0.0, 0.0, rest.SHAPES_AWAY, 0.0, 0.0, 0.0, 1.0]).all()
    worlds.set(worlds.state.progress, [0, 0, 0, 1])
    arrange.place_bins(worlds.scene, worlds.state, worlds.physics)
    poses = worlds.physics.model.shape_transform.numpy().reshape(2, SHAPES, 7)
    assert (poses[1, list(GUIDES), :3] == 0.0).all()


# ---- dropped again ----


@pytest.mark.parametrize(
    ("place", "outside"),
    [
        ((0.0, 0.0, 0.0), False),
        ((0.24, 0.14, 0.1), False),
        ((0.26, 0.0, 0.1), True),
        ((-0.26, 0.0, 0.1), True),
        ((0.0, 0.16, 0.1), True),
        ((0.0, -0.16, 0.199), True),
        ((0.0, 0.16, 0.3), False),
        ((0.0, 0.0, -0.02), True),
        ((0.0, 0.0, 5.0), False),
    ],
)
def test_what_leaves_the_tote_is_dropped_again(device, place, outside):
    worlds = made(device)
    worlds.set(worlds.state.progress, [5, 3, 0, 0])
    worlds.place(0, 1, [*place, 0.0, 0.0, 0.0, 1.0])
    worlds.set(worlds.physics.state.joint_qd, 1.0)
    judge(worlds)
    redropped = state_of(worlds)[2][2] == 1
    assert redropped == outside
    if not outside:
        return
    assert state_of(worlds)[2] == [6, 0, 1, 1]
    pose, drop, radius = worlds.coordinates()[0, 1], worlds.scene.drop, worlds.radius[2]
    key = rng.stream_key(SEED, 0, 0, Stream.REDROP)
    share = 2 * rng.uniform(key, np.arange(2)) - 1
    free = np.maximum(0.0, np.array(worlds.bins[0].opening) / 2 - radius)
    np.testing.assert_allclose(pose[:3], [*(share * drop.spread * free), worlds.bins[0].height + radius], atol=1e-6)
    np.testing.assert_allclose(pose[3:], rng.uniform_rotation(key, 2), atol=1e-6)
    speed = worlds.physics.state.joint_qd.numpy()[4:].reshape(-1, 6)
    assert (speed[1] == 0.0).all()
    assert (np.delete(speed, 1, axis=0) == 1.0).all()


def test_objects_dropped_again_together_fall_one_above_the_other_from_poses_of_their_own(device):
    worlds = made(device, objects=4)
    for instance in range(4):
        worlds.place(0, instance, [0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0])
    judge(worlds)
    assert state_of(worlds)[2] == [1, 0, 4, 1]
    radius = worlds.radius[worlds.state.catalog_index.numpy()[0]]
    poses = worlds.coordinates()[0, :4]
    gaps = np.diff(poses[:, 2]) - radius[1:] - radius[:-1]
    np.testing.assert_allclose(gaps, worlds.scene.drop.clearance, atol=1e-6)
    assert len(np.unique(poses[:, 3].round(6))) == 4


def test_a_stuck_object_is_dropped_again_after_some_time(device):
    worlds = made(device, settle={"min_ticks": 50})
    settle = worlds.scene.settle
    worlds.set(worlds.physics.model.shape_body, np.where(np.arange(SHAPES) == 4, 3, -1))
    height = float(INSIDE[2])
    deep, shallow = ([{"shape0": 4, "shape1": 0, "point1": (0, 0, height), "margin0": share * settle.stuck_depth}] for share in (1.5, 0.5))
    for contacts in [deep] * settle.stuck_ticks + [shallow] + [deep] * settle.stuck_ticks:
        judge(worlds, contacts=contacts)
        assert state_of(worlds)[2][2] == 0
    judge(worlds, contacts=deep)
    assert state_of(worlds)[2][2] == 1
    assert worlds.coordinates()[0, 1, 2] > 0.0
    assert (worlds.state.stuck.numpy() == 0).all()


def test_too_many_redrops_end_the_episode(device):
    worlds = made(device, settle={"max_redrops": 2})
    worlds.place(0, 0, [0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0])
    for expected in (Phase.SETTLE, Phase.SETTLE, Phase.OVER):
        judge(worlds)
        assert state_of(worlds)[0] == expected
    assert state_of(worlds)[1] == Ending.UNSETTLED


# ---- ends ----


@pytest.mark.parametrize("phase", [Phase.SETTLE, Phase.ACT])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_pose_that_is_no_number_ends_the_episode(device, phase, value, axis):
    worlds = made(device, worlds=2)
    worlds.begin(phase)
    pose = INSIDE.copy()
    pose[axis] = value
    worlds.place(1, 1, pose)
    arrange.judge_episodes(worlds.scene, worlds.state, worlds.attempts, worlds.observation, worlds.physics)
    assert state_of(worlds, 0)[:2] == (phase, Ending.RUNNING)
    assert state_of(worlds, 1)[:2] == (Phase.OVER, Ending.NOT_FINITE)


@pytest.mark.parametrize("phase", [Phase.SETTLE, Phase.ACT])
@pytest.mark.parametrize(
    ("lost", "ending"),
    [
        (0, Ending.SOLVER_OVERFLOW),
        (Lost.CONTACTS, Ending.CONTACT_OVERFLOW),
        (Lost.PAIRS, Ending.PAIR_OVERFLOW),
        (Lost.PAIRS | Lost.CONTACTS, Ending.PAIR_OVERFLOW),
    ],
)
def test_an_overflow_ends_the_episode(device, phase, lost, ending):
    worlds = made(device, worlds=2)
    worlds.begin(phase)
    worlds.set(worlds.physics.solver.constraint_overflow, [True, False])
    worlds.set(worlds.physics.lost, [lost, 0])
    arrange.judge_episodes(worlds.scene, worlds.state, worlds.attempts, worlds.observation, worlds.physics)
    assert state_of(worlds, 0)[:2] == (Phase.OVER, ending)
    assert state_of(worlds, 1)[:2] == (phase, Ending.RUNNING)
    assert not worlds.physics.lost.numpy().any()


def test_a_gripper_that_has_been_everywhere_ends_the_episode(device):
    worlds = made(device, worlds=2)
    worlds.begin(Phase.ACT)
    worlds.set(worlds.state.waypoint, [worlds.scene.move.waypoints - 1, worlds.scene.move.waypoints])
    arrange.judge_episodes(worlds.scene, worlds.state, worlds.attempts, worlds.observation, worlds.physics)
    assert state_of(worlds, 0)[:2] == (Phase.ACT, Ending.RUNNING)
    assert state_of(worlds, 1)[:2] == (Phase.OVER, Ending.FINISHED)


def test_worlds_without_an_episode_end_none(device):
    for phase in (Phase.EMPTY, Phase.IDLE, Phase.OVER):
        worlds = made(device)
        worlds.begin(phase)
        worlds.set(worlds.physics.solver.constraint_overflow, True)
        arrange.judge_episodes(worlds.scene, worlds.state, worlds.attempts, worlds.observation, worlds.physics)
        assert state_of(worlds)[:2] == (phase, Ending.RUNNING)


def test_what_counts_as_through_the_floor_is_thinner_than_its_collision_shape():
    from synpick_warp.scenes.tote import FLOOR_DEPTH

    assert -FLOOR_DEPTH < float(rest.BELOW_FLOOR) < 0.0
