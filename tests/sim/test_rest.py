"""When a pile rests, what is dropped again, and how episodes end: scripted bodies, without a physics engine; and what a snapshot says
of the frame before, whose poses it holds at rest."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from synpick_warp.codes import Ending, Lost, Phase, Stream
from synpick_warp.kernels.sim import rest
from synpick_warp.kernels.sim import snapshot as snapshots
from synpick_warp.kernels.structs import CatalogData
from synpick_warp.scenes.bins import FLOOR_DEPTH
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import LastFrame, Snapshot
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim import arrange
from synpick_warp.system.hardware.device import pick_device
from tests.harness.environment import default_device
from tests.twins import rng
from tests.worlds.kernel_worlds import SHAPES, KernelWorlds

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
    result.put(catalog_index=entry, body_slot=slot, progress=[0, 0, 0, 1], previous_pose=INSIDE)
    result.put(body_q=INSIDE)
    return result


def touch(worlds: KernelWorlds, contacts: list[dict], room: int = 8) -> None:
    """Give the pipeline's contacts; what a contact leaves open is zero."""
    values = {"normal": ((0, 0, 1), wp.vec3)} | dict.fromkeys(("shape0", "shape1"), (-1, int))
    values |= dict.fromkeys(("point0", "point1"), ((0, 0, 0), wp.vec3)) | dict.fromkeys(("margin0", "margin1"), (0, float))
    for name, (default, dtype) in values.items():
        rows = np.array([contact.get(name, default) for contact in contacts] + [default] * (room - len(contacts)))
        setattr(worlds.physics.contacts, f"rigid_contact_{name}", wp.array(rows, dtype=dtype, device=worlds.device))
    worlds.physics.contacts.rigid_contact_max = room
    worlds.physics.contacts.rigid_contact_count = wp.array([len(contacts)], dtype=int, device=worlds.device)


def judge(worlds: KernelWorlds, shift: float = 0.0, contacts: list[dict] | None = None, restless: float = 0.0) -> None:
    """One tick in which the first instance of every world moves by `shift`."""
    touch(worlds, contacts or [])
    previous, pose = worlds["previous_pose"], worlds["body_q"].reshape(worlds.worlds, -1, 7)
    previous[:, 0, :3] = pose[:, 2, :3] + [shift, 0.0, 0.0]
    worlds.put(previous_pose=previous)
    worlds.run(arrange.judge_settling, SEED, restless)
    worlds.run(arrange.judge_episodes)


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
    worlds.put(shape_body=bodies)
    pose = turned(2, np.pi / 2)
    worlds.place(0, 0, pose)
    # In the world the body's point is (0, 0.03, 0.05 - 0.04).
    low = {"shape0": 0, "shape1": 4, "point0": (0, 0, 0.02), "point1": (0.03, 0, -0.04)}
    beneath = {"shape1": 0, "normal": (0, 0, -1), "point1": (0, 0, 0.01)}
    thick = beneath | {"shape0": 4, "point0": (0, 0, -0.04), "margin0": 0.002, "margin1": 0.003}
    apart = beneath | {"shape0": 5}
    touch(worlds, [low, thick, apart])
    worlds.run(arrange.measure_penetration)
    expected = np.zeros(worlds.bodies)
    expected[2] = 0.01
    np.testing.assert_allclose(worlds["penetration"], expected, atol=1e-7)
    touch(worlds, [thick])
    worlds.run(arrange.measure_penetration)
    assert worlds["penetration"][2] == pytest.approx(0.005, abs=1e-7)


def test_contact_margins_cover_the_motion_of_a_substep(device):
    """Points of shapes of moving bodies, against their velocities v + ω x r. Bounds hold for a static shape, one too fast, and NaN."""
    random, count, duration, falling, least, most = np.random.default_rng(3), 200, 2e-3, 0.02, 5e-4, 4e-3
    body = np.arange(count) - 1  # The first shape is static.
    place, center = (random.normal(0.0, 0.05, (count, 3)) for _ in range(2))
    radius, twist = random.uniform(0.01, 0.1, count), random.normal(0.0, 1.0, (count, 6)) * random.choice([0.1, 1.0, 9.0], count)[:, None]
    poses = np.hstack([place, np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))])
    gap = wp.zeros(count, dtype=float, device=device)
    rows = [(body, int), (poses, wp.transform), (radius, float), (center, wp.vec3), (twist, wp.spatial_vector)]
    inputs = [least, most, duration, falling, *(wp.array(values, dtype=dtype, device=device) for values, dtype in rows)]
    wp.launch(rest.set_gaps_kernel, dim=count, inputs=inputs, outputs=[gap], device=device)
    direction = random.normal(size=(count, 500, 3))
    points = place[:, None] + radius[:, None, None] * direction / np.linalg.norm(direction, axis=-1, keepdims=True) - center[body][:, None]
    moved = duration * np.linalg.norm(twist[body, None, :3] + np.cross(twist[body, None, 3:], points), axis=-1).max(axis=1)
    found = gap.numpy()[1:]
    assert gap.numpy()[0] == np.float32(least)
    assert (found >= np.minimum(least + duration * falling + moved[1:], most) - 1e-8).all()
    assert 0.1 < (found == np.float32(most)).mean() < 0.9
    assert np.median((found - least)[found < np.float32(most)] / moved[1:][found < np.float32(most)]) < 3.0
    inputs[-1].assign(np.where(np.arange(6) == np.arange(count)[:, None] % 6, np.nan, twist))
    wp.launch(rest.set_gaps_kernel, dim=count, inputs=inputs, outputs=[gap], device=device)
    assert (gap.numpy()[1:] == np.float32(most)).all()


