"""Cache of a bake's stages: successive bakes of a process reuse objects, lights, worlds, renderer and captured graphs."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from synpick_warp.codes import Phase
from synpick_warp.configs.schema import Config
from synpick_warp.factory.assembly import Factory, build_factory
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.factory.order import order_longest_first
from synpick_warp.factory.pipeline import bake_episodes
from synpick_warp.factory.worker import BakeLink
from synpick_warp.system.progress import Progress


def keeping_baker(processes: int = 1, stop: BakeLink | None = None) -> Callable[..., BakeSummary]:
    """A function like `pipeline.bake_episodes` that keeps the stages of one device from call to call, for workers that bake chunk after
    chunk. Several devices have processes of their own, which keep nothing.

    Args:
        processes: Such workers on this host, which share its memory.
        stop: Requests to stop; None: signals do.
    """
    return partial(bake_episodes, build=KeptStages(processes), stop=stop)


class KeptStages:
    """Cache of one factory, a function like `assembly.build_factory`.

    The factory is built anew for other settings, if worlds are chosen by the number of episodes and these are more than before, and if the
    last bake did not come to its end.
    """

    def __init__(self, processes: int = 1) -> None:
        self._processes = processes
        self._factory: Factory | None = None
        self._given: tuple[Any, ...] = ()
        """What the factory was built from: settings, needs of the formats, order of the episodes."""
        self._most = 0
        """Number of episodes that it was built for."""

    def __call__(
        self, config: Config, progress: Progress, episodes: Sequence[int], *needs: bool, longest_first: bool, expected: int = 0
    ) -> Factory:
        """Build the factory, or have the kept one begin other episodes; arguments and errors as of `assembly.build_factory`."""
        given, factory = (config, needs, longest_first), self._factory
        expected = max(expected, len(episodes))
        grown = not config.bake.worlds and expected > self._most
        if factory is None or self._given != given or grown or not _has_ended(factory):
            self._factory = factory = None
            gc.collect()  # Frees its arrays before the memory for others is planned.
            chosen = {"longest_first": longest_first, "processes": self._processes, "expected": expected}
            self._factory = build_factory(config, progress, episodes, *needs, **chosen)
            self._given, self._most = given, expected
            return self._factory
        if longest_first:
            episodes = order_longest_first(factory.config, factory.catalog, episodes, factory.simulation.device)
        factory.simulation.restart(episodes)
        return replace(factory, log=factory.make_log())


def _has_ended(factory: Factory) -> bool:
    """Whether the last bake in a factory has ended: all worlds are idle, no views are in flight, and no state waits for trials."""
    waits = factory.picks is not None and factory.picks.waits
    return not (waits or factory.stream.in_flight) and bool((factory.simulation.state.phase.numpy() == Phase.IDLE).all())
