"""Lists of the edges in a batch's instance and amodal images, from which writers make masks without the images."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from synpick_warp.arrays import device_array
from synpick_warp.kernels.render.images.mask_runs import count_edges_kernel, list_edges_kernel
from synpick_warp.stages.buffers import ViewBuffers

EDGES_PER_COLUMN = 24
"""Room for edges, as a mean over the columns of an image: three times what a tote of 14 objects has."""
KINDS, PARTS = 2, 3
"""Images; numbers of an edge."""


@dataclass(frozen=True, eq=False)
class EdgeBuffers:
    """The edges of one batch of views; see `FrameBatch`."""

    edge_count: wp.array = device_array("view", "kind", dtype=wp.int32)
    """How many edges the instance and the amodal image have."""
    edges: wp.array = device_array("view", "kind", "part", "edge", dtype=wp.uint32)
    """Place, value above, value below of each."""


@dataclass(frozen=True, eq=False)
class EdgeScratch:
    """What finding edges needs meanwhile."""

    column_count: wp.array = device_array("view", "kind", "column", dtype=wp.int32)
    """Edges of each column."""


def edge_sizes(view_sizes: dict[str, int]) -> dict[str, int]:
    """Extents of the dimensions that `EdgeBuffers` and `EdgeScratch` name, from those that `ViewBuffers` names."""
    columns = view_sizes["column"]
    return {"view": view_sizes["view"], "kind": KINDS, "part": PARTS, "column": columns, "edge": EDGES_PER_COLUMN * columns}


def list_edges(scratch: EdgeScratch, count: int, images: ViewBuffers, out: EdgeBuffers) -> None:
    """List the edges of the first `count` views' images.

    Args:
        scratch: Overwritten.
        count: Views in use.
        images: Its instance and amodal images are read.
        out: Written.
    """
    dim = (count, *scratch.column_count.shape[1:])
    device = scratch.column_count.device
    wp.launch(count_edges_kernel, dim=dim, inputs=[images.instance, images.amodal], outputs=[scratch.column_count], device=device)
    wp.launch(
        list_edges_kernel,
        dim=dim,
        inputs=[images.instance, images.amodal, scratch.column_count],
        outputs=[out.edge_count, out.edges],
        device=device,
    )