def test_contacts_beyond_the_count_do_not_exist(device):
    worlds = made(device)
    worlds.put(shape_body=2)
    touch(worlds, [{"shape0": 0, "margin0": 0.5}] * 3)
    worlds.physics.contacts.rigid_contact_count.zero_()
    worlds.run(arrange.measure_penetration)
    assert (worlds["penetration"] == 0.0).all()


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
    worlds.put(previous_pose=before)
    worlds.put(body_q=before)
    worlds.place(0, 0, after)
    worlds.run(arrange.measure_displacement)
    assert worlds["displacement"][0, 0] == pytest.approx(np.linalg.norm(move) + angle * worlds.radius[0], abs=2e-5)
    assert worlds["displacement"][0, 1] == pytest.approx(0.0, abs=1e-6)
    worlds.run(arrange.measure_displacement)
    assert worlds["displacement"][0, 0] == pytest.approx(0.0, abs=1e-6)


# ---- rest ----


def test_guides_fall_after_some_ticks_at_rest_and_then_the_gripper_acts(device):
    worlds = made(device)
    settle, seen = worlds.scene.settle, []
    while worlds["phase"][0] == Phase.SETTLE and len(seen) < 20:
        judge(worlds)
        seen.append(worlds.row("phase", "progress"))
    until = max(settle.min_ticks, settle.rest_ticks)
    assert [progress[3] for _, progress in seen] == [1] * (until - 1) + [0] * (settle.rest_ticks + 1)
    assert [phase for phase, _ in seen] == [Phase.SETTLE] * (until + settle.rest_ticks - 1) + [Phase.ACT]
    assert [progress[0] for _, progress in seen] == list(range(1, len(seen) + 1))


@pytest.mark.parametrize(
    ("late", "ticks"),
    [
        (50, [(0.0, 1), (0.0, 2), (2e-4, 0), (0.5e-4, 1), (2e-4, 0), (0.0, 1), (0.0, 2)]),
        (6, [(5e-4, 0)] * 6 + [(5e-4, 1), (2e-3, 0)]),
    ],
    ids=["a motion starts the count again", "late piles may buzz a little"],
)
def test_ticks_at_rest_are_counted(device, late, ticks):
    """Shift of an object in each tick [m], and how many ticks the pile has rested; guide walls stand until the third."""
    worlds = made(device, settle={"min_ticks": 0, "rest_ticks": 3, "late_ticks": late})
    for shift, resting in ticks:
        judge(worlds, shift)
        assert worlds["progress"][0, [1, 3]].tolist() == [resting, 1]
    for _ in range(3 - resting):
        judge(worlds)
    assert worlds["progress"][0, 3] == 0


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
    assert worlds["progress"][0, 1] == rests


def test_an_empty_tote_is_at_rest(device):
    worlds = made(device, objects=0)
    for _ in range(10):
        judge(worlds)
    assert worlds["phase"][0] == Phase.ACT


def test_a_pile_that_never_rests_ends_its_episode(device):
    worlds = made(device, settle={"max_ticks": 7})
    for _ in range(6):
        judge(worlds, 0.01)
        assert worlds.row("phase", "ending") == [Phase.SETTLE, Ending.RUNNING]
    judge(worlds, 0.01)
    assert worlds.row("phase", "ending") == [Phase.OVER, Ending.UNSETTLED]


