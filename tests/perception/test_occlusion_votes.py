"""Votes along contours: who lies above whom in images made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.twins import planning
from tests.twins.planning import Looks, paint, paint_shapes

HIGH, LOW, LOWEST = 1.8, 1.9, 2.0


def looks(device, *pictures, instances: int = 5, **more) -> Looks:
    return Looks(device, [ids for ids, _ in pictures], [depth for _, depth in pictures], instances, **more)


# ---- votes ----


def test_a_nearer_neighbour_gets_a_vote_for_every_point_of_the_border(device):
    """Rows 20 to 59 of the lower one end at the upper one; where it ends at nothing, nobody votes."""
    votes = looks(device, paint([(20, 20, 49, 59, LOW), (50, 0, 90, 79, HIGH)])).votes()[0]
    expected = np.zeros((5, 5))
    expected[0, 1] = 40
    np.testing.assert_array_equal(votes, expected)


def test_neighbours_on_both_sides_of_a_thin_part_get_their_own_votes(device):
    """Five pixels wide: the two sides' normals must not be taken for each other."""
    votes = looks(device, paint([(40, 20, 44, 59, LOW), (45, 10, 80, 69, HIGH), (5, 30, 39, 49, HIGH)])).votes()[0]
    np.testing.assert_array_equal(votes[0, :3], [0, 40, 20])
    assert (votes[1:] == 0).all()


def test_too_thin_a_part_has_no_inside(device):
    """Its four corners, where the normal leans along it, are not enough for an edge."""
    votes = looks(device, paint([(40, 20, 42, 59, LOW), (43, 10, 80, 69, HIGH)])).votes()[0]
    assert votes.max() < planning.SIGHT["min_votes"]


def test_all_pieces_of_a_neighbour_vote_but_only_the_largest_of_ones_own_is_asked(device):
    """A bar cuts the lower object in two, and another bar cuts that bar in two."""
    picture = paint([(10, 30, 90, 60, LOWEST), (60, 10, 66, 80, LOW), (55, 44, 75, 46, HIGH)])
    made = looks(device, picture)
    votes = made.votes()[0]
    left_rows = 31 - 3
    # The bar's two pieces border on the left, larger piece of the lower one in all its rows but three.
    assert made.found["contour"][0, 0, :, 0].max() < 60
    assert left_rows - 2 <= votes[0, 1] <= left_rows
    np.testing.assert_allclose(votes, planning.votes(made, 10.0)[0], rtol=1e-6)


def test_objects_at_the_image_border(device):
    """What lies outside the image votes for nobody."""
    votes = looks(device, paint([(0, 0, 59, 89, LOW), (60, 0, 119, 89, HIGH)])).votes()[0]
    # Three rows at each end have a neighbouring pixel outside, or tilted normals.
    assert 84 <= votes[0, 1] <= 90
    assert votes.sum() == votes[0, 1]


def test_neighbours_lower_than_the_suction_point_weigh_little(device):
    steep = paint_shapes(
        [
            (np.array([(20, 20), (59, 20), (59, 59), (20, 59)]), (0.002, 0.0, 1.9)),
            (np.array([(60, 10), (100, 10), (100, 70), (60, 70)]), (0.0, 0.0, 2.0)),
        ]
    )
    made = looks(device, steep)
    # At the border the lower one has depth 2.012 or more; the suction point, about column 40, has 1.98.
    for suction, weight in ((1.97, 0.1), (1.985, 1.0), (1.979, 0.1)):
        made.sighting.depth.assign(np.full((1, 5), suction))
        assert made.votes()[0, 0, 1] == pytest.approx(40 * weight)


# ---- reach ----


def reaching(pixels: float, depth: float = HIGH) -> float:
    """Diagonal [m] of what may reach so many pixels, its suction point having that depth."""
    return pixels * depth / (planning.SIGHT["reach"] * planning.FOCAL)


def test_a_contour_votes_where_all_of_the_neighbour_is_in_reach(device):
    """A bar of columns 5 to 115, rows 50 to 60, compared from row 52: x votes if (115 - x)² + 8² and (x - 5)² + 8² are at most 70²."""
    picture = paint([(10, 20, 110, 49, LOW), (5, 50, 115, 60, HIGH)])
    assert looks(device, picture).votes()[0, 0, 1] == 101
    columns = np.arange(10, 111)
    expected = (np.hypot(np.maximum(columns - 5, 115 - columns), 8) <= 70).sum()
    assert expected == 29
    assert looks(device, picture, diagonal=reaching(70)).votes()[0, 0, 1] == expected


