"""Episode counters of a vector environment: seeds, indices of the piles, steps, and flags of termination and truncation.

The index of an episode is a hash of its environment's seed and episode counter, so it depends neither on other environments nor on time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from synpick_warp.configs.check import to_index
from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.errors import ConfigError, format_value
from synpick_warp.system.random_numbers import GAMMA, mix

OPTIONS = ("reset_mask", "env_idx", "episode")
"""Options of `reset`."""


@dataclass(frozen=True, eq=False)
class Episodes:
    """Episode counters and end flags of each environment, on the host."""

    seed: np.ndarray
    """Seed of its episodes (environment) uint64."""
    count: np.ndarray
    """Episode counter: episodes begun since the seed was set (environment) int64."""
    index: np.ndarray
    """Index of the current episode, which has the same pile in a bake with the same settings (environment) int64."""
    steps: np.ndarray
    """Steps in the episode (environment) int64."""
    terminated: np.ndarray
    """Whether the episode has ended with an empty bin (environment) bool."""
    truncated: np.ndarray
    """Whether it has reached `max_steps`, or its simulation failed (environment) bool."""

    @classmethod
    def of(cls, count: int) -> "Episodes":
        """Counters of `count` environments before their first episode: all truncated, so that each is due for a reset."""
        episodes, index, steps = (np.zeros(count, np.int64) for _ in range(3))
        return cls(np.zeros(count, np.uint64), episodes, index, steps, np.zeros(count, bool), np.ones(count, bool))

    @property
    def over(self) -> np.ndarray:
        """Whether each episode has ended, terminated or truncated (environment) bool."""
        return self.terminated | self.truncated

    def copy(self) -> "Episodes":
        """Deep copy."""
        return Episodes(*(getattr(self, item.name).copy() for item in fields(self)))

    def assign(self, other: "Episodes", environments: Sequence[int] | np.ndarray, rows: Any = None) -> None:
        """Overwrite the counters of environments with rows of `other`; None: with the rows of the same indices."""
        for item in fields(self):
            getattr(self, item.name)[environments] = getattr(other, item.name)[environments if rows is None else rows]

    def begin(self, environments: np.ndarray, index: np.ndarray) -> None:
        """Begin episodes with these indices (environment) in environments: no steps, not ended."""
        self.index[environments] = index
        for array in (self.steps, self.terminated, self.truncated):
            array[environments] = 0

    def reseed(self, seeds: Mapping[int, int], environments: np.ndarray) -> None:
        """Set the seeds of those of `environments` that have one (seed by environment), and reset their episode counters to 0."""
        for environment in environments.tolist():
            if environment in seeds:
                self.seed[environment], self.count[environment] = seeds[environment] % 2**64, 0

    def draw(self, environments: np.ndarray, piles: int, ahead: int = 0) -> np.ndarray:
        """Hash seed and counter to the index of each environment's next episode, 0 to `piles` - 1, or of the one `ahead` episodes later."""
        pairs = zip(self.seed[environments].tolist(), self.count[environments].tolist(), strict=True)
        return np.array([mix(seed * GAMMA + count + ahead + 1) % piles for seed, count in pairs], np.int64)


def make_seeds(seed: int | Sequence[int | None] | np.ndarray, count: int) -> dict[int, int]:
    """Seeds by environment: `seed`, `seed` + 1 and so on, or one for each, of which None are left out. Raises ConfigError if they are not
    whole numbers, or not one for each environment."""
    given = list(seed) if isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str) else []
    if (first := to_index(seed)) is not None:
        given = [first + index for index in range(count)]
    seeds = {index: number for index, one in enumerate(given) if (number := to_index(one)) is not None and number >= 0}
    if len(given) != count or len(seeds) + sum(one is None for one in given) != count:
        allowed = f"a whole number from 0 on, or one (None: none) for each of {count} environments"
        raise ConfigError(f"seed is {format_value(seed)}; allowed: {allowed}")
    return seeds


def choose_environments(options: Mapping[str, Any], count: int) -> np.ndarray:
    """Indices of the environments that `reset` begins anew (chosen) int64: those of `reset_mask`, else of `env_idx`, else all. Raises
    ConfigError if an option is unknown or not allowed."""
    if unknown := sorted(set(options) - set(OPTIONS)):
        raise ConfigError(f"reset has no option {unknown[0]}; options: {', '.join(OPTIONS)}")
    if (mask := options.get("reset_mask")) is not None:
        return np.flatnonzero(check_mask("reset_mask", mask, count))
    if (given := options.get("env_idx")) is None:
        return np.arange(count)
    chosen = np.atleast_1d(host_array(given))
    if chosen.dtype.kind not in "iu" or chosen.ndim != 1 or ((chosen < 0) | (chosen >= count)).any() or len(set(chosen)) < len(chosen):
        raise ConfigError(f"env_idx is {given!r}; allowed: different environments of 0 to {count - 1}")
    return chosen.astype(np.int64)


def choose_indices(options: Mapping[str, Any], count: int) -> np.ndarray | None:
    """Episode indices that option `episode` asks for, for `count` environments, int64; None: they are drawn. Raises ConfigError if they are
    not indices, or not one for each environment."""
    if (given := options.get("episode")) is None:
        return None
    chosen = host_array(given)
    if chosen.dtype.kind not in "iu" or chosen.shape not in ((), (count,)) or (chosen < 0).any() or (chosen >= INT32_MAX).any():
        raise ConfigError(f"episode is {given!r}; allowed: an index from 0 on, or one for each of {count} environments")
    return np.broadcast_to(chosen, count).astype(np.int64)


def check_mask(name: str, mask: Any, count: int) -> np.ndarray:
    """Check a mask of environments (environment) bool and return it on the host; raises ConfigError on another type or shape."""
    given = host_array(mask)
    if given.shape != (count,) or given.dtype != bool:
        raise ConfigError(f"{name} has the type {given.dtype} and the shape {given.shape}; allowed: bool, ({count},)")
    return given


def host_array(values: Any) -> np.ndarray:
    """Copy an array of NumPy, PyTorch or Warp, or a list, to the host."""
    if hasattr(values, "detach"):
        values = values.detach().cpu()
    return values.numpy() if hasattr(values, "numpy") else np.asarray(values)
