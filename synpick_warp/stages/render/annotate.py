"""Pixel counts and bounding boxes of every instance, for a batch of views."""

from __future__ import annotations

from typing import Any

import warp as wp

from synpick_warp.kernels.render.images.boxes_counts import (
    clear_boxes_counts_kernel,
    count_border_pixels_kernel,
    count_image_pixels_kernel,
    reset_empty_boxes_kernel,
)
from synpick_warp.kernels.tuning import COUNT_THREADS
from synpick_warp.stages.buffers import ViewBuffers
from synpick_warp.stages.render.scene import RenderScene


def annotate(scene: RenderScene, bodies: Any, views: Any, out: ViewBuffers) -> None:
    """Compute `out.pixels` and `out.boxes` of the views from their images and, beyond the image border, by rays.

    Args:
        scene: Constant data.
        bodies: The struct `ViewBodies` that `set_up_views` filled for these views.
        views: The struct `Views`.
        out: Its images are read, its counts and boxes written.
    """
    instances = out.pixels.shape[1]
    threads = COUNT_THREADS if scene.device.is_cuda else 1
    wp.launch(clear_boxes_counts_kernel, dim=(views.count, instances), outputs=[out.pixels, out.boxes], device=scene.device)
    wp.launch(
        count_image_pixels_kernel,
        dim=(views.count, instances, threads),
        inputs=[scene.grid, bodies, out.instance, out.depth, out.amodal, threads],
        outputs=[out.pixels, out.boxes],
        device=scene.device,
    )
    wp.launch(
        count_border_pixels_kernel,
        dim=(views.count, instances, threads),
        inputs=[scene.meshes, scene.cameras, scene.grid, bodies, views, threads],
        outputs=[out.pixels, out.boxes],
        device=scene.device,
    )
    wp.launch(reset_empty_boxes_kernel, dim=(views.count, instances, 2), outputs=[out.boxes], device=scene.device)
