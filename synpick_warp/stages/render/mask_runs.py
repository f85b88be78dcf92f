"""Run boundaries of a batch's segmentation ids and amodal masks, from which writers build RLE and PNG masks without images."""

import warp as wp

from synpick_warp.kernels.render.images import mask_runs
from synpick_warp.kernels.tuning import RUN_BANDS, RUN_LANES
from synpick_warp.stages.arrays import array_group
from synpick_warp.stages.buffers import ViewBuffers, masks_of
from synpick_warp.views.frames import WORD_BYTES

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
