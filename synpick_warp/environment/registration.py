"""Registration of the environments with Gymnasium, by id; importing this module carries it out.

env = gymnasium.make_vec("synpick_warp.environment.registration:SynPick/Pick-v0", num_envs=8)
"""

from typing import Any

import gymnasium  # pyright: ignore[reportMissingImports]

import synpick_warp
from synpick_warp.environment.settings import TASKS

IDS = {task: f"SynPick/{task.capitalize()}-v0" for task in TASKS}
"""Id of each task."""


def make(num_envs: int = 1, max_episode_steps: int | None = None, **arguments: Any) -> Any:
    """Entry point of `gymnasium.make_vec`: make a vector environment by `make_env`."""
    return synpick_warp.make_env(num_envs=num_envs, max_steps=max_episode_steps, **arguments)


for _task, _name in IDS.items():
    gymnasium.register(_name, vector_entry_point=f"{__name__}:make", kwargs={"task": _task})
