"""Command `eval`: tables, files, the BOP toolkit's command, and one line for each mistake."""

from __future__ import annotations

import csv
import json
import os
import shlex
import shutil
import subprocess
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import synpick_warp
from synpick_warp.apps.evaluation.results import write_results
from synpick_warp.apps.evaluation.run import method_names
from synpick_warp.apps.evaluation.truth import read_truth
from synpick_warp.cli.commands.evaluate import toolkit_command
from synpick_warp.cli.main import main
from synpick_warp.system.codecs.charts import SCALE, WIDTH
from tests.worlds.evaluation_set import moved, write_evaluation_set


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_evaluation_set(tmp_path_factory.mktemp("command") / "synpick")


@pytest.fixture(scope="module")
def files(folder):
    """Result files: perfect, and off by 5 cm."""
    poses = read_truth(synpick_warp.open(folder)).poses
    good, bad = folder.parent / "icg_synpick-train-pbr.csv", folder.parent / "bad.csv"
    write_results(good, poses)
    write_results(bad, moved(poses, (0.0, 0.0, 0.05)))
    return good, bad


def run(*arguments: object) -> int:
    return main(["eval", *map(str, arguments)])


@pytest.mark.parametrize("repeated", [("--results",), ()])
def test_methods_stand_beside_each_other(folder, files, capsys, repeated):
    assert run("--data", folder, "--results", files[0], *repeated, files[1]) == 0
    output, error = capsys.readouterr()
    assert error == ""
    lines = output.splitlines()
    assert lines[0].split() == ["icg", "bad"]
    mean = next(line for line in lines if line.startswith("mean"))
    assert mean.split()[1:3] == ["72", "100.0"]
    assert mean.split()[8] == "50.0"
    assert lines[-1].startswith("BOP_PATH=")


def test_other_styles_keep_the_standard_output_clean(folder, files, capsys):
    assert run("--data", folder, "--results", files[1], "--format", "json", "--visib-min", "0", "--top", "0", "--vertices", "5") == 0
    output, error = capsys.readouterr()
    table = json.loads(output)
    assert table["methods"][0]["rows"][-1]["targets"] == 96
    assert synpick_warp.evaluate(folder, files[1:], min_visibility=0.0, top=0, vertices=5) == table
    assert "eval_bop19_pose.py" in error


def test_the_filter_scores_each_method_once_more(folder, files, capsys):
    """With weight 1 it changes nothing; with the paper's 0.05 it lags behind what moves, and only there."""

    def methods(*arguments: object) -> dict[str, dict[str, float]]:
        assert run("--data", folder, "--results", *files, "--format", "json", "--vertices", 50, "--filter", "ema", *arguments) == 0
        found = json.loads(capsys.readouterr().out)["methods"]
        return {one["method"]: {f"{row['group']} {row['label']}": row["ADD exact"] for row in one["rows"]} for one in found}

    neutral = methods("--alpha", 1)
    assert list(neutral) == ["icg", "icg + EMA 1", "bad", "bad + EMA 1"]
    assert neutral["icg + EMA 1"] == pytest.approx(neutral["icg"])
    assert neutral["bad + EMA 1"] == pytest.approx(neutral["bad"])
    paper = methods()
    lost = {row: value - paper["icg + EMA 0.05"][row] for row, value in paper["icg"].items() if row.startswith("speed")}
    assert next(iter(lost.values())) == pytest.approx(0.0, abs=1e-6)
    assert max(lost.values()) > 10.0


def test_a_table_is_written_to_a_file(folder, files, tmp_path, capsys):
    out = tmp_path / "table.tex"
    assert run("--data", folder, "--results", files[0], "--format", "latex", "--convention", "vocap", "--out", out) == 0
    assert "convention vocap" in out.read_text()
    assert capsys.readouterr().out.startswith(f"table: {out}\n# BOP scores")
    assert [path.name for path in tmp_path.iterdir()] == ["table.tex"]


