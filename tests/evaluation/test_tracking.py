"""Tracking over time: association of estimates, the paper's filter on analytic trajectories, and the sweep of its weight. Charts: what is
drawn where, gaps, legends, files; refused input; and that no data or name breaks the drawing."""

import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from synpick_warp.apps.evaluation import tracking
from synpick_warp.apps.evaluation.figures import (
    plot_error,
    plot_recall,
    plot_sweep,
    plot_trajectory,
    write_figures,
)
from synpick_warp.apps.evaluation.tracking import filter_poses, find_tracks, sweep_alpha, track_of_instance
from synpick_warp.apps.evaluation.truth import PoseTable
from synpick_warp.errors import ConfigError, DatasetError, OutputError
from synpick_warp.system.codecs import charts
from synpick_warp.system.codecs.charts import INK, PALETTE, SCALE, Legend, axis, chart, panel, points, printable, render_charts
from tests.harness.charts import near, picture_of, tick_texts
from tests.harness.hostile import fuzz_examples
from tests.worlds.evaluation_set import FRAME, Motion, estimates, noisy_tables, true_poses

ALPHAS = (0.05, 0.2, 0.5, 0.9)


# ---- tracks ----


def purity(tracks: np.ndarray, truth: np.ndarray) -> float:
    """Fraction of rows whose true instance is their track's most frequent one."""
    return sum(np.bincount(truth[tracks == track]).max() for track in np.unique(tracks)) / len(tracks)


def test_a_single_instance_is_one_track_whatever_its_jumps_and_gaps():
    table = estimates(true_poses(Motion(velocity=(0.5, 0, 0))), noise=0.05, outliers=0.3, jump=2.0, missing=0.5)
    assert (find_tracks(table) == 0).all()


def test_tracks_are_sorted_by_scene_object_and_first_image():
    third = Motion(scene=1, object_id=3)
    table = true_poses(Motion(scene=2), Motion(scene=1, object_id=5), third, dataclasses.replace(third, start=(1, 0, 1)))
    tracks = find_tracks(table)
    keys = [(int(table.scene[tracks == one][0]), int(table.object_id[tracks == one][0])) for one in range(4)]
    assert keys == [(1, 3), (1, 3), (1, 5), (2, 17)]
    assert np.bincount(tracks).tolist() == [100] * 4


@pytest.mark.parametrize(
    ("first", "second", "outlier"),
    [
        (Motion(start=(-0.2, 0.0, 2), velocity=(0.06, 0, 0)), Motion(start=(0.2, 0.1, 2), velocity=(-0.06, 0, 0), instance=1), None),
        (Motion(start=(0, 0, 2)), Motion(start=(0.1, 0, 2), instance=1), [0.5, 0, 2]),
        (Motion(start=(0, 0, 2), images=30), Motion(start=(0.2, 0, 2), instance=1), None),
    ],
    ids=["they pass each other", "an outlier of one next to the other", "one is picked"],
)
def test_instances_of_an_object_keep_their_tracks(first, second, outlier):
    truth = true_poses(first, second)
    hidden = dataclasses.replace(truth, instance=np.full(len(truth), -1), translation=truth.translation.copy())
    if outlier:
        hidden.translation[(truth.image == 50) & (truth.instance == 0)] = outlier
    assert purity(find_tracks(hidden), truth.instance) == 1.0


def test_the_choice_of_axes_does_not_matter_among_crowded_instances():
    crowd = true_poses(*(Motion(start=(0.05 * instance, 0, 2), instance=instance, images=60) for instance in range(4)))
    table = estimates(crowd, noise=0.05)
    turn = Rotation.from_rotvec([0.4, -0.7, 1.1])
    turned = dataclasses.replace(table, translation=turn.apply(table.translation))
    np.testing.assert_array_equal(find_tracks(turned), find_tracks(table))


