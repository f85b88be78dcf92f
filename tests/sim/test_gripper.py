"""The gripper: force law, corners and setpoint, without a physics engine; then simulated under its drive, alone in worlds: free, following,
against wall and floor; and how its joints turn and tilt."""

import itertools
from types import SimpleNamespace

import newton
import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Mode, Phase, Task
from synpick_warp.configs.schema import Config
from synpick_warp.kernels.sim.gripper import impedance_force
from synpick_warp.scenes import build
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.constants import make_scene_data
from synpick_warp.stages.perception.images import Plan
from synpick_warp.stages.sim import arrange, gripper
from synpick_warp.stages.sim.physics import Physics
from synpick_warp.stages.sim.worlds import AttemptState, WorldState, world_sizes
from tests.harness.probe import probe
from tests.twins import suction as twin
from tests.twins.raycast import rotation_of
from tests.worlds.kernel_worlds import KernelWorlds
from tests.worlds.small_worlds import CUBE, catalog, settings

SEED = 5
CORNER = np.array([0.2, 0.1, 0.02])
TIP = 0.05


def made(device, worlds: int = 1, **move) -> KernelWorlds:
    result = KernelWorlds(device, worlds, move={"tcp_offset": TIP, **move})
    result.put(frame=-1)
    return result


# ---- the law ----

impedance_forces = probe(impedance_force)
vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


@given(
    offset=vectors,
    velocity=vectors,
    stiffness=st.floats(1.0, 1e5),
    damping=st.floats(0.0, 1e3),
    limit=st.floats(0.1, 1e3),
    mass=st.floats(0.05, 50.0),
    step=st.floats(1e-4, 2e-2),
)
def test_the_force_is_the_twins_and_never_above_the_limit(offset, velocity, stiffness, damping, limit, mass, step, device):
    values = [stiffness, damping, limit, mass, step]
    found = impedance_forces(offset, velocity, *values, device=device)
    np.testing.assert_allclose(found, twin.force(offset, velocity, *values), rtol=2e-3, atol=2e-4 * limit)
    assert np.linalg.norm(found) <= limit * (1 + 1e-5)


@pytest.mark.parametrize("mass", [1e-3, 0.15, 2.0])
@pytest.mark.parametrize("step", [5e-4, 2e-3, 2e-2])
def test_the_law_is_stable_for_every_mass(device, mass, step):
    """Where an explicit spring would explode: energy of a free mass on it never grows."""
    x, v = np.zeros(3), np.zeros(3)
    setpoint = np.array([0.02, -0.01, 0.005])
    energies = []
    for _ in range(60):
        force = impedance_forces(setpoint - x, v, 1e4, 0.0, 1e6, mass, step, device=device).astype(float)
        v = v + step * force / mass
        x = x + step * v
        energies.append(0.5e4 * np.sum((setpoint - x) ** 2) + 0.5 * mass * np.sum(v**2))
    assert (np.diff(energies) <= 1e-5 * energies[0]).all()


# ---- corners and setpoint ----


@pytest.mark.parametrize("rounds", [1, 3])
def test_every_round_visits_every_corner_in_the_twins_order(device, rounds):
    worlds = made(device, worlds=200, waypoints=4 * rounds)
    worlds.begin(Phase.ACT, 1000 + np.arange(200), 2)
    worlds.run(gripper.begin_moving, SEED)
    order = worlds["corner_order"]
    assert (np.sort(order.reshape(200, rounds, 4), axis=2) == np.arange(4)).all()
    assert order.tolist() == [twin.corner_order(SEED, 1000 + world, 2, rounds) for world in range(200)]
    _, counts = np.unique(order[:, :4], axis=0, return_counts=True)
    assert len(counts) == 24  # Every order of four comes, about 200 / 24 times.
    assert counts.max() < 25


