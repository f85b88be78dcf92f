"""GICP of boxes: observed points lie on the model, disturbed poses come back, and few points are no estimate."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import synpick_warp
from synpick_warp.apps.estimation.gicp import MIN_POINTS, Aligner, read_object_models
from synpick_warp.apps.estimation.run import (
    OFFSET,
    REFINE,
    SINGLE,
    TURN,
    EstimationOptions,
    disturb_pose,
    observed_points,
    read_scenes,
    run_estimation,
)
from synpick_warp.apps.estimation.scenes import ScenePlan
from synpick_warp.exporters.bop.exporter import BopExporter
from tests.worlds.box_sets import write_set
from tests.worlds.box_views import SIZES

PLAN = ScenePlan(0, 0, 0, (0, 1))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return synpick_warp.open(write_set(tmp_path_factory.mktemp("gicp") / "set", BopExporter))


@pytest.fixture(scope="module")
def aligner(data):
    return Aligner(read_object_models(data.folder, [3, 7]))


def test_observed_points_lie_on_the_boxes(data):
    (scene,) = read_scenes(data, [PLAN], EstimationOptions(REFINE))
    for slot, (object_id, pose) in enumerate(zip(scene.object_ids.tolist(), scene.poses[0], strict=True)):
        points = observed_points(scene, 0, slot, "depth")
        own = (points - pose[:3, 3]) @ pose[:3, :3]
        beyond = np.abs(own) / (np.array(SIZES[object_id]) / 2)
        # On a side: its coordinate is half the box's. Depth has steps of 0.1 mm.
        np.testing.assert_allclose(beyond.max(axis=1), 1.0, atol=0.01)
        assert len(points) > MIN_POINTS


def test_a_disturbed_pose_is_off_by_the_same_amounts_and_depends_on_its_key():
    pose = np.eye(4)
    pose[:3, 3] = (0.1, -0.2, 1.0)
    made = [disturb_pose(pose, 0, 1, 2, instance) for instance in range(50)]
    np.testing.assert_allclose([np.linalg.norm(each[:3, 3] - pose[:3, 3]) for each in made], OFFSET)
    np.testing.assert_allclose([np.degrees(Rotation.from_matrix(each[:3, :3]).magnitude()) for each in made], TURN)
    assert len({each.tobytes() for each in made}) == 50
    np.testing.assert_array_equal(disturb_pose(pose, 0, 1, 2, 7), made[7])


def test_disturbed_boxes_come_back(data, aligner):
    options = EstimationOptions(REFINE, threads=2)
    (scene,) = scenes = read_scenes(data, [PLAN], options)
    poses = run_estimation(scenes, aligner, options).poses
    assert len(poses) == 6
    true = {(frame, instance): scene.poses[frame, slot] for frame in (0, 1) for slot, instance in enumerate((0, 2, 3))}
    off = np.array([true[image, instance] for image, instance in zip(poses.image.tolist(), poses.instance.tolist(), strict=True)])
    # Two visible sides of a box leave a sliding direction open; the offset of 2 cm and the turn of 15° are mostly undone.
    assert np.median(np.linalg.norm(poses.translation - off[:, :3, 3], axis=1)) < 0.007
    turn = np.degrees(Rotation.from_matrix(poses.rotation @ off[:, :3, :3].transpose(0, 2, 1)).magnitude())
    assert np.median(turn) < 3.0
    assert (poses.score > 0.5).all()
    assert (poses.seconds > 0.0).all()


def test_a_search_finds_the_surface_without_a_start(data, aligner):
    """Distances of the observed points to the box at the estimated pose; turns of a box by 180 degrees are as good."""
    options = EstimationOptions(SINGLE, threads=2)
    (scene,) = scenes = read_scenes(data, [PLAN], options)
    poses = run_estimation(scenes, aligner, options).poses
    slots = {int(instance): slot for slot, instance in enumerate(scene.instances)}
    off = []
    for row in range(len(poses)):
        points = observed_points(scene, scene.plan.frames.index(int(poses.image[row])), slots[int(poses.instance[row])], "depth")
        own = np.abs((points - poses.translation[row]) @ poses.rotation[row]) - np.array(SIZES[int(poses.object_id[row])]) / 2
        off.append(np.abs(own.max(axis=1)).mean())
    assert np.median(off) < 2e-3


def test_without_points_there_is_no_estimate(aligner):
    start = np.eye(4)
    start[2, 3] = 1.0
    for points in (np.empty((0, 3)), np.ones((MIN_POINTS - 1, 3))):
        pose, score = aligner.refine(3, points, start)
        np.testing.assert_array_equal(pose, start)
        assert score == aligner.search(3, points)[1] == 0.0


def test_models_are_those_of_the_data_set(data):
    models = read_object_models(data.folder, [7, 3])
    assert [model.object_id for model in models] == [3, 7]
    for model in models:
        np.testing.assert_allclose(np.ptp(model.mesh.vertices, axis=0), SIZES[model.object_id], rtol=1e-6)
    assert models[0].material.texture is not None
    assert models[1].material.texture is None
