"""The pose estimator as a whole: its three methods on a fixed small data set, repeatability, and instances that are not seen."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation.auc import exact_auc
from synpick_warp.apps.evaluation.errors import add_errors, adds_errors
from synpick_warp.stages.pose.batch import Estimates, InstanceTable
from synpick_warp.stages.pose.estimator import EstimatorModels, PoseEstimator, PoseSettings, adapt_schedule
from synpick_warp.stages.pose.refine import Schedule
from synpick_warp.system.hardware.device import pick_device
from tests.worlds.pose_scenes import SET_INSTANCES, Scene, fixed_set, select, without
from tests.worlds.pose_views import disturbed, pose_errors

EVERY = 2
"""Of the frames every second is estimated alone and refined."""
TOLERANCE = 0.5
"""Allowed difference of scores [points]: on a GPU rounding differs."""
SCORES = {"single": (97.53, 99.76), "refine": (98.25, 99.66), "track": (99.75, 99.79)}
"""AUC of ADD and ADD-S [points], measured on the CPU. A change of estimators or pictures that is meant stores them anew; those below 99 in
ADD are turns that shape cannot tell: cartons from one side, and tins that were disturbed about their axis."""


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The first frames of the fixed set, rendered on the CPU, so that all devices get the same images."""
    return fixed_set(pick_device("cpu"), frames=3)


@pytest.fixture(scope="module")
def shared(device, scene) -> EstimatorModels:
    return EstimatorModels(scene.objects, PoseSettings(), device)


@pytest.fixture(scope="module")
def estimator(scene, shared) -> PoseEstimator:
    return PoseEstimator(shared, scene.table, *scene.frames[0].label.shape[1:])


@pytest.fixture(scope="module")
def whole(scene, estimator) -> Estimates:
    """What is found in the first frame without a start."""
    return estimator.estimate(scene.frames[0])


def start_of(scene: Scene, frame: int) -> np.ndarray:
    """Disturbed truth, by 2 cm and 15°."""
    return disturbed(scene.pose[frame], np.random.default_rng(frame))


def run(method: str, scene: Scene, estimator: PoseEstimator) -> dict[int, Estimates]:
    """Estimates by frame."""
    if method == "track":
        estimator.start(scene.pose[0], np.ones(len(scene.table), bool))
        return {frame: estimator.track(batch) for frame, batch in enumerate(scene.frames)}
    frames = range(0, len(scene.frames), EVERY)
    if method == "single":
        return {frame: estimator.estimate(scene.frames[frame]) for frame in frames}
    return {frame: estimator.refine(scene.frames[frame], start_of(scene, frame)) for frame in frames}