def test_the_gripper_starts_above_the_first_corner_at_rest(device):
    worlds = made(device, worlds=50, start_height=0.3)
    worlds.begin(Phase.ACT)
    worlds.put(joint_qd=1.0, waypoint=3)
    worlds.run(gripper.begin_moving, SEED)
    first = np.stack([twin.corner_place(code, CORNER) for code in worlds["corner_order"][:, 0]])
    first[:, 2] = 0.3 + TIP
    np.testing.assert_allclose(worlds["setpoint"], first, atol=1e-6)
    np.testing.assert_allclose(worlds["joint_q"].reshape(50, -1)[:, :3], first, atol=1e-6)
    speed = worlds["joint_qd"].reshape(50, -1)
    assert (speed[:, :4] == 0.0).all()
    assert (speed[:, 4:] == 1.0).all()
    assert (worlds["waypoint"] == 0).all()


def test_frames_count_while_the_gripper_acts(device):
    worlds = made(device, worlds=2)
    seen = []
    for phase in (Phase.SETTLE, Phase.ACT, Phase.ACT, Phase.ACT, Phase.OVER, Phase.SETTLE, Phase.ACT):
        worlds.begin(phase)
        worlds.run(gripper.begin_moving, SEED)
        seen.append(int(worlds["frame"][1]))
    assert seen == [-1, 0, 1, 2, -1, -1, 0]


def test_an_order_once_drawn_is_kept(device):
    worlds = made(device)
    worlds.begin(Phase.ACT)
    worlds.run(gripper.begin_moving, SEED)
    before = worlds["corner_order"].copy()
    worlds.put(setpoint=7.0)
    worlds.begin(Phase.ACT, [99])
    worlds.run(gripper.begin_moving, SEED)
    np.testing.assert_array_equal(worlds["corner_order"], before)
    assert (worlds["setpoint"] == 7.0).all()


def test_the_setpoint_walks_from_corner_to_corner_at_constant_speed(device):
    worlds = made(device, waypoints=4, speed=0.5, step=0.01, start_height=0.1)
    worlds.begin(Phase.ACT)
    worlds.run(gripper.begin_moving, SEED)
    setpoints, waypoints = [worlds["setpoint"][0].copy()], [0]
    while waypoints[-1] < 4 and len(setpoints) < 1000:
        worlds.run(gripper.drive_gripper)
        setpoints.append(worlds["setpoint"][0].copy())
        waypoints.append(int(worlds["waypoint"][0]))
    strides = np.linalg.norm(np.diff(setpoints, axis=0), axis=1)
    arrivals = np.flatnonzero(np.diff(waypoints)) + 1
    assert np.delete(strides, arrivals - 1) == pytest.approx(0.005, abs=1e-6)
    assert (strides[arrivals - 1] <= 0.005 + 1e-6).all()
    places = [twin.corner_place(code, np.add(CORNER, (0, 0, TIP))) for code in worlds["corner_order"][0]]
    np.testing.assert_allclose(np.array(setpoints)[arrivals], places, atol=1e-6)
    legs = [np.linalg.norm(b - a) for a, b in itertools.pairwise([setpoints[0], *places])]
    # A step more where rounding leaves a sliver of the way.
    assert len(setpoints) - 1 == pytest.approx(sum(np.ceil(leg / 0.005 - 1e-3) for leg in legs), abs=len(legs))
    worlds.run(gripper.drive_gripper)
    np.testing.assert_array_equal(worlds["setpoint"][0], setpoints[-1])


def test_only_an_acting_gripper_is_pulled_but_every_gripper_is_carried(device):
    worlds = made(device, worlds=2)
    worlds.begin(Phase.ACT)
    worlds.put(phase=[Phase.ACT, Phase.SETTLE], setpoint=[1.0, 0.0, 0.0], joint_f=3.0)
    worlds.run(gripper.drive_gripper)
    force = worlds["joint_f"].reshape(2, -1)
    move = worlds.scene.move
    np.testing.assert_allclose(force[1, :3], [0.0, 0.0, move.mass * move.gravity], rtol=1e-6)
    assert np.linalg.norm(force[0, :3] - force[1, :3]) == pytest.approx(move.force, rel=1e-5)
    assert (force[:, 3] == 0.0).all(), "seals add to what the drive has cleared"
    assert (force[:, 4:] == 3.0).all()


# ---- the simulated gripper ----

