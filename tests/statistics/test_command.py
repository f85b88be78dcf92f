"""Command `stats`: text, JSON and CSV say the same, sets of every shape give what they have, and bad input is one line."""

import csv
import dataclasses
import json
import shutil
from pathlib import Path

import pytest
from rich.console import Console

import synpick_warp
from synpick_warp.apps.statistics import Statistics, compute_statistics
from synpick_warp.apps.statistics.tables import make_tables
from synpick_warp.configs.schema import Split
from tests.builders import mistake, run
from tests.harness.scripted_bake import bake, settings
from tests.worlds.evaluation_set import CAMERAS, FRAMES, write_evaluation_set


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A data set of all formats with two splits, three episodes of mode pick."""
    out = tmp_path_factory.mktemp("scripted") / "set"
    splits = (Split("train", 2, 0, "pick", "train"), Split("test", 1, 2, "pick", "test"))
    bake(out, dataclasses.replace(settings(3, ("bop", "shards", "zarr")).with_values({"bop.color_format": "png"}), splits=splits))
    return out


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def stats(*arguments: object) -> tuple[str, str]:
    """Standard output and error of a command that succeeds."""
    code, out, err = run("stats", *arguments)
    assert code == 0, err
    return out, err


def test_text_json_and_csv_are_the_same_numbers(folder, tmp_path):
    statistics = compute_statistics(synpick_warp.open(folder))
    text, error = stats(folder)
    assert error == ""
    assert text.startswith("Views and mean visibility, by split and mode\n")
    assert text.splitlines()[-1].endswith("MiB")
    assert f"{statistics.total.annotations.visibility:.3f}" in text
    out, error = stats(folder, "--json")
    assert " views/s); peak memory " in error
    content = json.loads(out)
    assert content.keys() == {field.name for field in dataclasses.fields(statistics)}
    assert [(row["split"], row["mode"], row["annotations"]["views"]) for row in content["groups"]] == [
        (row.split, row.mode, row.annotations.views) for row in statistics.groups
    ]
    stats(folder, "--csv", tmp_path / "tables")
    tables = make_tables(statistics)
    assert {path.stem for path in (tmp_path / "tables").iterdir()} == {table.name for table in tables}
    for table in tables:
        with open(tmp_path / "tables" / f"{table.name}.csv", newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        assert header == [column.name for column in table.columns]
        assert rows == [["" if value is None else str(value) for value in row] for row in table.rows]
        assert all(len(row) == len(header) for row in rows)


@pytest.mark.parametrize("width", [40, 79, 100, 120, 300])
def test_no_column_is_cut_at_any_width(folder, monkeypatch, width):
    monkeypatch.setattr("synpick_warp.cli.display.make_console", lambda: Console(width=width, highlight=False))
    text, _ = stats(folder, "--paper")
    assert "…" not in text
    statistics = compute_statistics(synpick_warp.open(folder))
    for table in make_tables(statistics):
        if table.name == "paper":
            assert all(f"{column.label or column.name.replace('_', ' ')}" in text for column in table.columns)
            assert all(format(row.paper.views, ",") in text for row in statistics.paper)
    if width > 79:
        assert max(map(len, text.splitlines()[1:4])) <= width


def test_the_paper_stands_beside_its_own_objects_or_if_asked_for(folder, tmp_path, monkeypatch):
    hint = "the objects are not those of the paper; --paper shows its numbers beside these"
    for arguments, shown, hinted in (([], False, True), (["--paper"], True, False), (["--no-paper"], False, False)):
        text, _ = stats(folder, *arguments)
        assert ("Beside SynPick" in text, hint in text) == (shown, hinted)
    monkeypatch.setattr(Statistics, "has_paper_objects", True)
    text, _ = stats(folder)
    assert "Beside SynPick" in text
    assert hint not in text


def test_splits_are_counted_apart_and_alone(folder):
    statistics = compute_statistics(synpick_warp.open(folder))
    assert [(row.split, row.episodes.episodes) for row in statistics.groups] == [("train", 2), ("test", 1)]
    assert statistics.total.episodes.episodes == 3
    assert [row.split for row in statistics.paper] == ["train", "test"]
    alone = json.loads(stats(folder, "--split", "test", "--json")[0])
    assert [row["split"] for row in alone["groups"]] == ["test"]
    assert alone["missing"] == ["the objects are not those of the paper, so their distributions are not compared"]
    assert mistake("stats", folder, "--split", "val") == f'{folder} has no split "val"; splits: train, test'


def test_shards_count_as_scenes_do_and_a_set_without_images_gives_episodes_and_attempts(folder, copy):
    for split in ("train", "test"):
        shutil.rmtree(copy / split)
    assert compute_statistics(synpick_warp.open(copy)) == compute_statistics(synpick_warp.open(folder))
    for split in ("train", "test"):
        shutil.rmtree(copy / f"{split}_web")
    text, _ = stats(copy)
    assert "missing: 3 episodes have no images" in text
    assert "missing: no images: no views, visibility" in text
    statistics = compute_statistics(synpick_warp.open(copy))
    assert (statistics.total.episodes.episodes, statistics.total.episodes.attempts) == (3, 3)
    assert statistics.total.annotations.visibility is None
    assert (statistics.depth, statistics.lights, statistics.paper) == (None, None, ())


def test_a_set_without_trajectories_attempts_lights_and_depth_gives_the_rest(tmp_path):
    text, _ = stats(write_evaluation_set(tmp_path / "set"))
    assert f"{2 * FRAMES * CAMERAS} views in " in text
    for said in ("no depth images", "names no light maps", "no attempts", "are not those of the paper"):
        assert said in text


def test_an_unfinished_set_says_how_much_is_there(copy):
    for name in ("000002.json", "000002.sha256"):
        (copy / "manifest" / name).unlink()
    assert "missing: 1 of 3 planned episodes are not baked" in stats(copy)[0]
    assert "not baked" not in stats(copy, "--split", "train")[0]


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("train/000000/scene_gt_info.json", None, "there is no file {path}"),
        ("train/000000/scene_gt.json", "{}", "{path} does not have the images 0 to 1 of its episode; "),
        ("train/000000/scene_gt.json", "[" * 100_000, "{path} is damaged: "),
        ("train/000000/scene_gt_info.json", '{"0": [], "1": []}', "{folder}/train/000000: image 0 has other instances in scene_gt than "),
        ("train/000000/scene_camera.json", '{"0": 1e999}', "{path} is damaged: "),
        ("manifest/000000.json", '{"row": {"frames": 2, "ending": "x", "mode": 3}, "attempts": []}', "{path} is damaged: "),
        ("manifest/000000.json", '{"row": {"frames": 2, "ending": "x", "mode": "pick"}, "attempts": [{}]}', "{path} is damaged: "),
        ("config.toml", None, "{folder} has no config.toml; "),
        ("train/000000/depth/000000.png", "nothing", "{path} is not an image"),
    ],
)
def test_a_damaged_file_is_named_in_one_line(copy, tmp_path, file, content, said):
    path = copy / file
    path.unlink()
    if content is not None:
        path.write_text(content)
    assert mistake("stats", copy, "--csv", tmp_path / "tables").startswith(said.format(path=path, folder=copy))
    assert not (tmp_path / "tables").exists()


def test_wrong_options_are_named_in_one_line(folder, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").touch()
    for option, value, said in (
        ("--depth-views", -1, "; allowed: 0 to "),
        ("--threads", 9999, "; allowed: 0 to "),
        ("--csv", tmp_path / "full", "; allowed: a new or an empty folder"),
        ("--csv", folder / "tables", ", among the files of the data set"),
    ):
        assert mistake("stats", folder, option, value).startswith(f"{option} is {value}{said}")


def test_names_are_no_markup(copy):
    path = copy / "manifest" / "000000.json"
    entry = json.loads(path.read_text())
    entry["row"]["ending"] = "[red]\x1b[2J"
    path.write_text(json.dumps(entry))
    assert "[red]\\x1b[2J" in stats(copy)[0]
