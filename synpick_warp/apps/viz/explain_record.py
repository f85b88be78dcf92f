"""Records of pick attempts: read from attempts.jsonl, explained in sentences, and their clutter graph drawn in layers.

Arrows run downward, from the object on top to the one below. Layers by longest path (networkx), each ordered by the mean place of what
lies on its nodes, and spread evenly about the middle; an arrow that would run over another node is bent aside.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import networkx as nx
import numpy as np

from synpick_warp.apps.viz.drawing import FONT, INK, WHITE, Image, blank, instance_color, put_text, readable_on, short_labels
from synpick_warp.configs.cell.gripper import Suction
from synpick_warp.configs.episodes.manipulation import ANOTHER, Pick, Target
from synpick_warp.dataset import annotations
from synpick_warp.dataset.annotations import ADVICE, InstanceObservation, check_content
from synpick_warp.dataset.commit.manifest import ATTEMPTS_FILE
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import MAX_JSON, decode_json, read_file

MODE_WORDS = {"pick": "untargeted", "target": "targeted"}
CANDIDATES = ("pole", "centroid", "midpoint", "drawn")
"""Kinds of suction points: those in the order of `InstanceObservation.candidates`, and one drawn where the surface is flat."""

MAX_ATTEMPTS = 100
"""Most attempts of one figure."""
MIN_CHOICE = 3
"""Fewest visible objects of an attempt that is worth seeing."""
MAX_RUNS = 20
"""Most ranges of numbers that a message lists."""


class SeenAttempt(annotations.Attempt, dict=True):
    """Pick attempt as its record, of which the target was visible, and all suction points are in the image."""

    def __post_init__(self) -> None:
        annotations.Attempt.__post_init__(self)
        width, height = self.observation.resolution
        if self.target is not None and self.target not in self.objects:
            raise ValueError(f"target is {self.target}, which was not visible")
        for one in self.seen:
            if not all(-1.0 <= column <= width and -1.0 <= row <= height for column, row in (*one.candidates, one.grasp_pixel)):
                raise ValueError(f"a point of instance {one.instance} is not in the image of {width} x {height}")

    @cached_property
    def seen(self) -> list[InstanceObservation]:
        """Observations of the visible instances, in the order of instances."""
        return [one for one in self.observation.instances if one.visible > 0]

    @cached_property
    def votes(self) -> dict[tuple[int, int], float]:
        """(lower, upper) -> occlusion votes along the contour of the lower that the upper lies above it."""
        return {(lower, upper): votes for lower, upper, votes in self.observation.votes}

    @property
    def objects(self) -> dict[int, InstanceObservation]:
        """Instance id -> its observation."""
        return {one.instance: one for one in self.seen}

    def ranked(self) -> list[InstanceObservation]:
        """Rank by the choice rule: fewest ancestors, then largest visible area; in targeted picking the reverse."""
        sign = -1 if self.mode == "target" else 1
        return sorted(self.seen, key=lambda one: (sign * len(one.ancestors), -sign * one.visible_fraction, one.instance))


def read_attempts(dataset: Path, episode: int, number: int | None) -> list[SeenAttempt]:
    """Read the attempts of an episode, sorted, or one of them; raises DatasetError if the file is missing or damaged, or lacks the
    attempt."""
    path, lines = _read_lines(dataset)
    keys = [decode_json(line, annotations.AttemptKey, _line(path, row), DatasetError, ADVICE) for row, line in enumerate(lines)]
    episodes = sorted({key.episode for key in keys})
    if episode not in episodes:
        raise DatasetError(f"{path} has no attempt of episode {episode}; {_which('episodes that have', episodes)}")
    rows = sorted((key.attempt, row) for row, key in enumerate(keys) if key.episode == episode)
    numbers = [row[0] for row in rows]
    if number is not None and number not in numbers:
        raise DatasetError(f"{path} has no attempt {number} of episode {episode}; {_which('attempts', numbers)}")
    if len(rows) > MAX_ATTEMPTS and number is None:
        raise DatasetError(
            f"{path} has {len(rows)} attempts of episode {episode}; a figure has at most {MAX_ATTEMPTS}: name one by --attempt"
        )
    return [decode_json(lines[row], SeenAttempt, _line(path, row), DatasetError, ADVICE) for count, row in rows if number in (None, count)]


def choose_attempts(dataset: Path, count: int) -> list[SeenAttempt]:
    """Choose the first attempts worth seeing; if there are fewer, others from the beginning stand in. In the order of the file.

    Worth seeing is an attempt that chose among MIN_CHOICE objects or more, of which some lie on others, and engaged one. Raises
    DatasetError if the file is missing or damaged, or has no attempt.
    """
    path, lines = _read_lines(dataset)
    worthy: dict[int, SeenAttempt] = {}
    others: dict[int, SeenAttempt] = {}
    for row, line in enumerate(lines):
        attempt = decode_json(line, SeenAttempt, _line(path, row), DatasetError, ADVICE)
        chosen = attempt.target is not None and len(attempt.seen) >= MIN_CHOICE and any(one.above for one in attempt.seen)
        if chosen and attempt.engaged:
            worthy[row] = attempt
        elif len(others) < count:
            others[row] = attempt
        if len(worthy) == count:
            break
    if not worthy and not others:
        raise DatasetError(f"{path} has no attempt; explain draws those of a bake with mode pick, target, mixed or cycle")
    rows = [*worthy, *others][:count]
    return [(worthy | others)[row] for row in sorted(rows)]


def _read_lines(dataset: Path) -> tuple[Path, list[bytes]]:
    """The file of attempts, and its lines; raises DatasetError if it is missing or cannot be read."""
    path = dataset / ATTEMPTS_FILE
    if not path.exists():
        raise DatasetError(
            f"{dataset} has no {path.name}: it has no pick attempts; explain draws those of a bake with mode pick, target, mixed or cycle"
        )
    return path, read_file(path, MAX_JSON, DatasetError).splitlines()


def parse_attempt(content: Mapping[str, Any], source: str) -> SeenAttempt:
    """Parse a record of `synpick_warp.dataset.reading.Episode.attempts`; raises DatasetError if it is damaged."""
    return check_content(content, SeenAttempt, source)


def _line(path: Path, row: int) -> str:
    """Name of a line of a file, for messages."""
    return f"{path}, line {row + 1},"


def _which(what: str, numbers: list[int]) -> str:
    """List ascending integers with runs merged, up to MAX_RUNS runs: "attempts: 0 to 3, 5"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    shown = [f"{low}" if low == high else f"{low} to {high}" for low, high in runs[:MAX_RUNS]] + ["..."] * (len(runs) > MAX_RUNS)
    return f"{what}: {', '.join(shown) or 'none'}"


