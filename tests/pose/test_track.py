"""Tracking along known paths, through occlusion and absence."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation.errors import add_errors
from synpick_warp.stages.pose.estimator import EstimatorModels, PoseEstimator, PoseSettings
from tests.worlds.pose_scenes import DRILL, MOVING, MUG, TIN, Scene, moving_scene, without
from tests.worlds.pose_views import pose_errors

EVERY = np.ones(3, bool)


@pytest.fixture(scope="module")
def scene(device) -> Scene:
    return moving_scene(device)


@pytest.fixture(scope="module")
def shared(device, scene) -> EstimatorModels:
    return EstimatorModels(scene.objects, PoseSettings(), device)


@pytest.fixture
def tracker(scene, shared) -> PoseEstimator:
    """Estimator that starts with the truth in the next frame."""
    height, width = scene.frames[0].label.shape[1:]
    estimator = PoseEstimator(shared, scene.table, height, width)
    estimator.start(scene.pose[0], EVERY)
    return estimator


def distances(scene: Scene, estimated: np.ndarray, frame: int) -> np.ndarray:
    """ADD of each instance [m]."""
    return np.array(
        [
            add_errors(
                *(part for pose in (estimated[[row]], scene.pose[frame][[row]]) for part in _split(pose)),
                scene.objects[scene.table.model[row]].mesh.vertices.astype(np.float64),
            )[0]
            for row in range(len(scene.table))
        ]
    )


def _split(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return Rotation.from_quat(pose[:, 3:]).as_matrix(), pose[:, :3].astype(np.float64)


def test_tracks_stay_within_3_mm(scene, tracker):
    """A drill that flies and tumbles, a mug that a card nearly covers, and a tin's turn that depth cannot see."""
    covered = [(batch.label == MUG + 1).sum() for batch in scene.frames]
    assert min(covered) < 0.25 * covered[0]
    for frame, batch in enumerate(scene.frames):
        found = tracker.track(batch)
        assert found.valid.all()
        assert distances(scene, found.pose, frame).max() < 0.003, frame
    assert pose_errors(found.pose, scene.pose[-1])[1][TIN] < 2.0
    # The tin has turned far, and the drill has moved.
    assert pose_errors(scene.pose[0], scene.pose[-1])[1][TIN] > 30.0
    assert pose_errors(scene.pose[0], scene.pose[-1])[0][DRILL] > 0.05


def test_the_first_frame_is_the_truth(scene, tracker):
    found = tracker.track(scene.frames[0])
    assert np.array_equal(found.pose, scene.pose[0])
    assert found.valid.all()
    # Its score is that of the truth, not of what was there before.
    assert found.score.min() > 0.7


def test_without_colour_the_turn_of_the_tin_is_not_seen(device, scene):
    """Its shape is followed nevertheless, and so are the other objects."""
    height, width = scene.frames[0].label.shape[1:]
    estimator = PoseEstimator(EstimatorModels(scene.objects, PoseSettings(color=False), device), scene.table, height, width)
    estimator.start(scene.pose[0], EVERY)
    for batch in scene.frames:
        found = estimator.track(batch)
    distance, angle = pose_errors(found.pose, scene.pose[-1])
    assert distance[TIN] < 0.003
    assert angle[TIN] > 20.0
    assert distances(scene, found.pose, MOVING - 1)[[MUG, DRILL]].max() < 0.003


def test_an_instance_that_vanishes_holds_its_pose_and_comes_back(scene, tracker):
    """The drill's mask is missing in three frames, in which it goes on by 18 mm and 12°."""
    away = range(5, 8)
    for frame, batch in enumerate(scene.frames):
        found = tracker.track(without(batch, DRILL) if frame in away else batch)
        assert found.valid.tolist() == [True, True, frame not in away]
        if frame == away[0] - 1:
            held = found.pose[DRILL].copy()
        if frame in away:
            assert np.array_equal(found.pose[DRILL], held)
        if frame > away[-1] + 1:
            assert distances(scene, found.pose, frame)[DRILL] < 0.003, frame


def test_a_track_waits_for_its_start(scene, shared):
    """Rows start in different frames; before, they have no estimate, and the others go on as if alone."""
    height, width = scene.frames[0].label.shape[1:]
    late = PoseEstimator(shared, scene.table, height, width)
    late.start(scene.pose[0], np.array([True, False, False]))
    for frame in range(4):
        if frame == 2:
            late.start(scene.pose[2], np.array([False, True, False]))
        found = late.track(scene.frames[frame])
        assert found.valid.tolist() == [True, frame >= 2, False]
        assert np.isfinite(found.pose).all()
        assert np.isfinite(found.score).all()
        if frame == 2:
            assert np.array_equal(found.pose[1], scene.pose[2][1])
    assert distances(scene, found.pose, 3)[:2].max() < 0.003


def test_tracks_do_not_depend_on_their_neighbours(scene, shared, tracker):
    """The same bits, as every thread forms its own sums in a fixed order."""
    height, width = scene.frames[0].label.shape[1:]
    alone = []
    for row in range(3):
        table = type(scene.table)(*(getattr(scene.table, name)[[row]] for name in ("view", "slot", "model")))
        alone.append(PoseEstimator(shared, table, height, width))
        alone[row].start(scene.pose[0][[row]], EVERY[:1])
    for batch in scene.frames[:6]:
        together = tracker.track(batch)
        for row in range(3):
            single = alone[row].track(batch)
            assert np.array_equal(single.pose[0], together.pose[row])
            assert single.score[0] == together.score[row]


def test_a_big_turn_is_found_by_its_colours(device, scene, shared):
    """The tin is suddenly turned by 60° about its axis."""
    height, width = scene.frames[0].label.shape[1:]
    estimator = PoseEstimator(shared, scene.table, height, width)
    start = scene.pose[0].copy()
    turned = start.copy()
    turned[TIN, 3:] = (Rotation.from_quat(start[TIN, 3:]) * Rotation.from_euler("z", 60.0, degrees=True)).as_quat()
    # The estimator is told the truth, remembers how well colours fit, and then is set aside.
    estimator.start(start, EVERY)
    for _ in range(3):
        estimator.track(scene.frames[0])
    pose = estimator._tracker.track_state.pose
    pose.assign(wp.array(turned, dtype=wp.transform, device=device))
    for _ in range(3):
        found = estimator.track(scene.frames[0])
    assert pose_errors(found.pose, start)[1][TIN] < 2.0
