"""Instance segmentation and suction grasp points from the perception images; batches of views, entirely on the device."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import warp as wp

from synpick_warp.kernels.perception import components, contours, distance_transform, grasp_points
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.perception.arrays import Observation
from synpick_warp.stages.perception.images import PerceptionImages


class Segmenter:
    """Segments a batch of images and finds grasp points. Owns its scratch; `find_grasp_points` only launches kernels.

    Attributes:
        arrays: Components, distance transforms and contours of the batch.
    """

    def __init__(self, images: PerceptionImages) -> None:
        """Take the scratch of `images`, whose G-buffers it reads."""
        self.images = images
        self.grid, self.device = images.scene.grid, images.scene.device
        self.width, self.height, self.instances = self.grid.width, self.grid.height, images.views.instances
        self.pixels = images.views.count * self.grid.tiles * int(TILE_PIXELS)
        self.strips = -(-self.width // int(components.STRIP))
        self.arrays, self.scratch = images.arrays, images.scratch
        self.flat = _flatten_images(self.arrays, self.scratch)
        self.flat |= {name: _flatten(getattr(images.gbuffer, name)) for name in ("segment", "depth")}

    def find_grasp_points(self, scene: SceneData, catalog_index: wp.array, observation: Observation) -> None:
        """Compute components, distance transforms, contours and grasp points of the rendered views.

        Args:
            scene: Constants; mass and area of `catalog` are read.
            catalog_index: Catalog index of each instance (world, instance) int32.
            observation: Written for the worlds of the batch, except votes and clutter graph.
        """
        self.clear_sums(observation)
        self.label_strips()
        self.merge_strips()
        self.measure_components()
        self.find_largest()
        self.unpack_largest(scene, catalog_index)
        self.mark_patches()
        self.measure_columns()
        self.measure_rows()
        self.measure_patches()
        self.trace_contours(observation)
        self.measure_points(scene, catalog_index, observation)
        self.choose_grasp_points(scene, catalog_index, observation)

    def clear_sums(self, observation: Observation) -> None:
        """Reset maxima, sums and overflow flags to 0."""
        scratch = self.scratch
        outputs = [scratch.largest_key, scratch.pole_key, scratch.square, observation.overflow]
        self._launch(grasp_points.clear_sums_kernel, (self.instances,), [], outputs)

    def label_strips(self) -> None:
        """Label the runs of equal segmentation ids within each strip."""
        flat, count = self.flat, self.images.views.count * self.height * self.strips
        inputs = [self.images.views, flat["segment"], self.width, self.height, self.strips]
        launch_pixels(components.label_strips_kernel, count, inputs, [flat["component"], flat["area"]], self.device)

    def merge_strips(self) -> None:
        """Unite runs of one segment that touch across the borders of strips (connected components)."""
        inputs = [self.flat["segment"], self.width]
        self._launch(components.merge_strips_kernel, (self.height, self.strips), inputs, [self.flat["component"]])

    def measure_components(self) -> None:
        """Replace labels by roots and count the pixels of each component."""
        outputs = [self.flat["component"], self.flat["area"]]
        self._launch(components.measure_components_kernel, (self.height, self.strips), [self.width], outputs)

    def find_largest(self) -> None:
        """Find the largest component of each instance, as a packed key."""
        inputs = [self.flat["segment"], self.flat["area"]]
        self._launch(components.find_largest_kernel, (self.height * self.width,), inputs, [self.scratch.largest_key])

    def unpack_largest(self, scene: SceneData, catalog_index: wp.array) -> None:
        """Unpack the labels of the largest components from their keys."""
        views = self.images.views
        inputs = [scene.catalog, catalog_index, views, self.scratch.largest_key]
        dim = (views.count, self.instances)
        wp.launch(components.unpack_largest_kernel, dim=dim, inputs=inputs, outputs=[self.arrays.largest], device=self.device)

    def mark_patches(self) -> None:
        """Mark the pixels of the largest components and their neighbours."""
        flat = self.flat
        inputs = [self.grid, self.images.views, flat["segment"], flat["component"], self.arrays.largest]
        self._launch_pixels(distance_transform.mark_patches_kernel, inputs, [flat["patch"]])

    def measure_columns(self) -> None:
        """First pass of the distance transform: distances within columns."""
        inputs = [self.grid, self.images.views, self.flat["patch"]]
        dim = (self.images.views.count, self.width)
        wp.launch(distance_transform.measure_columns_kernel, dim=dim, inputs=inputs, outputs=[self.flat["gap"]], device=self.device)

    def measure_rows(self) -> None:
        """Second pass of the distance transform: minimum over the columns of a row."""
        inputs = [self.grid, self.images.views, self.flat["gap"]]
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
        self._launch(contours.trace_contours_kernel, (self.instances,), [self.flat["patch"], arrays.largest, self.width], outputs)

    def measure_points(self, scene: SceneData, catalog_index: wp.array, observation: Observation) -> None:
        """Compute visible fractions, and the distances to the contour at pole, centroid and midpoint."""
        images, arrays, flat, scratch = self.images, self.arrays, self.flat, self.scratch
        inputs = [scene.catalog, images.scene.cameras.intrinsics, catalog_index, images.views]
        inputs += [flat["component"], flat["area"], arrays.largest, flat["distance"], scratch.pole_key, scratch.square, self.width]
        outputs = [observation.visible, observation.visible_fraction, observation.pole, observation.centroid, observation.distances]
        dim = (self.images.views.count, self.instances)
        wp.launch(grasp_points.measure_points_kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def choose_grasp_points(self, scene: SceneData, catalog_index: wp.array, observation: Observation) -> None:
        """Choose each instance's grasp point among the candidates, and read its depth."""
        images = self.images
        inputs = [scene.catalog, scene.perception, catalog_index, images.views]
        inputs += [observation.visible, observation.pole, observation.centroid, observation.distances, images.gbuffer.depth]
        outputs = [observation.midpoint, observation.grasp_pixel, observation.depth]
        dim = (self.images.views.count, self.instances)
        wp.launch(grasp_points.choose_grasp_points_kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _launch(self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel over all views; its first input is the struct `Views`."""
        views = self.images.views
        wp.launch(kernel, dim=(views.count, *dim), inputs=[views, *inputs], outputs=outputs, device=self.device)

    def _launch_pixels(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel over all pixels of the batch."""
        launch_pixels(kernel, self.pixels, inputs, outputs, self.device)


def _flatten(image: wp.array) -> wp.array:
    """View (view, pixel) of an array (view, row, column); they share memory."""
    return image.reshape((image.shape[0], image.shape[1] * image.shape[2]))


def _flatten_images(*groups: Any) -> dict[str, wp.array]:
    """`_flatten` for the images among the arrays of dataclasses, by name."""
    named = [(item.name, item.metadata["array"].shape, getattr(group, item.name)) for group in groups for item in fields(group)]
    return {name: _flatten(array) for name, shape, array in named if shape == ("view", "row", "column")}
