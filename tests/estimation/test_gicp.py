"""GICP of boxes: observed points lie on the model, disturbed poses come back, missing library and missing points."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import synpick_warp
from synpick_warp.apps.estimation.gicp import GicpEstimator, load_small_gicp, observed_points
from synpick_warp.apps.estimation.methods import REFINE, make_group
from synpick_warp.apps.estimation.models import read_object_models
from synpick_warp.apps.estimation.reading import SceneReader
from synpick_warp.apps.estimation.run import Options, read_scenes, run_estimation
from synpick_warp.apps.estimation.scenes import ScenePlan
from synpick_warp.errors import ConfigError
from synpick_warp.exporters.bop.exporter import BopExporter
from tests.worlds.box_sets import write_set
from tests.worlds.box_views import SIZES

PLAN = ScenePlan(0, 0, 0, (0, 1))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return synpick_warp.open(write_set(tmp_path_factory.mktemp("gicp") / "set", BopExporter))


def test_observed_points_lie_on_the_boxes(data):
    scenes = read_scenes(data, [PLAN], Options(REFINE))
    with SceneReader(scenes) as reader:
        batch = next(iter(reader))
        for slot, (object_id, pose) in enumerate(zip(scenes[0].object_ids.tolist(), scenes[0].poses[0], strict=True)):
            points = observed_points(batch, 0, slot)
            own = (points - pose[:3, 3]) @ pose[:3, :3]
            beyond = np.abs(own) / (np.array(SIZES[object_id]) / 2)
            # On a side: its coordinate is half the box's. Depth has steps of 0.1 mm.
            np.testing.assert_allclose(beyond.max(axis=1), 1.0, atol=0.01)
            assert len(points) == (batch.label[0] == 1 + slot).sum()


def test_disturbed_boxes_come_back(data):
    pytest.importorskip("small_gicp")
    options = Options(REFINE)
    scenes = read_scenes(data, [PLAN], options)
    models = read_object_models(data.folder, [3, 7])
    result = run_estimation(scenes, [3, 7], lambda table, height, width: GicpEstimator(models, table, 2), options)
    poses = result.poses
    assert len(poses) == 6
    true = {(0, frame, instance): scenes[0].poses[frame, slot] for frame in (0, 1) for slot, instance in enumerate((0, 2, 3))}
    off = np.array([true[0, image, instance] for image, instance in zip(poses.image.tolist(), poses.instance.tolist(), strict=True)])
    # Two visible sides of a box leave a sliding direction open; the offset of 2 cm and the turn of 15° are mostly undone.
    assert np.median(np.linalg.norm(poses.translation - off[:, :3, 3], axis=1)) < 0.007
    turn = np.degrees(Rotation.from_matrix(poses.rotation @ off[:, :3, :3].transpose(0, 2, 1)).magnitude())
    assert np.median(turn) < 3.0
    assert (poses.score > 0.5).all()
    assert set(poses.seconds) != {0.0}


def test_without_points_there_is_no_estimate(data):
    pytest.importorskip("small_gicp")
    scenes = read_scenes(data, [PLAN], Options(REFINE))
    group = make_group(scenes, [3, 7])
    with SceneReader(scenes) as reader:
        batch = next(iter(reader))
        batch.label[batch.label == 2] = 0
        pose = np.tile(np.array([0, 0, 1, 0, 0, 0, 1], np.float32), (3, 1))
        answer = GicpEstimator(read_object_models(data.folder, [3, 7]), group.table, 1).refine(batch, pose)
    assert answer.valid.tolist() == [True, False, True]
    np.testing.assert_allclose(answer.pose[1], pose[1])


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(ConfigError, match="needs small_gicp, which is not installed"):
        load_small_gicp()


def test_models_are_those_of_the_data_set(data):
    models = read_object_models(data.folder, [7, 3])
    assert [model.object_id for model in models] == [3, 7]
    for model in models:
        np.testing.assert_allclose(np.ptp(model.mesh.vertices, axis=0), SIZES[model.object_id], rtol=1e-6)
    assert models[0].material.texture is not None
    assert models[1].material.texture is None
    assert (len(models[0].symmetries_discrete), len(models[1].symmetries_discrete)) == (0, 1)
    assert models[1].symmetries_continuous[0][1] == pytest.approx((0.001, 0.0, 0.0))
