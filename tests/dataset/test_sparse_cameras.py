"""A bake with a camera that has a picture of every third frame only, in every format that can have it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import synpick_warp
from synpick_warp.dataset.pytorch import Views
from synpick_warp.errors import DatasetError
from tests.builders import boxes, once, run
from tests.harness.exporter_contract import digests
from tests.online.test_stream import taken
from tests.worlds.cells import SIDE, bake_cell, cell_config, make_camera

CAMERAS = make_camera("slow", **SIDE, every=3, fov=40.0), make_camera("fast", fov=40.0)
EVERY = (3, 1)
GIVEN = {"bake.formats": ["bop", "shards", "coco", "yolo", "usd", "zarr"], "bake.episodes": 2, "bake.worlds": 2}


def bake(out: Path, **given: object) -> None:
    bake_cell(out, cell_config(CAMERAS, **GIVEN | given))


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    return once(tmp_path_factory, "sparse-cameras", bake)[0]


@pytest.fixture(scope="module")
def sensors(tmp_path_factory):
    def make(out: Path) -> None:
        bake(out, **{"bop.layout": "multisensor", "bake.formats": ["bop", "zarr"]})

    return once(tmp_path_factory, "sparse-sensors", make)[0]


def test_every_format_has_the_frames_of_each_camera(cell, sensors):
    for episode, row in enumerate(map(json.loads, (cell / "episodes.jsonl").read_text().splitlines())):
        assert row["frames"] > 4
        for camera, every in enumerate(EVERY):
            scene, frames = 2 * episode + camera, list(range(0, row["frames"], every))
            assert sorted(map(int, json.loads((cell / f"train/{scene:06d}/scene_camera.json").read_text()))) == frames
            for folder in (f"train/{scene:06d}/rgb", f"train/{scene:06d}/depth", f"coco/images/{scene:06d}"):
                assert sorted(int(path.stem) for path in (cell / folder).iterdir()) == frames
            assert len(list((cell / f"yolo/images/train/{scene:06d}").iterdir())) == len(frames)
            name = ("slow", "fast")[camera]
            assert sorted(map(int, json.loads((sensors / f"train/{episode:06d}/scene_gt_{name}.json").read_text()))) == frames


@pytest.mark.parametrize("command", ["verify", "validate", "stats", "report", "preview"])
@pytest.mark.parametrize("kind", ["cell", "sensors"])
def test_commands_take_it(request, kind, command, tmp_path):
    folder = request.getfixturevalue(kind)
    extra = {"report": ("--out", tmp_path / "page.html"), "preview": ("--out", tmp_path / "sheet.png")}
    ran = run(command, folder, *extra.get(command, ()))
    assert ran.code == 0, ran
    assert command != "validate" or "0 errors" in ran.out, ran


def test_it_is_read_by_episode_and_frame(cell):
    data = synpick_warp.open(cell)
    episode = data[1]
    views = [(view.camera, view.frame) for view in episode.views()]
    assert views == [(camera, frame) for frame in range(len(episode)) for camera in (0, 1) if frame % EVERY[camera] == 0]
    with pytest.raises(IndexError, match="no picture of camera 0 in frame 4; it has one every 3 frames"):
        episode.view(4, 0)
    track = episode.tracks[0]
    assert np.isfinite(track.visibility[1]).all()
    assert len(Views(cell, cameras=[0], stride=3)) == sum(len(data[each].frames(0)) for each in data)
    with pytest.raises(DatasetError, match="camera 0 has a picture every 3 frames; give a stride of 3, or cameras without it"):
        Views(cell)


def test_it_is_converted_and_streamed(cell, tmp_path):
    bake(tmp_path / "set", **{"bake.formats": ["bop"]})
    ran = run("convert", tmp_path / "set", "--to", "coco,shards", "--out", tmp_path / "more")
    assert ran.code == 0, ran
    ours, theirs = digests(cell), digests(tmp_path / "more")
    same = [name for name in ours if name.startswith(("coco/", "train_web/"))]
    assert same
    assert [name for name in same if ours[name] != theirs.get(name)] == []
    with boxes():
        views = taken(synpick_warp.stream(cell_config(CAMERAS, **GIVEN)))
    data = synpick_warp.open(cell)
    assert views.keys() == {(view.episode, view.camera, view.frame) for view in data.views()}
    for (episode, camera, frame), made in views.items():
        np.testing.assert_array_equal(made["color"], data[episode].view(frame, camera).rgb)


def test_the_number_of_worlds_changes_no_byte(cell, tmp_path):
    bake(tmp_path / "set", **{"bake.worlds": 1})
    assert {name for name, _ in digests(cell).items() ^ digests(tmp_path / "set").items()} <= {"config.toml"}
