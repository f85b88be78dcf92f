"""Clutter graph: edges from votes, minimum feedback arc sets, transitive closure; of few instances and of as many as eight words hold."""

from __future__ import annotations

import networkx as nx
import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.kernels.perception.clutter_graph import edge_weight
from synpick_warp.stages.arrays import count_words, unpack_words
from tests.harness.devices import default_device
from tests.harness.probe import probe
from tests.twins import planning
from tests.twins.planning import PlannerHarness

LEAST = planning.SETTINGS["min_votes"]
EXACT = planning.SETTINGS["exact_cycle"]
weigh = probe(edge_weight)
Pairs = dict[tuple[int, int], float]


def graphs(device, votes: np.ndarray, **settings) -> list[tuple[nx.DiGraph, nx.DiGraph]]:
    """Clutter graphs of votes (V, I, I) with and without cycles; edges run from upper to lower. The closure must be that of the edges."""
    harness = PlannerHarness.unseen(device, *votes.shape[:2], settings=settings)
    found = []
    for vote, edges, paths in zip(votes, *harness.graph(votes.astype(np.float32)), strict=True):
        whole, kept = (nx.from_numpy_array(weights.T, create_using=nx.DiGraph) for weights in (planning.net_weights(vote, LEAST), edges))
        assert nx.is_directed_acyclic_graph(kept)
        assert kept.edges <= whole.edges
        expected = np.zeros(paths.shape, bool)
        for instance in range(len(vote)):
            expected[instance, list(nx.ancestors(kept, instance))] = True
        np.testing.assert_array_equal(paths, expected)
        found.append((whole, kept))
    return found


def test_opposite_votes_below_the_least_do_not_count():
    """Weights of the edge 1 → 0 by votes for and against it."""
    found = [float(weigh(votes_of(*votes), 0, 0, 1, LEAST)) for votes in ((6, 4), (6, 5), (5, 6), (4, 0))]
    assert found == [6.0, 1.0, 0.0, 0.0]


def votes_of(votes: float, opposite: float) -> wp.array:
    """Votes (1, 2, 2) of two instances."""
    return wp.array([[[0.0, votes], [opposite, 0.0]]], dtype=float, device=default_device())


def weight(whole: nx.DiGraph, kept: nx.DiGraph) -> float:
    """Weight of the edges that are kept."""
    return sum(whole.edges[edge]["weight"] for edge in kept.edges)


def kept_pairs(kept: nx.DiGraph) -> set[tuple[int, int]]:
    """Edges as (lower, upper)."""
    return {(lower, upper) for upper, lower in kept.edges}


def as_matrix(votes: Pairs, size: int) -> np.ndarray:
    result = np.zeros((size, size))
    for pair, number in votes.items():
        result[pair] = number
    return result


def cycle(weights: list[float], first: int = 0) -> Pairs:
    """Votes of a cycle: node i + 1 above node i, with weights[i], numbered from `first`."""
    return {(first + i, first + (i + 1) % len(weights)): votes for i, votes in enumerate(weights)}


def random_votes(size: int, density: float, seed: int) -> np.ndarray:
    """Random integer votes, whose sums are exact."""
    numbers = np.random.default_rng(seed)
    votes = numbers.integers(5, 40, (size, size)) * (numbers.random((size, size)) < density)
    np.fill_diagonal(votes, 0)
    return votes.astype(float)


