"""Protocols: what each method gives to an estimator, and what comes out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import synpick_warp
from synpick_warp.apps.estimation.disturbance import disturb_poses
from synpick_warp.apps.estimation.factories import sensor_noise
from synpick_warp.apps.estimation.methods import GICP, REFINE, SINGLE, TRACK, ask, make_group, to_rotations, to_transforms
from synpick_warp.apps.estimation.run import (
    AHEAD,
    BYTES_PER_PIXEL,
    MAX_VIEWS,
    Options,
    count_views,
    list_targets,
    read_scenes,
    run_estimation,
)
from synpick_warp.apps.estimation.scenes import ABSENT, ScenePlan, read_scene
from synpick_warp.apps.evaluation.truth import read_truth
from synpick_warp.configs.cell.sensors import DepthSensor
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.exporter import BopExporter
from tests.estimation.fakes import FakeEstimator
from tests.worlds.box_sets import write_set

PLANS = [ScenePlan(0, 0, 0, (0, 1, 2)), ScenePlan(7, 2, 1, (0, 2)), ScenePlan(8, 2, 2, (1,))]
OBJECTS = [3, 7]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return synpick_warp.open(write_set(tmp_path_factory.mktemp("methods") / "set", BopExporter))


class Factory:
    """Makes fake estimators, and keeps them."""

    def __init__(self, **settings: float) -> None:
        self.made: list[FakeEstimator] = []
        self.settings = settings

    def __call__(self, table, height, width):
        assert (height, width) == (72, 96)
        self.made.append(FakeEstimator(table, **self.settings))
        return self.made[-1]


def run(data, options: Options, factory: Factory, plans=PLANS):
    scenes = read_scenes(data, plans, options)
    return run_estimation(scenes, OBJECTS, factory, options)


def true_rows(data, plans=PLANS):
    """Rows of the ground truth of the plans' images."""
    poses = read_truth(data).poses
    images = {(plan.scene, frame) for plan in plans for frame in plan.frames}
    return poses.select(np.array([key in images for key in zip(poses.scene.tolist(), poses.image.tolist(), strict=True)]))


