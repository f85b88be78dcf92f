"""The gripper: corners, setpoint, force law, and how the simulated gripper follows."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Phase
from synpick_warp.kernels.sim.gripper import impedance_force
from synpick_warp.scenes import build
from synpick_warp.stages.sim import arrange
from synpick_warp.stages.sim import gripper as act
from synpick_warp.stages.sim.simulate import Simulation
from tests.harness.probe import probe
from tests.twins import gripper as twin
from tests.worlds.kernel_worlds import KernelWorlds
from tests.worlds.small_worlds import CUBE, catalog, settings

SEED = 5
CORNER = np.array([0.2, 0.1, 0.02])
TIP = 0.05


def made(device, worlds: int = 1, **move) -> KernelWorlds:
    result = KernelWorlds(device, worlds, move={"tcp_offset": TIP, **move})
    result.set(result.state.frame, -1)
    return result


# ---- the law ----


forces = probe(impedance_force)
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
    law = [stiffness, damping, limit, mass, step]
    found = forces(offset, velocity, *law, device=device)
    np.testing.assert_allclose(found, twin.force(offset, velocity, *law), rtol=2e-3, atol=2e-4 * limit)
    assert np.linalg.norm(found) <= limit * (1 + 1e-5)


def test_the_force_is_a_spring_at_rest_and_a_damper_at_the_setpoint(device):
    """With a step that vanishes: 1000 N/m · 1 cm = 10 N; 60 N·s/m · 0.1 m/s = 6 N; 1 m is too far: 30 N."""
    law = (1000.0, 60.0, 30.0, 2.0, 1e-7)
    found = forces([[0.01, 0, 0], [0, 0, 0], [0, 0, 1]], [[0, 0, 0], [0, 0.1, 0], [0, 0, 0]], *law, device=device)
    np.testing.assert_allclose(found, [[10, 0, 0], [0, -6, 0], [0, 0, 30]], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("mass", [1e-3, 0.15, 2.0])
@pytest.mark.parametrize("step", [5e-4, 2e-3, 2e-2])
def test_the_law_is_stable_for_every_mass(device, mass, step):
    """Where an explicit spring would explode: energy of a free mass on it never grows."""
    x, v = np.zeros(3), np.zeros(3)
    setpoint = np.array([0.02, -0.01, 0.005])
    energies = []
    for _ in range(60):
        force = forces(setpoint - x, v, 1e4, 0.0, 1e6, mass, step, device=device).astype(float)
        v = v + step * force / mass
        x = x + step * v
        energies.append(0.5e4 * np.sum((setpoint - x) ** 2) + 0.5 * mass * np.sum(v**2))
    assert (np.diff(energies) <= 1e-5 * energies[0]).all()


# ---- corners and setpoint ----


@pytest.mark.parametrize("rounds", [1, 3])
def test_every_round_visits_every_corner_in_the_twins_order(device, rounds):
    worlds = made(device, worlds=200, waypoints=4 * rounds)
    worlds.begin(Phase.ACT, 1000 + np.arange(200), 2)
    act.begin_moving(worlds.scene, worlds.state, worlds.physics, SEED)
    order = worlds.state.corner_order.numpy()
    assert (np.sort(order.reshape(200, rounds, 4), axis=2) == np.arange(4)).all()
    assert order.tolist() == [twin.corner_order(SEED, 1000 + world, 2, rounds) for world in range(200)]
    _, counts = np.unique(order[:, :4], axis=0, return_counts=True)
    assert len(counts) == 24  # Every order of four comes, about 200 / 24 times.
    assert counts.max() < 25


def test_the_gripper_starts_above_the_first_corner_at_rest(device):
    worlds = made(device, worlds=50, start_height=0.3)
    worlds.begin(Phase.ACT)
    worlds.set(worlds.physics.state.joint_qd, 1.0)
    worlds.set(worlds.state.waypoint, 3)
    act.begin_moving(worlds.scene, worlds.state, worlds.physics, SEED)
    first = np.stack([twin.corner_place(code, CORNER) for code in worlds.state.corner_order.numpy()[:, 0]])
    first[:, 2] = 0.3 + TIP
    np.testing.assert_allclose(worlds.state.setpoint.numpy(), first, atol=1e-6)
    np.testing.assert_allclose(worlds.physics.state.joint_q.numpy().reshape(50, -1)[:, :3], first, atol=1e-6)
    speed = worlds.physics.state.joint_qd.numpy().reshape(50, -1)
    assert (speed[:, :4] == 0.0).all()
    assert (speed[:, 4:] == 1.0).all()
    assert (worlds.state.waypoint.numpy() == 0).all()


def test_frames_count_while_the_gripper_acts(device):
    worlds = made(device, worlds=2)
    seen = []
    for phase in (Phase.SETTLE, Phase.ACT, Phase.ACT, Phase.ACT, Phase.OVER, Phase.SETTLE, Phase.ACT):
        worlds.begin(phase)
        act.begin_moving(worlds.scene, worlds.state, worlds.physics, SEED)
        seen.append(int(worlds.state.frame.numpy()[1]))
    assert seen == [-1, 0, 1, 2, -1, -1, 0]


def test_an_order_once_drawn_is_kept(device):
    worlds = made(device)
    worlds.begin(Phase.ACT)
    act.begin_moving(worlds.scene, worlds.state, worlds.physics, SEED)
    before = worlds.state.corner_order.numpy().copy()
    worlds.set(worlds.state.setpoint, 7.0)
    worlds.begin(Phase.ACT, [99])
    act.begin_moving(worlds.scene, worlds.state, worlds.physics, SEED)
    np.testing.assert_array_equal(worlds.state.corner_order.numpy(), before)
    assert (worlds.state.setpoint.numpy() == 7.0).all()


def test_the_setpoint_walks_from_corner_to_corner_at_constant_speed(device):
    worlds = made(device, waypoints=4, speed=0.5, step=0.01, start_height=0.1)
    worlds.begin(Phase.ACT)
    act.begin_moving(worlds.scene, worlds.state, worlds.physics, SEED)
    setpoints, waypoints = [worlds.state.setpoint.numpy()[0].copy()], [0]
    while waypoints[-1] < 4 and len(setpoints) < 1000:
        act.drive_gripper(worlds.scene, worlds.state, worlds.attempts, worlds.plan, worlds.physics, worlds.physics.state)
        setpoints.append(worlds.state.setpoint.numpy()[0].copy())
        waypoints.append(int(worlds.state.waypoint.numpy()[0]))
    strides = np.linalg.norm(np.diff(setpoints, axis=0), axis=1)
    arrivals = np.flatnonzero(np.diff(waypoints)) + 1
    assert np.delete(strides, arrivals - 1) == pytest.approx(0.005, abs=1e-6)
    assert (strides[arrivals - 1] <= 0.005 + 1e-6).all()
    places = [twin.corner_place(code, np.add(CORNER, (0, 0, TIP))) for code in worlds.state.corner_order.numpy()[0]]
    np.testing.assert_allclose(np.array(setpoints)[arrivals], places, atol=1e-6)
    legs = [np.linalg.norm(b - a) for a, b in itertools.pairwise([setpoints[0], *places])]
    # A step more where rounding leaves a sliver of the way.
    assert len(setpoints) - 1 == pytest.approx(sum(np.ceil(leg / 0.005 - 1e-3) for leg in legs), abs=len(legs))
    act.drive_gripper(worlds.scene, worlds.state, worlds.attempts, worlds.plan, worlds.physics, worlds.physics.state)
    np.testing.assert_array_equal(worlds.state.setpoint.numpy()[0], setpoints[-1])


def test_only_an_acting_gripper_is_pulled_but_every_gripper_is_carried(device):
    worlds = made(device, worlds=2)
    worlds.begin(Phase.ACT)
    worlds.set(worlds.state.phase, [Phase.ACT, Phase.SETTLE])
    worlds.set(worlds.state.setpoint, [1.0, 0.0, 0.0])
    worlds.set(worlds.physics.control.joint_f, 3.0)
    act.drive_gripper(worlds.scene, worlds.state, worlds.attempts, worlds.plan, worlds.physics, worlds.physics.state)
    force = worlds.physics.control.joint_f.numpy().reshape(2, -1)
    move = worlds.scene.move
    np.testing.assert_allclose(force[1, :3], [0.0, 0.0, move.mass * move.gravity], rtol=1e-6)
    assert np.linalg.norm(force[0, :3] - force[1, :3]) == pytest.approx(move.force, rel=1e-5)
    assert (force[:, 3] == 0.0).all(), "seals add to what the drive has cleared"
    assert (force[:, 4:] == 3.0).all()


# ---- the simulated gripper ----

# World of each experiment.
SMALL, LIFT, FAR, WALL, FOLLOW, HOLD = range(6)
STEPS = 400
START = np.array([0.0, 0.0, 0.5])
OFFSETS = {SMALL: (0.012, -0.006, 0.0), LIFT: (0.0, 0.0, 0.015), FAR: (0.6, 0.3, 0.4), HOLD: (0.0, 0.0, 0.0)}


@pytest.fixture(scope="module")
def run(device):
    """Positions, commanded forces and setpoints (step, world, 3) of six grippers without objects, each with its own setpoint."""
    config = settings(bake__worlds=6, physics__steps_per_tick=1, move__speed=0.4, arrangement__max_objects=1)
    simulation = Simulation(config, catalog(CUBE), 1, device)
    state, physics, worlds = simulation.state, simulation.physics, 6
    floor = np.array(config.tote.floor_size)
    start = np.tile(START, (worlds, 1))
    start[WALL] = [floor[0] / 2 - config.gripper.cup_width, 0.0, config.gripper.cup_length + 0.03]
    start[FOLLOW] = [*(config.move.corner * floor / 2), config.move.height + config.gripper.cup_length]
    setpoint = start + [OFFSETS.get(world, (0.0, 0.0, 0.0)) for world in range(worlds)]
    setpoint[WALL, 0] += 0.5
    coordinates = physics.state.joint_q.numpy().reshape(worlds, -1)
    coordinates[:, : build.GRIPPER_DOFS] = np.pad(start, ((0, 0), (0, 1)))
    physics.state.joint_q.assign(coordinates.reshape(-1).astype(np.float32))
    physics.refresh_poses()
    # All setpoints but one are fixed: their waypoints are all reached.
    waypoint = np.full(worlds, simulation.scene.move.waypoints)
    waypoint[FOLLOW] = 0
    order = np.tile([1, 0, 1, 0], (worlds, 1))
    values = {"phase": np.full(worlds, Phase.ACT), "waypoint": waypoint, "corner_order": order, "setpoint": setpoint.astype(np.float32)}
    for name, value in values.items():
        getattr(state, name).assign(value)
    arrange.place_bins(simulation.scene, state, physics)
    drive = functools.partial(act.drive_gripper, simulation.scene, state, simulation.attempts, simulation.plan, physics)
    rows = []
    for _ in range(STEPS):
        physics.tick(drive)
        force = physics.control.joint_f.numpy().reshape(worlds, -1)[:, :3] - [0, 0, simulation.scene.move.mass * config.physics.gravity]
        rows.append((physics.state.joint_q.numpy().reshape(worlds, -1)[:, :4].copy(), force, state.setpoint.numpy().copy()))
    position, force, setpoints = (np.stack(column).astype(float) for column in zip(*rows, strict=True))
    return config, start, position, force, setpoints


def mass_of(config) -> float:
    return config.gripper.finger_mass + config.gripper.cup_mass


@pytest.mark.parametrize("world", [SMALL, LIFT])
def test_a_free_gripper_follows_the_analytic_step_response(run, world):
    config, start, position, force, _ = run
    assert np.linalg.norm(force[:, world], axis=1).max() < config.move.force
    time = config.physics.step * (1 + np.arange(STEPS))
    share = twin.step_response(time, config.move.stiffness, config.move.damping, mass_of(config))
    offset = np.array(OFFSETS[world])
    error = np.linalg.norm(position[:, world, :3] - start[world] - share[:, None] * offset, axis=1)
    assert error.max() < 0.02 * np.linalg.norm(offset)


def test_a_gripper_at_its_setpoint_is_carried(run):
    _, start, position, _, _ = run
    assert np.abs(position[:, HOLD, :3] - start[HOLD]).max() < 1e-5


def test_a_far_setpoint_pulls_with_the_largest_force_and_no_more(run):
    """Until the spring would pull less: constant acceleration F / m."""
    config, start, position, force, _ = run
    size = np.linalg.norm(force[:, FAR], axis=1)
    assert size.max() <= config.move.force * (1 + 1e-5)
    clamped = int(np.argmin(size > config.move.force * (1 - 1e-4)))
    assert clamped > 20
    time = config.physics.step * (1 + np.arange(clamped))
    way = np.linalg.norm(position[:clamped, FAR, :3] - start[FAR], axis=1)
    expected = config.move.force * time**2 / (2 * mass_of(config))
    assert np.abs(way - expected).max() < 0.02 * expected[-1]


def test_no_force_is_above_the_limit(run):
    config, _, _, force, _ = run
    assert np.linalg.norm(force, axis=2).max() <= config.move.force * (1 + 1e-5)


def test_a_gripper_pressed_against_the_wall_stands_there_under_the_largest_force(run):
    """At rest the wall pushes back with what the controller commands."""
    config, start, position, force, _ = run
    late = slice(STEPS - 50, STEPS)
    assert np.linalg.norm(force[late, WALL], axis=1) == pytest.approx(config.move.force, rel=1e-4)
    assert np.ptp(position[late, WALL, :3], axis=0).max() < 1e-4
    way = position[-1, WALL, 0] - start[WALL, 0]
    # Where the cup's lip meets the inclined wall.
    slope = (config.tote.rim_size[0] - config.tote.floor_size[0]) / 2 / (config.tote.outer_size[2] - config.tote.wall)
    lip = start[WALL, 2] - config.gripper.cup_length
    free = config.gripper.cup_width / 2 + slope * lip
    assert free - 1e-3 < way < free + 3e-3


def test_the_cup_keeps_its_tilt(run):
    """The drive holds the cup upright, pressed against a wall, too."""
    _, _, position, _, _ = run
    assert np.abs(position[:, :, 3]).max() < np.radians(2.0)


def test_a_following_gripper_lags_by_speed_times_damping_over_stiffness(run):
    config, _, position, _, setpoints = run
    move = config.move
    steady = slice(int(0.6 * STEPS), STEPS)
    assert np.linalg.norm(np.diff(setpoints[steady, FOLLOW], axis=0), axis=1) == pytest.approx(move.speed * config.physics.step, rel=1e-3)
    lag = setpoints[steady, FOLLOW] - position[steady, FOLLOW, :3]
    np.testing.assert_allclose(lag[:, 0], -move.speed * move.damping / move.stiffness, rtol=0.02)
    assert np.abs(lag[:, 1:]).max() < 1e-4
