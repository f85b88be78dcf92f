"""The face to Gymnasium, and arguments that are refused; what needs Gymnasium is skipped where it is not installed."""

import importlib.util

import numpy as np
import pytest

import synpick_warp
from synpick_warp.configs.files.load import load_config, override_config
from synpick_warp.environment.make import make_picking
from synpick_warp.environment.settings import action_bounds, fixed_settings, make_choice
from synpick_warp.errors import ActionError, ConfigError
from synpick_warp.stages.render.sampling_rates import accumulates
from tests.environment.conftest import ARGUMENTS, SETTINGS, SIZE, build, same

needs_gymnasium = pytest.mark.skipif(importlib.util.find_spec("gymnasium") is None, reason="Gymnasium is not installed")


@pytest.fixture(scope="module")
def target(device):
    """Task TARGET, with points as actions and all observations."""
    return build(device, task="target", action="point", obs=("rgb", "depth", "normals", "instances", "state"), max_steps=3)


# ---- observations and points ----


def test_a_target_is_named_by_mask_and_point(target):
    obs = target.reset(seed=3)[0]
    assert obs.keys() == {"rgb", "depth", "normals", "instances", "state", "target_mask", "target_point"}
    for mask, instances in zip(obs["target_mask"], obs["instances"], strict=True):
        (number,) = np.unique(instances[mask == 1])
        assert 1 <= number <= 3
        assert ((instances == number) == (mask == 1)).all()
    np.testing.assert_allclose(np.linalg.norm(obs["normals"], axis=-1), 1.0, atol=1e-5)
    assert obs["rgb"].std() > 1.0


def test_points_are_depth_along_the_rays_of_pixel_centres(device):
    """And not a number beside the bin, where no table is."""
    choice = make_choice(**ARGUMENTS | {"obs": ("points",)})
    environment = make_picking(choice, "smoke", SETTINGS | {"render.table": False}, str(device))
    points, sight = environment.reset(seed=3)[0]["points"], environment.worlds.sight
    depth, (fx, fy, cx, cy) = sight.arrays.depth.numpy()[:2], sight.images.views.cameras.intrinsics.numpy()[0]
    x, y = (np.arange(SIZE[0]) + 0.5 - cx) / fx, (np.arange(SIZE[1])[:, None] + 0.5 - cy) / fy
    rays = np.stack(np.broadcast_arrays(x, y, 1.0), axis=-1)
    assert (points.shape, points.dtype) == ((2, *SIZE[::-1], 3), np.float32)
    np.testing.assert_allclose(points, np.where(depth > 0, depth, np.nan)[..., None] * rays, atol=1e-6)
    assert 0.1 < np.isnan(points).mean() < 0.9


def test_the_point_of_the_target_picks_it(target):
    """Along its normal, which the plan of perception has."""
    obs = target.reset(seed=3)[0]
    normal = target.worlds.simulation.plan.normal.numpy()[:2]
    step = target.step(np.concatenate([obs["target_point"], normal], axis=1))
    assert step.reward.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("point", [(0.0, 0.0, 2.0), (0.3, 0.0, 0.1), (0.0, -0.2, 0.1), (0.0, 0.0, -0.01)])
def test_points_beside_the_bin_are_refused(target, point):
    target.reset(seed=3)
    with pytest.raises(ActionError, match=r"environment 1 lies outside of the space about the bin: .*; allowed: \[-0.2"):
        target.step([[0, 0, 0.1, 0, 0, 1], [*point, 0, 0, 1]])


@pytest.mark.parametrize("length", [2.0**900, 1e300, 3, 2.0**-900, 1e-300])
def test_directions_of_any_length_are_directions(target, length):
    """To the bit where the factor is a power of two; 1e300 is infinite in single precision, and 1e-300 is 0."""
    target.reset(seed=3)
    unit = np.array([[0.0, 0.0, 0.1, 0.3, -0.2, 1.0]] * 2)
    active, scaled = np.ones(2, bool), target.check_actions(np.concatenate([unit[:, :3], unit[:, 3:] * length], axis=1), np.ones(2, bool))
    plain = target.check_actions(unit, active)[:, 3:]
    cosines = (scaled[:, 3:] * plain).sum(1) / np.linalg.norm(scaled[:, 3:], axis=1) / np.linalg.norm(plain, axis=1)
    np.testing.assert_allclose(cosines, 1.0, rtol=1e-12)
    assert (np.abs(scaled[:, 3:]).max(axis=1) < 1.0).all()
    assert (np.abs(scaled[:, 3:]).max(axis=1) >= 0.5).all()
    if np.frexp(length)[0] == 0.5:
        np.testing.assert_array_equal(scaled, target.check_actions(unit, active))


def test_a_normal_beyond_single_precision_leaves_the_world_whole(target):
    """Then an episode begins as ever: 1e300 left worlds that never came to rest again."""
    target.reset(seed=3)
    step = target.step([[0.0, 0.0, 0.1, 0.0, 0.0, 1e300], [0.0, 0.0, 0.1, 0.0, 0.0, 1.0]])
    assert np.isfinite(step.obs["state"]).all()
    np.testing.assert_array_equal(step.info["ending"], [0, 0])
    with pytest.raises(ActionError, match="the action of environment 1 is not finite"):
        target.step([[0, 0, 0.1, 0, 0, 1], [0, 0, 0.1, 0, 0, np.longdouble("1e4000")]])


