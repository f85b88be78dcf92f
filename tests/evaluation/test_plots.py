"""Charts: what is drawn where, gaps, legends, files; refused input; and that no data or name breaks the drawing."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.apps.evaluation.figures import (
    plot_error,
    plot_recall,
    plot_sweep,
    plot_trajectory,
    write_figures,
)
from synpick_warp.apps.evaluation.tracking import filter_poses, sweep_alpha
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.system.codecs import charts
from synpick_warp.system.codecs.charts import INK, PALETTE, SCALE, ChartError, Legend, axis, chart, panel, points, printable, render_charts
from tests.harness.charts import near, picture_of, tick_texts
from tests.harness.fuzz import fuzz_examples
from tests.worlds.noisy_tracks import Motion, estimates, true_poses

WIDTH, LEFT, RIGHT, BOTTOM = 1400, 171, 1380, 103
"""Width of a picture, and frame of the panels [px], the lower edge from below."""
RED = PALETTE[1]


def rows_at(picture: np.ndarray, column: float, color: str, panel: int) -> np.ndarray:
    """Height of a colour's pixels in a column of the lowest panel, 0 at its lower edge, 1 at its upper."""
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


def test_a_library_that_cannot_run_is_one_line(tmp_path, monkeypatch):
    (tmp_path / "vl_convert.py").write_text("raise ImportError")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(ChartError, match=r"^the charts' library vl-convert-python ended with exit code 1; .* install the package again$"):
        render_charts([plot_recall({"method": np.array([0.01])}, "ADD")])


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
