"""A bake of cameras that have files of some images only: depth and masks of one, colour and normals of the other."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import synpick_warp
from synpick_warp.configs.load import load_config
from synpick_warp.errors import DatasetError
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.system.progress import SilentProgress
from tests.builders import STIRRING, boxes, once, run
from tests.dataset.test_sparse_cameras import CELL
from tests.harness.exporter_contract import digests
from tests.worlds.small_worlds import settings

CHOSEN = CELL.replace("every = 3", 'modalities = ["masks", "depth"]').replace('"fast"', '"fast"\nmodalities = ["color", "normals"]')
KINDS = ({"depth", "mask", "mask_visib"}, {"rgb", "normals"})


def bake(out: Path, **given: object) -> None:
    (out.parent / "cell.toml").write_text(CHOSEN)
    ours = {"bake.formats": ["bop", "shards", "zarr"], "render.layers": ["normals", "nocs"]}
    config = replace(
        settings(**STIRRING | ours | given), camera=load_config(str(out.parent / "cell.toml"), {"render.layers": ["normals"]}).camera
    )
    with boxes():
        run_bake(config, out, SilentProgress())


@pytest.fixture(scope="module", params=["classic", "multisensor"])
def chosen(tmp_path_factory, request):
    formats = ["bop", "shards", "zarr"] if request.param == "classic" else ["bop", "zarr"]

    def make(out: Path) -> None:
        bake(out, **{"bop.layout": request.param, "bake.formats": formats})

    return once(tmp_path_factory, f"modalities-{request.param}", make)[0]


def test_each_camera_has_its_own_files(chosen, request):
    scenes = sorted(path for path in (chosen / "train").iterdir() if path.is_dir())
    folders = [{path.name for path in scene.iterdir() if path.is_dir()} for scene in scenes]
    if len(folders) == 2:
        assert folders == list(KINDS)
    else:
        assert folders == [{f"{kind}_{name}" for name, kinds in zip(("slow", "fast"), KINDS, strict=True) for kind in kinds}]
    data = synpick_warp.open(chosen)
    deep, flat = data[0].view(2, 0), data[0].view(2, 1)
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
