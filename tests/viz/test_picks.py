"""Pictures of simulated picks: interpolated maps, sentences on trials, sheets, the report's section, and scores."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

import synpick_warp
from synpick_warp.apps.report import compose
from synpick_warp.apps.statistics.picks import ALL, FACED, SCORES, UNIFORM, evaluate_picks
from synpick_warp.apps.viz.picks import choose_trial, describe_trial, draw_pick_maps, spread_over_surface, write_pick_sheet
from synpick_warp.cli.main import main
from synpick_warp.codes import Ending, Outcome, Share
from synpick_warp.dataset.pytorch import Views
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.picks import pick_files
from tests.builders import mistake
from tests.worlds.box_sets import write_pick_set


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