def test_bounds_hold_all_bins(target):
    config = target.worlds.simulation.config
    low, high = action_bounds(config.cell.bins, config.bins)
    positions = target.reset(seed=3)[0]["state"][:, 6:].reshape(-1, 10)
    positions = positions[positions[:, 0] > 0, 3:6]
    assert ((positions > low) & (positions < high)).all()


def test_pictures_have_no_memory(target):
    """A state is complete without the renderer's light history, because environments have none, whatever the settings say."""
    target.reset(seed=3)
    state, before = target.get_state(), target.observe()
    target.step(np.array([[0.0, 0.0, 0.1, 0.0, 0.0, 1.0]] * 2))
    assert same(target.set_state(state), before)
    config = load_config("synpick", {"render.mode": "fast", "render.history": 64})
    assert accumulates(config.render, histories=1)
    assert not accumulates(override_config(config, fixed_settings(target.choice)).render, histories=1)


# ---- arguments ----


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"task": "push"}, 'task is "push"; allowed: pick, target, move'),
        ({"task": "pik"}, "did you mean pick"),
        ({"action": "joint"}, "action is"),
        ({"task": "move", "action": "pixel"}, 'action is "pixel"; task "move" is driven by "twist" alone'),
        ({"obs": ("depht",)}, "obs is .*; did you mean depth"),
        ({"obs": ()}, "obs is empty"),
        ({"obs": ("target_mask",)}, 'obs has target_mask, but task "pick" has no target'),
        ({"backend": "jax"}, "backend is .*; allowed: torch, numpy, warp"),
        ({"course": "near"}, "course is .*; allowed: attempt, trial"),
        ({"course": "trial", "action": "twist"}, 'course is "trial"; action "twist" has no course'),
        ({"autoreset": True}, "autoreset is true; allowed: next_step, same_step, disabled"),
        ({"num_envs": 0}, "num_envs is 0; allowed: a whole number from 1 on"),
        ({"num_envs": 1.5}, "num_envs is 1.5"),
        ({"max_steps": -1}, "max_steps is -1"),
        ({"piles": 0}, "piles is 0"),
        ({"resolution": (64,)}, r"resolution is \[64\]; allowed: width and height"),
        ({"resolution": (64, 0)}, "resolution is"),
        ({"seed": "a"}, 'seed is "a"; allowed: a whole number'),
        ({"seed": -1}, "seed is -1; allowed: a whole number from 0 on"),
    ],
)
def test_bad_arguments_are_refused(changed, message):
    with pytest.raises(ConfigError, match=message):
        make_choice(**(ARGUMENTS | changed))


def test_settings_are_those_given_but_for_what_an_environment_decides(target):
    config = target.worlds.simulation.config
    assert config.pick.failures > 1000
    assert config.bake.mode == "target"
    assert config.arrangement.max_objects == 3
    with pytest.raises(ConfigError, match=r"pick\.near_sped"):
        make_picking(make_choice(**ARGUMENTS), "smoke", {"pick.near_sped": 1})
    with pytest.raises(ConfigError, match="the configuration has its splits already"):
        make_picking(make_choice(**ARGUMENTS), load_config("synpick", splits=True))


def test_without_gymnasium_there_is_one_line(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        ModuleNotFoundError, match=r"^make_env needs Gymnasium, which is not installed: pip install 'synpick-warp\[environment\]'$"
    ):
        synpick_warp.make_env(backend="numpy")


# ---- Gymnasium ----


@needs_gymnasium
def test_the_environment_is_gymnasiums(target):
    import gymnasium  # pyright: ignore[reportMissingImports]

    from synpick_warp.environment.registration import IDS
    from synpick_warp.environment.vector import PickingVectorEnv

    env = PickingVectorEnv(target)
    assert PickingVectorEnv.__bases__ == (gymnasium.vector.VectorEnv,)
    assert env.metadata["autoreset_mode"] is env.autoreset_mode is gymnasium.vector.AutoresetMode.NEXT_STEP
    env.reset(seed=[None, 7])
    assert env.np_random_seed == 7
    obs, _ = env.reset(seed=3)
    assert env.np_random_seed == 3
    assert obs in env.observation_space
    assert env.action_space.sample() in env.action_space
    assert env.single_action_space.shape == (6,)
    assert same(env.set_state(env.get_state()), obs)
    assert {gymnasium.spec(name).kwargs["task"] for name in IDS.values()} == {"pick", "target", "move"}


@needs_gymnasium
@pytest.mark.slow
def test_the_lines_of_the_readme():
    env = synpick_warp.make_env(
        task="pick", num_envs=2, device="cpu", obs=("depth",), resolution=SIZE, action="pixel", backend="numpy", seed=3
    )
    env.reset(seed=3)
    obs, reward, *_ = env.step(env.action_space.sample())
    assert obs["depth"].shape == (2, *SIZE[::-1])
    assert reward.shape == (2,)
