"""Bakes of cameras that have files of some images only: pictures of every third frame, depth and masks without colour, or the reverse."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import synpick_warp
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.dataset.pytorch import Views
from synpick_warp.errors import DatasetError
from tests.builders import boxes, failing_after, once, run
from tests.harness.exporter_contract import digests
from tests.online.test_stream import taken
from tests.worlds.cells import SIDE, bake_cell, cell_config, make_camera

NAMES, EVERY = ("slow", "fast"), (3, 1)
SPARSE = make_camera("slow", **SIDE, every=3, fov=40.0), make_camera("fast", fov=40.0)
CHOSEN = (
    make_camera("slow", **SIDE, every=3, modalities=["masks", "depth"], fov=40.0),
    make_camera("fast", modalities=["color", "normals"], fov=40.0),
)
"""Depth and masks of one camera, colour and normals of the other."""
KINDS = ({"depth", "mask", "mask_visib"}, {"rgb", "normals"})
EPISODES = 2
GIVEN = {"bake.episodes": EPISODES, "bake.worlds": 2}
FORMATS = {"bake.formats": ["bop", "shards", "coco", "yolo", "usd", "zarr"]}
LAYERS = {"bake.formats": ["bop", "shards", "zarr"], "render.layers": ["normals", "nocs"]}
SENSORS = {"bop.layout": "multisensor", "bake.formats": ["bop", "zarr"]}
SETS = {
    "sparse": (SPARSE, FORMATS),
    "sparse sensors": (SPARSE, FORMATS | SENSORS),
    "modalities": (CHOSEN, LAYERS),
    "modalities of sensors": (CHOSEN, LAYERS | SENSORS),
}


def bake(name: str, out: Path, shard: tuple[int, int] = (0, 1), **given: object) -> None:
    cameras, settings = SETS[name]
    bake_cell(out, cell_config(cameras, **GIVEN | settings | given), shard)


@pytest.fixture
def baked(request, tmp_path_factory) -> Path:
    """A set by its name, made once."""
    name = request.param
    return once(tmp_path_factory, f"chosen-{name.replace(' ', '-')}", lambda out: bake(name, out))[0]


def of(*names: str):
    """Run a test on sets of these names."""
    return pytest.mark.parametrize("baked", names, indirect=True)


def check_same(ours: Path, theirs: Path) -> None:
    assert {name for name, _ in digests(ours).items() ^ digests(theirs).items()} <= {"config.toml"}


@of("sparse", "sparse sensors")
def test_every_format_has_the_frames_of_each_camera(baked):
    for episode, row in enumerate(map(json.loads, (baked / "episodes.jsonl").read_text().splitlines())):
        assert row["frames"] > 4
        for camera, every in enumerate(EVERY):
            scene, frames = EPISODES * episode + camera, list(range(0, row["frames"], every))
            if not (baked / "coco").exists():
                sensor = json.loads((baked / f"train/{episode:06d}/scene_gt_{NAMES[camera]}.json").read_text())
                assert sorted(map(int, sensor)) == frames
                continue
            assert sorted(map(int, json.loads((baked / f"train/{scene:06d}/scene_camera.json").read_text()))) == frames
            for folder in (f"train/{scene:06d}/rgb", f"train/{scene:06d}/depth", f"coco/images/{scene:06d}"):
                assert sorted(int(path.stem) for path in (baked / folder).iterdir()) == frames
            assert len(list((baked / f"yolo/images/train/{scene:06d}").iterdir())) == len(frames)


@of("modalities", "modalities of sensors")
def test_each_camera_has_its_own_files(baked):
    scenes = sorted(path for path in (baked / "train").iterdir() if path.is_dir())
    folders = [{path.name for path in scene.iterdir() if path.is_dir()} for scene in scenes]
    if len(folders) == 2 * EPISODES:
        assert folders == [*KINDS] * EPISODES
    else:
        assert folders == [{f"{kind}_{name}" for name, kinds in zip(NAMES, KINDS, strict=True) for kind in kinds}] * EPISODES
        assert "'slow': ['depth'], 'fast': ['rgb']" in (baked / "bop_dataset_params.py").read_text()
    data = synpick_warp.open(baked)
    deep, flat = data[0].view(3, 0), data[0].view(3, 1)
    assert (deep.depth > 0).any()
    assert deep.masks.shape[1:] == (72, 96)
    assert flat.rgb.shape == (72, 96, 3)
    assert np.abs(flat.layer("normals")).max() > 0.5
    for view, name in ((deep, "rgb"), (flat, "depth"), (flat, "masks")):
        with pytest.raises(DatasetError, match=r"there is no|has no"):
            getattr(view, name)
    assert deep.object_to_camera.shape == flat.object_to_camera.shape


@pytest.mark.parametrize("command", ["verify", "validate", "stats", "report", "preview"])
@of(*SETS)
def test_commands_take_it(baked, command, tmp_path):
    extra = {"report": ("--out", tmp_path / "page.html"), "preview": ("--out", tmp_path / "sheet.png")}
    ran = run(command, baked, *extra.get(command, ()))
    assert ran.code == 0, ran
    assert command != "validate" or "0 errors" in ran.out, ran


@of("sparse")
def test_it_is_read_by_episode_and_frame(baked):
    data = synpick_warp.open(baked)
    episode = data[1]
    views = [(view.camera, view.frame) for view in episode.views()]
    assert views == [(camera, frame) for frame in range(len(episode)) for camera in (0, 1) if frame % EVERY[camera] == 0]
    with pytest.raises(IndexError, match="no picture of camera 0 in frame 4; it has one every 3 frames"):
        episode.view(4, 0)
    track = episode.tracks[0]
    assert np.isfinite(track.visibility[1]).all()
    assert len(Views(baked, cameras=[0], stride=3)) == sum(len(data[each].frames(0)) for each in data)
    with pytest.raises(DatasetError, match="camera 0 has a picture every 3 frames; give a stride of 3, or cameras without it"):
        Views(baked)


@pytest.mark.parametrize(
    ("baked", "name", "to"), [("sparse", "sparse", "coco,shards"), ("modalities", "modalities", "shards")], indirect=["baked"]
)
def test_it_is_converted_to_the_same_files(baked, name, to, tmp_path):
    bake(name, tmp_path / "set", **{"bake.formats": ["bop"]})
    ran = run("convert", tmp_path / "set", "--to", to, "--out", tmp_path / "more")
    assert ran.code == 0, ran
    for folder in ("train_web", *(["coco"] if "coco" in to else [])):
        assert digests(baked / folder) == digests(tmp_path / "more" / folder)


@of("sparse")
def test_the_number_of_worlds_changes_no_byte(baked, tmp_path):
    bake("sparse", tmp_path / "set", **{"bake.worlds": 1})
    check_same(baked, tmp_path / "set")


@of("modalities")
def test_interrupted_or_in_shares_it_has_the_same_bytes(baked, tmp_path):
    with failing_after(1):
        bake("modalities", tmp_path / "set", **{"bake.worlds": 1})
    assert len(list((tmp_path / "set/manifest").glob("0*.json"))) == 1
    bake("modalities", tmp_path / "set")
    for part in range(2):
        bake("modalities", tmp_path / str(part), (part, 2))
    assert merge([tmp_path / "0", tmp_path / "1"], tmp_path / "merged").missing == []
    for made in ("set", "merged"):
        check_same(baked, tmp_path / made)


@pytest.mark.parametrize(("baked", "name"), [("sparse", "sparse"), ("modalities", "modalities")], indirect=["baked"])
def test_a_stream_has_the_images_of_each_camera(baked, name):
    """What a camera lacks is not rendered; depth and masks, from which all follows, are there for all."""
    cameras, settings = SETS[name]
    with boxes():
        views = taken(synpick_warp.stream(cell_config(cameras, **GIVEN | settings)))
    data = synpick_warp.open(baked)
    assert views.keys() == {(view.episode, view.camera, view.frame) for view in data.views()}
    for (episode, camera, frame), made in views.items():
        view = data[episode].view(frame, camera)
        if cameras is CHOSEN:
            assert {"color", "normals", "nocs"} & made.keys() == ({"color", "normals"} if camera else set())
        if cameras is SPARSE or camera:
            np.testing.assert_array_equal(made["color"], view.rgb)
        else:
            np.testing.assert_allclose(made["depth"] * 1e-4, view.depth, atol=1e-6)