def labels(attempt: SeenAttempt) -> dict[int, str]:
    """Short label of every visible instance, see `short_labels`."""
    return short_labels((one.instance, one.object_id) for one in attempt.seen)


def full_names(attempt: SeenAttempt, names: Mapping[int, str]) -> dict[int, str]:
    """Label and name of every visible instance."""
    short = labels(attempt)
    return {one.instance: f"{short[one.instance]} {names.get(one.object_id, '')}".rstrip() for one in attempt.seen}


def suction_kind(one: InstanceObservation) -> int:
    """Index in CANDIDATES of the suction point: of the nearest candidate, as the point is rounded to a pixel; the last beyond that."""
    distances = [math.dist(point, one.grasp_pixel) for point in one.candidates]
    return distances.index(min(distances)) if min(distances) <= 1.0 else len(distances)


def choice_words(attempt: SeenAttempt, names: Mapping[int, str], target: Target, pick: Pick) -> list[str]:
    """Explain in sentences the chosen target, the reason, and the suction point."""
    if attempt.target is None:
        return ["target: none, nothing is visible"]
    full = full_names(attempt, names)
    one = attempt.objects[attempt.target]
    kind = suction_kind(one)
    where = ("pole of inaccessibility", "centroid", "half-way point", "drawn where the surface is flattest")[kind]
    if 0 < kind < len(one.distances):
        where += f", {one.distances[kind] / one.distances[0] if one.distances[0] else 1.0:.2f} of the pole's distance"
    tilt = "" if attempt.tilt is None else f"; cup tilted by {abs(math.degrees(attempt.tilt)):.0f} degrees"
    return [f"target: {full[attempt.target]}: {_reason(attempt, one, full, target, pick)}", f"suction point: {where}{tilt}"]


