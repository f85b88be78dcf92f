"""From what was seen to what is picked: votes, clutter graph, choice, grasp."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import warp as wp

from synpick_warp.arrays import allocate, device_array
from synpick_warp.configs.schema import Config
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
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.perception.arrays import LookArrays, Plan, Sighting
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.render.view_setup import filled
from synpick_warp.stages.sim.worlds import AttemptState, WorldState

VIEW_BLOCK = 32
"""Threads of a block where a thread works on a whole view: small blocks spread few views over many processors."""


class Seen(Protocol):
    """What planning needs of the images of a batch."""

    scene: RenderScene
    look: LookArrays
    hits: Any
    bodies: Any
    cameras: Any
    grid: Any


@dataclass(frozen=True, eq=False)
class VoteArrays:
    """Scratch of the votes."""

    count: wp.array = device_array("view", "instance", "instance", "kind", dtype=wp.int32)
    """Full and deep votes."""
    extent: wp.array = device_array("view", "instance", dtype=wp.vec4i, unit="px")
    """How far a contour extends to the left, up, right and down: greatest -column, -row, column, row."""
    reach: wp.array = device_array("view", "instance", dtype=wp.float32, unit="px")
    """No point of its contour may be farther from where an instance gets a vote."""


@dataclass(frozen=True, eq=False)
class CycleArrays:
    """Arrays of the struct `Cycles`."""

    member: wp.array = device_array("view", "instance", dtype=wp.int32)
    weight: wp.array = device_array("view", "instance", "instance", dtype=wp.float32)
    rank: wp.array = device_array("view", "instance", dtype=wp.int32)
    best: wp.array = device_array("view", "subset", dtype=wp.float32)


def plan_sizes(config: Config, instances: int, views: int) -> dict[str, int]:
    """Extents of the dimensions that `VoteArrays` and `CycleArrays` name."""
    return {"view": views, "instance": instances, "kind": 2, "subset": 1 << min(config.sight.exact_cycle, instances)}


class Planner:
    """Chooses a target and a grasp for the worlds of a batch of looks. Owns its scratch; `plan` only launches."""

    def __init__(self, config: Config, seen: Seen, device: wp.Device) -> None:
        """Allocate scratch for as many views and instances as the images have room for.

        Args:
            config: All settings.
            seen: Images of a batch; instances at most 32: one bit each.
            device: Where they are.
        """
        self.views, instances = seen.look.largest.shape
        sizes = plan_sizes(config, instances, self.views)
        self.device = device
        self.voting = allocate(VoteArrays, sizes, device)
        self.arrays = allocate(CycleArrays, sizes, device)
        self.cycles = filled(Cycles, self.arrays)

    def plan(
        self, scene: SceneData, seen: Seen, state: WorldState, attempts: AttemptState, sighting: Sighting, plan: Plan, seed: int
    ) -> None:
        """Write votes and clutter graph to `sighting`, target and grasp to `plan`, for the worlds that the views name.

        Args:
            scene: Constants.
            seen: Images, components and contours; unused views have the world -1.
            state: The worlds.
            attempts: Their attempts; the outcome is that of the attempt that ended in this tick.
            sighting: Visible, share, suction and depth are read.
            plan: Written; a world in which nothing is visible gets the target -1 and keeps the rest.
            seed: Of all draws.
        """
        self.bound_contours(scene, seen, state, sighting)
        self.count_votes(scene, seen, sighting)
        self.weigh_votes(scene, seen, sighting)
        self.order_clutter(scene, seen, sighting)
        self.choose_target(scene, seen, state, attempts, sighting, plan, seed)
        self.smooth_normal(scene, seen, sighting, plan)
        self.frame_grasp(scene, seen, sighting, plan)

    def bound_contours(self, scene: SceneData, seen: Seen, state: WorldState, sighting: Sighting) -> None:
        """Box of every contour, and how far it may reach from where its instance gets a vote."""
        look, (views, instances) = seen.look, seen.look.largest.shape
        self.voting.extent.fill_(int(NOWHERE))
        inputs = [scene.catalog, seen.cameras, scene.sight, state.entry, look.world, look.camera, look.contour, look.contour_length]
        inputs += [sighting.depth]
        dim = (views, instances, int(CONTOUR_LANES))
        wp.launch(bound_contours_kernel, dim=dim, inputs=inputs, outputs=[self.voting.extent, self.voting.reach], device=self.device)

    def count_votes(self, scene: SceneData, seen: Seen, sighting: Sighting) -> None:
        """Votes of every contour, by kind."""
        look, (views, instances) = seen.look, seen.look.largest.shape
        self.voting.count.zero_()
        inputs = [seen.grid, scene.sight, seen.hits, look.world, look.component, look.largest, look.contour, look.contour_length]
        inputs += [sighting.depth, self.voting.extent, self.voting.reach]
        dim = (views, instances, int(CONTOUR_LANES))
        wp.launch(count_votes_kernel, dim=dim, inputs=inputs, outputs=[self.voting.count], device=self.device)

    def weigh_votes(self, scene: SceneData, seen: Seen, sighting: Sighting) -> None:
        """Votes by weight."""
        views, instances = seen.look.largest.shape
        inputs = [scene.sight, seen.look.world, self.voting.count]
        dim = (views, instances, instances)
        wp.launch(weigh_votes_kernel, dim=dim, inputs=inputs, outputs=[sighting.votes], device=self.device)

    def order_clutter(self, scene: SceneData, seen: Seen, sighting: Sighting) -> None:
        """The clutter graph without cycles."""
        inputs = [scene.sight, seen.look.world, sighting.votes]
        self._launch(order_clutter_kernel, inputs, [self.cycles, sighting.above, sighting.all_above])

    def choose_target(
        self, scene: SceneData, seen: Seen, state: WorldState, attempts: AttemptState, sighting: Sighting, plan: Plan, seed: int
    ) -> None:
        """The instance to pick."""
        inputs = [wp.uint64(seed), scene.pick, state.address, state.mode, attempts.attempt, attempts.outcome]
        inputs += [seen.look.world, sighting.visible, sighting.share, sighting.all_above]
        self._launch(choose_target_kernel, inputs, [plan.target])

    def smooth_normal(self, scene: SceneData, seen: Seen, sighting: Sighting, plan: Plan) -> None:
        """Sum of the normals about the target's suction point."""
        look = seen.look
        inputs = [seen.scene.meshes, seen.scene.surfaces, seen.cameras, seen.grid, scene.sight.normal_window, seen.bodies, seen.hits]
        inputs += [look.world, look.camera, look.component, look.largest, sighting.suction, plan.target]
        self._launch(smooth_normal_kernel, inputs, [plan.normal])

    def frame_grasp(self, scene: SceneData, seen: Seen, sighting: Sighting, plan: Plan) -> None:
        """Grasp point, normal and the gripper's angles."""
        inputs = [seen.cameras, scene.pick, plan.normal, seen.hits, seen.look.world, seen.look.camera, sighting.suction, plan.target]
        self._launch(frame_grasp_kernel, inputs, [plan.point, plan.yaw, plan.tilt])

    def _launch(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=self.views, inputs=inputs, outputs=outputs, device=self.device, block_dim=VIEW_BLOCK)
