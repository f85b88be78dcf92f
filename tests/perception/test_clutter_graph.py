"""Clutter graph: edges from votes, minimum feedback arc sets, transitive closure."""

from __future__ import annotations

import numpy as np
import pytest

from tests.twins import planning
from tests.twins.planning import PlannerHarness

EMPTY = np.full((4, 4), -1), np.ones((4, 4))


def harness_of(device, votes: np.ndarray, **settings) -> PlannerHarness:
    views, instances = votes.shape[:2]
    return PlannerHarness(device, [EMPTY[0]] * views, [EMPTY[1]] * views, instances, settings=settings)


def graph(device, votes, **settings) -> tuple[np.ndarray, np.ndarray]:
    """Edges and paths for votes (V, I, I) or (I, I)."""
    votes = np.asarray(votes, np.float32)
    edges, paths = harness_of(device, votes.reshape(-1, *votes.shape[-2:]), **settings).graph(votes.reshape(-1, *votes.shape[-2:]))
    return edges.reshape(votes.shape), paths.reshape(votes.shape)


def cycle(weights: list[float]) -> np.ndarray:
    """Votes (n, n) of a cycle: node i + 1 above node i, with weights[i]."""
    votes = np.zeros((len(weights),) * 2)
    votes[np.arange(len(weights)), np.roll(np.arange(len(weights)), -1)] = weights
    return votes


def pairs(edges: np.ndarray) -> set[tuple[int, int]]:
    return {tuple(pair) for pair in np.argwhere(edges).tolist()}


def test_too_few_votes_make_no_edge(device):
    votes = np.zeros((3, 3))
    votes[0, 1], votes[1, 2] = 4.9, 5.0
    edges, _ = graph(device, votes)
    assert pairs(edges) == {(1, 2)}


def test_opposite_edges_cancel_to_their_difference(device):
    votes = np.zeros((5, 5, 5))
    votes[0, 0, 1], votes[0, 1, 0] = 12, 7
    votes[1, 0, 1], votes[1, 1, 0] = 7, 12
    votes[2, 0, 1], votes[2, 1, 0] = 9, 9
    # Votes below the threshold do not count against the opposite edge.
    votes[3, 0, 1], votes[3, 1, 0] = 5, 4
    # The difference may be below the threshold.
    votes[4, 0, 1], votes[4, 1, 0] = 6, 5
    edges, _ = graph(device, votes)
    assert [pairs(e) for e in edges] == [{(0, 1)}, {(1, 0)}, set(), {(0, 1)}, {(0, 1)}]


def test_net_votes_are_the_weights_within_a_cycle(device):
    """30 - 24 is less than 8: the edge with the most votes is removed."""
    votes = cycle([30, 9, 8])
    votes[1, 0] = 24
    assert pairs(graph(device, votes)[0]) == {(1, 2), (2, 0)}
    assert pairs(graph(device, cycle([30, 9, 8]))[0]) == {(0, 1), (1, 2)}


@pytest.mark.parametrize("size", [3, 5, 9, 12])
@pytest.mark.parametrize("exact_cycle", [2, 12])
def test_a_simple_cycle_loses_its_lightest_edge(device, size, exact_cycle):
    """The greedy order may remove another edge of the cycle, but only one; the rest becomes a path."""
    weights = 10.0 + np.random.default_rng(size).permutation(size)
    edges, paths = graph(device, cycle(list(weights)), exact_cycle=exact_cycle)
    lost = pairs(cycle(list(weights)) > 0) - pairs(edges)
    assert len(lost) == 1
    if size <= exact_cycle:
        assert cycle(list(weights))[lost.pop()] == 10.0
    assert sorted(paths.sum(axis=1)) == list(range(size))


def test_all_above_is_transitive(device):
    votes = np.zeros((6, 6))
    for lower, upper in ((0, 1), (1, 2), (0, 3), (4, 3)):
        votes[lower, upper] = 10
    edges, paths = graph(device, votes)
    assert pairs(edges) == {(0, 1), (1, 2), (0, 3), (4, 3)}
    assert pairs(paths) == {(0, 1), (1, 2), (0, 3), (4, 3), (0, 2)}


