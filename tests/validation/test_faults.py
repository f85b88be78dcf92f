"""A correct data set has no violation, every planted fault is found and named; the same of foreign BOP layouts. Of measured data sets,
deviations within the tolerance are reported and no errors; gross and logical faults are still found. Measures against known answers and
brute force: masks, shifts, diameters, TIFF headers, symmetries."""

import json
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from synpick_warp.apps.validation.comparison import best_shift, fit_masks
from synpick_warp.apps.validation.comparison import moved as shifted
from synpick_warp.apps.validation.registry import Level, Tolerance, distributions, load_rules
from synpick_warp.apps.validation.rules.coco import run_lengths
from synpick_warp.apps.validation.rules.images import _farthest, wrong_sides
from synpick_warp.apps.validation.rules.models import diameter, sample_area
from synpick_warp.apps.validation.rules.poses import DiagnosedView
from synpick_warp.apps.validation.run import Summary, ValidationOptions, validate
from synpick_warp.apps.validation.scene_files import crop_mask, decode_mask, png_type
from synpick_warp.dataset.bop.layout import Layout
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.image_files import decode_picture, image_size
from tests.validation.conftest import LAYOUTS, imagewise, itodd, multisensor, tless, ycbv
from tests.validation.faults import CAMERA, FAULTS, edit, edit_entry, masks_swapped, moved, pixels, read, swap, write


def test_a_correct_set_has_no_violation_and_every_rule_its_fault(good, check):
    assert check(good) == []
    assert {rule for rule, *_ in FAULTS.values()} == set(load_rules())


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_found(copy, check, name):
    rule, words, plant = FAULTS[name]
    plant(copy)
    rendered = load_rules()[rule].check.__module__.endswith("poses")
    found = [violation for violation in check(copy, sample=None if rendered else 0) if violation.rule == rule]
    assert found, rule
    assert any(words in violation.text for violation in found), [violation.text for violation in found]
    assert all(violation.file for violation in found)


# ---- layouts of others ----


def errors(violations):
    return [violation for violation in violations if violation.level is Level.ERROR]


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
    path = min(path for path in folder.rglob("*gt*.json") if "info" not in path.name and "coco" not in path.name)
    image = (0,) if path.name.endswith(".gt.json") else (next(iter(json.loads(path.read_text()))), 0)
    moved(path.relative_to(folder).as_posix(), *image, "cam_t_m2c", [40.0, 0.0, 0.0])(folder)
    found = [violation for violation in errors(check(folder)) if violation.rule == "pose"]
    assert [violation.text.split(", instance ")[1][0] for violation in found] == ["0"]


def test_sensors_of_a_scene_are_scenes_of_their_own_and_t_less_has_cad_models(good, tmp_path):
    layout = Layout(multisensor(good, tmp_path / "set"))
    assert [ref.sensor for ref in layout.scenes()] == ["_cam0", "_cam1", "_cam2"]
    assert {folder for folder, _ in Layout(tless(good, tmp_path / "tless")).model_files.values()} == {"models_cad"}


def test_sensors_of_a_scene_must_agree_about_the_world(good, check, tmp_path):
    folder = multisensor(good, tmp_path / "set")
    moved("test/000000/scene_camera_cam1.json", "1", "cam_t_w2c", [0.0, 0.0, 30.0])(folder)
    found = errors(check(folder))
    assert {violation.rule for violation in found} == {"world-poses"}
    assert "30 mm" in found[0].text


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
    edit(folder / "train_pbr/000000_000000.mask_visib.json", lambda content: swap(content, "0", "2"))
    found = errors(check(folder))
    assert {"mask-inside-mask", "visible-count"} <= {violation.rule for violation in found}
    assert found[0].file.startswith("train_pbr/000000_000000.")


TOLERANCE = Tolerance(15.0, 3.0)
RENDERED = {item.name for item in load_rules().values() if item.subject is DiagnosedView}
VISIBLE = "mask_visib/000001_000001.png"


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
    pixels(VISIBLE, lambda mask: cv2.dilate(mask, np.ones((3, 3), np.uint8)))(copy)
    edit_entry(copy, "gt_info", 2, bbox_obj=[0, 0, 0, 0])
    assert {"mask-inside-mask", "amodal-box"} <= {violation.rule for violation in check(copy)}
    found, measured = measure(copy)
    assert "mask-inside-mask" not in found
    # Counts of the mask's own pixels are logical, and a box of nothing is gross.
    assert {"visible-count", "amodal-box"} <= found
    assert next(item for item in measured if item.rule == "mask-inside-mask").largest == pytest.approx(np.sqrt(2.0), abs=1e-4)


move_mask = pixels(VISIBLE, lambda mask: np.roll(mask, 20, axis=1))
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
    scale = 4.0 / json.loads((copy / CAMERA).read_text())["1"]["depth_scale"]
    pixels("depth/000001.png", lambda depth: np.round(depth / scale).astype(np.uint16))(copy)
    edit_entry(copy, "camera", depth_scale=4.0)
    found, measured = measure(copy, Tolerance(1.0, 3.0))
    assert not found & {"pose", "depth-rendered"}
    assert 1.0 < max(item.largest for item in measured if item.rule == "depth-rendered") <= 2.0 + 1e-3


def test_a_swap_is_reported_once_and_the_farthest_pixel_is_measured(copy):
    masks_swapped(copy)
    assert measure(copy)[0] & RENDERED == {"instances-swapped"}
    amodal, visible = np.zeros((40, 50), bool), np.zeros((40, 50), bool)
    amodal[10:20, 10:20] = visible[12:15, 12:15] = visible[23, 23] = True
    assert _farthest(crop_mask(visible, ""), crop_mask(amodal, "")) == pytest.approx(4.0 * np.sqrt(2.0), abs=1e-4)


