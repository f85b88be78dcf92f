"""Charts: what is drawn where, ticks, gaps, legends, files; refused input; and that no data or name breaks the drawing."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.evaluation import filter_poses, sweep_alpha
from synpick_warp.evaluation.charts import INK, PALETTE, WIDTH, Axis, Color, Entry, Image, Line, Panel, draw_chart, printable, write_chart
from synpick_warp.evaluation.plots import plot_error_by_speed, plot_error_by_visibility, plot_recall, plot_sweep, plot_trajectory
from tests.harness.fuzz import fuzz_examples
from tests.worlds.noisy_tracks import Motion, estimates, true_poses

LEFT, RIGHT, BOTTOM = 158, WIDTH - 40, 112
"""Frame of the panels [px], the lower edge from below."""
RED: Color = (213, 94, 0)


def near(picture: Image, color: Color, tolerance: int = 40) -> np.ndarray:
    """Pixels of about a colour (H, W) bool."""
    return (np.abs(picture.astype(int) - color) <= tolerance).all(axis=2)


def rows_at(picture: Image, column: float, color: Color, panel: int) -> np.ndarray:
    """Height of a colour's pixels in a column of the lowest panel, 0 at its lower edge, 1 at its upper."""
    rows = np.flatnonzero(near(picture, color)[:, round(column)])
    return (len(picture) - BOTTOM - 0.5 - rows) / panel


def test_lines_are_where_the_axes_say():
    x = np.linspace(0.0, 10.0, 50)
    picture = draw_chart(Axis("x", 0.0, 10.0), [Panel(Axis("y", -1.0, 1.0), [Line(x, 0.1 * x - 0.5, RED)], 400)], [])
    assert picture.shape[1:] == (WIDTH, 3)
    assert picture.dtype == np.uint8
    for fraction in (0.2, 0.5, 0.9):
        heights = rows_at(picture, LEFT + fraction * (RIGHT - LEFT), RED, 400)
        assert heights.mean() == pytest.approx(0.25 + 0.5 * fraction, abs=0.006)


def test_nan_breaks_a_line_and_what_is_outside_is_clipped():
    x, y = np.arange(5.0), np.array([0.5, 0.5, np.nan, 0.5, 1e300])
    picture = draw_chart(Axis("x", 0.0, 4.0), [Panel(Axis("y", 0.0, 1.0), [Line(x, y, RED)], 400)], [])
    drawn = near(picture, RED).any(axis=0)
    columns = LEFT + np.array([0.5, 1.5, 2.5, 3.0]) / 4 * (RIGHT - LEFT)
    assert drawn[columns.round().astype(int)].tolist() == [True, False, False, True]
    assert not near(picture, RED)[:28].any()


