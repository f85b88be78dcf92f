"""The clutter graph as a picture: layers from the top of the pile downward, each arrow from the object on top to the object below."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import networkx as nx
import numpy as np
from scipy.optimize import isotonic_regression

from synpick_warp.errors import DatasetError
from synpick_warp.viz.explain_record import Attempt, SeenObject, labels
from synpick_warp.viz.preview import FONT, Image, instance_color, put_text

RADIUS = 20
"""Of a node [px]."""
_APART = 13
"""Least gap between nodes of a layer [px]."""
_STRETCH = 1.7
"""A narrow graph is widened by at most so much."""
_ROUTE = 9
"""Half the room that a passing arrow gets in a layer [px]."""
_LAYER = 150
"""Largest distance of two layers [px]."""
_MARGIN = 38
"""From the picture's border to the outermost nodes' centres [px]."""
_SWEEPS = 8
"""Down and up again, each: more change nothing in graphs of this size."""
_BEND = 0.32
"""How far an edge that is not in the graph is bent aside, as a share of its length; the curve goes half as far."""
_SAMPLES = 12
"""Points of a curve between two layers."""
_SHIFT = 4
"""Fractional bits of coordinates that OpenCV gets."""
INK = (40, 40, 40)
GREY = (150, 150, 150)
RED = (60, 60, 200)
WHITE = (255, 255, 255)
KEPT, OUTVOTED, CYCLIC = "kept", "outvoted by the opposite", "dropped to break a cycle"

Key = int | tuple[int, int, int]
"""An instance; or a place where the arrow (upper, lower) passes layer n."""


@dataclass(frozen=True)
class Edge:
    """An arrow."""

    upper: int
    lower: int
    weight: float
    """Votes, less those for the opposite; where it is not kept, its own votes."""
    state: str


@dataclass(frozen=True)
class Layout:
    """Where everything stands in the picture [px]."""

    nodes: dict[int, tuple[float, float]]
    routes: dict[tuple[int, int], np.ndarray]
    """(upper, lower) of kept edges -> (N, 2) points from node to node."""


def clutter_edges(attempt: Attempt, min_votes: float) -> list[Edge]:
    """All edges for which there are votes enough, in order of instance: those of the graph, and those that were taken out of it."""
    edges = []
    for lower, one in sorted(attempt.objects.items()):
        voted = {upper for (at, upper), votes in attempt.votes.items() if at == lower and votes >= min_votes}
        for upper in sorted((one.above | voted) & attempt.objects.keys()):
            votes, opposite = attempt.votes.get((lower, upper), 0.0), attempt.votes.get((upper, lower), 0.0)
            opposite = opposite if opposite >= min_votes else 0.0
            if upper in one.above:
                edges.append(Edge(upper, lower, votes - opposite, KEPT))
            else:
                edges.append(Edge(upper, lower, votes, OUTVOTED if opposite >= votes else CYCLIC))
    return edges


def lay_out(attempt: Attempt, edges: Sequence[Edge], size: tuple[int, int]) -> Layout:
    """Place nodes in layers, so that every kept edge runs downward, and with few crossings.

    Args:
        attempt: Its suction points give the order from left to right to begin with.
        edges: The attempt's.
        size: Width and height of the picture [px].

    Raises:
        DatasetError: Kept edges run in a circle.
    """
    width, height = size
    kept = [(edge.upper, edge.lower) for edge in edges if edge.state == KEPT]
    place: dict[Key, float] = {one.instance: one.suction[0] / attempt.resolution[0] for one in attempt.seen}
    depth = _depths(attempt, kept, place, max(1, int((width - 2 * _MARGIN) // (2 * RADIUS + _APART)) + 1))
    layers: list[list[Key]] = [[] for _ in range(1 + max(depth.values(), default=-1))]
    for instance, layer in depth.items():
        layers[layer].append(instance)
    chains: dict[tuple[int, int], list[Key]] = {}
    for upper, lower in kept:
        passed: list[Key] = [(upper, lower, layer) for layer in range(depth[upper] + 1, depth[lower])]
        for step, key in enumerate(passed, start=1):
            layers[depth[upper] + step].append(key)
            place[key] = place[upper] + (place[lower] - place[upper]) * step / (len(passed) + 1)
        chains[upper, lower] = [upper, *passed, lower]
    pairs = [pair for chain in chains.values() for pair in itertools.pairwise(chain)]
    seeds: dict[Key, float] = {key: _MARGIN + x * (width - 2 * _MARGIN) for key, x in place.items()}
    column = _widened(_columns(_ordered(layers, pairs, place), pairs, seeds, width), width)
    gap = min(_LAYER, (height - 2 * _MARGIN) / max(1, len(layers) - 1))
    point = {key: (column[key], _MARGIN + gap * layer) for layer, keys in enumerate(layers) for key in keys}
    routes = {edge: _curve(np.array([point[key] for key in chain])) for edge, chain in chains.items()}
    return Layout({instance: point[instance] for instance in depth}, routes)


def _depths(attempt: Attempt, kept: list[tuple[int, int]], place: Mapping[Key, float], room: int) -> dict[int, int]:
    """Layer of each instance: the longest path from above; layers with too many nodes become several."""
    graph = nx.DiGraph(kept)
    graph.add_nodes_from(one.instance for one in attempt.seen)
    try:
        generations = [
            sorted(layer, key=lambda instance: (graph.degree(instance) > 0, place[instance])) for layer in nx.topological_generations(graph)
        ]
    except nx.NetworkXUnfeasible as error:
        raise DatasetError(f"the clutter graph of attempt {attempt.number} of episode {attempt.episode} runs in a circle") from error
    rows = [layer[start : start + room] for layer in generations for start in range(0, len(layer), room)]
    return {instance: number for number, row in enumerate(rows) for instance in row}


def _ordered(layers: list[list[Key]], pairs: list[tuple[Key, Key]], place: Mapping[Key, float]) -> list[list[Key]]:
    """Each layer ordered by the mean position of its neighbours, downward and upward in turn; of all orders that with least crossings."""
    above: dict[Key, list[Key]] = {key: [] for layer in layers for key in layer}
    below: dict[Key, list[Key]] = {key: [] for layer in layers for key in layer}
    for upper, lower in pairs:
        above[lower].append(upper)
        below[upper].append(lower)
    best = current = [sorted(layer, key=lambda key: place[key]) for layer in layers]
    for sweep in range(2 * _SWEEPS):
        neighbours, order = (above, range(1, len(layers))) if sweep % 2 == 0 else (below, range(len(layers) - 2, -1, -1))
        current = [list(layer) for layer in current]
        for number in order:
            rank = {key: (index + 0.5) / len(layer) for layer in current for index, key in enumerate(layer)}
            means = {key: float(np.mean([rank[other] for other in neighbours[key] or [key]])) for key in current[number]}
            current[number].sort(key=means.__getitem__)
        if _crossings(current, pairs) < _crossings(best, pairs):
            best = current
    return best


def _crossings(layers: list[list[Key]], pairs: list[tuple[Key, Key]]) -> int:
    layer_of = {key: number for number, layer in enumerate(layers) for key in layer}
    rank = {key: index for layer in layers for index, key in enumerate(layer)}
    return sum(
        (rank[first[0]] - rank[second[0]]) * (rank[first[1]] - rank[second[1]]) < 0
        for first, second in itertools.combinations(pairs, 2)
        if layer_of[first[0]] == layer_of[second[0]]
    )


def _columns(layers: list[list[Key]], pairs: list[tuple[Key, Key]], place: Mapping[Key, float], width: int) -> dict[Key, float]:
    """x of each key [px]: as near as possible to the mean of its neighbours, in order and apart (least squares, by isotonic regression)."""
    near: dict[Key, list[Key]] = {key: [] for layer in layers for key in layer}
    for upper, lower in pairs:
        near[lower].append(upper)
        near[upper].append(lower)
    x = dict(place)
    for sweep in range(2 * _SWEEPS):
        for layer in layers if sweep % 2 == 0 else layers[::-1]:
            wanted = np.array([np.mean([x[other] for other in near[key] or [key]]) for key in layer])
            half = np.array([RADIUS + _APART / 2 if isinstance(key, int) else _ROUTE for key in layer])
            apart = np.concatenate(([0.0], np.cumsum(half[1:] + half[:-1])))
            apart *= min(1.0, (width - 2 * _MARGIN) / max(apart[-1], 1.0))
            free = np.asarray(isotonic_regression(wanted - apart).x)
            x.update(zip(layer, np.clip(free, _MARGIN, width - _MARGIN - apart[-1]) + apart, strict=True))
    return x


def _widened(column: Mapping[Key, float], width: int) -> dict[Key, float]:
    """The same columns in the middle of the picture, farther apart where there is room."""
    if not column:
        return {}
    low, high = min(column.values()), max(column.values())
    factor = min(_STRETCH, (width - 2 * _MARGIN) / max(high - low, 1.0))
    return {key: width / 2 + factor * (x - (low + high) / 2) for key, x in column.items()}


def _curve(points: np.ndarray) -> np.ndarray:
    """A smooth curve through points (Catmull and Rom, 1974); two points give a straight line."""
    padded = np.concatenate((2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]))
    t = np.linspace(0.0, 1.0, _SAMPLES)[:, None]
    parts = [
        (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3) / 2
        for a, b, c, d in zip(padded, padded[1:], padded[2:], padded[3:], strict=False)
    ]
    return np.concatenate(parts)


def draw_graph(attempt: Attempt, min_votes: float, size: tuple[int, int]) -> Image:
    """The graph on white, without its explanation.

    Args:
        attempt: Whose graph.
        min_votes: Votes that make an edge.
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