def test_known_instances_are_tracks_though_they_change_places():
    truth = true_poses(Motion(start=(0, 0, 2)), Motion(start=(0.2, 0, 2), instance=1))
    swapped = dataclasses.replace(truth, translation=np.where((truth.image % 2 == 0)[:, None], truth.translation, 2.0 - truth.translation))
    np.testing.assert_array_equal(find_tracks(swapped), truth.instance)


def test_two_estimates_of_an_image_are_never_one_track_even_if_equal():
    once = true_poses(Motion(images=5))
    twice = once.select(np.repeat(np.arange(5), 2))
    for known in (0, -1):
        tracks = find_tracks(dataclasses.replace(twice, instance=np.full(10, known)))
        assert sorted(tracks[:2]) == [0, 1]
        assert np.bincount(tracks).tolist() == [5, 5]


def test_the_track_of_a_true_instance_is_the_one_most_often_nearest():
    truth = true_poses(Motion(start=(0, 0, 2)), Motion(start=(0.2, 0, 2), instance=1), Motion(scene=2), Motion(object_id=3))
    table = estimates(truth, noise=0.02, outliers=0.1, missing=0.2)
    tracks = find_tracks(table)
    for instance in range(2):
        one = truth.select((truth.scene == 1) & (truth.object_id == 17) & (truth.instance == instance))
        rows = track_of_instance(one, table, tracks)
        assert (table.scene[rows] == 1).all()
        assert (table.object_id[rows] == 17).all()
        assert (np.diff(table.image[rows]) > 0).all()
        np.testing.assert_allclose(np.median(table.translation[rows], axis=0), one.translation[0], atol=0.01)
        shuffled = np.random.default_rng(0).permutation(len(table))
        np.testing.assert_array_equal(shuffled[track_of_instance(one, table.select(shuffled), tracks[shuffled])], rows)
    gone = dataclasses.replace(one, object_id=one.object_id + 100)
    assert len(track_of_instance(gone, table, tracks)) == 0


@given(noisy_tables())
@settings(max_examples=fuzz_examples(100), deadline=None)
def test_fuzz_tracks_never_mix_scenes_objects_or_instances_nor_hold_two_rows_of_an_image(table):
    """A group has as many tracks as its fullest image."""
    tracks = find_tracks(table)
    assert sorted(np.unique(tracks)) == list(range(len(np.unique(tracks))))
    key = np.stack((table.scene, table.object_id, table.instance), axis=1)
    for track in np.unique(tracks):
        rows = tracks == track
        assert len(np.unique(key[rows], axis=0)) == 1
        assert len(np.unique(table.image[rows])) == rows.sum()
    for group in np.unique(key, axis=0):
        rows = (key == group).all(axis=1)
        assert len(np.unique(tracks[rows])) == np.bincount(table.image[rows]).max()


# ---- filter ----


def with_rotations(table: PoseTable, rotation: Rotation) -> PoseTable:
    return dataclasses.replace(table, rotation=rotation.as_matrix())


def angles(first: PoseTable, second: PoseTable) -> np.ndarray:
    """Angle between the rotations of two tables, row by row [rad]."""
    return (Rotation.from_matrix(first.rotation).inv() * Rotation.from_matrix(second.rotation)).magnitude()


def by_hand(table: PoseTable, alpha: float) -> tuple[np.ndarray, Rotation]:
    """The paper's formulas as they stand, with SciPy's slerp, on the rows of one track."""
    turns = Rotation.from_matrix(table.rotation)
    mean, turn = [table.translation[0]], [turns[0]]
    for row in range(1, len(table)):
        mean.append((1 - alpha) * mean[-1] + alpha * table.translation[row])
        turn.append(Slerp([0.0, 1.0], Rotation.concatenate([turn[-1], turns[row]]))(alpha))
    return np.array(mean), Rotation.concatenate(turn)


