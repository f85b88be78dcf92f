"""Twists: a setpoint that follows velocities, a seal that a bit switches, and stirring."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.codes import Outcome
from synpick_warp.environment.picking import TWIST_SPEED
from synpick_warp.errors import ActionError
from tests.environment.conftest import build

APPROACH = 0.015
"""Distance beside an object within which the gripper descends [m]."""
OBJECT_HEIGHT = 0.05


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


@pytest.mark.parametrize(
    ("twist", "message"),
    [([np.nan] * 6, "the action of environment 0 is not finite"), ([0.0] * 5, r"shape \(2, 5\); allowed: \(2, 6\), of a twist")],
)
def test_bad_twists_are_refused(pick, twist, message):
    pick.reset(seed=3)
    with pytest.raises(ActionError, match=message):
        pick.step([twist] * 2)
