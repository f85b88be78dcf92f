"""Episodes of environments: which pile comes next, how many steps it has had, and how it ended.

Environment i's k-th episode since its seed was set is a hash of both, so that it depends neither on other environments nor on time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from synpick_warp.configs.check import to_index
from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.errors import ConfigError, format_value

OPTIONS = ("reset_mask", "env_idx", "episode")
"""Options of `reset`."""


@dataclass(frozen=True, eq=False)
class Episodes:
    """Counters of each environment, on the host."""

    seed: np.ndarray
    """Seed of its episodes (environment) uint64."""
    count: np.ndarray
    """Episodes since the seed was set (environment) int64."""
    index: np.ndarray
    """Index of the episode, as of a bake's with the same settings (environment) int64."""
    steps: np.ndarray
    """Steps in the episode (environment) int64."""
    terminated: np.ndarray
    """The bin is empty (environment) bool."""
    truncated: np.ndarray
    """The episode has had its steps, or its simulation failed (environment) bool."""

    @classmethod
    def of(cls, count: int) -> Episodes:
        """Episodes of `count` environments, none of which has begun."""
        episodes, index, steps = (np.zeros(count, np.int64) for _ in range(3))
        return cls(np.zeros(count, np.uint64), episodes, index, steps, np.zeros(count, bool), np.ones(count, bool))

    @property
    def over(self) -> np.ndarray:
        """Environments whose episode has ended (environment) bool."""
        return self.terminated | self.truncated

    def copy(self) -> Episodes:
        """A copy."""
        return Episodes(*(getattr(self, item.name).copy() for item in fields(self)))

    def assign(self, other: Episodes, environments: Sequence[int] | np.ndarray, rows: Any = None) -> None:
        """Take the rows of another for environments; None: those of the same index."""
        for item in fields(self):
            getattr(self, item.name)[environments] = getattr(other, item.name)[environments if rows is None else rows]

    def begin(self, environments: np.ndarray, index: np.ndarray) -> None:
        """Begin episodes of these indices in environments."""
        self.index[environments] = index
        for array in (self.steps, self.terminated, self.truncated):
            array[environments] = 0

    def reseed(self, seeds: np.ndarray, environments: np.ndarray) -> None:
        """Set the seeds of environments, whose next episode is the first."""
        self.seed[environments] = seeds
        self.count[environments] = 0

    def draw(self, environments: np.ndarray, piles: int, ahead: int = 0) -> np.ndarray:
        """Index of the episode that follows in each environment, after `ahead` others, below `piles`."""
        counts = self.count[environments] + ahead
        with np.errstate(over="ignore"):
            key = _mix(self.seed[environments] * _GAMMA + counts.astype(np.uint64) + np.uint64(1))
        return (key % np.uint64(piles)).astype(np.int64)


_GAMMA = np.uint64(0x9E3779B97F4A7C15)


def _mix(x: np.ndarray) -> np.ndarray:
    """Output function of SplitMix64, as `system.random_numbers` has it, of an array uint64."""
    y = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    y = (y ^ (y >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return y ^ (y >> np.uint64(31))


def make_seeds(seed: int | Sequence[int | None], count: int) -> np.ndarray:
    """Seeds of environments (environment) uint64: `seed`, `seed` + 1 and so on, or one for each.

    Raises:
        ConfigError: There are as many numbers.
    """
    given = [seed + index for index in range(count)] if isinstance(seed, int) else list(seed)
    numbers = [to_index(one) for one in given]
    if len(numbers) != count or any(number is None for number in numbers):
        raise ConfigError(f"seed is {format_value(seed)}; allowed: a whole number, or one for each of {count} environments")
    return np.array([(number or 0) % 2**64 for number in numbers], np.uint64)


def choose_environments(options: Mapping[str, Any], count: int) -> np.ndarray:
    """Environments that `reset` begins anew: those of `reset_mask` or `env_idx`, or all.

    Raises:
        ConfigError: An option is unknown or not allowed.
    """
    if unknown := sorted(set(options) - set(OPTIONS)):
        raise ConfigError(f"reset has no option {unknown[0]}; options: {', '.join(OPTIONS)}")
    if (mask := options.get("reset_mask")) is not None:
        return np.flatnonzero(check_mask("reset_mask", mask, count))
    if (given := options.get("env_idx")) is None:
        return np.arange(count)
    chosen = np.atleast_1d(_host(given))
    if chosen.dtype.kind not in "iu" or chosen.ndim != 1 or ((chosen < 0) | (chosen >= count)).any() or len(set(chosen)) < len(chosen):
        raise ConfigError(f"env_idx is {given!r}; allowed: different environments of 0 to {count - 1}")
    return chosen.astype(np.int64)


def choose_indices(options: Mapping[str, Any], count: int) -> np.ndarray | None:
    """Episode indices that `reset` is asked for, for `count` environments; None: they are drawn.

    Raises:
        ConfigError: They are none.
    """
    if (given := options.get("episode")) is None:
        return None
    chosen = _host(given)
    if chosen.dtype.kind not in "iu" or chosen.shape not in ((), (count,)) or (chosen < 0).any() or (chosen >= INT32_MAX).any():
        raise ConfigError(f"episode is {given!r}; allowed: an index from 0 on, or one for each of {count} environments")
    return np.broadcast_to(chosen, count).astype(np.int64)


def check_mask(name: str, mask: Any, count: int) -> np.ndarray:
    """A mask of environments (environment) bool; raises ConfigError if it is none."""
    given = _host(mask)
    if given.shape != (count,) or given.dtype != bool:
        raise ConfigError(f"{name} has the type {given.dtype} and the shape {given.shape}; allowed: bool, ({count},)")
    return given


def _host(values: Any) -> np.ndarray:
    """Values as an array of the host."""
    return np.asarray(values.detach().cpu() if hasattr(values, "detach") else values)