def test_alpha_is_the_papers_and_weighs_the_new_estimate():
    assert tracking.PAPER_ALPHAS == (0.05, 0.2)
    table = dataclasses.replace(true_poses(Motion(images=2)), translation=np.array([[0.0, 0, 1], [1.0, 0, 1]]))
    assert filter_poses(table).translation[1, 0] == pytest.approx(0.05)


@pytest.mark.parametrize("alpha", ALPHAS)
def test_the_filter_is_the_recursion_of_the_paper(alpha):
    table = estimates(true_poses(Motion(velocity=(0.1, 0, -0.2), spin=(0, 0.3, 0.9))), noise=0.01, angle=0.2, outliers=0.1, missing=0.2)
    mean, turn = by_hand(table, alpha)
    filtered = filter_poses(table, alpha)
    np.testing.assert_allclose(filtered.translation, mean, atol=1e-13)
    np.testing.assert_allclose(filtered.rotation, turn.as_matrix(), atol=1e-9)


def test_rotations_take_the_shorter_arc_and_half_a_turn_ends_halfway_on_either():
    two = true_poses(Motion(images=2))
    turns = (Rotation.from_euler("z", [[first], [-first]], degrees=True) for first in (10.0, 170.0))
    halves = [filter_poses(with_rotations(two, turn), 0.5).rotation[1] for turn in turns]
    np.testing.assert_allclose(halves, Rotation.from_euler("z", [[0.0], [180.0]], degrees=True).as_matrix(), atol=1e-12)
    table = with_rotations(two, Rotation.from_euler("z", [[0.0], [180.0]], degrees=True))
    assert np.degrees(angles(filter_poses(table, 0.5), table)) == pytest.approx([0.0, 90.0])


def test_alpha_one_changes_nothing_and_all_else_stays():
    """The input is not written to, and a table without rows stays empty."""
    table = estimates(true_poses(Motion(spin=(1, 2, 3)), Motion(object_id=4)), noise=0.1, angle=1.0, missing=0.1)
    for name in ("translation", "rotation"):
        getattr(table, name).setflags(write=False)
    filtered = filter_poses(table, 1.0)
    np.testing.assert_array_equal(filtered.translation, table.translation)
    np.testing.assert_allclose(filtered.rotation, table.rotation, atol=1e-12)
    for name in ("scene", "image", "object_id", "score", "seconds", "instance"):
        np.testing.assert_array_equal(getattr(filter_poses(table, 0.05), name), getattr(table, name))
    empty = table.select(np.zeros(len(table), bool))
    assert len(filter_poses(empty)) == len(find_tracks(empty)) == 0


@pytest.mark.parametrize("alpha", [0.0, -0.1, 1.0001, float("nan"), float("inf")])
def test_an_alpha_out_of_range_is_refused(alpha):
    with pytest.raises(ConfigError, match=r"^alpha .* is not allowed: .* above 0 and at most 1"):
        filter_poses(true_poses(Motion()), alpha)


NOT_FINITE = r"^the pose of scene 1, image 42, object 17 is not finite"


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("translation", np.nan, NOT_FINITE),
        ("rotation", np.inf, NOT_FINITE),
        ("translation", 1e300, NOT_FINITE),
        ("rotation", 7.0, NOT_FINITE),
        ("rotation", np.diag([1.0, 1.0, -1.0]), "^matrix 42 of the estimates is no rotation"),
    ],
)
def test_a_pose_that_is_none_is_refused_with_its_place(name, value, said):
    table = true_poses(Motion())
    getattr(table, name)[42] = value
    with pytest.raises(DatasetError, match=said):
        filter_poses(table)


