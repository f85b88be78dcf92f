"""Island sleeping (`physics.sleep`): objects at rest are neither collided nor solved until one of their island is touched.

Launches kernels.sim.sleep. All decisions are integers that follow from contacts and displacements, so that they do not depend on the number
of worlds or the order of threads; they are part of a world's state.
"""

from __future__ import annotations

from dataclasses import dataclass

import newton
import warp as wp

from synpick_warp.errors import SynpickError
from synpick_warp.kernels.sim import sleep
from synpick_warp.newton_patches.broad_phase import SeparatingBroadPhase
from synpick_warp.newton_patches.solver import FusedSteel
from synpick_warp.stages.arrays import allocate, device_array
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim.physics import Physics, contact_arrays
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState

THREADS = 64
"""Threads per world that stride over the overlaps, and over the contacts, of all worlds."""


@dataclass(frozen=True, eq=False)
class SleepState:
    """Which bodies sleep, by the slot of a body in its world."""

    asleep: wp.array = device_array("world", "slot", dtype=wp.int32)
    """1: the body sleeps."""
    island: wp.array = device_array("world", "slot", dtype=wp.int32)
    """Slot that names the island with which it sleeps."""
    quiet: wp.array = device_array("world", "slot", dtype=wp.int32, unit="ticks")
    """Time for which it has been quiet."""


class Sleep:
    """Sleeping bodies of all worlds: what physics leaves out (`physics.Sleepers`), and the judgement at the end of a tick."""

    def __init__(self, scene: SceneData, physics: Physics) -> None:
        """Have `physics` leave out what sleeps.

        Raises:
            SynpickError: Newton's version is not the one whose broad phase can.
        """
        pipeline = physics.pipeline
        if not isinstance(pipeline.broad_phase, SeparatingBroadPhase):
            raise SynpickError(f"physics.sleep needs another version of Newton than {newton.__version__}; set it to 0")
        self._scene, self._physics = scene, physics
        worlds, device = physics.layout.worlds, physics.device
        self.state = allocate(SleepState, {"world": worlds, "slot": physics.layout.slots}, device)
        self._threads = worlds * THREADS if device.is_cuda else 1
        self._woken = wp.zeros_like(self.state.asleep)
        self._parent, self._restless = (wp.zeros(physics.model.body_count, dtype=wp.int32, device=device) for _ in range(2))
        self._pairs = wp.zeros(pipeline.broad_phase_shape_pairs.shape[0], dtype=wp.vec2i, device=device)
        self._pair_count = wp.zeros(1, dtype=wp.int32, device=device)
        pipeline.broad_phase.choose = self.choose
        physics.sleepers = self
        if isinstance(physics.solver, FusedSteel):
            physics.solver.skips_idle = True

    def choose(self, overlaps: wp.array, count: wp.array) -> tuple[wp.array, wp.array]:
        """Of pairs of shapes and their number, those of which one belongs to a body that is awake."""
        self._pair_count.zero_()
        given = {"overlap": overlaps, "overlap_count": count, "pair": self._pairs, "pair_count": self._pair_count}
        launch(sleep.list_awake_pairs_kernel, self._threads, self._scene, self._physics.model, self.state, threads=self._threads, **given)
        return self._pairs, self._pair_count

    def touch(self) -> None:
        """Mark the islands that something awake touches. Runs between collision detection and solver."""
        sources = self._scene, self.state, contact_arrays(self._physics)
        launch(sleep.wake_touched_kernel, self._threads, *sources, threads=self._threads, woken=self._woken)

    def hold(self, before: newton.State, after: newton.State) -> None:
        """Hold what sleeps where it was before a substep, and wake the islands that were touched in it."""
        given = {"woken": self._woken, "quiet": self.state.quiet}
        launch(sleep.hold_sleepers_kernel, self.state.asleep.shape, self._scene, self.state, before, out=after, **given)

    def judge(self, state: WorldState, attempts: AttemptState, seals: SealState, threshold: float) -> None:
        """Send islands to sleep whose objects moved by at most `threshold` [m] in each of the last ticks, and wake those that lost an
        object. Runs at the end of a tick."""
        scene, physics, contacts = self._scene, self._physics, contact_arrays(self._physics)
        launch(sleep.begin_islands_kernel, len(self._parent), parent=self._parent)
        launch(sleep.join_islands_kernel, physics.contacts.rigid_contact_max, contacts, parent=self._parent)
        self._restless.zero_()
        scratch = {"parent": self._parent, "restless": self._restless, "woken": self._woken}
        sources = (scene, state, attempts, seals, self.state, physics.state)
        launch(sleep.judge_sleep_kernel, len(state.phase), *sources, threshold=threshold, **scratch)
