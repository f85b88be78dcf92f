"""Seals in the real physics: force, break and swing; and their wrench against a NumPy twin."""

from functools import reduce
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from synpick_warp.configs.files.load import load_config
from synpick_warp.kernels.structs import SuctionData
from synpick_warp.scenes import build
from synpick_warp.stages.sim import physics
from synpick_warp.stages.sim.behavior import ArrayHold, SuctionHold
from tests.sim.test_suction import ARM, SQUARE
from tests.twins import suction as twin
from tests.worlds.hanging import Hanging
from tests.worlds.kernel_worlds import GRIPPER_DOFS, KernelWorlds, filled
from tests.worlds.small_worlds import CUBE, catalog

GRAVITY = 9.81
# Masses of the object table [kg], the lightest to the heaviest.
MASSES = np.sort([row.mass for row in load_config("synpick", {}).object_rows])
LIFT = 0.5


def size_of(mass: float) -> tuple[float, float, float]:
    """A bar, a box or a large box [m]."""
    return (0.12, 0.02, 0.02) if mass < 0.1 else (0.1, 0.07, 0.05) if mass < 0.5 else (0.25, 0.1, 0.07)


def under(hanging: Hanging, share: float = 0.0) -> np.ndarray:
    """Centres of objects whose upper side touches the TCP at an offset from its middle: a fraction of half their length."""
    place = np.zeros((hanging.worlds, hanging.instances, 3))
    place[..., 0] = share * hanging.size[..., 0] / 2
    place[..., 2] = -hanging.size[..., 2] / 2
    return place


@pytest.fixture(scope="module")
def table(device) -> Hanging:
    """A world for every mass of the object table."""
    return Hanging(device, MASSES[:, None], [[size_of(mass)] for mass in MASSES])


# ---- what a seal bears ----


def test_at_rest_the_seal_force_is_the_weight_and_a_good_seal_lifts_everything(table):
    assert (len(MASSES), *MASSES[[0, -1]]) == pytest.approx((21, 0.016, 1.131))
    table.start(under(table))
    seal_force = table.run(150)[-50:, :, 0]
    assert (np.abs(seal_force / (MASSES * GRAVITY) - 1.0) < 0.03).all()
    table.speed[2] = LIFT
    seal_force = table.run(130)[:, :, 0]
    assert (table.seals.attached.numpy() == 1).all()
    # Up to speed, without slack: more than the weight, and then the weight again.
    assert (seal_force.max(axis=0) > 1.2 * MASSES * GRAVITY).all()
    assert (np.abs(seal_force[-1] / (MASSES * GRAVITY) - 1.0) < 0.1).all()
    poses, velocity = table.bodies()
    np.testing.assert_allclose(velocity[:, 2, 2], LIFT, rtol=0.03)
    # Stretched by no more than the paper's compliance.
    tcp = poses[:, 1, 2] - table.config.gripper.cup_length
    np.testing.assert_allclose(poses[:, 2, 2] + table.size[:, 0, 2] / 2, tcp, atol=5e-3)
    np.testing.assert_allclose(table.seals.peak.numpy()[:, 0], seal_force.max(axis=0), rtol=1e-5)


def test_a_poor_seal_holds_the_marker_and_drops_what_is_heavy(table):
    table.start(under(table), break_force=2.0)
    table.speed[2] = LIFT
    seal_force = table.run(150)[:, :, 0]
    np.testing.assert_array_equal(table.seals.peak.numpy()[:, 0], seal_force.max(axis=0))
    attached = table.seals.attached.numpy()[:, 0]
    assert attached[0] == 1
    assert (attached[MASSES > 0.21] == 0).all()
    # Heavier objects break off sooner: the attached ones are the lightest.
    assert (np.diff(attached) <= 0).all()
    # The force that breaks a seal is recorded, too: in one step of each object that is dropped.
    assert (np.sort(seal_force, axis=0)[-2] <= 2.0).all()
    assert (table.seals.peak.numpy()[:, 0][attached == 0] > 2.0).all()
    assert (table.seals.peak.numpy()[:, 0][attached == 1] <= 2.0).all()
    # Dropped objects feel no force any more, and fall.
    force = table.physics.control.joint_f.numpy().reshape(len(MASSES), -1)[:, build.GRIPPER_DOFS :]
    assert (force[attached == 0] == 0.0).all()
    assert (table.seals.seal_force.numpy()[attached == 0] == 0.0).all()
    _, velocity = table.bodies()
    assert (velocity[attached == 0, 2, 2] < -0.2).all()
    assert velocity[0, 2, 2] == pytest.approx(LIFT, rel=0.1)