def test_a_neighbour_too_long_for_its_diagonal_has_no_vote(device):
    """From the middle of the bar its ends are 55 pixels away, 8 rows down."""
    picture = paint([(5, 20, 115, 49, LOW), (5, 50, 115, 60, HIGH)])
    farthest = np.hypot(55, 8)
    assert looks(device, picture, diagonal=reaching(farthest * 1.001)).votes()[0, 0, 1] == 1
    assert looks(device, picture, diagonal=reaching(farthest * 0.999)).votes()[0, 0, 1] == 0


def test_a_small_thing_at_the_end_of_a_long_one_votes(device):
    """Its diagonal is the one that it shows; from the long one's suction point it is out of reach."""
    shown = float(np.hypot(15, 40))
    made = looks(device, paint([(10, 30, 95, 50, LOW), (85, 20, 100, 60, HIGH)]), diagonal=shown * HIGH / planning.FOCAL)
    column, row = made.found["suction"][0, 0]
    assert np.hypot(100 - column, max(row - 20, 60 - row)) > planning.SIGHT["reach"] * shown
    assert made.votes()[0, 0, 1] == 21


def test_piles_of_true_masks_keep_every_vote(device):
    """Turned rectangles with the diagonals that they have, many of them out of reach of a suction point."""
    numbers = np.random.default_rng(7)
    far = votes = 0
    for _ in range(8):
        sides, turns = numbers.uniform(12, 60, (8, 2)), numbers.uniform(0, np.pi, 8)
        depths, middles = 1.8 + 0.02 * numbers.permutation(8), numbers.uniform((30, 25), (90, 65), (8, 2))
        square = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
        turn = np.stack([[np.cos(turns), -np.sin(turns)], [np.sin(turns), np.cos(turns)]]).transpose(2, 0, 1)
        corners = ((square * sides[:, None]) @ turn.transpose(0, 2, 1) + middles[:, None]).round()
        diagonal = np.linalg.norm(sides, axis=1) * depths / planning.FOCAL
        made = looks(
            device, paint_shapes([(c, (0.0, 0.0, z)) for c, z in zip(corners, depths, strict=True)]), instances=8, diagonal=diagonal
        )
        found = made.votes()[0]
        np.testing.assert_allclose(found, planning.votes(made, np.inf)[0], atol=1e-4)
        for i, j in np.argwhere(found >= planning.SIGHT["min_votes"]):
            line = made.found["contour"][0, j, : made.found["contour_length"][0, j]]
            farthest = np.linalg.norm(line - made.found["suction"][0, i], axis=1).max()
            far, votes = far + (farthest > planning.SIGHT["reach"] * np.linalg.norm(sides[j])), votes + 1
    assert votes > 60
    assert far > 5


@settings(max_examples=40, deadline=None)
@given(
    points=st.lists(st.tuples(st.integers(0, 119), st.integers(0, 89)), min_size=1, max_size=300),
    column=st.integers(10, 110),
    more=st.sampled_from((-0.5, 0.5)),
)
def test_votes_in_reach_are_the_twins_whatever_the_contour(device, points, column, more):
    """The reach is just below or above what one of the compared pixels needs: a box alone cannot tell."""
    made = looks(device, paint([(10, 20, 110, 49, LOW), (5, 50, 115, 60, HIGH)]))
    line = np.array(points)
    square = ((line - (column, 52)) ** 2).sum(axis=1).max()
    diagonal = reaching(np.sqrt(max(square + more, 0.0)))
    made.found["contour"][0, 1, : len(line)], made.found["contour_length"][0, 1] = line, len(line)
    made.look.contour.assign(made.found["contour"])
    made.look.contour_length.assign(made.found["contour_length"])
    made.worlds.scene.catalog.diagonal.fill_(diagonal)
    assert made.votes()[0, 0, 1] == planning.votes(made, diagonal)[0, 0, 1]


