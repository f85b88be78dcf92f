"""Scenes and their images: what the reader hands over equals the views of the data set, from folders and from shards."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import synpick_warp
from synpick_warp.apps.estimation.mask_errors import disturb_labels
from synpick_warp.apps.estimation.reading import SceneReader
from synpick_warp.apps.estimation.scenes import ABSENT, Scene, ScenePlan, group_scenes, read_scene
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from tests.worlds.box_sets import HOLE, add_sensor_depth, write_set


@pytest.fixture(scope="module", params=[BopExporter, ShardsExporter], ids=["bop", "shards"])
def data(request, tmp_path_factory):
    return synpick_warp.open(write_set(tmp_path_factory.mktemp("reading") / "set", request.param))


@pytest.fixture
def folder(tmp_path):
    return write_set(tmp_path / "set", BopExporter)


def plan(episode: int, camera: int, *frames: int) -> ScenePlan:
    return ScenePlan(3 * episode + camera, episode, camera, frames)


def labels(view, scene: Scene) -> np.ndarray:
    """Label image by the view's own masks."""
    image = np.zeros(view.depth.shape, np.uint8)
    for mask, instance in zip(view.masks, view.instance_ids.tolist(), strict=True):
        image[mask] = 1 + int(np.flatnonzero(scene.instances == instance)[0])
    return image


def test_truth_equals_the_views(data):
    scene = read_scene(data, plan(2, 1, 2, 0))
    assert scene.instances.tolist() == [0, 2, 3]
    assert scene.object_ids.tolist() == [3, 7, 3]
    for row, frame in enumerate((2, 0)):
        view = data[2].view(frame, 1)
        assert scene.index[row].tolist() == [0, 1, 2]
        np.testing.assert_allclose(scene.poses[row], view.object_to_camera)
        np.testing.assert_allclose(scene.visibility[row], view.visibility)
        np.testing.assert_array_equal(scene.boxes[row], view.visible_boxes)
        np.testing.assert_allclose(scene.intrinsics[row], view.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]], rtol=1e-6)
        assert scene.depth_scale[row] == pytest.approx(1e-4)


@pytest.mark.parametrize(("threads", "ahead"), [(1, 0), (3, 2)])
def test_images_equal_the_views_and_ended_scenes_are_empty(data, threads, ahead):
    plans = [plan(0, 0, 0, 1, 2), plan(2, 2, 2), plan(0, 1, 1, 0)]
    scenes = [read_scene(data, each) for each in plans]
    with SceneReader(scenes, threads=threads, ahead=ahead) as reader:
        for step, batch in enumerate(reader):
            for index, (each, scene) in enumerate(zip(plans, scenes, strict=True)):
                if step >= len(scene):
                    assert not any(image[index].any() for image in (batch.color, batch.depth, batch.label))
                    continue
                view = data[each.episode].view(each.frames[step], each.camera)
                np.testing.assert_array_equal(batch.color[index], view.rgb)
                np.testing.assert_allclose(batch.depth[index] * batch.depth_scale[index], view.depth, rtol=1e-6)
                np.testing.assert_array_equal(batch.label[index], labels(view, scene))
                np.testing.assert_array_equal(batch.intrinsics[index], scene.intrinsics[step])
    assert reader.steps == step + 1 == 3


def test_instances_that_are_not_asked_have_no_label(data):
    scene = read_scene(data, plan(0, 0, 0))
    with SceneReader([replace(scene, asked=np.array([[True, False, True]]))]) as reader:
        label = next(iter(reader)).label[0]
    assert set(np.unique(label)) == {0, 1, 3}


def test_mask_errors_are_those_of_seed_scene_and_frame(data):
    scene = read_scene(data, plan(2, 1, 0, 1, 2))
    changed = False
    for seed in range(6):
        with SceneReader([scene], mask_seed=seed) as reader:
            for step, batch in enumerate(reader):
                exact = labels(data[2].view(step, 1), scene)
                expected = exact.copy()
                disturb_labels(expected, scene.boxes[step], scene.instances, seed, 7, step)
                np.testing.assert_array_equal(batch.label[0], expected)
                changed |= bool((expected != exact).any())
    assert changed


def test_sensor_depth_is_read_if_it_is_asked(folder):
    add_sensor_depth(folder)
    data = synpick_warp.open(folder)
    scene = read_scene(data, plan(0, 0, 1))
    with SceneReader([scene], "sensor") as reader:
        depth = next(iter(reader)).depth[0].copy()
    clean = data[0].view(1).depth
    assert not depth[:, :HOLE].any()
    np.testing.assert_allclose(depth[:, HOLE:] * 1e-4, clean[:, HOLE:], rtol=1e-6)


def edit(folder, name: str, change) -> None:
    path = folder / "train" / "000000" / f"scene_{name}.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_an_instance_that_comes_late_has_its_slot(folder):
    for name in ("gt", "gt_info"):
        edit(folder, name, lambda content: content["0"].pop(1))
    scene = read_scene(synpick_warp.open(folder), plan(0, 0, 0, 1))
    assert scene.index.tolist() == [[0, ABSENT, 1], [0, 1, 2]]
    np.testing.assert_array_equal(scene.poses[0, 1], np.eye(4))
    assert scene.asked.tolist() == [[True, False, True], [True, True, True]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content["1"][0].pop("instance_id"), "an instance of image 1 has no instance_id"),
        (lambda content: content["1"][1].update(instance_id=0), "instance 0 of image 1 has another obj_id than before"),
        (lambda content: content["1"][2].update(instance_id=0), "image 1 has an instance_id twice"),
        (lambda content: content["1"][0].update(cam_R_m2c=[0.0] * 9), "a cam_R_m2c of image 1 is no rotation"),
        (lambda content: content["1"][0].update(cam_R_m2c=[-1, 0, 0, 0, 1, 0, 0, 0, 1]), "a cam_R_m2c of image 1 is no rotation"),
        (lambda content: content.pop("1"), "do not agree about image 1"),
    ],
)
def test_damaged_truth_is_refused(folder, change, message):
    edit(folder, "gt", change)
    with pytest.raises(DatasetError, match=message):
        read_scene(synpick_warp.open(folder), plan(0, 0, 0, 1, 2))


def test_cameras_have_focal_lengths(folder):
    edit(folder, "camera", lambda content: content["1"].update(cam_K=[0.0] * 9))
    with pytest.raises(DatasetError, match="a focal length in cam_K is not above 0"):
        read_scene(synpick_warp.open(folder), plan(0, 0, 0, 1, 2))


def test_damaged_images_are_refused(folder):
    data = synpick_warp.open(folder)
    scene = read_scene(data, plan(0, 0, 0, 1, 2))
    path = folder / "train" / "000000" / "mask_visib" / "000001_000001.png"
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(DatasetError, match="is not an image that OpenCV can decode"), SceneReader([scene]) as reader:
        list(reader)
    path.unlink()
    with pytest.raises(DatasetError, match="there is no"), SceneReader([scene]) as reader:
        list(reader)


def test_scenes_of_similar_length_share_a_group():
    plans = [plan(0, 0, 1), plan(1, 0, *range(9)), plan(2, 0, *range(3)), plan(3, 0, *range(8))]
    assert [[one.episode for one in group] for group in group_scenes(plans, 2)] == [[1, 3], [2, 0]]
    assert group_scenes([], 2) == []