def test_images_without_an_estimate_are_told(folder, files, tmp_path, capsys):
    header, *rows = files[0].read_text().splitlines()
    few, list_beside = tmp_path / "few.csv", tmp_path / "few-targets.json"
    few.write_text("\n".join((header, *rows[:1])))
    images = len({tuple(row.split(",")[:2]) for row in rows})
    said = f"{few} has no estimate in {images - 1} of {images} images, whose objects count as missed"
    assert run(folder, "--results", files[0], few, "--vertices", 50) == 0
    assert capsys.readouterr().err == f"{said}\n"
    list_beside.write_text("[]")
    assert run(folder, "--results", few, "--vertices", 50) == 0
    assert capsys.readouterr().err == f"{said}; --targets {list_beside} scores those that were estimated\n"


def test_the_toolkits_command_has_the_names_that_the_toolkit_parses(folder, files):
    data = synpick_warp.open(folder)
    lines = toolkit_command(data, files).splitlines()
    assert lines[1] == f"cp {files[1]} {folder.parent / 'bad_synpick-train-pbr.csv'}"
    words = shlex.split(lines[-1])
    assert words[:3] == [f"BOP_PATH={folder.parent}", "python", "scripts/eval_bop19_pose.py"]
    assert "--result_filenames=icg_synpick-train-pbr.csv,bad_synpick-train-pbr.csv" in words
    assert "--targets_filename=test_targets_bop19.json" in words
    assert f"--targets_filename={folder / 'few.json'}" in toolkit_command(data, files, folder / "few.json")
    other = write_evaluation_set(folder.parent / "my set_1")
    lines = toolkit_command(synpick_warp.open(other), files[:1]).splitlines()
    assert shlex.split(lines[1]) == ["ln", "-sfn", str(other), str(folder.parent / "myset1")]
    assert shlex.split(lines[2])[2] == str(folder.parent / "icgsynpicktrainpbr_myset1-train-pbr.csv")


def test_the_toolkit_gets_results_of_the_first_sensor_with_the_ids_of_its_scenes(folder, files, tmp_path):
    data = synpick_warp.open(folder)
    source = shutil.copy(files[0], tmp_path / "icg.csv")
    several = SimpleNamespace(folder=folder, sensors=("cam0", "cam1", "cam2"), split_folders=data.split_folders)
    lines = toolkit_command(several, [source]).splitlines()
    assert "scripts/eval_bop24_pose.py" in lines[-1]
    assert lines[-1].endswith("--result_filenames=icg_synpick-train-pbr.csv --targets_filename=test_targets_bop24.json")
    subprocess.run(["bash", "-c", lines[-2]], check=True)
    all_rows, rows = (path.read_text().splitlines() for path in (source, tmp_path / "icg_synpick-train-pbr.csv"))
    expected = [row.split(",", 1) for row in all_rows[1:] if int(row.partition(",")[0]) % 3 == 0]
    assert rows == [all_rows[0], *(f"{int(scene) // 3},{rest}" for scene, rest in expected)]
    assert {row.partition(",")[0] for row in rows[1:]} == {"0", "1"}


