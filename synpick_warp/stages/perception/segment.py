"""Looking: what camera 0 shows of each instance without the gripper, and where each would be sucked. Batches of views, on the device."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import warp as wp

from synpick_warp.arrays import allocate, device_array, memory_table
from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError
from synpick_warp.kernels.perception import components, contours, distance_transform, suction_points
from synpick_warp.kernels.render.visibility import gbuffer, view_setup
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.perception.arrays import LookArrays, Sighting
from synpick_warp.stages.render.scene import RenderScene, build_cameras, build_grid
from synpick_warp.stages.render.view_setup import BodyArrays, HitArrays, body_sizes, filled, place_bodies

CPU_BYTES = 512 * 2**20
GPU_BYTES = 2 * 2**30
"""Scratch that views may take if their number is left open."""
CPU_VIEWS = 4
"""Most views on the processor then: a batch gains nothing there, and views that are not in use still cost a little."""
CENTER = wp.vec2(0.0, 0.0)
"""Rays pass the pixels' centres."""


@dataclass(frozen=True, eq=False)
class SightScratch:
    """What lies between the arrays of a look. A patch is the largest component of an instance."""

    patch: wp.array = device_array("view", "row", "column", dtype=wp.uint16)
    """Low byte: 1 + instance, 0: of no patch; bit 8 + d: the neighbour in direction d is of the same."""
    gap: wp.array = device_array("view", "row", "column", dtype=wp.int32)
    """256 x distance within the column [px] + low byte of `patch`."""
    largest_key: wp.array = device_array("view", "instance", dtype=wp.int64)
    """Size and name of the largest component, as `ranked` packs them."""
    pole_key: wp.array = device_array("view", "instance", dtype=wp.int64)
    """Squared distance [px²] and pixel of the pole, as `ranked` packs them."""
    square: wp.array = device_array("view", "instance", dtype=wp.int64, unit="2⁻²⁴ m²")
    """Sum of squared depths over the patch."""


SCRATCH = (BodyArrays, HitArrays, LookArrays, SightScratch)


def sight_sizes(config: Config, instances: int, views: int) -> dict[str, int]:
    """Extents of the dimensions that the dataclasses of `SCRATCH` name."""
    width, height = config.sight.resolution
    return {
        "view": views,
        "instance": instances,
        "row": height,
        "column": width,
        "point": config.sight.contour_points,
    } | body_sizes(instances, width, height)


def view_bytes(config: Config, instances: int) -> int:
    """Scratch that one view takes [bytes]."""
    sizes = sight_sizes(config, instances, 1)
    return sum(row[3] for kind in SCRATCH for row in memory_table(kind, sizes))


def count_views(config: Config, instances: int, device: wp.Device) -> int:
    """Views of a batch: as configured, or as many as fit; never more than there are worlds."""
    views = config.sight.views
    if views == 0:
        each = view_bytes(config, instances)
        views = GPU_BYTES // each if device.is_cuda else min(CPU_BYTES // each, CPU_VIEWS)
    return min(max(views, 1), config.bake.worlds)


