"""Default folders: where a bake writes without --out, which data set the other commands read, and outputs that replace nothing;
folders of any depth."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import traceback
from pathlib import Path

import numpy as np
import pytest

from synpick_warp.cli.main import main
from synpick_warp.cli.options import beside
from synpick_warp.configs.files.load import config_to_toml, load_config
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit.manifest import encode_manifest, make_manifest
from synpick_warp.scenes.collision.shapes import _Saver
from synpick_warp.scenes.types import ConvexPiece
from synpick_warp.system.hardware.kernels import link_files
from synpick_warp.system.inputs.files import make_folder
from tests.builders import mistake
from tests.harness.scripted_bake import bake, settings


def start(folder: str, config: Config) -> Path:
    """What a bake with these settings leaves that has begun."""
    out = Path(folder)
    (out / "manifest").mkdir(parents=True)
    (out / "manifest.json").write_bytes(encode_manifest(make_manifest(config)))
    (out / "config.toml").write_text(config_to_toml(config))
    return out


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A data set of three episodes of mode pick."""
    out = tmp_path_factory.mktemp("folders") / "PICKS"
    config = settings(3, ("bop",))
    bake(out, dataclasses.replace(config, bop=dataclasses.replace(config.bop, split="train", color_format="png")))
    return out


# ---- where a bake writes ----


@pytest.mark.parametrize(
    ("preset", "given", "episodes"),
    [
        (None, {}, 4),
        (None, {"bake.worlds": 512}, 512),
        (None, {"bake.worlds": 512, "bake.episodes": 7}, 7),
        (None, {"bake.worlds": 0}, 4),
        ("smoke", {}, 2),
        ("smoke", {"bake.worlds": 8}, 8),
        ("synpick-test", {"bake.worlds": 8}, 60),
    ],
)
def test_episodes_are_as_many_as_the_worlds_asked_for_unless_they_are_set(preset, given, episodes):
    assert load_config(preset, given).bake.episodes == episodes


def test_a_file_may_set_either_and_splits_their_own(tmp_path):
    for text, given, episodes in (("worlds = 5", {}, 5), ("worlds = 5\nepisodes = 3", {}, 3), ("episodes = 9", {"bake.worlds": 2}, 9)):
        (tmp_path / "my.toml").write_text(f"[bake]\n{text}\n")
        assert load_config(tmp_path / "my.toml", given).bake.episodes == episodes
    assert load_config("synpick", {"bake.worlds": 512}, splits=True).bake.episodes == 300


def test_a_bake_without_a_folder_takes_the_default_one_unless_another_bake_has_it(here, monkeypatch):
    start("synpick-data", load_config("smoke", {"bake.seed": 5}))
    line = mistake("bake", "--config", "smoke", "--device", "cpu")
    assert line.startswith("synpick-data was started with other settings: ")
    assert line.endswith("; resume with the same, or name another folder with --out")
    monkeypatch.chdir(here / "synpick-data" / "manifest")
    line = mistake("bake", "--config", "smoke", "--device", "cpu")
    assert line.startswith("--out is synpick-data, among the files of the data set ")


# ---- which data set the others read ----


COMMANDS = ["preview", "explain", "stats", "report", "validate --fast", "verify", "convert --to shards", "eval --results a.csv"]


@pytest.mark.parametrize("command", [*COMMANDS, "estimate --method single"])
def test_without_a_data_set_the_commands_say_what_to_do(here, command):
    (here / "other").mkdir()
    (here / "manifest.json").write_text("{}")
    line = mistake(*command.split())
    assert line.startswith("there is no data set in the current folder; name one (synpick-warp ")
    assert line.endswith(" DIR), or make one first (synpick-warp bake)")


def test_without_a_name_it_is_the_folder_of_a_bake_without_out_or_the_current_one(made, here, monkeypatch, capsys):
    (here / "other").symlink_to(made)
    assert main(["verify"]) == 2
    capsys.readouterr()
    (here / "other").rename(here / "synpick-data")
    assert main(["preview", "--views", "1"]) == 0
    captured = capsys.readouterr()
    assert captured.out == "contact sheet: synpick-data-contact-sheet.png\n"
    assert captured.err == "synpick-warp: data set: synpick-data (synpick-warp preview DIR takes another)\n"
    monkeypatch.chdir(made)
    assert main(["verify"]) == 0
    assert f"data set: {made} (synpick-warp verify DIR takes another)" in capsys.readouterr().err
    assert main(["verify", str(made)]) == 0
    assert capsys.readouterr().err == ""


# ---- where outputs go ----


@pytest.mark.parametrize(
    ("folder", "said"), [("DATA", "DATA-x.png"), ("a/DATA/", "a/DATA-x.png"), (".", "{here}-x.png"), ("a/..", "{here}-x.png")]
)
def test_outputs_stand_beside_the_data_set(here, folder, said):
    assert str(beside(Path(folder), "-x.png")) == said.format(here=here)


OWN = ["manifest.json", "config.toml", "episodes.jsonl", "camera.json", "new.json", "train/000000/rgb/000000.png", "models/page.html"]