def test_what_hangs_by_its_edge_swings_little_more_than_the_limit(device):
    masses = np.array([1.131, 0.729, 0.411, 0.066])
    sizes = [(0.25, 0.1, 0.07), (0.2, 0.09, 0.09), (0.21, 0.16, 0.06), (0.18, 0.04, 0.04)]
    hanging = Hanging(device, masses[:, None], [[size] for size in sizes])
    hanging.start(under(hanging, 0.9))
    limit = hanging.config.suction.swing_limit
    most = np.zeros(4)
    for _ in range(60):
        hanging.run(4)
        most = np.maximum(most, hanging.swing())
    assert (most > limit).all()
    assert (most < limit + 5.0).all()
    hanging.run(60)
    assert (hanging.swing() < limit + 2.0).all()
    assert (hanging.seals.attached.numpy() == 1).all()
    np.testing.assert_allclose(hanging.seals.seal_force.numpy()[:, 0], masses * GRAVITY, rtol=0.03)


# ---- momentum and energy ----


THREE = {"gripper__kind": "suction_array", "gripper__cups": [[-0.05, 0.0], [0.0, 0.04], [0.05, 0.0]]}


@pytest.fixture(scope="module")
def floating(device, request) -> Hanging:
    """The lightest and the heaviest object, without weight, on grippers that nothing holds; on one cup, or on three."""
    hanging = Hanging(device, [[0.016], [1.131]], [[(0.12, 0.02, 0.02)], [(0.2, 0.08, 0.06)]], physics__gravity=0.0, **request.param)
    hanging.carried = False
    return hanging


SEALS = ((2e4, 100.0, 50.0), (1e6, 0.0, 500.0), (2e3, 100.0, 5.0))
"""Stiffness, damping and stiffness of twist."""


@pytest.mark.parametrize(
    ("floating", "stiffness", "damping", "twist"), [*(({}, *seal) for seal in SEALS), (THREE, *SEALS[0])], indirect=["floating"]
)
def test_wrenches_are_opposite_and_give_no_energy(floating, stiffness, damping, twist):
    """A pushed and spinning object takes its gripper along: the momentum stays, energy goes, at last both move as one."""
    filled(floating.scene.suction, {"stiffness": stiffness, "damping": damping, "twist_stiffness": twist})
    floating.start(under(floating, 0.4), break_force=1e9)
    speeds = floating.physics.state.joint_qd.numpy().reshape(2, -1)
    speeds[:, build.GRIPPER_DOFS : build.GRIPPER_DOFS + 6] = (0.3, -0.2, 0.1, 1.0, 2.0, 3.0)
    floating.physics.state.joint_qd.assign(speeds.reshape(-1))
    floating.physics.refresh_poses()
    energy, momentum = floating.energy(), floating.momentum()
    most = np.zeros(2)
    for _ in range(100):
        floating.run(1)
        most = np.maximum(most, floating.energy())
    assert (most <= energy * (1 + 1e-3)).all()
    np.testing.assert_allclose(floating.momentum(), momentum, atol=2e-6)
    floating.run(50)
    together = (momentum**2).sum(axis=1) / (2 * (floating.mass[:, 0] + floating.gripper_mass))
    assert (floating.energy() < together + 0.05 * energy).all()


# ---- several objects, contacts ----


@pytest.fixture(scope="module")
def pair(device) -> Hanging:
    """Two objects on each cup: side by side, and one much heavier than the other."""
    return Hanging(device, [[0.4, 0.4], [0.016, 1.131]], [[(0.05, 0.05, 0.05)] * 2, [(0.04, 0.02, 0.02), (0.08, 0.05, 0.05)]])


def beside(hanging: Hanging) -> np.ndarray:
    """Centres of two objects below the TCP with a gap of 2 mm between them."""
    place = under(hanging)
    place[:, 0, 0], place[:, 1, 0] = -hanging.size[:, 0, 0] / 2 - 1e-3, hanging.size[:, 1, 0] / 2 + 1e-3
    return place


def test_two_objects_hang_on_one_cup_and_break_off_alone(pair):
    pair.start(beside(pair))
    pair.run(150)
    # They lean on one another as they swing in: together they weigh what they weigh.
    assert (pair.seals.attached.numpy() == 1).all()
    seal_force = pair.run(50).mean(axis=0)
    assert seal_force.sum(axis=1) == pytest.approx(pair.mass.sum(axis=1) * GRAVITY, rel=0.1)
    assert np.abs(pair.bodies()[1][:, 2:, :3]).max() < 0.01
    pair.seals.break_force.fill_(2.0)
    pair.run(1)
    assert pair.seals.attached.numpy().tolist() == [[0, 0], [1, 0]]
    pair.run(30)
    assert pair.seals.attached.numpy().tolist() == [[0, 0], [1, 0]]
    assert pair.bodies()[1][1, 3, 2] < -0.4
    assert abs(pair.bodies()[1][1, 2, 2]) < 0.1