@pytest.mark.parametrize("phase", [Phase.EMPTY, Phase.ACT, Phase.OVER, Phase.IDLE])
def test_only_settling_worlds_are_judged_for_rest(device, phase):
    worlds = made(device)
    worlds.begin(phase)
    worlds.place(0, 0, [5.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    before = worlds["joint_q"].copy()
    for _ in range(10):
        judge(worlds)
    assert worlds.row("phase", "ending", "progress") == [phase, Ending.RUNNING, [0, 0, 0, 1]]
    np.testing.assert_array_equal(worlds["joint_q"], before)


# ---- dropped again ----


def test_what_leaves_the_tote_is_dropped_again(device):
    worlds = made(device)
    worlds.put(progress=[5, 3, 0, 0], joint_qd=1.0)
    worlds.place(0, 1, [0.26, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0])
    judge(worlds)
    assert worlds.row("progress") == [[6, 0, 1, 1]]
    pose, drop, radius = worlds.coordinates()[0, 1], worlds.scene.drop, worlds.radius[2]
    key = rng.stream_key(SEED, 0, 0, Stream.REDROP)
    share = 2 * rng.uniform(key, np.arange(2)) - 1
    free = np.maximum(0.0, np.array(worlds.bins[0].opening) / 2 - radius)
    np.testing.assert_allclose(pose[:3], [*(share * drop.spread * free), worlds.bins[0].height + radius], atol=1e-6)
    np.testing.assert_allclose(pose[3:], rng.uniform_rotation(key, 2), atol=1e-6)
    speed = worlds["joint_qd"][4:].reshape(-1, 6)
    assert (speed[1] == 0.0).all()
    assert (np.delete(speed, 1, axis=0) == 1.0).all()


def test_objects_dropped_again_together_fall_one_above_the_other_from_poses_of_their_own(device):
    worlds = made(device, objects=4)
    worlds.put(body_q=[0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0])
    judge(worlds)
    assert worlds.row("progress") == [[1, 0, 4, 1]]
    radius = worlds.radius[worlds["catalog_index"][0]]
    poses = worlds.coordinates()[0, :4]
    gaps = np.diff(poses[:, 2]) - radius[1:] - radius[:-1]
    np.testing.assert_allclose(gaps, worlds.scene.drop.clearance, atol=1e-6)
    assert len(np.unique(poses[:, 3].round(6))) == 4


def test_a_stuck_object_is_dropped_again_after_some_time(device):
    worlds = made(device, settle={"min_ticks": 50})
    settle = worlds.scene.settle
    worlds.put(shape_body=np.where(np.arange(SHAPES) == 4, 3, -1))
    height = float(INSIDE[2])
    deep, shallow = ([{"shape0": 4, "shape1": 0, "point1": (0, 0, height), "margin0": share * settle.stuck_depth}] for share in (1.5, 0.5))
    for contacts in [deep] * settle.stuck_ticks + [shallow] + [deep] * settle.stuck_ticks:
        judge(worlds, contacts=contacts)
        assert worlds["progress"][0, 2] == 0
    judge(worlds, contacts=deep)
    assert worlds["progress"][0, 2] == 1
    assert worlds.coordinates()[0, 1, 2] > 0.0
    assert (worlds["stuck"] == 0).all()


def test_too_many_redrops_end_the_episode(device):
    worlds = made(device, settle={"max_redrops": 2})
    worlds.place(0, 0, [0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0])
    for expected in (Phase.SETTLE, Phase.SETTLE, Phase.OVER):
        judge(worlds)
        assert worlds["phase"][0] == expected
    assert worlds["ending"][0] == Ending.UNSETTLED


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
    worlds.run(arrange.judge_episodes)
    assert worlds["phase"].tolist() == [phase, Phase.OVER]
    assert worlds["ending"].tolist() == [Ending.RUNNING, Ending.NOT_FINITE]


@pytest.mark.parametrize("phase", [Phase.SETTLE, Phase.ACT, Phase.EMPTY, Phase.IDLE, Phase.OVER])
@pytest.mark.parametrize(
    ("lost", "ending"),
    [
        (0, Ending.SOLVER_OVERFLOW),
        (Lost.CONTACTS, Ending.CONTACT_OVERFLOW),
        (Lost.PAIRS, Ending.PAIR_OVERFLOW),
        (Lost.PAIRS | Lost.CONTACTS, Ending.PAIR_OVERFLOW),
    ],
)
def test_an_overflow_ends_the_episode_that_a_world_has(device, phase, lost, ending):
    worlds = made(device, worlds=2)
    worlds.begin(phase)
    worlds.put(constraint_overflow=[True, False], lost=[lost, 0])
    worlds.run(arrange.judge_episodes)
    runs = phase in (Phase.SETTLE, Phase.ACT)
    assert worlds["phase"].tolist() == [Phase.OVER if runs else phase, phase]
    assert worlds["ending"].tolist() == [ending if runs else Ending.RUNNING, Ending.RUNNING]
    assert not worlds["lost"].any()


def test_a_gripper_that_has_been_everywhere_ends_the_episode(device):
    worlds = made(device, worlds=2)
    worlds.begin(Phase.ACT)
    worlds.put(waypoint=[worlds.scene.move.waypoints - 1, worlds.scene.move.waypoints])
    worlds.run(arrange.judge_episodes)
    assert worlds["phase"].tolist() == [Phase.ACT, Phase.OVER]
    assert worlds["ending"].tolist() == [Ending.RUNNING, Ending.FINISHED]


def test_what_counts_as_through_the_floor_is_thinner_than_its_collision_shape():
    assert -FLOOR_DEPTH < float(rest.BELOW_FLOOR) < 0.0


# ---- the frame before ----

LINKED_WORLDS = 3
SIZES = {"world": LINKED_WORLDS, "instance": 2, "fixture": 3}
KEPT = ("catalog_index", "pose", "fixture_pose", "fixture_visible")
TICK = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 2), st.integers(-1, 3)), min_size=LINKED_WORLDS, max_size=LINKED_WORLDS)
"""live, episode and frame of each world."""


