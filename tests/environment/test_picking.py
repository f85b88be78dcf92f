"""Environment of whole picks, and of twists: seeds, rewards, resets, states, and actions that are refused."""

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.codes import Outcome, Segment
from synpick_warp.configs.episodes.manipulation import Picks
from synpick_warp.configs.files.load import load_config
from synpick_warp.environment.episodes import Episodes, make_seeds
from synpick_warp.environment.make import make_picking
from synpick_warp.environment.picking import TWIST_SPEED
from synpick_warp.environment.settings import make_choice
from synpick_warp.errors import ActionError, ConfigError, StateError
from synpick_warp.stages.perception.candidates import CandidateSampler
from synpick_warp.stages.sim.trials import Trials
from synpick_warp.system.random_numbers import mix
from tests.builders import PICKING, boxes
from tests.environment.conftest import build, centers, same
from tests.worlds.small_worlds import QUICK, own_grasps

FLOOR = 1e-3
"""Error of a point on the floor of the tote, by a depth in single precision [m]."""


def floor_pixels(obs) -> np.ndarray:
    """A pixel of each image that shows the floor of the tote: of those of the tote the farthest."""
    depth = np.where(obs["instances"] == Segment.TOTE, obs["depth"], 0.0)
    rows, columns = np.unravel_index(depth.reshape(len(depth), -1).argmax(axis=1), depth.shape[1:])
    return np.stack([columns, rows], axis=1)


# ---- seeds ----


def test_looks_and_props_change_no_observation_of_geometry(device, tmp_path):
    """The frame has maps and stands beside the images; materials are drawn."""
    prop = 'name = "frame"\nmesh = "frame"\npose = { position = [50.0, 0.0, 0.0] }\n'
    (tmp_path / "cell.toml").write_text(f'preset = "smoke"\n[randomize]\nobject_brightness = 0.5\n[[prop]]\n{prop}')
    sources = ("smoke", tmp_path / "cell.toml")
    assert same(*(build(device, source, obs=("depth", "instances", "normals")).reset(seed=3)[0] for source in sources))


def test_an_episode_index_names_a_pile(environment):
    info = environment.reset(seed=3)[1]
    first = environment.observe()
    environment.reset()
    obs, again = environment.reset(options={"episode": info["episode_index"]})
    assert same(obs, first)
    assert again["episode_index"].tolist() == info["episode_index"].tolist()


@pytest.mark.slow
def test_the_number_of_environments_changes_nothing(environment, device):
    wide, narrow = build(device, num_envs=3), environment
    actions = np.append(centers(narrow.observe()["instances"]), [[1, 1]], axis=0)
    for one, count in ((wide, 3), (narrow, 2)):
        one.reset(seed=3)
        one.step(actions[:count])
    for name, values in narrow.observe().items():
        assert wide.observe()[name][:2].tobytes() == values.tobytes(), name


def test_episodes_are_a_hash_of_seed_and_count():
    episodes = Episodes.of(2)
    episodes.reseed({0: 3, 1: 4}, np.arange(2))
    drawn = [episodes.draw(np.arange(2), 2**31 - 1, ahead).tolist() for ahead in range(3)]
    gamma = 0x9E3779B97F4A7C15
    assert drawn == [[mix(seed * gamma + count + 1) % (2**31 - 1) for seed in (3, 4)] for count in range(3)]
    assert len({index for row in drawn for index in row}) == 6
    assert (episodes.draw(np.arange(2), 5) < 5).all()


# ---- actions and rewards ----


def test_a_pick_of_an_object_is_rewarded_and_takes_it_away(environment):
    obs = environment.observe()
    step = environment.step(centers(obs["instances"]))
    assert step.reward.tolist() == [1.0, 1.0]
    assert [Outcome(outcome) for outcome in step.info["outcome"]] == [Outcome.TARGET_PICKED] * 2
    present = [values[:, 6::10].sum(axis=1) for values in (obs["state"], step.obs["state"])]
    assert (present[1] < present[0]).all()
    for world, picked in enumerate(step.info["picked"]):
        assert step.obs["state"][world, 6 + 10 * picked] == 0.0
        assert not (step.obs["instances"][world] == picked + 1).any()


