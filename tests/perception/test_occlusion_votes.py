"""Occlusion votes along contours of synthetic images, and the clutter graphs that follow from them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.codes import MAX_INSTANCES, Mode
from tests.twins import planning
from tests.twins.planning import PlannerHarness, mosaic, paint, paint_shapes

HIGH, LOW, LOWEST = 1.8, 1.9, 2.0


def harness_of(device, *pictures, instances: int = 5, **options) -> PlannerHarness:
    return PlannerHarness(device, [ids for ids, _ in pictures], [depth for _, depth in pictures], instances, **options)


# ---- votes ----


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


def test_votes_for_neighbours_below_the_grasp_point_have_little_weight(device):
    steep = paint_shapes(
        [
            (np.array([(20, 20), (59, 20), (59, 59), (20, 59)]), (0.002, 0.0, 1.9)),
            (np.array([(60, 10), (100, 10), (100, 70), (60, 70)]), (0.0, 0.0, 2.0)),
        ]
    )
    harness = harness_of(device, steep)
    # At the border the lower object has a depth of at least 2.012; the grasp point, near column 40, 1.98.
    for grasp_depth, weight in ((1.97, 0.1), (1.985, 1.0), (1.979, 0.1)):
        harness.observation.depth.assign(np.full((1, 5), grasp_depth))
        assert harness.votes()[0, 0, 1] == pytest.approx(40 * weight)


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


def test_neighbour_longer_than_its_reach_gets_no_vote(device):
    """From the middle of the bar its ends are 55 pixels away, 8 rows down."""
    picture = paint([(5, 20, 115, 49, LOW), (5, 50, 115, 60, HIGH)])
    farthest = np.hypot(55, 8)
    assert harness_of(device, picture, diagonal=reaching(farthest * 1.001)).votes()[0, 0, 1] == 1
    assert harness_of(device, picture, diagonal=reaching(farthest * 0.999)).votes()[0, 0, 1] == 0


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


def test_a_cycle_of_three_is_broken_at_its_weakest_edge(device):
    """Each bar passes under the next; the borders have different lengths."""
    size = {"height": 120, "width": 160}
    ids, depth = np.full(tuple(size.values()), -1), np.full(tuple(size.values()), 2.5, np.float32)

    def fill(i, left, top, right, bottom, z):
        ids[top : bottom + 1, left : right + 1], depth[top : bottom + 1, left : right + 1] = i, z

    # 1 over 0 along 40 pixels, 2 over 1 along 30, 0 over 2 along 20: each object has a high and a low part.
    fill(0, 10, 10, 60, 49, 1.90)
    fill(1, 61, 10, 100, 49, 1.88)
    fill(1, 71, 50, 100, 60, 1.92)
    fill(2, 71, 61, 100, 100, 1.90)
    fill(2, 50, 81, 70, 100, 1.90)
    fill(0, 10, 50, 20, 100, 1.86)
    fill(0, 21, 81, 49, 100, 1.86)
    harness = PlannerHarness(device, [ids], [depth], 3)
    votes = harness.votes()[0]
    assert votes[0, 1] > votes[1, 2] > votes[2, 0] >= 5
    edges, _ = harness.graph()
    np.testing.assert_array_equal(edges[0], [[False, True, False], [False, False, True], [False, False, False]])