def _draw_node(canvas: Image, place: tuple[float, float], label: str, one: SeenObject, target: bool) -> None:
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
    put_centered(canvas, str(len(one.all_above)), badge, 0.36, INK, 1)


def _draw_arrow(canvas: Image, route: np.ndarray, color: tuple[int, int, int], thickness: int, dashed: bool = False) -> None:
    """From node to node: the curve is cut at both nodes' borders, and ends in a triangle."""
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
    """An edge that is not in the graph, beside the straight line, where its opposite runs."""
    start, end = (np.array(layout.nodes[node]) for node in (edge.upper, edge.lower))
    bend = (start + end) / 2 + _BEND * np.array([end[1] - start[1], start[0] - end[0]])
    t = np.linspace(0.0, 1.0, 3 * _SAMPLES)[:, None]
    _draw_arrow(canvas, (1 - t) ** 2 * start + 2 * t * (1 - t) * bend + t**2 * end, GREY if edge.state == OUTVOTED else RED, 1, dashed=True)


def _draw_weight(canvas: Image, edge: Edge, route: np.ndarray) -> None:
    dense = _resample(route)
    place = dense[int(0.42 * len(dense))]
    put_boxed(canvas, f"{edge.weight:.0f}", (float(place[0]), float(place[1])), 0.38, (90, 90, 90), WHITE)


