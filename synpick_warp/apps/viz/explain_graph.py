"""Layered drawing of the clutter graph: arrows run downward, from the object on top to the one below.

Layers by longest path (networkx), each ordered by the mean place of what lies on its nodes, and spread evenly about the middle; an arrow
that would run over another node is bent aside.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import networkx as nx
import numpy as np

from synpick_warp.apps.viz.drawing import FONT, INK, WHITE, Image, blank, instance_color, put_text, readable_on
from synpick_warp.apps.viz.explain_record import SeenAttempt, labels
from synpick_warp.dataset.records import InstanceObservation
from synpick_warp.errors import DatasetError

RADIUS = 20
"""Radius of a node [px]."""
_MIN_STEP, _MAX_STEP = 53, 110
"""Minimum and maximum distance of neighbours in a layer [px]."""
_MAX_LAYER_GAP = 150
"""Maximum distance of two layers [px]."""
_MARGIN = 38
"""Distance from the border to the outermost nodes' centres [px]."""
_MAX_EDGES = 1000
"""Maximum number of kept edges; those of 100 objects are some 200."""
_BEND = 0.32
"""Offset of the control point of a removed edge's curve, as a fraction of its length; the curve deviates by half of it."""
_OFFSETS = (0, 60, -60, 100, -100, 160, -160, 240, -240)
"""Offsets [px] to the side that are tried for the control point of a kept edge's curve, until it passes beside all nodes."""
_CLEARANCE = RADIUS + 6
"""Distance [px] at which a curve passes beside a node."""
_SAMPLES = 36
"""Number of points of a curve."""
_SHIFT = 4
"""Fractional bits of OpenCV's fixed-point coordinates."""
GREY = (150, 150, 150)
RED = (60, 60, 200)
KEPT, OUTVOTED, CYCLIC = "kept", "outvoted by the opposite", "dropped to break a cycle"


@dataclass(frozen=True)
class Edge:
    """Edge of the clutter graph, from the upper to the lower instance."""

    upper: int
    lower: int
    weight: float
    """Votes minus those for the opposite edge; of a removed edge, its own votes."""
    state: str
    """KEPT, or why it was removed."""


@dataclass(frozen=True)
class GraphLayout:
    """Layout of the graph in the image [px]."""

    nodes: dict[int, tuple[float, float]]
    """Position of each node."""
    routes: dict[tuple[int, int], np.ndarray]
    """(upper, lower) of a kept edge -> polyline from node to node (N, 2)."""


def clutter_edges(attempt: SeenAttempt, min_votes: float) -> list[Edge]:
    """Edges of the clutter graph, sorted by lower, then upper instance: all that are kept in the acyclic graph, and of at least `min_votes`
    those removed, since the opposite has as many votes or to break a cycle.
    """
    edges = []
    for lower, one in sorted(attempt.objects.items()):
        voted = {upper for (at, upper), votes in attempt.votes.items() if at == lower and votes >= min_votes}
        for upper in sorted(voted.union(one.above) & attempt.objects.keys()):
            votes, opposite = attempt.votes.get((lower, upper), 0.0), attempt.votes.get((upper, lower), 0.0)
            opposite = opposite if opposite >= min_votes else 0.0
            if upper in one.above:
                edges.append(Edge(upper, lower, votes - opposite, KEPT))
            else:
                edges.append(Edge(upper, lower, votes, OUTVOTED if opposite >= votes else CYCLIC))
    return edges