def test_methods_have_different_names(tmp_path):
    assert method_names([tmp_path / "a_set-test.csv", tmp_path / "b.csv"]) == ["a", "b"]
    assert method_names([tmp_path / "a_set-test.csv", tmp_path / "a_set-val.csv"]) == ["a_set-test", "a_set-val"]
    assert method_names([tmp_path / "1" / "a.csv", tmp_path / "2" / "a.csv"]) == [str(tmp_path / name / "a.csv") for name in "12"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--format", "html"], '--format is "html"; allowed: text, latex, csv, json'),
        (["--convention", "coco"], '--convention is "coco"; allowed: exact, vocap'),
        (["--visib-min", "1.5"], "--visib-min is 1.5; allowed: 0 to 1"),
        (["--visib-min", "nan"], "--visib-min is nan; allowed: 0 to 1"),
        (["--top", "-2"], "--top is -2; allowed: -1 for as many as instances, 0 for all"),
        (["--alpha", "0.1"], "--alpha is 0.1, but there is no filter; add --filter ema"),
        (["--filter", "kalman"], '--filter is "kalman"; allowed: ema'),
        (["--filter", "ema", "--alpha", "0"], "alpha 0.0 is not allowed: it is the weight of the new estimate, above 0 and at most 1"),
        (["--vertices", "-1"], "--vertices is -1; allowed: 0 for all"),
        (["--top", "1.5"], '--top is "1.5"; allowed: a whole number'),
        (["--out", "{folder}/none/table.txt"], "/none/table.txt; allowed: a file in an existing folder"),
        (["--out", "{folder}"], "; allowed: a file in an existing folder"),
        (["--out", "{good}"], ", which the command reads; name another file"),
        (["--plots", "{folder}"], "--plots is {folder}; allowed: a new folder, or an empty one"),
        (["--plots", "{good}"], "; allowed: a new folder, or an empty one"),
        (["--plots", "{good}/below"], "/below, but {good} is a file; name another folder"),
        (["--plots", "{folder}/new"], "--plots is {folder}/new, among the files of the data set {folder}; name a folder outside of it"),
        (["--track", "0:1"], "--track is 0:1, but there are no plots; add --plots DIR"),
        (["--plots", "{good}-new", "--track", "one"], '--track is "one"; allowed: SCENE:INSTANCE, such as 3:12'),
        (["--plots", "{good}-new", "--track", "9:1"], "--track is 9:1; the data set has no such scene and instance"),
        (["--results", "{folder}/none.csv"], "there is no file {folder}/none.csv"),
        (["--results", "{folder}/config.toml"], "/config.toml, line 1 has 1 columns; allowed: 7 separated by commas"),
    ],
)
def test_mistakes_are_one_line(folder, files, capsys, arguments, message):
    before = sorted(folder.rglob("*"))
    given = [text.format(folder=folder, good=files[0]) for text in arguments]
    assert run("--data", folder, "--results", files[0], *given) == 2
    output, error = capsys.readouterr()
    assert output == ""
    assert error.startswith("synpick-warp: error: ")
    assert message.format(folder=folder, good=files[0]) in error
    assert error.count("\n") == 1
    assert sorted(folder.rglob("*")) == before


def test_folders_that_are_no_data_sets_are_refused(files, tmp_path, capsys):
    assert run("--data", tmp_path, "--results", files[0]) == 2
    assert "is not a data set" in capsys.readouterr().err
    assert run("--data", tmp_path) == 2
    assert run("--results", files[0]) == 2
    assert run("--data", tmp_path, "--results") == 2
    assert "--results has no value; name BOP result files" in capsys.readouterr().err


def test_visibility_that_no_instance_has_is_refused(folder, files, tmp_path, capsys):
    hidden = write_evaluation_set(tmp_path / "hidden")
    for path in hidden.rglob("scene_gt_info.json"):
        path.write_text(path.read_text().replace('"visib_fract": 1.0', '"visib_fract": 0.5'))
    assert run("--data", hidden, "--results", files[0], "--visib-min", "0.9") == 2
    assert "--visib-min is 0.9; no instance of" in capsys.readouterr().err


def test_names_that_do_not_print_are_escaped(folder, files, capsys, tmp_path):
    odd = tmp_path / "a\nb\x1b\udcff.csv"
    odd.write_bytes(files[0].read_bytes())
    for style in ("text", "latex", "csv", "json"):
        assert run("--data", folder, "--results", odd, "--format", style, "--out", tmp_path / style) == 0
        assert "\x1b" not in (tmp_path / style).read_text()
        assert "\x1b" not in capsys.readouterr().out


ERRORS = ("error_by_speed", "error_by_visibility", "recall")
PICTURES = [f"{name}_{metric}.png" for name in ERRORS for metric in ("add", "add_or_s", "add_s")]
KINDS = (("alpha_sweep", ""), ("trajectory", "_scene_000004_instance_1"))


def test_plots_are_written_to_a_new_or_empty_folder(folder, files, tmp_path, capsys):
    """One of the two moving bricks is faster: instance 3 of the first scene in which it is so."""
    for name in ("new/deep", "empty"):
        (tmp_path / "empty").mkdir(exist_ok=True)
        assert run("--data", folder, "--results", *files, "--plots", tmp_path / name) == 0
        found = {path.name for path in (tmp_path / name).iterdir()}
        assert found == {*PICTURES, *(f"trajectory_{method}_scene_000000_instance_3.png" for method in ("icg", "bad"))}
        lines = capsys.readouterr().out.splitlines()
        assert {line.removeprefix("picture: ") for line in lines if line.startswith("picture: ")} == {
            str(tmp_path / name / each) for each in found
        }
        assert lines[-1].startswith("BOP_PATH=")
        for each in found:
            assert cv2.imread(str(tmp_path / name / each)).shape[1] == SCALE * WIDTH


