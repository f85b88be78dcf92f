"""Pixel counts and bounding boxes of every instance, for a batch of views."""

from typing import Any

import warp as wp

from synpick_warp.kernels.render.images import boxes_counts
from synpick_warp.kernels.tuning import BORDER_CHUNK, BORDER_GROUPS, BORDER_THREADS, COUNT_THREADS
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.buffers import ViewBuffers, masks_of
from synpick_warp.stages.launch import launch
from synpick_warp.stages.render.scene import RenderScene

BORDER_BOXES = struct_arrays(boxes_counts.BorderBoxes, "view_instance", length=("one",))


class Annotator:
    """Counts the instances' pixels and bounds them by boxes. Owns its scratch; `annotate` only launches."""

    def __init__(self, scene: RenderScene, instances: int, views: int) -> None:
        """Allocate scratch.

        Args:
            scene: Constant data.
            instances: Instance capacity of a world.
            views: Maximum number of views of a batch.
        """
        self.scene = scene
        self.border_boxes: Any = allocate_struct(BORDER_BOXES, {"view_instance": views * instances, "one": 1}, scene.device)

    def annotate(self, shot: Any, out: ViewBuffers) -> None:
        """Compute `out.pixels` and `out.boxes` of the views of the struct `ShotData` from their images and, beyond the image border, by
        rays."""
        scene, instances, views = self.scene, out.pixels.shape[1], shot.views
        threads = COUNT_THREADS if scene.device.is_cuda else 1
        images = {"instance_image": out.instance, "depth_image": out.depth, "masks": masks_of(out)}
        launch(boxes_counts.clear_boxes_counts_kernel, (views.count, instances), out)
        launch(boxes_counts.count_image_pixels_kernel, (views.count, instances, threads), out, threads=threads, **images)
        self._count_border_pixels(shot, out)
        launch(boxes_counts.reset_empty_boxes_kernel, (views.count, instances, 2), out)

    def _count_border_pixels(self, shot: Any, out: ViewBuffers) -> None:
        """List the boxes that reach beyond the image, and count the pixels there by rays."""
        scene, device, instances = self.scene, self.scene.device, out.pixels.shape[1]
        groups, threads = (BORDER_GROUPS, BORDER_THREADS) if device.is_cuda else (1, 1)
        self.border_boxes.length.zero_()
        wp.launch(
            boxes_counts.list_border_boxes_kernel,
            dim=(shot.views.count, instances),
            inputs=[scene.grid, shot.bodies, instances, BORDER_CHUNK],
            outputs=[self.border_boxes],
            device=device,
        )
        given = {"shot": shot, "groups": groups, "threads": threads, "chunk": BORDER_CHUNK}
        launch(boxes_counts.count_border_pixels_kernel, (groups, threads), self, scene, out, block_dim=BORDER_THREADS, **given)
