"""Batched perception and grasp planning for every world whose task is LOOK, as a conditional graph loop; instance segmentation and suction
grasp points of its images, entirely on the device.

An occlusion vote that instance j lies above i is a point on the contour of i outside of which a nearer j is visible. The clutter graph, a
directed acyclic graph, has edges from upper to lower instances by their votes. See the kernels for the rules.
"""

from collections.abc import Callable
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import warp as wp

from synpick_warp.configs import schema
from synpick_warp.configs.cell.cameras import Rig
from synpick_warp.configs.episodes.manipulation import FLAT
from synpick_warp.kernels.perception import components, contours, distance_transform, grasp_points, occlusion_votes, worklist
from synpick_warp.kernels.perception.clutter_graph import LANES, Cycles, break_cycles_kernel, close_clutter_kernel, link_clutter_kernel
from synpick_warp.kernels.perception.components import Segments
from synpick_warp.kernels.perception.cup_alignment import align_cups_kernel
from synpick_warp.kernels.perception.flat_points import choose_flat_points_kernel
from synpick_warp.kernels.perception.grasp import frame_grasp_kernel, smooth_normal_kernel
from synpick_warp.kernels.perception.target import choose_target_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.kernels.tuning import CONTOUR_BLOCK, VIEW_BLOCK
from synpick_warp.stages.arrays import allocate, allocate_struct, array_group, bundle, count_words, struct_arrays
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch, launch_images
from synpick_warp.stages.perception.images import Observation, PerceptionArrays, PerceptionImages, Plan
from synpick_warp.stages.render.scene import RenderScene
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
        """Allocate scratch for the views and instances of a batch. `settings`: settings of perception. `images`: g-buffers of a batch;
        unused views have world -1. `arrays`: components and contours of the batch."""
        self.images, self.arrays = images, arrays
        self.flat = settings.grasp_point == FLAT
        self.device = arrays.largest.device
        self.views, self.instances = arrays.largest.shape
        self.voting, self.cycles = allocate_votes(settings, self.instances, self.views, self.device)
        self._sources = (images, images.scene, arrays, self.voting)
        self._contours = (self.views, self.instances, int(occlusion_votes.CONTOUR_LANES))

    def plan(self, scene: SceneData, state: WorldState, attempts: AttemptState, observation: Observation, plan: Plan, seed: int) -> None:
        """Write votes and clutter graph to `observation`, target and grasp to `plan`, for the worlds of the batch. `attempts`: state of the
        attempts; failed attempts, and the `outcome` of the one that ended in this tick, change the choice. `observation`: visibility, grasp
        points and depths are read; point and depth of targets may change. `plan`: written; in a world without a visible instance only the
        target, to -1. `seed`: seed of the random choice of targets and grasp points."""
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


class Segmenter:
    """Segments a batch of images and finds grasp points. Owns its scratch; `find_grasp_points` only launches kernels. `arrays`: components,
    distance transforms and contours of the batch."""

    def __init__(self, images: PerceptionImages) -> None:
        """Take the scratch of `images`, whose G-buffers it reads."""
        self.images = images
        self.grid, self.device = images.scene.grid, images.scene.device
        self.width, self.height, self.instances = self.grid.width, self.grid.height, images.views.instances
        self.pixels = images.views.count * self.grid.tiles * int(TILE_PIXELS)
        self.strips = -(-self.width // int(components.STRIP))
        self.arrays = images.arrays
        flat = _flatten_images(images.arrays, images.scratch)
        flat |= {name: _flatten(getattr(images.gbuffer, name)) for name in ("segment", "depth")}
        self.segments = bundle(Segments, SimpleNamespace(**flat), images.arrays, images.scratch)

    def find_grasp_points(self, scene: SceneData, catalog_index: wp.array, observation: Observation) -> None:
        """Compute components, distance transforms, contours and grasp points of the rendered views, by mass and area of the `catalog` of
        `scene` and the catalog index of each instance (world, instance) int32. `observation` is written for the worlds of the batch, except
        votes and clutter graph."""
        images, views, sources = self.images, self.images.views.count, (self, self.images, scene, observation)
        instances, strips = (views, self.instances), (views, self.height, self.strips)
        objects = {"catalog_index": catalog_index}
        launch(grasp_points.clear_sums_kernel, instances, *sources)
        launch_images(components.label_strips_kernel, views * self.height * self.strips, *sources)
        launch(components.merge_strips_kernel, strips, *sources)
        launch(components.measure_components_kernel, strips, *sources)
        launch(components.find_largest_kernel, (views, self.height * self.width), *sources)
        launch(components.unpack_largest_kernel, instances, *sources, **objects)
        launch_images(distance_transform.mark_patches_kernel, self.pixels, *sources)
        launch(distance_transform.measure_columns_kernel, (views, self.width), *sources, block_dim=VIEW_BLOCK)
        launch_images(distance_transform.measure_rows_kernel, self.pixels, *sources)
        launch(grasp_points.measure_patches_kernel, strips, *sources)
        launch(contours.trace_contours_kernel, instances, *sources, block_dim=CONTOUR_BLOCK)
        cameras = {"intrinsics": images.scene.cameras.intrinsics}
        launch(grasp_points.measure_points_kernel, instances, *sources, **cameras, **objects)
        launch(grasp_points.choose_grasp_points_kernel, instances, *sources, hit_depth=images.gbuffer.depth, **objects)


def _flatten(image: wp.array) -> wp.array:
    """View (view, pixel) of an array (view, row, column); they share memory."""
    return image.reshape((image.shape[0], image.shape[1] * image.shape[2]))


def _flatten_images(*groups: Any) -> dict[str, wp.array]:
    """`_flatten` for the images among the arrays of dataclasses, by name."""
    named = [(item.name, item.metadata["array"].shape, getattr(group, item.name)) for group in groups for item in fields(group)]
    return {name: _flatten(array) for name, shape, array in named if shape == ("view", "row", "column")}
