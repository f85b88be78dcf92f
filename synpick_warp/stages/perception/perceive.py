"""Batched perception and grasp planning for every world whose task is LOOK, as a conditional graph loop; instance segmentation and suction
grasp points of its images, entirely on the device."""

from collections.abc import Callable
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import warp as wp

from synpick_warp.configs import schema
from synpick_warp.configs.cell.rig import Rig
from synpick_warp.kernels.perception import components, contours, distance_transform, grasp_points, worklist
from synpick_warp.kernels.perception.components import Segments
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.stages.arrays import allocate_struct, bundle, struct_arrays
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch, launch_images
from synpick_warp.stages.perception.arrays import Observation, Plan
from synpick_warp.stages.perception.images import PerceptionImages
from synpick_warp.stages.perception.plan import GraspPlanner
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
        launch(distance_transform.measure_columns_kernel, (views, self.width), *sources)
        launch_images(distance_transform.measure_rows_kernel, self.pixels, *sources)
        launch(grasp_points.measure_patches_kernel, strips, *sources)
        launch(contours.trace_contours_kernel, instances, *sources)
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
