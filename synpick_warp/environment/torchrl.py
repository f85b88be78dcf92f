"""Adapter for TorchRL: its `GymWrapper`, whose partial resets work on a GPU, too.

    env = TorchRlEnv(synpick_warp.make_env(task="pick", num_envs=512, autoreset="disabled"))

This module needs TorchRL.
"""

from __future__ import annotations

from typing import Any

from torchrl.envs.libs.gym import GymWrapper  # pyright: ignore[reportMissingImports]

from synpick_warp.environment.settings import DISABLED, TORCH
from synpick_warp.environment.vector import PickingVectorEnv
from synpick_warp.errors import ConfigError


class TorchRlEnv(GymWrapper):
    """Environment of TorchRL (`EnvBase`): tensors stay on the device, pixels are categorical actions."""

    def __init__(self, env: PickingVectorEnv | None = None, **options: Any) -> None:
        """
        Args:
            env: Environment with autoreset "disabled" and backend "torch".
            options: Further ones of `GymWrapper`.

        Raises:
            ConfigError: It has others.
        """
        if env is not None:
            choice = env.environment.choice
            if choice.autoreset != DISABLED or choice.backend != TORCH:
                raise ConfigError(f'TorchRL needs autoreset "{DISABLED}" and backend "{TORCH}"')
            options = {"device": env.device, "categorical_action_encoding": True, "convert_actions_to_numpy": False} | options
        super().__init__(env=env, **options)

    def _replace_reset(self, reset: Any, kwargs: dict[str, Any]) -> dict[str, Any]:
        """Options of a reset of the environments of a mask (environment, 1) bool on the device."""
        kwargs.setdefault("options", {})["reset_mask"] = reset.view(self.batch_size)
        return kwargs
