"""Simulated picks: tables of episodes and views, maps, arrays of suctionnetAPI, and what a damaged or missing table says. Their pictures:
interpolated maps, sentences on trials, sheets, the report's section, and scores."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

import synpick_warp
from synpick_warp.apps.conversion.run import convert
from synpick_warp.apps.report import compose
from synpick_warp.apps.statistics.picks import ALL, FACED, SCORES, UNIFORM, evaluate_picks
from synpick_warp.apps.viz.picks import choose_trial, describe_trial, draw_pick_maps, spread_over_surface, write_pick_sheet
from synpick_warp.cli.main import main
from synpick_warp.codes import Ending, Outcome, Share
from synpick_warp.configs.files.load import config_to_toml
from synpick_warp.dataset import picks as reader
from synpick_warp.dataset.pytorch import Views
from synpick_warp.dataset.view import find_pixels, mean_by_candidate
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.exporters.picks import FOLDER, PicksExporter, check_schema, from_table, make_table, pick_files
from synpick_warp.testing.box_views import EACH, REPEATS, cameras, config, pick_batch
from synpick_warp.testing.exporters import export
from synpick_warp.views.picks import COLUMNS, STATES, are_sorted, make_rows, sort_rows
from tests.builders import mistake, run
from tests.harness import scripted_bake
from tests.worlds.box_sets import write_pick_set, write_set


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """Boxes as BOP scenes, with picks."""
    return write_pick_set(tmp_path_factory.mktemp("picks") / "set")


def test_tables_of_an_episode_are_those_of_its_batches(whole):
    episode, batch = synpick_warp.open(whole)[2], pick_batch(2)
    assert episode.picks.tobytes() == sort_rows(make_rows(COLUMNS, batch.trials)).tobytes()
    assert episode.picks.point.shape == (len(batch), 3)
    np.testing.assert_array_equal(episode.pick_states.visible, batch.states["visible"])


def test_trials_of_a_view_lie_on_their_objects(whole):
    """Grasp points project to their pixels in camera 0, and to visible pixels of the same instance or behind others in camera 1."""
    episode = synpick_warp.open(whole)[0]
    view = episode.view(2)
    assert len(view.picks) == 3 * EACH * REPEATS
    assert set(view.picks.frame) == {2}
    np.testing.assert_array_equal(find_pixels(view, view.picks), np.column_stack((view.picks.column, view.picks.row)))
    assert len(episode.view(1).picks) == 0
    assert np.isnan(episode.view(1).graspable).all()


@pytest.mark.parametrize("camera", [0, 1])
def test_graspable_is_the_share_of_successes_at_tried_pixels(whole, camera):
    view = synpick_warp.open(whole)[0].view(0, camera)
    known = np.argwhere(~np.isnan(view.graspable))
    shown = view.masks.any(axis=0)[tuple(known.T)]
    assert shown.all()
    pixels, picks = find_pixels(view, view.picks), view.picks
    for row, column in known:
        here = (pixels == (column, row)).all(axis=1)
        assert view.graspable[row, column] == np.float32(picks.success[here].mean())
    assert len(known) == 3 * EACH if camera == 0 else 0 < len(known) <= 3 * EACH


def test_suctions_are_candidates_in_the_camera_frame(whole):
    view = synpick_warp.open(whole)[0].view(0)
    first, success = mean_by_candidate(view.picks)
    assert view.suctions.shape == (3 * EACH, 7)
    np.testing.assert_array_equal(view.suctions[:, 0], success.astype(np.float32))
    np.testing.assert_allclose(view.project(view.suctions[:, 4:]), view.project(view.picks.point[first], view.world_to_camera), atol=1e-2)
    assert (view.suctions[:, 3] < 0).all(), "normals face the camera"


def test_the_file_beside_a_scene_has_the_candidates_of_its_frames(whole):
    """Candidates in camera coordinates: their points project to the pixels of the table, and success is the share of their trials."""
    content = json.loads((whole / "train" / "000000" / "scene_picks.json").read_text())
    assert list(content) == ["0", "2"]
    assert not (whole / "train" / "000001" / "scene_picks.json").exists(), "camera 1 has chosen nothing"
    view = synpick_warp.open(whole)[0].view(2)
    first, success = mean_by_candidate(view.picks)
    tried, found = view.picks[first], content["2"]
    assert [one["instance_id"] for one in found] == tried["instance"].tolist()
    np.testing.assert_allclose([one["success"] for one in found], success)
    np.testing.assert_allclose([one["score"] for one in found], tried["seal"] * tried["wrench"], atol=2e-6)
    np.testing.assert_array_equal(np.floor([one["pixel"] for one in found]), np.column_stack((tried["column"], tried["row"])))
    np.testing.assert_allclose(np.array([one["point"] for one in found]) / 1e3, view.suctions[:, 4:], atol=1e-6)
    np.testing.assert_allclose([one["normal"] for one in found], view.suctions[:, 1:4], atol=1e-6)
    assert {one["trials"] for one in found} == {REPEATS}


def replaced(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    """A table with another column in a column's place."""
    return table.set_column(table.column_names.index(name), name, values)


