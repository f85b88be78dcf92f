"""Layered graph drawing (Sugiyama et al., 1981) of the clutter graph: arrows run downward, from the object on top to the one below.

Layers by longest path, order and columns by barycentres under the nodes' widths, long edges as splines. networkx' `multipartite_layout` is
not used: it keeps the order of its input and spaces all layers evenly, so edges cross, and the nodes of wide layers overlap.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import networkx as nx
import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import isotonic_regression

from synpick_warp.apps.viz.drawing import FONT, INK, WHITE, Image, instance_color, put_text, readable_on
from synpick_warp.apps.viz.explain_record import Attempt, labels
from synpick_warp.dataset.records import InstanceObservation
from synpick_warp.errors import DatasetError

RADIUS = 20
"""Radius of a node [px]."""
_MIN_GAP = 13
"""Minimum gap between nodes of a layer [px]."""
_MAX_STRETCH = 1.7
"""Maximum factor by which a narrow graph is widened."""
_ROUTE = 9
"""Half the width reserved for an edge that passes a layer [px]."""
_MAX_LAYER_GAP = 150
"""Maximum distance of two layers [px]."""
_MARGIN = 38
"""Distance from the border to the outermost nodes' centres [px]."""
_SWEEPS = 8
"""Number of downward and of upward barycentre sweeps; graphs of this size converge within them."""
_MAX_PIECES = 1000
"""Maximum number of edges between neighbouring layers; those of 100 objects are some 200."""
_BEND = 0.32
"""Offset of the control point of a removed edge's curve, as a fraction of its length; the curve deviates by half of it."""
_SAMPLES = 12
"""Number of points of a curve between two layers."""
_SHIFT = 4
"""Fractional bits of OpenCV's fixed-point coordinates."""
GREY = (150, 150, 150)
RED = (60, 60, 200)
KEPT, OUTVOTED, CYCLIC = "kept", "outvoted by the opposite", "dropped to break a cycle"

Key = int | tuple[int, int, int]
"""A node: an instance id, or the dummy node of edge (upper, lower) in layer n."""


@dataclass(frozen=True)
class Edge:
    """Edge of the clutter graph, from the upper to the lower instance: its votes (of a kept edge minus those for the opposite one), and
    whether it was kept or why it was removed.
    """

    upper: int
    lower: int
    weight: float
    """Votes minus those for the opposite edge; of a removed edge, its own votes."""
    state: str


@dataclass(frozen=True)
class Layout:
    """Layout of the graph in the image [px]: position of each node, and polyline of each kept edge (upper, lower)."""

    nodes: dict[int, tuple[float, float]]
    routes: dict[tuple[int, int], np.ndarray]
    """(upper, lower) of a kept edge -> polyline from node to node (N, 2)."""


def clutter_edges(attempt: Attempt, min_votes: float) -> list[Edge]:
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