def _resample(route: np.ndarray) -> np.ndarray:
    """The same curve in steps of one pixel."""
    length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))))
    steps = np.linspace(0.0, length[-1], max(2, math.ceil(length[-1])))
    return np.stack([np.interp(steps, length, route[:, axis]) for axis in range(2)], axis=1)


def fixed(points: np.ndarray) -> np.ndarray:
    """Points (N, 2) as OpenCV takes fractions of pixels, with `shift` 4."""
    return np.rint(np.asarray(points) * (1 << _SHIFT)).astype(np.int32)


def disc(canvas: Image, place: Sequence[float], radius: float, color: tuple[int, int, int], thickness: int = -1) -> None:
    """A circle with fractions of pixels; thickness -1: filled."""
    x, y = (round(value * (1 << _SHIFT)) for value in place)
    cv2.circle(canvas, (x, y), round(radius * (1 << _SHIFT)), color, thickness, cv2.LINE_AA, _SHIFT)


def put_centered(canvas: Image, text: str, place: Sequence[float], size: float, color: tuple[int, int, int], thickness: int) -> None:
    """Text whose middle is at a place."""
    (width, height), _ = cv2.getTextSize(text, FONT, size, thickness)
    put_text(canvas, text, (round(place[0] - width / 2), round(place[1] + height / 2)), size, color, thickness)


def put_boxed(
    canvas: Image, text: str, place: Sequence[float], size: float, color: tuple[int, int, int], ground: tuple[int, int, int]
) -> None:
    """As `put_centered`, on a box of another colour."""
    (width, height), _ = cv2.getTextSize(text, FONT, size, 1)
    half = np.array([width / 2 + 2, height / 2 + 2])
    low, high = np.rint(np.array(place) - half).astype(int), np.rint(np.array(place) + half).astype(int)
    cv2.rectangle(canvas, low.tolist(), high.tolist(), ground, -1)
    put_centered(canvas, text, place, size, color, 1)


def readable_on(color: tuple[int, int, int]) -> tuple[int, int, int]:
    """Dark or white, whichever can be read on a colour (blue first)."""
    blue, green, red = color
    return INK if 0.114 * blue + 0.587 * green + 0.299 * red > 110 else WHITE