def test_a_cup_does_not_push_away_what_it_holds(pair):
    """An object attached 3 mm deep in the cup hangs like any other, and the seal force is its weight; contacts would push it out."""
    place = under(pair)
    place[:, 0, 2] += 3e-3
    place[:, 1, 0] = 0.5
    weight = pair.mass[:, 0] * GRAVITY
    try:
        for pair.ignoring in (False, True):
            pair.start(place)
            pair.seals.attached.assign(np.array([[1, 0], [1, 0]]))
            seal_force = pair.run(60)[-1, :, 0]
            assert (seal_force == pytest.approx(weight, rel=0.03)) == pair.ignoring
    finally:
        pair.ignoring = True
    poses, _ = pair.bodies()
    low = poses[:, 1, 2] - pair.config.gripper.cup_length - pair.size[:, 0, 2] / 2 - poses[:, 2, 2]
    assert low == pytest.approx(-3e-3 + weight / pair.config.suction.stiffness, abs=3e-4)


def test_attached_objects_touch_each_other_and_detached_ones_touch_the_cup(pair):
    """Of the contacts between bodies, exactly those of a cup with its attached objects are disabled."""
    place = beside(pair)
    place[..., 2] += 1e-3
    pair.start(place)
    pair.seals.attached.assign(np.array([[1, 0], [1, 1]]))
    pair.physics.pipeline.collide(pair.physics.state, pair.physics.contacts)

    def pairs() -> list[tuple[int, int]]:
        contacts, shape_body = pair.physics.contacts, pair.physics.model.shape_body.numpy()
        count = int(contacts.rigid_contact_count.numpy()[0])
        shapes = np.stack([contacts.rigid_contact_shape0.numpy(), contacts.rigid_contact_shape1.numpy()])[:, :count]
        near = contacts.rigid_contact_margin0.numpy()[:count] > -physics.CONTACT_GAP
        return sorted({(int(min(column)), int(max(column))) for column in shape_body[shapes][:, near].T})

    one = pair.layout.bodies_per_world
    cup, first, second = 1, 2, 3
    both = {(one + cup, one + first), (one + cup, one + second)}
    before = pairs()
    assert {(cup, first), (cup, second), (first, second)} | both <= set(before)
    pair.suction.ignore_contacts(pair.scene, pair.state, pair.seals, pair.physics)
    assert set(pairs()) == set(before) - {(cup, first)} - both


# ---- several cups on one tool ----

TRIANGLE = [[ARM * np.cos(angle), ARM * np.sin(angle)] for angle in 2 * np.pi * np.arange(3) / 3]
BOX_MASS, SIZE = 2.0, (0.2, 0.16, 0.05)
STEPS = 200
"""Until what hangs is at rest."""


def hanging(device, cups, offsets=((0.0, 0.0),), **overrides) -> Hanging:
    """One world per horizontal offset [m] between a box's centre and the axis of the tool, which holds the box by its top face."""
    array = {"gripper__kind": "suction_array", "gripper__cups": [list(map(float, place)) for place in cups]}
    result = Hanging(device, [[BOX_MASS]] * len(offsets), [[SIZE]] * len(offsets), **array, **overrides)
    result.start(np.array([[[*offset, -SIZE[2] / 2]] for offset in offsets]))
    return result


def loads(cups, offset, held) -> np.ndarray:
    """Loads [N] of linear springs at the cups that hold: a plane over their places, with the weight's force and moments."""
    places = np.asarray(cups, float)[held]
    basis = np.column_stack([np.ones(len(places)), places])
    result = np.zeros(len(cups))
    result[held] = basis @ (np.linalg.pinv(basis.T @ basis) @ np.array([1.0, *offset])) * BOX_MASS * GRAVITY
    return result


@pytest.mark.parametrize("cups", [TRIANGLE, [*SQUARE, [0.0, 0.0]]])
def test_cups_about_the_middle_of_a_box_bear_equal_shares(device, cups):
    world = hanging(device, cups)
    largest = world.run(STEPS)[-1, 0, 0]
    np.testing.assert_allclose(world.seals.cup_force.numpy()[0], BOX_MASS * GRAVITY / len(cups), rtol=0.01)
    assert largest == world.seals.cup_force.numpy().max()