class Linked:
    """Snapshots one after the other, told by their number: tick t of world w puts t + 10 w into every array."""

    def __init__(self) -> None:
        self.device = pick_device(default_device())
        self.last, self.count = allocate(LastFrame, SIZES, self.device), 0
        self.catalog = CatalogData()
        self.catalog.radius = wp.full(32, 0.1, dtype=float, device=self.device)

    def tick(self, worlds: list[tuple[int, int, int]]) -> Snapshot:
        self.count += 1
        made = allocate(Snapshot, SIZES, self.device)
        for column, name in enumerate(("live", "episode", "frame")):
            getattr(made, name).assign(np.array([row[column] for row in worlds]))
        for name in KEPT:
            values = getattr(made, name).numpy()
            values[:] = (self.count + 10 * np.arange(LINKED_WORLDS)).reshape(LINKED_WORLDS, *(1,) * (values.ndim - 1))
            getattr(made, name).assign(values)
        launch(snapshots.link_frames_kernel, LINKED_WORLDS, made, self.last, catalog=self.catalog)
        return made


@given(st.lists(TICK, min_size=1, max_size=6))
@examples(max_examples=30)
def test_every_snapshot_has_the_one_before_beside_it(script):
    linked, before = Linked(), [(0, 0, 0)] * LINKED_WORLDS
    for number, worlds in enumerate(script):
        made = linked.tick(worlds)
        pairs = zip(worlds, before, strict=True)
        expected = [now[0] and was[0] and now[1] == was[1] and now[2] == was[2] + 1 for now, was in pairs]
        assert made.follows.numpy().tolist() == expected
        for name in KEPT:
            values = getattr(made, f"last_{name}").numpy().reshape(LINKED_WORLDS, -1)
            told = number + 10 * np.arange(LINKED_WORLDS) if number else np.zeros(LINKED_WORLDS)
            np.testing.assert_array_equal(values, np.broadcast_to(told[:, None], values.shape))
        before = worlds


@pytest.mark.parametrize(
    ("moved", "turned", "held"), [(0.0, 0.0, True), (9e-6, 0.0, True), (1.1e-5, 0.0, False), (0.0, 9e-5, True), (0.0, 1.1e-4, False)]
)
def test_poses_are_held_until_a_point_moves_by_10_um(moved, turned, held):
    """Of an object whose points lie within 0.1 m of its origin."""
    linked = Linked()
    first = linked.tick([(1, 0, 0)] * LINKED_WORLDS)
    first.catalog_index.zero_()
    poses = np.tile(np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0], np.float32), (LINKED_WORLDS, 2, 1))
    linked.last.pose.assign(poses)
    linked.last.catalog_index.zero_()
    made = allocate(Snapshot, SIZES, linked.device)
    made.live.fill_(1)
    made.frame.fill_(1)
    now = poses + np.array([moved, 0.0, 0.0, np.sin(turned / 2), 0.0, 0.0, np.cos(turned / 2) - 1.0], np.float32)
    made.pose.assign(now)
    launch(snapshots.link_frames_kernel, LINKED_WORLDS, made, linked.last, catalog=linked.catalog)
    np.testing.assert_array_equal(made.pose.numpy(), poses if held else now)
    np.testing.assert_array_equal(made.last_pose.numpy(), poses)
    np.testing.assert_array_equal(linked.last.pose.numpy(), made.pose.numpy())