@given(noisy_tables(), st.floats(0.01, 1.0), st.integers(0, 2**31))
@settings(max_examples=fuzz_examples(100), deadline=None)
def test_fuzz_the_order_of_rows_does_not_matter(table, alpha, seed):
    shuffled = np.random.default_rng(seed).permutation(len(table))
    straight, mixed = filter_poses(table, alpha), filter_poses(table.select(shuffled), alpha)
    np.testing.assert_array_equal(mixed.image, table.image[shuffled])
    np.testing.assert_allclose(mixed.translation, straight.translation[shuffled], atol=1e-12)
    np.testing.assert_allclose(mixed.rotation, straight.rotation[shuffled], atol=1e-9)


@given(noisy_tables(), st.floats(0.01, 1.0))
@settings(max_examples=fuzz_examples(50), deadline=None)
def test_fuzz_scenes_and_objects_are_filtered_as_if_alone(table, alpha):
    filtered = filter_poses(table, alpha)
    for scene, object_id in {(int(a), int(b)) for a, b in zip(table.scene, table.object_id, strict=True)}:
        rows = (table.scene == scene) & (table.object_id == object_id)
        alone = filter_poses(table.select(rows), alpha)
        np.testing.assert_allclose(filtered.translation[rows], alone.translation, atol=1e-12)
        np.testing.assert_allclose(filtered.rotation[rows], alone.rotation, atol=1e-9)


@given(noisy_tables(), st.floats(0.01, 1.0), st.integers(0, 2**31))
@settings(max_examples=fuzz_examples(50), deadline=None)
def test_fuzz_a_rigid_change_of_the_camera_frame_commutes_with_the_filter(table, alpha, seed):
    # Equivariance: positions are averaged linearly, rotations by the angle between them, whatever the axes.
    turn, shift = Rotation.random(rng=np.random.default_rng(seed)).as_matrix(), np.array([0.3, -0.1, 0.7])
    moved = dataclasses.replace(table, rotation=turn @ table.rotation, translation=table.translation @ turn.T + shift)
    straight, after = filter_poses(table, alpha), filter_poses(moved, alpha)
    np.testing.assert_allclose(after.translation, straight.translation @ turn.T + shift, atol=1e-9)
    np.testing.assert_allclose(after.rotation, turn @ straight.rotation, atol=1e-6)


# ---- sweep ----


def accuracy(truth: PoseTable, table: PoseTable) -> float:
    """Minus the mean squared position error [m²], after the first 100 images."""
    return -float(np.mean((table.translation - truth.translation)[truth.image >= 100] ** 2))


def test_at_rest_the_smallest_alpha_is_best_and_in_motion_the_one_of_least_noise_and_lag():
    noise, velocity = 0.01, 0.02
    rest = true_poses(*(Motion(scene=scene, images=300) for scene in range(20)))
    moving = true_poses(*(Motion(scene=scene, images=300, velocity=(velocity,) * 3) for scene in range(20)))
    tables = {"pick": estimates(rest, noise=noise), "move": estimates(moving, noise=noise)}
    alphas = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0])
    truths = {"pick": rest, "move": moving}
    sweep = sweep_alpha(tables, lambda mode, table: accuracy(truths[mode], table), alphas.tolist())
    expected = noise**2 * alphas / (2 - alphas) + (velocity * FRAME * (1 - alphas) / alphas) ** 2
    np.testing.assert_allclose(-sweep.scores[1], expected, rtol=0.1)
    assert sweep.best("pick")[0] == 0.02
    assert sweep.best("move")[0] == alphas[np.argmin(expected)] == 0.3
    np.testing.assert_allclose(sweep.scores[:, -1], sweep.unfiltered)


def test_sweeps_choose_the_largest_of_equal_weights_also_for_modes_without_estimates():
    table = true_poses(*(Motion(scene=scene, images=3) for scene in (4, 5, 6)))
    parts = tracking.split_by_mode(table, {6: "pick", 5: "move", 4: "pick", 9: "target"})
    assert list(parts) == ["pick", "move", "target"]
    assert [np.unique(part.scene).tolist() for part in parts.values()] == [[4, 6], [5], []]
    sweep = sweep_alpha(parts, lambda mode, table: len(table))
    assert sweep.alphas == tracking.SWEEP_ALPHAS
    assert sweep.best("pick") == (1.0, 6.0)
    assert sweep.scores.tolist() == [[count] * len(tracking.SWEEP_ALPHAS) for count in (6.0, 3.0, 0.0)]


