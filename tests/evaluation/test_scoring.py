"""Scores from poses to tables: perfect poses, known offsets, symmetries, misses, several hypotheses, all styles;
matching as of the BOP toolkit."""

from __future__ import annotations

import csv
import io
import json
import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import synpick_warp
from synpick_warp.apps.evaluation import scoring
from synpick_warp.apps.evaluation.models import read_models
from synpick_warp.apps.evaluation.poses import PoseTable
from synpick_warp.apps.evaluation.scoring import ALL, METRICS, PER_INSTANCE, make_pairs, match, score
from synpick_warp.apps.evaluation.tables import FORMATS, render, summarize
from synpick_warp.apps.evaluation.truth import read_truth
from tests.harness.fuzz import fuzz_examples
from tests.twins import pose_errors as twin
from tests.worlds.evaluation_set import BOX, BRICK, OBJECTS, PRISM, SIDES, VISIBILITY, moved, write_evaluation_set

NAMES = {BRICK: "brick", BOX: "a_box & co"}
VISIBLE = sum(fraction >= 0.1 for fraction in VISIBILITY)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    folder = write_evaluation_set(tmp_path_factory.mktemp("scoring") / "set")
    return read_truth(synpick_warp.open(folder))


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    return read_models(write_evaluation_set(tmp_path_factory.mktemp("models") / "set"), OBJECTS)


def rows(truth, *scores) -> dict[str, dict[str, float]]:
    """Cells of the first method by label."""
    return {row.label: row.cells[0] for row in summarize(truth, scores, NAMES)}