def test_plots_with_a_filter_have_a_sweep_of_each_method(folder, files, tmp_path, capsys):
    given = ("--filter", "ema", "--format", "csv", "--plots", tmp_path / "plots", "--track", "4:1", "--vertices", 20)
    assert run("--data", folder, "--results", *files, *given) == 0
    output, error = capsys.readouterr()
    assert output.startswith("group,")
    assert "picture: " not in output
    names = {path.name for path in (tmp_path / "plots").iterdir()}
    assert names == {*PICTURES, *(f"{kind}_{method}{end}.png" for kind, end in KINDS for method in ("icg", "bad"))}
    assert error.count("picture: ") == len(names)


def test_a_track_that_a_method_lacks_is_not_chosen_and_is_refused(folder, files, tmp_path, capsys):
    poses = read_truth(synpick_warp.open(folder)).poses
    slow = tmp_path / "slow.csv"
    write_results(slow, poses.select((poses.scene == 2) & (poses.instance == 1)))
    assert run("--data", folder, "--results", files[0], slow, "--plots", tmp_path / "plots") == 0
    trajectories = sorted(path.name for path in (tmp_path / "plots").glob("trajectory*"))
    assert trajectories == [f"trajectory_{method}_scene_000002_instance_1.png" for method in ("icg", "slow")]
    capsys.readouterr()
    assert run("--data", folder, "--results", files[0], slow, "--plots", tmp_path / "other", "--track", "0:3") == 2
    assert "--track is 0:3; slow has no estimate of it; choose another one" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_methods_of_odd_names_have_pictures_of_their_own(folder, files, tmp_path):
    for name in ("a b", "a+b", "Ground truth"):
        (tmp_path / f"{name}.csv").write_bytes(files[0].read_bytes())
    assert run("--data", folder, "--results", *sorted(tmp_path.glob("*.csv")), "--plots", tmp_path / "plots") == 0
    ending = "scene_000000_instance_3.png"
    names = {path.name for path in (tmp_path / "plots").glob("trajectory*")}
    assert names == {f"trajectory_{number}_{name}_{ending}" for number, name in ((1, "Ground_truth"), (2, "a_b"), (3, "a_b"))}


@pytest.fixture(scope="module", params=["bop,zarr", "shards"])
def baked(request, picked_set, tmp_path_factory):
    others = ("train", "trajectory.zarr") if request.param == "shards" else ("train_web",)
    return shutil.copytree(picked_set, tmp_path_factory.mktemp("baked") / "set", ignore=lambda *_: others, copy_function=os.link)


def test_the_truth_of_a_bake_scores_100(baked, tmp_path, capsys):
    data = synpick_warp.open(baked)
    truth = read_truth(data)
    assert len(truth.images) == sum(len(episode) for episode in data.values()) * data.camera_count
    assert set(truth.mode) == {"pick"}
    assert np.isfinite(truth.speed).all()
    assert 0.0 <= truth.speed.min() <= truth.speed.max() < 10.0
    results, table = tmp_path / "truth.csv", tmp_path / "table.csv"
    write_results(results, truth.poses)
    options = ("--format", "csv", "--out", str(table), "--visib-min", "0")
    assert main(["eval", "--data", str(baked), "--results", str(results), *options]) == 0
    capsys.readouterr()
    rows = list(csv.DictReader(table.read_text().splitlines()))
    values = [float(row[column]) for row in rows for column in row if column.startswith("ADD")]
    assert (min(values), max(values)) == pytest.approx((100.0, 100.0))
    labels = {row["label"] for row in rows if row["group"] == "object"}
    assert labels <= ({"boxes_1", "boxes_2", "boxes_3"} if data.has_store else {"obj_000001", "obj_000002", "obj_000003"})
