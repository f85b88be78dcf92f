"""Claiming workers of one command: their options and cost, and a progress observer that adds rate and remaining time."""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from synpick_warp.errors import DeviceError
from synpick_warp.system.progress import ForwardingProgress, Progress

RAY = "ray"
_ENGINE = re.compile(r"(ray(://(\[[0-9a-fA-F:]+\]|[\w.-]+):[0-9]{1,5})?)?")
_WINDOW = 60.0
"""Averaging window of the rate [s]: workers pause between bakes."""
_LEAST = 1.0
"""Minimum averaging window [s]."""


@dataclass
class Crew:
    """Options and cost of claiming workers. Raises DeviceError if there is no such engine."""

    engine: str = RAY
    """Ray cluster: "ray" is the one at RAY_ADDRESS, or else a local one, started for this bake; "ray://HOST:PORT" is reached by Ray Client.
    Empty: no cluster, but one process for each device of the command."""
    workers: int = 0
    """Number of the engine's workers; 0: as many as the cluster has GPUs at the time, or CPU cores with `bake.device` cpu."""
    price: float = 0.0
    """Price of a worker an hour."""
    alive: int = 0
    """Number of running workers."""
    seconds: float = 0.0
    """Accumulated running time of all workers [s]."""

    def __post_init__(self) -> None:
        if _ENGINE.fullmatch(self.engine) is None:
            raise DeviceError(f"--engine is {self.engine}; allowed: ray, or ray://HOST:PORT of a Ray Client, such as ray://head:10001")

    def __str__(self) -> str:
        cost = f" · cost {self.price * self.seconds / 3600.0:,.2f}" if self.price else ""
        return f"{self.alive} worker{'s' * (self.alive != 1)}{cost}"


class CrewProgress(ForwardingProgress):
    """Decorator of an observer: adds the moving average of the rate and the remaining time of the plan to the counts of all workers, and
    accumulates the workers' time in their `Crew`."""

    def __init__(self, progress: Progress, crew: Crew, before: int, planned: int, clock: Callable[[], float] = time.monotonic) -> None:
        """
        Args:
            progress: The observer.
            crew: Workers; its `seconds` grow by the time of `alive` workers.
            before: Episodes of the plan that were done before.
            planned: Episodes of the plan.
            clock: Monotonic clock [s].
        """
        super().__init__(progress)
        self._crew, self._before, self._planned, self._clock = crew, before, planned, clock
        self._now = clock()
        self._seen = deque([(self._now, 0)])
        """Samples in the averaging window: time [s], number of views."""

    def update(
        self, *, episodes_done: int, episodes: int, worlds_active: int, views: int, views_per_s: float, seconds_left: float | None
    ) -> None:
        """Pass on episodes, worlds and views of all workers since their start, with rate and remaining time. See `Progress`.

        Running episodes count as half done.
        """
        del episodes, views_per_s, seconds_left
        now, seen = self._clock(), self._seen
        self._crew.seconds += self._crew.alive * (now - self._now)
        self._now = now
        if not views:
            seen.clear()
        seen.append((now, views))
        while now - seen[0][0] > _WINDOW:
            seen.popleft()
        rate = (views - seen[0][1]) / max(_LEAST, now - seen[0][0])
        begun = episodes_done + 0.5 * worlds_active
        left = max(0.0, self._planned - self._before - begun) * views / begun / rate if episodes_done and rate > 0.0 else None
        super().update(
            episodes_done=min(self._planned, self._before + episodes_done),
            episodes=self._planned,
            worlds_active=worlds_active,
            views=views,
            views_per_s=rate,
            seconds_left=left,
        )