@pytest.mark.parametrize("foreign", [False, True])
@pytest.mark.parametrize("name", OWN)
def test_no_output_replaces_or_adds_a_file_of_a_data_set(made, here, name, foreign):
    """Not of the one that is read, and not of another one; nor of one of other programs."""
    if foreign:
        made = shutil.copytree(made, here / "foreign")
        (made / "manifest.json").unlink()
    target = str(made / name)
    before = {path: path.read_bytes() for path in made.iterdir() if path.is_file()}
    commands = (
        (["preview", made], ".png"),
        (["explain", made], ".png"),
        (["report", made], ".html"),
        (["eval", "--data", made, "--results", "a.csv"], ""),
        (["estimate", "--data", made, "--method", "single"], ""),
    )
    for arguments, suffix in commands:
        line = mistake(*arguments, "--out", target)
        if target.endswith(suffix):
            assert line == f"--out is {target}, among the files of the data set {made}; name a file outside of it"
    if not foreign:
        arguments = ("--config", "smoke", "--out", here / "new", "--device", "cpu", "--profile-out", target)
        assert "--profile-out is " in mistake("bake", *arguments)
    assert {path: path.read_bytes() for path in made.iterdir() if path.is_file()} == before


def test_no_folder_is_made_in_a_data_set(made, here):
    """Neither of pictures, nor of another data set."""
    names = sorted(made.rglob("*"))
    shutil.copytree(made, here / "other")
    for name in ("plots", "plots.png", "train/plots"):
        for arguments in (["eval", "--data", made, "--results", "a.csv", "--plots"], ["merge", here / "other", "--out"]):
            said = f"{arguments[-1]} is {made / name}, among the files of the data set {made}; name a folder outside of it"
            assert mistake(*arguments, made / name) == said
    assert sorted(made.rglob("*")) == names


def test_a_picture_in_the_folder_of_a_data_set_is_a_file_of_nobody(made):
    for _ in range(2):
        assert main(["preview", str(made), "--out", str(made / "contact-sheet.png"), "--views", "1"]) == 0
    assert main(["verify", str(made)]) == 0
    (made / "contact-sheet.png").unlink()


def test_an_output_through_a_link_or_onto_an_input_is_found(made, here):
    (here / "link").symlink_to(made)
    (here / "a.csv").write_text("scene_id,im_id,obj_id,score,R,t,time\n")
    (here / "targets.json").write_text(json.dumps([]))
    arguments = ["eval", "--data", str(made), "--results", "a.csv", "--targets", "targets.json", "--out"]
    for out, said in (("link/manifest.json", "among the files"), ("a.csv", "which the command reads"), ("targets.json", "which the com")):
        assert said in mistake(*arguments, out)


# ---- folders of any depth ----

FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
CALLS = 450
"""Calls that Python's stack has room for, instead of 1,000: time grows with the square of the depth."""
DEPTH = 500
"""More than that; the path is shorter than Linux allows, 4,096 bytes."""


def test_a_folder_with_parents_a_folder_that_is_there_and_a_file(tmp_path):
    make_folder(tmp_path / "a" / "b")
    make_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    (tmp_path / "file").touch()
    for path, error in ((tmp_path / "file", FileExistsError), (tmp_path / "file" / "below", NotADirectoryError)):
        with pytest.raises(error):
            make_folder(path)


@pytest.fixture
def deep(tmp_path, monkeypatch):
    """The current folder, which is removed again by a program that is not recursive, as pytest's is."""
    monkeypatch.chdir(tmp_path)
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(len(traceback.extract_stack()) + CALLS)
    yield tmp_path
    sys.setrecursionlimit(before)
    subprocess.run(["rm", "-rf", "d"], cwd=tmp_path, check=True)


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("deep") / "set"
    bake(out, settings(1, ("bop", "zarr")))
    return out


@pytest.mark.parametrize(
    ("command", "output"),
    [
        ("preview {data} --views 1 --out", "sheet.png"),
        ("explain {data} --out", "sheet.png"),
        ("report {data} --views 1 --out", "page.html"),
        ("stats {data} --csv", "tables"),
        ("convert {data} --to coco --threads 1 --out", "set"),
        ("convert {data} --to shards,lerobot --threads 1 --out", "set"),
        ("merge {data} --out", "set"),
    ],
)
def test_outputs_lie_at_any_depth(small, deep, command, output):
    """RecursionError, with a traceback."""
    out = "/".join(["d"] * DEPTH + [output])
    assert main([*command.format(data=small).split(), out]) == 0
    assert os.path.exists(out)


@pytest.mark.usefixtures("deep")
def test_caches_and_textures_lie_at_any_depth():
    folder = Path("/".join(["d"] * DEPTH))
    lines: list[str] = []
    _Saver(lines.append)(folder / "shape.npz", (ConvexPiece(np.eye(4, 3, dtype=np.float32), FACES),))
    assert not lines
    assert (folder / "shape.npz").is_file()
    source = folder / "source"
    source.mkdir()
    link_files(source, folder / "kernels")
    assert (folder / "kernels").is_dir()


def test_a_path_that_is_too_long_with_a_file_is_one_line(small, deep):
    """4,096 bytes with the files of a small set; the folder alone is shorter."""
    out = "/".join(["d"] * 2030)
    for arguments in (
        ["merge", str(small)],
        *(["convert", str(small), "--to", to, "--threads", "1"] for to in ("shards", "lerobot", "coco")),
    ):
        mistake(*arguments, "--out", out)
        assert list(deep.iterdir()) == []


def test_a_bake_is_refused_in_one_line_at_any_depth(deep):
    out = "/".join(["d"] * DEPTH)
    arguments = ("--config", "smoke", "--device", "cpu", "--mode", "move", "--models", deep)
    assert "contains no models" in mistake("bake", *arguments, "--out", out)
    assert list(deep.iterdir()) == []
