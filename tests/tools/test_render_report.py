"""Report on the renderer: rows, bounds, images and contact sheets."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import warp as wp

from synpick_warp.configs.files.load import load_config
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot
from tests.builders import FEW_STEPS, ONE_OBJECT
from tools.reports import render as render_report
from tools.reports import render_checks, render_piles, render_sheet
from tools.reports import sequence as render_sequence
from tools.reports.reference_store import ReferenceStore


def shot(level: int, size: tuple[int, int] = (9, 16)):
    """A uniform grey image."""
    return render_checks.Shot(
        np.full((*size, 3), level, np.uint8), np.full((*size, 3), level / 255, np.float32), np.zeros(size, np.uint8), 1.0
    )


def test_psnr_of_images_that_differ_by_one_grey_level():
    image = np.full((4, 4, 3), 100, np.uint8)
    assert round(render_piles.psnr(image, image + 1), 3) == 48.131
    assert render_piles.psnr(image, image) > 100.0
    assert render_piles.mean_difference(shot(100), shot(98)) == 2.0


def test_two_references_tell_the_error_without_their_noise():
    random = np.random.default_rng(0)
    truth = random.uniform(60, 190, (256, 256, 3))
    noisy = [np.rint(truth + random.normal(0.0, 12.0, truth.shape)).astype(np.uint8) for _ in range(2)]
    denoised, first, second = (replace(shot(0, (256, 256)), color=color) for color in (np.rint(truth + 4.0).astype(np.uint8), *noisy))
    one, two = render_piles.Pair("map", denoised, first, 1.0), render_piles.Pair("map", denoised, first, 1.0, second)
    assert one.quality == pytest.approx(10 * np.log10(255**2 / (4.0**2 + 12.0**2)), abs=0.2)
    assert two.quality == pytest.approx(10 * np.log10(255**2 / 4.0**2), abs=0.5)


def test_a_report_of_one_pile_has_all_rows_and_images(tmp_path):
    file, out, sheet = tmp_path / "numbers.json", tmp_path / "pictures", tmp_path / "sheet.png"
    options = ("--scenes", "1", "--size", "32x18", "--samples", "8", "--json", str(file), "--out", str(out), "--sheet", str(sheet))
    code = render_report.main([*options, *FEW_STEPS])
    rows = {row["name"]: row for row in json.loads(file.read_text())["rows"]}
    assert all(row["holds"] for name, row in rows.items() if name.startswith("reference: "))
    assert code == int(not all(row["holds"] for row in rows.values()))
    assert rows["denoised against reference, mean"]["value"] > 5.0
    assert rows["denoised: frames of a static scene, mean difference"]["value"] < 1.0
    assert rows["reference: paths"]["value"] > 0.0
    assert not [name for name in rows if "against itself" in name]
    # The pile is rendered under each of the embedded skies, which are at least six.
    pictures = sorted(out.iterdir())
    assert len(pictures) >= 6
    assert {cv2.imread(str(picture)).shape for picture in pictures} == {(18, 96, 3)}
    assert cv2.imread(str(sheet)).shape[1] == 3 * (32 * 20 + render_sheet.GAP)


@pytest.mark.slow
def test_a_second_reference_measures_noise(tmp_path, monkeypatch):
    file = tmp_path / "numbers.json"
    for name in ("measure_furnaces", "measure_planes"):
        monkeypatch.setattr(render_report, name, lambda *_: [])
    render_report.main(["--scenes", "1", "--size", "16x9", "--samples", "2", "--noise", "--json", str(file), *FEW_STEPS])
    (row,) = (row for row in json.loads(file.read_text())["rows"] if row["name"].endswith("reference against itself"))
    assert 5.0 < row["value"] < 90.0


def test_sheets_have_a_labelled_row_per_pair_and_continue_in_further_files(tmp_path):
    pairs = [render_piles.Pair(f"map {index}", shot(100), shot(110), 100 / 255) for index in range(render_sheet.MAX_ROWS + 2)]
    files = render_sheet.write_sheets(pairs, tmp_path / "deep" / "sheet.png")
    assert [file.name for file in files] == ["sheet.png", "sheet-2.png"]
    first, second = (cv2.imread(str(file)) for file in files)
    row = 9 * 40 + render_sheet.GAP + render_sheet.LINE
    assert first.shape == (render_sheet.LINE + render_sheet.MAX_ROWS * row, 3 * (640 + render_sheet.GAP), 3)
    assert second.shape[0] == render_sheet.LINE + 2 * row
    top = 2 * render_sheet.LINE + 5
    assert [int(first[top, column * (640 + render_sheet.GAP) + 5, 0]) for column in range(3)] == [100, 110, 50]
    assert first[render_sheet.LINE : 2 * render_sheet.LINE].min() < 100  # The label.
    assert pairs[0].bias == pytest.approx(-100.0 / 11.0, rel=1e-4)


def test_large_images_are_shrunk():
    pair = render_piles.Pair("map", shot(10, (72, 1280)), shot(10, (72, 1280)), 1.0)
    assert render_sheet.draw_sheet([pair]).shape == (2 * render_sheet.LINE + 36 + render_sheet.GAP, 3 * (640 + render_sheet.GAP), 3)


def test_the_next_frame_displaces_objects_and_keeps_the_rest(device):
    snapshot = allocate(Snapshot, {"world": 1, "instance": 2, "fixture": 3}, device)
    snapshot.frame.fill_(7)
    snapshot.pose.fill_(wp.transform((1.0, 2.0, 3.0), wp.quat_identity()))
    after = render_piles.next_frame(snapshot, 0.5)
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


@pytest.mark.slow
def test_a_report_of_a_sequence_compares_its_frames_with_references(tmp_path, capsys):
    """A bound of 35 dB does not hold for tiny images of few paths: exit code 1."""
    file, sheet = tmp_path / "numbers.json", tmp_path / "sheet.png"
    options = ["--mode", "move", "--frames", "3,0", "--size", "32x18", "--samples", "4", "--json", str(file), "--sheet", str(sheet)]
    code = render_sequence.main([*options, *FEW_STEPS])
    rows = {row["name"]: row for row in json.loads(file.read_text())["rows"]}
    frames = [int(name.split(",")[0].removeprefix("frame ")) for name in rows if name.endswith("denoised against reference")]
    assert frames == [0, 3]
    mean = rows["denoised against reference, mean"]
    assert mean["value"] == pytest.approx(
        np.mean([row["value"] for name, row in rows.items() if name.endswith(": denoised against reference")])
    )
    assert (mean["holds"], code) == (mean["value"] >= 35.0, 1)
    assert cv2.imread(str(sheet)).shape[1] == 3 * (32 * 20 + render_sheet.GAP)
    capsys.readouterr()
    assert render_sequence.main(["--frames", "100000", "--mode", "move", "--size", "32x18", *FEW_STEPS, "--set", "move.speed=9"]) == 2
    assert "no episode has frame 100000" in capsys.readouterr().err


@pytest.mark.slow
def test_references_are_kept_for_other_settings_of_the_denoiser(tmp_path, monkeypatch, capsys):
    def run(*options: str) -> tuple[dict[str, float], int]:
        """Values, and the number of references that were rendered."""
        file, rendered = tmp_path / "numbers.json", []
        original = ReferenceStore._render
        monkeypatch.setattr(ReferenceStore, "_render", lambda *given: rendered.append(1) or original(*given))
        common = ["--mode", "move", "--frames", "0,3", "--size", "32x18", "--references", str(kept), "--json", str(file)]
        render_sequence.main([*common, *FEW_STEPS, *options])
        monkeypatch.setattr(ReferenceStore, "_render", original)
        return {row["name"]: row["value"] for row in json.loads(file.read_text())["rows"]}, len(rendered)

    kept = tmp_path / "kept"
    kept.mkdir()
    few = ["--samples", "4"]
    first = run(*few)
    assert first[1] == 2
    assert run(*few) == (first[0], 0)
    coarser, rendered = run(*few, "--set", "render.coarse_pixel=4")
    assert (coarser == first[0], rendered) == (False, 0)
    assert run("--samples", "8")[1] == run(*few, "--seed", "5")[1] == 2
    assert len(list(kept.iterdir())) == 6
    with pytest.raises(SystemExit, match="2"):
        run("--references", str(tmp_path / "none"))
    assert "there is no folder" in capsys.readouterr().err


@pytest.mark.slow
def test_histories_bring_frames_nearer_to_the_reference():
    """With histories later frames have more paths than single frames have; references of few paths suffice, as their noise cancels."""
    fixed = {"cameras.resolution": [64, 36], "bake.mode": "move", "bake.episodes": 1, "bake.worlds": 1, "render.samples": 64}
    given = fixed | ONE_OBJECT | {"bake.device": "cpu"}
    quality = {}
    for history in (0, 16):
        config = load_config("synpick", given | {"render.history": history})
        ((_, pair),) = render_sequence.compare_frames(config, (12,))
        quality[history] = pair.quality
    assert quality[16] > quality[0]
