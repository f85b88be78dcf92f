"""The drawn clutter graph: edges that run downward, and nothing that overlaps; hostile records are drawn, or their line is named. Scene
graphs of data sets: edges by forces and masks, the order, and what a bake's files say of them."""

import itertools
import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import synpick_warp
from synpick_warp.apps.validation.rules.cross_file import find_gap
from synpick_warp.apps.viz.drawing import instance_color
from synpick_warp.apps.viz.explain import draw_words, load_chart
from synpick_warp.apps.viz.explain_record import (
    CYCLIC,
    KEPT,
    MAX_ATTEMPTS,
    OUTVOTED,
    RADIUS,
    Edge,
    SeenAttempt,
    clutter_edges,
    draw_graph,
    lay_out,
    read_attempts,
)
from synpick_warp.configs.files.load import load_config
from synpick_warp.dataset.annotations import MAX_OBSERVED
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.scene import find_occlusions, find_supports, find_unstacking_order
from synpick_warp.exporters.writing.rle import Masks, find_runs
from tests.harness.charts import picture_of
from tests.harness.hostile import LEAVES, fuzz_examples, hostile_contents, places, removed, replaced
from tests.worlds.trajectories import attempt, record, seen, seen_object

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


# ---- hostile records ----


PILE = [seen_object(2, 7, (50, 38), above=[3], ancestors=[3]), seen_object(3, 7, (20, 30)), seen_object(5, 1, (70, 60))]
RECORD = record(PILE, observation={"resolution": [96, 72], "instances": PILE, "votes": [[2, 3, 12.0], [5, 3, 2.5]]})
CONFIG = load_config("smoke", {})
SECONDS = 5.0
VALUES = (
    st.sampled_from(LEAVES) | st.integers() | st.floats() | st.text(max_size=30) | st.lists(st.integers(0, 5) | st.floats(0, 9), max_size=4)
)


def draw(attempt: SeenAttempt) -> None:
    """Draw all panels that need no image."""
    draw_words(attempt, {7: "tin"}, (CONFIG.target, CONFIG.pick), CONFIG.suction)
    assert picture_of(load_chart(attempt, CONFIG.suction, CONFIG.physics.tick_time, 800, 200), 1.0).shape == (200, 800, 3)
    draw_graph(attempt, CONFIG.perception.min_votes, (500, 640))


def read_and_draw(folder: Path, line: bytes) -> None:
    (folder / "attempts.jsonl").write_bytes(line + b"\n")
    try:
        for attempt in read_attempts(folder, 0, None):
            draw(attempt)
    except DatasetError as error:
        assert str(error).isprintable()  # noqa: PT017


def test_the_record_itself_is_drawn(tmp_path):
    (tmp_path / "attempts.jsonl").write_text(json.dumps(RECORD) + "\n")
    [attempt] = read_attempts(tmp_path, 0, None)
    draw(attempt)
    assert len(clutter_edges(attempt, CONFIG.perception.min_votes)) > 0


@settings(max_examples=fuzz_examples(200), deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10**6), VALUES, st.booleans()), min_size=1, max_size=3))
def test_changed_records_are_drawn_or_named(tmp_path_factory, changes):
    content: Any = RECORD
    for spot, value, gone in changes:
        where = list(places(content))
        place = where[spot % len(where)]
        content = removed(content, place) if gone else replaced(content, place, value)
    read_and_draw(tmp_path_factory.getbasetemp(), json.dumps(content).encode())


@pytest.mark.parametrize("part", range(4))
def test_hostile_lines_are_drawn_or_named(tmp_path, part):
    for number, (_, content) in enumerate(hostile_contents(json.dumps(RECORD).encode())):
        if number % 16 == part:
            read_and_draw(tmp_path, content)


@pytest.mark.parametrize("point", [{"pole": [1e300, 3]}, {"grasp_pixel": [2**31 - 1, 3]}])
def test_a_point_outside_of_the_image_is_named(tmp_path, point):
    one = seen_object(2, 7, (50, 38), **point)
    (tmp_path / "attempts.jsonl").write_text(json.dumps(record([one])))
    with pytest.raises(DatasetError, match="line 1, is damaged: a point of instance 2 is not in the image of 96 x 72"):
        read_attempts(tmp_path, 0, None)


def test_a_graph_of_all_edges_ends(tmp_path):
    """More objects than a world can have are refused where they are read."""
    pile = [seen_object(index, 1, (index % 80, 30), above=list(range(index))) for index in range(MAX_OBSERVED + 1)]
    (tmp_path / "attempts.jsonl").write_text(json.dumps(record(pile)))
    with pytest.raises(DatasetError, match=f"expected array of length <= {MAX_OBSERVED}"):
        read_attempts(tmp_path, 0, None)
    (tmp_path / "attempts.jsonl").write_text(json.dumps(record(pile[:MAX_OBSERVED])))
    [attempt] = read_attempts(tmp_path, 0, None)
    started = time.monotonic()
    with pytest.raises(DatasetError, match="has too many edges to be drawn"):
        lay_out(attempt, clutter_edges(attempt, 1.0), (500, 640))
    assert time.monotonic() - started < SECONDS


def test_a_figure_has_a_limited_number_of_attempts(tmp_path):
    lines = [json.dumps(RECORD | {"attempt": number}) for number in range(MAX_ATTEMPTS + 1)]
    (tmp_path / "attempts.jsonl").write_text("\n".join(lines))
    with pytest.raises(DatasetError, match="has 101 attempts of episode 0; a figure has at most 100: name one by --attempt"):
        read_attempts(tmp_path, 0, None)
    assert len(read_attempts(tmp_path, 0, 100)) == 1