@pytest.mark.parametrize("views", [0, 1, 2])
def test_single_frames_are_estimated_from_images_alone(data, views):
    factory = Factory()
    result = run(data, Options(SINGLE, views=views), factory)
    truth = true_rows(data)
    for name in ("scene", "image", "object_id"):
        np.testing.assert_array_equal(getattr(result.poses, name), getattr(truth, name))
    assert (result.views, result.skipped) == (6, 0)
    assert len(factory.made) == {0: 1, 1: 3, 2: 2}[views]
    for row in range(len(result.poses)):  # The fake answers with the mask's centroid.
        scene, image = int(result.poses.scene[row]), int(result.poses.image[row])
        view = data[scene // 3].view(image, scene % 3)
        mask = view.masks[view.instance_ids.tolist().index(result.poses.instance[row])]
        rows, columns = np.nonzero(mask)
        np.testing.assert_allclose(result.poses.translation[row, :2], (columns.mean(), rows.mean()), rtol=1e-6)


def test_the_time_is_one_for_all_rows_of_an_image(data):
    poses = run(data, Options(SINGLE), Factory()).poses
    for scene, image in set(zip(poses.scene.tolist(), poses.image.tolist(), strict=True)):
        rows = (poses.scene == scene) & (poses.image == image)
        assert len(set(poses.seconds[rows])) == 1


@pytest.mark.parametrize("method", [REFINE, GICP])
def test_refinement_starts_from_the_disturbed_truth(data, method):
    result = run(data, Options(method, seed=4), Factory())
    truth = true_rows(data)
    matrices = np.tile(np.eye(4), (len(truth), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = truth.rotation, truth.translation
    for row in range(len(truth)):
        own = np.flatnonzero(
            (result.poses.scene == truth.scene[row])
            & (result.poses.image == truth.image[row])
            & (result.poses.instance == truth.instance[row])
        )
        expected = disturb_poses(matrices[[row]], truth.instance[[row]], 4, int(truth.scene[row]), int(truth.image[row]))[0]
        np.testing.assert_allclose(result.poses.translation[own[0]], expected[:3, 3], atol=1e-6)
        np.testing.assert_allclose(result.poses.rotation[own[0]], expected[:3, :3], atol=1e-6)


def test_tracks_start_at_the_truth_once_and_never_again(data):
    """The fake drifts by a metre a frame from the start on, which makes the frames countable."""
    factory = Factory(step=1.0)
    result = run(data, Options(TRACK), factory, PLANS[:1])
    truth = true_rows(data, PLANS[:1])
    first = {int(instance): truth.translation[truth.instance == instance][0] for instance in set(truth.instance)}
    for row in range(len(result.poses)):
        image = int(result.poses.image[row])
        drift = result.poses.translation[row] - first[int(result.poses.instance[row])]
        # In the first frame the truth is written, though the estimator has moved on.
        np.testing.assert_allclose(drift, (image + 1.0 if image else 0.0, 0.0, 0.0), atol=1e-5)
        assert result.poses.score[row] == (0.5 if image else 1.0)
    assert [rows.tolist() for rows in factory.made[0].started] == [[True, True, True]]
    assert len(factory.made[0].labels) == 3


def test_tracks_start_where_an_instance_is_visible_enough(data):
    scene = read_scene(data, PLANS[0])
    visibility = np.array([[1.0, 0.05, 0.0], [0.0, 0.1, 0.0], [0.3, 0.0, 0.0]])
    index = np.array([[0, 1, ABSENT], [ABSENT, 1, 0], [0, 1, 2]])
    scene = replace(scene, visibility=visibility, index=index)
    tracked = ask(scene, TRACK, 0.1, [None] * 3)
    assert tracked.asked.tolist() == [[True, False, False], [False, True, False], [True, True, False]]
    group = make_group([tracked], OBJECTS)
    assert group.table.slot.tolist() == [0, 1]
    assert group.table.model.tolist() == [0, 1]
    assert [group.truth(step).starting.tolist() for step in range(4)] == [[True, False], [False, True], [False, False], [False, False]]
    single = ask(scene, SINGLE, 0.1, [None, frozenset({3}), frozenset({3})])
    assert single.asked.tolist() == [[True, False, False], [False, False, False], [True, False, False]]


def test_estimates_that_are_not_finite_are_left_out_and_counted(data):
    class Broken(FakeEstimator):
        def estimate(self, batch):
            answer = super().estimate(batch)
            answer.pose[0, 3:], answer.pose[1, 1], answer.score[2] = 0.0, np.nan, np.inf
            return answer

    result = run_estimation(
        read_scenes(data, PLANS[:1], Options(SINGLE)), OBJECTS, lambda table, height, width: Broken(table), Options(SINGLE)
    )
    assert (len(result.poses), result.skipped) == (0, 9)


def test_targets_count_what_is_asked(data):
    scenes = read_scenes(data, PLANS[1:2], Options(SINGLE, min_visibility=0.6))
    found = {(target.scene_id, target.im_id, target.obj_id): target.inst_count for target in list_targets(scenes)}
    assert found == {(7, 0, 3): 1, (7, 0, 7): 1, (7, 2, 3): 1, (7, 2, 7): 1}
    with pytest.raises(DatasetError, match="as visible as --visib-min 1 in these images"):
        read_scenes(data, [ScenePlan(7, 2, 1, (2,))], Options(SINGLE, min_visibility=1.0))


def test_the_number_of_views_at_a_time(data):
    scenes = read_scenes(data, PLANS, Options(SINGLE)) * 100
    size = (1 + AHEAD) * BYTES_PER_PIXEL * 72 * 96
    assert count_views(scenes, 5) == 5
    assert count_views(scenes[:2], 5) == 2
    assert count_views(scenes, 0, free=1 << 50) == MAX_VIEWS
    assert count_views(scenes, 0, free=4 * 9 * size) == 9
    assert count_views(scenes, 0, free=0) == 1


def test_the_noise_of_the_sensor(data):
    """Boxes lie about 1.5 m away, at a focal length of 288 px."""
    scenes = read_scenes(data, PLANS, Options(SINGLE))
    quiet = DepthSensor(noise=0.0, noise_growth=0.0, disparity_step=0.1, baseline=0.1)
    depth = np.median(np.concatenate([scene.poses[..., 2, 3][scene.asked] for scene in scenes]))
    assert 1.4 < depth < 1.6
    assert sensor_noise(quiet, scenes) == pytest.approx(0.1 * depth**2 / (288 * 0.1) / 12**0.5, rel=1e-6)
    fine = DepthSensor(noise=0.001, noise_growth=0.002, noise_distance=0.4, disparity_step=1e-9)
    assert sensor_noise(fine, scenes) == pytest.approx(0.001 + 0.002 * (depth - 0.4) ** 2, rel=1e-6)


def test_transforms():
    rotations = Rotation.random(5, rng=np.random.default_rng(0)).as_matrix()
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, np.arange(15).reshape(5, 3)
    transforms = to_transforms(poses)
    np.testing.assert_allclose(to_rotations(transforms), rotations, atol=1e-6)
    np.testing.assert_array_equal(transforms[:, :3], np.arange(15).reshape(5, 3))
    assert to_rotations(to_transforms(np.empty((0, 4, 4)))).shape == (0, 3, 3)
