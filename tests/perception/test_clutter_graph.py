"""Clutter graph: edges from votes, minimum feedback arc sets, transitive closure; of few instances and of as many as eight words hold.
Occlusion votes along contours of synthetic images, and the graphs that follow from them."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.codes import MAX_INSTANCES, Mode
from synpick_warp.stages.arrays import count_words, unpack_words
from tests.twins import planning
from tests.twins.planning import PlannerHarness, mosaic, paint, paint_shapes

LEAST = planning.SETTINGS["min_votes"]
EXACT = planning.SETTINGS["exact_cycle"]
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


# ---- votes ----

HIGH, LOW, LOWEST = 1.8, 1.9, 2.0


def harness_of(device, *pictures, instances: int = 5, **options) -> PlannerHarness:
    return PlannerHarness(device, [ids for ids, _ in pictures], [depth for _, depth in pictures], instances, **options)


@pytest.mark.parametrize(
    ("rectangles", "expected"),
    [
        pytest.param([(20, 20, 49, 59, LOW), (50, 0, 90, 79, HIGH)], {(0, 1): 40}, id="a vote a point of the border, none beside nothing"),
        pytest.param(
            [(40, 20, 44, 59, LOW), (45, 10, 80, 69, HIGH), (5, 30, 39, 49, HIGH)],
            {(0, 1): 40, (0, 2): 20},
            id="the normals of the two sides of a part of five pixels are not confused",
        ),
    ],
)
def test_known_votes(device, rectangles, expected):
    votes = harness_of(device, paint(rectangles)).votes()[0]
    assert {pair: votes[pair] for pair in zip(*np.nonzero(votes), strict=True)} == expected


def test_part_thinner_than_the_offset_yields_too_few_votes(device):
    """Only its four corners, where the normal is oblique, yield votes: too few for an edge."""
    votes = harness_of(device, paint([(40, 20, 42, 59, LOW), (43, 10, 80, 69, HIGH)])).votes()[0]
    assert votes.max() < planning.SETTINGS["min_votes"]


def test_all_components_of_a_neighbour_get_votes_but_only_the_largest_own_contour_gives_them(device):
    """A bar splits the lower object in two, and another bar splits that bar in two."""
    picture = paint([(10, 30, 90, 60, LOWEST), (60, 10, 66, 80, LOW), (55, 44, 75, 46, HIGH)])
    harness = harness_of(device, picture)
    votes = harness.votes()[0]
    left_rows = 31 - 3
    # The bar's two components border on the left, larger component of the lower object in all its rows but three.
    assert harness.expected["contour"][0, 0, :, 0].max() < 60
    assert left_rows - 2 <= votes[0, 1] <= left_rows
    np.testing.assert_allclose(votes, planning.votes(harness, 10.0)[0], rtol=1e-6)


def test_objects_at_the_image_border(device):
    """Contour points at the image border yield no votes."""
    votes = harness_of(device, paint([(0, 0, 59, 89, LOW), (60, 0, 119, 89, HIGH)])).votes()[0]
    # Three rows at each end have a compared pixel outside the image, or oblique normals.
    assert 84 <= votes[0, 1] <= 90
    assert votes.sum() == votes[0, 1]


# ---- reach ----


def reaching(pixels: float, depth: float = HIGH) -> float:
    """Diagonal [m] of an object whose reach is `pixels` at the depth of its grasp point."""
    return pixels * depth / (planning.SETTINGS["reach"] * planning.FOCAL)


def test_points_vote_if_the_whole_neighbour_is_within_reach(device):
    """A bar of columns 5 to 115, rows 50 to 60, compared at row 52: column x votes if (115 - x)² + 8² and (x - 5)² + 8² are at most 70²."""
    picture = paint([(10, 20, 110, 49, LOW), (5, 50, 115, 60, HIGH)])
    assert harness_of(device, picture).votes()[0, 0, 1] == 101
    columns = np.arange(10, 111)
    expected = (np.hypot(np.maximum(columns - 5, 115 - columns), 8) <= 70).sum()
    assert expected == 29
    assert harness_of(device, picture, diagonal=reaching(70)).votes()[0, 0, 1] == expected


def test_small_neighbour_at_the_end_of_a_long_object_gets_votes(device):
    """Its diagonal is the visible one; the long object's grasp point is out of its reach, but the compared pixels are not."""
    shown = float(np.hypot(15, 40))
    harness = harness_of(device, paint([(10, 30, 95, 50, LOW), (85, 20, 100, 60, HIGH)]), diagonal=shown * HIGH / planning.FOCAL)
    column, row = harness.expected["grasp_pixel"][0, 0]
    assert np.hypot(100 - column, max(row - 20, 60 - row)) > planning.SETTINGS["reach"] * shown
    assert harness.votes()[0, 0, 1] == 21


