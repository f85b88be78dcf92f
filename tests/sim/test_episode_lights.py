"""Which light an episode is drawn: map, turn, exposure."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.codes import Phase, Stream
from synpick_warp.configs.episodes.randomize import Distribution, Randomize
from synpick_warp.scenes.looks import Looks
from synpick_warp.stages.render.looks import draw_looks
from synpick_warp.stages.sim import arrange
from tests.twins import rng
from tests.worlds.kernel_worlds import KernelWorlds

SEED = 2**40 + 3


def made(device, worlds: int = 24, **drop) -> KernelWorlds:
    """Worlds that draw from five light maps."""
    return KernelWorlds(device, worlds, drop=drop)


def test_lights_are_even_and_turn(device):
    worlds = made(device, worlds=2000)
    worlds.begin(Phase.START)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    counts = np.bincount(worlds.state.light.numpy(), minlength=5)
    assert counts.min() > 330
    assert len(counts) == 5
    keys = [rng.stream_key(SEED, episode, 0, Stream.LIGHT) for episode in range(2000)]
    np.testing.assert_allclose(worlds.state.light_yaw.numpy(), [2 * np.pi * rng.uniform(key, 1) for key in keys], rtol=1e-6)


def test_exposures_are_even_within_their_spread_and_the_episodes_own(device):
    """Half a stop either way: mean 0 and deviation 0.5 / √3, within four standard errors; other worlds draw the same."""
    worlds = made(device, worlds=2000)
    worlds.begin(Phase.START)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    drawn = worlds.state.light_exposure.numpy()
    assert np.abs(drawn).max() <= 0.5
    assert drawn.mean() == pytest.approx(0.0, abs=4 * 0.5 / np.sqrt(3 * 2000))
    np.testing.assert_allclose(np.quantile(drawn, (0.05, 0.25, 0.5, 0.75, 0.95)), (-0.45, -0.25, 0.0, 0.25, 0.45), atol=0.05)
    keys = [rng.stream_key(SEED, episode, 0, Stream.LIGHT) for episode in range(2000)]
    np.testing.assert_allclose(drawn, [rng.uniform(key, 2) - 0.5 for key in keys], atol=1e-6)
    few = made(device, worlds=3)
    few.begin(Phase.START, np.array([1999, 7, 300]))
    arrange.sample_episodes(few.scene, few.state, SEED)
    np.testing.assert_array_equal(few.state.light_exposure.numpy(), drawn[[1999, 7, 300]])
    wide = made(device, worlds=2000, exposure_spread=2.0)
    wide.begin(Phase.START)
    arrange.sample_episodes(wide.scene, wide.state, SEED)
    np.testing.assert_allclose(wide.state.light_exposure.numpy(), 4.0 * drawn, rtol=1e-6)
    np.testing.assert_array_equal(wide.state.light_yaw.numpy(), worlds.state.light_yaw.numpy())


def test_a_distribution_of_exposure_replaces_the_spread_and_is_that_of_the_record(device):
    randomize = Randomize(exposure=Distribution.parse({"uniform": [1.0, 3.0]}))
    plain, own = made(device), KernelWorlds(device, 24, randomize=randomize)
    for worlds in (plain, own):
        worlds.begin(Phase.START, arrangement=2)  # A look is the episode's, not that of one of its arrangements.
        arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    recorded = [draw_looks(Looks(randomize, (), ()), SEED, episode, 0)["exposure"] for episode in range(24)]
    np.testing.assert_allclose(own.state.light_exposure.numpy(), recorded, atol=1e-6)
    assert 1.0 <= min(recorded) < 1.5
    assert 2.5 < max(recorded) <= 3.0
    assert np.abs(plain.state.light_exposure.numpy()).max() <= 0.5


@pytest.mark.parametrize("setting", ["random_yaw", "exposure_spread"])
def test_what_is_not_to_be_drawn_is_zero(device, setting):
    worlds = made(device, **{setting: 0})
    worlds.begin(Phase.START)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    drawn = {"random_yaw": worlds.state.light_yaw, "exposure_spread": worlds.state.light_exposure}
    for name, array in drawn.items():
        assert (array.numpy() == 0.0).all() == (name == setting)
