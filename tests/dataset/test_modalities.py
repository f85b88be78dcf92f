"""A bake of cameras that have files of some images only: depth and masks of one, colour and normals of the other."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import synpick_warp
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.errors import DatasetError
from tests.builders import boxes, failing_after, once, run
from tests.harness.exporter_contract import digests
from tests.online.test_stream import taken
from tests.worlds.cells import SIDE, bake_cell, cell_config, make_camera

CAMERAS = (
    make_camera("slow", **SIDE, every=3, modalities=["masks", "depth"], fov=40.0),
    make_camera("fast", modalities=["color", "normals"], fov=40.0),
)
KINDS = ({"depth", "mask", "mask_visib"}, {"rgb", "normals"})
EPISODES = 2
GIVEN = {"bake.formats": ["bop", "shards", "zarr"], "render.layers": ["normals", "nocs"], "bake.episodes": EPISODES, "bake.worlds": 2}


def bake(out: Path, shard: tuple[int, int] = (0, 1), **given: object) -> None:
    bake_cell(out, cell_config(CAMERAS, **GIVEN | given), shard)


@pytest.fixture(scope="module", params=["classic", "multisensor"])
def chosen(tmp_path_factory, request):
    formats = ["bop", "shards", "zarr"] if request.param == "classic" else ["bop", "zarr"]

    def make(out: Path) -> None:
        bake(out, **{"bop.layout": request.param, "bake.formats": formats})

    return once(tmp_path_factory, f"modalities-{request.param}", make)[0]


def test_each_camera_has_its_own_files(chosen, request):
    scenes = sorted(path for path in (chosen / "train").iterdir() if path.is_dir())
    folders = [{path.name for path in scene.iterdir() if path.is_dir()} for scene in scenes]
    if len(folders) == 2 * EPISODES:
        assert folders == [*KINDS] * EPISODES
    else:
        assert folders == [{f"{kind}_{name}" for name, kinds in zip(("slow", "fast"), KINDS, strict=True) for kind in kinds}] * EPISODES
    data = synpick_warp.open(chosen)
    deep, flat = data[0].view(3, 0), data[0].view(3, 1)
    assert (deep.depth > 0).any()
    assert deep.masks.shape[1:] == (72, 96)
    assert flat.rgb.shape == (72, 96, 3)
    assert np.abs(flat.layer("normals")).max() > 0.5
    for view, name in ((deep, "rgb"), (flat, "depth"), (flat, "masks")):
        with pytest.raises(DatasetError):
            getattr(view, name)
    assert deep.object_to_camera.shape == flat.object_to_camera.shape


@pytest.mark.parametrize("command", ["verify", "validate", "stats", "report", "preview"])
def test_commands_take_it(chosen, command, tmp_path):
    extra = {"report": ("--out", tmp_path / "page.html"), "preview": ("--out", tmp_path / "sheet.png")}
    ran = run(command, chosen, *extra.get(command, ()))
    assert ran.code == 0, ran
    assert command != "validate" or "0 errors" in ran.out, ran


def test_it_is_converted_to_the_same_shards(chosen, tmp_path):
    if not (chosen / "train_web").exists():
        pytest.skip("several sensors have no shards")
    bake(tmp_path / "set", **{"bake.formats": ["bop"]})
    ran = run("convert", tmp_path / "set", "--to", "shards", "--out", tmp_path / "more")
    assert ran.code == 0, ran
    ours, theirs = digests(chosen / "train_web"), digests(tmp_path / "more/train_web")
    assert ours == theirs


def test_the_toolkit_knows_the_modalities_of_sensors(chosen):
    text = (chosen / "bop_dataset_params.py").read_text()
    if json.loads((chosen / "manifest.json").read_text())["settings"]["bop"].get("layout") == "multisensor":
        assert "'slow': ['depth'], 'fast': ['rgb']" in text


@pytest.mark.parametrize("chosen", ["classic"], indirect=True)
def test_interrupted_or_in_shares_it_has_the_same_bytes(chosen, tmp_path):
    with failing_after(1):
        bake(tmp_path / "set", **{"bake.worlds": 1})
    assert len(list((tmp_path / "set/manifest").glob("0*.json"))) == 1
    bake(tmp_path / "set")
    for part in range(2):
        bake(tmp_path / str(part), (part, 2))
    assert merge([tmp_path / "0", tmp_path / "1"], tmp_path / "merged").missing == []
    for made in ("set", "merged"):
        assert {name for name, _ in digests(chosen).items() ^ digests(tmp_path / made).items()} <= {"config.toml"}


@pytest.mark.parametrize("chosen", ["classic"], indirect=True)
def test_a_stream_has_the_images_of_each_camera(chosen):
    """What a camera lacks is not rendered; depth and masks, from which all follows, are there for all."""
    with boxes():
        views = taken(synpick_warp.stream(cell_config(CAMERAS, **GIVEN)))
    data = synpick_warp.open(chosen)
    assert views.keys() == {(view.episode, view.camera, view.frame) for view in data.views()}
    for (episode, camera, frame), made in views.items():
        view = data[episode].view(frame, camera)
        assert {"color", "normals", "nocs"} & made.keys() == ({"color", "normals"} if camera else set())
        if camera:
            np.testing.assert_array_equal(made["color"], view.rgb)
        else:
            np.testing.assert_allclose(made["depth"] * 1e-4, view.depth, atol=1e-6)