def lay_out(attempt: SeenAttempt, edges: Sequence[Edge], size: tuple[int, int]) -> GraphLayout:
    """Place nodes in layers such that every kept edge runs downward.

    Args:
        attempt: Its suction points give the order of the uppermost objects from left to right.
        edges: Edges of the attempt.
        size: Width and height of the image [px].

    Raises:
        DatasetError: The kept edges have a cycle, or are far more than those of any pile.
    """
    width, height = size
    graph = nx.DiGraph([(edge.upper, edge.lower) for edge in edges if edge.state == KEPT])
    graph.add_nodes_from(one.instance for one in attempt.seen)
    if graph.number_of_edges() > _MAX_EDGES:
        raise DatasetError(f"the clutter graph of attempt {attempt.attempt} of episode {attempt.episode} has too many edges to be drawn")
    rows = _rows(attempt, graph, int((width - 2 * _MARGIN) // _MIN_STEP) + 1)
    longest = max((len(row) for row in rows), default=1)
    step = min(_MAX_STEP, (width - 2 * _MARGIN) / max(1, longest - 1))
    gap = min(_MAX_LAYER_GAP, (height - 2 * _MARGIN) / max(1, len(rows) - 1))
    nodes = {
        instance: (width / 2 + step * (place - (len(row) - 1) / 2), _MARGIN + gap * layer)
        for layer, row in enumerate(rows)
        for place, instance in enumerate(row)
    }
    return GraphLayout(nodes, {(upper, lower): _route(nodes, upper, lower, width) for upper, lower in graph.edges})


def _rows(attempt: SeenAttempt, graph: nx.DiGraph, capacity: int) -> list[list[int]]:
    """Instances of each layer from left to right: layers by longest path from above, in rows of at most `capacity`, ordered by the mean
    place of its nodes' predecessors, or of those without any by their suction points."""
    try:
        generations = list(nx.topological_generations(graph))
    except nx.NetworkXUnfeasible as error:
        raise DatasetError(f"the clutter graph of attempt {attempt.attempt} of episode {attempt.episode} has a cycle") from error
    place = {one.instance: one.grasp_pixel[0] / attempt.observation.resolution[0] for one in attempt.seen}
    rows = []
    for layer in generations:
        ordered = sorted(layer, key=lambda instance: (graph.degree(instance) > 0, place[instance]))
        for start in range(0, len(ordered), capacity):
            row = ordered[start : start + capacity]
            means = {key: float(np.mean([place[upper] for upper in graph.predecessors(key)] or [place[key]])) for key in row}
            rows.append(sorted(row, key=means.__getitem__))
            place.update({instance: (number + 0.5) / len(row) for number, instance in enumerate(rows[-1])})
    return rows


def _route(nodes: Mapping[int, tuple[float, float]], upper: int, lower: int, width: int) -> np.ndarray:
    """Curve (N, 2) from node to node that passes beside all others: straight if possible, else bent to the side, y never turning back."""
    others = np.array([place for instance, place in nodes.items() if instance not in (upper, lower)])
    start, end = np.array(nodes[upper]), np.array(nodes[lower])
    curves = [_arc(start, end, np.array((offset, 0.0))) for offset in _OFFSETS]
    inside = [curve for curve in curves if curve[:, 0].min() >= 0 and curve[:, 0].max() <= width]
    if not len(others):
        return inside[0]
    free = [min(_CLEARANCE, float(np.linalg.norm(curve[:, None] - others, axis=2).min())) for curve in inside]
    return inside[int(np.argmax(free))]


def _arc(start: np.ndarray, end: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Quadratic Bézier curve (N, 2), whose control point is the middle of both ends, moved by `offset` [px]."""
    t = np.linspace(0.0, 1.0, _SAMPLES)[:, None]
    return (1 - t) ** 2 * start + 2 * t * (1 - t) * ((start + end) / 2 + offset) + t**2 * end


def draw_graph(attempt: SeenAttempt, min_votes: float, size: tuple[int, int]) -> Image:
    """Draw the clutter graph on white, without legend.

    Args:
        attempt: Attempt whose observation gave the graph.
        min_votes: Minimum votes of an edge.
        size: Width and height [px].
    """
    canvas = blank(*size)
    edges = clutter_edges(attempt, min_votes)
    layout = lay_out(attempt, edges, size)
    for edge in edges:
        if edge.state != KEPT:
            _draw_bent(canvas, edge, layout)
    for edge in edges:
        if edge.state == KEPT:
            thickness = 1 if edge.weight < 4 * min_votes else 2
            _draw_arrow(canvas, layout.routes[edge.upper, edge.lower], INK, thickness)
    for edge in edges:
        if edge.state == KEPT:
            _draw_weight(canvas, edge, layout.routes[edge.upper, edge.lower])
    short = labels(attempt)
    for one in attempt.seen:
        _draw_node(canvas, layout.nodes[one.instance], short[one.instance], one, one.instance == attempt.target)
    return canvas


def _draw_node(canvas: Image, place: tuple[float, float], label: str, one: InstanceObservation, target: bool) -> None:
    """Draw a node with its label, and a badge with the number of its ancestors."""
    x, y = place
    color = instance_color(one.instance)
    if target:
        disc(canvas, place, RADIUS + 6, INK)
        disc(canvas, place, RADIUS + 3, WHITE)
    disc(canvas, place, RADIUS, INK)
    disc(canvas, place, RADIUS - 1.2, color)
    put_centered(canvas, label, place, 0.52, readable_on(color), 2)
    badge = x + 0.8 * RADIUS, y - 0.8 * RADIUS
    disc(canvas, badge, 8.5, INK)
    disc(canvas, badge, 7.5, WHITE)
    put_centered(canvas, str(len(one.ancestors)), badge, 0.36, INK, 1)


def _draw_arrow(canvas: Image, route: np.ndarray, color: tuple[int, int, int], thickness: int, dashed: bool = False) -> None:
    """Draw a curve clipped at both nodes' borders, with an arrow head."""
    dense = _resample(route)
    free = (np.hypot(*(dense - dense[0]).T) > RADIUS + 1) & (np.hypot(*(dense - dense[-1]).T) > RADIUS + 3)
    line = dense[free]
    if len(line) < 2:
        return
    tip, back = line[-1], line[max(0, len(line) - 10)]
    along = (tip - back) / max(float(np.hypot(*(tip - back))), 1e-9)
    across = np.array([-along[1], along[0]])
    base = tip - (8 + thickness) * along
    shaft = line[np.hypot(*(line - tip).T) > 6]
    for piece in (shaft[start : start + 6] for start in range(0, len(shaft), 10)) if dashed else (shaft,):
        cv2.polylines(canvas, [fixed(piece)], False, color, thickness, cv2.LINE_AA, _SHIFT)
    cv2.fillPoly(canvas, [fixed(np.stack((tip, base + 4.5 * across, base - 4.5 * across)))], color, cv2.LINE_AA, _SHIFT)


def _draw_bent(canvas: Image, edge: Edge, layout: GraphLayout) -> None:
    """Draw a removed edge as a dashed arc, so that it does not cover the straight line between its nodes, where the opposite
    edge may run.
    """
    start, end = (np.array(layout.nodes[node]) for node in (edge.upper, edge.lower))
    route = _arc(start, end, _BEND * np.array([end[1] - start[1], start[0] - end[0]]))
    _draw_arrow(canvas, route, GREY if edge.state == OUTVOTED else RED, 1, dashed=True)


def _draw_weight(canvas: Image, edge: Edge, route: np.ndarray) -> None:
    """Draw the votes of an edge on its curve."""
    dense = _resample(route)
    place = dense[int(0.42 * len(dense))]
    put_boxed(canvas, f"{edge.weight:.0f}", (float(place[0]), float(place[1])), 0.38, (90, 90, 90), WHITE)


def _resample(route: np.ndarray) -> np.ndarray:
    """Resample a polyline in steps of one pixel."""
    length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))))
    steps = np.linspace(0.0, length[-1], max(2, math.ceil(length[-1])))
    return np.stack([np.interp(steps, length, route[:, axis]) for axis in range(2)], axis=1)


