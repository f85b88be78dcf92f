"""Command `eval`: tables, files, the BOP toolkit's command, and one line for each mistake."""

import csv
import json
import os
import shlex
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import synpick_warp
from synpick_warp.apps.evaluation.results import method_names, write_results
from synpick_warp.apps.evaluation.truth import read_truth
from synpick_warp.cli.commands.evaluate import toolkit_command
from synpick_warp.system.codecs.charts import SCALE, WIDTH
from tests.builders import mistake, run
from tests.worlds.evaluation_set import moved, write_evaluation_set
from tests.worlds.model_files import put


@pytest.fixture(scope="module")
def files(folder, truth, tmp_path_factory):
    """Result files: perfect, and off by 5 cm."""
    results = tmp_path_factory.mktemp("results")
    good, bad = results / "icg_synpick-train-pbr.csv", results / "bad.csv"
    write_results(good, truth.poses)
    write_results(bad, moved(truth.poses, (0.0, 0.0, 0.05)))
    return good, bad


def evaluated(*arguments: object) -> tuple[str, str]:
    """Output of a run that ends well."""
    code, output, error = run("eval", *arguments)
    assert code == 0, error
    return output, error


@pytest.mark.parametrize("repeated", [("--results",), ()])
def test_methods_stand_beside_each_other(folder, files, repeated):
    output, error = evaluated("--data", folder, "--results", files[0], *repeated, files[1])
    assert error == ""
    lines = output.splitlines()
    assert lines[0].split() == ["icg", "bad"]
    mean = next(line for line in lines if line.startswith("mean"))
    assert mean.split()[1:3] == ["72", "100.0"]
    assert mean.split()[8] == "50.0"
    assert lines[-1].startswith("BOP_PATH=")


def test_other_styles_keep_the_standard_output_clean_and_files_get_the_table(folder, files, tmp_path):
    options = ("--format", "json", "--visib-min", 0, "--top", 0, "--vertices", 5)
    output, error = evaluated("--data", folder, "--results", files[1], *options)
    table = json.loads(output)
    assert table["methods"][0]["rows"][-1]["targets"] == 96
    assert synpick_warp.evaluate(folder, files[1:], min_visibility=0.0, top=0, vertices=5) == table
    assert "eval_bop19_pose.py" in error
    out = tmp_path / "table.tex"
    output, _ = evaluated("--data", folder, "--results", files[0], "--format", "latex", "--convention", "vocap", "--out", out)
    assert "convention vocap" in out.read_text()
    assert output.startswith(f"table: {out}\n# BOP scores")
    assert [path.name for path in tmp_path.iterdir()] == ["table.tex"]


def test_the_filter_scores_each_method_once_more(folder, files):
    """With weight 1 it changes nothing; with the paper's 0.05 it lags behind what moves, and only there."""

    def methods(*arguments: object) -> dict[str, dict[str, float]]:
        given = ("--format", "json", "--vertices", 50, "--filter", "ema", *arguments)
        found = json.loads(evaluated("--data", folder, "--results", *files, *given)[0])["methods"]
        return {one["method"]: {f"{row['group']} {row['label']}": row["ADD exact"] for row in one["rows"]} for one in found}

    neutral = methods("--alpha", 1)
    assert list(neutral) == ["icg", "icg + EMA 1", "bad", "bad + EMA 1"]
    assert neutral["icg + EMA 1"] == pytest.approx(neutral["icg"])
    assert neutral["bad + EMA 1"] == pytest.approx(neutral["bad"])
    paper = methods()
    lost = {row: value - paper["icg + EMA 0.05"][row] for row, value in paper["icg"].items() if row.startswith("speed")}
    assert next(iter(lost.values())) == pytest.approx(0.0, abs=1e-6)
    assert max(lost.values()) > 10.0


def test_images_without_an_estimate_are_told(folder, files, tmp_path):
    header, *rows = files[0].read_text().splitlines()
    few = put(tmp_path / "few.csv", "\n".join((header, *rows[:1])))
    images = len({tuple(row.split(",")[:2]) for row in rows})
    said = f"{few} has no estimate in {images - 1} of {images} images, whose objects count as missed"
    assert evaluated(folder, "--results", files[0], few, "--vertices", 50)[1] == f"{said}\n"
    beside = put(tmp_path / "few-targets.json", "[]")
    assert evaluated(folder, "--results", few, "--vertices", 50)[1] == f"{said}; --targets {beside} scores those that were estimated\n"