class Sight:
    """Looks at batches of worlds. Owns its scratch; `trace` and `find_suction_points` only launch, so a CUDA graph can capture them.

    Attributes:
        look: Arrays of the batch. Who looks fills `look.world`: the world of each view, each world once; -1: the view is not in use.
        hits: The struct `Hits` of the batch.
        cameras: The struct `Cameras` of camera 0 alone, at the resolution of sight.
        grid: The struct `ImageGrid` of its image.
        views: Views of a batch.
    """

    def __init__(self, config: Config, scene: RenderScene, instances: int) -> None:
        """Allocate scratch.

        Args:
            config: All settings.
            scene: Meshes and table of the renderer; its cameras are not used.
            instances: Room for instances of a world, at most 32.

        Raises:
            ConfigError: A batch has more pixels than 31 bits count.
        """
        device = scene.device
        self.scene, self.instances = scene, instances
        self.views = count_views(config, instances, device)
        sizes = sight_sizes(config, instances, self.views)
        self.width, self.height = config.sight.resolution
        self.grid = build_grid(self.width, self.height)
        self.pixels = self.views * self.grid.tiles * int(TILE_PIXELS)
        if self.pixels >= 2**31:
            raise ConfigError(f"sight.views is {self.views}; of {self.width} x {self.height} px that is more than 2³¹ pixels; take fewer")
        self.look = allocate(LookArrays, sizes, device)
        self.look.world.fill_(-1)
        self.scratch = allocate(SightScratch, sizes, device)
        self.hit_arrays = allocate(HitArrays, sizes, device)
        self.hits = filled(gbuffer.Hits, self.hit_arrays)
        self.bodies = filled(gbuffer.Bodies, allocate(BodyArrays, sizes, device))
        self.cameras = build_cameras(make_cameras(replace(config.cameras, resolution=config.sight.resolution))[:1], device)
        self.strips = -(-self.width // int(components.STRIP))
        self.fixture_visible = wp.array([[1, 0, 0]] * config.bake.worlds, dtype=wp.int32, device=device)
        self.flat = _flat(self.hit_arrays, self.look, self.scratch)

    def trace(self, snapshot: Snapshot) -> None:
        """What each pixel shows, without finger and cup. Views that are not in use keep what they had."""
        scene, look = self.scene, self.look
        wp.launch(view_setup.aim_views_kernel, dim=self.views, inputs=[look.world], outputs=[look.camera], device=scene.device)
        place_bodies(scene, self.cameras, self.grid, snapshot, self.fixture_visible, look.world, look.camera, self.views, self.bodies)
        inputs = [scene.meshes, scene.table, self.cameras, self.grid, self.bodies, look.camera, self.instances, CENTER]
        self._launch_pixels(gbuffer.trace_sample_kernel, inputs, [self.hits])

    def find_suction_points(self, scene: SceneData, entry: wp.array, sighting: Sighting) -> None:
        """Components, distances, contours and suction points of the traced views.

        Args:
            scene: Constants; of `catalog` mass and area are read.
            entry: Catalog index of each instance (N, I) int32.
            sighting: Rows of the worlds looked at are written, but for votes and what follows from them.
        """
        self.clear_sums(sighting)
        self.label_strips()
        self.merge_strips()
        self.measure_components()
        self.find_largest()
        self.name_largest()
        self.mark_patches()
        self.measure_columns()
        self.measure_rows()
        self.measure_patches()
        self.trace_contours(sighting)
        self.measure_points(scene, entry, sighting)
        self.choose_suction_points(scene, entry, sighting)

    def clear_sums(self, sighting: Sighting) -> None:
        """Maxima and sums to 0."""
        scratch = self.scratch
        outputs = [scratch.largest_key, scratch.pole_key, scratch.square, sighting.overflow]
        self._launch(suction_points.clear_sums_kernel, (self.instances,), [], outputs)

    def label_strips(self) -> None:
        """Name pixels by their runs."""
        flat, count = self.flat, self.views * self.height * self.strips
        inputs = [self.look.world, flat["code"], self.instances, self.width, self.height, self.strips]
        launch_pixels(components.label_strips_kernel, count, inputs, [flat["component"], flat["area"]], self.scene.device)

    def merge_strips(self) -> None:
        """Join runs that touch."""
        inputs = [self.flat["code"], self.instances, self.width]
        self._launch(components.merge_strips_kernel, (self.height, self.strips), inputs, [self.flat["component"]])

    def measure_components(self) -> None:
        """Name pixels by their components, and count these."""
        outputs = [self.flat["component"], self.flat["area"]]
        self._launch(components.measure_components_kernel, (self.height, self.strips), [self.width], outputs)

    def find_largest(self) -> None:
        """Keys of the largest components."""
        inputs = [self.flat["code"], self.flat["area"]]
        self._launch(components.find_largest_kernel, (self.height * self.width,), inputs, [self.scratch.largest_key])

    def name_largest(self) -> None:
        """Names of the largest components."""
        self._launch(components.name_largest_kernel, (self.instances,), [self.scratch.largest_key], [self.look.largest])

    def mark_patches(self) -> None:
        """Pixels of the largest components and their neighbours."""
        flat = self.flat
        inputs = [self.grid, self.look.world, flat["code"], flat["component"], self.look.largest]
        self._launch_pixels(distance_transform.mark_patches_kernel, inputs, [flat["patch"]])

    def measure_columns(self) -> None:
        """Distances within columns."""
        inputs = [self.grid, self.look.world, self.flat["patch"]]
        dim = (self.views, self.width)
        wp.launch(distance_transform.measure_columns_kernel, dim=dim, inputs=inputs, outputs=[self.flat["gap"]], device=self.scene.device)

    def measure_rows(self) -> None:
        """Distances."""
        inputs = [self.grid, self.look.world, self.flat["gap"]]
        self._launch_pixels(distance_transform.measure_rows_kernel, inputs, [self.flat["distance"]])

    def measure_patches(self) -> None:
        """Poles and visible areas."""
        flat, scratch = self.flat, self.scratch
        inputs = [flat["patch"], flat["distance"], flat["depth"], self.width]
        self._launch(suction_points.measure_patches_kernel, (self.height, self.strips), inputs, [scratch.pole_key, scratch.square])

    def trace_contours(self, sighting: Sighting) -> None:
        """Contours and their centroids."""
        look = self.look
        outputs = [look.contour, look.contour_length, sighting.centroid, sighting.overflow]
        self._launch(contours.trace_contours_kernel, (self.instances,), [self.flat["patch"], look.largest, self.width], outputs)

    def measure_points(self, scene: SceneData, entry: wp.array, sighting: Sighting) -> None:
        """Visible shares; distances of pole, centroid and the point half-way."""
        look, flat, scratch = self.look, self.flat, self.scratch
        inputs = [scene.catalog, self.cameras.intrinsics, entry, look.world, flat["component"], flat["area"], look.largest]
        inputs += [flat["distance"], scratch.pole_key, scratch.square, self.width]
        outputs = [sighting.visible, sighting.share, sighting.pole, sighting.centroid, sighting.distances]
        dim = (self.views, self.instances)
        wp.launch(suction_points.measure_points_kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.scene.device)

    def choose_suction_points(self, scene: SceneData, entry: wp.array, sighting: Sighting) -> None:
        """Suction points and their depths."""
        inputs = [scene.catalog, scene.sight, entry, self.look.world, sighting.visible, sighting.pole, sighting.centroid]
        inputs += [sighting.distances, self.hit_arrays.depth]
        outputs = [sighting.middle, sighting.suction, sighting.depth]
        dim = (self.views, self.instances)
        wp.launch(suction_points.choose_suction_points_kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.scene.device)

    def _launch(self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> None:
        """Launch over all views a kernel whose first input is their worlds."""
        wp.launch(kernel, dim=(self.views, *dim), inputs=[self.look.world, *inputs], outputs=outputs, device=self.scene.device)

    def _launch_pixels(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        launch_pixels(kernel, self.pixels, inputs, outputs, self.scene.device)


def _flat(*groups: Any) -> dict[str, wp.array]:
    """The images among the arrays of dataclasses, with rows and columns as one dimension; they share their memory."""
    flat = {}
    for group in groups:
        for item in fields(group):
            if item.metadata["array"].shape == ("view", "row", "column"):
                image = getattr(group, item.name)
                flat[item.name] = image.reshape((image.shape[0], image.shape[1] * image.shape[2]))
    return flat
