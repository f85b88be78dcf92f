"""Adapter for stable-baselines3: a `VecEnv`, whose episodes restart by themselves.

env = Sb3Env(synpick_warp.make_env(task="pick", num_envs=8, action="point", obs=("state",), autoreset="same_step", backend="numpy"))
PPO("MultiInputPolicy", env).learn(1000)
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

from synpick_warp.environment.settings import NUMPY, SAME_STEP
from synpick_warp.environment.vector import PickingVectorEnv
from synpick_warp.errors import ConfigError


class Sb3Env(VecEnv):
    """Vectorized environment of stable-baselines3, whose observations are dictionaries ("MultiInputPolicy")."""

    def __init__(self, env: PickingVectorEnv) -> None:
        """Wrap an environment with autoreset "same_step" and backend "numpy"; raises ConfigError for another."""
        choice = env.environment.choice
        if choice.autoreset != SAME_STEP or choice.backend != NUMPY:
            raise ConfigError(f'stable-baselines3 needs autoreset "{SAME_STEP}" and backend "{NUMPY}"')
        self.env, self.render_mode = env, None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> dict[str, np.ndarray]:
        """Begin episodes in all environments, with the seeds of `seed`, if any."""
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        obs = self.env.reset(seed=seeds)[0]
        self._reset_seeds()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step; an episode that ended has its last observation, and whether it was truncated, in its info."""
        obs, reward, terminated, truncated, info = self.env.step(self._actions)
        done, infos = terminated | truncated, [{"outcome": outcome} for outcome in info["outcome"].tolist()]
        for index in np.flatnonzero(done):
            infos[index]["terminal_observation"] = {name: values[index] for name, values in info["final_obs"].items()}
            infos[index]["TimeLimit.truncated"] = bool(truncated[index] and not terminated[index])
        return obs, reward, done, infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Attribute of the vector environment, once for each of the chosen environments."""
        return [getattr(self.env, attr_name)] * self._count(indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the vector environment."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method of the vector environment once, and return its result for each selected environment."""
        return [getattr(self.env, method_name)(*args, **kwargs)] * self._count(indices)

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """No environment has a wrapper of its own."""
        return [False] * self._count(indices)

    def _count(self, indices: int | Sequence[int] | None) -> int:
        """Number of environments that are chosen."""
        return len(list(self._get_indices(indices)))