MODES = ("pick", "move")
FREE, STAND, MEET = range(3)
"""World of each experiment in mode pick; those of mode move follow, and then others in mode move."""
FAR, WALL, FOLLOW, HOLD = range(6, 10)
WORLDS, STEPS = 10, 480
SHIFT = {"pick": (0.012, -0.016, 0.0), "move": (0.012, 0.0, 0.009)}
"""Goal of a free gripper [m]: 20 and 15 mm away, so that the force stays below its limit."""
DEEP = 1.0
"""How far below the floor the setpoint of a standing gripper lies [m]."""
ABOVE = 0.005
"""How far above the floor the tip of a gripper starts whose setpoint moves down [m]."""
SMOOTH, FOUND = 5, 200
"""Steps over which single ones even out, 10 ms; steps after which all contacts of a standing gripper are found, 400 ms."""


class CupContacts:
    """Watcher of physics: copies, in each substep, of contacts and of the forces that the solver tells of."""

    def __init__(self, physics: Physics) -> None:
        self.physics, self.copies, self.substep = physics, [], 0

    def begin_step(self) -> None:
        self.substep = 0

    def after_solve(self, contact_f: wp.array) -> None:
        """A replay copies into the same arrays."""
        contacts = self.physics.contacts
        told = (contacts.rigid_contact_count, contacts.rigid_contact_shape0, contacts.rigid_contact_shape1, contact_f)
        if self.substep == len(self.copies):
            self.copies.append([wp.empty_like(array) for array in told])
        for array, copy in zip(told, self.copies[self.substep], strict=True):
            wp.copy(copy, array)
        self.substep += 1

    def forces(self) -> list[np.ndarray]:
        """Sum of the forces of all contacts on each cup, in each substep (substep, world, 3) [N]; the solver tells of that on shape 0."""
        layout, totals = self.physics.layout, []
        for count, first, second, force in self.copies:
            total, used = np.zeros((layout.worlds, 3)), int(count.numpy()[0])
            for array, sign in ((first, 1.0), (second, -1.0)):
                shape = array.numpy()[:used]
                cup = np.isin(shape % layout.shapes_per_world, layout.head_shapes)
                np.add.at(total, shape[cup] // layout.shapes_per_world, sign * force.numpy()[:used, :3][cup])
            totals.append(total)
        return totals

    def end_step(self, step: int, current: newton.State) -> None:
        """Nothing more."""


def law(config: Config, mode: str) -> tuple[float, float, float]:
    """Stiffness, damping and mass."""
    section = getattr(config, mode)
    return section.stiffness, section.damping, config.gripper.finger_mass + config.gripper.cup_mass


@pytest.fixture(scope="module")
def driven(device) -> SimpleNamespace:
    """What came of all experiments, from rest: `start` (world, 3), and by step and world `position` relative to it, `tilt`, `velocity`,
    `force` of the impedance law, `setpoint`, and `contact` with an axis of substeps before the world's."""
    config = settings(bake__worlds=WORLDS, physics__steps_per_tick=1, move__speed=0.4, arrangement__max_objects=1)
    built = build.build_model(config, catalog(CUBE), device)
    physics, layout, tip = Physics(config.physics, built), built.layout, config.gripper.cup_length
    scene = make_scene_data(config, catalog(CUBE), built, 1, device)
    sizes = world_sizes(WORLDS, layout.instances, config.move.rounds, layout.bodies_per_world, len(built.head.cups))
    state, attempts, plan = (allocate(kind, sizes, device) for kind in (WorldState, AttemptState, Plan))
    state.bin_pose.fill_(wp.transform_identity())
    scene.bins.chosen, scene.bins.pose = state.bin, state.bin_pose
    floor, pick = np.array(config.tote.floor_size), np.arange(WORLDS) < 3
    start = np.tile((0.0, 0.0, 0.5), (WORLDS, 1))
    start[[STAND, STAND + 3]], start[[MEET, MEET + 3]] = (0.0, 0.0, tip), (0.0, 0.0, tip + ABOVE)
    start[WALL] = [floor[0] / 2 - config.gripper.cup_width, 0.0, tip + 0.03]
    start[FOLLOW] = [*(config.move.corner * floor / 2), config.move.height + tip]
    setpoint = start.copy()
    setpoint[[FREE, FREE + 3]] += list(SHIFT.values())
    setpoint[[STAND, STAND + 3], 2] -= DEEP
    setpoint[FAR] += (0.6, 0.3, 0.4)
    setpoint[WALL, 0] += 0.5
    goal = setpoint - (0.0, 0.0, scene.move.tcp_offset)
    goal[MEET, 2] -= DEEP
    coordinates = physics.state.joint_q.numpy().reshape(WORLDS, -1)
    coordinates[:, : build.GRIPPER_DOFS] = np.pad(start, ((0, 0), (0, 1)))
    physics.state.joint_q.assign(coordinates.reshape(-1).astype(np.float32))
    physics.refresh_poses()
    for array, values in (
        (state.phase, np.full(WORLDS, Phase.ACT)),
        (state.mode, np.where(pick, Mode.PICK, Mode.MOVE)),
        (state.waypoint, np.where(np.arange(WORLDS) == FOLLOW, 0, scene.move.waypoints)),  # Other setpoints are fixed: all are reached.
        (state.corner_order, np.tile([1, 0, 1, 0], (WORLDS, 1))),
        (state.setpoint, setpoint.astype(np.float32)),
        (attempts.task, np.where(np.arange(WORLDS) == MEET, Task.DESCEND, Task.PRESS)),
        (plan.point, goal.astype(np.float32)),
        (plan.normal, np.tile((0.0, 0.0, 1.0), (WORLDS, 1))),
    ):
        array.assign(values)
    arrange.place_bins(scene, state, physics)
    watcher, rows = CupContacts(physics), []
    for _ in range(STEPS):
        sinking = state.setpoint.numpy()
        sinking[MEET + 3, 2] -= Config().move.speed * config.physics.step
        state.setpoint.assign(sinking)
        physics.tick(lambda current: gripper.drive_gripper(scene, state, attempts, plan, physics, current), watcher=watcher)
        arrays = (physics.state.joint_q, physics.state.joint_qd, physics.control.joint_f)
        place, speed, force = (array.numpy().reshape(WORLDS, -1).astype(float) for array in arrays)
        weight = [0.0, 0.0, scene.move.mass * config.physics.gravity]
        rows.append(
            (place[:, :3] - start, place[:, 3], speed[:, :3], force[:, :3] - weight, state.setpoint.numpy().copy(), watcher.forces())
        )
    names = ("position", "tilt", "velocity", "force", "setpoint", "contact")
    columns = dict(zip(names, (np.array(column, float) for column in zip(*rows, strict=True)), strict=True))
    return SimpleNamespace(config=config, start=start, **columns)


# ---- free ----


@pytest.mark.parametrize("mode", MODES)
def test_the_free_step_response_is_the_analytic_one_within_two_percent(driven, mode):
    """Simulated: 0.7 % (pick) and 1.1 % (move). All of it is the time step's: as it is stepped, the twin agrees."""
    config, world, shift = driven.config, FREE + 3 * MODES.index(mode), np.array(SHIFT[mode])
    assert np.linalg.norm(driven.force[:, world], axis=1).max() < getattr(config, mode).force
    time = config.physics.step * (1 + np.arange(STEPS))
    error = np.linalg.norm(driven.position[:, world] - twin.step_response(time, *law(config, mode))[:, None] * shift, axis=1)
    assert error.max() < 0.02 * np.linalg.norm(shift)
    stepped = twin.stepped_response(STEPS, *law(config, mode), config.physics.step, config.physics.substeps)
    np.testing.assert_allclose(driven.position[:, world], stepped[:, None] * shift, atol=2e-4 * np.linalg.norm(shift))


def test_a_far_setpoint_pulls_with_the_largest_force_and_no_more(driven):
    """Until the spring would pull less: constant acceleration F / m."""
    limit, size = driven.config.move.force, np.linalg.norm(driven.force[:, FAR], axis=1)
    clamped = int(np.argmin(size > limit * (1 - 1e-4)))
    assert clamped > 20
    time = driven.config.physics.step * (1 + np.arange(clamped))
    expected = limit * time**2 / (2 * law(driven.config, "move")[2])
    assert np.abs(np.linalg.norm(driven.position[:clamped, FAR], axis=1) - expected).max() < 0.02 * expected[-1]


def test_no_force_is_above_the_limit_and_cups_keep_their_tilt(driven):
    """The drive holds the cup upright, pressed against a wall, too; and a gripper at its setpoint is carried."""
    for mode, worlds in (("pick", slice(0, 3)), ("move", slice(3, WORLDS))):
        assert np.linalg.norm(driven.force[:, worlds], axis=2).max() <= getattr(driven.config, mode).force * (1 + 1e-5)
    assert np.abs(driven.tilt).max() < np.radians(2.0)
    assert np.abs(driven.position[:, HOLD]).max() < 1e-5


def test_a_following_gripper_lags_by_speed_times_damping_over_stiffness(driven):
    move, steady = driven.config.move, slice(240, 400)
    way, place = driven.setpoint[steady, FOLLOW], driven.start[FOLLOW] + driven.position[steady, FOLLOW]
    assert np.linalg.norm(np.diff(way, axis=0), axis=1) == pytest.approx(move.speed * driven.config.physics.step, rel=1e-3)
    np.testing.assert_allclose((way - place)[:, 0], -move.speed * move.damping / move.stiffness, rtol=0.02)
    assert np.abs((way - place)[:, 1:]).max() < 1e-4


# ---- against wall and floor ----


def test_a_gripper_pressed_against_the_wall_stands_there_under_the_largest_force(driven):
    """At rest the wall pushes back with what the controller commands."""
    config, late = driven.config, slice(STEPS - 50, STEPS)
    assert np.linalg.norm(driven.force[late, WALL], axis=1) == pytest.approx(config.move.force, rel=1e-4)
    assert np.ptp(driven.position[late, WALL], axis=0).max() < 1e-4
    # Where the cup's lip meets the inclined wall.
    slope = (config.tote.rim_size[0] - config.tote.floor_size[0]) / 2 / (config.tote.outer_size[2] - config.tote.wall)
    free = config.gripper.cup_width / 2 + slope * (driven.start[WALL, 2] - config.gripper.cup_length)
    assert free - 1e-3 < driven.position[-1, WALL, 0] < free + 3e-3


@pytest.mark.parametrize("mode", MODES)
def test_a_gripper_that_stands_on_the_floor_presses_with_no_more_than_the_limit(device, driven, mode):
    """The setpoint is far below. What is bounded is the whole reaction of the floor, as the solver has it.

    While it still finds the contacts, in the first 0.4 s, some of its steps are off by up to 0.7 N on a CPU, for lack of iterations; they
    even out within 10 ms.
    """
    world, limit = STAND + 3 * MODES.index(mode), getattr(driven.config, mode).force
    contact = np.linalg.norm(driven.contact[:, :, world], axis=2)
    assert np.convolve(contact.mean(axis=1), np.full(SMOOTH, 1 / SMOOTH), "valid").max() < 1.01 * limit
    assert contact.max() < limit + (6.0 if device.is_cuda else 1.0)
    # The GPU's solver sweeps contacts in another order and evens out more slowly.
    tolerance = 0.02 if device.is_cuda else 0.002
    assert contact[FOUND:].max() < (1.0 + tolerance) * limit
    assert contact[FOUND:].min() > (1.0 - tolerance) * limit
    assert np.abs(driven.position[:, world]).max() < 1e-5


def test_a_picking_gripper_that_meets_the_floor_never_presses_with_more_than_the_limit(driven):
    """The setpoint goes through the floor at the speed of the last 5 cm; the impact, m v in one step, is within the bound."""
    contact, limit = np.linalg.norm(driven.contact[:, :, MEET], axis=2), driven.config.pick.force
    assert contact[-1].max() > 0.8 * limit  # Far in: the bound is put to the test.
    assert contact.max() <= limit


def test_a_moving_gripper_that_meets_the_floor_presses_with_no_more_than_the_limit_but_for_the_impact(driven):
    """A rigid floor takes the gripper's momentum m v within a step, whatever the controller does: 2 kg · 0.1 m/s / 2 ms = 100 N.

    So what is bounded by 30 N is the force from then on, and the impact by its impulse.
    """
    step, limit = driven.config.physics.step, driven.config.move.force
    contact = driven.contact[:, :, MEET + 3].mean(axis=1)
    size = np.linalg.norm(contact, axis=1)
    first = int(np.argmax(size > 0.0))
    impact = slice(first, first + 3)
    momentum = law(driven.config, "move")[2] * Config().move.speed
    assert step * contact[impact, 2].sum() < 1.1 * momentum + 3 * step * limit
    assert size[impact.stop :].max() < 1.01 * limit
    assert size[-1] == pytest.approx(limit, rel=1e-3)


@pytest.mark.parametrize("world", [STAND, MEET, STAND + 3, MEET + 3])
def test_contact_forces_balance_the_momentum(driven, world):
    """That the solver's contact forces are all there is, vertically: F_contact = m dv/dt - F; the gripper's weight is carried."""
    change = law(driven.config, "move")[2] * np.diff(driven.velocity[:, world, 2]) / driven.config.physics.step
    np.testing.assert_allclose(driven.contact[1:, :, world, 2].mean(axis=1), change - driven.force[1:, world, 2], atol=1e-2)


# ---- joints ----

YAW, TILT = np.array([0.0, 0.7, -2.5]), np.array([0.4, 0.4, -1.2])
# Above the tote.
PLACE, FORCE = np.array([0.1, -0.2, 1.0]), np.array([3.0, -2.0, 1.0])


def test_fingers_turn_and_cups_tilt_and_the_gripper_still_moves_along_the_worlds_axes(device):
    """Three grippers, turned between two steps; then tilted and pushed."""
    steps = {"physics__steps_per_tick": 1, "physics__substeps": 1}
    config = settings(bake__worlds=3, arrangement__max_objects=1, physics__gravity=0.0, physics__guide_height=0.2, **steps)
    physics = Physics(config.physics, build.build_model(config, catalog(CUBE), device))
    state, control = physics.state, physics.control

    def put(array: wp.array, columns: slice, values: object) -> None:
        rows = array.numpy().reshape(3, -1)
        rows[:, columns] = values
        array.assign(rows.reshape(-1))

    put(state.joint_q, slice(0, build.GRIPPER_DOFS), [*PLACE, 0.0])
    physics.refresh_poses()
    physics.tick(lambda current: None)
    physics.set_yaw(wp.array(YAW, dtype=float, device=device))
    physics.refresh_poses()
    for yaw, pair in zip(YAW, state.body_q.numpy().reshape(3, -1, 7)[:, :2], strict=True):
        for pose in pair:
            np.testing.assert_allclose(pose[:3], PLACE, atol=1e-5)
            expected = [[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]]
            np.testing.assert_allclose(rotation_of(pose[3:]), expected, atol=1e-5)
    put(control.joint_f, slice(0, 3), FORCE)
    put(control.joint_target_q, slice(3, 4), TILT[:, None])
    for _ in range(250):
        physics.tick(lambda current: None)
    last, time, (_, _, mass) = state.joint_q.numpy().reshape(3, -1), 250 * config.physics.step, law(config, "move")
    # The cup's mass, which swings as the cup tilts, pulls at the finger a little.
    gripper_head = config.gripper
    pull = 0.5 * gripper_head.cup_mass * gripper_head.cup_length
    np.testing.assert_allclose(last[:, :3] - PLACE, np.tile(FORCE * time**2 / (2 * mass), (3, 1)), atol=pull)
    np.testing.assert_allclose(last[:, 3], TILT, atol=5e-3)
    for yaw, tilt, pose in zip(YAW, last[:, 3], state.body_q.numpy().reshape(3, -1, 7)[:, 1], strict=True):
        axis = [np.sin(tilt) * np.cos(yaw), np.sin(tilt) * np.sin(yaw), np.cos(tilt)]
        np.testing.assert_allclose(rotation_of(pose[3:])[:, 2], axis, atol=1e-4)