def test_a_list_of_many_episodes_is_shortened(tmp_path):
    lines = [json.dumps({"episode": 2 * number, "attempt": 0}) for number in range(1000)]
    (tmp_path / "attempts.jsonl").write_text("\n".join(lines))
    with pytest.raises(DatasetError, match=r"episodes that have: 0, 2, .*, 38, \.\.\.$"):
        read_attempts(tmp_path, 1, None)


# ---- scene graphs ----


@pytest.mark.parametrize(
    ("nodes", "edges", "order"),
    [
        (2, [(1, 0)], [[1], [0]]),
        (3, [(2, 0), (2, 1), (0, -1), (1, -1)], [[2], [0], [1]]),
        (4, [(0, 1), (1, 2), (2, 0), (3, 1)], [[3], [0, 1, 2]]),
        (3, [], [[0], [1], [2]]),
        (70, [(one, one - 1) for one in range(1, 70)], [[one] for one in range(69, -1, -1)]),
        (0, [], []),
    ],
    ids=["stack", "bridge", "cycle", "apart", "tower", "nothing"],
)
def test_nothing_is_taken_from_below(nodes, edges, order):
    assert find_unstacking_order(nodes, edges) == order


def test_support_edges_are_upward_forces_that_matter():
    """Instance 1 lies on 0 and 3, the latter without label; 2 is not there; 0 leans on 1 by a hundredth of its weight."""
    support = np.zeros((1, 4, 4), np.float32)
    support[0, 1, [0, 3]], support[0, [0, 3], 1] = [1.5, 0.5], [-1.5, -0.5]
    support[0, 0, 3] = 0.01
    static = np.array([[2.5, 0.0, 0.0, 1.0]], np.float32)
    batch = SimpleNamespace(object_id=np.array([[7, 8, -1, -2]]), tick={"support": support, "static_support": static})
    (found,) = find_supports(batch, {7: 1.0, 8: 2.0})
    assert found.nodes == 2
    np.testing.assert_allclose(found.edges, [[0, -1, 2.51], [1, 0, 1.5], [1, -1, 0.5]], rtol=1e-6)


def test_occlusions_are_common_pixels_of_the_images():
    """Of visible masks that share out the image and any amodal ones, against counts in the images; and of no objects."""
    rng = np.random.default_rng(0)
    ids = rng.integers(0, 5, (13, 17))
    amodal = [rng.random((13, 17)) < 0.4, np.zeros((13, 17), bool), np.ones((13, 17), bool), np.eye(13, 17, dtype=bool)]
    masks = [Masks(find_runs(other), find_runs(ids == 1 + index)) for index, other in enumerate(amodal)]
    pairs = [(a, b, int(((ids == 1 + a) & amodal[b]).sum())) for a in range(4) for b in range(4) if a != b and b != 1]
    assert find_occlusions(masks) == pairs
    assert find_occlusions([]) == []


def test_a_bake_tells_who_lies_on_whom(picked_set):
    """In every view: loads of what rests on the bin and on each other, and pixels that the masks confirm."""
    views, seen = list(synpick_warp.open(picked_set).views()), 0
    for view in views[:: max(1, len(views) // 12)]:
        assert sorted(index for component in view.order for index in component) == list(range(len(view)))
        hidden = (view.amodal_masks & ~view.masks).sum(axis=(1, 2))
        assert (view.occlusion.sum(axis=0) <= hidden).all()
        assert view.support.shape == (len(view), len(view) + 1)
        seen += int((view.support[:, -1] > 0.0).sum())
    assert seen > 5


def test_a_gap_is_that_of_the_nearest_sides():
    """Of two boxes: side above side, apart by a turn, and one in the other."""
    corners = np.array([[x, y, z] for x in (-10.0, 10.0) for y in (-5.0, 5.0) for z in (-2.0, 2.0)])
    box = (corners, np.concatenate((np.eye(3), -np.eye(3))))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for rotation, move, gap in ((np.eye(3), [1.0, 1.0, 7.0], 3.0), (turn, [18.0, 0.0, 0.0], 3.0), (np.eye(3), [1.0, 0.0, 0.0], -4.0)):
        assert find_gap(box, box, np.column_stack((100.0 * rotation, move))) == pytest.approx(gap)


def test_models_say_what_suction_needs(picked_set):
    infos = json.loads((picked_set / "models" / "models_info.json").read_text())
    box, cube = infos["1"], infos["2"]
    assert box["mass"] == pytest.approx(500.0 * 0.08 * 0.06 * 0.04)
    np.testing.assert_allclose(box["center_of_mass"], 0.0, atol=1e-3)
    assert box["inertia"][0] == pytest.approx(box["mass"] * (60.0**2 + 40.0**2) / 12.0, rel=1e-5)
    # The cup of 10 mm radius must lie within a side, whose edges it may reach.
    for info, sides in ((box, (80.0, 60.0, 40.0)), (cube, (50.0, 50.0, 50.0))):
        pairs = [(sides[0], sides[1]), (sides[1], sides[2]), (sides[0], sides[2])]
        expected, area = (2 * sum((a - cut) * (b - cut) for a, b in pairs) for cut in (20.0, 0.0))
        assert info["suctionable_area"] == pytest.approx(expected, rel=0.05)
        assert info["suctionable_fraction"] == pytest.approx(expected / area, rel=0.05)