# ---- charts ----

WIDTH, LEFT, RIGHT, BOTTOM = 1400, 171, 1380, 103
"""Width of a plot, and edges of its panels [px]; the lower edge is counted from the bottom of the image."""
RED = PALETTE[1]


def rows_at(picture: np.ndarray, column: float, color: str, panel: int) -> np.ndarray:
    """Heights of the pixels of a colour in one column of the lowest panel: 0 at the lower edge, 1 at the upper."""
    rows = np.flatnonzero(near(picture, color)[:, round(column)])
    return (len(picture) - BOTTOM - 0.5 - rows) / panel


def one_line(x: np.ndarray, y: np.ndarray, end: float, low: float, high: float, width: float = 2.0) -> np.ndarray:
    """Picture of a red line on axes from 0 to `end` and from `low` to `high`, in a panel of 400 px."""
    layer = points(charts.line(width, {"value": RED}), low, high, y, x=x)
    return picture_of(chart(axis("x", "x", 0.0, end), [panel(axis("y", "y", low, high), 200, [layer])]))


def test_lines_are_where_the_axes_say():
    x = np.linspace(0.0, 10.0, 50)
    picture = one_line(x, 0.1 * x - 0.5, 10.0, -1.0, 1.0)
    assert picture.shape[1:] == (WIDTH, 3)
    for fraction in (0.2, 0.5, 0.9):
        heights = rows_at(picture, LEFT + fraction * (RIGHT - LEFT), RED, 400)
        assert heights.mean() == pytest.approx(0.25 + 0.5 * fraction, abs=0.006)