DAMAGE = {
    "column gone": (lambda table: table.drop_columns("seal"), "it has 0 columns seal; allowed: 1"),
    "column renamed": (lambda table: table.rename_columns({"seal": "Seal"}), "it has 0 columns seal; allowed: 1"),
    "column twice": (lambda table: table.append_column("seal", table["seal"]), "it has 2 columns seal; allowed: 1"),
    "another column": (lambda table: table.append_column("more", table["seal"]), "it has 1 columns more; allowed: 0"),
    "type": (lambda table: replaced(table, "seal", table["seal"].cast("double")), "column seal has the type double; allowed: float"),
    "size": (lambda table: replaced(table, "point", table["seal"]), r"column point has the type float; allowed: fixed_size_list.*\[3\]"),
    "null": (lambda table: replaced(table, "hits", pa.array([1, None] * 24, "int32")), "column hits, row 1 has no value"),
    "null in a list": (
        lambda table: replaced(table, "point", pa.array([[0, 0, 0], [0, None, 0]] * 24, pa.list_(pa.float32(), 3))),
        "column point, row 1 has no value",
    ),
    "order": (lambda table: table.take([1, 0, *range(2, 48)]), "column state, row 1 is 0; allowed: rows sorted by state, candidate and"),
    "twice": (lambda table: table.take([0, 0, *range(2, 48)]), "column state, row 1 is 0; allowed: .* none twice"),
    "empty": (lambda table: table.slice(0, 0), r"states.000002.parquet, column candidates, row 0 is 12; allowed: 0"),
}
BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut": (lambda place: place.write_bytes(place.read_bytes()[:-9]), "000002.parquet cannot be read: "),
    "missing": (Path.unlink, "there is no file .*000002.parquet"),
}


@pytest.fixture
def copied(whole, tmp_path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "set"))


@pytest.mark.parametrize("change", [*DAMAGE, *BROKEN])
def test_damaged_tables_are_refused(copied, change):
    place, (damage, message) = copied / FOLDER / "000002.parquet", (DAMAGE | BROKEN)[change]
    damage(place) if change in BROKEN else pq.write_table(damage(pq.read_table(place)), place)
    data = synpick_warp.open(copied)
    with pytest.raises(DatasetError, match=message):
        data[2].picks  # noqa: B018
    assert len(data[0].picks)


WRONG = {"f": (np.nan, np.inf, -np.inf), "i": (-2, -(2**31)), "u": (255, 77)}
"""Values that no column allows, by kind of its type."""
BOUNDED = ("frame", "candidate", "column", "row", "instance", "picked", "camera", "candidates")
"""Columns that refer to something, so that no number is too large for their type alone."""


@pytest.mark.parametrize(("place", "columns"), list(zip(pick_files(2), (COLUMNS, STATES), strict=True)), ids=("trials", "states"))
def test_each_column_has_its_domain(copied, place, columns):
    """One wrong value in the last row of a column: table, column, row and value are named."""
    table = pq.read_table(copied / place)
    for column in columns:
        values = [*WRONG.get(np.dtype(column.dtype).kind, ()), *[2**31 - 1] * (column.name in BOUNDED), *[1.5] * (column.high == 1)]
        for value in values[column.undefined :]:
            rows, row = from_table(table, columns, check_schema(table.schema, columns)), len(table) - 1
            rows[column.name][row] = value
            pq.write_table(make_table(columns, rows), copied / place)
            with pytest.raises(DatasetError, match=rf"parquet, column {column.name}, row {row} is \S.*; allowed: \S") as fault:
                synpick_warp.open(copied)[2].pick_states  # noqa: B018
            assert str(copied / place) in str(fault.value)
            assert re.search(rf"is \[?{re.escape(str(rows[column.name][row].ravel()[0]))}", str(fault.value))