PLACES = [
    ((0.01, 0.005), [0, 1, 2, 3]),
    ((-0.015, 0.0), [0, 1, 2, 3]),
    ((-0.01, 0.01), [0, 1, 2]),
    ((0.01, -0.01), [0, 2, 3]),
    ((0.0, 0.0), [0, 2]),
]
"""Offset of a box's centre, and cups that hold it."""


@pytest.mark.parametrize("breaks", [False, True], ids=["missed", "broken"])
def test_loads_balance_the_moments_where_cups_miss_or_have_broken_off(device, breaks):
    """Cups that never held, and cups that break off in the first steps, leave the same loads to the others."""
    expected = np.array([loads(SQUARE, offset, held) for offset, held in PLACES])
    np.testing.assert_allclose(expected.sum(axis=1), BOX_MASS * GRAVITY)
    bits = [[sum(1 << cup for cup in held)] for _, held in PLACES]
    world = hanging(device, SQUARE, [offset for offset, _ in PLACES])
    if breaks:
        world.seals.break_force.assign(np.array([np.where(np.isin(np.arange(4), held), 1e3, 1e-3) for _, held in PLACES]))
    else:
        world.seals.attached.assign(np.array(bits))
    world.run(STEPS)
    assert world.seals.attached.numpy().tolist() == bits
    np.testing.assert_allclose(world.seals.cup_force.numpy(), expected, atol=0.01 * BOX_MASS * GRAVITY)


def test_where_one_seal_of_a_common_valve_breaks_the_others_are_poor(device):
    world = hanging(device, SQUARE, gripper__valve="common")
    world.seals.break_force.assign(np.array([[40.0, 40.0, 40.0, 1.0]]))
    world.run(STEPS)
    assert world.seals.attached.numpy().tolist() == [[0]]
    assert world.bodies()[0][0, 2, 2] < 0.5


# ---- the law ----


def test_settings_of_the_seal_are_numbers_alone():
    """With an array in the struct, a GPU's compiler fuses other products with sums: the last bits of picks change."""
    assert {member.type for member in SuctionData.vars.values()} <= {int, float, wp.int32, wp.float32}


LAW = {
    "stiffness": 2e4,
    "damping": 100.0,
    "twist_stiffness": 50.0,
    "twist_damping": 0.1,
    "swing_limit": np.radians(5.0),
    "swing_stiffness": 50.0,
    "finger_mass": 1.5,
    "cup_mass": 0.5,
    "tilt_inertia": 0.4,
    "step": 2e-3,
}
SLOTS = (3, 0, 2)
TIP = 0.055


def scripted(
    device, bodies: list[twin.Body], objects_in_tcp: np.ndarray, attached: list[int], break_force: float, cups=((0.0, 0.0),)
) -> KernelWorlds:
    """One world with a moving gripper and three moving objects in the slots SLOTS."""
    worlds = KernelWorlds(device, 1, instances=3, single_slots=4, move={"tcp_offset": TIP}, cups=cups)
    filled(worlds.scene.suction, LAW)
    rows = [1, *(2 + slot for slot in SLOTS)]
    columns = {
        "body_q": (wp.transform, (7,), [body.pose for body in bodies]),
        "body_qd": (wp.spatial_vector, (6,), [body.velocity for body in bodies]),
        "body_com": (wp.vec3, (3,), [body.center for body in bodies]),
        "body_inv_mass": (float, (), [1 / body.mass for body in bodies]),
        "body_inv_inertia": (wp.mat33, (3, 3), [np.linalg.inv(body.inertia) for body in bodies]),
    }
    for name, (dtype, shape, values) in columns.items():
        full = np.zeros((worlds.bodies, *shape), np.float32)
        full[rows] = values
        owner = worlds.physics.state if name in ("body_q", "body_qd") else worlds.physics.model
        setattr(owner, name, wp.array(full, dtype=dtype, device=device))
    worlds.put(body_slot=SLOTS, object_in_tcp=objects_in_tcp, attached=attached, break_force=break_force)
    worlds.put(seal_force=9.0, peak=[1.0, 0.0], joint_f=7.0)
    return worlds


