"""Checkpoint bank of settled piles, from which resets are loaded: a cache of states by episode index."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from synpick_warp.errors import StateError
from synpick_warp.kernels.environment import attempts as kernels
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim.simulate import Simulation

POLL = 8
"""Polling interval for piles at rest, and for attempts that have ended [ticks]."""


class PileBank:
    """Checkpoint bank of settled piles. Settling takes all worlds; a pile depends on its episode alone, not on world or bank.

    `rows` has the row of `state`, the checkpoints, by episode index."""

    def __init__(self, simulation: Simulation, capacity: int) -> None:
        """Allocate the bank for at most `capacity` piles of worlds after their first tick; raises StateError if memory is too short."""
        self.simulation, self.device = simulation, simulation.device
        self.state = simulation.states.allocate(capacity)
        self.rows: dict[int, int] = {}
        self._free = list(range(capacity))
        worlds = simulation.layout.worlds
        self._row, self._episode = (wp.zeros(worlds, dtype=wp.int32, device=self.device) for _ in range(2))
        self._world = wp.zeros(capacity, dtype=wp.int32, device=self.device)
        self._done = wp.zeros(2, dtype=wp.int32, device=self.device)

    def fetch(self, episodes: Sequence[int], ahead: Sequence[int] = ()) -> list[int]:
        """Look up the rows of episodes; settles the piles that the bank lacks, whereby the worlds' current states are lost. Those of
        `ahead` are prefetched: settled by worlds that would otherwise be idle. Raises StateError if the bank is too small, or a pile does
        not come to rest."""
        missing = [episode for episode in dict.fromkeys(episodes) if episode not in self.rows]
        if missing:
            worlds = self.simulation.layout.worlds
            kept = list(dict.fromkeys([*episodes, *ahead]))[: len(self.rows) + len(self._free)]
            if not set(episodes) <= set(kept):
                raise StateError(f"{len(set(episodes)):,} piles are asked for at once, but the bank keeps {len(kept):,}")
            room = -(-len(missing) // worlds) * worlds
            fill = (missing + [episode for episode in kept if episode not in self.rows and episode not in missing])[:room]
            self._make_room(len(fill), set(kept))
            for first in range(0, len(fill), worlds):
                self._settle(fill[first : first + worlds])
        return [self.rows[episode] for episode in episodes]

    def misses(self, episodes: Sequence[int]) -> bool:
        """Whether `fetch` would have to settle piles."""
        return any(episode not in self.rows for episode in episodes)

    def _make_room(self, count: int, kept: set[int]) -> None:
        """Evict piles that are not in `kept`, the oldest first, until `count` rows are free."""
        for episode in [episode for episode in self.rows if episode not in kept]:
            if len(self._free) >= count:
                break
            self._free.append(self.rows.pop(episode))

    def _settle(self, episodes: Sequence[int]) -> None:
        """Simulate piles until they rest, one in each world, and save each in the first tick at rest."""
        simulation, worlds, settle = self.simulation, self.simulation.layout.worlds, self.simulation.config.settle
        rows = [self._free.pop() for _ in episodes]
        for array, values in ((self._episode, episodes), (self._row, rows)):
            array.assign(np.append(values, np.full(worlds - len(values), -1)).astype(np.int32))
        self._done.zero_()
        launch(kernels.start_piles_kernel, worlds, simulation.state, episode=self._episode)
        rested = exhausted = 0
        while rested + exhausted < len(episodes):
            for _ in range(POLL):
                simulation.tick(perceives=False)
                self._world.fill_(-1)
                launch(kernels.list_settled_kernel, worlds, simulation.state, row=self._row, world=self._world, done=self._done)
                simulation.states.save(self.state, self._world)
            rested, exhausted = self._done.numpy().tolist()
        self._episode.fill_(-1)
        launch(kernels.start_piles_kernel, worlds, simulation.state, episode=self._episode)
        if exhausted:
            self._free += rows
            raise StateError(f"{exhausted} of {len(episodes)} piles do not come to rest in settle.tries = {settle.tries} arrangements")
        self.rows |= zip(episodes, rows, strict=True)