def test_nan_breaks_a_line_and_what_is_outside_is_clipped():
    picture = one_line(np.arange(5.0), np.array([0.5, 0.5, np.nan, 0.5, 1e300]), 4.0, 0.0, 1.0)
    drawn = near(picture, RED).any(axis=0)
    columns = LEFT + np.array([0.5, 1.5, 2.5, 3.0]) / 4 * (RIGHT - LEFT)
    assert drawn[columns.round().astype(int)].tolist() == [True, False, False, True]
    assert not near(picture, RED)[: len(picture) - BOTTOM - 402].any()
    # A single point between breaks is a dot.
    picture = one_line(np.arange(3.0), np.array([np.nan, 0.5, np.nan]), 2.0, 0.0, 1.0, width=3.0)
    assert near(picture, RED)[:, (LEFT + RIGHT) // 2].sum() >= 5


@given(st.floats(-1e6, 1e6), st.floats(1e-4, 1e6), st.integers(2, 12))
@settings(max_examples=fuzz_examples(30), deadline=None)
def test_fuzz_ticks_are_few_round_and_inside(low, span, count):
    high = low + span
    if high - low < 1e-6 * max(abs(low), abs(high)):
        return
    layer = points(charts.line(1.0, {"value": RED}), low, high, [low], x=[0.0])
    y = axis("y", None, low, high, tickCount=count)
    texts = tick_texts(chart(axis("x", None, 0.0, 1.0, labels=False), [panel(y, 600, [layer])]))
    values = np.array([float(text.replace(",", "").replace("−", "-")) for text in texts])
    assert len(texts) <= 1.6 * count + 1
    assert (values >= low - 1e-5 * span).all()
    assert (values <= high + 1e-5 * span).all()
    assert len(set(texts)) == len(texts)
    assert not {"−0", "−0.0", "−0.00"} & set(texts)


def test_recall_is_the_fraction_of_errors_up_to_the_threshold():
    errors = np.array([0.02] * 30 + [0.06] * 20 + [np.inf] * 50)
    picture = picture_of(plot_recall({"method": errors}, "ADD"))
    for threshold, recall in ((0.01, 0.0), (0.04, 0.3), (0.08, 0.5)):
        heights = rows_at(picture, LEFT + threshold / 0.1 * (RIGHT - LEFT), PALETTE[0], 600)
        assert heights.mean() == pytest.approx(recall, abs=0.01)


@pytest.mark.parametrize("missing", [3, 12])
def test_trajectories_bridge_short_gaps_and_leave_long_ones_open(missing):
    truth = true_poses(Motion(images=101))
    table = truth.select((truth.image <= 50) | (truth.image > 50 + missing))
    shifted = filter_poses(table, 1.0)
    shifted.translation[:] += [0.1, 0.1, 0.1]
    picture = picture_of(plot_trajectory(truth, table, {"Filter": shifted}))
    column = LEFT + (50.5 + missing / 2) / 100 * (RIGHT - LEFT)
    assert bool(len(rows_at(picture, column, PALETTE[0], 300))) is (missing == 3)
    assert len(rows_at(picture, column, INK, 300))


def test_pick_attempts_are_marked_in_red_and_the_legend_names_all():
    truth = true_poses(Motion(images=101))
    plain, marked = (picture_of(plot_trajectory(truth, truth, {}, attempts=attempts)) for attempts in ([], [25, 75]))
    assert not near(plain, "#c82828").any()
    # One disc for each attempt in the upper panel, and one in the legend.
    count, _ = cv2.connectedComponents(near(marked, "#c82828").astype(np.uint8))
    assert count - 1 == 3


def test_a_trajectory_is_of_one_track_whatever_the_order_of_its_rows():
    truth = true_poses(Motion(images=40, velocity=(0.1, 0, 0)))
    table = estimates(truth, noise=0.01, missing=0.1)
    shuffled = np.random.default_rng(0).permutation(len(table))
    assert plot_trajectory(truth, table, {}) == plot_trajectory(truth, table.select(shuffled), {})
    with pytest.raises(DatasetError, match="Estimate has several rows of an image"):
        plot_trajectory(truth, truth.select(np.array([0, 0, 1])), {})


def test_bins_show_medians_with_misses_as_the_largest_error():
    speed = np.repeat([0.001, 0.7, 5.0], 10)
    errors = np.repeat([0.03, np.inf, np.inf], 10)
    picture = picture_of(plot_error("speed", speed, {"method": errors}, "ADD"))
    dots = near(picture, PALETTE[0])
    for middle, share in ((0.5 / 8, 1 / 3), (7.5 / 8, 2 / 3)):
        column = round(LEFT + middle * (RIGHT - LEFT))
        assert dots[: len(picture) - BOTTOM - 274, column].any()
        bar = near(picture, "#6e6e6e", 3)[-BOTTOM - 240 : -BOTTOM, column + 20].sum()
        assert bar / 240 == pytest.approx(share / (1.1 * 2 / 3), abs=0.02)


def test_sweeps_ring_the_optimum():
    moving = {"move": true_poses(Motion(velocity=(1, 0, 0)))}
    sweep = sweep_alpha(moving, lambda mode, table: -abs(table.translation[-1, 0] - 6.4), [0.1, 0.5, 1.0])
    assert sweep.best("move")[0] == 0.5
    picture = picture_of(plot_sweep(sweep, "score"))
    x = np.log([0.1 / 1.2, 0.5, 1.2])
    column = round(LEFT + (x[1] - x[0]) / (x[2] - x[0]) * (RIGHT - LEFT))
    drawn = near(picture, PALETTE[0])[80:-BOTTOM]
    assert np.ptp(np.flatnonzero(drawn[:, column])) >= 28


def test_long_and_strange_names_are_shortened_stay_distinct_and_stand_in_values_only():
    assert printable("α\n\0é\udc80") == "???é?"
    assert len(printable("x" * 500)) <= 36
    names = ["W" * 99, "W" * 98 + "V" * 9 + "W" * 30, "Pick attempt"]
    assert len({Legend(dict.fromkeys(names, RED)).color(name)["datum"] for name in names}) == 3
    assert picture_of(plot_recall({"W" * count: np.zeros(1) for count in range(90, 99)}, "ADD")).shape[1] == WIDTH
    evil = "datum['x'] + {'signal': 'width'}"

    def drop(part: object) -> object:
        if isinstance(part, dict):
            return {key: drop(value) for key, value in part.items() if key not in ("values", "domain", "datum")}
        return [drop(each) for each in part] if isinstance(part, list) else part

    spec = plot_error("speed", np.ones(2), {evil: np.zeros(2)}, "ADD")
    assert evil in str(spec)
    assert evil not in str(drop(spec))


def test_written_charts_read_back(tmp_path, monkeypatch):
    spec = plot_recall({"method": np.array([0.01, 0.05])}, "ADD")
    (tmp_path / "json.py").write_text("raise ImportError('of the current folder')")
    monkeypatch.chdir(tmp_path)
    first, second = render_charts([spec, spec])
    assert first == second
    [written] = write_figures(tmp_path / "new", {"recall.png": first})
    np.testing.assert_array_equal(cv2.imread(str(written))[..., ::-1], picture_of(spec))
    assert [path.name for path in written.parent.iterdir()] == ["recall.png"]
    assert render_charts([]) == []


def test_a_file_that_cannot_be_written_is_refused_and_leaves_nothing(tmp_path):
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").touch()
    for folder, name in ((tmp_path, "folder.png"), (tmp_path / "file", "a.png"), (tmp_path, "a" * 300 + ".png")):
        with pytest.raises(OutputError, match=r"\A.*cannot write.*\Z"):
            list(write_figures(folder, {name: b"picture"}))
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder.png"]


@given(st.data())
@settings(max_examples=fuzz_examples(5), deadline=None)
def test_fuzz_no_data_and_no_name_breaks_a_drawing(data):
    names = data.draw(st.lists(st.text(max_size=60), min_size=1, max_size=9, unique=True))
    count = data.draw(st.integers(1, 20))
    numbers = st.one_of(st.floats(0.0, 0.2), st.floats(0.0, 1e300), st.just(float("inf")))
    errors = {name: np.array(data.draw(st.lists(numbers, min_size=count, max_size=count))) for name in names}
    values = np.array(data.draw(st.lists(st.floats(-1e6, 1e6), min_size=count, max_size=count)))
    pictures = [plot_recall(errors, "ADD"), plot_error("visibility", values, errors, "ADD")]
    motion = Motion(images=count, velocity=tuple(data.draw(st.floats(-1e5, 1e5)) for _ in range(3)))
    truth = true_poses(motion)
    table = estimates(truth, data.draw(st.integers(0, 99)), noise=data.draw(st.floats(0.0, 10.0)))
    pictures.append(plot_trajectory(truth, table, {}, attempts=data.draw(st.lists(st.integers(-9, 99), max_size=3))))
    scores = {
        name: float(score) for name, score in zip(names, data.draw(st.lists(st.floats(-1e6, 1e6), min_size=9, max_size=9)), strict=False)
    }
    alphas = data.draw(st.lists(st.floats(1e-6, 1.0), min_size=1, max_size=4))
    pictures.append(plot_sweep(sweep_alpha(dict.fromkeys(scores, truth), lambda mode, _: scores[mode], sorted(set(alphas))), "score"))
    for picture in (picture_of(each, 1.0) for each in pictures):
        assert WIDTH - 4 <= SCALE * picture.shape[1] <= 1.2 * WIDTH  # Labels of large numbers widen it, and bounds are rounded.
        assert near(picture, INK).any()
