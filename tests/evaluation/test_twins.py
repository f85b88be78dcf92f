"""Twins of annotated images: what they change, what they keep, and appearance of known pixels."""

import re
import shutil

import cv2
import numpy as np
import pytest

import synpick_warp
from synpick_warp.apps.evaluation.twins import Appearance, measure_appearance
from tests.builders import mistake, run


def test_appearance_of_known_pixels():
    color = np.zeros((40, 40, 3), np.uint8)
    color[:, 20:] = 255, 0, 0
    whole = np.ones((40, 40), bool)
    assert measure_appearance(color, whole)[:2] == pytest.approx((1 / 6, 1 / 6))
    assert measure_appearance(color, whole).saturation == pytest.approx(0.5)
    assert measure_appearance(color, np.arange(40) > 30 + 0 * whole) == pytest.approx(Appearance(1 / 3, 0.0, 1.0, 0.0), abs=1e-5)


def test_twins_differ_in_the_pixels_of_objects_alone(picked_set, tmp_path):
    """All but colour images has the bytes of the data set; a twin differs inside of visible masks, and is bright under a bright light."""
    out = tmp_path / "twins"
    code, text, error = run("gap", picked_set, "--out", out, "--device", "cpu", "--set", "render.exposure=2.0")
    assert code == 0, error
    real, twins = synpick_warp.open(picked_set), synpick_warp.open(out)
    files = {path.relative_to(out): path for path in out.rglob("*") if path.is_file()}
    assert files.keys() == {path.relative_to(picked_set) for path in picked_set.rglob("*") if path.is_file()}
    changed = {str(name.parent.name) for name, path in files.items() if path.read_bytes() != (picked_set / name).read_bytes()}
    assert changed == {"rgb"}
    brighter = 0
    for image, twin in zip(real.views(), twins.views(), strict=True):
        shown = image.masks.any(axis=0)
        far = np.abs(image.rgb.astype(int) - twin.rgb).max(axis=2) > 40  # JPEG rings by less.
        assert not (far & ~shown).any()
        brighter += int((twin.rgb[shown].astype(int) - image.rgb[shown]).mean() > 20) if shown.any() else 0
    assert brighter > 1
    assert text.count("\n") == 2 + len({int(index) for view in real.views() for index in view.object_ids})


def test_twins_of_a_sensor_stand_where_its_images_do(picked_set, tmp_path):
    """A grey sensor's folder has its name, files have four digits, and no camera has a pose: twins are grey, the linked data set keeps its
    bytes, and another split is left out."""
    real = tmp_path / "real"
    shutil.copytree(picked_set / "models", real / "models")
    scene = shutil.copytree(next(picked_set.glob("*/000000/rgb")).parent, real / "test" / "000000")
    (scene / "rgb").rename(scene / "gray1")
    for path in list((scene / "gray1").iterdir()):
        cv2.imwrite(str(path.with_name(f"{path.stem[2:]}.png")), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        path.unlink()
    for path in list(scene.iterdir()):
        if re.fullmatch("(scene_(camera|gt|gt_info).json|depth|mask|mask_visib)", path.name):
            path.rename(path.with_name(f"{path.stem}_gray1{path.suffix}"))
    cameras = scene / "scene_camera_gray1.json"
    cameras.write_text(re.sub(r'"cam_[Rt]_w2c": ?\[[^]]*\],? ?', "", cameras.read_text()).replace(", }", "}"))
    before = {path: path.read_bytes() for path in real.rglob("*") if path.is_file()}
    shutil.copytree(scene, real / "train" / "000001")
    code, _, error = run("gap", real, "--out", tmp_path / "a" / "twins", "--device", "cpu", "--split", "test")
    assert code == 0, error
    assert "images without cam_R_w2c are taken as upright" in error
    made = {path.relative_to(tmp_path / "a" / "twins"): path for path in (tmp_path / "a" / "twins").rglob("*") if path.is_file()}
    assert {real / name for name in made} == before.keys()
    assert all(path.read_bytes() == data for path, data in before.items())
    changed = [path for name, path in made.items() if path.read_bytes() != before[real / name]]
    assert changed
    assert {path.parent.name for path in changed} == {"gray1"}
    assert {cv2.imread(str(path), cv2.IMREAD_UNCHANGED).ndim for path in changed} == {2}


def test_what_has_no_twins_is_one_line(picked_set, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    assert "allowed: a new or an empty folder" in mistake("gap", picked_set, "--out", tmp_path / "full")
    assert "is not a data set" in mistake("gap", tmp_path / "full", "--out", tmp_path / "new")
    shutil.copytree(picked_set / "models", tmp_path / "real" / "models")
    scene = shutil.copytree(next(picked_set.glob("*/000000/rgb")).parent, tmp_path / "real" / "test" / "000000")
    truth = (scene / "scene_gt.json").read_text()
    (scene / "scene_gt.json").write_text(re.sub(r'("cam_R_m2c": ?\[)[^]]*', r"\g<1>1, 0, 0, 0, 1, 0, 0, 0, -1", truth))
    assert "cam_R_m2c that is no rotation" in mistake("gap", tmp_path / "real", "--out", tmp_path / "new", "--device", "cpu")
    (scene / "scene_gt.json").unlink()
    (scene / "scene_gt_info.json").unlink()
    assert "no image with objects" in mistake("gap", tmp_path / "real", "--out", tmp_path / "new")
    assert not (tmp_path / "new").exists()
