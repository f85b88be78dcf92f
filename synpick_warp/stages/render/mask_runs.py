"""Run boundaries of a batch's instance and amodal images, from which writers build RLE and PNG masks without the images."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from synpick_warp.kernels.render.images.mask_runs import count_boundaries_kernel, list_boundaries_kernel
from synpick_warp.stages.arrays import device_array
from synpick_warp.stages.buffers import ViewBuffers

BOUNDARIES_PER_COLUMN = 24
"""Capacity of a list, as a mean over the columns of an image: three times the run boundaries of a tote with 14 objects."""
IMAGES, FIELDS = 2, 3
"""Extents: the instance and the amodal image; position, value above and value below of a boundary."""


@dataclass(frozen=True, eq=False)
class BoundaryBuffers:
    """Run boundaries of the instance and amodal images of one batch of views (position, value above, value below), and their numbers, which
    may exceed the capacity; see `FrameBatch`.
    """

    boundary_count: wp.array = device_array("view", "image", dtype=wp.int32)
    """Run boundaries of the instance and the amodal image, including those beyond the capacity of `boundaries`."""
    boundaries: wp.array = device_array("view", "image", "field", "boundary", dtype=wp.uint32)
    """Position, value above, value below of each run boundary."""


@dataclass(frozen=True, eq=False)
class BoundaryScratch:
    """Run boundaries per column: scratch between the two passes over the images."""

    column_count: wp.array = device_array("view", "image", "column", dtype=wp.int32)
    """Run boundaries of each column."""


def boundary_sizes(view_sizes: dict[str, int]) -> dict[str, int]:
    """Extents of the dimensions of `BoundaryBuffers` and `BoundaryScratch`, from those of `ViewBuffers`."""
    columns = view_sizes["column"]
    sizes = {"view": view_sizes["view"], "image": IMAGES, "field": FIELDS, "column": columns}
    return sizes | {"boundary": BOUNDARIES_PER_COLUMN * columns}


def list_boundaries(scratch: BoundaryScratch, count: int, images: ViewBuffers, out: BoundaryBuffers) -> None:
    """List the run boundaries of the first `count` views' images.

    Args:
        scratch: Overwritten.
        count: Views in use.
        images: Its instance and amodal images are read.
        out: Written.
    """
    dim = (count, *scratch.column_count.shape[1:])
    device = scratch.column_count.device
    wp.launch(count_boundaries_kernel, dim=dim, inputs=[images.instance, images.amodal], outputs=[scratch.column_count], device=device)
    wp.launch(
        list_boundaries_kernel,
        dim=dim,
        inputs=[images.instance, images.amodal, scratch.column_count],
        outputs=[out.boundary_count, out.boundaries],
        device=device,
    )
