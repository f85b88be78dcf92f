"""A correct data set has no violation, every planted fault is found and named; the same of foreign BOP layouts."""

from __future__ import annotations

import json

import numpy as np
import pytest

from synpick_warp.apps.validation.registry import Level, load_rules
from synpick_warp.apps.validation.run import Summary, ValidationOptions, validate
from synpick_warp.dataset.bop.layout import Layout
from tests.validation.faults import FAULTS
from tests.validation.layouts import LAYOUTS, imagewise, itodd, multisensor, tless, ycbv
from tests.validation.planting import read, write


def test_a_correct_set_has_no_violation(good, check):
    assert check(good) == []


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_found(copy, check, name):
    rule, words, plant = FAULTS[name]
    plant(copy)
    rendered = load_rules()[rule].check.__module__.endswith("poses")
    found = [violation for violation in check(copy, sample=None if rendered else 0) if violation.rule == rule]
    assert found, rule
    assert any(words in violation.text for violation in found), [violation.text for violation in found]
    assert all(violation.file for violation in found)


def test_every_rule_has_its_fault():
    assert {rule for rule, *_ in FAULTS.values()} == set(load_rules())


# ---- layouts of others ----


def errors(violations):
    return [violation for violation in violations if violation.level is Level.ERROR]


def poses(folder):
    """Files with poses, and those of their images."""
    return sorted(folder.glob("*/*/scene_gt*.json")) + sorted(folder.glob("*/*.gt.json"))


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_correct_set_of_another_layout_has_no_error(good, check, tmp_path, name):
    folder = LAYOUTS[name](good, tmp_path / "set")
    summary = Summary()
    found = list(validate(folder, ValidationOptions(sample=None, threads=1), summary))
    assert errors(found) == []
    assert {violation.rule for violation in found} <= {"set-files", "ground-truth"}
    assert summary.rendered >= 6


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_wrong_pose_is_found_in_every_layout(good, check, tmp_path, name):
    folder = LAYOUTS[name](good, tmp_path / "set")
    path = next(path for path in poses(folder) if "info" not in path.name and "coco" not in path.name)
    content = json.loads(path.read_text())
    (content[0] if isinstance(content, list) else next(iter(content.values()))[0])["cam_t_m2c"][0] += 40.0
    path.write_text(json.dumps(content))
    found = [violation for violation in errors(check(folder)) if violation.rule == "pose"]
    assert [violation.text.split(", instance ")[1][0] for violation in found] == ["0"]


def test_sensors_of_a_scene_are_scenes_of_their_own(good, tmp_path):
    layout = Layout(multisensor(good, tmp_path / "set"))
    assert [ref.sensor for ref in layout.scenes()] == ["_cam0", "_cam1", "_cam2"]


def test_sensors_of_a_scene_must_agree_about_the_world(good, check, tmp_path):
    folder = multisensor(good, tmp_path / "set")
    path = folder / "test/000000/scene_camera_cam1.json"
    content = json.loads(path.read_text())
    content["1"]["cam_t_w2c"][2] += 30.0
    path.write_text(json.dumps(content))
    found = errors(check(folder))
    assert {violation.rule for violation in found} == {"world-poses"}
    assert "30 mm" in found[0].text


def test_poses_of_t_less_are_checked_with_its_cad_models(good, tmp_path):
    assert {folder for folder, _ in Layout(tless(good, tmp_path / "set")).model_files.values()} == {"models_cad"}


def test_measured_depth_may_be_noisy_but_not_scaled(good, check, tmp_path):
    folder = ycbv(good, tmp_path / "set")
    for path in folder.glob("test/000048/depth/*.png"):
        write(path, np.rint(read(path) * 1.02).astype(np.uint16))
    found = errors(check(folder))
    assert {violation.rule for violation in found} == {"depth-scaled"}
    assert all("1.02 times" in violation.text for violation in found)


def test_shifted_masks_are_found_without_amodal_ones(good, check, tmp_path):
    folder = itodd(good, tmp_path / "set")
    path = folder / "val/000000/mask_visib/000000_000000.png"
    write(path, np.roll(read(path), 6, axis=1))
    assert "the mask is shifted by (6, 0) px" in "; ".join(v.text for v in errors(check(folder)) if v.rule == "mask-shifted")


def test_masks_of_keyed_views_are_checked(good, check, tmp_path):
    folder = imagewise(good, tmp_path / "set")
    path = folder / "train_pbr/000000_000000.mask_visib.json"
    content = json.loads(path.read_text())
    content["0"], content["2"] = content["2"], content["0"]
    path.write_text(json.dumps(content))
    found = errors(check(folder))
    assert {"mask-inside-mask", "visible-count"} <= {violation.rule for violation in found}
    assert found[0].file.startswith("train_pbr/000000_000000.")
