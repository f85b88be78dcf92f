"""Scores from poses to tables: perfect poses, known offsets, symmetries, misses, several hypotheses, all styles;
matching as of the BOP toolkit."""

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

from synpick_warp.apps.evaluation import errors as scoring
from synpick_warp.apps.evaluation.errors import (
    ALL,
    LIMIT,
    METRICS,
    PER_INSTANCE,
    VertexSearch,
    add_errors,
    adds_errors,
    band_indices,
    error_bands,
    exact_auc,
    expand_symmetries,
    make_pairs,
    match,
    read_models,
    recall_curve,
    rotation_errors,
    score,
    translation_errors,
    vocap_auc,
)
from synpick_warp.apps.evaluation.tables import FORMATS, render, summarize
from synpick_warp.apps.evaluation.truth import PoseTable
from synpick_warp.scenes.assets.models_info import FileModelInfo
from tests.harness.hostile import fuzz_examples
from tests.twins import pose_errors as twin
from tests.worlds.evaluation_set import BOX, BRICK, OBJECTS, PRISM, SIDES, VISIBILITY, join_tables, moved

NAMES = {BRICK: "brick", BOX: "a_box & co"}
VISIBLE = sum(fraction >= 0.1 for fraction in VISIBILITY)


@pytest.fixture(scope="module")
def models(folder):
    return read_models(folder, OBJECTS)


def changed(poses: PoseTable, **columns: np.ndarray) -> PoseTable:
    return PoseTable(**(vars(poses) | columns))


def rows(truth, *scores) -> dict[str, dict[str, float]]:
    """Cells of the first method by label."""
    return {row.label: row.cells[0] for row in summarize(truth, scores, NAMES)}


def mean(truth, poses, models, *options) -> dict[str, float]:
    """Cells of all instances of a method with these poses."""
    return rows(truth, score("a", truth, poses, models, *(options or (0.0,))))["mean"]


def test_perfect_poses_give_100(truth, models):
    cells = rows(truth, score("a", truth, truth.poses, models, 0.0))
    assert {"brick", "a_box & co", f"obj_{PRISM:06d}", "move", "pick", "camera 2", "0.5 to 0.75 visible", "mean"} <= set(cells)
    for values in cells.values():
        assert [values[column] for column in values if column not in ("rotation", "translation")] == pytest.approx([100.0] * 7)
        assert (values["rotation"], values["translation"]) == pytest.approx((0.0, 0.0), abs=1e-5)


def test_poses_off_by_5_cm_along_z_give_50(truth, models):
    """ADD is 5 cm everywhere; nearest neighbours are nearer, but for models of a single point."""
    scores = score("a", truth, moved(truth.poses, (0.0, 0.0, 0.05)), models, 0.0)
    cells = rows(truth, scores)["mean"]
    assert cells["ADD exact"] == pytest.approx(50.0)
    assert rows(truth, scores)["brick"]["ADD(-S) exact"] == pytest.approx(50.0)
    assert cells["ADD-S exact"] > 50.0
    assert cells["translation"] == pytest.approx(50.0)
    assert cells["ADD vocap"] >= 50.0
    points = {key: type(model)(key, np.zeros((1, 3)), model.symmetries, model.symmetric) for key, model in models.items()}
    cells = mean(truth, moved(truth.poses, (0.0, 0.0, -0.05)), points)
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
    cells = rows(truth, score("a", truth, truth.poses.select(truth.poses.scene == 0), models, 0.0))
    assert cells["mean"]["ADD exact"] == pytest.approx(100.0 / 6)
    assert (cells["pick"]["ADD exact"], cells["pick"]["recall"]) == (0.0, 0.0)
    assert math.isnan(cells["pick"]["rotation"])
    nothing = score("none", truth, truth.poses.select(np.zeros(len(truth), bool)), models)
    assert rows(truth, nothing)["mean"]["ADD-S vocap"] == 0.0
    assert math.isnan(nothing.seconds)
    text = render(summarize(truth, [nothing], NAMES), truth, [nothing], "text", "vocap")
    assert "convention vocap" in text
    assert text.splitlines()[-4].split() == ["mean", "72", "0.0", "0.0", "0.0", "0.0", "-", "-"]