def test_limits_missing_tables_and_a_data_set_of_picks_alone(whole, tmp_path, monkeypatch):
    alone = export(PicksExporter, tmp_path / "alone", config(), (0, 2))
    (alone / "config.toml").write_text(config_to_toml(config()))
    (alone / "manifest.json").write_text("{}")
    assert list(synpick_warp.open(alone)) == [0, 2]
    with pytest.raises(DatasetError, match=r"set has no picks; bake it with --formats picks"):
        synpick_warp.open(write_set(tmp_path / "set", BopExporter))[0].picks  # noqa: B018
    monkeypatch.setattr(reader, "MAX_ROWS", 5)
    with pytest.raises(DatasetError, match=r"000000\.parquet has 48 rows; at most 5 are read"):
        synpick_warp.open(whole)[0].picks  # noqa: B018


def test_order_of_rows():
    rows = sort_rows(make_rows(COLUMNS, pick_batch(0).trials))
    assert all(are_sorted(rows[:count]).all() for count in (0, 1, None))
    assert are_sorted(rows[[1, 0, 2, 2]]).tolist() == [True, False, True, False]


def picks_of(folder: Path) -> dict[str, tuple[str, bytes]]:
    """Files of picks."""
    return {name: content for name, content in scripted_bake.snapshot(folder).items() if "picks" in name}


def test_a_bake_is_verified_joined_and_converted_with_its_picks(tmp_path):
    """Two shards of a bake are joined to its bytes; scenes that are made of shards have the same scene_picks.json."""
    given = {"bop.split": "train", "bop.color_format": "png", "bop.masks": True, "bop.coco": False}
    config = scripted_bake.settings(2, ("bop", "shards", "picks")).with_values(given)
    whole, parts = tmp_path / "whole", [tmp_path / f"part{index}" for index in range(2)]
    scripted_bake.bake(whole, config, picks=True)
    for index, part in enumerate(parts):
        scripted_bake.bake(part, config, (index, 2), picks=True)
    assert run("merge", *parts, "--out", tmp_path / "joined").code == 0
    assert run("verify", tmp_path / "joined").code == 0
    joined = picks_of(tmp_path / "joined")
    assert joined == picks_of(whole)
    assert {"picks/000001.parquet", "picks/states/000001.parquet", "train/000003/scene_picks.json"} <= set(joined)
    (whole / "picks" / "000001.parquet").write_bytes(b"PAR1")
    assert run("verify", whole).code == 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("synpick_warp.scenes.cameras.make_cameras", lambda _: cameras(16, 12))
        for name in ("shards", "bop"):
            scripted_bake.bake(tmp_path / name, config.with_values({"bake.formats": (name, "picks")}), picks=True)
        convert(tmp_path / "shards", tmp_path / "scenes", ("bop",), 1, lambda *_: None)
    made, baked = (tmp_path / name / "train/000003/scene_picks.json" for name in ("scenes", "bop"))
    assert made.read_bytes() == baked.read_bytes()


# ---- pictures ----


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> synpick_warp.dataset.reading.DataSet:
    return synpick_warp.open(write_pick_set(tmp_path_factory.mktemp("picks") / "set"))


def test_a_map_has_the_values_of_its_points_and_nothing_beyond_their_instances(data):
    view = data[0].view(0)
    pixels = np.argwhere(view.masks[0])
    points = pixels[[0, -1], ::-1] + 0.5
    instance = view.instance_ids[0]
    found = spread_over_surface(view, points, np.array([instance, instance]), np.array([0.0, 1.0]))
    np.testing.assert_array_equal(np.isnan(found), ~view.masks[0])
    ends = found[tuple(pixels[[0, -1]].T)]
    np.testing.assert_allclose(ends, (0.0, 1.0), atol=0.01)
    middle = pixels[
        np.abs(
            np.linalg.norm(pixels[:, ::-1] + 0.5 - points[0], axis=1) - np.linalg.norm(pixels[:, ::-1] + 0.5 - points[1], axis=1)
        ).argmin()
    ]
    assert 0.4 < found[tuple(middle)] < 0.6
    one = spread_over_surface(view, points[:1], np.array([instance]), np.array([0.25]))
    np.testing.assert_allclose(one[view.masks[0]], 0.25)