def test_a_contour_without_points_is_in_reach(device):
    """What had no room for its contour keeps its votes."""
    made = looks(device, paint([(20, 20, 49, 59, LOW), (50, 0, 90, 79, HIGH)]), diagonal=1e-3)
    assert made.votes()[0, 0, 1] == 0
    made.look.contour_length.assign([[160, 0, 0, 0, 0]])
    assert made.votes()[0, 0, 1] == 40


# ---- which views ----


def test_unused_views_write_nothing(device):
    picture = paint([(20, 20, 49, 59, LOW), (50, 0, 90, 79, HIGH)])
    made = looks(device, picture, picture)
    made.look.world.assign(np.array([-1, 0]))
    made.sighting.votes.fill_(7.0)
    votes = made.votes()
    assert votes[0, 0, 1] == 40
    assert (votes[1] == 7.0).all()
    made.sighting.above.fill_(3)
    made.planner.order_clutter(made.scene, made.seen, made.sighting)
    assert made.sighting.above.numpy().tolist() == [[2, 0, 0, 0, 0], [3] * 5]


def test_votes_of_an_earlier_look_are_gone(device):
    made = looks(device, paint([(20, 20, 49, 59, LOW), (50, 0, 90, 79, HIGH)]))
    np.testing.assert_array_equal(made.votes().copy(), made.votes())


def test_votes_are_the_twins(device):
    """Tilted polygons that pass through each other."""
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
    made = looks(device, *pictures, instances=6, diagonal=0.9)
    expected = planning.votes(made, 0.9)
    np.testing.assert_allclose(made.votes(), expected, atol=1e-4)
    # The draw has full votes, deep votes and votes out of reach.
    assert (expected > 5).sum() > 30
    assert (expected % 1 > 0).sum() > 5
    assert (planning.votes(made, 10.0) != expected).sum() > 5


# ---- stacks ----


def order_of(device, picture, instances: int) -> tuple[Looks, list[set[int]]]:
    made = looks(device, picture, instances=instances)
    _, paths = made.graph()
    return made, [set(np.flatnonzero(row).tolist()) for row in paths[0]]


def choices(made: Looks) -> tuple[int, int]:
    """What picking and targeted picking choose."""
    chosen = []
    for mode in (1, 2):
        made.worlds.state.mode.fill_(mode)
        chosen.append(made.choose()[0])
    return tuple(chosen)


def test_a_stack_of_two(device):
    made, above = order_of(device, paint([(20, 20, 80, 70, LOW), (40, 30, 60, 80, HIGH)]), 2)
    assert above == [{1}, set()]
    assert choices(made) == (1, 0)


def test_what_lies_within_an_outline_is_no_obstacle(device):
    """Outer contours alone are asked, as in the source: an object that lies on the middle of a larger one has no vote."""
    made, above = order_of(device, paint([(20, 20, 80, 70, LOW), (40, 30, 60, 50, HIGH)]), 2)
    assert above == [set(), set()]
    assert choices(made) == (0, 1)


def test_a_stack_of_three_in_a_row(device):
    """0 on 2 on 1; 0 does not touch 1."""
    made, above = order_of(device, paint([(70, 30, 100, 60, HIGH), (10, 20, 40, 70, LOWEST), (30, 35, 80, 55, LOW)]), 3)
    assert above == [set(), {0, 2}, {0}]
    assert choices(made) == (0, 1)


def test_a_stack_of_five(device):
    """A plate 3, on it 0 and 4 side by side, over its edge; across both of them 2; 1 lies alone, small."""
    plate, across, alone = (15, 40, 90, 85, LOWEST), (20, 45, 70, 60, HIGH), (95, 10, 110, 20, LOWEST)
    made, above = order_of(device, paint([(10, 30, 35, 70, LOW), alone, across, plate, (50, 30, 75, 70, LOW)]), 5)
    assert above == [{2}, set(), set(), {0, 2, 4}, {2}]
    # Nothing is above 1 and 2; 2 shows more.
    assert choices(made) == (2, 3)


def test_a_ring_of_three_is_opened_at_its_weakest_border(device):
    """Each bar passes under the next, the borders being of different lengths."""
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
    made = Looks(device, [ids], [depth], 3)
    votes = made.votes()[0]
    assert votes[0, 1] > votes[1, 2] > votes[2, 0] >= 5
    edges, _ = made.graph()
    np.testing.assert_array_equal(edges[0], [[False, True, False], [False, False, True], [False, False, False]])
