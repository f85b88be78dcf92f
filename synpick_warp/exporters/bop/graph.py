"""Scene graph of a frame: support edges from contact forces, occlusion edges from masks, and an unstacking order.

Nodes are ground-truth indices: positions in a frame's list of scene_gt.json. Runs in writer processes, so it imports neither Warp nor
Newton.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from synpick_warp.exporters.writing.rle import Masks, Runs
from synpick_warp.system.linear_algebra import matmul
from synpick_warp.views.frames import TickBatch

GRAPH_FILE = "scene_graph.json"
SUPPORT_FRACTION = 0.05
"""Least upward force of a supporter, as a fraction of the supported object's weight. At rest the solver leaves 2 % of a load
unbalanced, and friction at a neighbour that an object only touches carries little more."""
WITHOUT_LABEL = -1
"""Index that stands for a supporter without node: bin, table, or an object without label."""
_DIGITS = 4
"""Decimal places of forces [N]."""
_BOUNDS = ("column", "first", "past")
"""Fields of `Runs` that are arrays."""


@dataclass(frozen=True, eq=False)
class FrameSupport:
    """Edge list of a frame's support graph: rows of object, supporter (or WITHOUT_LABEL) and upward force [N]; `nodes` instances."""

    nodes: int
    edges: np.ndarray
    """(edge, 3) float32."""


def find_supports(batch: TickBatch, weights: Mapping[int, float]) -> list[FrameSupport]:
    """Find the support edges of each frame of a batch, which has support forces: contact forces of at least SUPPORT_FRACTION of the
    object's weight, in `weights` [N] by obj_id."""
    frames = zip(batch.object_id, batch.tick["support"], batch.tick["static_support"], strict=True)
    return [_find_edges(*frame, weights) for frame in frames]


def _find_edges(object_id: np.ndarray, support: np.ndarray, static: np.ndarray, weights: Mapping[int, float]) -> FrameSupport:
    """Support edges of a frame: obj_id of instances (I), upward forces between them (I, I) and of static bodies on them (I) [N]."""
    labelled, others = np.flatnonzero(object_id >= 0), np.flatnonzero(object_id < WITHOUT_LABEL)
    # The last column has index -1: WITHOUT_LABEL.
    force = np.column_stack((support[np.ix_(labelled, labelled)], static[labelled] + support[np.ix_(labelled, others)].sum(axis=1)))
    least = SUPPORT_FRACTION * np.array([weights[obj_id] for obj_id in object_id[labelled].tolist()])
    objects, supporters = np.nonzero(force > least[:, None])
    ends = np.where(supporters < len(labelled), supporters, WITHOUT_LABEL)
    return FrameSupport(len(labelled), np.column_stack((objects, ends, force[objects, supporters])).astype(np.float32))


def find_occlusions(masks: Sequence[Masks]) -> list[tuple[int, int, int]]:
    """Occlusion edges of a view, (a, b, pixels): number of pixels common to a's visible mask and b's amodal mask.

    Interval join: visible masks are disjoint, so the visible runs that overlap an amodal run are consecutive in column-major order.
    """
    shown, begin, end = _list_runs([mask.visible for mask in masks], masks)
    hidden, start, past = _list_runs([mask.amodal for mask in masks], masks)
    order = np.argsort(begin, kind="stable")
    shown, begin, end = shown[order], begin[order], end[order]
    first, last = np.searchsorted(end, start, "right"), np.searchsorted(begin, past, "left")
    counts = last - first
    run = np.repeat(np.arange(len(start)), counts)
    other = np.arange(len(run)) - np.repeat(np.cumsum(counts) - counts - first, counts)
    pixels = np.minimum(end[other], past[run]) - np.maximum(begin[other], start[run])
    common = np.zeros((len(masks), len(masks)), np.int64)
    np.add.at(common, (shown[other], hidden[run]), pixels)
    np.fill_diagonal(common, 0)
    return [(a, b, int(common[a, b])) for a, b in np.argwhere(common).tolist()]


def _list_runs(parts: Sequence[Runs], masks: Sequence[Masks]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Runs of a mask of each instance: instance, and column-major positions of the first pixel and after the last (N)."""
    span = max((max(mask.amodal.bottom, mask.visible.bottom) for mask in masks), default=0) + 1
    column, first, past = (np.concatenate([np.zeros(0, np.int64), *(getattr(one, name) for one in parts)]) for name in _BOUNDS)
    instance = np.repeat(np.arange(len(parts)), [len(one.column) for one in parts])
    return instance, column * span + first, column * span + past


def find_unstacking_order(nodes: int, supports: Iterable[tuple[int, int]]) -> list[list[int]]:
    """Unstacking order: a topological order of the support graph's condensation, the least index first wherever several may follow.

    From the transitive closure, by repeated squaring of the adjacency matrix: bins have few enough objects. Edges are (object, supporter);
    those to WITHOUT_LABEL are left out. Returns strongly connected components, none of which carries a later one; one of several objects
    is a cycle: they carry each other.
    """
    reach = np.eye(nodes, dtype=np.float32)
    for one, other in supports:
        if other != WITHOUT_LABEL:
            reach[one, other] = 1.0
    for _ in range(nodes.bit_length()):
        reach = np.minimum(matmul(reach, reach), 1.0)
    mutual = (reach * reach.T).astype(bool)
    heads = np.unique(mutual.argmax(axis=1)) if nodes else np.zeros(0, np.int64)
    # Number of components that have to be taken before each, itself included; 0: it is taken.
    above = reach[np.ix_(heads, heads)].astype(np.int64)
    waiting, order = above.sum(axis=0), []
    for _ in heads:
        following = int((waiting == 1).argmax())
        order.append(np.flatnonzero(mutual[heads[following]]).tolist())
        waiting -= above[following]
    return order


def graph_entry(entry: Mapping[str, Any], support: FrameSupport | None) -> dict[str, Any]:
    """A frame's entry in scene_graph.json: the view's `entry`, with support edges and unstacking order (`support` None: without)."""
    if support is None:
        return dict(entry)
    edges = [(int(one), int(other), round(force, _DIGITS)) for one, other, force in support.edges.tolist()]
    return {**entry, "support": edges, "order": find_unstacking_order(support.nodes, ((one, other) for one, other, _ in edges))}