def test_maps_mark_the_tried_points(data):
    view = data[2].view(2)
    (said, success), (_, score) = draw_pick_maps(view, view.picks, 480)
    assert success.shape == score.shape == (360, 480, 3)
    assert "simulated success" in said
    assert f"of {len(view.picks) // 2} points" in said
    assert (success != score).any()


def trial(data, **changes) -> np.void:
    """A trial that fails after a poor seal, with some columns changed."""
    row = data[0].picks[data[0].picks["repeat"] == 0][:1].copy()
    values = {
        "point": (0.1, 0.0, 0.02),
        "approach": (0.0, 0.6, -0.8),
        "normal": (0.0, -1.0, 0.0),
        "seal": 0.5,
        "wrench": 0.8,
        "hits": 7,
        "sealed": 0,
        "success": False,
    }
    values |= {"peak_force": 2.5, "margin": -0.25, "time_to_break": 0.4, "outcome": Outcome.DROPPED, "share": Share.UNIFORM, "moved": 0}
    for name, value in (values | changes).items():
        row[name] = value
    return row[0]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, r"on the box at \(100, 0, 20\) mm, pressed 37 degrees off the vertical, 53 off the surface normal"),
        ({}, r"seal 0\.50, wrench 0\.80, score 0\.40"),
        ({}, r"7 rays hit; poor seal\|largest seal force 2\.5 N, margin -0\.25: it broke after 0\.40 s\|outcome: every seal broke"),
        ({"hits": 0, "outcome": Outcome.NOTHING_CAUGHT}, r"no ray of the cup hit an object\|outcome: no ray"),
        ({"sealed": 5}, "good seals"),
        ({"offset": (0.0, 0.003, 0.004), "friction": 0.8}, r"point by 5\.0 mm, cup by 0\.0 degrees, friction by a factor of 0\.80"),
        ({"moved": 2, "farthest": 0.031, "lost": 1}, "2 other objects moved, by up to 31 mm; 1 fell out of the bin"),
        ({"outcome": Outcome.NONE, "ending": Ending.NOT_FINITE}, "no outcome: a pose became infinite"),
    ],
)
def test_a_trial_is_told_in_sentences(data, changes, said):
    assert re.search(said, "|".join(describe_trial(trial(data, **changes), "the box")))


def test_the_most_surprising_failure_is_explained(data):
    picks = data[0].picks[data[0].picks["state"] == 0]
    chosen = choose_trial(picks)
    failed = picks[(picks["repeat"] == 0) & ~picks["success"]]
    assert chosen["candidate"] == failed["candidate"][np.argmax(failed["seal"] * failed["wrench"])]
    assert choose_trial(picks, 3)["candidate"] == 3
    with pytest.raises(DatasetError, match="the state has no candidate 99; it has 12 candidates"):
        choose_trial(picks, 99)


def test_a_sheet_has_two_maps_and_a_trial(data, tmp_path):
    sheet = cv2.imread(str(write_pick_sheet(data, tmp_path / "sheet.png", 2, 1, 4)))
    assert sheet.shape[1] == 2 * 880 + 60
    for wrong, said in (((1, None), "has no episode 1"), ((0, 7), "episode 0 has no state 7; it has 2 states")):
        with pytest.raises(DatasetError, match=said):
            write_pick_sheet(data, tmp_path / "none.png", *wrong)


def test_commands_draw_picks(data, tmp_path, capsys):
    maps, sheet = tmp_path / "maps.png", tmp_path / "sheet.png"
    assert main(["preview", str(data.folder), "--picks", "--views=3", f"--out={maps}"]) == 0
    assert main(["explain", str(data.folder), "--state=1", f"--out={sheet}"]) == 0
    assert cv2.imread(str(maps)).shape == (3 * (48 + 660 + 20), 2 * 880 + 60, 3)
    assert cv2.imread(str(sheet)).shape[1] == 2 * 880 + 60
    for options, said in (
        (["--state=5"], "episode 0 has no state 5; it has 2 states"),
        (["--candidate=5"], "--candidate is 5, but no state is named; add --state"),
        (["--episode=0", "--attempt=0", "--state=0"], "--attempt is given beside --state, which is of picks; allowed: one of both"),
    ):
        assert mistake("explain", str(data.folder), *options) == said