def test_the_reach_drops_no_vote_of_piles_with_true_masks(device):
    """Rotated rectangles with their true diagonals; many have a grasp point out of reach."""
    numbers = np.random.default_rng(7)
    far = votes = 0
    for _ in range(8):
        sides, turns = numbers.uniform(12, 60, (8, 2)), numbers.uniform(0, np.pi, 8)
        depths, middles = 1.8 + 0.02 * numbers.permutation(8), numbers.uniform((30, 25), (90, 65), (8, 2))
        square = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
        turn = np.stack([[np.cos(turns), -np.sin(turns)], [np.sin(turns), np.cos(turns)]]).transpose(2, 0, 1)
        corners = ((square * sides[:, None]) @ turn.transpose(0, 2, 1) + middles[:, None]).round()
        diagonal = np.linalg.norm(sides, axis=1) * depths / planning.FOCAL
        harness = harness_of(
            device, paint_shapes([(c, (0.0, 0.0, z)) for c, z in zip(corners, depths, strict=True)]), instances=8, diagonal=diagonal
        )
        found = harness.votes()[0]
        np.testing.assert_allclose(found, planning.votes(harness, np.inf)[0], atol=1e-4)
        for i, j in np.argwhere(found >= planning.SETTINGS["min_votes"]):
            line = harness.expected["contour"][0, j, : harness.expected["contour_length"][0, j]]
            farthest = np.linalg.norm(line - harness.expected["grasp_pixel"][0, i], axis=1).max()
            far, votes = far + (farthest > planning.SETTINGS["reach"] * np.linalg.norm(sides[j])), votes + 1
    assert votes > 60
    assert far > 5


@settings(max_examples=40, deadline=None)
@given(
    points=st.lists(st.tuples(st.integers(0, 119), st.integers(0, 89)), min_size=1, max_size=300),
    column=st.integers(10, 110),
    more=st.sampled_from((-0.5, 0.5)),
)
def test_votes_within_reach_equal_the_reference_for_any_contour(device, points, column, more):
    """The reach is just below or above the distance of a compared pixel: the bounding box alone cannot decide."""
    harness = harness_of(device, paint([(10, 20, 110, 49, LOW), (5, 50, 115, 60, HIGH)]))
    line = np.array(points)
    square = ((line - (column, 52)) ** 2).sum(axis=1).max()
    diagonal = reaching(np.sqrt(max(square + more, 0.0)))
    harness.expected["contour"][0, 1, : len(line)], harness.expected["contour_length"][0, 1] = line, len(line)
    harness.arrays.contour.assign(harness.expected["contour"])
    harness.arrays.contour_length.assign(harness.expected["contour_length"])
    harness.worlds.scene.catalog.diagonal.fill_(diagonal)
    assert harness.votes()[0, 0, 1] == planning.votes(harness, diagonal)[0, 0, 1]


def test_neighbour_without_contour_points_is_within_reach(device):
    """An instance without a contour keeps its votes."""
    harness = harness_of(device, paint([(20, 20, 49, 59, LOW), (50, 0, 90, 79, HIGH)]), diagonal=1e-3)
    assert harness.votes()[0, 0, 1] == 0
    harness.arrays.contour_length.assign([[160, 0, 0, 0, 0]])
    assert harness.votes()[0, 0, 1] == 40


# ---- which views ----


