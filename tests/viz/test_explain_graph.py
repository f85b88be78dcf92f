"""The drawn clutter graph: which edges, that all of them run downward, that nothing overlaps or leaves the picture."""

from __future__ import annotations

import itertools

import networkx as nx
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.apps.viz.drawing import instance_color
from synpick_warp.apps.viz.explain_graph import CYCLIC, KEPT, OUTVOTED, RADIUS, Edge, clutter_edges, draw_graph, lay_out
from synpick_warp.apps.viz.explain_record import SeenAttempt
from tests.worlds.attempt_records import attempt, seen

SIZE = (500, 600)
LEAST = 5.0


def from_votes(count: int, kept: list[tuple[int, int]], votes: dict[tuple[int, int], float], columns: list[float]) -> SeenAttempt:
    """An attempt whose graph has the edges (upper, lower) that are given."""
    graph = nx.DiGraph(kept)
    graph.add_nodes_from(range(count))
    objects = tuple(
        seen(i, frozenset(graph.predecessors(i)), frozenset(nx.ancestors(graph, i)), grasp_pixel=(columns[i], 10.0)) for i in range(count)
    )
    return attempt(objects, votes, target=0)


@st.composite
def piles(draw: st.DrawFn) -> SeenAttempt:
    count = draw(st.integers(1, 32))
    order = draw(st.permutations(range(count)))
    pairs = list(itertools.combinations(order, 2))
    kept = draw(st.lists(st.sampled_from(pairs), max_size=40, unique=True)) if pairs else []
    votes = {(lower, upper): draw(st.floats(5.0, 90.0)) for upper, lower in kept}
    return from_votes(count, kept, votes, [draw(st.floats(0.0, 95.0)) for _ in range(count)])


@given(piles())
@settings(max_examples=25)
def test_arrows_run_downward_and_nodes_stay_apart_and_inside(pile):
    edges = clutter_edges(pile, LEAST)
    layout = lay_out(pile, edges, SIZE)
    assert layout.routes.keys() == {(upper, one.instance) for one in pile.seen for upper in one.above}
    for (upper, lower), route in layout.routes.items():
        np.testing.assert_allclose(route[[0, -1]], [layout.nodes[upper], layout.nodes[lower]], atol=1e-6)
        assert (np.diff(route[:, 1]) > -1e-6).all()
        assert route[-1, 1] - route[0, 1] > 1.0
    places = np.array(list(layout.nodes.values()))
    assert len(places) == len(pile.seen)
    assert (places >= RADIUS + 15).all()
    assert (places <= np.array(SIZE) - RADIUS - 15).all()
    for first, second in itertools.combinations(places, 2):
        if abs(first[1] - second[1]) < 1e-6:
            assert abs(first[0] - second[0]) >= 10


def test_a_layer_is_the_longest_path_from_above():
    pile = from_votes(4, [(0, 1), (1, 2), (0, 2), (0, 3)], {}, [50.0, 20.0, 50.0, 80.0])
    heights = {instance: y for instance, (_, y) in lay_out(pile, clutter_edges(pile, LEAST), SIZE).nodes.items()}
    assert heights[0] < heights[1] == heights[3] < heights[2]


def test_neighbours_keep_the_order_of_the_image_where_nothing_speaks_against_it():
    pile = from_votes(4, [(0, 1), (2, 3)], {}, [80.0, 80.0, 10.0, 10.0])
    nodes = lay_out(pile, clutter_edges(pile, LEAST), SIZE).nodes
    assert nodes[2][0] < nodes[0][0]
    assert nodes[3][0] < nodes[1][0]


def test_crossings_are_avoided():
    pile = from_votes(4, [(0, 3), (1, 2)], {}, [20.0, 70.0, 20.0, 70.0])
    nodes = lay_out(pile, clutter_edges(pile, LEAST), SIZE).nodes
    assert (nodes[0][0] - nodes[1][0]) * (nodes[3][0] - nodes[2][0]) > 0


def test_a_long_arrow_passes_beside_the_nodes_between():
    pile = from_votes(3, [(0, 1), (1, 2), (0, 2)], {}, [50.0, 50.0, 50.0])
    layout = lay_out(pile, clutter_edges(pile, LEAST), SIZE)
    away = np.hypot(*(layout.routes[0, 2] - np.array(layout.nodes[1])).T)
    assert away.min() > RADIUS + 2


def test_opposite_edges_a_cycle_and_too_few_votes():
    votes = {(1, 0): 20.0, (0, 1): 8.0, (2, 1): 9.0, (0, 2): 6.0, (3, 0): 4.9, (2, 3): 7.0, (3, 2): 7.0, (1, 3): 30.0, (3, 1): 4.0}
    pile = from_votes(4, [(0, 1), (1, 2), (3, 1)], votes, [0.0] * 4)
    assert clutter_edges(pile, LEAST) == [
        Edge(1, 0, 8.0, OUTVOTED),
        Edge(2, 0, 6.0, CYCLIC),
        Edge(0, 1, 12.0, KEPT),
        Edge(3, 1, 30.0, KEPT),
        Edge(1, 2, 9.0, KEPT),
        Edge(3, 2, 7.0, OUTVOTED),
        Edge(2, 3, 7.0, OUTVOTED),
    ]


def test_the_arrow_head_is_at_the_object_below():
    pile = from_votes(2, [(0, 1)], {(1, 0): 9.0}, [50.0, 50.0])
    nodes = lay_out(pile, clutter_edges(pile, LEAST), SIZE).nodes
    picture = draw_graph(pile, LEAST, SIZE)
    x = round(nodes[0][0])
    dark = (picture[:, x - 12 : x + 13].max(axis=2) < 120).sum(axis=1)
    top, bottom = round(nodes[0][1]) + RADIUS, round(nodes[1][1]) - RADIUS
    assert dark[bottom - 12 : bottom - 4].max() >= 7
    assert dark[top + 8 : top + 30].max() <= 2
    for instance, (column, row) in nodes.items():
        assert tuple(picture[round(row) + RADIUS - 5, round(column)]) == instance_color(instance)


def test_edges_that_were_taken_out_are_dashed_and_not_dark():
    kept = from_votes(2, [(0, 1)], {(1, 0): 9.0}, [50.0, 50.0])
    both = from_votes(2, [(0, 1)], {(1, 0): 20.0, (0, 1): 8.0}, [50.0, 50.0])
    first, second = draw_graph(kept, LEAST, SIZE), draw_graph(both, LEAST, SIZE)
    added = (first != second).any(axis=2)
    added[:, 230:270] = False  # The weight is another one.
    assert added.sum() > 30
    assert second[added].min() >= 140


def test_without_objects_the_picture_is_white():
    assert (draw_graph(attempt((), {}), LEAST, SIZE) == 255).all()