def test_the_toolkits_command_has_the_names_that_the_toolkit_parses(folder, files, tmp_path):
    data = synpick_warp.open(folder)
    lines = toolkit_command(data, files).splitlines()
    assert lines[1] == f"cp {files[1]} {files[1].parent / 'bad_synpick-train-pbr.csv'}"
    words = shlex.split(lines[-1])
    assert words[:3] == [f"BOP_PATH={folder.parent}", "python", "scripts/eval_bop19_pose.py"]
    assert "--result_filenames=icg_synpick-train-pbr.csv,bad_synpick-train-pbr.csv" in words
    assert "--targets_filename=test_targets_bop19.json" in words
    assert f"--targets_filename={folder / 'few.json'}" in toolkit_command(data, files, folder / "few.json")
    other = write_evaluation_set(tmp_path / "my set_1")
    lines = toolkit_command(synpick_warp.open(other), files[:1]).splitlines()
    assert shlex.split(lines[1]) == ["ln", "-sfn", str(other), str(tmp_path / "myset1")]
    assert shlex.split(lines[2])[2] == str(files[0].parent / "icgsynpicktrainpbr_myset1-train-pbr.csv")
    paths = [Path(name) for name in ("a_set-test.csv", "b.csv", "a_set-val.csv", "1/a.csv", "2/a.csv")]
    for some, names in ((paths[:2], ["a", "b"]), (paths[::2][:2], ["a_set-test", "a_set-val"]), (paths[3:], ["1/a.csv", "2/a.csv"])):
        assert method_names(some) == names


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
        (["--vertices", "-1"], "--vertices is -1; allowed: 0 for all"),
        (["--top", "1.5"], '--top is "1.5"; allowed: a whole number'),
        (["--out", "{folder}/none/table.txt"], "/none/table.txt; allowed: a file in an existing folder"),
        (["--out", "{folder}"], "; allowed: a file in an existing folder"),
        (["--out", "{good}"], ", which the command reads; name another file"),
        (["--plots", "{folder}"], "--plots is {folder}; allowed: a new or an empty folder"),
        (["--plots", "{good}"], "; allowed: a new or an empty folder"),
        (["--plots", "{good}/below"], "/below, but {good} is a file; name another folder"),
        (["--plots", "{folder}/new"], "--plots is {folder}/new, among the files of the data set {folder}; name a folder outside of it"),
        (["--track", "0:1"], "--track is 0:1, but there are no plots; add --plots DIR"),
        (["--plots", "{good}-new", "--track", "one"], '--track is "one"; allowed: SCENE:INSTANCE, such as 3:12'),
        (["--plots", "{good}-new", "--track", "9:1"], "--track is 9:1; the data set has no such scene and instance"),
        (["--results", "{folder}/none.csv"], "there is no file {folder}/none.csv"),
    ],
)
def test_mistakes_are_one_line(folder, files, arguments, message):
    before = sorted(folder.rglob("*"))
    given = [text.format(folder=folder, good=files[0]) for text in arguments]
    code, output, error = run("eval", "--data", folder, "--results", files[0], *given)
    assert (code, output, error.count("\n")) == (2, "", 1)
    assert error.startswith("synpick-warp: error: ")
    assert message.format(folder=folder, good=files[0]) in error
    assert sorted(folder.rglob("*")) == before


def test_what_cannot_be_scored_is_one_line(files, tmp_path):
    hidden = write_evaluation_set(tmp_path / "hidden")
    for path in hidden.rglob("scene_gt_info.json"):
        path.write_text(path.read_text().replace('"visib_fract": 1.0', '"visib_fract": 0.5'))
    for given, said in (
        (("--data", tmp_path, "--results", files[0]), "is not a data set"),
        (("--data", tmp_path), ""),
        (("--results", files[0]), ""),
        (("--data", tmp_path, "--results"), "--results has no value; name BOP result files"),
        (("--data", hidden, "--results", files[0], "--visib-min", "0.9"), "--visib-min is 0.9; no instance of"),
    ):
        assert said in mistake("eval", *given)


def test_names_that_do_not_print_are_escaped(folder, files, tmp_path):
    odd = put(tmp_path / "a\nb\x1b\udcff.csv", files[0].read_bytes())
    for style in ("text", "latex", "csv", "json"):
        output, _ = evaluated("--data", folder, "--results", odd, "--format", style, "--out", tmp_path / style)
        assert "\x1b" not in (tmp_path / style).read_text() + output


METHODS = ("icg", "bad")
ERRORS = ("error_by_speed", "error_by_visibility", "recall")
PICTURES = [f"{name}_{metric}.png" for name in ERRORS for metric in ("add", "add_or_s", "add_s")]
KINDS = (("alpha_sweep", ""), ("trajectory", "_scene_000004_instance_1"))


