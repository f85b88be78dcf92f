"""Command `estimate`: result files that `eval` scores, target lists, and one line for each mistake."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from synpick_warp.cli.commands.estimate import parse_indices
from synpick_warp.cli.main import main
from synpick_warp.errors import ConfigError
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from synpick_warp.exporters.writing.png import encode_png
from tests.worlds.box_sets import write_set


@pytest.fixture(scope="module", params=[BopExporter, ShardsExporter], ids=["bop", "shards"])
def folder(request, tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("estimate") / "set", request.param)


@pytest.fixture
def bop(tmp_path):
    return write_set(tmp_path / "set", BopExporter)


def run(folder, *arguments: object) -> int:
    return main(["estimate", "--data", str(folder), *map(str, arguments)])


def score(folder, results, *arguments: object) -> dict[str, object]:
    table = results.with_suffix(".json")
    assert (
        main(["eval", "--data", str(folder), "--results", str(results), "--format", "json", "--out", str(table), *map(str, arguments)]) == 0
    )
    return json.loads(table.read_text())["methods"][0]["rows"][-1]


def test_tracks_are_scored(folder, tmp_path, capsys):
    out = tmp_path / "track_set-train.csv"
    assert run(folder, "--method", "track", "--out", out) == 0
    output = capsys.readouterr().out
    assert "18 views, 54 poses in" in output
    assert output.splitlines()[-1] == f"results: {out}"
    assert [path.name for path in tmp_path.iterdir()] == [out.name]
    row = score(folder, out)
    assert row["targets"] == 54
    assert 80.0 < row["ADD-S exact"] < 100.0


def test_any_number_of_threads_writes_the_same(folder, tmp_path):
    tables = []
    for threads in (1, 3):
        out = tmp_path / f"{threads}.csv"
        assert run(folder, "--method", "track", "--threads", threads, "--out", out) == 0
        # The last column is time.
        tables.append([line.rpartition(",")[0] for line in out.read_text().splitlines()])
    assert tables[0] == tables[1]
    assert len(tables[0]) > 40


def test_some_images_have_a_target_list(folder, tmp_path, capsys):
    """Without the list, images that were left out are misses."""
    out = tmp_path / "refine.csv"
    assert run(folder, "--method", "refine", "--every", 2, "--cameras", "0,2", "--out", out) == 0
    targets = tmp_path / "refine-targets.json"
    assert f"targets: {targets}" in capsys.readouterr().out
    listed = json.loads(targets.read_text())
    assert {(one["scene_id"], one["im_id"]) for one in listed} == {(scene, image) for scene in (0, 2, 6, 8) for image in (0, 2)}
    assert sum(one["inst_count"] for one in listed) == 24
    row = score(folder, out, "--targets", targets)
    assert (row["targets"], row["recall"]) == (24, pytest.approx(100.0))
    assert row["ADD-S exact"] > 90.0
    assert score(folder, out)["targets"] == 54
    again = tmp_path / "again.csv"
    assert run(folder, "--method", "refine", "--targets", targets, "--out", again) == 0
    assert [line.rpartition(",")[0] for line in again.read_text().splitlines()] == [
        line.rpartition(",")[0] for line in out.read_text().splitlines()
    ]
    only = tmp_path / "only.csv"
    targets.write_text(json.dumps([{"scene_id": 6, "im_id": 1, "obj_id": 7, "inst_count": 1}, {"scene_id": 7, "im_id": 0}]))
    assert run(folder, "--method", "single", "--targets", targets, "--out", only) == 0
    lines = [line.split(",")[:3] for line in only.read_text().splitlines()[1:]]
    assert lines == [["6", "1", "7"], ["7", "0", "3"], ["7", "0", "3"], ["7", "0", "7"]]


def test_modes_and_episodes_choose(folder, tmp_path, capsys):
    out = tmp_path / "pick.csv"
    assert run(folder, "--method", "single", "--every", 1, "--modes", "pick", "--out", out) == 0
    assert {line.split(",")[0] for line in out.read_text().splitlines()[1:]} == {"6", "7", "8"}
    assert run(folder, "--method", "single", "--episodes", "0-0", "--threads", 2, "--seed", 5, "--out", out) == 0
    assert {line.split(",")[0] for line in out.read_text().splitlines()[1:]} == {"0", "1", "2"}
    assert capsys.readouterr().err == ""


def test_indices():
    assert parse_indices("--cameras", "2, 0-1,1") == (0, 1, 2)
    for text in ("", "a", "2-1", "0-99999999", "-1", "1,,2"):
        with pytest.raises(ConfigError, match="--cameras is"):
            parse_indices("--cameras", text)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--method", "cosypose"], '--method is "cosypose"; allowed: single, refine, track'),
        (["--depth", "raw"], '--depth is "raw"; allowed: clean, sensor'),
        (["--depth", "sensor"], 'has no depth_sensor; bake with render.layers = ["depth_sensor"], or use --depth clean'),
        (["--every", "0"], "--every is 0; allowed: 1 for all frames, or more"),
        (["--every", "1.5"], '--every is "1.5"; allowed: a whole number'),
        (["--method", "track", "--every", "5"], "--method track takes every frame"),
        (["--method", "track", "--targets", "{targets}"], "--method track takes every frame"),
        (["--every", "2", "--targets", "{targets}"], "--every and --targets both choose images"),
        (["--targets", "{folder}/none.json"], "there is no file {folder}/none.json"),
        (["--targets", "{folder}/config.toml"], "config.toml is damaged"),
        (["--targets", "{empty}"], "lists no images"),
        (["--targets", "{targets}"], "the data set has no scene 99"),
        (["--modes", "stir"], "--modes names stir; allowed: move, pick, target"),
        (["--modes", "target"], "no image of {folder} is left by"),
        (["--cameras", "3"], "--cameras names 3; allowed: 0, 1, 2"),
        (["--episodes", "1"], "--episodes names 1; allowed: 0, 2"),
        (["--visib-min", "1.5"], "--visib-min is 1.5; allowed: 0 to 1"),
        (["--visib-min", "nan"], "--visib-min is nan; allowed: 0 to 1"),
        (["--seed", "-1"], "--seed is -1; allowed: 0 to"),
        (["--out", "{folder}"], "; allowed: a file in an existing folder"),
        (["--out", "{folder}/none/a.csv"], "; allowed: a file in an existing folder"),
        (["--targets", "{targets}", "--out", "{targets}"], "which would replace {targets}; name another file"),
        (["--targets", "{targets}", "--out", "{own}"], "which would replace {targets}; name another file"),
    ],
)
def test_mistakes_are_one_line(folder, tmp_path, capsys, arguments, message):
    files = {"targets": tmp_path / "targets.json", "empty": tmp_path / "empty.json", "own": tmp_path / "own.csv"}
    if "{own}" in arguments:
        files["targets"] = tmp_path / "own-targets.json"
    files["targets"].write_text('[{"scene_id": 99, "im_id": 0, "obj_id": 3, "inst_count": 1}]')
    files["empty"].write_text("[]")
    before = sorted((*folder.rglob("*"), *tmp_path.rglob("*")))
    given = [text.format(folder=folder, **files) for text in arguments]
    options = {"--method": "single", "--out": str(tmp_path / "out.csv")}
    options |= dict(zip(given[::2], given[1::2], strict=True))
    assert run(folder, *(text for pair in options.items() for text in pair)) == 2
    output, error = capsys.readouterr()
    assert output == ""
    assert error.startswith("synpick-warp: error: ")
    assert message.format(folder=folder, **files) in error
    assert error.count("\n") == 1
    assert sorted((*folder.rglob("*"), *tmp_path.rglob("*"))) == before


def test_damaged_sets_are_refused(bop, tmp_path, capsys):
    def refuse(message: str) -> None:
        assert run(bop, "--method", "single", "--every", 1, "--out", tmp_path / "out.csv") == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "out.csv").exists()
        assert not list(tmp_path.glob("*.json"))

    image = bop / "train" / "000006" / "depth" / "000001.png"
    saved = image.read_bytes()
    image.write_bytes(encode_png(np.zeros((72, 90), np.uint16)))
    refuse("has 90 x 72 pixels; the images of this camera have 96 x 72")
    image.write_bytes(saved)
    for scene in (bop / "train").iterdir():
        shutil.rmtree(scene / "mask_visib")
    refuse("has no mask_visib; bake with bop.masks = true")


def test_sets_without_models_or_textures_are_refused(bop, tmp_path, capsys):
    arguments = ("--method", "single", "--out", tmp_path / "out.csv")
    for name, message in (
        ("obj_000003.png", "obj_000003.ply refers to"),
        ("obj_000003.ply", "has no models/obj_000003.ply"),
        ("models_info.json", "has no models/models_info.json"),
    ):
        (bop / "models" / name).unlink()
        assert run(bop, *arguments) == 2
        assert message in capsys.readouterr().err
    shutil.rmtree(bop / "train")
    assert run(bop, *arguments) == 2
    assert "has no episode to estimate poses in" in capsys.readouterr().err
    assert run(tmp_path, *arguments) == 2
    assert "is not a data set" in capsys.readouterr().err


def crash(path: Path, unit: float) -> None:
    """Stands in for a decoder of images that a model's texture crashes."""
    os.kill(os.getpid(), signal.SIGSEGV)


