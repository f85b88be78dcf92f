"""tools/reports/render.py: its numbers, its bounds, its pictures."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import warp as wp

from synpick_warp.arrays import allocate
from synpick_warp.stages.buffers import Snapshot
from tools.reports import render as render_report
from tools.reports import render_checks, render_piles, render_sheet

FEW = (
    "--device",
    "cpu",
    "--set",
    "arrangement.volume=1e-3",
    "--set",
    "arrangement.max_objects=1",
    "--set",
    "physics.substeps=1",
    "--set",
    "physics.steps_per_tick=10",
    "--set",
    "settle.min_time=0.1",
    "--set",
    "settle.rest_ticks=2",
)
"""One object, and as few steps as bring it to rest."""


def shot(level: int, size: tuple[int, int] = (9, 16)):
    """A grey picture."""
    return render_checks.Shot(
        np.full((*size, 3), level, np.uint8), np.full((*size, 3), level / 255, np.float32), np.zeros(size, np.uint8), 1.0
    )


def test_psnr_of_pictures_that_differ_by_one_grey_level():
    picture = np.full((4, 4, 3), 100, np.uint8)
    assert round(render_piles.psnr(picture, picture + 1), 3) == 48.131
    assert render_piles.psnr(picture, picture) > 100.0
    assert render_piles.difference(shot(100), shot(98)) == 2.0


def test_a_report_of_one_pile_has_all_lines_and_pictures(tmp_path):
    file, out, sheet = tmp_path / "numbers.json", tmp_path / "pictures", tmp_path / "sheet.png"
    options = ["--scenes", "1", "--size", "32x18", "--samples", "8", "--json", str(file), "--out", str(out), "--sheet", str(sheet), *FEW]
    code = render_report.main(options)
    rows = {row["name"]: row for row in json.loads(file.read_text())["rows"]}
    assert all(row["holds"] for name, row in rows.items() if name.startswith("reference: "))
    assert code == int(not all(row["holds"] for row in rows.values()))
    assert rows["fast against reference, mean"]["value"] > 5.0
    assert rows["fast: frames of a still scene, mean difference"]["value"] < 1.0
    assert rows["reference: paths"]["value"] > 0.0
    assert not [name for name in rows if "against itself" in name]
    # The one pile is seen under each of the embedded skies, of which there are at least six.
    pictures = sorted(out.iterdir())
    assert len(pictures) >= 6
    assert {cv2.imread(str(picture)).shape for picture in pictures} == {(18, 96, 3)}
    assert cv2.imread(str(sheet)).shape[1] == 3 * (32 * 20 + render_sheet.GAP)


def test_a_second_reference_tells_of_noise(tmp_path, monkeypatch):
    file = tmp_path / "numbers.json"
    for name in ("furnaces", "planes"):
        monkeypatch.setattr(render_report, name, lambda *_: [])
    render_report.main(["--scenes", "1", "--size", "16x9", "--samples", "2", "--noise", "--json", str(file), *FEW])
    (row,) = (row for row in json.loads(file.read_text())["rows"] if row["name"].endswith("reference against itself"))
    assert 5.0 < row["value"] < 90.0


def test_a_sheet_has_a_labelled_row_a_map_and_goes_on_beside_itself(tmp_path):
    pairs = [render_piles.Pair(f"map {number}", shot(100), shot(110), 100 / 255) for number in range(render_sheet.MOST_ROWS + 2)]
    files = render_sheet.contact_sheets(pairs, tmp_path / "deep" / "sheet.png")
    assert [file.name for file in files] == ["sheet.png", "sheet-2.png"]
    first, second = (cv2.imread(str(file)) for file in files)
    row = 9 * 40 + render_sheet.GAP + render_sheet.LINE
    assert first.shape == (render_sheet.LINE + render_sheet.MOST_ROWS * row, 3 * (640 + render_sheet.GAP), 3)
    assert second.shape[0] == render_sheet.LINE + 2 * row
    top = 2 * render_sheet.LINE + 5
    assert [int(first[top, number * (640 + render_sheet.GAP) + 5, 0]) for number in range(3)] == [100, 110, 50]
    assert first[render_sheet.LINE : 2 * render_sheet.LINE].min() < 100  # The label.
    assert pairs[0].bias == pytest.approx(-100.0 / 11.0, rel=1e-4)


def test_large_pictures_are_made_smaller():
    pair = render_piles.Pair("map", shot(10, (72, 1280)), shot(10, (72, 1280)), 1.0)
    assert render_sheet.draw_sheet([pair]).shape == (2 * render_sheet.LINE + 36 + render_sheet.GAP, 3 * (640 + render_sheet.GAP), 3)


def test_a_frame_follows_a_snapshot_with_nothing_but_time_and_a_shift(device):
    snapshot = allocate(Snapshot, {"world": 1, "instance": 2, "fixture": 3}, device)
    snapshot.frame.fill_(7)
    snapshot.pose.fill_(wp.transform((1.0, 2.0, 3.0), wp.quat_identity()))
    after = render_piles.following(snapshot, 0.5)
    assert after.frame.numpy().tolist() == [8]
    assert after.follows.numpy().tolist() == [1]
    assert after.pose.numpy()[0, 1, :3].tolist() == [1.5, 2.0, 3.0]
    assert np.array_equal(after.last_pose.numpy(), snapshot.pose.numpy())
    assert snapshot.frame.numpy().tolist() == [7]


def test_a_bad_size_or_setting_is_an_error(capsys):
    assert render_report.main(["--size", "32", "--scenes", "0"]) == 2
    assert render_report.main(["--size", "axb", "--scenes", "0"]) == 2
    assert render_report.main(["--set", "render.bounces=0", "--scenes", "0"]) == 2
    assert render_report.main(["--sheet", "sheet.txt"]) == 2
    assert capsys.readouterr().err.count("reports.render: ") == 4
