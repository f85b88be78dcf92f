"""Measured data sets: deviations within the tolerance are reported and no errors; gross and logical faults are still found."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from synpick_warp.apps.validation.diagnosis import DiagnosedView
from synpick_warp.apps.validation.registry import Tolerance, distributions, load_rules
from synpick_warp.apps.validation.rules.images import _farthest
from synpick_warp.apps.validation.run import Summary, ValidationOptions, validate
from synpick_warp.apps.validation.scene_files import crop_mask
from tests.validation.faults import masks_swapped
from tests.validation.planting import SCENE, edit_entry

TOLERANCE = Tolerance(15.0, 3.0)
RENDERED = {item.name for item in load_rules().values() if item.subject is DiagnosedView}
VISIBLE = f"{SCENE}/mask_visib/000001_000001.png"


def measure(folder, tolerance=TOLERANCE):
    """Validate with a tolerance: the violated rules, and the distributions of the deviations."""
    summary = Summary()
    found = {violation.rule for violation in validate(folder, ValidationOptions(sample=None, threads=1, tolerance=tolerance), summary)}
    return found, distributions(summary.deviations)


def test_every_geometric_rule_has_a_distribution_and_a_rendered_set_none_that_exceeds(good):
    found, measured = measure(good)
    assert not found
    assert {item.rule for item in measured} == {item.name for item in load_rules().values() if item.unit}
    assert all(0.0 <= item.median <= item.percentile_95 <= item.largest < 1.0 for item in measured)
    for rule in {item.rule for item in measured}:
        everyone, *parts = [item for item in measured if item.rule == rule]
        assert everyone.obj_id is None
        assert everyone.instances == sum(part.instances for part in parts)


def test_noise_of_an_annotator_is_measured_and_no_error(copy, check):
    mask = cv2.imread(str(copy / VISIBLE), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(copy / VISIBLE), cv2.dilate(mask, np.ones((3, 3), np.uint8)))
    edit_entry(copy, "gt_info", 2, bbox_obj=[0, 0, 0, 0])
    assert {"mask-inside-mask", "amodal-box"} <= {violation.rule for violation in check(copy)}
    found, measured = measure(copy)
    assert "mask-inside-mask" not in found
    # Counts of the mask's own pixels are logical, and a box of nothing is gross.
    assert {"visible-count", "amodal-box"} <= found
    assert next(item for item in measured if item.rule == "mask-inside-mask").largest == pytest.approx(np.sqrt(2.0), abs=1e-4)


def move_mask(folder):
    """Shift a visible mask by 20 px."""
    mask = cv2.imread(str(folder / VISIBLE), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(folder / VISIBLE), np.roll(mask, 20, axis=1))


GROSS = {
    "pose": lambda folder: edit_entry(folder, "gt", 1, cam_t_m2c=[0.0, 0.0, 1400.0]),
    "mask-inside-mask": move_mask,
    "visible-rendered": move_mask,
    "visible-fraction": lambda folder: edit_entry(folder, "gt_info", 1, visib_fract=0.97),
    "visible-box": lambda folder: edit_entry(folder, "gt_info", 1, bbox_visib=[1, 1, 9, 9]),
    "count-order": lambda folder: edit_entry(folder, "gt_info", 1, px_count_visib=30000),
    "rotation": lambda folder: edit_entry(folder, "gt", 1, cam_R_m2c=[1.0] * 9),
}


@pytest.mark.parametrize("rule", GROSS)
def test_a_gross_fault_is_still_found(copy, rule):
    GROSS[rule](copy)
    assert rule in measure(copy)[0]


def test_depth_in_coarse_counts_is_judged_by_its_counts(copy):
    """Counts of 4 mm are up to 2 mm off: more than 1 mm, less than the one and a half counts that no rule tells apart."""
    path = copy / f"{SCENE}/depth/000001.png"
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    scale = 4.0 / json.loads((copy / f"{SCENE}/scene_camera.json").read_text())["1"]["depth_scale"]
    cv2.imwrite(str(path), np.round(depth / scale).astype(np.uint16))
    edit_entry(copy, "camera", depth_scale=4.0)
    found, measured = measure(copy, Tolerance(1.0, 3.0))
    assert not found & {"pose", "depth-rendered"}
    assert 1.0 < max(item.largest for item in measured if item.rule == "depth-rendered") <= 2.0 + 1e-3


def test_a_swap_is_reported_once(copy):
    masks_swapped(copy)
    assert measure(copy)[0] & RENDERED == {"instances-swapped"}


def test_the_farthest_pixel_is_measured():
    amodal, visible = np.zeros((40, 50), bool), np.zeros((40, 50), bool)
    amodal[10:20, 10:20] = visible[12:15, 12:15] = visible[23, 23] = True
    assert _farthest(crop_mask(visible, ""), crop_mask(amodal, "")) == pytest.approx(4.0 * np.sqrt(2.0), abs=1e-4)