def random_bodies(seed: int) -> tuple[list[twin.Body], np.ndarray]:
    """A cup and three objects of random masses, near their poses of attachment, all moving."""
    numbers = np.random.default_rng(seed)

    def quaternion(size: float) -> np.ndarray:
        q = np.append(size * numbers.normal(size=3), 1.0)
        return q / np.linalg.norm(q)

    bodies, objects_in_tcp = [], []
    for index in range(4):
        mass = 10 ** numbers.uniform(-1.8, 0.1)
        spread = numbers.normal(scale=0.03, size=(8, 3))
        inertia = mass * (np.trace(spread.T @ spread) * np.eye(3) - spread.T @ spread) / 8
        pose = np.concatenate([numbers.normal(size=3), quaternion(1.0)])
        if index > 0:
            objects_in_tcp.append(np.concatenate([numbers.normal(scale=0.05, size=3), quaternion(1.0)]))
            moved = [*numbers.normal(scale=5e-4, size=3), *quaternion(0.05)]
            pose = np.array(reduce(_times, (bodies[0].pose, [0, 0, -TIP, 0, 0, 0, 1], moved, objects_in_tcp[-1])))
        velocity = np.concatenate([numbers.normal(scale=0.05, size=3), numbers.normal(scale=0.3, size=3)])
        center = numbers.normal(scale=0.02, size=3)
        bodies.append(twin.Body(pose, velocity, mass, inertia, center))
    return bodies, np.array(objects_in_tcp)


def _times(a, b) -> list[float]:
    """Product of two poses."""
    turn = Rotation.from_quat(a[3:])
    return [*(np.asarray(a[:3]) + turn.apply(b[:3])), *(turn * Rotation.from_quat(b[3:])).as_quat()]


ONE, ROW = ((0.0, 0.0),), ((0.05, 0.01), (-0.03, 0.04), (0.02, -0.04))
"""Places of cups [m]."""


@given(
    seed=st.integers(0, 10_000),
    tool=st.sampled_from(
        [(hold, ONE, attached) for hold in (SuctionHold, ArrayHold) for attached in ([1, 0, 0], [0, 1, 1], [1, 1, 1])]
        + [(ArrayHold, ROW, attached) for attached in ([7, 0, 0], [0, 5, 2], [4, 7, 3])]
    ),
    break_force=st.sampled_from([1e6, 5.0]),
)
@settings(max_examples=40)
def test_wrenches_are_those_of_the_twin_and_detached_objects_feel_none(seed, tool, break_force, device):
    hold, cups, attached = tool
    bodies, objects_in_tcp = random_bodies(seed)
    worlds = scripted(device, bodies, objects_in_tcp, attached, break_force, cups)
    expected = np.full(worlds.dofs, 7.0)
    seal_forces, cup_forces, kept, peak_force = [0.0] * 3, np.zeros(len(cups)), list(attached), 1.0
    for instance in np.flatnonzero(attached):
        held = [cup for cup in range(len(cups)) if attached[instance] >> cup & 1]
        seals = twin.seal_wrenches(
            bodies[0],
            bodies[1 + instance],
            objects_in_tcp[instance],
            SimpleNamespace(**LAW, tcp_offset=TIP),
            np.count_nonzero(attached),
            np.array(cups)[held],
        )
        first = GRIPPER_DOFS + 6 * SLOTS[instance]
        expected[first : first + 6] = 0.0
        for cup, (force, reaction, seal_force) in zip(held, seals, strict=True):
            breaks = seal_force > break_force
            expected[first : first + 6] += 0.0 if breaks else force
            expected[:GRIPPER_DOFS] += 0.0 if breaks else reaction
            kept[instance] -= int(breaks) << cup
            cup_forces[cup] += seal_force
            seal_forces[instance] = max(seal_forces[instance], seal_force)
        peak_force = max(peak_force, seal_forces[instance])
    meshes = SimpleNamespace(id=wp.zeros(1, dtype=wp.uint64, device=device))
    suction = hold(load_config("smoke", {}).suction, catalog(CUBE), SimpleNamespace(meshes=meshes, keep=()), device)
    worlds.run(suction.apply_forces)
    # Offsets are differences of positions of about 1 m in single precision: the spring multiplies their rounding.
    atol = 1e-4 * np.abs(expected).max() + LAW["stiffness"] * np.finfo(np.float32).eps
    np.testing.assert_allclose(worlds["joint_f"], expected, rtol=3e-4, atol=atol)
    np.testing.assert_allclose(worlds["seal_force"][0], seal_forces, rtol=3e-4, atol=atol)
    np.testing.assert_allclose(worlds["cup_force"][0], cup_forces, rtol=3e-4, atol=atol)
    assert worlds["attached"][0].tolist() == kept
    assert worlds["peak"][0, 0] == pytest.approx(peak_force, rel=3e-4, abs=atol)
    assert worlds["peak"][0, 1] == pytest.approx(max(seal_forces) / break_force, rel=3e-4, abs=atol)
