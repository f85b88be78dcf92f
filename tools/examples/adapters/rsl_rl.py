"""Adapter for rsl_rl: a `VecEnv` whose observations are a TensorDict.

env = RslRlEnv(synpick_warp.make_env(task="pick", num_envs=512, action="point", obs=("state",), autoreset="same_step"))
OnPolicyRunner(env, settings).learn(100)
"""

from typing import Any

import torch  # pyright: ignore[reportMissingImports]
from rsl_rl.env import VecEnv  # pyright: ignore[reportMissingImports]
from tensordict import TensorDict  # pyright: ignore[reportMissingImports]

from synpick_warp.environment.settings import PIXEL, SAME_STEP, TORCH
from synpick_warp.environment.vector import PickingVectorEnv
from synpick_warp.errors import ConfigError

GROUPS = ("rgb", "normals")
"""Observations whose last dimension is the channel."""
WHITE = 255.0


class RslRlEnv(VecEnv):
    """Environment of rsl_rl: actions from -1 to 1, images with their channels first, colours from 0 to 1.

    Attributes:
        max_episode_length: Steps after which an episode is truncated.
        cfg: Task and action of the environment, for rsl_rl's logs.
    """

    def __init__(self, env: PickingVectorEnv) -> None:
        """Wrap an environment with action "point" or "twist", autoreset "same_step", backend "torch"; raises ConfigError for another."""
        choice = env.environment.choice
        if choice.action == PIXEL or choice.autoreset != SAME_STEP or choice.backend != TORCH:
            raise ConfigError(f'rsl_rl needs action "point" or "twist", autoreset "{SAME_STEP}" and backend "{TORCH}"')
        self.env, self.num_envs, self.device = env, env.num_envs, torch.device(env.device)
        low, high = (torch.as_tensor(end, device=self.device) for end in (env.single_action_space.low, env.single_action_space.high))
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        self.num_actions, self.max_episode_length, self.cfg = len(low), choice.max_steps, {"task": choice.task, "action": choice.action}
        self._obs = env.reset()[0]

    @property
    def episode_length_buf(self) -> Any:
        """Steps of each environment's episode (environment) int64; can be set."""
        return torch.as_tensor(self.env.environment.episodes.steps, device=self.device)

    @episode_length_buf.setter
    def episode_length_buf(self, steps: Any) -> None:
        self.env.environment.episodes.steps[:] = steps.cpu().numpy()

    def get_observations(self) -> Any:
        """Current observations, a TensorDict with batch size (environment)."""
        return TensorDict({name: _channels_first(name, values) for name, values in self._obs.items()}, batch_size=[self.num_envs])

    def reset(self) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode in all environments; returns observations and info."""
        self._obs, info = self.env.reset()
        return self.get_observations(), info

    def step(self, actions: Any) -> tuple[Any, Any, Any, dict[str, Any]]:
        """Step with actions (environment, value), clamped to -1 to 1 and scaled to the action space."""
        self._obs, reward, terminated, truncated, info = self.env.step(self._middle + self._half * actions.clamp(-1.0, 1.0))
        log = {f"/{name}": info[name].float().mean() for name in ("moved", "lost")}
        return self.get_observations(), reward, terminated | truncated, {"time_outs": truncated, "log": log}


def _channels_first(name: str, values: Any) -> Any:
    """Observation in the layout of rsl_rl's networks: vectors as they are, images (environment, channel, row, column) float32."""
    if values.ndim < 3:
        return values
    images = values.movedim(-1, 1) if name in GROUPS else values.unsqueeze(1)
    return images.float() / WHITE if name == "rgb" else images.float()
