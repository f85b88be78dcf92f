"""Arguments of `make_env`: their check, and the settings of the worlds and action bounds that follow from them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.check import to_index
from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.configs.schema import Bins
from synpick_warp.errors import ConfigError, format_value, suggest

PICK, TARGET, MOVE = TASKS = ("pick", "target", "move")
PIXEL, POINT, TWIST = ACTIONS = ("pixel", "point", "twist")
NEXT_STEP, SAME_STEP, DISABLED = AUTORESETS = ("next_step", "same_step", "disabled")
ATTEMPT, TRIAL = COURSES = ("attempt", "trial")
TORCH, NUMPY, WARP = BACKENDS = ("torch", "numpy", "warp")
OBSERVATIONS: Mapping[str, str] = {
    "depth": "depth",
    "rgb": "color",
    "instances": "segment",
    "normals": "normal",
    "points": "cloud",
    "state": "state",
    "target_mask": "mask",
    "target_point": "point",
}
"""Name of an observation -> field of `SightArrays`."""
TARGETS = ("target_mask", "target_point")
"""Observations of task TARGET, which are always added to it (the mask only if other images are observed), and which others lack."""
IMAGES = ("depth", "rgb", "instances", "normals", "points", "target_mask")
MAX_STEPS: Mapping[str, int] = {PIXEL: 30, POINT: 30, TWIST: 600}
"""Steps after which an episode is truncated, by action: attempts, or ticks (40 s)."""
RESAMPLES = 1000
"""Arrangements that are tried until a pile comes to rest (`settle.tries`): an environment cannot skip a pile, as a bake can."""
HEADROOM = 0.3
"""Height above the rim up to which an action may name points; setpoints of twists may rise by as much again [m]."""


@dataclass(frozen=True)
class EnvironmentChoice:
    """Arguments of `make_env`, checked."""

    task: str
    num_envs: int
    obs: tuple[str, ...]
    resolution: tuple[int, int]
    action: str
    autoreset: str
    backend: str
    seed: int
    max_steps: int
    piles: int
    """Number of different piles from which episodes are drawn."""
    course: str
    """Course of a whole pick: that of an attempt of a bake, or of a grasp trial."""


def make_choice(
    task: str,
    num_envs: int,
    obs: Sequence[str],
    resolution: Sequence[int],
    action: str | None,
    autoreset: str,
    backend: str,
    seed: int,
    max_steps: int | None,
    piles: int | None,
    course: str,
) -> EnvironmentChoice:
    """Check arguments of `make_env`; raises ConfigError if a value is not allowed."""
    _check_choice("task", task, TASKS)
    action = action or (TWIST if task == MOVE else PIXEL)
    _check_choice("action", action, ACTIONS)
    for name, value, allowed in (("autoreset", autoreset, AUTORESETS), ("backend", backend, BACKENDS), ("course", course, COURSES)):
        _check_choice(name, value, allowed)
    if course == TRIAL and action == TWIST:
        raise ConfigError(f'course is "{TRIAL}"; action "{TWIST}" has no course')
    if task == MOVE and action != TWIST:
        raise ConfigError(f'action is "{action}"; task "{MOVE}" is driven by "{TWIST}" alone')
    names = (obs,) if isinstance(obs, str) else tuple(obs)
    for name in names:
        _check_choice("obs", name, tuple(OBSERVATIONS))
        if name in TARGETS and task != TARGET:
            raise ConfigError(f'obs has {name}, but task "{task}" has no target')
    if task == TARGET:
        names += (TARGETS[1],) if not set(names) & set(IMAGES) else TARGETS
    if not names:
        raise ConfigError(f"obs is empty; allowed: one or more of {', '.join(OBSERVATIONS)}")
    limits = {"num_envs": num_envs, "max_steps": MAX_STEPS[action] if max_steps is None else max_steps}
    limits |= {"piles": INT32_MAX if piles is None else piles}
    for name, value in limits.items():
        if (to_index(value) or 0) < 1:
            raise ConfigError(f"{name} is {format_value(value)}; allowed: a whole number from 1 on")
    sides = [to_index(side) or 0 for side in resolution] if isinstance(resolution, Sequence) else []
    if len(sides) != 2 or min(sides) < 1:
        raise ConfigError(f"resolution is {format_value(resolution)}; allowed: width and height [px]")
    number = to_index(seed)
    if number is None or number < 0:
        raise ConfigError(f"seed is {format_value(seed)}; allowed: a whole number from 0 on")
    images = tuple(dict.fromkeys(names)), (sides[0], sides[1])
    rest = int(limits["max_steps"]), min(int(limits["piles"]), INT32_MAX)
    return EnvironmentChoice(task, int(num_envs), *images, action, autoreset, backend, number, *rest, course)


def fixed_settings(choice: EnvironmentChoice) -> dict[str, object]:
    """Settings that follow from the arguments of `make_env`: full key -> value; they override the caller's."""
    fixed: dict[str, object] = {
        "bake.worlds": choice.num_envs,
        "bake.mode": choice.task,
        "cameras.resolution": list(choice.resolution),
        "pick.failures": INT32_MAX,
        "settle.tries": RESAMPLES,
        "render.mode": "unoccluded",
        "render.history": 0,
        "render.layers": [],
    }
    if choice.task != TARGET:
        fixed["perception.views"] = 1
    if "rgb" not in choice.obs:
        fixed["render.views_per_batch"] = 1
    return fixed


def action_bounds(sizes: Sequence[BinSizes], bins: Bins) -> tuple[np.ndarray, np.ndarray]:
    """Bounding box of the points that an action may name, over all bins and their poses: lower and upper corner (3) float32 [m], world."""
    sides = []
    for one in sizes:
        half, cosine, sine = np.array(one.opening) / 2, abs(math.cos(one.turn)), abs(math.sin(one.turn))
        reach = np.full(2, np.hypot(*half)) if bins.yaw > 0 else cosine * half + sine * half[::-1]
        sides.append(np.abs(one.origin[:2]) + reach + np.abs(bins.shift))
    across = np.max(sides, axis=0)
    ground = min(one.origin[2] for one in sizes)
    height = max(one.origin[2] + one.height for one in sizes)
    return np.array([*-across, ground], np.float32), np.array([*across, height + HEADROOM], np.float32)


def _check_choice(name: str, value: object, allowed: Sequence[str]) -> None:
    """Raise ConfigError if a value is not one of the allowed names."""
    if value not in allowed:
        hint = suggest(value, allowed) if isinstance(value, str) else ""
        raise ConfigError(f"{name} is {format_value(value)}; allowed: {', '.join(allowed)}{hint}")