def test_a_pick_of_the_floor_catches_nothing(environment):
    step = environment.step(floor_pixels(environment.observe()))
    assert step.reward.tolist() == [0.0, 0.0]
    plan = environment.worlds.simulation.plan
    np.testing.assert_allclose(plan.point.numpy()[:2, 2], 0.0, atol=FLOOR)
    np.testing.assert_allclose(plan.normal.numpy()[:2], [[0, 0, 1]] * 2, atol=1e-3)
    assert plan.target.numpy()[:2].tolist() == [-1, -1]


def test_an_empty_bin_terminates_the_episode(environment):
    environment.choice = replace(environment.choice, max_steps=50)
    terminated = np.zeros(2, bool)
    for _ in range(9):
        step = environment.step(centers(environment.observe()["instances"]))
        terminated |= step.terminated
        if terminated.any():
            break
    world = int(terminated.argmax())
    assert step.obs["state"][world, 6::10].sum() == 0.0
    assert not step.truncated[world]
    again = environment.step(centers(step.obs["instances"]))
    assert again.obs["state"][world, 6::10].sum() > 0.0
    assert (again.reward[world], again.terminated[world], again.info["steps"][world]) == (0.0, False, 0)


# ---- the ends of episodes ----


def test_same_step_has_the_last_observation_in_its_info(environment):
    pixels = floor_pixels(environment.observe())
    environment.choice = replace(environment.choice, max_steps=1)
    last = environment.step(pixels)
    environment.reset(seed=3)
    environment.choice = replace(environment.choice, autoreset="same_step")
    step = environment.step(pixels)
    assert same(step.info["final_obs"], last.obs)
    assert step.info["final_obs"] is step.info["final_observation"]
    assert step.info["_final_obs"].all()
    assert step.info["_final_info"].all()
    assert (step.info["final_info"]["episode_index"] == last.info["episode_index"]).all()
    assert (step.info["episode_index"] != last.info["episode_index"]).all()
    assert step.truncated.all()


def test_disabled_waits_for_a_reset_of_the_mask(environment):
    environment.choice = replace(environment.choice, autoreset="disabled", max_steps=1)
    last = environment.step(floor_pixels(environment.observe()))
    waiting = environment.step(floor_pixels(last.obs))
    assert same(waiting.obs, last.obs)
    assert waiting.truncated.all()
    obs, info = environment.reset(options={"reset_mask": np.array([False, True])})
    assert info["episode_index"][0] == last.info["episode_index"][0]
    assert info["episode_index"][1] != last.info["episode_index"][1]
    assert obs["depth"][0].tobytes() == last.obs["depth"][0].tobytes()
    assert environment.step(floor_pixels(obs)).info["steps"].tolist() == [1, 1]


@pytest.mark.parametrize("seed", [3, np.int64(3), [3, 4], np.array([3, 4])])
def test_integers_of_numpy_are_seeds_too(seed):
    assert make_seeds(seed, 2) == {0: 3, 1: 4}


def test_the_course_of_a_trial_has_the_outcome_of_its_table(device):
    """Sooner than an attempt, and with hits and force of the trial of the planned grasp; on the floor it ends after the press."""
    environment = build(device, course="trial")
    obs, _ = environment.reset(seed=3)
    state, simulation = environment.get_state(), environment.worlds.simulation
    step = environment.step(np.stack((centers(obs["instances"])[0], floor_pixels(obs)[1])))
    assert step.reward.tolist() == [1.0, 0.0]
    assert step.info["ticks"][1] < step.info["ticks"][0] < 20
    grasps = own_grasps(simulation, range(2))
    trials = Trials(simulation, simulation.config.picks)
    labels = trials.run(state.worlds, trials.upload(grasps, 2))
    for name in ("outcome", "picked", "hits", "peak_force", "ticks"):
        np.testing.assert_array_equal(labels[name], step.info[name], err_msg=name)