def scores(scene: Scene, found: dict[int, Estimates]) -> tuple[float, float]:
    """AUC of ADD and ADD-S over all instances and frames, in points."""
    errors: tuple[list[np.ndarray], list[np.ndarray]] = [], []
    estimated, true = np.stack([found[frame].pose for frame in found]), scene.pose[list(found)]
    for model, item in enumerate(scene.objects):
        rows = scene.table.model == model
        pair = []
        for poses in (estimated, true):
            flat = poses[:, rows].reshape(-1, 7)
            pair += [Rotation.from_quat(flat[:, 3:]).as_matrix(), flat[:, :3].astype(np.float64)]
        # A thousand vertices stand for all, as in `eval --vertices 1000`.
        vertices = item.mesh.vertices.astype(np.float64)[:: max(len(item.mesh.vertices) // 1000, 1)]
        errors[0].append(add_errors(*pair, vertices))
        errors[1].append(adds_errors(*pair, vertices))
    return tuple(100.0 * exact_auc(np.concatenate(values)) for values in errors)


@pytest.mark.parametrize("method", SCORES)
@pytest.mark.slow
def test_scores_are_those_of_the_first_day(estimator, method):
    """The fixed set: two scenes of six instances, eight frames; clutter, cut-off objects, cans and cartons."""
    scene = fixed_set(pick_device("cpu"))
    found = run(method, scene, estimator)
    assert all(estimates.valid.all() for estimates in found.values())
    assert scores(scene, found) == pytest.approx(SCORES[method], abs=TOLERANCE)


@pytest.mark.parametrize("method", SCORES)
def test_two_runs_agree_to_the_bit(scene, shared, estimator, whole, method):
    """Also on a GPU: all sums are formed in a fixed order."""
    other = PoseEstimator(shared, scene.table, *scene.frames[0].label.shape[1:])
    count = 1 if method == "single" else 3
    short = Scene(scene.objects, scene.frames[:count], scene.table, scene.pose[:count])
    first, second = {0: whole} if method == "single" else run(method, short, estimator), run(method, short, other)
    for frame in first:
        for name in ("pose", "score", "valid"):
            assert np.array_equal(getattr(first[frame], name), getattr(second[frame], name)), (frame, name)


@pytest.mark.parametrize("method", ["single", "refine"])
def test_estimates_do_not_depend_on_the_rest_of_the_batch(scene, shared, estimator, whole, method):
    """The second view with two of its instances, in another order, alone: the same bits."""
    rows = np.array([SET_INSTANCES + 3, SET_INSTANCES + 1])
    table = InstanceTable(np.zeros(2, np.int32), scene.table.slot[rows], scene.table.model[rows])
    alone = PoseEstimator(shared, table, *scene.frames[0].label.shape[1:])
    view = select(scene.frames[0], [1])
    if method == "single":
        all_rows, some = whole, alone.estimate(view)
    else:
        start = start_of(scene, 0)
        all_rows, some = estimator.refine(scene.frames[0], start), alone.refine(view, start[rows])
    assert np.array_equal(some.pose, all_rows.pose[rows])
    assert np.array_equal(some.score, all_rows.score[rows])


def test_what_is_not_seen_has_no_estimate(scene, estimator):
    batch = without(scene.frames[0], 2)
    gone = scene.table.slot == 2
    for found in (estimator.estimate(batch), estimator.refine(batch, scene.pose[0])):
        assert np.array_equal(found.valid, ~gone)
        assert np.isfinite(found.pose).all()
        assert found.score[gone].max() < 1e-6
        assert (found.score[~gone] > 0.1).all()
    assert np.array_equal(estimator.refine(batch, scene.pose[0]).pose[gone], scene.pose[0][gone])


def test_results_are_poses(scene, estimator):
    found = estimator.refine(scene.frames[0], start_of(scene, 0))
    assert found.pose.shape == (len(scene.table), 7)
    assert found.pose.dtype == np.float32
    assert np.linalg.norm(found.pose[:, 3:], axis=1) == pytest.approx(np.ones(len(scene.table)), abs=1e-5)
    assert (found.seconds > 0.0).all()
    assert ((found.score > 0.0) & (found.score <= 1.0)).all()


def test_refinement_of_noisy_depth_stays_near(scene, device):
    """Depth with a noise of 5 mm: with its standard deviation known, a refinement from the truth stays near."""
    random = np.random.default_rng(0)
    batch = scene.frames[0]
    noise = np.rint(random.normal(0.0, 0.005 / 1e-4, batch.depth.shape))
    noisy = type(batch)(**(vars(batch) | {"depth": (batch.depth + noise).clip(1).astype(np.uint16)}))
    known = EstimatorModels(scene.objects, PoseSettings(depth_noise=0.005), device)
    found = PoseEstimator(known, scene.table, *batch.label.shape[1:]).refine(noisy, scene.pose[0])
    assert pose_errors(found.pose, scene.pose[0])[0].max() < 0.01
    assert np.median(pose_errors(found.pose, scene.pose[0])[0]) < 0.003


def test_schedules_are_adapted_to_the_settings():
    schedule = Schedule(iterations=4, cutoffs=(0.03, 0.005), step=1, color=0.005)
    assert adapt_schedule(schedule, PoseSettings()) == schedule
    assert adapt_schedule(schedule, PoseSettings(color=False)).color == 0.0
    assert adapt_schedule(schedule, PoseSettings(depth_noise=0.004)).cutoffs == pytest.approx((0.03, 0.011))
    assert adapt_schedule(schedule, PoseSettings(depth_noise=1.0)).cutoffs == (0.03, 0.03)