def test_a_model_whose_reader_crashes_is_one_line(bop, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("synpick_warp.apps.estimation.gicp.read_mesh", crash)
    assert run(bop, "--method", "single", "--out", tmp_path / "out.csv") == 2
    line = capsys.readouterr().err
    assert re.search(r"obj_\d{6}\.ply: the process that reads it crashed \(SIGSEGV\); repair or simplify the file\n$", line)


def test_a_missing_library_is_one_line(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    assert run(folder, "--method", "refine", "--out", tmp_path / "out.csv") == 2
    assert capsys.readouterr().err.startswith("synpick-warp: error: estimate needs small_gicp")


def test_lists_that_do_not_fit_the_data_set_are_refused_by_eval(folder, tmp_path, capsys):
    out, targets = tmp_path / "out.csv", tmp_path / "targets.json"
    assert run(folder, "--method", "track", "--out", out) == 0
    for content, message in (
        ([{"scene_id": 0, "im_id": 7}], "the data set has no image 7 in scene 0"),
        ([{"scene_id": 0, "im_id": 1, "obj_id": 99}], "--visib-min is 0.1; no instance of"),
    ):
        targets.write_text(json.dumps(content))
        capsys.readouterr()
        assert main(["eval", "--data", str(folder), "--results", str(out), "--targets", str(targets)]) == 2
        assert message in capsys.readouterr().err