def fixed(points: np.ndarray) -> np.ndarray:
    """Convert points (N, 2) to OpenCV's fixed-point coordinates with `shift` 4."""
    return np.rint(np.asarray(points) * (1 << _SHIFT)).astype(np.int32)


def disc(canvas: Image, place: Sequence[float], radius: float, color: tuple[int, int, int], thickness: int = -1) -> None:
    """Draw a circle at subpixel position; thickness -1: filled."""
    x, y = (round(value * (1 << _SHIFT)) for value in place)
    cv2.circle(canvas, (x, y), round(radius * (1 << _SHIFT)), color, thickness, cv2.LINE_AA, _SHIFT)


def put_centered(canvas: Image, text: str, place: Sequence[float], size: float, color: tuple[int, int, int], thickness: int) -> None:
    """Draw text centred at a position."""
    (width, height), _ = cv2.getTextSize(text, FONT, size, thickness)
    put_text(canvas, text, (round(place[0] - width / 2), round(place[1] + height / 2)), size, color, thickness)


def put_boxed(
    canvas: Image, text: str, place: Sequence[float], size: float, color: tuple[int, int, int], ground: tuple[int, int, int]
) -> None:
    """Draw centred text on a filled box of colour `ground`."""
    (width, height), _ = cv2.getTextSize(text, FONT, size, 1)
    half = np.array([width / 2 + 2, height / 2 + 2])
    low, high = np.rint(np.array(place) - half).astype(int), np.rint(np.array(place) + half).astype(int)
    cv2.rectangle(canvas, low.tolist(), high.tolist(), ground, -1)
    put_centered(canvas, text, place, size, color, 1)
