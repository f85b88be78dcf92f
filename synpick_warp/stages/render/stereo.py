"""Active stereo camera of a batch of views: launches of the infrared pair, and of stereo matching, a few views at a time."""

import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from synpick_warp.codes import MAX_DISPARITIES
from synpick_warp.kernels.render.images.clear_bodies import see_through_kernel
from synpick_warp.kernels.render.images.infrared import render_infrared_kernel
from synpick_warp.kernels.render.images.stereo_matching import (
    WARP,
    MatchingScratch,
    match_left_kernel,
    match_right_kernel,
    measure_depth_kernel,
    sum_path_costs_kernel,
    transform_census_kernel,
)
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.stages.arrays import allocate, allocate_struct, device_array, struct_arrays
from synpick_warp.stages.buffers import LayerBuffers
from synpick_warp.stages.launch import launch_pixels, launch_views
from synpick_warp.stages.render.scene import RenderScene

EYES = ("ir_left", "ir_right")
DEPTH = "depth_stereo"
STEREO_LAYERS = {*EYES, DEPTH}
"""Layers of an active stereo camera."""
DIRECTIONS = 4
"""Directions of paths: right, left, down and up."""
GPU_SLOTS, CPU_SLOTS = 8, 1
"""Views that are matched at a time: their paths, a warp each, fill the multiprocessors of a GPU."""
MAX_COSTS = 1 << 30
"""Elements of the cost volumes of these views together, 2 bytes each, above which fewer are matched at a time."""


@dataclass(frozen=True, eq=False)
class InfraredImages:
    """Infrared pair, where it is no layer itself."""

    ir_left: wp.array = device_array("view", "row", "column", dtype=wp.uint8)
    ir_right: wp.array = device_array("view", "row", "column", dtype=wp.uint8)


MATCHING = struct_arrays(
    MatchingScratch, "slot", "row", "column", census=("slot", "eye", "row", "column"), cost=("slot", "row", "column", "disparity")
)


def count_disparities(max_disparity: float) -> int:
    """Disparities that are searched, from that of the farthest depth on: up to `max_disparity` [px], if it is set, and MAX_DISPARITIES."""
    return min(math.ceil(max_disparity) + 2, MAX_DISPARITIES) if max_disparity > 0.0 else MAX_DISPARITIES


class StereoRenderer:
    """Renders infrared pairs and matches them. Owns its scratch; `render` only launches, so a CUDA graph can capture it."""

    def __init__(self, names: tuple[str, ...], sensor: Any, scene: RenderScene, views: int) -> None:
        """Allocate scratch. `names`: layers to render; those that are none of `STEREO_LAYERS` are ignored. `sensor`: the struct
        `SensorParameters`. `scene`: constant data. `views`: largest number of views in a batch."""
        self.scene, self.sensor = scene, sensor
        self.matches = DEPTH in names
        disparities = count_disparities(sensor.max_disparity)
        most = MAX_COSTS // (scene.height * scene.width * disparities)
        self.slots = max(1, min(views, GPU_SLOTS if scene.device.is_cuda else CPU_SLOTS, most))
        sizes = {"view": views, "slot": self.slots, "eye": len(EYES), "row": scene.height, "column": scene.width, "disparity": disparities}
        self.eyes = [eye for eye in EYES if eye in names or self.matches]
        self.images = allocate(InfraredImages, sizes, scene.device, set(self.eyes) - set(names))
        self.scratch: Any = allocate_struct(MATCHING, sizes, scene.device) if self.matches else None

    def render(self, shot: Any, out: LayerBuffers, behind: Any) -> None:
        """Render the infrared images of a batch of views, and match them; arguments as of `LayerRenderer.render`."""
        scene, views = self.scene, shot.views
        pixels = views.count * scene.grid.tiles * int(TILE_PIXELS)
        own = [getattr(self.images, eye) for eye in self.eyes]
        images = {eye: getattr(out, eye) if image is None else image for eye, image in zip(self.eyes, own, strict=True)}
        for eye, image in images.items():
            kernel, more = (render_infrared_kernel, ()) if behind is None else (see_through_kernel, (behind.bodies, behind.gbuffer))
            launch_pixels(kernel, pixels, [scene.paths, self.sensor, shot, *more, EYES.index(eye)], [image], scene.device)
        if self.scratch is not None:
            for first in range(0, views.count, self.slots):
                self.match(first, min(self.slots, views.count - first), views, list(images.values()), out.depth_stereo)

    def match(self, first_view: int, count: int, views: Any, images: list[wp.array], depth: wp.array) -> None:
        """Match the left and right images of `count` views, at most as many as there are slots."""
        grid, sensor, scratch, device = self.scene.grid, self.sensor, self.scratch, self.scene.device
        pixels = count * grid.tiles * int(TILE_PIXELS)
        launch_pixels(transform_census_kernel, len(EYES) * pixels, [grid, *images, first_view], [scratch.census], device)
        lanes = WARP if device.is_cuda else 1
        for direction in range(DIRECTIONS):
            lines = grid.height if direction < DIRECTIONS // 2 else grid.width
            inputs = [sensor, views, first_view, direction, lines, lanes]
            launch_views(sum_path_costs_kernel, count * lines, lanes, inputs, [scratch], device)
        for kernel in (match_right_kernel, match_left_kernel):
            launch_pixels(kernel, pixels, [grid, sensor, views, first_view], [scratch], device)
        launch_pixels(measure_depth_kernel, pixels, [grid, sensor, views, scratch.disparity, first_view], [depth], device)
