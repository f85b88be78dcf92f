"""Island sleeping (`physics.sleep`): objects at rest are neither collided nor solved until a body touches their island.

Launches kernels.sim.sleep. Flags and islands are integers computed from contacts and displacements, independent of the number of worlds
and the order of threads, and are part of a world's state.
"""

import newton
import warp as wp

from synpick_warp.errors import SynpickError
from synpick_warp.kernels.sim import sleep
from synpick_warp.kernels.state import Motion
from synpick_warp.newton_patches.broad_phase import SeparatingBroadPhase
from synpick_warp.stages.arrays import allocate, allocate_struct, array_group, bundle, struct_arrays
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim.physics import Physics, contact_arrays
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState

ISLANDS = struct_arrays(sleep.Islands, "body", woken=("world", "slot"))
THREADS = 64
"""Threads per world of the grid-stride loops over the overlaps and contacts of all worlds."""


class SleepState(array_group(sleep.Sleepers, "world", "slot", units={"quiet": "ticks"})):
    """Per body slot of each world: sleep flag, island, and quiet time."""


class Sleep:
    """Island sleeping of all worlds: hooks of a substep (`physics.Sleepers`) and of the broad phase, and `judge` at the end of a tick."""

    def __init__(self, scene: SceneData, physics: Physics) -> None:
        """Install the hooks in `physics`; raises SynpickError without `SeparatingBroadPhase`, as with another version of Newton."""
        pipeline = physics.pipeline
        if not isinstance(pipeline.broad_phase, SeparatingBroadPhase):
            raise SynpickError(f"physics.sleep needs another version of Newton than {newton.__version__}; set it to 0")
        self._scene, self._physics = scene, physics
        worlds, device = physics.layout.worlds, physics.device
        self._threads = worlds * THREADS if device.is_cuda else 1
        sizes = {"world": worlds, "slot": physics.layout.slots, "body": physics.model.body_count}
        self.state, self._islands = allocate(SleepState, sizes, device), allocate_struct(ISLANDS, sizes, device)
        self._pairs = wp.zeros(pipeline.broad_phase_shape_pairs.shape[0], dtype=wp.vec2i, device=device)
        self._pair_count = wp.zeros(1, dtype=wp.int32, device=device)
        pipeline.broad_phase.choose = self.choose
        physics.sleepers = self

    def choose(self, overlaps: wp.array, count: wp.array) -> tuple[wp.array, wp.array]:
        """Broad-phase filter: of pairs of shapes (overlap) vec2i and their number (one) int32, those with a shape of an awake body."""
        self._pair_count.zero_()
        given = {"overlap": overlaps, "overlap_count": count, "pair": self._pairs, "pair_count": self._pair_count}
        launch(sleep.list_awake_pairs_kernel, self._threads, self._scene, self._physics.model, self.state, threads=self._threads, **given)
        return self._pairs, self._pair_count

    def touch(self) -> None:
        """Mark sleeping islands in contact with an awake body. Runs between collision detection and solver."""
        given = {"threads": self._threads, "islands": self._islands, "contacts": contact_arrays(self._physics)}
        launch(sleep.wake_touched_kernel, self._threads, self._scene, self.state, **given)

    def hold(self, before: newton.State, after: newton.State) -> None:
        """Restore the sleeping bodies to their state before the substep, and wake the marked islands. Runs after the solver."""
        given = {"before": bundle(Motion, before), "after": bundle(Motion, after), "islands": self._islands}
        launch(sleep.hold_sleepers_kernel, self.state.asleep.shape, self._scene, self.state, **given)

    def judge(self, state: WorldState, attempts: AttemptState, seals: SealState, threshold: float) -> None:
        """Put islands to sleep whose objects moved by at most `threshold` [m] in each of the last ticks, and wake those of which an
        object was attached or removed. Runs at the end of a tick."""
        scene, physics, islands = self._scene, self._physics, self._islands
        launch(sleep.begin_islands_kernel, len(islands.parent), islands=islands)
        launch(sleep.join_islands_kernel, physics.contacts.rigid_contact_max, contacts=contact_arrays(physics), islands=islands)
        islands.restless.zero_()
        sources = (scene, state, attempts, seals, self.state, physics.state)
        launch(sleep.judge_sleep_kernel, len(state.phase), *sources, threshold=threshold, islands=islands)
