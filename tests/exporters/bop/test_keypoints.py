"""Keypoints of COCO annotations: farthest points of known shapes, projections and visibility against ray casts, read by pycocotools."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pycocotools.coco import COCO

import synpick_warp
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.keypoints import Keypoints, project_keypoints, sample_keypoints
from tests.harness.exporter_contract import digests, export, with_files
from tests.worlds.box_sets import write_set
from tests.worlds.box_views import SIZES, config

CAMERA = {"cam_K": [100.0, 0.0, 50.0, 0.0, 100.0, 40.0, 0.0, 0.0, 1.0], "depth_scale": 0.1}
POSE = {"obj_id": 1, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0.0, 0.0, 1000.0]}


def test_farthest_points_of_a_cube_are_its_corners_and_their_skeleton_is_a_tree():
    corners = np.array([[x, y, z] for x in (0, 0.2) for y in (0, 0.2) for z in (0, 0.2)], np.float32)
    inner = np.random.default_rng(0).uniform(0.09, 0.11, (200, 3)).astype(np.float32)
    found = sample_keypoints(np.concatenate((inner, corners)), 8)
    assert {tuple(point) for point in found.positions.tolist()} == {
        tuple(point) for point in np.round(1000.0 * corners.astype(float), 4).tolist()
    }
    assert [last for _, last in found.edges] == list(range(1, 8))
    assert all(first < last for first, last in found.edges)
    assert len(sample_keypoints(np.repeat(corners, 3, axis=0), 20).positions) == 8


def test_flags_tell_outside_hidden_and_visible():
    points = {1: Keypoints(np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [600, 0, 0], [0, 0, -1100]]), ())}
    depth = np.full((80, 100), 10000, np.uint16)
    depth[40, 60] = 9800  # 20 mm in front: more than a pixel's width, 10 mm, and the tolerance.
    depth[50, 50] = 9890  # 11 mm in front.
    (keys,) = project_keypoints([POSE], CAMERA, depth, points)
    assert keys == {"keypoints": [50.0, 40.0, 2, 60.0, 40.0, 1, 50.0, 50.0, 2, 0, 0, 0, 0, 0, 0], "num_keypoints": 3}
    (keys,) = project_keypoints([POSE], CAMERA, np.zeros((80, 100), np.uint16), points)
    assert keys["keypoints"][2::3] == [2, 2, 2, 0, 0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_set(tmp_path_factory.mktemp("keypoints") / "set", BopExporter, keypoints=8)


def test_pycocotools_reads_keypoints_whose_flags_agree_with_rays(folder, capsys):
    view_count = {0: 0, 1: 0, 2: 0}
    data = synpick_warp.open(folder)
    for scene in sorted((folder / "train").iterdir()):
        coco = COCO(str(scene / "scene_gt_coco.json"))
        categories = {category["id"]: category for category in coco.loadCats(coco.getCatIds())}
        assert {index: category["name"] for index, category in categories.items()} == {obj_id: f"box {obj_id}" for obj_id in SIZES}
        episode, camera = divmod(int(scene.name), 3)
        for annotation in coco.loadAnns(coco.getAnnIds()):
            view = data[episode].view(annotation["image_id"], camera)
            category = categories[annotation["category_id"]]
            positions = np.array(category["keypoint_positions"])
            assert len(category["keypoints"]) == len(positions) == 8
            assert sorted(np.abs(positions).max(axis=0)) == pytest.approx(sorted(np.array(SIZES[category["id"]]) * 500))
            x, y, flag = np.reshape(annotation["keypoints"], (8, 3)).T
            assert annotation["num_keypoints"] == (flag > 0).sum()
            rows = [row for row, mask in enumerate(view.masks) if mask.sum() == annotation["area"]]
            pixels = [view.project(positions / 1000, view.object_to_camera[row]) for row in rows]
            labeled = flag > 0
            assert any(np.abs(each[labeled] - np.stack((x, y), axis=1)[labeled]).max(initial=0) < 0.006 for each in pixels)
            for each in flag.tolist():
                view_count[int(each)] += 1
    capsys.readouterr()
    assert min(view_count.values()) > 0  # All three occur.


def test_depth_files_of_the_device_give_the_same_flags(tmp_path):
    images, files = (
        export(BopExporter, tmp_path / name, config(keypoints=8), prepare=prepare)
        for name, prepare in (("images", lambda batch: batch), ("files", with_files))
    )
    assert digests(files) == digests(images)


def test_without_the_option_annotations_have_no_keypoints(tmp_path):
    coco = json.loads((export(BopExporter, tmp_path, config(), (0,)) / "train_pbr" / "000000" / "scene_gt_coco.json").read_text())
    assert all("keypoints" not in entry for entry in (*coco["annotations"], *coco["categories"]))