def test_samples_of_pytorch_have_candidates(data):
    sample = Views(data.folder, fields=("pick_pixels", "pick_success", "pick_weights"), cameras=(0,))[2]
    view = data[0].view(2)
    assert len(sample["pick_pixels"]) == len(sample["pick_weights"]) == 12
    columns, rows = sample["pick_pixels"].T
    np.testing.assert_array_equal(sample["pick_success"], view.graspable[rows, columns])


@pytest.fixture(autouse=True)
def _no_attempts(monkeypatch):
    monkeypatch.setattr(compose, "choose_attempts", lambda *_: [])  # That of the boxes was never seen.


def test_the_page_has_a_section_of_picks(data, tmp_path):
    page = compose.write_report(data, tmp_path / "report.html", frames=1, threads=1).read_text(encoding="utf-8")
    section = page.partition('<section id="picks">')[2].partition("</section>")[0]
    assert section.count('src="data:image/webp;base64,') == 4
    assert "By object: all candidates, seal x wrench" in section
    assert '"name":"calibration"' in page


def test_own_grasps_alone_have_maps_but_no_scores(tmp_path):
    """As with picks.candidates = 1: the report is written, and says why no score is evaluated."""
    folder = write_pick_set(tmp_path / "set")
    for index in (0, 2):
        trials, states = pick_files(index)
        table = pq.read_table(folder / trials).filter(pc.field("candidate") == 0)
        pq.write_table(table.set_column(4, "share", pa.array([0] * len(table), "uint8")), folder / trials)
        table = pq.read_table(folder / states)
        pq.write_table(table.set_column(5, "candidates", pa.array([1] * len(table), "int32")), folder / states)
    page = compose.write_report(synpick_warp.open(folder), tmp_path / "report.html", frames=1, threads=1).read_text(encoding="utf-8")
    section = page.partition('<section id="picks">')[2].partition("</section>")[0]
    assert section.count('src="data:image/webp;base64,') == 4
    assert "picks.candidates = 1" in section
    assert '"name":"calibration"' not in page


def test_figures_of_hand_made_trials():
    """Success follows the seal alone: its AUC is 1, that of a wrench without meaning 0.5; own grasps and those without outcome are out."""
    count = 8
    names = ("cluster", "candidate", "share", "weight", "obj_id", "seal", "wrench", "angle", "outcome", "success")
    trials = np.zeros(
        count,
        [(name, np.float64 if name in ("weight", "seal", "wrench", "angle") else np.int64) for name in names[:-1]] + [("success", bool)],
    )
    trials["cluster"], trials["candidate"], trials["weight"] = np.arange(count) // 4, np.arange(count) % 4, 2.0
    trials["share"], trials["outcome"], trials["obj_id"] = Share.UNIFORM, Outcome.DROPPED, 3
    trials["seal"], trials["success"], trials["wrench"] = [0.1, 0.2, 0.8, 0.9] * 2, [0, 0, 1, 1] * 2, 0.5
    extra = trials[:2].copy()
    extra["share"], extra["outcome"] = (Share.OWN, Share.UNIFORM), (Outcome.DROPPED, Outcome.NONE)
    alike = evaluate_picks(np.concatenate((trials, extra)), 1, {3: "box"}, draws=20)
    assert {each.population for each in alike.scores} == {UNIFORM, ALL}, "all are pressed along the normal"
    trials["angle"][0] = 20.0
    figures = evaluate_picks(np.concatenate((trials, extra)), 1, {3: "box"}, draws=20)
    assert (figures.trials, figures.left_out, figures.states, figures.candidates) == (8, 2, 2, 8)
    areas = {(each.population, each.score): each.auc.value for each in figures.scores}
    assert areas == {(where, score): 0.5 if score == "wrench" else 1.0 for where in (UNIFORM, FACED, ALL) for score in SCORES}
    assert figures.objects[0].success.value == 0.5
