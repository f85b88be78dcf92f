"""Pixel counts and bounding boxes of every instance of a batch of views; and run boundaries of segmentation ids and amodal masks, from
which writers build RLE and PNG masks without images."""

from typing import Any

import warp as wp

from synpick_warp.kernels.render.images import boxes_counts, mask_runs
from synpick_warp.kernels.tuning import BORDER_CHUNK, BORDER_GROUPS, BORDER_THREADS, COUNT_THREADS, RUN_BANDS, RUN_LANES
from synpick_warp.stages.arrays import allocate_struct, array_group, struct_arrays
from synpick_warp.stages.buffers import ViewBuffers, masks_of
from synpick_warp.stages.launch import launch
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.views.frames import WORD_BYTES

BORDER_BOXES = struct_arrays(boxes_counts.BorderBoxes, "view_instance", length=("one",))
BORDER_COUNTS = struct_arrays(boxes_counts.BorderCounts, "view", "instance", boxes=("view", "instance", "one", "side"))
KEPT_COUNTS = struct_arrays(boxes_counts.BorderCounts, "kept", "instance", boxes=("kept", "instance", "one", "side"))


class Annotator:
    """Counts the instances' pixels and bounds them by boxes. Owns its scratch; `annotate` only launches."""

    def __init__(self, scene: RenderScene, instances: int, views: int, kept: int = 0) -> None:
        """Allocate scratch. `scene`: constant data. `instances`: instance capacity of a world. `views`: maximum number of views of a batch.
        `kept`: number of views whose counts beyond the image are kept from frame to frame."""
        self.scene = scene
        self.border_boxes: Any = allocate_struct(BORDER_BOXES, {"view_instance": views * instances, "one": 1}, scene.device)
        sizes = {"view": views, "kept": kept, "instance": instances, "one": 1, "side": 4}
        self.border: Any = allocate_struct(KEPT_COUNTS if kept else BORDER_COUNTS, sizes, scene.device)

    def annotate(self, shot: Any, damage: Any, out: ViewBuffers) -> None:
        """Compute `out.pixels` and `out.boxes` of the views of the struct `ShotData` from their images and, beyond the image border, by
        rays, where the struct `Damage` says that bodies moved."""
        scene, instances, views = self.scene, out.pixels.shape[1], shot.views
        threads = COUNT_THREADS if scene.device.is_cuda else 1
        images = {"instance_image": out.instance, "depth_image": out.depth, "masks": masks_of(out)}
        launch(boxes_counts.clear_boxes_counts_kernel, (views.count, instances), out)
        launch(boxes_counts.count_image_pixels_kernel, (views.count, instances, threads), out, threads=threads, **images)
        self._count_border_pixels(shot, damage, instances)
        launch(boxes_counts.finish_boxes_counts_kernel, (views.count, instances, 2), self, out, damage=damage)

    def _count_border_pixels(self, shot: Any, damage: Any, instances: int) -> None:
        """List the boxes that reach beyond the image, and count the pixels there by rays."""
        scene, device = self.scene, self.scene.device
        groups, threads = (BORDER_GROUPS, BORDER_THREADS) if device.is_cuda else (1, 1)
        self.border_boxes.length.zero_()
        wp.launch(
            boxes_counts.list_border_boxes_kernel,
            dim=(shot.views.count, instances),
            inputs=[scene.grid, damage, shot.bodies, instances, BORDER_CHUNK],
            outputs=[self.border_boxes, self.border],
            device=device,
        )
        given = {"shot": shot, "damage": damage, "groups": groups, "threads": threads, "chunk": BORDER_CHUNK}
        launch(boxes_counts.count_border_pixels_kernel, (groups, threads), self, scene, block_dim=BORDER_THREADS, **given)


BOUNDARIES_PER_COLUMN = 24
"""Least capacity of a list, as a mean over the columns of an image: three times the run boundaries of a tote with 14 objects. Of many
instances there is one a mask, and one for two of them in the ids, in which they hide each other; those are never more than an image."""
FIELDS = 2
"""Fields of a boundary of the ids: position; values above and below."""


_COUNTS = {
    "column_count": ("view", "column"),
    "band_count": ("view", "band", "column"),
    "lane_count": ("view", "instance", "lane"),
}
_LISTS = {"boundaries": ("view", "field", "boundary"), "runs": ("view", "run")}


class BoundaryBuffers(array_group(mask_runs.Boundaries, boundary_count=("view",), run_count=("view", "instance"), **_LISTS)):
    """Run boundaries of the ids and amodal masks of a batch of views."""


class BoundaryScratch(array_group(mask_runs.BoundaryCounts, **_COUNTS)):
    """Scratch between the two passes over images and masks."""


def boundary_sizes(view_sizes: dict[str, int]) -> dict[str, int]:
    """Extents of the dimensions of `BoundaryBuffers` and `BoundaryScratch`, from those of `ViewBuffers`."""
    sizes = {name: view_sizes[name] for name in ("view", "column", "instance")} | {"field": FIELDS, "lane": RUN_LANES, "band": RUN_BANDS}
    columns, instances = view_sizes["column"], view_sizes["instance"]
    seen = min(instances // 2, view_sizes["row"] // (FIELDS * WORD_BYTES))
    ids, masks = (columns * max(BOUNDARIES_PER_COLUMN, most) for most in (seen, instances))
    return sizes | {"boundary": ids, "run": masks}


def list_boundaries(scratch: BoundaryScratch, count: int, images: ViewBuffers, out: BoundaryBuffers) -> None:
    """List the run boundaries of the first `count` views' segmentation ids and amodal masks. `scratch`: overwritten. `count`: views in use.
    `images`: its ids and masks are read. `out`: written."""
    instance, masks, device = images.instance, masks_of(images), scratch.column_count.device
    counts, runs = scratch.bundle, out.bundle
    scratch.column_count.zero_()
    dim = (count, *scratch.band_count.shape[1:])
    wp.launch(mask_runs.count_boundaries_kernel, dim=dim, inputs=[instance], outputs=[counts], device=device)
    wp.launch(mask_runs.list_boundaries_kernel, dim=dim, inputs=[instance, counts], outputs=[runs], device=device)
    out.run_count.zero_()
    dim = (count, *scratch.lane_count.shape[1:])
    wp.launch(mask_runs.count_runs_kernel, dim=dim, inputs=[masks], outputs=[counts, runs], device=device)
    wp.launch(mask_runs.list_runs_kernel, dim=dim, inputs=[masks, instance.shape[1], counts], outputs=[runs], device=device)
