"""Adapter for TorchRL: a `GymWrapper` whose partial resets also work on a GPU.

env = TorchRlEnv(synpick_warp.make_env(task="pick", num_envs=512, autoreset="disabled"))
"""

from typing import Any

from torchrl.envs.libs.gym import GymWrapper  # pyright: ignore[reportMissingImports]

from synpick_warp.environment.settings import DISABLED, TORCH
from synpick_warp.environment.vector import PickingVectorEnv
from synpick_warp.errors import ConfigError


class TorchRlEnv(GymWrapper):
    """TorchRL environment (`EnvBase`): tensors stay on the device, actions of pixels are categorical."""

    def __init__(self, env: PickingVectorEnv | None = None, **options: Any) -> None:
        """Wrap an environment with autoreset "disabled" and backend "torch" by `GymWrapper`; raises ConfigError for another."""
        if env is not None:
            choice = env.environment.choice
            if choice.autoreset != DISABLED or choice.backend != TORCH:
                raise ConfigError(f'TorchRL needs autoreset "{DISABLED}" and backend "{TORCH}"')
            options = {"device": env.device, "categorical_action_encoding": True, "convert_actions_to_numpy": False} | options
        super().__init__(env=env, **options)

    def _replace_reset(self, reset: Any, kwargs: dict[str, Any]) -> dict[str, Any]:
        """Arguments of a partial reset, from TorchRL's mask (environment, 1) bool on the device."""
        kwargs.setdefault("options", {})["reset_mask"] = reset.view(self.batch_size)
        return kwargs