def test_unused_views_write_nothing_and_others_clear_earlier_votes(device):
    picture = paint([(20, 20, 49, 59, LOW), (50, 0, 90, 79, HIGH)])
    harness = harness_of(device, picture, picture)
    harness.images.views.world.assign(np.array([-1, 0]))
    harness.observation.votes.fill_(7.0)
    votes = harness.votes()
    assert (votes[0].sum(), votes[0, 0, 1]) == (40, 40)
    assert (votes[1] == 7.0).all()
    harness.observation.above.fill_(3)
    harness.planner.order_clutter(harness.scene, harness.observation)
    assert harness.observation.above.numpy()[..., 0].tolist() == [[2, 0, 0, 0, 0], [3] * 5]


def test_votes_equal_the_reference(device):
    """Tilted, intersecting polygons."""
    numbers = np.random.default_rng(3)
    pictures = []
    for _ in range(12):
        shapes = []
        for _ in range(6):
            angle = np.sort(numbers.uniform(0, 2 * np.pi, 5))
            corners = numbers.uniform((25, 20), (95, 70)) + 30 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            slopes = numbers.uniform(-0.002, 0.002, 2)
            shapes.append((corners.round(), (*slopes, 2.0 - slopes @ (60, 45) + numbers.uniform(-0.03, 0.03))))
        pictures.append(paint_shapes(shapes))
    harness = harness_of(device, *pictures, instances=6, diagonal=0.9)
    expected = planning.votes(harness, 0.9)
    np.testing.assert_allclose(harness.votes(), expected, atol=1e-4)
    # The random images have full votes, deep votes and votes out of reach.
    assert (expected > 5).sum() > 30
    assert (expected % 1 > 0).sum() > 5
    assert (planning.votes(harness, 10.0) != expected).sum() > 5


def test_votes_among_many_instances_equal_the_reference(device):
    ids = mosaic(MAX_INSTANCES, 300, 200, 2)
    depth = np.where(ids < 0, 2.5, 2.0 + 0.003 * (ids * 37 % MAX_INSTANCES)).astype(np.float32)
    harness = PlannerHarness(device, [ids], [depth], MAX_INSTANCES)
    votes = harness.votes()
    np.testing.assert_allclose(votes, planning.votes(harness, 10.0), rtol=1e-6)
    assert (votes[0] > 0).sum() > 300


# ---- stacks ----


@pytest.mark.parametrize(
    ("rectangles", "above", "chosen"),
    [
        pytest.param([(20, 20, 80, 70, LOW), (40, 30, 60, 80, HIGH)], [{1}, set()], (1, 0), id="two"),
        # Only outer contours are followed, as in the paper.
        pytest.param([(20, 20, 80, 70, LOW), (40, 30, 60, 50, HIGH)], [set(), set()], (0, 1), id="one inside the outer contour"),
        # 0 lies on 2, which lies on 1; 0 does not touch 1.
        pytest.param(
            [(70, 30, 100, 60, HIGH), (10, 20, 40, 70, LOWEST), (30, 35, 80, 55, LOW)], [set(), {0, 2}, {0}], (0, 1), id="three in a row"
        ),
        # 0 and 4 lie side by side on plate 3, across its edge; 2 lies across both; 1 lies alone and is smaller than 2.
        pytest.param(
            [(10, 30, 35, 70, LOW), (95, 10, 110, 20, LOWEST), (20, 45, 70, 60, HIGH), (15, 40, 90, 85, LOWEST), (50, 30, 75, 70, LOW)],
            [{2}, set(), set(), {0, 2, 4}, {2}],
            (2, 3),
            id="five",
        ),
    ],
)
def test_known_stacks(device, rectangles, above, chosen):
    """What lies above each object, and the targets in the modes PICK and TARGET."""
    harness = harness_of(device, paint(rectangles), instances=len(rectangles))
    _, paths = harness.graph()
    assert [set(np.flatnonzero(row).tolist()) for row in paths[0]] == above
    for mode, target in zip((Mode.PICK, Mode.TARGET), chosen, strict=True):
        harness.worlds.state.mode.fill_(mode)
        assert harness.choose() == [target]
