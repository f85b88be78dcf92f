"""Instance segmentation and suction grasp points, from images of camera 0 without the gripper; batches of views, entirely on the device."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import warp as wp

from synpick_warp.arrays import allocate, allocate_struct, device_array, memory_table
from synpick_warp.configs import schema
from synpick_warp.errors import ConfigError
from synpick_warp.kernels.perception import components, contours, distance_transform, grasp_points
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.kernels.render.visibility.gbuffer import trace_sample_kernel
from synpick_warp.kernels.render.visibility.view_setup import aim_views_kernel
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.perception.arrays import Observation, PerceptionArrays
from synpick_warp.stages.render.scene import RenderScene, build_cameras, build_grid
from synpick_warp.stages.render.view_setup import GBUFFER, VIEW_BODIES, VIEWS, body_sizes, set_up_views

CPU_BYTES = 512 * 2**20
GPU_BYTES = 2 * 2**30
"""Scratch that the views of a batch may take if `sight.views` is 0."""
CPU_VIEWS = 4
"""Maximum number of views on the CPU in that case: larger batches gain nothing there, and unused views still cost a little."""
CENTER = wp.vec2(0.0, 0.0)
"""Offset of rays through the pixel centres [px]."""


@dataclass(frozen=True, eq=False)
class SegmentationScratch:
    """Intermediate images and sums. A patch is the largest component of an instance."""

    patch: wp.array = device_array("view", "row", "column", dtype=wp.uint16)
    """Low byte: 1 + instance, 0: no patch; bit 8 + d: the neighbour in direction d belongs to the same patch."""
    gap: wp.array = device_array("view", "row", "column", dtype=wp.int32)
    """256 x distance within the column [px] + low byte of `patch`."""
    largest_key: wp.array = device_array("view", "instance", dtype=wp.int64)
    """Size and label of the largest component, packed by `pack_key`."""
    pole_key: wp.array = device_array("view", "instance", dtype=wp.int64)
    """Squared distance [px²] and pixel of the pole, packed by `pack_key`."""
    square: wp.array = device_array("view", "instance", dtype=wp.int64, unit="2⁻²⁴ m²")
    """Sum of squared depths over the patch."""


SCRATCH = (VIEWS, VIEW_BODIES, GBUFFER, PerceptionArrays, SegmentationScratch)
"""Declarations of all arrays that a `Segmenter` allocates."""


def perception_sizes(settings: schema.Sight, instances: int, views: int) -> dict[str, int]:
    """Extents of the dimensions of the declarations in `SCRATCH`."""
    width, height = settings.resolution
    return {
        "view": views,
        "instance": instances,
        "row": height,
        "column": width,
        "point": settings.contour_points,
    } | body_sizes(instances, width, height)


def view_bytes(settings: schema.Sight, instances: int) -> int:
    """Scratch of one view [bytes]."""
    sizes = perception_sizes(settings, instances, 1)
    return sum(row[3] for kind in SCRATCH for row in memory_table(kind, sizes))


def count_views(settings: schema.Sight, worlds: int, instances: int, device: wp.Device) -> int:
    """Views of a batch: the setting, or as many as fit into the memory budget; never more than there are worlds."""
    views = settings.views
    if views == 0:
        each = view_bytes(settings, instances)
        views = GPU_BYTES // each if device.is_cuda else min(CPU_BYTES // each, CPU_VIEWS)
    return min(max(views, 1), worlds)


class Segmenter:
    """Renders G-buffers of a batch of worlds, segments them and finds grasp points.

    Owns its scratch; `render` and `find_grasp_points` only launch kernels, so a CUDA graph can capture them.

    Attributes:
        views: The struct `Views` of the batch. The caller fills `views.world` (view): each world once; -1: the view is unused.
        arrays: Arrays of the batch.
        gbuffer: The struct `GBuffer` of the batch.
        cameras: The struct `Cameras` with camera 0 alone, at the resolution of perception.
        grid: The struct `ImageGrid` of its image.
    """

    def __init__(self, settings: schema.Sight, cameras: schema.Cameras, render_scene: RenderScene, worlds: int, instances: int) -> None:
        """Allocate scratch.

        Args:
            settings: Settings of perception.
            cameras: Settings of the cameras; the resolution is that of `settings`.
            render_scene: Meshes and table of the renderer; its cameras are not used.
            worlds: Number of worlds.
            instances: Capacity for instances of a world, at most 32.

        Raises:
            ConfigError: A batch has more pixels than 31 bits can count.
        """
        device = render_scene.device
        self.render_scene = render_scene
        sizes = perception_sizes(settings, instances, count_views(settings, worlds, instances, device))
        self.views = allocate_struct(VIEWS, sizes, device)
        self.views.world.fill_(-1)
        self.views.count, self.views.instances = sizes["view"], instances
        self.width, self.height = settings.resolution
        self.grid = build_grid(self.width, self.height)
        self.pixels = self.views.count * self.grid.tiles * int(TILE_PIXELS)
        if self.pixels >= 2**31:
            size = f"{self.width} x {self.height} px"
            raise ConfigError(f"sight.views is {self.views.count}; of {size} that is more than 2³¹ pixels; take fewer")
        self.arrays = allocate(PerceptionArrays, sizes, device)
        self.scratch = allocate(SegmentationScratch, sizes, device)
        self.gbuffer = allocate_struct(GBUFFER, sizes, device)
        self.bodies = allocate_struct(VIEW_BODIES, sizes, device)
        self.cameras = build_cameras(make_cameras(replace(cameras, resolution=settings.resolution))[:1], device)
        self.strips = -(-self.width // int(components.STRIP))
        self.fixture_visible = wp.array([[1, 0, 0]] * worlds, dtype=wp.int32, device=device)
        self.flat = _images(self.arrays, self.scratch) | {"segment": _flatten(self.gbuffer.segment), "depth": _flatten(self.gbuffer.depth)}

    def render(self, snapshot: Snapshot) -> None:
        """Render the G-buffer of each view without gripper shaft and cup. Unused views keep their content."""
        scene, views = self.render_scene, self.views
        wp.launch(aim_views_kernel, dim=views.count, outputs=[views], device=scene.device)
        set_up_views(scene, self.cameras, self.grid, snapshot, self.fixture_visible, views, self.bodies)
        inputs = [scene.meshes, scene.table, self.cameras, self.grid, self.bodies, views, CENTER]
        self._launch_pixels(trace_sample_kernel, inputs, [self.gbuffer])

    def find_grasp_points(self, scene: SceneData, entry: wp.array, observation: Observation) -> None:
        """Compute components, distance transforms, contours and grasp points of the rendered views.

        Args:
            scene: Constants; mass and area of `catalog` are read.
            entry: Catalog index of each instance (world, instance) int32.
            observation: Written for the worlds of the batch, except votes and clutter graph.
        """
        self.clear_sums(observation)
        self.label_strips()
        self.merge_strips()
        self.measure_components()
        self.find_largest()
        self.unpack_largest()
        self.mark_patches()
        self.measure_columns()
        self.measure_rows()
        self.measure_patches()
        self.trace_contours(observation)
        self.measure_points(scene, entry, observation)
        self.choose_grasp_points(scene, entry, observation)

    def clear_sums(self, observation: Observation) -> None:
        """Reset maxima, sums and overflow flags to 0."""
        scratch = self.scratch
        outputs = [scratch.largest_key, scratch.pole_key, scratch.square, observation.overflow]
        self._launch(grasp_points.clear_sums_kernel, (self.views.instances,), [], outputs)

    def label_strips(self) -> None:
        """Label the runs of each strip."""
        flat, count = self.flat, self.views.count * self.height * self.strips
        inputs = [self.views, flat["segment"], self.width, self.height, self.strips]
        launch_pixels(components.label_strips_kernel, count, inputs, [flat["component"], flat["area"]], self.render_scene.device)

    def merge_strips(self) -> None:
        """Unite runs that touch."""
        inputs = [self.flat["segment"], self.width]
        self._launch(components.merge_strips_kernel, (self.height, self.strips), inputs, [self.flat["component"]])

    def measure_components(self) -> None:
        """Replace labels by roots and count the pixels of each component."""
        outputs = [self.flat["component"], self.flat["area"]]
        self._launch(components.measure_components_kernel, (self.height, self.strips), [self.width], outputs)

    def find_largest(self) -> None:
        """Find the keys of the largest components."""
        inputs = [self.flat["segment"], self.flat["area"]]
        self._launch(components.find_largest_kernel, (self.height * self.width,), inputs, [self.scratch.largest_key])

    def unpack_largest(self) -> None:
        """Unpack the labels of the largest components."""
        self._launch(components.unpack_largest_kernel, (self.views.instances,), [self.scratch.largest_key], [self.arrays.largest])

    def mark_patches(self) -> None:
        """Mark the pixels of the largest components and their neighbours."""
        flat = self.flat
        inputs = [self.grid, self.views, flat["segment"], flat["component"], self.arrays.largest]
        self._launch_pixels(distance_transform.mark_patches_kernel, inputs, [flat["patch"]])

    def measure_columns(self) -> None:
        """First pass of the distance transform: distances within columns."""
        inputs = [self.grid, self.views, self.flat["patch"]]
        dim, device = (self.views.count, self.width), self.render_scene.device
        wp.launch(distance_transform.measure_columns_kernel, dim=dim, inputs=inputs, outputs=[self.flat["gap"]], device=device)

    def measure_rows(self) -> None:
        """Second pass of the distance transform: minimum over the columns of a row."""
        inputs = [self.grid, self.views, self.flat["gap"]]
        self._launch_pixels(distance_transform.measure_rows_kernel, inputs, [self.flat["distance"]])

    def measure_patches(self) -> None:
        """Find the poles of inaccessibility and sum the squared depths."""
        flat, scratch = self.flat, self.scratch
        inputs = [flat["patch"], flat["distance"], flat["depth"], self.width]
        self._launch(grasp_points.measure_patches_kernel, (self.height, self.strips), inputs, [scratch.pole_key, scratch.square])

    def trace_contours(self, observation: Observation) -> None:
        """Follow the outer contours and compute their centroids."""
        arrays = self.arrays
        outputs = [arrays.contour, arrays.contour_length, observation.centroid, observation.overflow]
        self._launch(contours.trace_contours_kernel, (self.views.instances,), [self.flat["patch"], arrays.largest, self.width], outputs)

    def measure_points(self, scene: SceneData, entry: wp.array, observation: Observation) -> None:
        """Compute visible fractions, and the distances to the contour at pole, centroid and midpoint."""
        arrays, flat, scratch = self.arrays, self.flat, self.scratch
        inputs = [scene.catalog, self.cameras.intrinsics, entry, self.views, flat["component"], flat["area"], arrays.largest]
        inputs += [flat["distance"], scratch.pole_key, scratch.square, self.width]
        outputs = [observation.visible, observation.visible_fraction, observation.pole, observation.centroid, observation.distances]
        dim, device = (self.views.count, self.views.instances), self.render_scene.device
        wp.launch(grasp_points.measure_points_kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)

    def choose_grasp_points(self, scene: SceneData, entry: wp.array, observation: Observation) -> None:
        """Choose each instance's grasp point among the candidates, and read its depth."""
        inputs = [scene.catalog, scene.perception, entry, self.views, observation.visible, observation.pole, observation.centroid]
        inputs += [observation.distances, self.gbuffer.depth]
        outputs = [observation.midpoint, observation.grasp_pixel, observation.depth]
        dim, device = (self.views.count, self.views.instances), self.render_scene.device
        wp.launch(grasp_points.choose_grasp_points_kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)

    def _launch(self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel over all views; its first input is the struct `Views`."""
        wp.launch(kernel, dim=(self.views.count, *dim), inputs=[self.views, *inputs], outputs=outputs, device=self.render_scene.device)

    def _launch_pixels(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        launch_pixels(kernel, self.pixels, inputs, outputs, self.render_scene.device)


def _images(*groups: Any) -> dict[str, wp.array]:
    """The images (view, row, column) among the arrays of dataclasses, flattened, by name."""
    members = [(group, item) for group in groups for item in fields(group)]
    images = [(group, item.name) for group, item in members if item.metadata["array"].shape == ("view", "row", "column")]
    return {name: _flatten(getattr(group, name)) for group, name in images}


def _flatten(image: wp.array) -> wp.array:
    """View (view, pixel) of an image (view, row, column); it shares the memory."""
    return image.reshape((image.shape[0], image.shape[1] * image.shape[2]))
