"""All worlds that must choose are looked at, and get their plan, within a tick, however many they are."""

from __future__ import annotations

import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.kernels.perception import worklist
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.perception.arrays import Plan, Sighting
from synpick_warp.stages.perception.plan import Planner
from synpick_warp.stages.perception.segment import Sight
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.sim.worlds import AttemptState, WorldState


class Looker:
    """Looks at worlds in batches until none is left; on a GPU that loop is a node of a graph, and the host does not know its length."""

    def __init__(
        self,
        config: Config,
        render_scene: RenderScene,
        scene: SceneData,
        state: WorldState,
        attempts: AttemptState,
        sighting: Sighting,
        plan: Plan,
    ) -> None:
        """Allocate scratch.

        Args:
            config: Settings.
            render_scene: What there is to see.
            scene: Constants.
            state: Worlds.
            attempts: Their tasks.
            sighting: Written: what was seen.
            plan: Written: what was chosen.
        """
        self.scene, self.state, self.attempts, self.sighting, self.plan = scene, state, attempts, sighting, plan
        self.seed = config.bake.seed
        self.device = state.phase.device
        self.sight = Sight(config, render_scene, config.arrangement.max_objects)
        self.planner = Planner(config, self.sight, self.device)
        self._looker = wp.zeros(state.phase.shape[0], dtype=wp.int32, device=self.device)
        self._count, self._first, self._left = (wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(3))
        self._graphs: dict[int, wp.Graph] = {}
        self._warm = False

    def look(self, snapshot: Snapshot) -> None:
        """Look at every world whose task is LOOK, as `snapshot` shows it, and plan its attempt."""
        if not self.device.is_cuda:
            self._look(snapshot)
            return
        if not self._warm:
            # Once eagerly, whether anybody looks or not: it loads the kernels.
            self.list_lookers()
            self.look_at_batch(snapshot)
            self._warm = True
        if id(snapshot) not in self._graphs:
            with wp.ScopedCapture(device=self.device) as capture:
                self._look(snapshot)
            self._graphs[id(snapshot)] = capture.graph
        wp.capture_launch(self._graphs[id(snapshot)])

    def _look(self, snapshot: Snapshot) -> None:
        self.list_lookers()
        wp.capture_while(self._left, self.look_at_batch, snapshot=snapshot)

    def list_lookers(self) -> None:
        """List the worlds that look, and begin with the first."""
        wp.launch(
            worklist.list_lookers_kernel,
            dim=1,
            inputs=[self.state.phase.shape[0], self.state.phase, self.attempts.task],
            outputs=[self._looker, self._count, self._first, self._left],
            device=self.device,
        )

    def look_at_batch(self, snapshot: Snapshot) -> None:
        """Look at the next of the worlds listed, as many as there are views, and plan their attempts."""
        look = self.sight.look
        views = look.world.shape[0]
        wp.launch(
            worklist.take_batch_kernel, dim=views, inputs=[self._looker, self._count, self._first], outputs=[look.world], device=self.device
        )
        self.sight.trace(snapshot)
        self.sight.find_suction_points(self.scene, snapshot.entry, self.sighting)
        self.planner.plan(self.scene, self.sight, self.state, self.attempts, self.sighting, self.plan, self.seed)
        wp.launch(worklist.pass_batch_kernel, dim=1, inputs=[views, self._count], outputs=[self._first, self._left], device=self.device)
