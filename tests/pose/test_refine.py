"""Refinement of disturbed poses, and costs of poses."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.stages.pose.models import build_models
from synpick_warp.stages.pose.refine import LossScales, Refiner, Schedule, make_loss
from tests.twins.raycast import cast_mesh
from tests.worlds.pose_views import (
    disturbed,
    drawn,
    embedded,
    joined,
    observe,
    pose_errors,
    pose_of,
    table_of,
)
from tests.worlds.toy_scene import camera

IDS = (10, 12, 15, 19)
"""Objects that no turn keeps in place: banana, bottle, drill, clamp."""
FOCAL, SHAPE = 330.0, (180, 240)
SHAPE_ONLY = Schedule(iterations=16, cutoffs=(0.03, 0.006), step=1, color=0.0)


@pytest.fixture(scope="module")
def scene(device):
    """Models, observer and true poses: each object alone in a view, cast in float64 before a wall."""
    random, lens = np.random.default_rng(2), camera(SHAPE[1], SHAPE[0], FOCAL, (0.0, 0.0, 0.0), np.eye(3))
    batches, poses = [], []
    for item in embedded(*IDS):
        pose = pose_of(tuple(random.uniform((-0.06, -0.03, 0.6), (0.06, 0.03, 0.7))), Rotation.random(rng=random))
        depth = cast_mesh(item.mesh, pose, lens)
        batches.append(drawn(np.isfinite(depth), np.where(np.isfinite(depth), depth, 1.0), FOCAL))
        poses.append(pose)
    table = table_of(*((row, 0, row) for row in range(len(IDS))))
    return build_models(embedded(*IDS), device), observe(joined(*batches), table, device), np.stack(poses)


def refined(scene, start: np.ndarray, schedule: Schedule = SHAPE_ONLY, hypotheses: int = 1) -> np.ndarray:
    models, observer, _ = scene
    poses = wp.array(start, dtype=wp.transform, device=observer.device)
    Refiner(models, observer, hypotheses, LossScales()).refine(poses, schedule)
    return poses.numpy()


@pytest.mark.parametrize("seed", range(6))
def test_disturbed_poses_come_back(scene, seed):
    """From 2 cm and 15° to 2 mm and 2°, by shape and silhouette alone."""
    _, _, truth = scene
    distance, angle = pose_errors(refined(scene, disturbed(truth, np.random.default_rng(seed))), truth)
    assert distance.max() < 0.002
    assert angle.max() < 2.0


def test_the_truth_stays(scene):
    _, _, truth = scene
    distance, angle = pose_errors(refined(scene, truth), truth)
    assert distance.max() < 2e-4
    assert angle.max() < 0.2


def test_hypotheses_are_refined_as_if_alone(scene):
    """To the bit, whatever their neighbours are."""
    _, _, truth = scene
    start = [disturbed(truth, np.random.default_rng(seed)) for seed in (11, 12)]
    together = refined(scene, np.stack(start, axis=1).reshape(-1, 7), hypotheses=2).reshape(-1, 2, 7)
    for row, poses in enumerate(start):
        assert np.array_equal(together[:, row], refined(scene, poses))


def test_a_strong_prior_holds(scene):
    _, _, truth = scene
    start = disturbed(truth, np.random.default_rng(5), 0.01, 5.0)
    free, held = (refined(scene, start, Schedule(16, (0.03, 0.006), 1, 0.0, prior)) for prior in (0.0, 1e3))
    assert pose_errors(free, truth)[0].max() < 0.002
    assert pose_errors(held, start)[0].max() < 1e-4


@pytest.mark.parametrize("color", [False, True])
def test_the_truth_costs_least(scene, color):
    models, observer, truth = scene
    refiner = Refiner(models, observer, 1, LossScales())

    def cost(poses: np.ndarray) -> np.ndarray:
        return refiner.score(wp.array(poses, dtype=wp.transform, device=observer.device), color=color).numpy().copy()

    best = cost(truth)
    assert best.max() < 0.05 + 0.3 * color
    for seed in range(3):
        assert (cost(disturbed(truth, np.random.default_rng(seed), 0.005, 4.0)) > best + 0.02).all()


def test_costs_take_the_scales_over():
    loss = make_loss(LossScales(truncation=0.02, margin=0.003, silhouette=0.25, color_cutoff=0.6, color_cost=0.1), 0.04, 3, 0.005)
    values = [loss.truncation, loss.margin, loss.silhouette, loss.color_cutoff, loss.color_cost, loss.cutoff, loss.color]
    assert values == pytest.approx([0.02, 0.003, 0.25, 0.6, 0.1, 0.04, 0.005])
    assert loss.step == 3