def test_only_the_best_hypotheses_count(truth, models):
    """And time is the mean over images; instances that are hardly visible are no targets."""
    wrong = changed(moved(truth.poses, (0.0, 0.0, 0.5)), score=np.full(len(truth), 2.0))
    low, other = changed(wrong, score=np.zeros(len(truth))), changed(truth.poses, object_id=np.full(len(truth), 77))
    both = join_tables(truth.poses, wrong)
    assert mean(truth, both, models)["ADD exact"] == 0.0
    assert mean(truth, both, models, 0.0, ALL)["ADD exact"] == pytest.approx(100.0)
    # Estimates of objects that are not in the image count nothing.
    for more in (low, other):
        assert mean(truth, join_tables(more, truth.poses), models)["ADD exact"] == pytest.approx(100.0)
    seconds = np.where(truth.poses.image == 0, 3.0, np.where(truth.poses.image == 1, 1.0, -1.0))
    scores = score("a", truth, changed(truth.poses, seconds=seconds), models)
    assert scores.seconds == pytest.approx(2.0)
    assert len(scores.target) == len(truth) * VISIBLE // len(VISIBILITY)
    assert not {f"obj_{PRISM:06d}", "0 to 0.1 visible"} & set(rows(truth, scores))


def pose(poses: PoseTable, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation of a row."""
    return poses.rotation[row], poses.translation[row]


def rows_of(poses: PoseTable, scene: int, image: int, object_id: int) -> np.ndarray:
    return np.flatnonzero((poses.scene == scene) & (poses.image == image) & (poses.object_id == object_id))


@given(seed=st.integers(0, 2**32 - 1), spread=st.sampled_from([0.01, 0.05, 0.2]))
@settings(max_examples=fuzz_examples(50))
def test_scores_are_those_of_one_pair_at_a_time(truth, models, seed, spread):
    """Twin of the whole: errors and matching of the toolkit image by image, then the mean."""
    random = np.random.default_rng(seed)
    truth_rows = random.permutation(len(truth))[:40]
    turn = Rotation.from_rotvec(random.normal(0.0, 10 * spread, (40, 3))).as_matrix()
    part = truth.poses.select(np.sort(truth_rows))
    places = part.translation + random.normal(0.0, spread, (40, 3))
    estimates = changed(part, rotation=part.rotation @ turn, translation=places, score=random.choice([0.2, 0.5], 40))
    scores = score("a", truth, estimates, models, 0.0, ALL)
    for metric, function in (("ADD", twin.add), ("ADD-S", twin.adi)):
        expected = np.full(len(truth), np.inf)
        for key in {*zip(estimates.scene, estimates.image, estimates.object_id, strict=True)}:
            ours, theirs = (rows_of(poses, *key) for poses in (truth.poses, estimates))
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
    names = ("good_one", "a-method-of-a-rather-long-name-that-is-wider-than-its-columns-are")
    scores = [score(name, truth, moved(truth.poses, (0.0, 0.0, off)), models) for name, off in zip(names, (0.0, 0.05), strict=True)]
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
        ours, theirs = (rows_of(poses, *key) for poses in (truth, estimates))
        limit = {PER_INSTANCE: int(target[ours].sum()), ALL: len(theirs)}.get(top, top)
        theirs = theirs[np.argsort(-estimates.score[theirs], kind="stable")][:limit]
        matched = twin.match_poses(estimates.score[theirs].tolist(), errors[np.ix_(theirs, ours)], 0.1, target[ours].tolist())
        for instance, estimate in matched.items():
            expected[ours[instance]] = theirs[estimate]
    assert [pairs.estimate[index] if index >= 0 else -1 for index in found] == expected.tolist()
    assert all(pairs.truth[index] == row for row, index in enumerate(found) if index >= 0)


# ---- errors: hand-computed values, agreement with the BOP toolkit's functions, invariance under symmetries ----


AXIS = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))


def random_pairs(seed: int, count: int, spread: float = 0.1) -> tuple[np.ndarray, ...]:
    """Estimated and true rotations and translations [m]."""
    random = np.random.default_rng(seed)
    true = Rotation.random(count, rng=random)
    estimated = true * Rotation.from_rotvec(random.normal(0.0, random.choice([1e-3, 0.1, 2.0], (count, 1)), (count, 3)))
    place = random.uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.5), (count, 3))
    return estimated.as_matrix(), place + random.normal(0.0, spread, (count, 3)), true.as_matrix(), place


def test_hand_computed_errors():
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    quarter = Rotation.from_euler("z", [[90]], degrees=True).as_matrix()
    one, zero = np.eye(3)[None], np.zeros((1, 3))
    # Quarter turn: one vertex stays, the other moves by √2; its nearest vertex in the estimated pose is the origin.
    assert add_errors(quarter, zero, one, zero, vertices) == pytest.approx([np.sqrt(2.0) / 2.0])
    assert adds_errors(quarter, zero, one, zero, vertices) == pytest.approx([0.5])
    assert add_errors(one, np.array([[3.0, 4.0, 0.0]]), one, zero, vertices) == pytest.approx([5.0])
    assert adds_errors(one, np.array([[1.0, 0.0, 0.0]]), one, zero, vertices) == pytest.approx([0.5])
    assert translation_errors(np.array([[3.0, 4.0, 0.0]]), zero) == pytest.approx([5.0])
    assert rotation_errors(quarter, one) == pytest.approx([90.0])
    # ADD-S searches from the true to the estimated pose.
    vertices = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [5.0, 0.0, 0.0]])
    pair = Rotation.from_euler("y", [[90]], degrees=True).as_matrix(), np.array([[0.0, 0.0, 1.0]]), one, zero
    forward, backward = adds_errors(*pair, vertices), adds_errors(*pair[2:], *pair[:2], vertices)
    assert abs(forward - backward) > 0.01
    assert forward == pytest.approx([twin.adi(*(part[0] for part in pair), vertices)])


@pytest.mark.parametrize("size", [4, 300])
def test_errors_agree_with_the_toolkit(size):
    vertices = np.random.default_rng(size).normal(0.0, 0.05, (size, 3))
    pairs = random_pairs(size, fuzz_examples(200))
    search = VertexSearch(vertices)
    rows = list(zip(*pairs, strict=True))
    assert add_errors(*pairs, vertices) == pytest.approx([twin.add(*row, vertices) for row in rows], abs=1e-6)
    assert adds_errors(*pairs, vertices, search) == pytest.approx([twin.adi(*row, vertices) for row in rows], abs=1e-6)
    assert translation_errors(pairs[1], pairs[3]) == pytest.approx([twin.te(row[1], row[3]) for row in rows], abs=1e-6)
    # The toolkit's arccos has half of the digits near 0.
    assert rotation_errors(pairs[0], pairs[2]) == pytest.approx([twin.re(row[0], row[2]) for row in rows], abs=2e-6)


def test_errors_of_many_pairs_are_those_of_each_pair(monkeypatch):
    vertices = np.random.default_rng(1).normal(0.0, 0.05, (7, 3))
    pairs = random_pairs(2, 23)
    whole = add_errors(*pairs, vertices), adds_errors(*pairs, vertices)
    for name in ("_CHUNK", "_QUERIED"):
        monkeypatch.setattr(f"synpick_warp.apps.evaluation.errors.{name}", 20)
    for function, expected in zip((add_errors, adds_errors), whole, strict=True):
        np.testing.assert_allclose(function(*pairs, vertices), expected, rtol=1e-12, atol=1e-15)


@given(seed=st.integers(0, 2**32 - 1), size=st.integers(1, 30))
@settings(max_examples=fuzz_examples(100))
def test_errors_obey_their_bounds(seed, size):
    """ADD-S is at most ADD; ADD is at least the centroid's way; a rigid motion of both poses changes nothing; equal poses have none."""
    vertices = np.random.default_rng(seed).normal(0.0, 0.05, (size, 3))
    pairs = random_pairs(seed, 5)
    add, adds = add_errors(*pairs, vertices), adds_errors(*pairs, vertices)
    assert (adds <= add + 1e-12).all()
    offset = (pairs[0] - pairs[2]) @ vertices.mean(axis=0) + pairs[1] - pairs[3]
    assert (add >= np.linalg.norm(offset, axis=1) - 1e-12).all()
    motion = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    elsewhere = motion @ pairs[0], pairs[1] @ motion.T + 1.0, motion @ pairs[2], pairs[3] @ motion.T + 1.0
    np.testing.assert_allclose(add_errors(*elsewhere, vertices), add, atol=1e-12)
    np.testing.assert_allclose(adds_errors(*elsewhere, vertices), adds, atol=1e-12)
    assert np.abs(adds_errors(*pairs[2:], *pairs[2:], vertices)).max() < 1e-12
    assert rotation_errors(pairs[2], pairs[2]).max() < 1e-10


@given(seed=st.integers(0, 2**32 - 1), sides=st.integers(2, 12), step=st.integers(0, 11))
@settings(max_examples=fuzz_examples(100))
def test_errors_of_symmetric_objects_are_invariant_under_their_symmetries(seed, sides, step):
    random = np.random.default_rng(seed)
    turns = [Rotation.from_euler("z", 360.0 * k / sides, degrees=True).as_matrix() for k in range(sides)]
    wedge = random.normal(0.0, 0.05, (4, 3))
    vertices = np.concatenate([wedge @ turn.T for turn in turns])
    rotation, place, true_rotation, true_place = random_pairs(seed, 3)
    turn = turns[step % sides]
    np.testing.assert_allclose(
        adds_errors(rotation @ turn, place, true_rotation, true_place, vertices),
        adds_errors(rotation, place, true_rotation, true_place, vertices),
        atol=1e-12,
    )
    symmetries = np.stack(turns)
    error = rotation_errors(rotation, true_rotation, symmetries)
    np.testing.assert_allclose(rotation_errors(rotation @ turn, true_rotation, symmetries), error, atol=1e-6)
    assert (error <= rotation_errors(rotation, true_rotation) + 1e-9).all()
    assert rotation_errors(true_rotation @ turn, true_rotation, symmetries) == pytest.approx(0.0, abs=1e-6)


def test_continuous_symmetries_are_steps_about_the_axis():
    flip = (1.0, 0, 0, 0, 0, -1.0, 0, 0, 0, 0, -1.0, 0, 0, 0, 0, 1.0)
    symmetries = expand_symmetries(FileModelInfo(0.1, (flip,), (AXIS,)))
    assert len(symmetries) == 2 * 315
    np.testing.assert_array_equal(symmetries[0], np.eye(3))
    true = Rotation.random(50, rng=np.random.default_rng(3)).as_matrix()
    turns = Rotation.from_euler("z", np.linspace(0.0, 360.0, 50)[:, None], degrees=True).as_matrix()
    assert rotation_errors(true @ turns, true, symmetries).max() < 180.0 / 315 + 1e-9
    assert len(expand_symmetries(FileModelInfo())) == 1


def test_rotation_errors_are_precise_at_both_ends():
    angles = np.array([0.0, 1e-7, 1e-3, 90.0, 179.999, 180.0])
    turns = Rotation.from_euler("x", angles[:, None], degrees=True).as_matrix()
    assert rotation_errors(turns, np.broadcast_to(np.eye(3), turns.shape)) == pytest.approx(angles, abs=1e-10)


# ---- area under the accuracy-threshold curve ----

ERRORS = st.lists(st.one_of(st.floats(0.0, 0.2), st.sampled_from([0.0, 0.05, LIMIT, math.inf])), min_size=1, max_size=40)


def test_hand_computed_areas():
    assert exact_auc(np.zeros(3)) == vocap_auc(np.zeros(3)) == 1.0
    assert exact_auc(np.full(4, 0.05)) == pytest.approx(0.5)
    assert exact_auc(np.array([0.0, 0.05, np.inf, 0.3])) == pytest.approx(0.375)
    # VOCap: 1/2 over the first 5 cm, since the accuracy there is that of the error at its end; then 2/2.
    assert vocap_auc(np.array([0.05, 0.05])) == pytest.approx(0.75)
    assert vocap_auc(np.array([0.02, 0.06, np.inf, np.inf])) == pytest.approx((0.02 / 4 + 0.04 * 2 / 4 + 0.04 * 2 / 4) / 0.1)
    # Missing detections are misses.
    for auc in (exact_auc, vocap_auc):
        assert auc(np.full(3, np.inf)) == 0.0
        assert auc(np.array([0.0, np.inf])) == pytest.approx(0.5)
        assert math.isnan(auc(np.empty(0)))
    # Recall counts errors below the threshold.
    assert recall_curve(np.array([0.01, 0.02, np.inf]), np.array([0.0, 0.01, 0.015, 0.1])) == pytest.approx([0.0, 0.0, 1 / 3, 2 / 3])
    assert np.isnan(recall_curve(np.empty(0), np.array([0.1]))).all()


@given(errors=ERRORS)
@settings(max_examples=fuzz_examples(200))
def test_exact_is_the_integral_of_the_recall_curve_and_vocap_is_posecnns(errors):
    values = np.array(errors)
    knots = np.unique(np.concatenate(([0.0, LIMIT], values[values < LIMIT])))
    middle = 0.5 * (knots[1:] + knots[:-1])
    assert exact_auc(values) == pytest.approx((np.diff(knots) * recall_curve(values, middle)).sum() / LIMIT, abs=1e-12)
    expected = twin.vocap(values)
    assert vocap_auc(values) == pytest.approx(0.0 if math.isnan(expected) else expected, abs=1e-12)
    assert exact_auc(values) - 1e-12 <= vocap_auc(values) <= exact_auc(values) + 1.0 / len(values) + 1e-12


def test_bands_include_their_lower_limit_and_the_last_its_upper_one():
    index = band_indices(np.array([0.0, 0.09, 0.1, 1.0, 1.1, -0.1, np.nan]), (0.0, 0.1, 1.0))
    assert index.tolist() == [0, 0, 1, 1, -1, -1, -1]
    low, high = error_bands(np.array([0.05, np.inf, 0.01]), np.array([0.0, 0.5, 0.6]), (0.0, 0.1, 1.0))
    assert (low.count, low.auc, low.recall, low.median) == pytest.approx((1, 0.5, 1.0, 0.05))
    assert (high.count, high.auc, high.recall, high.median) == pytest.approx((2, 0.45, 0.5, 0.01))
    assert math.isnan(error_bands(np.empty(0), np.empty(0), (0.0, 1.0))[0].auc)
