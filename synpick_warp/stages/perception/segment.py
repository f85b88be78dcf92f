"""Instance segmentation and suction grasp points from the perception images; batches of views, entirely on the device."""

from __future__ import annotations

from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import warp as wp

from synpick_warp.kernels.perception import components, contours, distance_transform, grasp_points
from synpick_warp.kernels.perception.components import Segments
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.stages.arrays import bundle
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch, launch_images
from synpick_warp.stages.perception.arrays import Observation
from synpick_warp.stages.perception.images import PerceptionImages


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