def pose(poses: PoseTable, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation of a row."""
    return poses.rotation[row], poses.translation[row]


def joined(*tables: PoseTable) -> PoseTable:
    """Rows of several tables, sorted."""
    columns = {name: np.concatenate([getattr(table, name) for table in tables]) for name in vars(tables[0])}
    order = np.lexsort((columns["object_id"], columns["image"], columns["scene"]))
    return PoseTable(**columns).select(order)


def test_perfect_poses_give_100(truth, models):
    cells = rows(truth, score("a", truth, truth.poses, models, 0.0))
    assert {"brick", "a_box & co", f"obj_{PRISM:06d}", "move", "pick", "camera 2", "0.5 to 0.75 visible", "mean"} <= set(cells)
    for values in cells.values():
        assert [values[column] for column in values if column not in ("rotation", "translation")] == pytest.approx([100.0] * 7)
        assert (values["rotation"], values["translation"]) == pytest.approx((0.0, 0.0), abs=1e-5)


def test_poses_off_by_5_cm_along_z_give_50(truth, models):
    """ADD is 5 cm everywhere; nearest neighbours are nearer."""
    scores = score("a", truth, moved(truth.poses, (0.0, 0.0, 0.05)), models, 0.0)
    cells = rows(truth, scores)["mean"]
    assert cells["ADD exact"] == pytest.approx(50.0)
    assert rows(truth, scores)["brick"]["ADD(-S) exact"] == pytest.approx(50.0)
    assert cells["ADD-S exact"] > 50.0
    assert cells["translation"] == pytest.approx(50.0)
    assert cells["ADD vocap"] >= 50.0


def test_add_s_of_a_point_off_by_5_cm_gives_50(truth, models):
    points = {key: type(model)(key, np.zeros((1, 3)), model.symmetries, model.symmetric) for key, model in models.items()}
    cells = rows(truth, score("a", truth, moved(truth.poses, (0.0, 0.0, -0.05)), points, 0.0))["mean"]
    assert [cells[f"{metric} exact"] for metric in METRICS] == pytest.approx([50.0] * 3)


def test_symmetric_objects_are_invariant_under_their_symmetries(truth, models):
    half = Rotation.from_euler("z", 180, degrees=True).as_matrix()
    cells = rows(truth, score("a", truth, moved(truth.poses, turn=half), models, 0.0))
    for name in ("a_box & co", f"obj_{PRISM:06d}"):
        assert (cells[name]["ADD(-S) exact"], cells[name]["rotation"]) == pytest.approx((100.0, 0.0), abs=0.6)
        assert cells[name]["ADD exact"] < 80.0
    assert cells["brick"]["ADD(-S) exact"] < 80.0
    assert cells["brick"]["rotation"] == pytest.approx(180.0)
    side = Rotation.from_euler("z", 360 / SIDES, degrees=True).as_matrix()
    cells = rows(truth, score("a", truth, moved(truth.poses, turn=side), models, 0.0))
    assert cells[f"obj_{PRISM:06d}"]["ADD(-S) exact"] == pytest.approx(100.0)


def test_missing_detections_count_as_misses(truth, models):
    first = truth.poses.select(truth.poses.scene == 0)
    scores = score("a", truth, first, models, 0.0)
    cells = rows(truth, scores)
    assert cells["mean"]["ADD exact"] == pytest.approx(100.0 / 6)
    assert (cells["pick"]["ADD exact"], cells["pick"]["recall"]) == (0.0, 0.0)
    assert math.isnan(cells["pick"]["rotation"])
    nothing = score("a", truth, truth.poses.select(np.zeros(len(truth), bool)), models)
    assert rows(truth, nothing)["mean"]["ADD-S vocap"] == 0.0
    assert math.isnan(nothing.seconds)


def test_instances_that_are_hardly_visible_are_no_targets(truth, models):
    scores = score("a", truth, truth.poses, models)
    assert len(scores.target) == len(truth) * VISIBLE // len(VISIBILITY)
    labels = [row.label for row in summarize(truth, [scores], NAMES)]
    assert f"obj_{PRISM:06d}" not in labels
    assert "0 to 0.1 visible" not in labels


def test_only_the_best_hypotheses_count(truth, models):
    wrong = PoseTable(**(vars(moved(truth.poses, (0.0, 0.0, 0.5))) | {"score": np.full(len(truth), 2.0)}))
    both = joined(truth.poses, wrong)
    assert rows(truth, score("a", truth, both, models, 0.0))["mean"]["ADD exact"] == 0.0
    assert rows(truth, score("a", truth, both, models, 0.0, ALL))["mean"]["ADD exact"] == pytest.approx(100.0)
    low = PoseTable(**(vars(wrong) | {"score": np.zeros(len(truth))}))
    assert rows(truth, score("a", truth, joined(low, truth.poses), models, 0.0))["mean"]["ADD exact"] == pytest.approx(100.0)


def test_estimates_of_objects_that_are_not_in_the_image_count_nothing(truth, models):
    other = PoseTable(**(vars(truth.poses) | {"object_id": np.full(len(truth), 77)}))
    assert rows(truth, score("a", truth, joined(truth.poses, other), models, 0.0))["mean"]["ADD exact"] == pytest.approx(100.0)


def test_time_is_the_mean_over_images(truth, models):
    seconds = np.where(truth.poses.image == 0, 3.0, np.where(truth.poses.image == 1, 1.0, -1.0))
    scores = score("a", truth, PoseTable(**(vars(truth.poses) | {"seconds": seconds})), models)
    assert scores.seconds == pytest.approx(2.0)


@given(seed=st.integers(0, 2**32 - 1), spread=st.sampled_from([0.01, 0.05, 0.2]))
@settings(max_examples=fuzz_examples(50))
def test_scores_are_those_of_one_pair_at_a_time(truth, models, seed, spread):
    """Twin of the whole: errors and matching of the toolkit image by image, then the mean."""
    random = np.random.default_rng(seed)
    truth_rows = random.permutation(len(truth))[:40]
    turn = Rotation.from_rotvec(random.normal(0.0, 10 * spread, (40, 3))).as_matrix()
    part = truth.poses.select(np.sort(truth_rows))
    values = {"rotation": part.rotation @ turn, "translation": part.translation + random.normal(0.0, spread, (40, 3))}
    estimates = PoseTable(**(vars(part) | values | {"score": random.choice([0.2, 0.5], 40)}))
    scores = score("a", truth, estimates, models, 0.0, ALL)
    for metric, function in (("ADD", twin.add), ("ADD-S", twin.adi)):
        expected = np.full(len(truth), np.inf)
        for key in {*zip(estimates.scene, estimates.image, estimates.object_id, strict=True)}:
            ours, theirs = (
                np.flatnonzero((poses.scene == key[0]) & (poses.image == key[1]) & (poses.object_id == key[2]))
                for poses in (truth.poses, estimates)
            )
            vertices = models[int(key[2])].vertices
            errors = np.array([[function(*pose(estimates, e), *pose(truth.poses, g), vertices) for g in ours] for e in theirs])
            matched = twin.match_poses(estimates.score[theirs].tolist(), errors, 0.1, [True] * len(ours))
            for instance, estimate in matched.items():
                expected[ours[instance]] = errors[estimate, instance]
        np.testing.assert_allclose(scores.errors[metric], expected, atol=1e-9)


def test_bounds_leave_out_only_pairs_that_cannot_match(truth, models, monkeypatch):
    counted = []
    monkeypatch.setattr(scoring, "adds_errors", lambda *given: counted.append(len(given[0])) or np.zeros(len(given[0])))
    score("a", truth, moved(truth.poses, (0.0, 0.0, 0.9)), models, 0.0)
    assert sum(counted) == 0


@pytest.mark.parametrize("style", FORMATS)
def test_methods_stand_beside_each_other_in_every_style(truth, models, style):
    scores = [
        score("good_one", truth, truth.poses, models),
        score("a-method-of-a-rather-long-name-that-is-wider-than-its-columns-are", truth, moved(truth.poses, (0.0, 0.0, 0.05)), models),
    ]
    output = render(summarize(truth, scores, NAMES), truth, scores, style)
    assert output.endswith("\n")
    if style == "text":
        assert max(map(len, output.splitlines())) < 160
        line = next(line for line in output.splitlines() if line.startswith("brick"))
        assert line.split()[:4] == ["brick", "48", "100.0", "100.0"]
        assert line.split()[8] == "50.0"
    elif style == "latex":
        assert r"\multicolumn{3}{c}{good\_one}" in output
        assert r"a\_box \& co & 100.0 & 100.0 & 100.0 & 50.0 &" in output
        assert output.count("\\\\\n") == 2 + len(summarize(truth, scores, NAMES))
        assert r"\cmidrule(lr){2-4}\cmidrule(lr){5-7}" in output
    elif style == "csv":
        lines = list(csv.DictReader(io.StringIO(output)))
        assert len(lines) == 2 * len(summarize(truth, scores, NAMES))
        mean = [line for line in lines if line["group"] == "mean"]
        assert [float(line["ADD exact"]) for line in mean] == pytest.approx([100.0, 50.0])
        assert mean[0]["method"] == "good_one"
    else:
        first, second = json.loads(output)["methods"]
        assert first["rows"][-1]["ADD vocap"] == pytest.approx(100.0)
        assert second["recall"]["ADD"][-1] == 1.0
        assert [band["count"] for band in second["bands"]["visibility"]["ADD"]] == [0, 0, 24, 24, 24]
        assert second["seconds_per_image"] is None


def test_a_table_without_scores_has_dashes(truth, models):
    nothing = score("none", truth, truth.poses.select(np.zeros(len(truth), bool)), models)
    text = render(summarize(truth, [nothing], NAMES), truth, [nothing], "text", "vocap")
    assert "convention vocap" in text
    assert text.splitlines()[-4].split() == ["mean", "72", "0.0", "0.0", "0.0", "0.0", "-", "-"]


@given(
    names=st.lists(st.text(st.characters(exclude_categories=["C", "Zl", "Zp"]), min_size=1, max_size=90), min_size=1, max_size=3),
    data=st.data(),
)
@settings(max_examples=fuzz_examples(50))
def test_tables_hold_any_names_and_values(truth, models, names, data):
    """CSV and JSON give back names and values; LaTeX rows have one cell a column; text lines have one width for every block."""
    target = np.flatnonzero(truth.visibility >= 0.1)
    errors = st.sampled_from([0.0, 0.03, 0.0999, np.inf])
    scores = []
    for name in names:
        values = np.resize(np.array(data.draw(st.lists(errors, min_size=1, max_size=7))), len(target))
        unknown = np.where(np.isfinite(values), 1.0, np.nan)
        scores.append(scoring.Scores(name, target, dict.fromkeys(METRICS, values), unknown, unknown, math.nan))
    table = summarize(truth, scores, {BRICK: names[0]})
    assert sum(row.targets for row in table if row.group == "object") == len(target)
    for row in table:
        for cells in row.cells:
            assert all(math.isnan(value) or value >= 0.0 for value in cells.values())
            assert cells["ADD exact"] <= cells["ADD vocap"] + 1e-9 <= 100.0 + 1e-6
    lines = list(csv.DictReader(io.StringIO(render(table, truth, scores, "csv"))))
    assert [line["method"] for line in lines] == names * len(table)
    for line, cells in zip(lines, [cells for row in table for cells in row.cells], strict=True):
        assert float(line["ADD-S exact"]) == pytest.approx(cells["ADD-S exact"], rel=1e-5, abs=1e-5)
    content = json.loads(render(table, truth, scores, "json"))
    assert [each["method"] for each in content["methods"]] == names
    latex = [line for line in render(table, truth, scores, "latex").splitlines() if line.endswith("\\\\")]
    assert {line.replace("\\&", "").count("&") for line in latex[1:]} == {3 * len(names)}
    text = render(table, truth, scores, "text")
    assert len(text.splitlines()) == len(table) + len({row.group for row in table}) + 5


# ---- matching ----


def table(keys: list[tuple[int, int, int]], scores: list[float] | None = None) -> PoseTable:
    """Poses of (scene, image, object), sorted as tables are."""
    columns = np.reshape(np.array(keys, np.int64), (-1, 3))
    order = np.lexsort(columns.T[::-1])
    count = len(columns)
    values = np.ones(count) if scores is None else np.array(scores, np.float64)
    unknown = np.full(count, -1)
    poses = PoseTable(*columns.T, np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), values, -np.ones(count), unknown)
    return poses.select(order)


def test_estimates_meet_instances_of_the_same_image_and_object():
    truth = table([(0, 0, 1), (0, 0, 1), (0, 0, 2), (0, 1, 1)])
    estimates = table([(0, 0, 1), (0, 0, 2), (0, 0, 3), (0, 2, 1)])
    pairs = make_pairs(truth, np.ones(4, bool), estimates)
    assert list(zip(pairs.estimate, pairs.truth, strict=True)) == [(0, 0), (0, 1), (1, 2)]


def test_only_the_best_estimates_count():
    truth = table([(0, 0, 1), (0, 0, 1)])
    estimates = table([(0, 0, 1)] * 4, [0.1, 0.9, 0.5, 0.9])
    for top, expected in ((PER_INSTANCE, [1, 3]), (ALL, [1, 3, 2, 0]), (1, [1])):
        pairs = make_pairs(truth, np.ones(2, bool), estimates, top)
        assert pairs.estimate[::2].tolist() == expected
    pairs = make_pairs(truth, np.array([False, True]), estimates)
    assert (pairs.estimate.tolist(), pairs.truth.tolist()) == ([1], [1])


def test_the_better_score_chooses_first_though_another_fits_better():
    truth, estimates = table([(0, 0, 1), (0, 0, 1)]), table([(0, 0, 1)] * 2, [0.5, 0.9])
    pairs = make_pairs(truth, np.ones(2, bool), estimates)
    assert pairs.estimate.tolist() == [1, 1, 0, 0]
    assert match(pairs, np.array([0.02, 0.03, 0.01, 0.2]), 0.1, 2).tolist() == [0, -1]
    assert match(pairs, np.array([0.02, 0.03, 0.01, 0.04]), 0.1, 2).tolist() == [0, 3]


def test_an_error_at_the_threshold_is_no_match():
    truth, estimates = table([(0, 0, 1)]), table([(0, 0, 1)])
    pairs = make_pairs(truth, np.ones(1, bool), estimates)
    assert match(pairs, np.array([0.1]), 0.1, 1).tolist() == [-1]
    assert match(pairs, np.array([np.inf]), 0.1, 1).tolist() == [-1]


def test_no_estimates_and_no_targets():
    some, none = table([(0, 0, 1)]), table([])
    for truth, estimates, target in ((some, none, [True]), (none, some, []), (some, some, [False]), (none, none, [])):
        pairs = make_pairs(truth, np.array(target, bool), estimates)
        assert len(pairs.truth) == 0
        assert match(pairs, np.empty(0), 0.1, len(truth)).tolist() == [-1] * len(truth)


def test_many_hypotheses_take_as_many_rounds_as_instances():
    count = 20_000
    truth, estimates = table([(0, 0, 1), (0, 0, 1)]), table([(0, 0, 1)] * count, np.linspace(1.0, 0.0, count).tolist())
    pairs = make_pairs(truth, np.ones(2, bool), estimates, ALL)
    errors = np.where(pairs.truth == 0, 0.01, 0.02)
    started = time.monotonic()
    assert match(pairs, errors, 0.1, 2).tolist() == [0, 3]
    assert time.monotonic() - started < 5.0


KEYS = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 1), st.integers(1, 2)), max_size=12)


@given(keys=KEYS, others=KEYS, data=st.data())
@settings(max_examples=fuzz_examples(150))
def test_matching_is_the_toolkits(keys, others, data):
    draw = data.draw
    truth = table(keys)
    estimates = table(others, draw(st.lists(st.sampled_from([0.1, 0.5, 0.9]), min_size=len(others), max_size=len(others))))
    target = np.array(draw(st.lists(st.booleans(), min_size=len(keys), max_size=len(keys))), bool)
    top = draw(st.sampled_from([PER_INSTANCE, ALL, 1, 2]))
    pairs = make_pairs(truth, target, estimates, top)
    levels = [0.0, 0.01, 0.05, 0.1, 0.2]
    errors = np.array(draw(st.lists(st.sampled_from(levels), min_size=len(keys) * len(others), max_size=len(keys) * len(others))))
    errors = errors.reshape(len(others), len(keys))
    found = match(pairs, errors[pairs.estimate, pairs.truth], 0.1, len(truth))
    expected = np.full(len(truth), -1)
    for key in sorted(set(keys)):
        ours, theirs = (
            np.flatnonzero((poses.scene == key[0]) & (poses.image == key[1]) & (poses.object_id == key[2])) for poses in (truth, estimates)
        )
        limit = {PER_INSTANCE: int(target[ours].sum()), ALL: len(theirs)}.get(top, top)
        theirs = theirs[np.argsort(-estimates.score[theirs], kind="stable")][:limit]
        matched = twin.match_poses(estimates.score[theirs].tolist(), errors[np.ix_(theirs, ours)], 0.1, target[ours].tolist())
        for instance, estimate in matched.items():
            expected[ours[instance]] = theirs[estimate]
    assert [pairs.estimate[index] if index >= 0 else -1 for index in found] == expected.tolist()
    assert all(pairs.truth[index] == row for row, index in enumerate(found) if index >= 0)
