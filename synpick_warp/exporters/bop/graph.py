"""Scene graph of a frame: support edges from contact forces, occlusion edges from masks, and an unstacking order.

Nodes are ground-truth indices: positions in a frame's list of scene_gt.json. Runs in writer processes, so it imports neither Warp nor
Newton.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from synpick_warp.exporters.writing.rle import Masks, Runs
from synpick_warp.views.frames import TickBatch

GRAPH_FILE = "scene_graph.json"
SUPPORT_FRACTION = 0.05
"""Least upward force of a supporter, as a fraction of the supported object's weight. At rest the solver leaves 2 % of a load
unbalanced, and friction at a neighbour that an object only touches carries little more."""
WITHOUT_LABEL = -1
"""Index that stands for a supporter without node: bin, table, or an object without label."""
_DIGITS = 4
"""Decimal places of forces [N]."""


@dataclass(frozen=True, eq=False)
class FrameSupport:
    """Edge list of a frame's support graph: rows of object, supporter (or WITHOUT_LABEL) and upward force [N]; `nodes` instances."""

    nodes: int
    edges: np.ndarray
    """(edge, 3) float32."""


def find_supports(batch: TickBatch, weights: Mapping[int, float]) -> list[FrameSupport]:
    """Find the support edges of each frame of a batch: contact forces of at least SUPPORT_FRACTION of the object's weight.

    Args:
        batch: The frames, with support forces in their ticks.
        weights: Weight of an object [N] by obj_id.
    """
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
    """Occlusion edges of a view, (a, b, pixels): number of pixels common to a's visible mask and b's amodal mask."""
    return [
        (a, b, pixels)
        for a, one in enumerate(masks)
        for b, other in enumerate(masks)
        if a != b and (pixels := count_common(one.visible, other.amodal))
    ]


def count_common(one: Runs, other: Runs) -> int:
    """Intersection area [px] of two run-length encoded masks."""
    box, own = one.box(), other.box()
    if box is None or own is None or any(box[side] > own[side + 2] or own[side] > box[side + 2] for side in (0, 1)):
        return 0
    span = max(one.bottom, other.bottom)
    (start, end), (first, past) = ((span * runs.column + runs.first, span * runs.column + runs.past) for runs in (one, other))
    # Pixels of `one` before a position, a function of positions that is linear between the ends of its runs.
    places, before = np.stack((start, end), axis=1).ravel(), np.cumsum(np.stack((0 * start, end - start), axis=1))
    return round(float((np.interp(past, places, before) - np.interp(first, places, before)).sum()))


def find_unstacking_order(nodes: int, supports: Iterable[tuple[int, int]]) -> list[list[int]]:
    """Unstacking order: a topological order of the support graph's condensation, the least index first wherever several may follow.

    Args:
        nodes: Number of nodes.
        supports: Edges (object, supporter); those to WITHOUT_LABEL are left out.

    Returns:
        Strongly connected components, none of which carries a later one. One of several objects is a cycle: they carry each other.
    """
    import networkx

    graph = networkx.DiGraph()
    graph.add_nodes_from(range(nodes))
    graph.add_edges_from((one, other) for one, other in supports if other != WITHOUT_LABEL)
    components = networkx.condensation(graph)
    members = {node: sorted(components.nodes[node]["members"]) for node in components}
    return [members[node] for node in networkx.lexicographical_topological_sort(components, key=lambda node: members[node][0])]


def graph_entry(entry: Mapping[str, Any], support: FrameSupport | None) -> dict[str, Any]:
    """A frame's entry in scene_graph.json: the view's `entry`, with support edges and unstacking order (`support` None: without)."""
    if support is None:
        return dict(entry)
    edges = [(int(one), int(other), round(force, _DIGITS)) for one, other, force in support.edges.tolist()]
    return {**entry, "support": edges, "order": find_unstacking_order(support.nodes, ((one, other) for one, other, _ in edges))}
