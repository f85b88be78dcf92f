"""Run boundaries of a batch's segmentation ids and amodal masks, from which writers build RLE and PNG masks without images."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from synpick_warp.kernels.render.images.mask_runs import (
    count_boundaries_kernel,
    count_runs_kernel,
    list_boundaries_kernel,
    list_runs_kernel,
)
from synpick_warp.kernels.tuning import RUN_LANES
from synpick_warp.stages.arrays import device_array
from synpick_warp.stages.buffers import ViewBuffers, masks_of
from synpick_warp.views.frames import WORD_BYTES

BOUNDARIES_PER_COLUMN = 24
"""Least capacity of a list, as a mean over the columns of an image: three times the run boundaries of a tote with 14 objects. Of many
instances there is one a mask, and one for two of them in the ids, in which they hide each other; those are never more than an image."""
FIELDS = 2
"""Fields of a boundary of the ids: position; values above and below."""


@dataclass(frozen=True, eq=False)
class BoundaryBuffers:
    """Run boundaries of the segmentation ids and amodal masks of a batch of views, and their counts. A count may exceed the capacity of its
    list; the list is then truncated. See `FrameBatch`.
    """

    boundary_count: wp.array = device_array("view", dtype=wp.int32)
    """Run boundaries of the ids, including those beyond the capacity of `boundaries`."""
    boundaries: wp.array = device_array("view", "field", "boundary", dtype=wp.uint32)
    """Position, and values above and below, of each run boundary of the ids."""
    run_count: wp.array = device_array("view", "instance", dtype=wp.int32)
    """Run boundaries of each amodal mask, including those beyond the capacity of `runs`."""
    runs: wp.array = device_array("view", "run", dtype=wp.uint32)
    """Positions of the run boundaries of the amodal masks, mask by mask."""


@dataclass(frozen=True, eq=False)
class BoundaryScratch:
    """Run boundaries per column and per lane: scratch between the two passes over images and masks."""

    column_count: wp.array = device_array("view", "column", dtype=wp.int32)
    """Run boundaries of each column of the ids."""
    lane_count: wp.array = device_array("view", "instance", "lane", dtype=wp.int32)
    """Run boundaries of each lane of a mask."""


def boundary_sizes(view_sizes: dict[str, int]) -> dict[str, int]:
    """Extents of the dimensions of `BoundaryBuffers` and `BoundaryScratch`, from those of `ViewBuffers`."""
    sizes = {name: view_sizes[name] for name in ("view", "column", "instance")} | {"field": FIELDS, "lane": RUN_LANES}
    columns, instances = view_sizes["column"], view_sizes["instance"]
    seen = min(instances // 2, view_sizes["row"] // (FIELDS * WORD_BYTES))
    ids, masks = (columns * max(BOUNDARIES_PER_COLUMN, most) for most in (seen, instances))
    return sizes | {"boundary": ids, "run": masks}


def list_boundaries(scratch: BoundaryScratch, count: int, images: ViewBuffers, out: BoundaryBuffers) -> None:
    """List the run boundaries of the first `count` views' segmentation ids and amodal masks.

    Args:
        scratch: Overwritten.
        count: Views in use.
        images: Its ids and masks are read.
        out: Written.
    """
    instance, masks, device = images.instance, masks_of(images), scratch.column_count.device
    dim = (count, scratch.column_count.shape[1])
    wp.launch(count_boundaries_kernel, dim=dim, inputs=[instance], outputs=[scratch.column_count], device=device)
    outputs = [out.boundary_count, out.boundaries]
    wp.launch(list_boundaries_kernel, dim=dim, inputs=[instance, scratch.column_count], outputs=outputs, device=device)
    out.run_count.zero_()
    dim = (count, *scratch.lane_count.shape[1:])
    wp.launch(count_runs_kernel, dim=dim, inputs=[masks], outputs=[scratch.lane_count, out.run_count], device=device)
    inputs = [masks, instance.shape[1], scratch.lane_count, out.run_count]
    wp.launch(list_runs_kernel, dim=dim, inputs=inputs, outputs=[out.runs], device=device)
