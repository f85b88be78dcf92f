"""bop_dataset_params.py, run as its instruction says, on a stand-in for the toolkit's module; paths it returns exist."""

from __future__ import annotations

import json
import os
import runpy
import shutil
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from synpick_warp.exporters.bop.exporter import BopExporter
from tests.exporters.bop.test_bop import make
from tests.harness.exporter_contract import FRAMES
from tests.worlds.box_sets import EPISODES, write_set


@pytest.fixture
def toolkit(monkeypatch) -> ModuleType:
    """A stand-in for bop_toolkit_lib.dataset_params."""

    def unknown(datasets_path: str, name: str, *rest: object, **more: object) -> dict[str, object]:
        raise ValueError(f"Unknown BOP dataset ({name}).")

    package, module = ModuleType("bop_toolkit_lib"), ModuleType("bop_toolkit_lib.dataset_params")
    for name in ("get_split_params", "get_model_params", "get_camera_params"):
        setattr(module, name, unknown)
    module.inout = SimpleNamespace(load_cam_params=lambda path: {"im_size": json.loads(Path(path).read_text())["width"]})
    package.dataset_params = module
    monkeypatch.setitem(sys.modules, "bop_toolkit_lib", package)
    monkeypatch.setitem(sys.modules, "bop_toolkit_lib.dataset_params", module)
    return module


@pytest.mark.parametrize("layout", ["classic", "multisensor"])
def test_paths_of_the_entry_exist(toolkit, tmp_path, layout):
    folder = write_set(tmp_path / "synpick", BopExporter, layout=layout)
    runpy.run_path(str(folder / "bop_dataset_params.py"))
    split = toolkit.get_split_params(str(tmp_path), "synpick", "train", split_type=None)
    classic = layout == "classic"
    assert split["scene_ids"] == ([3 * episode + camera for episode in EPISODES for camera in range(3)] if classic else list(EPISODES))
    assert split["eval_sensor"] == (None if classic else "cam0")
    assert split["im_size"] == ((96, 72) if classic else {"": (96, 72), "cam0": (96, 72), "cam1": (96, 72), "cam2": (96, 72)})
    templates = {name: path for name, path in split.items() if name.endswith("_tpath")}
    assert len(templates) == (9 if classic else 3 * 2 * 7)
    for scene in split["scene_ids"]:
        for name, path in templates.items():
            if name != "gray_tpath":
                assert os.path.isfile(path.format(scene_id=scene, im_id=FRAMES - 1, gt_id=2)), path
    keys = {"scene_gt_tpath", "rgb_tpath"} if classic else {"scene_gt_rgb_cam1_tpath", "mask_visib_depth_cam2_tpath", "depth_cam0_tpath"}
    assert keys <= set(templates)


def test_models_cameras_and_other_data_sets(toolkit, tmp_path):
    folder = make(tmp_path / "synpick", episodes=(0,))
    runpy.run_path(str(folder / "bop_dataset_params.py"))
    models = toolkit.get_model_params(str(tmp_path), "synpick", "eval")
    assert (models["obj_ids"], models["symmetric_obj_ids"]) == ([3, 7], [7])
    assert all(os.path.isfile(models["model_tpath"].format(obj_id=obj_id)) for obj_id in models["obj_ids"])
    assert toolkit.get_split_params(str(tmp_path), "synpick", "train", "pbr")["rgb_tpath"].endswith(".jpg")
    assert toolkit.get_camera_params(str(tmp_path), "synpick")["im_size"] == 96
    with pytest.raises(ValueError, match=r"Unknown BOP dataset \(lm\)"):
        toolkit.get_split_params(str(tmp_path), "lm", "test")
    with pytest.raises(ValueError, match="synpick has no split test; splits: train_pbr"):
        toolkit.get_split_params(str(tmp_path), "synpick", "test")
    notes = (folder / "dataset_info.md").read_text()
    for text in ("run_path('$BOP_PATH/synpick/bop_dataset_params.py')", "METHOD_synpick-train-pbr.csv", "on a copy", "EGL_PLATFORM"):
        assert text in notes
    shutil.move(folder, tmp_path / "my-set")
    with pytest.raises(ValueError, match="rename"):
        runpy.run_path(str(tmp_path / "my-set" / "bop_dataset_params.py"))
