"""Gymnasium vector environment: a direct subclass of `gymnasium.vector.VectorEnv`."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium  # pyright: ignore[reportMissingImports]
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv  # pyright: ignore[reportMissingImports]
from gymnasium.vector.utils import batch_space  # pyright: ignore[reportMissingImports]

from synpick_warp.codes import Segment
from synpick_warp.environment.episodes import make_seeds
from synpick_warp.environment.picking import ACTION_SIZES, COMMAND, EnvironmentState, PickingEnvironment
from synpick_warp.environment.settings import OBSERVATIONS, PIXEL, POINT, EnvironmentChoice

Box = gymnasium.spaces.Box


class PickingVectorEnv(VectorEnv):
    """Vector environment of suction picking; see `synpick_warp.make_env` and the README of this package.

    `environment` is the one without Gymnasium, which does the work, and `device` the name of the device of the worlds, on which results are
    unless backend is "numpy"."""

    def __init__(self, environment: PickingEnvironment) -> None:
        choice = environment.choice
        self.environment, self.num_envs = environment, choice.num_envs
        self.autoreset_mode = AutoresetMode[choice.autoreset.upper()]
        frame_rate = 1.0 / environment.worlds.simulation.config.physics.tick_time
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": [], "render_fps": frame_rate}
        self.single_observation_space = observation_space(choice, environment)
        self.single_action_space = action_space(choice, *environment.bounds)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.device = str(environment.worlds.device)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin episodes; see `PickingEnvironment.reset`. The first seed seeds `np_random`, too."""
        result = self.environment.reset(seed, options)
        if seed is not None and (seeds := list(make_seeds(seed, self.num_envs).values())):
            self._np_random, self._np_random_seed = gymnasium.utils.seeding.np_random(seeds[0])
        return result

    def step(self, actions: Any) -> tuple[dict[str, Any], Any, Any, Any, dict[str, Any]]:
        """Carry out an action in each environment; see `PickingEnvironment.step`."""
        return self.environment.step(actions)

    def observe(self) -> dict[str, Any]:
        """Render the current observation; see `PickingEnvironment.observe`."""
        return self.environment.observe()

    def get_state(self) -> EnvironmentState:
        """Save a checkpoint of all environments; see `PickingEnvironment.get_state`."""
        return self.environment.get_state()

    def set_state(self, state: EnvironmentState, mask: Any = None) -> dict[str, Any]:
        """Load a checkpoint; see `PickingEnvironment.set_state`."""
        return self.environment.set_state(state, mask)

    def branch(self, environment: int, into: Sequence[int]) -> dict[str, Any]:
        """Copy the state of an environment to others; see `PickingEnvironment.branch`."""
        return self.environment.branch(environment, into)


def observation_space(choice: EnvironmentChoice, environment: PickingEnvironment) -> Any:
    """Observation space of a single environment (`Dict` of boxes)."""
    width, height = choice.resolution
    limits: Mapping[str, tuple[float, float, tuple[int, ...], Any]] = {
        "depth": (0.0, np.inf, (height, width), np.float32),
        "rgb": (0, 255, (height, width, 3), np.uint8),
        "instances": (0, int(Segment.CUP), (height, width), np.uint8),
        "normals": (-np.inf, np.inf, (height, width, 3), np.float32),
        "points": (-np.inf, np.inf, (height, width, 3), np.float32),
        "target_mask": (0, 1, (height, width), np.uint8),
        "target_point": (-np.inf, np.inf, (3,), np.float32),
    }
    spaces = {name: Box(low, high, shape, kind) for name, (low, high, shape, kind) in limits.items() if name in choice.obs}
    if "state" in choice.obs:
        values = getattr(environment.worlds.sight.arrays, OBSERVATIONS["state"]).shape[1]
        spaces["state"] = Box(-np.inf, np.inf, (values,), np.float32)
    return gymnasium.spaces.Dict({name: spaces[name] for name in choice.obs})


def action_space(choice: EnvironmentChoice, low: np.ndarray, high: np.ndarray) -> Any:
    """Action space of a single environment."""
    if choice.action == PIXEL:
        return gymnasium.spaces.MultiDiscrete(list(choice.resolution))
    if choice.action == POINT:
        ends = [np.append(low, (-1.0, -1.0, 0.0)), np.append(high, (1.0, 1.0, 1.0))]
        return Box(*(np.array(end, np.float32) for end in ends), shape=(ACTION_SIZES[POINT],), dtype=np.float32)
    return Box(-1.0, 1.0, (COMMAND,), np.float32)
