"""Physics whose steps are launched one by one, never as a captured graph: hooks may read arrays and compute on the host."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import newton

from synpick_warp.stages.sim.physics import Physics, Watcher


class EagerPhysics(Physics):
    """`Physics` for tests that script the gripper in NumPy."""

    def tick_parts(
        self, before_step: Callable[[newton.State], None], after_collide: Callable[[], None] | None = None, watcher: Watcher | None = None
    ) -> Iterator[None]:
        yield from self._run_substeps(before_step, after_collide, watcher)