masks = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).random((7, 9)) < 0.3)


@given(masks)
def test_a_cropped_mask_and_its_run_lengths_are_the_whole_one(mask):
    cropped = crop_mask(mask, "")
    assert cropped.count == mask.sum()
    np.testing.assert_array_equal(cropped.window(0, 0, 9, 7), mask)
    padded = np.pad(mask, 3)
    np.testing.assert_array_equal(cropped.window(-3, -3, 15, 13), padded)
    np.testing.assert_array_equal(cropped.window(2, 1, 4, 5), mask[1:6, 2:6])
    counts = run_lengths(cropped)
    np.testing.assert_array_equal(np.repeat(np.arange(len(counts)) % 2 == 1, counts).reshape(9, 7).T, mask)


@pytest.mark.parametrize("shift", [(3, 0), (0, -2), (-5, 4), (1, 1), (0, 0)])
def test_a_shift_is_measured(shift):
    silhouette = np.zeros((60, 70), bool)
    silhouette[20:40, 15:45] = True
    silhouette[35:45, 40:50] = True
    mask = shifted(silhouette, *shift)
    assert best_shift(mask, silhouette) == shift
    np.testing.assert_array_equal(shifted(mask, -shift[0], -shift[1]), silhouette)


def test_a_shift_by_one_pixel_is_no_fit_and_the_half_pixel_convention_is():
    rows, columns = np.mgrid[:120, :120]
    disc = (rows - 60.0) ** 2 + (columns - 60.0) ** 2 < 40.0**2
    half = (rows - 60.0) ** 2 + (columns - 60.5) ** 2 < 40.0**2
    assert fit_masks(disc, disc).iou == 1.0
    assert fit_masks(disc, half).good
    assert not fit_masks(disc, np.roll(disc, 2, axis=1)).good
    square = np.zeros((120, 120), bool)
    square[30:90, 30:90] = True
    assert not fit_masks(square, np.roll(square, (1, 1), axis=(0, 1))).good


def test_the_diameter_is_the_largest_distance_also_of_a_flat_model():
    for count in (2, 10, 700, 3000):
        points = np.random.default_rng(count).normal(size=(count, 3)) * (1.0, 2.0, 30.0) + 100.0
        assert diameter(points) == pytest.approx(pdist(points).max(), rel=1e-9)
    x, y = np.meshgrid(np.arange(50.0), np.arange(40.0))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    assert diameter(points) == pytest.approx(np.hypot(49.0, 39.0), rel=1e-9)


def test_samples_are_spread_evenly_over_the_area():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [4, 0, 0], [4, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])
    points = sample_area(vertices, faces, 4000)
    assert points[:, 0].mean() == pytest.approx(2.0, abs=0.02)
    assert points[:, 1].mean() == pytest.approx(0.5, abs=0.02)
    assert (points[:, 2] == 0.0).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_tiff_images_decode_and_state_their_size(dtype):
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (31, 47)).astype(dtype)
    data = cv2.imencode(".tif", image)[1].tobytes()
    assert image_size(data) == (47, 31)
    np.testing.assert_array_equal(decode_picture(data, "x.tif", DatasetError), image)
    with pytest.raises(DatasetError):
        decode_picture(data[:40], "x.tif", DatasetError)


def test_types_of_masks():
    image = np.zeros((5, 6), np.uint8)
    image[2:4, 1:3] = 255
    good = decode_mask(cv2.imencode(".png", image)[1].tobytes(), "")
    assert (good.binary, good.kind, good.box) == (True, (8, "greyscale"), (1, 2, 2, 2))
    image[0, 0] = 1
    assert not decode_mask(cv2.imencode(".png", image)[1].tobytes(), "").binary
    assert png_type(cv2.imencode(".png", image.astype(np.uint16))[1].tobytes()) == (16, "greyscale")


# ---- amodal boxes against masks that the border of the image cuts ----

LEFT, TOP, RIGHT, BOTTOM = range(4)
SIZE = (100, 60)
"""Width and height of the image [px]."""


def mask(*box: int) -> Any:
    """Mask with a tight box x_min, y_min, width, height [px]."""
    return SimpleNamespace(box=box, size=SIZE)


@pytest.mark.parametrize(
    ("seen", "stated", "wrong"),
    [
        pytest.param((10, 20, 30, 15), [10, 20, 29, 14], [], id="inside"),
        pytest.param((10, 20, 30, 15), [10, 20, 30, 15], [RIGHT, BOTTOM], id="inside, with one more"),
        pytest.param((10, 20, 30, 15), [-5, 20, 44, 14], [LEFT], id="inside, beyond the border"),
        pytest.param((10, 0, 30, 15), [4, -9, 45, 23], [], id="cut at the top, wider beyond"),
        pytest.param((10, 0, 30, 15), [4, -9, 45, 24], [BOTTOM], id="cut at the top, and too low"),
        pytest.param((10, 0, 30, 15), [12, -9, 40, 23], [LEFT], id="cut at the top, and narrower than the mask"),
        pytest.param((0, 0, 30, 15), [-9, -9, 50, 50], [], id="cut at two sides"),
        pytest.param((15, 0, 23, 2), [-52, -165, 194, 176], [], id="cut at the top, and lower around the corner"),
        pytest.param((15, 0, 23, 2), [-52, -165, 80, 176], [RIGHT], id="around the corner, and narrower than the mask"),
    ],
)
def test_sides_are_wrong_where_the_mask_contradicts_them(seen, stated, wrong):
    assert wrong_sides(stated, mask(*seen)) == wrong