def test_components_are_processed_independently(device):
    """Two cycles, one above the other: the edges between them are kept."""
    votes = np.zeros((6, 6))
    votes[:3, :3], votes[3:, 3:] = cycle([9, 8, 7]), cycle([7, 8, 9])
    votes[0, 3] = votes[2, 5] = 5
    edges, paths = graph(device, votes)
    assert pairs(edges) == {(0, 1), (1, 2), (4, 5), (5, 3), (0, 3), (2, 5)}
    assert paths[0].sum() == 4


def random_votes(count: int, size: int, density: float, seed: int) -> np.ndarray:
    """Random integer votes (count, size, size), whose sums are exact."""
    numbers = np.random.default_rng(seed)
    votes = numbers.integers(5, 40, (count, size, size)) * (numbers.random((count, size, size)) < density)
    votes[:, np.arange(size), np.arange(size)] = 0
    return votes.astype(float)


def test_the_two_exhaustive_searches_agree():
    for votes in random_votes(30, 4, 0.9, 0):
        weights = planning.net_weights(votes, 5)
        assert planning.heaviest_by_orders(weights) == planning.heaviest_by_subsets(weights)


@pytest.mark.parametrize(("size", "count"), [(3, 60), (4, 60), (5, 40), (6, 12)])
def test_exact_order_equals_an_exhaustive_search(device, size, count):
    votes = np.concatenate([random_votes(count // 2, size, density, size) for density in (0.5, 0.95)])
    edges, paths = graph(device, votes)
    unique = cyclic = 0
    for vote, edge, path in zip(votes, edges, paths, strict=True):
        weights = planning.net_weights(vote, 5)
        best, sets = planning.heaviest_by_orders(weights)
        assert weights[edge].sum() == best
        assert edge.tobytes() in sets
        unique += len(sets) == 1
        cyclic += not planning.is_acyclic(weights > 0)
        np.testing.assert_array_equal(path, planning.transitive_closure(edge))
    # Most samples have a unique optimum and many have cycles, so the test is not vacuous.
    assert unique > count / 2
    assert cyclic > count / 6


@pytest.mark.parametrize(("size", "density"), [(6, 0.5), (11, 0.4), (20, 0.2), (32, 0.9)])
def test_the_greedy_order_is_acyclic_and_keeps_half_of_the_weight(device, size, density):
    votes = random_votes(20, size, density, size)
    edges, paths = graph(device, votes, exact_cycle=2)
    for vote, edge, path in zip(votes, edges, paths, strict=True):
        weights = planning.net_weights(vote, 5)
        assert not edge[weights == 0].any()
        assert planning.is_acyclic(edge)
        assert not path.diagonal().any()
        assert weights[edge].sum() >= weights.sum() / 2


def test_the_exact_order_is_never_worse_than_the_greedy_one_and_sometimes_better(device):
    votes = random_votes(20, 10, 0.5, 1)
    exact, greedy = (graph(device, votes, exact_cycle=limit)[0] for limit in (10, 2))
    weights = np.stack([planning.net_weights(vote, 5) for vote in votes])
    gain = (weights * exact).sum(axis=(1, 2)) - (weights * greedy).sum(axis=(1, 2))
    assert (gain >= 0).all()
    assert (gain > 0).any()


def test_ties_go_by_index_and_do_not_depend_on_the_view(device):
    """A cycle of equal edges can be broken anywhere; both orders begin with the smallest index."""
    votes = np.tile(cycle([8, 8, 8, 8]), (3, 1, 1))
    exact, greedy = (graph(device, votes, exact_cycle=limit)[0] for limit in (4, 2))
    # Exact: 0 is placed last. Greedy: 0 is placed first.
    assert [pairs(e) for e in exact] == [{(0, 1), (1, 2), (2, 3)}] * 3
    assert [pairs(e) for e in greedy] == [{(1, 2), (2, 3), (3, 0)}] * 3
