"""Grasp planning: who lies on whom, choice of the target, grasp pose.

An occlusion vote that instance j lies above i is a point on the contour of i outside of which a nearer j is visible. The clutter graph, a
directed acyclic graph, has edges from upper to lower instances by their votes. See the kernels for the rules.
"""

from typing import Any

import warp as wp

from synpick_warp.configs import schema
from synpick_warp.configs.episodes.manipulation import FLAT
from synpick_warp.kernels.perception import occlusion_votes
from synpick_warp.kernels.perception.clutter_graph import LANES, Cycles, break_cycles_kernel, close_clutter_kernel, link_clutter_kernel
from synpick_warp.kernels.perception.cup_alignment import align_cups_kernel
from synpick_warp.kernels.perception.flat_points import choose_flat_points_kernel
from synpick_warp.kernels.perception.grasp import frame_grasp_kernel, smooth_normal_kernel
from synpick_warp.kernels.perception.target import choose_target_kernel
from synpick_warp.kernels.tuning import VIEW_BLOCK
from synpick_warp.stages.arrays import allocate, allocate_struct, array_group, count_words, struct_arrays
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch
from synpick_warp.stages.perception.arrays import Observation, PerceptionArrays, Plan
from synpick_warp.stages.perception.images import PerceptionImages
from synpick_warp.stages.sim.worlds import AttemptState, WorldState

_KINDS = {"count": ("view", "instance", "instance", "kind")}


class VoteArrays(array_group(occlusion_votes.Voting, "view", "instance", units={"extent": "px", "reach": "px"}, **_KINDS)):
    """Scratch of the occlusion votes."""


CYCLES = struct_arrays(
    Cycles,
    "view",
    "instance",
    pending=("view", "instance", "word"),
    weight=("view", "instance", "instance"),
    best=("view", "subset"),
)


def allocate_votes(settings: schema.Perception, instances: int, views: int, device: wp.Device) -> tuple[VoteArrays, Any]:
    """Allocate the scratch of a batch: `VoteArrays`, and `Cycles`, with a table of the subsets of `exact_cycle` instances, up to which
    cycles of the clutter graph are broken at the least loss of votes."""
    sizes = {"view": views, "instance": instances, "word": count_words(instances), "kind": 2}
    sizes["subset"] = 1 << min(settings.exact_cycle, instances)
    return allocate(VoteArrays, sizes, device), allocate_struct(CYCLES, sizes, device)