@pytest.mark.parametrize(
    ("votes", "edges"),
    [
        pytest.param({(0, 1): 4.9, (1, 2): 5.0}, {(1, 2)}, id="too few votes"),
        pytest.param({(0, 1): 12, (1, 0): 7}, {(0, 1)}, id="opposite edges cancel to their difference"),
        pytest.param({(0, 1): 7, (1, 0): 12}, {(1, 0)}, id="the other way round"),
        pytest.param({(0, 1): 9, (1, 0): 9}, set(), id="equal votes"),
        pytest.param({(0, 1): 5, (1, 0): 4}, {(0, 1)}, id="too few votes do not count against the opposite edge"),
        pytest.param({(0, 1): 6, (1, 0): 5}, {(0, 1)}, id="the difference may be below the threshold"),
        pytest.param(cycle([30, 9, 8]), {(0, 1), (1, 2)}, id="a cycle"),
        pytest.param(cycle([30, 9, 8]) | {(1, 0): 24}, {(1, 2), (2, 0)}, id="net votes are the weights within a cycle"),
        pytest.param(dict.fromkeys([(0, 1), (1, 2), (0, 3), (4, 3)], 10), {(0, 1), (1, 2), (0, 3), (4, 3)}, id="no cycle"),
        pytest.param(
            cycle([9, 8, 7]) | cycle([7, 8, 9], 3) | {(0, 3): 5, (2, 5): 5},
            {(0, 1), (1, 2), (4, 5), (5, 3), (0, 3), (2, 5)},
            id="two cycles, one above the other",
        ),
    ],
)
def test_known_graphs(device, votes, edges):
    """Votes and edges (lower, upper)."""
    ((_, kept),) = graphs(device, as_matrix(votes, 6)[None])
    assert kept_pairs(kept) == edges


@pytest.mark.parametrize("size", [3, 5, 9, 12])
@pytest.mark.parametrize("exact_cycle", [2, 12])
def test_a_simple_cycle_loses_its_lightest_edge(device, size, exact_cycle):
    """The greedy order may remove another edge of the cycle, but only one; the rest becomes a path."""
    votes = cycle((10.0 + np.random.default_rng(size).permutation(size)).tolist())
    ((_, kept),) = graphs(device, as_matrix(votes, size)[None], exact_cycle=exact_cycle)
    (lost,) = set(votes) - kept_pairs(kept)
    assert votes[lost] == 10.0 or size > exact_cycle
    assert nx.dag_longest_path_length(kept) == size - 1


def test_ties_go_by_index_and_do_not_depend_on_the_view(device):
    """A cycle of equal edges can be broken anywhere; both orders begin with the smallest index."""
    votes = np.tile(as_matrix(cycle([8] * 4), 4), (3, 1, 1))
    # Exact: 0 is placed last. Greedy: 0 is placed first.
    for limit, edges in ((4, {(0, 1), (1, 2), (2, 3)}), (2, {(1, 2), (2, 3), (3, 0)})):
        assert [kept_pairs(kept) for _, kept in graphs(device, votes, exact_cycle=limit)] == [edges] * 3


@pytest.mark.parametrize(("size", "count"), [(3, 60), (4, 60), (5, 40), (6, 12)])
def test_the_exact_order_equals_an_exhaustive_search(device, size, count):
    votes = np.stack([random_votes(size, (0.5, 0.95)[seed % 2], 1 + seed) for seed in range(count)])
    found = graphs(device, votes)
    for vote, (whole, kept) in zip(votes, found, strict=True):
        assert weight(whole, kept) == planning.heaviest_by_orders(planning.net_weights(vote, LEAST))
    assert sum(not nx.is_directed_acyclic_graph(whole) for whole, _ in found) > count / 6


def test_the_exact_order_is_never_worse_than_the_greedy_one_and_sometimes_better(device):
    votes = np.stack([random_votes(10, 0.5, seed) for seed in range(20)])
    exact, greedy = ([weight(*pair) for pair in graphs(device, votes, exact_cycle=limit)] for limit in (10, 2))
    assert (np.subtract(exact, greedy) >= 0).all()
    assert max(np.subtract(exact, greedy)) > 0


@pytest.mark.parametrize(
    ("size", "density", "count", "exact_cycle"),
    [
        *[(size, density, 20, 2) for size, density in ((6, 0.5), (11, 0.4), (20, 0.2), (32, 0.9))],
        *[(MAX_INSTANCES, density, 1, EXACT) for density in (0.004, 0.008, 0.03, 0.9)],
    ],
)
def test_random_graphs_keep_half_of_the_weight_and_all_that_is_on_no_cycle(device, size, density, count, exact_cycle):
    votes = np.stack([random_votes(size, density, 3 + seed) for seed in range(count)])
    for whole, kept in graphs(device, votes, exact_cycle=exact_cycle):
        component = {node: index for index, nodes in enumerate(nx.strongly_connected_components(whole)) for node in nodes}
        assert all(component[a] == component[b] for a, b in whole.edges - kept.edges)
        assert weight(whole, kept) >= whole.size("weight") / 2


