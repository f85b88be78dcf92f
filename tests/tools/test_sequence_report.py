"""The report on frames of episodes: rows, bounds, kept references and the contact sheet."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from synpick_warp.configs.files.load import load_config
from tests.builders import FEW_STEPS, ONE_OBJECT
from tools.reports import sequence
from tools.reports.sequence import GAP, LINE, Pair, ReferenceStore, Shot, draw_sheet, summarize_pairs


def shot(level: int, size: tuple[int, int] = (9, 16)) -> Shot:
    """A uniform grey image."""
    return Shot(np.full((*size, 3), level, np.uint8), np.full((*size, 3), level / 255, np.float32))


def pair(denoised: Shot, *references: Shot) -> Pair:
    return Pair("map", denoised, (references[0], references[-1]))


def test_quality_is_psnr_without_the_references_noise():
    assert round(pair(shot(101), shot(100)).quality, 3) == 48.131
    assert pair(shot(100), shot(100)).quality > 100.0
    assert pair(shot(100), shot(110)).bias == pytest.approx(-100.0 / 11.0, rel=1e-4)
    random = np.random.default_rng(0)
    truth = random.uniform(60, 190, (256, 256, 3))
    noisy = [np.rint(truth + random.normal(0.0, 12.0, truth.shape)).astype(np.uint8) for _ in range(2)]
    denoised, first, second = (Shot(color, color / np.float32(255)) for color in (np.rint(truth + 4.0).astype(np.uint8), *noisy))
    assert pair(denoised, first).quality == pytest.approx(10 * np.log10(255**2 / (4.0**2 + 12.0**2)), abs=0.2)
    assert pair(denoised, first, second).quality == pytest.approx(10 * np.log10(255**2 / 4.0**2), abs=0.5)


def test_bounds_are_of_the_means():
    good, dark = pair(shot(100), shot(100)), pair(shot(98), shot(110))
    assert [row.holds for row in summarize_pairs([good, good])] == [True, True, True]
    assert [row.holds for row in summarize_pairs([dark, dark])] == [False, True, False]


def test_a_sheet_has_a_labelled_row_per_pair_and_large_images_are_shrunk():
    sheet = draw_sheet([pair(shot(100), shot(110))] * 2)
    assert sheet.shape == (LINE + 2 * (9 * 40 + GAP + LINE), 3 * (640 + GAP), 3)
    assert [int(sheet[2 * LINE + 5, column * (640 + GAP) + 5, 0]) for column in range(3)] == [100, 110, 50]
    assert sheet[LINE : 2 * LINE].min() < 100  # The label.
    assert draw_sheet([pair(shot(10, (72, 1280)), shot(10, (72, 1280)))]).shape == (2 * LINE + 36 + GAP, 3 * (640 + GAP), 3)


@pytest.mark.parametrize("arguments", [["--size", "32"], ["--size", "axb"], ["--set", "render.bounces=0"]])
def test_a_bad_size_or_setting_is_one_line(capsys, arguments):
    assert sequence.main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("reports.sequence: ")


@pytest.mark.slow
def test_a_report_of_a_sequence_compares_its_frames_with_references(tmp_path, capsys):
    """A bound of 35 dB does not hold for tiny images of few paths: exit code 1."""
    file, sheet = tmp_path / "numbers.json", tmp_path / "sheet.png"
    options = ["--mode", "move", "--frames", "3,0", "--size", "32x18", "--samples", "4", "--json", str(file), "--sheet", str(sheet)]
    code = sequence.main([*options, *FEW_STEPS])
    rows = {row["name"]: row for row in json.loads(file.read_text())["rows"]}
    frames = [int(name.split(",")[0].removeprefix("frame ")) for name in rows if name.endswith("denoised against reference")]
    assert frames == [0, 3]
    mean = rows["denoised against reference, mean"]
    assert mean["value"] == pytest.approx(
        np.mean([row["value"] for name, row in rows.items() if name.endswith(": denoised against reference")])
    )
    assert (mean["holds"], code) == (mean["value"] >= 35.0, 1)
    assert cv2.imread(str(sheet)).shape[1] == 3 * (32 * 20 + GAP)
    capsys.readouterr()
    assert sequence.main(["--frames", "100000", "--mode", "move", "--size", "32x18", *FEW_STEPS, "--set", "move.speed=9"]) == 2
    assert "no episode has frame 100000" in capsys.readouterr().err


@pytest.mark.slow
def test_references_are_kept_for_other_settings_of_the_denoiser(tmp_path, monkeypatch, capsys):
    rendered, original = [], ReferenceStore._render
    monkeypatch.setattr(ReferenceStore, "_render", lambda *given: rendered.append(1) or original(*given))

    def run(*options: str) -> tuple[dict[str, float], int]:
        """Values, and the number of references that were rendered."""
        file, before = tmp_path / "numbers.json", len(rendered)
        common = ["--mode", "move", "--frames", "0,3", "--size", "32x18", "--references", str(kept), "--json", str(file)]
        sequence.main([*common, *FEW_STEPS, *options])
        return {row["name"]: row["value"] for row in json.loads(file.read_text())["rows"]}, len(rendered) - before

    kept = tmp_path / "kept"
    kept.mkdir()
    few = ["--samples", "4"]
    first = run(*few)
    assert first[1] == 2
    assert run(*few) == (first[0], 0)
    coarser, count = run(*few, "--set", "render.coarse_pixel=4")
    assert (coarser == first[0], count) == (False, 0)
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
        ((_, found),) = sequence.compare_frames(config, (12,))
        quality[history] = found.quality
    assert quality[16] > quality[0]