def _reason(attempt: SeenAttempt, one: InstanceObservation, full: Mapping[int, str], target: Target, pick: Pick) -> str:
    """Clause on why an object was chosen: number of objects above it, and its visible area if several have as many.

    The area is relative to the largest face of the bounding box: seen obliquely, an object can show more.
    """
    targeted = attempt.mode == "target"
    count = len(one.ancestors)
    above = f"{count} object{'' if count == 1 else 's'} above"
    first = attempt.ranked()[0]
    if first.visible_fraction != one.visible_fraction or len(first.ancestors) != count:
        if targeted and target.random_after_failure:
            return f"{above}; chosen at random after a failed attempt"
        if pick.retry == ANOTHER:
            return f"{above}; attempts have failed at {full[first.instance]}"
        return f"{above}; the rule would name {full[first.instance]}"
    equals = sum(len(other.ancestors) == count for other in attempt.seen)
    if len(attempt.seen) == 1:
        return f"{above}; the only visible object"
    if equals == 1:
        return f"{above}, the {'most' if targeted else 'fewest'} of all"
    area = f"visible area {one.visible_fraction:.2f} of its box's largest face"
    return f"{above}; {area}, the {'smallest' if targeted else 'largest'} of {equals} such"


def seal_words(attempt: SeenAttempt, names: Mapping[int, str], suction: Suction) -> list[str]:
    """Explain in sentences the rays, the seal, its force and the picked objects; none if nothing was chosen."""
    if attempt.target is None:
        return []
    full = full_names(attempt, names)
    lines = [f"rays: {attempt.hits} of {attempt.rays} hit"]
    if attempt.hits:
        seal = f"{'good' if attempt.good_seal else 'poor'} seal, breaks"
        if attempt.sealed is not None:
            seal = f"{len(attempt.sealed)} of {attempt.rays // (suction.rays + suction.mouth_rays)} cups with a good seal, break"
        lines[0] += f"; {seal} at {break_force(attempt, suction):.3g} N"
        peak = f"; largest force {max(attempt.peak_force):.1f} N" if attempt.peak_force else ""
        lines.append(f"engaged: {_listed(attempt.engaged, full)}{peak}")
        lines.append(f"picked: {_listed(attempt.picked, full)}")
    return lines


def break_force(attempt: SeenAttempt, suction: Suction) -> float:
    """Force at which the strongest seal of the attempt breaks, or with `suction.vacuum` the weakest [N]."""
    if attempt.break_force is not None:
        return attempt.break_force
    return suction.good_force if attempt.good_seal or attempt.sealed else suction.poor_force


def _listed(instances: Sequence[int], full: Mapping[int, str]) -> str:
    """List names of instances; an engaged object can be invisible to the camera of perception."""
    return ", ".join(full.get(instance, f"instance {instance}, unseen") for instance in instances) or "nothing"


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
    routes: dict[tuple[int, int], np.ndarray]
    """(upper, lower) of a kept edge -> polyline from node to node (N, 2)."""


def clutter_edges(attempt: SeenAttempt, min_votes: float) -> list[Edge]:
    """Edges of the clutter graph, sorted by lower, then upper instance: all that are kept in the acyclic graph, and of at least `min_votes`
    those removed, since the opposite has as many votes or to break a cycle."""
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
    """Place nodes in layers such that every kept edge runs downward; the attempt's suction points give the order of the uppermost objects
    from left to right. Raises DatasetError if the kept edges have a cycle, or are far more than those of any pile."""
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
    """Draw the clutter graph on white, without legend, in an image of width and height [px]; `min_votes` are those of an edge."""
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
    """Draw a removed edge as a dashed arc, beside the straight line between its nodes, where the opposite edge may run."""
    start, end = (np.array(layout.nodes[node]) for node in (edge.upper, edge.lower))
    route = _arc(start, end, _BEND * np.array([end[1] - start[1], start[0] - end[0]]))
    _draw_arrow(canvas, route, GREY if edge.state == OUTVOTED else RED, 1, dashed=True)


def _draw_weight(canvas: Image, edge: Edge, route: np.ndarray) -> None:
    dense = _resample(route)
    place = dense[int(0.42 * len(dense))]
    put_boxed(canvas, f"{edge.weight:.0f}", (float(place[0]), float(place[1])), 0.38, (90, 90, 90), WHITE)


def _resample(route: np.ndarray) -> np.ndarray:
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
