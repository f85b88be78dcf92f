"""Vector environment of suction picking, independent of Gymnasium: reset, step, autoreset, checkpoints and branches.

`vector` wraps it as a Gymnasium environment.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from synpick_warp.codes import Ending, Outcome, Phase
from synpick_warp.environment import settings as env_settings
from synpick_warp.environment.episodes import Episodes, check_mask, choose_environments, choose_indices, host_array, make_seeds
from synpick_warp.errors import ActionError, StateError
from synpick_warp.stages.environment.worlds import EnvironmentWorlds
from synpick_warp.stages.sim.states import State, check_array

TWIST_SPEED, TWIST_RATE = 0.25, 1.0
"""Velocity [m/s] and angular rates [rad/s] that a twist of 1 commands; whole picks descend the last 5 cm at 0.1 m/s."""
ACTION_SIZES = {env_settings.PIXEL: 2, env_settings.POINT: 6}
"""Values of an action of a whole pick."""
COMMAND = 6
"""Values of a twist."""


@dataclass(frozen=True, eq=False)
class EnvironmentState:
    """Checkpoint of all environments: states of their worlds on the device, and episode counters on the host."""

    worlds: State
    episodes: Episodes


class EnvironmentStep(NamedTuple):
    """Result of a step as Gymnasium defines it; arrays (environment, ...) of the caller's library."""

    obs: dict[str, Any]
    reward: Any
    terminated: Any
    truncated: Any
    info: dict[str, Any]