def test_plots_are_written_to_a_new_folder(folder, files, tmp_path):
    """One of the two moving bricks is faster: instance 3 of the first scene in which it is so."""
    lines = evaluated("--data", folder, "--results", *files, "--plots", tmp_path / "new/deep")[0].splitlines()
    found = set((tmp_path / "new/deep").iterdir())
    assert {path.name for path in found} == {*PICTURES, *(f"trajectory_{method}_scene_000000_instance_3.png" for method in METHODS)}
    assert {line.removeprefix("picture: ") for line in lines if line.startswith("picture: ")} == set(map(str, found))
    assert lines[-1].startswith("BOP_PATH=")
    for each in found:
        assert cv2.imread(str(each)).shape[1] == SCALE * WIDTH


def test_plots_with_a_filter_have_a_sweep_of_each_method(folder, files, tmp_path):
    """In an empty folder."""
    (tmp_path / "plots").mkdir()
    given = ("--filter", "ema", "--format", "csv", "--plots", tmp_path / "plots", "--track", "4:1", "--vertices", 20)
    output, error = evaluated("--data", folder, "--results", *files, *given)
    assert output.startswith("group,")
    assert "picture: " not in output
    names = {path.name for path in (tmp_path / "plots").iterdir()}
    assert names == {*PICTURES, *(f"{kind}_{method}{end}.png" for kind, end in KINDS for method in METHODS)}
    assert error.count("picture: ") == len(names)


def test_a_track_that_a_method_lacks_is_not_chosen_and_is_refused(folder, truth, files, tmp_path):
    poses, slow = truth.poses, tmp_path / "slow.csv"
    write_results(slow, poses.select((poses.scene == 2) & (poses.instance == 1)))
    given = ("--data", folder, "--results", files[0], slow)
    evaluated(*given, "--plots", tmp_path / "plots")
    trajectories = sorted(path.name for path in (tmp_path / "plots").glob("trajectory*"))
    assert trajectories == [f"trajectory_{method}_scene_000002_instance_1.png" for method in ("icg", "slow")]
    said = "--track is 0:3; slow has no estimate of it; choose another one"
    code, _, error = run("eval", *given, "--plots", tmp_path / "other", "--track", "0:3")
    assert code == 2
    assert said in error
    assert not (tmp_path / "other").exists()


def test_methods_of_odd_names_have_pictures_of_their_own(folder, files, tmp_path):
    for name in ("a b", "a+b", "Ground truth"):
        (tmp_path / f"{name}.csv").write_bytes(files[0].read_bytes())
    evaluated("--data", folder, "--results", *sorted(tmp_path.glob("*.csv")), "--plots", tmp_path / "plots")
    names = {path.name for path in (tmp_path / "plots").glob("trajectory*")}
    numbered = ((1, "Ground_truth"), (2, "a_b"), (3, "a_b"))
    assert names == {f"trajectory_{number}_{name}_scene_000000_instance_3.png" for number, name in numbered}


@pytest.fixture(scope="module", params=["bop,zarr", "shards"])
def baked(request, picked_set, tmp_path_factory):
    others = ("train", "trajectory.zarr") if request.param == "shards" else ("train_web",)
    return shutil.copytree(picked_set, tmp_path_factory.mktemp("baked") / "set", ignore=lambda *_: others, copy_function=os.link)


def test_the_truth_of_a_bake_scores_100(baked, tmp_path):
    data = synpick_warp.open(baked)
    truth = read_truth(data)
    assert len(truth.images) == sum(len(episode) for episode in data.values()) * data.camera_count
    assert set(truth.mode) == {"pick"}
    assert np.isfinite(truth.speed).all()
    assert 0.0 <= truth.speed.min() <= truth.speed.max() < 10.0
    results, table = tmp_path / "truth.csv", tmp_path / "table.csv"
    write_results(results, truth.poses)
    evaluated("--data", baked, "--results", results, "--format", "csv", "--out", table, "--visib-min", 0)
    rows = list(csv.DictReader(table.read_text().splitlines()))
    values = [float(row[column]) for row in rows for column in row if column.startswith("ADD")]
    assert (min(values), max(values)) == pytest.approx((100.0, 100.0))
    labels = {row["label"] for row in rows if row["group"] == "object"}
    assert labels <= ({"boxes_1", "boxes_2", "boxes_3"} if data.has_store else {"obj_000001", "obj_000002", "obj_000003"})
