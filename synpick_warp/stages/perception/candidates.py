"""Two-phase stratified sampling of grasp candidates of saved states, in perception's images; their grasps are planned as in attempts."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.configs.episodes.manipulation import Picks
from synpick_warp.kernels.perception import candidates as kernels
from synpick_warp.kernels.state import Frames
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.launch import launch
from synpick_warp.stages.perception.perceive import Perception
from synpick_warp.stages.render.layers import layer_scene
from synpick_warp.stages.render.view_setup import make_shot
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.states import State
from synpick_warp.stages.sim.trials import GRASPS
from synpick_warp.stages.timing import scope

POOL = struct_arrays(
    kernels.Pool,
    "view",
    "draw",
    row_first=("view", "row"),
    pixels=("view",),
    visible=("view", "instance"),
    count=("view", "instance", "stratum"),
    units={"pixel": "px", "pixels": "px"},
)
SAMPLING = struct_arrays(kernels.Sampling, "one", row=("world",))
CANDIDATES = struct_arrays(kernels.Candidates, "grasp", units={"pixel": "px"})


class CandidateSampler:
    """Sampler of grasp candidates of saved states, in batches of one state per view of perception.

    Overwrites worlds and perception of a simulation.

    Attributes:
        count: Number of candidates of a state.
        uniform: Number of candidates that are uniform over visible pixels; they come last.
    """

    def __init__(self, simulation: Simulation, settings: Picks) -> None:
        """Allocate scratch arrays for a simulation, which must have perception and have ticked once."""
        assert simulation.perception is not None
        self.simulation, self.device = simulation, simulation.device
        self.perception: Perception = simulation.perception
        self.images = self.perception.images
        self.count, self.uniform = settings.candidates, round(settings.uniform * (settings.candidates - 1))
        views, width, height = self.images.views, *simulation.config.perception.resolution
        self._dim = (views.count, height, width)
        sizes = {"view": views.count, "row": height, "instance": views.instances, "stratum": int(kernels.STRATA)}
        self._draws = sizes["draw"] = int(kernels.POOL) + self.uniform + 1
        self._pool = allocate_struct(POOL, sizes, self.device)
        images = self.images
        self._shot = make_shot(images.scene, Frames(), images.bodies, images.gbuffer, images.drawn)
        self._sampling = allocate_struct(SAMPLING, {"world": simulation.layout.worlds, "one": 1}, self.device)
        self._sampling.count = self.count
        self._graph: wp.Graph | None = None

    def sample(self, state: State, rows: Sequence[int]) -> tuple[Any, Any, np.ndarray]:
        """Sample the candidates of saved states. Waits for the device. `state`: states at moments of choice, as of `Trials.run`.
        `rows`: its rows to sample. Returns the structs `Grasps` and `Candidates`, with `count` consecutive elements per row, and the
        visible instances (row, instance) bool. All fields of a row without visible instances are 0, or the planned grasp's."""
        sizes = {"grasp": len(rows) * self.count}
        grasps, candidates = (allocate_struct(kind, sizes, self.device) for kind in (GRASPS, CANDIDATES))
        uploaded = wp.array(rows, dtype=wp.int32, device=self.device)
        views, visible = self.images.views.count, []
        for first in range(0, len(rows), views):
            self._sample_batch(state, first, uploaded, grasps, candidates)
            visible.append(self._pool.visible.numpy()[: len(rows) - first] > 0)
        return grasps, candidates, np.concatenate(visible)

    def _sample_batch(self, state: State, first: int, rows: wp.array, grasps: Any, candidates: Any) -> None:
        """Sample the candidates of one batch: `rows[first]` and following, one per view."""
        simulation, views, self._sampling.first = self.simulation, self.images.views, first
        assigned = {"first": first, "rows": rows, "views": views.count, "row_out": self._sampling.row}
        launch(kernels.assign_states_kernel, simulation.layout.worlds, **assigned, world_out=views.world)
        with scope("load states", self.device):
            simulation.states.load(state, self._sampling.row)
        with scope("render", self.device):
            self.images.render(simulation.record.snapshot)
        with scope("draw and score pixels", self.device):
            self._draw()
        sources = (simulation.state, simulation.attempts)
        drawn = {"sampling": self._sampling, "patches": self.images.arrays.bundle, "pool": self._pool, "views": views}
        chosen = {"seed": self._seed, "uniform": self.uniform, "candidates": candidates, "grasps": grasps}
        launch(kernels.choose_candidates_kernel, (views.count, self.count), *sources, **drawn, **chosen)
        with scope("frame grasps", self.device):
            self._frame(grasps, candidates)

    @property
    def _seed(self) -> Any:
        return wp.uint64(self.simulation.config.bake.seed)

    def _draw(self) -> None:
        """Phase one: draw and score the pixels of a batch of views, and count those of each stratum."""
        simulation, images, pool = self.simulation, self.images, self._pool
        views, scene = images.views, images.scene
        shown, seen = {"layer": layer_scene(scene), "shot": self._shot}, {"pool": pool, "views": views, "patches": images.arrays.bundle}
        launch(kernels.label_instances_kernel, self._dim, **shown, patches=images.arrays.bundle)
        pool.visible.zero_()
        launch(kernels.count_rows_kernel, self._dim[:2], **seen)
        launch(kernels.sum_rows_kernel, views.count, **seen)
        sources = (simulation.state, simulation.attempts, simulation.observation, simulation.plan)
        launch(kernels.draw_pixels_kernel, (views.count, self._draws), *sources, **seen, seed=self._seed)
        launch(kernels.score_pixels_kernel, (views.count, self._draws), **shown, scene=scene.plain, pool=pool)
        launch(kernels.count_strata_kernel, (views.count, views.instances), **seen)

    def _frame(self, grasps: Any, candidates: Any) -> None:
        """Plan the candidates' grasps by the functions that plan an attempt, one candidate of each view at a time (a CUDA graph)."""
        simulation, planner, views = self.simulation, self.perception.planner, self.images.views
        scene, observation, plan, device = simulation.scene, simulation.observation, simulation.plan, self.device
        at = {"sampling": self._sampling, "views": views}
        self._sampling.index.zero_()
        launch(kernels.store_grasps_kernel, views.count, plan, **at, grasps=grasps)

        def frame(stores: bool) -> None:
            launch(kernels.aim_candidates_kernel, views.count, plan, observation, **at, candidates=candidates, grasps=grasps)
            planner.smooth_normal(scene, observation, plan)
            launch(kernels.store_normals_kernel, views.count, plan, **at, candidates=candidates)
            if stores:
                planner.frame_grasp(scene, observation, plan)
                if simulation.behavior.choose_grasps is not None:
                    simulation.behavior.choose_grasps(planner, scene, plan)
                launch(kernels.store_grasps_kernel, views.count, plan, **at, grasps=grasps)
            launch(kernels.increment_kernel, 1, sampling=self._sampling)

        frame(False)
        if self.count == 1:
            return
        frame(True)
        if not device.is_cuda:
            for _ in range(2, self.count):
                frame(True)
            return
        with wp.ScopedCapture(device=device) as capture:
            frame(True)
        for _ in range(2, self.count):
            wp.capture_launch(capture.graph)
