"""Ground truth as a pose table: columns, speeds, order; models and symmetries; sets that cannot be evaluated on."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import synpick_warp
from synpick_warp.apps.evaluation.models import read_models
from synpick_warp.apps.evaluation.poses import PoseTable
from synpick_warp.apps.evaluation.results import ResultFile
from synpick_warp.apps.evaluation.run import make_methods
from synpick_warp.apps.evaluation.tracking import filter_poses
from synpick_warp.apps.evaluation.truth import instance_speeds, read_truth
from synpick_warp.errors import CatalogError, DatasetError
from synpick_warp.scenes.assets.ply import read_ply_vertices
from tests.harness.fuzz import fuzz_examples
from tests.worlds.evaluation_set import (
    BOX,
    BRICK,
    CAMERAS,
    FRAMES,
    MODES,
    OBJECTS,
    PERIOD,
    PRISM,
    SPEED,
    VISIBILITY,
    shapes,
    write_evaluation_set,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_evaluation_set(tmp_path_factory.mktemp("truth") / "set")


def test_truth_has_a_row_per_instance_image_and_camera(folder):
    data = synpick_warp.open(folder)
    truth = read_truth(data)
    assert len(truth) == len(truth.poses) == len(MODES) * CAMERAS * FRAMES * len(OBJECTS)
    assert truth.images.tolist() == [[scene, image] for scene in range(len(MODES) * CAMERAS) for image in range(FRAMES)]
    keys = np.stack((truth.poses.scene, truth.poses.image, truth.poses.object_id))
    assert (np.lexsort(keys[::-1]) == np.arange(len(truth))).all()
    for row in (0, 17, len(truth) - 1):
        instance, scene = truth.poses.instance[row], truth.poses.scene[row]
        view = data[scene // CAMERAS].view(int(truth.poses.image[row]), int(scene % CAMERAS))
        np.testing.assert_array_equal(truth.poses.rotation[row], view.object_to_camera[instance, :3, :3])
        np.testing.assert_allclose(truth.poses.translation[row], view.object_to_camera[instance, :3, 3])
        assert truth.poses.object_id[row] == OBJECTS[instance]
        assert truth.visibility[row] == VISIBILITY[instance]
        assert truth.speed[row] == pytest.approx(SPEED[instance], abs=1e-9)
        assert (truth.episode[row], truth.camera[row], truth.mode[row]) == (scene // CAMERAS, scene % CAMERAS, MODES[scene // CAMERAS])
    assert set(truth.poses.score) == {1.0}


def test_speed_is_from_the_frame_before_or_else_from_the_next():
    image = np.array([0, 1, 2, 4, 0])
    count = len(image)
    places = np.zeros((count, 3))
    places[:, 0] = [0.0, 0.1, 0.4, 2.0, 7.0]
    zero = np.zeros(count, np.int64)
    poses = PoseTable(
        zero, image, zero, np.tile(np.eye(3), (count, 1, 1)), places, np.ones(count), -np.ones(count), np.array([0, 0, 0, 0, 1])
    )
    assert instance_speeds(poses, 0.1) == pytest.approx([1.0, 1.0, 3.0, np.nan, np.nan], nan_ok=True)
    assert len(instance_speeds(poses.select(np.zeros(count, bool)), 0.1)) == 0


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 25))
@settings(max_examples=fuzz_examples(100))
def test_speeds_are_those_of_each_row(seed, count):
    random = np.random.default_rng(seed)
    keys = random.permutation(60)[:count]
    scene, instance, image = keys // 30, keys // 10 % 3, keys % 10
    places = random.normal(size=(count, 3))
    speed = instance_speeds(
        PoseTable(scene, image, instance, np.zeros((count, 3, 3)), places, np.ones(count), np.ones(count), instance), PERIOD
    )
    rows = {tuple(key): row for row, key in enumerate(np.stack((scene, instance, image), axis=1).tolist())}
    for (a, b, frame), row in rows.items():
        other = rows.get((a, b, frame - 1), rows.get((a, b, frame + 1)))
        expected = np.nan if other is None else np.linalg.norm(places[row] - places[other]) / PERIOD
        assert speed[row] == pytest.approx(expected, nan_ok=True)


def test_models_are_in_metres_with_the_symmetries_of_the_set(folder):
    models = read_models(folder, OBJECTS)
    np.testing.assert_allclose(models[BRICK].vertices, 1e-3 * shapes()[BRICK].vertices, atol=1e-7)
    assert [models[key].symmetric for key in (BRICK, BOX, PRISM)] == [False, True, True]
    assert [len(models[key].symmetries) for key in (BRICK, BOX, PRISM)] == [1, 2, 315]
    thinned = read_models(folder, [PRISM], vertices=10)[PRISM].vertices
    assert len(thinned) == 10
    assert {tuple(row) for row in thinned} <= {tuple(row) for row in models[PRISM].vertices}
    assert len(read_models(folder, [BOX], vertices=10**6)[BOX].vertices) == len(models[BOX].vertices)


def test_sets_that_cannot_be_evaluated_on_are_named(folder, tmp_path):
    broken = tmp_path / "set"
    shutil.copytree(folder, broken)
    (broken / "models" / "obj_000002.ply").unlink()
    with pytest.raises(DatasetError, match=r"has no models/obj_000002\.ply, the model of an object in its ground truth"):
        read_models(broken, OBJECTS)
    (broken / "models" / "models_info.json").write_text(json.dumps({"1": {"diameter": 1.0}}))
    with pytest.raises(CatalogError, match="no entry for object 2"):
        read_models(broken, OBJECTS)
    (broken / "models" / "models_info.json").unlink()
    with pytest.raises(DatasetError, match=r"has no models/models_info\.json, .*; bake with --formats bop or shards"):
        read_models(broken, OBJECTS)
    entry = broken / "manifest" / "000000.json"
    entry.write_text(entry.read_text().replace('"mode"', '"mood"'))
    with pytest.raises(DatasetError, match="episode 0 has no mode"):
        read_truth(synpick_warp.open(broken))
    for path in (broken / "manifest").iterdir():
        path.unlink()
    with pytest.raises(DatasetError, match="has no episode to evaluate on"):
        read_truth(synpick_warp.open(broken))


def test_estimates_of_a_camera_that_moves_are_filtered_in_the_world(folder, tmp_path):
    """A camera turns over a pile at rest: exact estimates stay exact, and nothing has a speed that has none in the world."""
    out = shutil.copytree(folder, tmp_path / "set")
    scene = sorted((out / "train_pbr").iterdir())[0]
    cameras, poses = (json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt"))
    for frame, camera in cameras.items():
        turn = Rotation.from_euler("xyz", [10 * int(frame), 0, 25 * int(frame)], degrees=True).as_matrix()
        shift = np.array([40.0, -30.0, 15.0]) * int(frame)
        camera |= {"cam_R_w2c": turn.ravel().tolist(), "cam_t_w2c": shift.tolist()}
        for row in poses[frame]:
            row["cam_t_m2c"] = (turn @ row["cam_t_m2c"] + shift).tolist()
            row["cam_R_m2c"] = (turn @ np.reshape(row["cam_R_m2c"], (3, 3))).ravel().tolist()
    for name, content in (("camera", cameras), ("gt", poses)):
        (scene / f"scene_{name}.json").write_text(json.dumps(content))
    truth, before = read_truth(synpick_warp.open(out)), read_truth(synpick_warp.open(folder))
    assert (truth.motion.scene.tolist(), truth.motion.image.tolist()) == ([0] * FRAMES, list(range(FRAMES)))
    np.testing.assert_allclose(truth.speed, before.speed, atol=1e-9)
    world, back = truth.motion.to_world(truth.poses), truth.motion.to_camera(truth.motion.to_world(truth.poses))
    for name in ("rotation", "translation"):
        np.testing.assert_allclose(getattr(world, name), getattr(before.poses, name), atol=1e-12)
        np.testing.assert_allclose(getattr(back, name), getattr(truth.poses, name), atol=1e-12)
    (method,) = make_methods([tmp_path / "a.csv"], [ResultFile(tmp_path / "a.csv", truth.poses, np.arange(len(truth)))], 0.2, truth.motion)
    resting = np.array(SPEED)[truth.poses.instance] == 0.0
    np.testing.assert_allclose(method.filtered.translation[resting], truth.poses.translation[resting], atol=1e-9)
    assert np.abs(filter_poses(truth.poses, 0.2).translation - truth.poses.translation)[resting].max() > 0.05


@pytest.mark.parametrize("body", ["nan 0 0", "1e400 0 0", ""])
def test_vertices_that_are_no_points_are_refused(tmp_path, body):
    path = tmp_path / "a.ply"
    header = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    path.write_text(header.format(1 if body else 0) + body + "\n")
    with pytest.raises(CatalogError, match=r"not a finite number|no vertices|not readable"):
        read_ply_vertices(path)