class PickingEnvironment:
    """Vector environment whose actions are whole picks, or twists of the gripper for a tick; see the README of this package.

    `bounds` are the lowest and highest point that an action may name, each (3) float32 [m]."""

    def __init__(self, choice: env_settings.EnvironmentChoice, worlds: EnvironmentWorlds, bounds: tuple[np.ndarray, np.ndarray]) -> None:
        self.choice, self.worlds, self.bounds = choice, worlds, bounds
        self.count = choice.num_envs
        self.exporter = ArrayExporter(choice.backend, worlds.device)
        self.episodes = Episodes.of(self.count)
        self.episodes.reseed(make_seeds(choice.seed, self.count), np.arange(self.count))
        self._is_new = True
        """Whether no environment has been reset yet."""

    def reset(
        self, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin episodes in all environments, or after the first in those that `options` choose; returns the observation of all, and info.

        `seed` is that of environment 0, the others get `seed` + 1 and so on; or a sequence of one for each, of which None continue with
        their next episodes, as all do by default. Options: "reset_mask" (environment) bool or "env_idx", the environments to reset;
        "episode", an episode index, or one for each environment that is reset. Raises ConfigError if a seed or an option is not allowed,
        and StateError if a pile does not come to rest."""
        options = options or {}
        chosen = choose_environments(options, self.count)
        if self._is_new:
            chosen = np.arange(self.count)
        if seed is not None:
            self.episodes.reseed(make_seeds(seed, self.count), chosen)
        self._begin(chosen, choose_indices(options, len(chosen)))
        self._is_new = False
        return self.observe(), self._describe()

    def step(self, actions: Any) -> EnvironmentStep:
        """Carry out an action in each environment, a whole pick or a tick, and reset episodes that have ended, as `autoreset` says. Raises
        ActionError if actions have another shape, are not finite, or lie outside of the image or `bounds`, and StateError if the
        environment has not been reset."""
        if self._is_new:
            raise StateError("an environment is reset before its first step")
        episodes, autoreset = self.episodes, self.choice.autoreset
        over = episodes.over.copy()
        results = self._act(~over, self.check_actions(actions, ~over))
        reward = np.where(over, 0.0, self._reward(results)).astype(np.float32)
        self._judge(~over)
        terminated, truncated = episodes.terminated.copy(), episodes.truncated.copy()
        info = self._describe(results)
        if autoreset == env_settings.NEXT_STEP:
            terminated[over] = truncated[over] = False
            if over.any():
                self._begin(np.flatnonzero(over))
                info = self._describe(results)
        obs = self.observe()
        if autoreset == env_settings.SAME_STEP and episodes.over.any():
            ended = episodes.over.copy()
            final, info = info, {}
            self._begin(np.flatnonzero(ended))
            mask = self.exporter.from_host(ended)
            info = self._describe(results)
            info |= {"final_obs": obs, "_final_obs": mask, "final_observation": obs, "_final_observation": mask}
            info |= {"final_info": final, "_final_info": mask}
            obs = self.observe()
        reward, terminated, truncated = (self.exporter.from_host(values) for values in (reward, terminated, truncated))
        return EnvironmentStep(obs, reward, terminated, truncated, info)

    def observe(self) -> dict[str, Any]:
        """Render the observation of all environments: arrays (environment, ...) by name."""
        arrays = self.worlds.sight.observe(self.worlds.simulation.record.snapshot)
        return {name: self.exporter.from_device(getattr(arrays, env_settings.OBSERVATIONS[name]), self.count) for name in self.choice.obs}

    def get_state(self) -> EnvironmentState:
        """Save a checkpoint of all environments, from which they continue bit by bit; raises StateError if memory is too short."""
        return EnvironmentState(self.worlds.simulation.get_state(range(self.count)), self.episodes.copy())

    def set_state(self, state: EnvironmentState, mask: Any = None) -> dict[str, Any]:
        """Load a checkpoint into the environments of a mask (environment) bool; None: into all. Returns the observation. Raises ConfigError
        if the mask has another type or shape, and StateError if the state has another number of environments, or is of other worlds."""
        chosen = np.arange(self.count) if mask is None else np.flatnonzero(check_mask("mask", mask, self.count))
        if len(state.worlds) != self.count:
            raise StateError(f"the state is of {len(state.worlds)} environments, not of {self.count}")
        self.worlds.simulation.set_state(state.worlds, chosen.tolist(), chosen.tolist())
        self.episodes.assign(state.episodes, chosen)
        self._is_new = False
        return self.observe()

    def branch(self, environment: int, into: Sequence[int]) -> dict[str, Any]:
        """Copy the state of an environment to those of `into`; returns the observation. Raises StateError if one does not exist."""
        if wrong := [index for index in (environment, *into) if not 0 <= index < self.count]:
            raise StateError(f"there is no environment {wrong[0]}; there are 0 to {self.count - 1}")
        self.worlds.simulation.branch(environment, into)
        self.episodes.assign(self.episodes.copy(), list(into), environment)
        return self.observe()

    def state_to_host(self, state: EnvironmentState) -> dict[str, np.ndarray]:
        """Copy a checkpoint to the host: arrays by name, which `np.savez` can store."""
        counters = {f"episodes.{name}": array for name, array in vars(state.episodes).items()}
        return self.worlds.simulation.states.to_host(state.worlds) | counters

    def state_from_host(self, arrays: Mapping[str, np.ndarray]) -> EnvironmentState:
        """Copy a checkpoint from the host to the device: the inverse of `state_to_host`. Raises StateError if it is of another version,
        other objects, cell or capacities, or an array is missing, has another shape or type, or is not finite."""
        likes = vars(self.episodes)
        counters = {name: check_array(f"episodes.{name}", arrays, like.dtype, like.shape) for name, like in likes.items()}
        return EnvironmentState(self.worlds.simulation.states.from_host(arrays), Episodes(**counters))

    def check_actions(self, actions: Any, active: np.ndarray) -> np.ndarray:
        """Check actions and copy them to the host (environment, value); those of inactive environments become 0. Errors as of `step`."""
        given, action = to_host(actions), self.choice.action
        shape = (self.count, ACTION_SIZES.get(action, COMMAND))
        if given.shape != shape:
            raise ActionError(f"actions have the shape {given.shape}; allowed: {shape}, of a {action} for each environment")
        given = np.where(active[:, None], given, np.zeros((), given.dtype))
        with np.errstate(over="ignore"):
            finite = np.isfinite(given.astype(np.float64)).all(axis=1)
        if wrong := np.flatnonzero(~finite).tolist():
            raise ActionError(f"the action of environment {wrong[0]} is not finite: {given[wrong[0]].tolist()}")
        if action == env_settings.PIXEL:
            if wrong := np.flatnonzero((given != np.floor(given)).any(axis=1)).tolist():
                raise ActionError(f"the action of environment {wrong[0]} is no pixel: {given[wrong[0]].tolist()}; allowed: column and row")
            self._check_within(given, np.zeros(2, int), np.array(self.choice.resolution) - 1, active, "image")
        if action == env_settings.POINT:
            self._check_within(given[:, :3], *self.bounds, active, "space about the bin")
            given = np.concatenate([given[:, :3], _scaled(given[:, 3:])], axis=1)
        return given

    def _check_within(self, given: np.ndarray, low: np.ndarray, high: np.ndarray, active: np.ndarray, place: str) -> None:
        """Raise ActionError if an active environment's values lie outside of low to high."""
        outside = active & ((given < low) | (given > high)).any(axis=1)
        if wrong := np.flatnonzero(outside).tolist():
            where = f"allowed: {low.round(3).tolist()} to {high.round(3).tolist()}"
            raise ActionError(f"the action of environment {wrong[0]} lies outside of the {place}: {given[wrong[0]].tolist()}; {where}")

    def _act(self, active: np.ndarray, actions: np.ndarray) -> dict[str, np.ndarray]:
        """Carry out checked actions in active environments; returns the results by name."""
        if self.choice.action == env_settings.PIXEL:
            return self.worlds.attempt_pixels(active, actions.astype(np.int32))
        if self.choice.action == env_settings.POINT:
            return self.worlds.attempt_points(active, actions[:, :3], actions[:, 3:])
        scale = np.array([TWIST_SPEED] * 3 + [TWIST_RATE] * 2 + [1.0])
        return self.worlds.tick(active, np.clip(actions, -1.0, 1.0) * scale)

    def _reward(self, results: Mapping[str, np.ndarray]) -> np.ndarray:
        """Reward of the task (environment), see the README."""
        if self.choice.task == env_settings.MOVE:
            return results["moved"]
        if self.choice.task == env_settings.TARGET:
            return results["outcome"] == Outcome.TARGET_PICKED
        return np.isin(results["outcome"], (Outcome.TARGET_PICKED, Outcome.OTHER_PICKED))

    def _judge(self, active: np.ndarray) -> None:
        """Count a step of active environments, and set their flags `terminated` and `truncated`."""
        episodes, (phase, ending) = self.episodes, self.worlds.status()
        ended = active & (phase == Phase.OVER)
        emptied = ended & (ending == Ending.EMPTIED)
        episodes.steps[active] += 1
        episodes.terminated[active] = emptied[active]
        episodes.truncated[active] = (ended & ~emptied | (episodes.steps >= self.choice.max_steps) & ~emptied)[active]

    def _begin(self, environments: np.ndarray, indices: np.ndarray | None = None) -> None:
        """Begin episodes in environments: those of `indices`, or None: the next ones drawn."""
        episodes, piles = self.episodes, self.choice.piles
        drawn = episodes.draw(environments, piles)
        episodes.count[environments] += 1
        following = episodes.draw(np.arange(self.count), piles)
        chosen = drawn if indices is None else indices
        self.worlds.reset(environments, chosen.tolist(), following.tolist())
        episodes.begin(environments, chosen)

    def _describe(self, results: Mapping[str, np.ndarray] | None = None) -> dict[str, Any]:
        """Info of all environments: episode index, steps, ending and results of a step; arrays by name, each with its mask `_name`."""
        episodes = self.episodes
        arrays: dict[str, np.ndarray] = {"episode_index": episodes.index.copy(), "steps": episodes.steps.copy()}
        arrays["ending"] = self.worlds.status()[1].copy()
        arrays |= results or {}
        exported = {name: self.exporter.from_host(values) for name, values in arrays.items()}
        return exported | {f"_{name}": self.exporter.from_host(np.ones(self.count, bool)) for name in arrays}


def _scaled(directions: np.ndarray) -> np.ndarray:
    """Scale directions (environment, 3) of any length by powers of two, so that single precision holds them; their digits are kept."""
    values = directions.astype(np.float64)
    return np.ldexp(values, -np.frexp(np.abs(values).max(axis=1, keepdims=True))[1])


VECTORS = (wp.vec3, wp.vec3ub)


def to_host(values: Any) -> np.ndarray:
    """Copy actions (array of NumPy, PyTorch or Warp, or nested lists) to the host; raises ActionError if they are not numbers."""
    try:
        array = host_array(values)
    except ValueError as error:
        raise ActionError(f"actions have no common shape: {error}") from error
    if array.dtype.kind not in "biuf":
        raise ActionError(f"actions are {array.dtype}; allowed: numbers")
    return array


class ArrayExporter:
    """Converter of arrays to the caller's library (`backend`); results own their memory, so that a later step does not change them."""

    def __init__(self, backend: str, device: wp.Device) -> None:
        self.backend, self.device = backend, device

    def from_device(self, array: wp.array, count: int) -> Any:
        """Copy the first `count` rows of a device array; components of vectors become the last dimension."""
        if self.backend == env_settings.NUMPY:
            return array[:count].numpy().copy()
        rows: Any = array[:count]
        return self._export(wp.clone(_flatten_vectors(rows) if array.dtype in VECTORS else rows))

    def from_host(self, values: np.ndarray) -> Any:
        """Convert an array of the host: to the device, or for backend "numpy" as it is."""
        if self.backend == env_settings.NUMPY:
            return values
        scalar = wp.bool if values.dtype.kind == "b" else wp.dtype_from_numpy(values.dtype)
        return self._export(wp.array(np.ascontiguousarray(values), dtype=scalar, device=self.device))

    def _export(self, array: wp.array) -> Any:
        """Convert a device array that nothing else refers to; for PyTorch on a GPU, its content is complete on all streams."""
        if self.backend == env_settings.TORCH:
            if self.device.is_cuda:
                wp.synchronize_device(self.device)
            return wp.to_torch(array)
        return array


def _flatten_vectors(array: wp.array) -> wp.array:
    """View of a contiguous array of vectors as scalars, with their components as the last dimension; valid as long as the array."""
    scalar, length = array.dtype._wp_scalar_type_, array.dtype._length_
    return wp.array(ptr=array.ptr, dtype=scalar, shape=(*array.shape, length), device=array.device, copy=False)