# ---- states and branches ----


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes.seed": None}, "the state lacks episodes.seed; allowed: all arrays"),
        ({"version": np.array(0)}, "the state has version 0"),
        ({"episodes.steps": np.zeros(3, int)}, r"episodes.steps of the state is int64 \(3,\); allowed: int64 \(2,\)"),
    ],
)
def test_states_that_do_not_fit_are_refused(environment, changes, message):
    arrays = dict(environment.state_to_host(environment.get_state())) | changes
    with pytest.raises(StateError, match=message):
        environment.state_from_host({name: array for name, array in arrays.items() if array is not None})


BAD_ACTIONS = [
    ([[1, 2], [64, 2]], r"environment 1 lies outside of the image: \[64, 2\]; allowed: \[0, 0\] to \[63, 47\]"),
    ([[-1, 2], [3, 2]], "environment 0 lies outside of the image"),
    ([[1.0, np.nan], [3, 2]], "the action of environment 0 is not finite"),
    ([[1.5, 2.0], [3, 2]], "the action of environment 0 is no pixel"),
    ([1, 2], r"actions have the shape \(2,\); allowed: \(2, 2\), of a pixel for each environment"),
    ([[1, 2], [3]], "actions have no common shape"),
    ([["a", "b"]] * 2, "allowed: numbers"),
]
BAD_OPTIONS = [
    ({"env": [0]}, "reset has no option env; options: reset_mask, env_idx, episode"),
    ({"reset_mask": np.ones(3, bool)}, "reset_mask has the type bool and the shape"),
    ({"reset_mask": np.ones(2)}, "reset_mask has the type float64"),
    ({"env_idx": [2]}, "allowed: different environments of 0 to 1"),
    ({"env_idx": [0, 0]}, "allowed: different environments"),
    ({"episode": -1}, "allowed: an index from 0 on, or one for each of 2 environments"),
    ({"episode": [1, 2, 3]}, "episode is"),
]
BAD_STATES = [
    (lambda one: one.branch(0, [2]), "there is no environment 2; there are 0 to 1"),
    (lambda one: one.worlds.bank.fetch(range(99)), "99 piles are asked for at once, but the bank keeps [48]"),
    (
        lambda one: one.set_state(replace(one.get_state(), worlds=one.worlds.simulation.get_state([0]))),
        "the state is of 1 environments, not of 2",
    ),
]


@pytest.mark.parametrize(
    ("ask", "error", "message"),
    [
        *((lambda one, actions=actions: one.step(actions), ActionError, message) for actions, message in BAD_ACTIONS),
        *((lambda one, options=options: one.reset(options=options), ConfigError, message) for options, message in BAD_OPTIONS),
        *(
            (lambda one, seed=seed: one.reset(seed=seed), ConfigError, "for each of 2 environments$")
            for seed in ([1], [1, "b"], [1, True], "ab", -1, [3, -1])
        ),
        *((ask, StateError, message) for ask, message in BAD_STATES),
    ],
)
def test_mistakes_are_refused_and_change_nothing(environment, ask, error, message):
    before = environment.observe()
    with pytest.raises(error, match=message):
        ask(environment)
    assert same(environment.observe(), before)


def test_a_pixel_is_picked_as_its_label_was(device):
    """Surface point, normal, yaw and tilt of a pick at a pixel are those of the candidate of trials there."""
    with boxes():
        config = load_config("smoke", QUICK | PICKING | {"perception.resolution": [64, 36], "perception.normal_window": 1})
        choice = make_choice("pick", 1, ("depth",), (64, 36), "pixel", "disabled", "numpy", 0, None, None, "attempt")
        environment = make_picking(choice, config)
    environment.reset()
    state, worlds = environment.get_state(), environment.worlds
    sampler = CandidateSampler(worlds.simulation, Picks(candidates=256, uniform=0.0))
    grasps, candidates, _ = sampler.sample(state.worlds, [0])
    pixels = candidates.pixel.numpy()
    environment.set_state(state)
    for row in (1, 100, 255):
        worlds.attempt_pixels(np.ones(1, bool), pixels[row : row + 1])
        for name in ("point", "normal", "yaw", "tilt"):
            np.testing.assert_allclose(getattr(worlds.simulation.plan, name).numpy()[0], getattr(grasps, name).numpy()[row], atol=1e-6)
        environment.set_state(state)