def lay_out(attempt: Attempt, edges: Sequence[Edge], size: tuple[int, int]) -> Layout:
    """Place nodes in layers such that every kept edge runs downward, with few crossings.

    Args:
        attempt: Its suction points give the initial order from left to right.
        edges: Edges of the attempt.
        size: Width and height of the image [px].

    Raises:
        DatasetError: The kept edges have a cycle, or are far more than those of any pile.
    """
    width, height = size
    kept = [(edge.upper, edge.lower) for edge in edges if edge.state == KEPT]
    place: dict[Key, float] = {one.instance: one.grasp_pixel[0] / attempt.observation.resolution[0] for one in attempt.seen}
    depth = _assign_layers(attempt, kept, place, max(1, int((width - 2 * _MARGIN) // (2 * RADIUS + _MIN_GAP)) + 1))
    if sum(depth[lower] - depth[upper] for upper, lower in kept) > _MAX_PIECES:
        raise DatasetError(f"the clutter graph of attempt {attempt.attempt} of episode {attempt.episode} has too many edges to be drawn")
    graph = nx.Graph()
    graph.add_nodes_from(depth)
    layers: dict[Key, int] = {**depth}
    chains: dict[tuple[int, int], list[Key]] = {}
    for upper, lower in kept:
        chain: list[Key] = [upper, *((upper, lower, layer) for layer in range(depth[upper] + 1, depth[lower])), lower]
        for step, key in enumerate(chain[1:-1], start=1):
            layers[key] = depth[upper] + step
            place[key] = place[upper] + (place[lower] - place[upper]) * step / (len(chain) - 1)
        nx.add_path(graph, chain)
        chains[upper, lower] = chain
    column = _widen(_place_columns(graph, layers, {key: _MARGIN + x * (width - 2 * _MARGIN) for key, x in place.items()}, width), width)
    gap = min(_MAX_LAYER_GAP, (height - 2 * _MARGIN) / max([1, *depth.values()]))
    point = {key: (column[key], _MARGIN + gap * layer) for key, layer in layers.items()}
    routes = {edge: _curve(np.array([point[key] for key in chain])) for edge, chain in chains.items()}
    return Layout({instance: point[instance] for instance in depth}, routes)


def _assign_layers(attempt: Attempt, kept: list[tuple[int, int]], place: Mapping[Key, float], capacity: int) -> dict[int, int]:
    """Assign each instance to a layer by its longest path from a source; layers with more than `capacity` nodes are split."""
    graph = nx.DiGraph(kept)
    graph.add_nodes_from(one.instance for one in attempt.seen)
    try:
        generations = [
            sorted(layer, key=lambda instance: (graph.degree(instance) > 0, place[instance])) for layer in nx.topological_generations(graph)
        ]
    except nx.NetworkXUnfeasible as error:
        raise DatasetError(f"the clutter graph of attempt {attempt.attempt} of episode {attempt.episode} has a cycle") from error
    rows = [layer[start : start + capacity] for layer in generations for start in range(0, len(layer), capacity)]
    return {instance: number for number, row in enumerate(rows) for instance in row}


def _place_columns(graph: nx.Graph, layers: Mapping[Key, int], place: Mapping[Key, float], width: int) -> dict[Key, float]:
    """x of each node [px], by barycentre sweeps from the first x in `place`: each layer is ordered by the mean x of its nodes' neighbours,
    and moved as near to these means (least squares, isotonic regression) as the widths of its nodes allow.

    The first sweeps use the layer before, downward and upward in turn, which finds the order; the others use both sides.
    """
    rows: list[list[Key]] = [[] for _ in range(1 + max(layers.values(), default=-1))]
    for key, layer in layers.items():
        rows[layer].append(key)
    x = dict(place)
    for sweep in range(4 * _SWEEPS):
        step = 1 if sweep % 2 == 0 else -1
        for row in rows[::step]:
            seen = {key: [x[other] for other in graph[key] if sweep >= 2 * _SWEEPS or layers[other] == layers[key] - step] for key in row}
            means = {key: float(np.mean(near or [x[key]])) for key, near in seen.items()}
            row.sort(key=means.__getitem__)
            half = np.array([RADIUS + _MIN_GAP / 2 if isinstance(key, int) else _ROUTE for key in row])
            apart = np.concatenate(([0.0], np.cumsum(half[1:] + half[:-1])))
            apart *= min(1.0, (width - 2 * _MARGIN) / max(apart[-1], 1.0))
            free = np.asarray(isotonic_regression(np.array([means[key] for key in row]) - apart).x)
            x.update(zip(row, np.clip(free, _MARGIN, width - _MARGIN - apart[-1]) + apart, strict=True))
    return x


def _widen(column: Mapping[Key, float], width: int) -> dict[Key, float]:
    """Centre the graph horizontally, and widen it where the image allows."""
    if not column:
        return {}
    low, high = min(column.values()), max(column.values())
    factor = min(_MAX_STRETCH, (width - 2 * _MARGIN) / max(high - low, 1.0))
    return {key: width / 2 + factor * (x - (low + high) / 2) for key, x in column.items()}


def _curve(points: np.ndarray) -> np.ndarray:
    """Polyline (N, 2) along a monotone cubic spline (PCHIP; Fritsch and Butland, 1984) of x and y over the index of the points: y never
    turns back. Two points give a straight line.
    """
    return PchipInterpolator(range(len(points)), points)(np.linspace(0, len(points) - 1, _SAMPLES * (len(points) - 1)))


def draw_graph(attempt: Attempt, min_votes: float, size: tuple[int, int]) -> Image:
    """Draw the clutter graph on white, without legend.

    Args:
        attempt: Attempt whose observation gave the graph.
        min_votes: Minimum votes of an edge.
        size: Width and height [px].
    """
    canvas = np.full((size[1], size[0], 3), 255, np.uint8)
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


def _draw_bent(canvas: Image, edge: Edge, layout: Layout) -> None:
    """Draw a removed edge as a dashed arc, so that it does not cover the straight line between its nodes, where the opposite
    edge may run.
    """
    start, end = (np.array(layout.nodes[node]) for node in (edge.upper, edge.lower))
    bend = (start + end) / 2 + _BEND * np.array([end[1] - start[1], start[0] - end[0]])
    t = np.linspace(0.0, 1.0, 3 * _SAMPLES)[:, None]
    _draw_arrow(canvas, (1 - t) ** 2 * start + 2 * t * (1 - t) * bend + t**2 * end, GREY if edge.state == OUTVOTED else RED, 1, dashed=True)


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
