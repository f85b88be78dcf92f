"""Batched perception and grasp planning for every world whose task is LOOK, as a conditional graph loop."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from synpick_warp.configs import schema
from synpick_warp.configs.cell.rig import Rig
from synpick_warp.kernels.perception import worklist
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch
from synpick_warp.stages.perception.arrays import Observation, Plan
from synpick_warp.stages.perception.images import PerceptionImages
from synpick_warp.stages.perception.plan import GraspPlanner
from synpick_warp.stages.perception.segment import Segmenter
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.sim.worlds import AttemptState, WorldState

WORKLIST = struct_arrays(worklist.Worklist, "one", world=("world",))


class Perception:
    """Processes a worklist of worlds in batches; on CUDA the loop is a conditional node of a graph, so the host never reads its length."""

    def __init__(
        self,
        settings: schema.Perception,
        rig: Rig,
        seed: int,
        render_scene: RenderScene,
        scene: SceneData,
        state: WorldState,
        attempts: AttemptState,
        observation: Observation,
        plan: Plan,
        choose_grasps: Callable[[GraspPlanner, SceneData, Plan], None] | None = None,
    ) -> None:
        """Allocate scratch.

        Perception uses the camera `perception.camera`, or the first, with meshes, materials and table of `render_scene`, in worlds that
        `attempts.task` selects. It writes their perception results to `observation`, and targets and grasps to `plan`; `seed` is that of
        the random choices of targets, `choose_grasps` the gripper's choice among other grasps of the target, None: it takes the first."""
        self.scene, self.state, self.attempts, self.observation, self.plan = scene, state, attempts, observation, plan
        self.seed, self.choose_grasps = seed, choose_grasps
        self.device = state.phase.device
        worlds, instances = observation.visible.shape
        self.images = PerceptionImages(settings, rig, render_scene, worlds, instances)
        self.images.fixture_visible[:, :1].fill_(scene.bins.visible)
        self.segmenter = Segmenter(self.images)
        self.planner = GraspPlanner(settings, self.images, self.segmenter.arrays)
        self._worklist = allocate_struct(WORKLIST, {"world": worlds, "one": 1}, self.device)
        self._graphs: dict[int, wp.Graph] = {}
        self._warm = False

    def perceive(self, snapshot: Snapshot) -> None:
        """Observe every world whose task is LOOK, in the state that `snapshot` holds, and plan its next attempt."""
        if not self.device.is_cuda:
            self._loop(snapshot)
            return
        if not self._warm:
            # Kernels cannot be loaded during capture.
            self.load_kernels(snapshot)
            self._warm = True
        if id(snapshot) not in self._graphs:
            with wp.ScopedCapture(device=self.device) as capture:
                self._loop(snapshot)
            self._graphs[id(snapshot)] = capture.graph
        wp.capture_launch(self._graphs[id(snapshot)])

    def clear_graphs(self) -> None:
        """Drop the captured graphs; the next call loads all kernels, and captures them anew."""
        self._graphs.clear()
        self._warm = False

    def load_kernels(self, snapshot: Snapshot) -> None:
        """Launch one batch, which loads all kernels, even if the worklist is empty."""
        self.list_worlds()
        self.perceive_batch(snapshot)

    def _loop(self, snapshot: Snapshot) -> None:
        """Process the worklist to its end: the loop is a conditional node of the graph that is captured."""
        self.list_worlds()
        wp.capture_while(self._worklist.remaining, self.perceive_batch, snapshot=snapshot)

    def list_worlds(self) -> None:
        """Build the worklist of worlds whose task is LOOK and reset the loop to its beginning."""
        given = {"worlds": len(self.state.phase), "worklist": self._worklist}
        launch(worklist.list_worlds_kernel, 1, self.state, self.attempts, **given)

    def perceive_batch(self, snapshot: Snapshot) -> None:
        """Loop body: observe the next worlds of the worklist, one a view, and plan their attempts."""
        views = self.images.views
        launch(worklist.take_batch_kernel, views.count, worklist=self._worklist, views=views)
        self.images.render(snapshot)
        self.segmenter.find_grasp_points(self.scene, snapshot.catalog_index, self.observation)
        self.planner.plan(self.scene, self.state, self.attempts, self.observation, self.plan, self.seed)
        if self.choose_grasps is not None:
            self.choose_grasps(self.planner, self.scene, self.plan)
        launch(worklist.advance_batch_kernel, 1, views=views.count, worklist=self._worklist)
