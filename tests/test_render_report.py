"""tools/render_report.py: its numbers, its bounds, its pictures."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
FEW = (
    "--device", "cpu", "--set", "arrangement.volume=1e-3", "--set", "arrangement.max_objects=1",
    "--set", "physics.substeps=1", "--set", "physics.steps_per_tick=10", "--set", "settle.min_time=0.1", "--set", "settle.rest_ticks=2",
)  # fmt: skip
"""One object, and as few steps as bring it to rest."""


def load_tool():
    spec = importlib.util.spec_from_file_location("render_report", ROOT / "tools" / "render_report.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["render_report"] = module
    spec.loader.exec_module(module)
    return module


render_report = load_tool()


def test_psnr_of_pictures_that_differ_by_one_grey_level():
    picture = np.full((4, 4, 3), 100, np.uint8)
    assert round(render_report.psnr(picture, picture + 1), 3) == 48.131
    assert render_report.psnr(picture, picture) > 100.0


def test_a_report_of_one_pile_has_all_lines_and_a_picture(tmp_path):
    file, out = tmp_path / "numbers.json", tmp_path / "pictures"
    code = render_report.main(["--scenes", "1", "--size", "32x18", "--samples", "8", "--json", str(file), "--out", str(out), *FEW])
    rows = {row["name"]: row for row in json.loads(file.read_text())["rows"]}
    assert all(row["holds"] for name, row in rows.items() if name.startswith("reference: "))
    assert code == int(not all(row["holds"] for row in rows.values()))
    assert rows["fast against reference, mean"]["value"] > 5.0
    (picture,) = out.iterdir()
    assert cv2.imread(str(picture)).shape == (18, 96, 3)


def test_a_bad_size_or_setting_is_an_error(capsys):
    assert render_report.main(["--size", "32", "--scenes", "0"]) == 2
    assert render_report.main(["--size", "axb", "--scenes", "0"]) == 2
    assert render_report.main(["--set", "render.bounces=0", "--scenes", "0"]) == 2
    assert capsys.readouterr().err.count("render_report: ") == 3