@pytest.mark.parametrize("density", [0.02, 0.9])
def test_the_greedy_order_is_that_of_the_reference(device, density):
    votes = random_votes(MAX_INSTANCES, density, 4)
    ((whole, kept),) = graphs(device, votes[None])
    expected = nx.DiGraph(whole)
    for nodes in map(sorted, nx.strongly_connected_components(whole)):
        assert len(nodes) == 1 or len(nodes) > EXACT
        rank = dict(zip(planning.greedy_order(planning.net_weights(votes, LEAST)[np.ix_(nodes, nodes)]), range(len(nodes)), strict=True))
        inner = whole.subgraph(nodes).edges
        expected.remove_edges_from([(a, b) for a, b in inner if rank[nodes.index(a)] > rank[nodes.index(b)]])
    assert kept.edges == expected.edges


# ---- many instances ----


@pytest.mark.parametrize(("instances", "words"), [(1, 1), (32, 1), (33, 2), (64, 2), (MAX_INSTANCES, 8)])
def test_words_hold_the_instances(instances, words):
    assert count_words(instances) == words
    members = np.arange(instances)[::-3]
    sets = np.zeros((2, words), np.uint32)
    np.bitwise_or.at(sets[1], members // 32, np.uint32(1) << (members % 32).astype(np.uint32))
    there = unpack_words(sets, instances)
    assert there.shape == (2, instances)
    assert not there[0].any()
    assert np.flatnonzero(there[1]).tolist() == sorted(members)


@pytest.mark.parametrize("size", [31, 33, 64, MAX_INSTANCES])
def test_a_chain_through_all_words_is_closed(device, size):
    """Each instance lies above all that follow it in a random order."""
    order = np.random.default_rng(size).permutation(size)
    votes = np.zeros((1, size, size))
    votes[0, order[1:], order[:-1]] = 10
    ((_, kept),) = graphs(device, votes)
    assert [len(nx.ancestors(kept, instance)) for instance in order] == list(range(size))


def test_small_cycles_among_many_instances_lose_the_least_weight(device):
    """Components of two to six members, each with all orders tried, scattered over the words and joined by edges that make no cycle."""
    numbers = np.random.default_rng(8)
    places, votes, best = numbers.permutation(MAX_INSTANCES), np.zeros((MAX_INSTANCES, MAX_INSTANCES)), 0.0
    groups = np.split(places, np.cumsum(numbers.integers(2, 7, 60))[:-1].clip(0, MAX_INSTANCES))
    for before, group in zip([[], *groups[:-1]], groups, strict=True):
        inside = random_votes(len(group), 0.8, len(group) + int(best))
        votes[np.ix_(group, group)] = inside
        best += planning.heaviest_by_orders(planning.net_weights(inside, LEAST))
        if len(before) and len(group):
            votes[group[0], before[-1]] = 7.0
            best += 7.0
    ((whole, kept),) = graphs(device, votes[None])
    assert weight(whole, kept) == best < whole.size("weight")


@given(size=st.integers(2, 70), density=st.floats(0.0, 0.5), seed=st.integers(0, 1000), exact=st.integers(2, 6))
def test_what_is_kept_does_not_depend_on_instances_that_are_not_there(size, density, seed, exact, device):
    """The same pile among more instances, the others unseen, has the same graph."""
    votes, room = random_votes(size, density, seed), 101
    padded = np.zeros((1, room, room))
    padded[0, :size, :size] = votes
    ((_, alone),), ((_, among),) = graphs(device, votes[None], exact_cycle=exact), graphs(device, padded, exact_cycle=exact)
    assert alone.edges == among.edges
