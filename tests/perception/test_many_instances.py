"""Perception of up to 251 instances, whose sets take eight words: components, votes, clutter graph, target."""

from __future__ import annotations

import cv2
import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Mode, Phase
from synpick_warp.stages.arrays import count_words, unpack_words
from tests.twins import perception, planning
from tests.twins.perception import SegmenterHarness
from tests.twins.planning import PlannerHarness

MANY = 251
LEAST = planning.SETTINGS["min_votes"]
EMPTY = np.full((4, 4), -1), np.ones((4, 4))


def graphs(device, votes: np.ndarray, **settings) -> list[tuple[nx.DiGraph, nx.DiGraph]]:
    """Clutter graphs of votes (V, I, I) with and without cycles; edges run from upper to lower. The closure must be that of the edges."""
    harness = PlannerHarness(device, [EMPTY[0]] * len(votes), [EMPTY[1]] * len(votes), votes.shape[1], settings=settings)
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


def weight(whole: nx.DiGraph, kept: nx.DiGraph) -> float:
    """Weight of the edges that are kept."""
    return sum(whole.edges[edge]["weight"] for edge in kept.edges)


def random_votes(size: int, density: float, seed: int) -> np.ndarray:
    """Random integer votes, whose sums are exact."""
    numbers = np.random.default_rng(seed)
    votes = numbers.integers(5, 40, (size, size)) * (numbers.random((size, size)) < density)
    np.fill_diagonal(votes, 0)
    return votes.astype(float)


