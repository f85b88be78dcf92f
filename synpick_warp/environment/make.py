"""Assembly of an environment from settings."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.configs.schema import Config
from synpick_warp.environment.picking import PickingEnvironment
from synpick_warp.environment.settings import (
    HEADROOM,
    OBSERVATIONS,
    PIXEL,
    TARGET,
    TORCH,
    TWIST,
    Choice,
    action_bounds,
    make_choice,
    make_config,
)
from synpick_warp.errors import ConfigError
from synpick_warp.factory.assembly import build_smallest, build_stages, compiling_if_cold
from synpick_warp.factory.memory_plan import check_memory, explain_shortage, plan_memory
from synpick_warp.factory.sizes import fit_to_device
from synpick_warp.stages.environment.sight import Sight
from synpick_warp.stages.environment.twist import TwistLaw
from synpick_warp.stages.environment.worlds import EnvironmentWorlds
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import Progress, SilentProgress

NO_WRITERS = 0
"""Writer processes in the memory plan: none."""
CACHE = 4096
"""Most piles that are kept of those that `piles` names; others are settled again when they are wanted."""


def make_vector(
    config: Config | Path | str | None,
    settings: Mapping[str, object],
    device: str | None,
    arguments: Mapping[str, Any],
    progress: Progress | None,
) -> Any:
    """Make a `PickingVectorEnv`; arguments and errors as of `synpick_warp.make_env`, `arguments` being those of `make_choice`."""
    choice = make_choice(**arguments)
    for module, package in (("gymnasium", "gymnasium"), *([("torch", "torch")] if choice.backend == TORCH else [])):
        if importlib.util.find_spec(module) is None:
            wanted = f'backend="{choice.backend}" needs PyTorch' if module == "torch" else "make_env needs Gymnasium"
            raise ModuleNotFoundError(f"{wanted}, which is not installed: pip install {package}", name=module)
    from synpick_warp.environment.vector import PickingVectorEnv

    resolved = make_config(choice, config, settings, device)
    return PickingVectorEnv(make_picking(choice, resolved, progress or SilentProgress()))


def make_picking(choice: Choice, config: Config, progress: Progress) -> PickingEnvironment:
    """Build worlds and observations on the device of the settings.

    Raises:
        SynpickError: The machine has too little memory, or device, models, lights, bin or cameras cannot be used.
    """
    device = pick_device(config.bake.device)
    config = fit_to_device(config, device, 1, NO_WRITERS)
    check_memory(plan_memory(config, device, NO_WRITERS), device)
    with explain_shortage(config):
        smallest = partial(build_smallest, config, device, SilentProgress(), False, True)
        with compiling_if_cold(smallest, device, progress):
            stages = build_stages(config, device, progress, [])
        config, simulation = stages.config, stages.simulation
        camera = config.rig.index(config.perception.camera)
        group = next(one for one in stages.groups if camera in one.cameras)
        if group.placed:
            raise ConfigError(f"{config.rig.label(camera)} is not the same in all episodes; environments observe a fixed camera")
        bounds = action_bounds(config)
        law = None
        if choice.action == TWIST:
            tcp = np.array([0.0, 0.0, config.gripper.cup_length])
            law = TwistLaw(simulation, bounds[0] + tcp, bounds[1] + tcp + (0.0, 0.0, HEADROOM))
            simulation.behavior = replace(simulation.behavior, law=law)
        wanted = [OBSERVATIONS[name] for name in choice.obs] + (["depth"] if choice.action == PIXEL else [])
        if "rgb" in choice.obs and not group.colors:
            raise ConfigError(f"obs has rgb, but {config.rig.label(camera)} has none among its modalities")
        sight = Sight(config.perception, config.rig, simulation, group, choice.resolution, wanted, shows_gripper=law is not None)
        kept = choice.piles if choice.piles <= CACHE else 0
        worlds = EnvironmentWorlds(simulation, sight, choice.num_envs, kept, law, choice.task == TARGET)
    return PickingEnvironment(choice, worlds, bounds)