class GraspPlanner:
    """Chooses a target and its suction grasp for the worlds of a batch. Owns its scratch; `plan` only launches kernels."""

    def __init__(self, settings: schema.Perception, images: PerceptionImages, arrays: PerceptionArrays) -> None:
        """Allocate scratch for the views and instances of a batch.

        Args:
            settings: Settings of perception.
            images: G-buffers of a batch; unused views have world -1.
            arrays: Components and contours of the batch.
        """
        self.images, self.arrays = images, arrays
        self.flat = settings.grasp_point == FLAT
        self.device = arrays.largest.device
        self.views, self.instances = arrays.largest.shape
        self.voting, self.cycles = allocate_votes(settings, self.instances, self.views, self.device)
        self._sources = (images, images.scene, arrays, self.voting)
        self._contours = (self.views, self.instances, int(occlusion_votes.CONTOUR_LANES))

    def plan(self, scene: SceneData, state: WorldState, attempts: AttemptState, observation: Observation, plan: Plan, seed: int) -> None:
        """Write votes and clutter graph to `observation`, target and grasp to `plan`, for the worlds of the batch.

        Args:
            scene: Constants.
            state: State of the worlds.
            attempts: State of the attempts; failed attempts, and the `outcome` of the one that ended in this tick, change the choice.
            observation: Visibility, grasp points and depths are read; point and depth of targets may change.
            plan: Written; in a world without a visible instance only the target, to -1.
            seed: Seed of the random choice of targets and grasp points.
        """
        self.bound_contours(scene, state, observation)
        self.count_votes(scene, observation)
        self.weigh_votes(scene, observation)
        self.order_clutter(scene, observation)
        self.choose_target(scene, state, attempts, observation, plan, seed)
        if scene.tries_another or self.flat:
            self.choose_flat_points(scene, state, attempts, observation, plan, seed)
        self.smooth_normal(scene, observation, plan)
        self.frame_grasp(scene, observation, plan)

    def bound_contours(self, scene: SceneData, state: WorldState, observation: Observation) -> None:
        """Compute each contour's bounding box, and its instance's reach."""
        self.voting.extent.fill_(int(occlusion_votes.NOWHERE))
        launch(occlusion_votes.bound_contours_kernel, self._contours, scene, state, observation, *self._sources)

    def count_votes(self, scene: SceneData, observation: Observation) -> None:
        """Count, along every contour, the votes that another instance lies above the enclosed one, by kind."""
        self.voting.count.zero_()
        launch(occlusion_votes.count_votes_kernel, self._contours, scene, observation, *self._sources)

    def weigh_votes(self, scene: SceneData, observation: Observation) -> None:
        """Sum full and deep votes, deep ones times their weight."""
        launch(occlusion_votes.weigh_votes_kernel, (self.views, self.instances, self.instances), scene, observation, *self._sources)

    def order_clutter(self, scene: SceneData, observation: Observation) -> None:
        """Build the clutter graph from the votes, make it acyclic (minimum feedback arc set), and compute its transitive closure."""
        sources = (scene, observation, self.images)
        launch(link_clutter_kernel, (self.views, *observation.above.shape[1:]), *sources)
        self._close_clutter(observation)
        lanes = LANES if self.device.is_cuda else 1
        launch(break_cycles_kernel, (self.views, lanes), *sources, lanes=lanes, cycles=self.cycles, block_dim=LANES)
        self._close_clutter(observation)

    def _close_clutter(self, observation: Observation) -> None:
        """Compute the transitive closure of the clutter graph."""
        dim = (self.views, self.instances)
        launch(close_clutter_kernel, dim, observation, self.images, cycles=self.cycles, block_dim=VIEW_BLOCK)

    def choose_target(
        self, scene: SceneData, state: WorldState, attempts: AttemptState, observation: Observation, plan: Plan, seed: int
    ) -> None:
        """Choose the visible instance with the fewest others above it; in mode target the one with the most."""
        sources = (scene, state, attempts, observation, plan, self.images)
        launch(choose_target_kernel, self.views, *sources, seed=wp.uint64(seed), block_dim=VIEW_BLOCK)

    def choose_flat_points(
        self, scene: SceneData, state: WorldState, attempts: AttemptState, observation: Observation, plan: Plan, seed: int
    ) -> None:
        """Move grasp points to where the surface is flat: of all targets, or only of those at which an attempt has failed."""
        sources = (scene, state, attempts, observation, plan, *self._sources)
        least = 0 if self.flat else 1
        launch(choose_flat_points_kernel, self.views, *sources, seed=wp.uint64(seed), least_failures=least, block_dim=VIEW_BLOCK)

    def smooth_normal(self, scene: SceneData, observation: Observation, plan: Plan) -> None:
        """Sum the normals in the window around the target's grasp point."""
        window = scene.perception.normal_window
        launch(smooth_normal_kernel, self.views, observation, plan, *self._sources, window=window, block_dim=VIEW_BLOCK)

    def frame_grasp(self, scene: SceneData, observation: Observation, plan: Plan) -> None:
        """Compute the grasp's frame: point in the world, unit normal, and the gripper's angles."""
        launch(frame_grasp_kernel, self.views, scene, observation, plan, *self._sources, block_dim=VIEW_BLOCK)

    def align_cups(self, scene: SceneData, plan: Plan) -> None:
        """Turn the gripper about the grasp point so that as many cups as possible lie on the target. For suction arrays only."""
        if scene.cups.count > 1:
            launch(align_cups_kernel, self.views, scene, plan, *self._sources, block_dim=VIEW_BLOCK)
