"""Builder of the vector environment: resolves settings, and allocates worlds and observations on a device."""

import importlib.util
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from synpick_warp.configs.schema import Config
from synpick_warp.environment import settings as env_settings
from synpick_warp.environment.picking import PickingEnvironment
from synpick_warp.errors import ConfigError
from synpick_warp.factory.assembly import build_online
from synpick_warp.factory.memory_plan import explain_shortage
from synpick_warp.online.stream import resolve_settings
from synpick_warp.stages.environment.worlds import EnvironmentWorlds, Sight, TwistLaw
from synpick_warp.stages.sim.trials import TrialLaw, make_course
from synpick_warp.system.progress import LoggedProgress, Progress

CACHE = 4096
"""Largest number of different piles (`piles`) at which all are kept; of more, a pile is settled again whenever it is drawn."""


def require_libraries(backend: str) -> None:
    """Raise ModuleNotFoundError unless Gymnasium and the library of the arrays are installed."""
    wanted = [("gymnasium", "make_env needs Gymnasium", "'synpick-warp[environment]'")]
    if backend == env_settings.TORCH:
        wanted.append(("torch", f'backend="{env_settings.TORCH}" needs PyTorch', "torch"))
    for module, reason, package in wanted:
        if importlib.util.find_spec(module) is None:
            raise ModuleNotFoundError(f"{reason}, which is not installed: pip install {package}", name=module)


def make_picking(
    choice: env_settings.EnvironmentChoice,
    source: Config | Path | str | None = None,
    settings: Mapping[str, object] = MappingProxyType({}),
    device_name: str | None = None,
    progress: Progress | None = None,
    perceives: bool = False,
) -> PickingEnvironment:
    """Build a vector environment on a device, from checked arguments of `make_env` and settings as for `bake`; `vector.PickingVectorEnv`
    wraps it for Gymnasium.

    `device_name` overrides `bake.device`; `perceives`: whether the paper's heuristic plans a grasp before each attempt in every task
    (`worlds.simulation.plan`), not in target alone; it chooses as in a bake of this mode. Raises SynpickError if a setting is not allowed,
    the machine has too little memory, or device, models, lights, bin or cameras cannot be used."""
    progress = progress or LoggedProgress()
    config = resolve_settings(source, {**settings, **env_settings.fixed_settings(choice)}, {"device": device_name})
    if choice.course == env_settings.TRIAL:
        config = config.with_values({"pick.lift_height": config.picks.lift_height})
    stages = build_online(config, progress, [])
    config, simulation = stages.config, stages.simulation
    with explain_shortage(config):
        camera = config.rig.index(config.perception.camera)
        group = next(one for one in stages.groups if camera in one.cameras)
        if group.placed:
            raise ConfigError(f"{config.rig.label(camera)} is not the same in all episodes; environments observe a fixed camera")
        bounds = env_settings.action_bounds(config.cell.bins, config.bins)
        law = None
        if choice.action == env_settings.TWIST:
            tcp = np.array([0.0, 0.0, config.gripper.cup_length])
            law = TwistLaw(simulation, bounds[0] + tcp, bounds[1] + tcp + (0.0, 0.0, env_settings.HEADROOM))
        path = law or (TrialLaw(make_course(config.picks, config.physics, config.pick)) if choice.course == env_settings.TRIAL else None)
        if path is not None:
            simulation.behavior = replace(simulation.behavior, law=path)
        wanted = [env_settings.OBSERVATIONS[name] for name in choice.obs] + (["depth"] if choice.action == env_settings.PIXEL else [])
        if "rgb" in choice.obs and not group.colors:
            raise ConfigError(f"obs has rgb, but {config.rig.label(camera)} has none among its modalities")
        sight = Sight(config.perception, config.rig, simulation, group, choice.resolution, wanted, shows_gripper=law is not None)
        kept = choice.piles if choice.piles <= CACHE else 0
        worlds = EnvironmentWorlds(simulation, sight, choice.num_envs, kept, law, perceives or choice.task == env_settings.TARGET)
    return PickingEnvironment(choice, worlds, bounds)