@pytest.mark.parametrize(("instances", "words"), [(1, 1), (32, 1), (33, 2), (64, 2), (MANY, 8)])
def test_words_hold_the_instances(instances, words):
    assert count_words(instances) == words
    members = np.arange(instances)[::-3]
    sets = np.zeros((2, words), np.uint32)
    np.bitwise_or.at(sets[1], members // 32, np.uint32(1) << (members % 32).astype(np.uint32))
    there = unpack_words(sets, instances)
    assert there.shape == (2, instances)
    assert not there[0].any()
    assert np.flatnonzero(there[1]).tolist() == sorted(members)


# ---- clutter graph ----


@pytest.mark.parametrize("size", [31, 33, 64, MANY])
def test_a_chain_through_all_words_is_closed(device, size):
    """Each instance lies above all that follow it in a random order."""
    order = np.random.default_rng(size).permutation(size)
    votes = np.zeros((1, size, size))
    votes[0, order[1:], order[:-1]] = 10
    ((_, kept),) = graphs(device, votes)
    assert [len(nx.ancestors(kept, instance)) for instance in order] == list(range(size))


@pytest.mark.parametrize("density", [0.004, 0.008, 0.03, 0.9])
def test_random_graphs_keep_half_of_the_weight_and_all_that_is_on_no_cycle(device, density):
    ((whole, kept),) = graphs(device, random_votes(MANY, density, 3)[None])
    component = {node: index for index, nodes in enumerate(nx.strongly_connected_components(whole)) for node in nodes}
    assert all(component[a] == component[b] for a, b in whole.edges - kept.edges)
    assert weight(whole, kept) >= whole.size("weight") / 2


@pytest.mark.parametrize("density", [0.02, 0.9])
def test_the_greedy_order_is_that_of_the_reference(device, density):
    votes = random_votes(MANY, density, 4)
    ((whole, kept),) = graphs(device, votes[None])
    expected = nx.DiGraph(whole)
    for nodes in map(sorted, nx.strongly_connected_components(whole)):
        assert len(nodes) == 1 or len(nodes) > planning.SETTINGS["exact_cycle"]
        rank = dict(zip(planning.greedy_order(planning.net_weights(votes, LEAST)[np.ix_(nodes, nodes)]), range(len(nodes)), strict=True))
        inner = whole.subgraph(nodes).edges
        expected.remove_edges_from([(a, b) for a, b in inner if rank[nodes.index(a)] > rank[nodes.index(b)]])
    assert kept.edges == expected.edges


def test_small_cycles_among_many_instances_lose_the_least_weight(device):
    """Components of two to six members, each with all orders tried, scattered over the words and joined by edges that make no cycle."""
    numbers = np.random.default_rng(8)
    places, votes, best = numbers.permutation(MANY), np.zeros((MANY, MANY)), 0.0
    groups = np.split(places, np.cumsum(numbers.integers(2, 7, 60))[:-1].clip(0, MANY))
    for before, group in zip([[], *groups[:-1]], groups, strict=True):
        inside = random_votes(len(group), 0.8, len(group) + int(best))
        votes[np.ix_(group, group)] = inside
        best += planning.heaviest_by_orders(planning.net_weights(inside, LEAST))[0]
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


# ---- images ----


def mosaic(count: int, width: int, height: int, seed: int) -> np.ndarray:
    """Voronoi cells of random points as images of instances (H, W), some of them in no place; -1: between them."""
    numbers = np.random.default_rng(seed)
    points = numbers.uniform((0, 0), (width, height), (count, 2))
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    away = np.hypot(columns[..., None] - points[:, 0], rows[..., None] - points[:, 1])
    nearest = np.argmin(away, axis=-1)
    return np.where(np.min(away, axis=-1) < 0.045 * width, numbers.permutation(count)[nearest], -1)


def test_all_instances_of_an_image_get_their_suction_points(device):
    width, height = 240, 160
    harness = SegmenterHarness(device, width, height, instances=MANY)
    ids = mosaic(MANY, width, height, 1)
    ids[:20, :40][ids[:20, :40] >= 0] = MANY - 1
    segments = (ids + 1).astype(np.uint8)
    harness.observe(segments)
    labels = perception.label_components(segments, MANY)
    largest = [perception.largest_label(labels, segments, instance) for instance in range(MANY)]
    assert harness.image("largest").tolist() == largest
    assert (np.array(largest) >= 0).sum() > 200
    for instance in np.flatnonzero(np.array(largest) >= 0):
        mask = labels == largest[instance]
        assert harness.result("visible", instance) == mask.sum()
        column, row = harness.result("pole", instance).astype(int)
        distance = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        assert distance[row + 1, column + 1] == distance.max()
        column, row = harness.result("grasp_pixel", instance)
        assert mask[row, column]
    assert not harness.observation.overflow.numpy().any()


def test_votes_among_many_instances_equal_the_reference(device):
    ids = mosaic(MANY, 300, 200, 2)
    depth = np.where(ids < 0, 2.5, 2.0 + 0.003 * (ids * 37 % MANY)).astype(np.float32)
    harness = PlannerHarness(device, [ids], [depth], MANY)
    votes = harness.votes()
    np.testing.assert_allclose(votes, planning.votes(harness, 10.0), rtol=1e-6)
    assert (votes[0] > 0).sum() > 300


# ---- target ----


def test_ancestors_of_all_words_count(device):
    """Instance i has i ancestors, the last ones."""
    harness = PlannerHarness(device, [EMPTY[0]], [EMPTY[1]], MANY)
    harness.observation.visible.fill_(1)
    harness.observation.visible_fraction.fill_(0.5)
    there = np.arange(MANY)[None, :] >= MANY - np.arange(MANY)[:, None]
    octets = np.packbits(np.pad(there, ((0, 0), (0, 32 * count_words(MANY) - MANY))), axis=1, bitorder="little")
    harness.observation.ancestors.assign(octets.view(np.uint32)[None])
    harness.worlds.begin(Phase.ACT)
    harness.attempts.attempt.fill_(-1)
    for mode, target in ((Mode.PICK, 0), (Mode.TARGET, MANY - 1)):
        harness.worlds.state.mode.fill_(mode)
        assert harness.choose() == [target]
