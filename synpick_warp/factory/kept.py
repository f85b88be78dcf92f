"""Bakes that follow one another in a process without a new start: objects, lights, worlds, renderer and captured graphs are kept."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from synpick_warp.configs.schema import Config
from synpick_warp.factory.assembly import Factory, build_factory
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.factory.order import order_longest_first
from synpick_warp.factory.pipeline import bake_episodes
from synpick_warp.system.progress import Progress


class KeptBaker:
    """Baker with a cache of one factory, a function like `pipeline.bake_episodes`: for workers that bake chunk after chunk.

    The factory is built anew for other settings, and if worlds are chosen by the number of episodes and these are more than before.
    A bake that fails or is stopped leaves none. Several devices have processes of their own, which keep nothing.
    """

    def __init__(self) -> None:
        self._factory: Factory | None = None
        self._given: tuple[Any, ...] = ()
        """What the factory was built from: settings and needs of the formats."""
        self._most = 0
        """Number of episodes that it was built for."""

    def __call__(
        self,
        config: Config,
        out: Path,
        progress: Progress,
        episodes: Sequence[int],
        devices: Sequence[str] = (),
        deliver: Callable[[], None] | None = None,
    ) -> BakeSummary:
        """Generate episodes in a folder; arguments and errors as of `pipeline.bake_episodes`."""
        kept = False
        try:
            summary = bake_episodes(config, out, progress, episodes, devices, deliver, self._build)
            kept = not summary.stopped
        finally:
            if not kept:
                self._factory = None
        return summary

    def _build(self, config: Config, progress: Progress, episodes: Sequence[int], *needs: bool, longest_first: bool) -> Factory:
        """Build the factory, or have the kept one begin other episodes; arguments as of `assembly.build_factory`."""
        grown = not config.bake.worlds and len(episodes) > self._most
        if self._factory is None or self._given != (config, needs) or grown:
            self._factory = None
            gc.collect()  # Frees its arrays before the memory for others is planned.
            self._factory = build_factory(config, progress, episodes, *needs, longest_first=longest_first)
            self._given, self._most = (config, needs), len(episodes)
            return self._factory
        factory = self._factory
        if longest_first:
            episodes = order_longest_first(factory.config, factory.catalog, episodes, factory.simulation.device)
        factory.simulation.restart(episodes)
        self._factory = replace(factory, log=factory.make_log())
        return self._factory