# ---- twists: a setpoint that follows velocities, a seal that a bit switches, and stirring ----

APPROACH = 0.015
"""Distance beside an object within which the gripper descends [m]."""


@pytest.fixture(scope="module")
def pick(device):
    return build(device, action="twist", obs=("state",), max_steps=200)


@pytest.fixture(scope="module")
def move(device):
    return build(device, task="move", obs=("state", "depth"), max_steps=200)


def servo(state: np.ndarray) -> np.ndarray:
    """Twist of each world's gripper to its highest object, and up with what it holds."""
    twists = []
    for values in state:
        objects, wrist = values[6:].reshape(-1, 10), values[:3]
        if values[5] > 0:
            twists.append((0, 0, 1, 0, 0, 1))
            continue
        highest = objects[np.argmax(np.where(objects[:, 0] > 0, objects[:, 5], -1.0))]
        across = highest[3:5] - wrist[:2]
        down = -0.8 if np.linalg.norm(across) < APPROACH else 0.0
        twists.append((*np.clip(10 * across, -1, 1), down, 0, 0, 1))
    return np.array(twists)


def test_the_wrist_moves_as_it_is_told(pick):
    obs = pick.reset(seed=3)[0]
    pick.step(np.zeros((2, 6)))
    before = pick.observe()["state"]
    for _ in range(8):
        obs = pick.step([[1, 0, 0, 0.5, 0, -1], [0, -0.5, 0, 0, 9, -1]]).obs
    time = 8 * pick.worlds.simulation.config.physics.tick_time
    moved = (obs["state"] - before)[:, :5]
    np.testing.assert_allclose(moved[:, :3], [[TWIST_SPEED * time, 0, 0], [0, -0.5 * TWIST_SPEED * time, 0]], atol=0.02)
    np.testing.assert_allclose(moved[:, 3], [0.5 * time, 0.0], rtol=1e-5)
    assert moved[1, 4] == pytest.approx(time, abs=0.1)  # A drive turns the cup, which lags.


def test_suction_picks_what_it_is_lowered_on_and_lets_go_without(pick):
    obs, rewards, outcomes = pick.reset(seed=3)[0], np.zeros(2), set()
    released = False
    for _ in range(70):
        if obs["state"][:, 5].any() and not released:
            before = pick.get_state()
            assert not pick.step([[0, 0, 0, 0, 0, -1]] * 2).obs["state"][:, 5].any()
            pick.set_state(before)
            released = True
        step = pick.step(servo(obs["state"]))
        obs, rewards = step.obs, rewards + step.reward
        outcomes |= set(step.info["outcome"].tolist())
    assert released
    assert rewards.max() >= 1.0
    assert outcomes <= {Outcome.NONE, Outcome.TARGET_PICKED, Outcome.OTHER_PICKED}


@pytest.mark.slow
def test_stirring_moves_objects(move):
    obs = move.reset(seed=3)[0]
    moved = np.zeros(2)
    for _ in range(30):
        twists = servo(obs["state"])
        twists[:, 2] = -1
        step = move.step(twists)
        obs, moved = step.obs, moved + step.reward
    assert moved.max() >= 1.0


def test_bad_twists_are_refused(pick):
    pick.reset(seed=3)
    for twist, message in (
        ([np.nan] * 6, "the action of environment 0 is not finite"),
        ([0.0] * 5, r"shape \(2, 5\); allowed: \(2, 6\), of a"),
    ):
        with pytest.raises(ActionError, match=message):
            pick.step([twist] * 2)