def test_a_single_point_between_breaks_is_a_dot():
    y = np.array([np.nan, 0.5, np.nan])
    picture = draw_chart(Axis("x", 0.0, 2.0), [Panel(Axis("y", 0.0, 1.0), [Line(np.arange(3.0), y, RED, 4.0)], 400)], [])
    assert near(picture, RED)[:, (LEFT + RIGHT) // 2].sum() >= 5


@given(st.floats(-1e6, 1e6), st.floats(1e-4, 1e6), st.integers(2, 12))
@settings(max_examples=fuzz_examples(200), deadline=None)
def test_fuzz_ticks_are_few_round_and_inside(low, span, count):
    high = low + span
    if high - low < 1e-6 * max(abs(low), abs(high)):
        return
    ticks = Axis("", low, high).labelled_ticks(count)
    values = np.array([value for value, _ in ticks])
    assert len(ticks) <= count + 1
    assert (values >= low - 1e-5 * span).all()
    assert (values <= high + 1e-5 * span).all()
    assert len({text for _, text in ticks}) == len(ticks)
    assert not {"-0", "-0.0", "-0.00"} & {text for _, text in ticks}
    np.testing.assert_allclose([float(text) for _, text in ticks], values, atol=1e-3 * span, rtol=1e-9)


def test_recall_is_the_fraction_of_errors_up_to_the_threshold():
    errors = np.array([0.02] * 30 + [0.06] * 20 + [np.inf] * 50)
    picture = plot_recall({"method": errors})
    for threshold, recall in ((0.01, 0.0), (0.04, 0.3), (0.08, 0.5)):
        heights = rows_at(picture, LEFT + threshold / 0.1 * (RIGHT - LEFT), PALETTE[0], 640)
        assert heights.mean() == pytest.approx(recall, abs=0.01)


@pytest.mark.parametrize("missing", [3, 12])
def test_trajectories_bridge_short_gaps_and_leave_long_ones_open(missing):
    truth = true_poses(Motion(images=101))
    table = truth.select((truth.image <= 50) | (truth.image > 50 + missing))
    shifted = filter_poses(table, 1.0)
    shifted.translation[:] += [0.1, 0.1, 0.1]
    picture = plot_trajectory(truth, table, {"Filter": shifted})
    column = LEFT + (50.5 + missing / 2) / 100 * (RIGHT - LEFT)
    assert bool(len(rows_at(picture, column, PALETTE[0], 330))) is (missing == 3)
    assert len(rows_at(picture, column, INK, 330))


def test_pick_attempts_are_marked_in_red_and_the_legend_names_all():
    truth = true_poses(Motion(images=101))
    plain = plot_trajectory(truth, truth, {})
    marked = plot_trajectory(truth, truth, {}, attempts=[25, 75])
    red = (200, 40, 40)
    assert not near(plain, red).any()
    # One disc for each attempt in the upper panel, and one in the legend.
    count, _ = cv2.connectedComponents(near(marked, red).astype(np.uint8))
    assert count - 1 == 3


def test_the_order_of_rows_does_not_matter_to_a_trajectory():
    truth = true_poses(Motion(images=40, velocity=(0.1, 0, 0)))
    table = estimates(truth, noise=0.01, missing=0.1)
    shuffled = np.random.default_rng(0).permutation(len(table))
    np.testing.assert_array_equal(plot_trajectory(truth, table, {}), plot_trajectory(truth, table.select(shuffled), {}))


def test_bins_show_medians_with_misses_as_the_largest_error():
    speed = np.repeat([0.001, 0.7, 5.0], 10)
    errors = np.repeat([0.03, np.inf, np.inf], 10)
    picture = plot_error_by_speed(speed, {"method": errors}, edges=(0.0, 0.01, 1.0))
    dots = near(picture, PALETTE[0])
    for middle, share in ((0.25, 1 / 3), (0.75, 2 / 3)):
        column = round(LEFT + middle * (RIGHT - LEFT))
        assert dots[: len(picture) - BOTTOM - 284, column].any()
        bar = near(picture, (110, 110, 110), 3)[-BOTTOM - 250 : -BOTTOM, column + 20].sum()
        assert bar / 250 == pytest.approx(share / (1.1 * 2 / 3), abs=0.02)


def test_sweeps_ring_the_optimum():
    sweep = sweep_alpha(
        {"move": true_poses(Motion(velocity=(1, 0, 0)))}, lambda table: -abs(table.translation[-1, 0] - 6.4), [0.1, 0.5, 1.0]
    )
    assert sweep.best("move")[0] == 0.5
    picture = plot_sweep(sweep)
    x = np.log([0.1 / 1.2, 0.5, 1.2])
    column = round(LEFT + (x[1] - x[0]) / (x[2] - x[0]) * (RIGHT - LEFT))
    drawn = near(picture, PALETTE[0])[76:-BOTTOM]
    assert np.ptp(np.flatnonzero(drawn[:, column])) >= 28


def test_long_and_strange_names_are_shortened():
    assert printable("α\n\0é\udc80") == "???é?"
    assert len(printable("x" * 500)) <= 36
    assert draw_chart(Axis("x", 0, 1), [Panel(Axis("y", 0, 1), [], 200)], [Entry("W" * 99, RED)] * 9).shape[1] == WIDTH


def test_a_written_chart_reads_back(tmp_path):
    picture = plot_recall({"method": np.array([0.01, 0.05])})
    written = write_chart(tmp_path / "new" / "recall.png", picture)
    np.testing.assert_array_equal(cv2.imread(str(written))[..., ::-1], picture)
    assert [path.name for path in written.parent.iterdir()] == ["recall.png"]


def test_a_file_that_cannot_be_written_is_refused_and_leaves_nothing(tmp_path):
    picture = np.zeros((4, 4, 3), np.uint8)
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").touch()
    for name, message in (
        ("recall.pdf", "must end in .png"),
        ("folder.png", "cannot write"),
        ("file/a.png", "cannot write"),
        ("a\0.png", "cannot"),
    ):
        with pytest.raises(OutputError, match=message) as caught:
            write_chart(tmp_path / name, picture)
        assert "\n" not in str(caught.value)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder.png"]


def test_what_cannot_be_drawn_is_refused():
    truth = true_poses(Motion(images=3))
    empty = truth.select(np.arange(0))
    twice = truth.select(np.array([0, 0, 1]))
    errors = np.array([0.01, 0.02])
    cases = [
        (lambda: plot_trajectory(truth, empty, {}), "at least one true and one estimated"),
        (lambda: plot_trajectory(truth, twice, {}), "Estimate has several rows of an image"),
        (lambda: plot_trajectory(truth, truth, {"Estimate": truth}), "the same name"),
        (lambda: plot_recall({"m": np.array([])}), "errors of m"),
        (lambda: plot_recall({"m": np.array([np.nan])}), "errors of m"),
        (lambda: plot_recall({"m": np.array([-1.0])}), "errors of m"),
        (lambda: plot_error_by_visibility(np.ones(3), {"m": errors}), "m has 2 errors for 3 instances"),
        (lambda: plot_error_by_visibility(np.array([0.5, np.nan]), {"m": errors}), "not finite"),
        (lambda: plot_error_by_speed(np.ones(2), {"m": errors}, edges=[1.0]), "at least two, rising"),
        (lambda: plot_error_by_speed(np.ones(2), {"m": errors}, edges=[1.0, 0.5]), "at least two, rising"),
    ]
    for call, message in cases:
        with pytest.raises(DatasetError, match=message):
            call()


@given(st.data())
@settings(max_examples=fuzz_examples(15), deadline=None)
def test_fuzz_no_data_and_no_name_breaks_a_drawing(data):
    names = data.draw(st.lists(st.text(max_size=60), min_size=1, max_size=9, unique=True))
    count = data.draw(st.integers(1, 20))
    numbers = st.one_of(st.floats(0.0, 0.2), st.floats(0.0, 1e300), st.just(float("inf")))
    errors = {name: np.array(data.draw(st.lists(numbers, min_size=count, max_size=count))) for name in names}
    values = np.array(data.draw(st.lists(st.floats(-1e6, 1e6), min_size=count, max_size=count)))
    pictures = [plot_recall(errors), plot_error_by_visibility(values, errors)]
    motion = Motion(images=count, velocity=tuple(data.draw(st.floats(-1e5, 1e5)) for _ in range(3)))
    truth = true_poses(motion)
    table = estimates(truth, data.draw(st.integers(0, 99)), noise=data.draw(st.floats(0.0, 10.0)))
    pictures.append(plot_trajectory(truth, table, {}, attempts=data.draw(st.lists(st.integers(-9, 99), max_size=3))))
    scores = {
        name: float(score) for name, score in zip(names, data.draw(st.lists(st.floats(-1e6, 1e6), min_size=9, max_size=9)), strict=False)
    }
    alphas = data.draw(st.lists(st.floats(1e-6, 1.0), min_size=1, max_size=4))
    functions = {name: lambda _, score=score: score for name, score in scores.items()}
    pictures.append(plot_sweep(sweep_alpha(dict.fromkeys(scores, truth), functions, alphas)))
    for picture in pictures:
        assert picture.shape[1] == WIDTH
        assert near(picture, INK).any()
