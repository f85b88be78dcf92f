"""Grasp planning: occlusion votes, clutter graph, choice of the target, grasp pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from synpick_warp.configs import schema
from synpick_warp.kernels.perception.clutter_graph import Cycles, order_clutter_kernel
from synpick_warp.kernels.perception.grasp import frame_grasp_kernel, smooth_normal_kernel
from synpick_warp.kernels.perception.occlusion_votes import (
    CONTOUR_LANES,
    NOWHERE,
    bound_contours_kernel,
    count_votes_kernel,
    weigh_votes_kernel,
)
from synpick_warp.kernels.perception.target import choose_target_kernel
from synpick_warp.kernels.tuning import VIEW_BLOCK
from synpick_warp.stages.arrays import allocate, allocate_struct, device_array, struct_arrays
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.perception.arrays import Observation, PerceptionArrays, Plan
from synpick_warp.stages.perception.images import PerceptionImages
from synpick_warp.stages.sim.worlds import AttemptState, WorldState


@dataclass(frozen=True, eq=False)
class VoteArrays:
    """Vote counts, bounding boxes of contours and reaches of instances: scratch of the occlusion votes."""

    count: wp.array = device_array("view", "instance", "instance", "kind", dtype=wp.int32)
    """Number of votes by kind: full, deep."""
    extent: wp.array = device_array("view", "instance", dtype=wp.vec4i, unit="px")
    """Bounding box of each contour as maxima: -column, -row, column, row."""
    reach: wp.array = device_array("view", "instance", dtype=wp.float32, unit="px")
    """Largest distance allowed between a pixel where the instance gets a vote and any point of its contour."""


CYCLES = struct_arrays(Cycles, "view", "instance", weight=("view", "instance", "instance"), best=("view", "subset"))


def allocate_votes(settings: schema.Perception, instances: int, views: int, device: wp.Device) -> tuple[VoteArrays, Any]:
    """Allocate the scratch of a batch: `VoteArrays`, and the struct `Cycles`."""
    sizes = {"view": views, "instance": instances, "kind": 2, "subset": 1 << min(settings.exact_cycle, instances)}
    return allocate(VoteArrays, sizes, device), allocate_struct(CYCLES, sizes, device)


class GraspPlanner:
    """Chooses a target and its suction grasp for the worlds of a batch. Owns its scratch; `plan` only launches kernels."""

    def __init__(self, settings: schema.Perception, images: PerceptionImages, arrays: PerceptionArrays) -> None:
        """Allocate scratch for the views and instances of a batch.

        Args:
            settings: Settings of perception.
            images: G-buffers of a batch; unused views have world -1; at most 32 instances, one bit each.
            arrays: Components and contours of the batch.
        """
        self.images, self.arrays = images, arrays
        self.device = arrays.largest.device
        self.views, self.instances = arrays.largest.shape
        self.voting, self.cycles = allocate_votes(settings, self.instances, self.views, self.device)

    def plan(self, scene: SceneData, state: WorldState, attempts: AttemptState, observation: Observation, plan: Plan, seed: int) -> None:
        """Write votes and clutter graph to `observation`, target and grasp to `plan`, for the worlds of the batch.

        Args:
            scene: Constants.
            state: State of the worlds.
            attempts: State of the attempts; `outcome` belongs to the attempt that ended in this tick.
            observation: Visibility, grasp points and depths are read.
            plan: Written; a world without a visible instance gets target -1 and keeps the rest.
            seed: Seed of the random choice of targets.
        """
        self.bound_contours(scene, state, observation)
        self.count_votes(scene, observation)
        self.weigh_votes(scene, observation)
        self.order_clutter(scene, observation)
        self.choose_target(scene, state, attempts, observation, plan, seed)
        self.smooth_normal(scene, observation, plan)
        self.frame_grasp(scene, observation, plan)

    def bound_contours(self, scene: SceneData, state: WorldState, observation: Observation) -> None:
        """Compute each contour's bounding box, and its instance's reach."""
        images, arrays = self.images, self.arrays
        self.voting.extent.fill_(int(NOWHERE))
        inputs = [scene.catalog, images.scene.cameras, scene.perception, state.catalog_index, images.views]
        inputs += [arrays.contour, arrays.contour_length, observation.depth]
        self._launch_contours(bound_contours_kernel, inputs, [self.voting.extent, self.voting.reach])

    def count_votes(self, scene: SceneData, observation: Observation) -> None:
        """Count the occlusion votes along every contour, by kind."""
        images, arrays, voting = self.images, self.arrays, self.voting
        voting.count.zero_()
        inputs = [images.scene.grid, scene.perception, images.gbuffer, images.views, arrays.component, arrays.largest]
        inputs += [arrays.contour, arrays.contour_length, observation.depth, voting.extent, voting.reach]
        self._launch_contours(count_votes_kernel, inputs, [voting.count])

    def weigh_votes(self, scene: SceneData, observation: Observation) -> None:
        """Sum the counted votes by their weights: writes the observation's `votes`."""
        inputs = [scene.perception, self.images.views, self.voting.count]
        dim = (self.views, self.instances, self.instances)
        wp.launch(weigh_votes_kernel, dim=dim, inputs=inputs, outputs=[observation.votes], device=self.device)

    def order_clutter(self, scene: SceneData, observation: Observation) -> None:
        """Build the acyclic clutter graph and its transitive closure."""
        inputs = [scene.perception, self.images.views, observation.votes]
        self._launch_views(order_clutter_kernel, inputs, [self.cycles, observation.above, observation.ancestors])

    def choose_target(
        self, scene: SceneData, state: WorldState, attempts: AttemptState, observation: Observation, plan: Plan, seed: int
    ) -> None:
        """Choose the instance to pick in each world: writes the plan's `target`."""
        inputs = [wp.uint64(seed), scene.pick, state.arrangement_id, state.mode, attempts.attempt, attempts.outcome]
        inputs += [self.images.views, observation.visible, observation.visible_fraction, observation.ancestors]
        self._launch_views(choose_target_kernel, inputs, [plan.target])

    def smooth_normal(self, scene: SceneData, observation: Observation, plan: Plan) -> None:
        """Sum the normals in the window around the target's grasp point."""
        images, arrays = self.images, self.arrays
        inputs = [images.scene.meshes, images.scene.surfaces, images.scene.cameras, images.scene.grid, scene.perception.normal_window]
        inputs += [images.bodies, images.gbuffer, images.views, arrays.component, arrays.largest, observation.grasp_pixel, plan.target]
        self._launch_views(smooth_normal_kernel, inputs, [plan.normal])

    def frame_grasp(self, scene: SceneData, observation: Observation, plan: Plan) -> None:
        """Compute the grasp point in the world, its unit normal, and the gripper's angles."""
        images = self.images
        inputs = [images.scene.cameras, scene.pick, images.gbuffer, images.views, observation.grasp_pixel, plan.target]
        self._launch_views(frame_grasp_kernel, inputs, [plan.normal, plan.point, plan.yaw, plan.tilt])

    def _launch_views(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel with one thread a view."""
        wp.launch(kernel, dim=self.views, inputs=inputs, outputs=outputs, device=self.device, block_dim=VIEW_BLOCK)

    def _launch_contours(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel with `CONTOUR_LANES` threads a contour."""
        dim = (self.views, self.instances, int(CONTOUR_LANES))
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)
