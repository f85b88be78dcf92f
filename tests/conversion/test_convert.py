"""Conversion of data sets: byte equality with a bake of the format, resuming, and errors in one line."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import synpick_warp
from synpick_warp.apps.conversion.run import check_formats, convert
from synpick_warp.cli.main import main
from synpick_warp.configs.schema import Config, Split
from synpick_warp.dataset.commit.verify import verify
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.scenes.embedded.skies import skies
from tests.builders import mistake, once
from tests.harness import scripted_bake
from tests.harness.scripted_bake import INPUTS, snapshot
from tests.worlds import box_views


def settings(*formats: str, jpg: bool = False, keypoints: int = 0) -> Config:
    """Settings of two episodes with two layers: two splits as PNG, or one as JPEG."""
    config = scripted_bake.settings(2, formats)
    bop = dataclasses.replace(config.bop, split="train_pbr" if jpg else "train", color_format="jpg" if jpg else "png", keypoints=keypoints)
    splits = () if jpg else (Split("train", 1, 0, "pick", "train"), Split("test", 1, 1, "pick", "test"))
    render = dataclasses.replace(config.render, layers=("flow", "classes"))
    return dataclasses.replace(config, bop=bop, splits=splits, render=render)


@pytest.fixture(scope="module")
def sets(tmp_path_factory) -> dict[str, Path]:
    """Data sets that were baked directly, by name."""
    wanted = {
        "source": settings("bop", "zarr"),
        **{name: settings(name) for name in ("shards", "bop", "lerobot", "usd", "coco", "yolo")},
        "keypoints": settings("bop", keypoints=8),
        "keypoints shards": settings("shards", keypoints=8),
        "keypoints coco": settings("coco", keypoints=8),
        "jpg": settings("bop", jpg=True),
        "jpg shards": settings("shards", jpg=True),
    }

    def make(folder: Path) -> None:
        for name, config in wanted.items():
            scripted_bake.bake(folder / name, config)

    folder, _ = once(tmp_path_factory, "conversion", make)
    return {name: folder / name for name in wanted}


@pytest.fixture
def assets(monkeypatch):
    """Objects, lights and cameras of the scripted bake, in place of those that settings name."""
    monkeypatch.setattr("synpick_warp.scenes.catalog.load_catalog", lambda _: box_views.catalog())
    monkeypatch.setattr("synpick_warp.scenes.lights.load_lights", lambda _: skies())
    monkeypatch.setattr("synpick_warp.scenes.cameras.make_cameras", lambda _: box_views.cameras(16, 12))
    monkeypatch.setattr("synpick_warp.dataset.commit.writing.digest_inputs", lambda *_: INPUTS)


def run(source: Path, out: Path, *formats: str, report=lambda *_: None):
    return convert(source, out, formats, 1, report)


@pytest.mark.parametrize(
    ("source", "formats", "baked"),
    [
        ("source", ("shards",), "shards"),
        ("shards", ("bop",), "bop"),
        ("source", ("lerobot",), "lerobot"),
        ("source", ("usd",), "usd"),
        ("source", ("coco",), "coco"),
        ("shards", ("coco",), "coco"),
        ("source", ("yolo",), "yolo"),
        ("shards", ("yolo",), "yolo"),
        ("keypoints", ("coco",), "keypoints coco"),
        ("keypoints shards", ("coco",), "keypoints coco"),
        ("keypoints shards", ("bop",), "keypoints"),
        ("jpg", ("shards",), "jpg shards"),
        ("jpg shards", ("bop",), "jpg"),
    ],
)
def test_converted_sets_equal_baked_ones_byte_for_byte(sets, tmp_path, assets, source, formats, baked):
    before = snapshot(sets[source])
    assert run(sets[source], tmp_path / "out", *formats)[:2] == (2, 0)
    converted, expected = snapshot(tmp_path / "out"), snapshot(sets[baked])
    assert sorted(converted) == sorted(expected)
    assert [name for name in expected if converted[name] != expected[name]] == []
    assert snapshot(sets[source]) == before
    assert verify(tmp_path / "out").problem == ""


def test_several_formats_are_converted_at_once(sets, tmp_path):
    synpick_warp.convert(sets["source"], tmp_path / "out", ("shards", "lerobot"), threads=2)
    for name in ("test_web/shard-000003.tar", "lerobot/meta/stats.json", "lerobot/parts/000001.json"):
        baked = sets["lerobot" if name.startswith("lerobot") else "shards"]
        assert (tmp_path / "out" / name).read_bytes() == (baked / name).read_bytes()


@pytest.mark.parametrize("name", ["lerobot", "coco", "yolo"])
def test_sets_without_views_have_episodes_and_attempts(sets, name, capsys):
    import synpick_warp

    data = synpick_warp.open(sets[name])
    assert {split: list(part) for split, part in data.splits.items()} == {"train": [0], "test": [1]}
    assert (data[1].row["split"], len(data[1].attempts)) == ("test", 1)
    with pytest.raises(DatasetError, match="has no images of episode 1; bake with --formats bop or shards"):
        data[1].view(0)
    assert main(["stats", str(sets[name])]) == 0
    assert "2 episodes have no images" in capsys.readouterr().out
    mistake("validate", sets[name])
    mistake("preview", sets[name], "--out", sets[name].parent / "sheet.png")


def test_interrupted_conversion_resumes_to_the_same_bytes(sets, tmp_path):
    """What a kill between two commits leaves: one episode committed, files of the other, a staging folder."""
    out, seen = tmp_path / "out", []
    shutil.copytree(sets["shards"], out)
    for name in ("000001.json", "000001.sha256", "joined.json", "joined.sha256"):
        (out / "manifest" / name).unlink()
    (out / "test_web" / "shard-000004.tar").write_bytes(b"half")
    (out / ".partial" / "shards" / "000001").mkdir(parents=True)
    assert run(sets["source"], out, "shards", report=lambda *step: seen.append(step))[:2] == (2, 1)
    assert seen == [("episodes", 2, 2)]
    assert snapshot(out) == snapshot(sets["shards"])
    assert run(sets["source"], out, "shards")[:2] == (2, 2)


def test_an_interrupt_leaves_no_files_beside_committed_episodes(sets, tmp_path):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(sets["source"], tmp_path / "out", "shards", report=interrupt)
    assert not (tmp_path / "out").exists()


def test_episodes_that_delivered_nothing_stay_in_the_lists(sets, tmp_path):
    """An edited source: the second episode gave up while it settled."""
    source = tmp_path / "source"
    shutil.copytree(sets["source"], source)
    entry = source / "manifest" / "000001.json"
    content = json.loads(entry.read_text())
    content["row"] |= {"ending": "unsettled", "sentence": "the objects did not come to rest"}
    entry.write_text(json.dumps(content))
    assert run(source, tmp_path / "out", "shards").episodes == 2
    assert {path.name for path in (tmp_path / "out").glob("*_web/*.tar")} == {f"shard-{scene:06d}.tar" for scene in range(3)}
    assert len((tmp_path / "out" / "episodes.jsonl").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("source", "formats", "error", "message"),
    [
        ("source", ("zarr",), ConfigError, "allowed: bop, shards, usd, lerobot, coco, yolo; no other format has the physics"),
        ("source", ("hdf5",), ConfigError, "--to names hdf5; allowed"),
        ("source", ("bop",), ConfigError, "has already"),
        ("usd", ("shards",), DatasetError, "has no images"),
        ("bop", ("usd",), DatasetError, r"has no trajectory\.zarr"),
        ("bop", ("lerobot",), DatasetError, r"has no trajectory\.zarr"),
    ],
)
def test_what_cannot_be_converted_is_one_error_and_leaves_nothing(sets, tmp_path, source, formats, error, message):
    with pytest.raises(error, match=message):
        run(sets[source], tmp_path / "out", *formats)
    assert not (tmp_path / "out").exists()


def test_sets_of_several_sensors_are_refused():
    with pytest.raises(ConfigError, match=r"has bop.layout = .*, which convert does not"):
        check_formats(("shards",), "multisensor", ("bop", "zarr"), Path("DATA"))


def test_keypoints_need_the_objects_of_the_bake(sets, tmp_path, assets, monkeypatch):
    source = tmp_path / "source"
    shutil.copytree(sets["keypoints"], source)
    truth = source / "train/000000/scene_gt.json"
    truth.write_text(truth.read_text().replace('"obj_id":7', '"obj_id":8'))
    with pytest.raises(DatasetError, match="obj_id 8, which is none of the bake's objects"):
        run(source, tmp_path / "first", "coco")
    monkeypatch.setattr("synpick_warp.dataset.commit.writing.digest_inputs", lambda *_: {"objects": "other"})
    with pytest.raises(DatasetError, match="have changed since its bake"):
        run(sets["keypoints"], tmp_path / "second", "coco")


@pytest.mark.parametrize("place", [".", "inside", ".."])
def test_output_folders_lie_apart_from_the_source(sets, place):
    with pytest.raises(DatasetError, match="holds or lies in"):
        run(sets["source"], sets["source"] / place, "shards")


def test_changed_objects_are_refused_for_usd(sets, tmp_path, assets, monkeypatch):
    monkeypatch.setattr("synpick_warp.dataset.commit.writing.digest_inputs", lambda *_: {"objects": "other"})
    with pytest.raises(DatasetError, match="have changed since its bake"):
        run(sets["source"], tmp_path / "out", "usd")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("fault", ["missing image", "no image", "other size", "damaged json", "missing model"])
def test_damaged_sources_are_one_error(sets, tmp_path, fault):
    source = tmp_path / "source"
    shutil.copytree(sets["source"], source)
    image = source / "test" / "000004" / "depth" / "000001.png"
    if fault == "missing image":
        image.unlink()
    elif fault == "no image":
        image.write_bytes(b"text")
    elif fault == "other size":
        image.write_bytes(cv2.imencode(".png", np.zeros((4, 4), np.uint16))[1].tobytes())
    elif fault == "damaged json":
        (source / "test" / "000004" / "scene_gt.json").write_text("{")
    else:
        (source / "models" / "obj_000003.ply").unlink()
    with pytest.raises(DatasetError, match="obj_000003" if fault == "missing model" else "000004") as caught:
        run(source, tmp_path / "out", "shards")
    assert "\n" not in str(caught.value)
    assert "cannot write" not in str(caught.value)


def test_masks_beyond_their_boxes_are_read_whole(sets, tmp_path):
    """An edited source whose boxes are wrong: masks are what counts."""
    source = tmp_path / "source"
    shutil.copytree(sets["source"], source)
    for scene in source.glob("t*/00000?"):
        infos = json.loads((scene / "scene_gt_info.json").read_text())
        for rows in infos.values():
            for row in rows:
                row["bbox_visib"] = [0, 0, 1, 1]
        (scene / "scene_gt_info.json").write_text(json.dumps(infos))
    run(source, tmp_path / "out", "shards")
    views = [next(iter(synpick_views(folder))) for folder in (tmp_path / "out", sets["source"])]
    np.testing.assert_array_equal(views[0].masks, views[1].masks)
    assert views[0].masks.any()


def synpick_views(folder: Path):
    import synpick_warp

    return synpick_warp.open(folder).views()


def test_command_says_what_it_made(sets, tmp_path, capsys):
    assert main(["convert", str(sets["source"]), "--to", "shards", "--out", str(tmp_path / "out"), "--threads", "1"]) == 0
    assert "2 episodes converted to shards" in capsys.readouterr().out
    mistake("convert", sets["source"], "--to", "shards,tar", "--out", tmp_path / "other")
    mistake("convert", tmp_path / "none", "--to", "shards", "--out", tmp_path / "other")
    assert not (tmp_path / "other").exists()
