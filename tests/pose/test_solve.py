"""Gauss-Newton steps: solver, exponential map, limits, prior, costs."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from synpick_warp.kernels.pose import residuals, solve
from synpick_warp.kernels.pose.residuals import LANES
from synpick_warp.kernels.pose.solve import UNSEEN, score_poses_kernel
from synpick_warp.stages.pose.models import build_models
from synpick_warp.stages.pose.refine import LossScales, make_loss
from tests.harness.pose_probe import Normals, step_limits
from tests.harness.probe import probe
from tests.twins import pose as twin
from tests.worlds.pose_views import drawn, model_of, observe, pose_errors, pose_of, table_of
from tests.worlds.toy_scene import box

RADIUS = 0.1


@wp.func
def step_there_and_back(pose: wp.transform, step: wp.spatial_vector, radius: float):
    """Stepped pose, its difference from the old one, and the logarithm of its rotation."""
    moved = solve.apply_step(pose, step, radius)
    return moved, solve.pose_difference(moved, pose, radius), solve.rotation_vector(wp.transform_get_rotation(moved))


step_and_back, cholesky = probe(step_there_and_back), probe(solve.solve_cholesky)
jacobian, tukey = probe(residuals.jacobian), probe(residuals.tukey_weight)


def random_poses(seed: int, count: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    place = random.uniform((-0.3, -0.3, 0.5), (0.3, 0.3, 2.0), (count, 3))
    return np.concatenate([place, Rotation.random(count, rng=random).as_quat()], axis=1).astype(np.float32)


@given(seed=st.integers(0, 2**32 - 1))
def test_cholesky_solves_positive_definite_systems(device, seed):
    random = np.random.default_rng(seed)
    factor = random.normal(size=(4, 6, 9))
    matrix = factor @ factor.transpose(0, 2, 1) + 0.1 * np.eye(6)
    right = random.normal(size=(4, 6))
    expected = np.linalg.solve(matrix, right[..., None])[..., 0]
    assert cholesky(matrix, right, device=device) == pytest.approx(expected, rel=2e-3, abs=2e-3 * np.abs(expected).max())


def test_an_unknown_that_nothing_determines_stays_zero(device):
    matrix = np.diag([2.0, 1.0, 0.0, 4.0, 0.5, 1.0])
    right = np.array([2.0, 1.0, 0.0, 2.0, 0.5, 3.0])
    assert cholesky(matrix, right, device=device) == pytest.approx([1.0, 1.0, 0.0, 0.5, 1.0, 3.0])


@given(seed=st.integers(0, 2**32 - 1), size=st.sampled_from([0.0, 1e-5, 1e-3, 0.05, 0.3]))
def test_a_step_and_the_difference_of_poses_are_inverse(device, seed, size):
    """Up to half a turn: steps of at most 3 rad."""
    random = np.random.default_rng(seed)
    pose, step = random_poses(seed, 8), random.normal(size=(8, 6))
    step *= size / np.linalg.norm(step[:, :3], axis=1, keepdims=True)
    moved, back, _ = step_and_back(pose, step, RADIUS, device=device)
    assert back == pytest.approx(step, abs=2e-6)
    for row in range(8):
        rotation, translation = twin.stepped(pose[row], step[row], RADIUS)
        assert moved[row, :3] == pytest.approx(translation, abs=1e-6)
        assert (Rotation.from_quat(moved[row, 3:]) * rotation.inv()).magnitude() < 1e-5
        assert np.linalg.norm(moved[row, 3:]) == pytest.approx(1.0, abs=1e-6)


def test_logarithm_of_rotations(device):
    pose = random_poses(3, 64)
    pose[0, 3:], pose[1, 3:], pose[2, 3:] = (0, 0, 0, 1), (0, 0, 0, -1), (0, 1, 0, 0)
    _, _, log = step_and_back(pose, np.zeros((64, 6)), RADIUS, device=device)
    assert log[:3].tolist() == pytest.approx(np.array([[0, 0, 0], [0, 0, 0], [0, np.pi, 0]]))
    assert log[3:] == pytest.approx(Rotation.from_quat(pose[3:, 3:]).as_rotvec(), abs=1e-5)


def test_a_step_moves_points_as_linearized(device):
    """p + w x (p - c) / ρ + v to first order: the rest is quadratic in the step."""
    random = np.random.default_rng(5)
    pose, step = random_poses(5, 16), random.normal(size=(16, 6)) * 1e-3
    moved, _, _ = step_and_back(pose, step, RADIUS, device=device)
    point = random.uniform(-RADIUS, RADIUS, (16, 3))
    before, after = (Rotation.from_quat(p[:, 3:]).apply(point) + p[:, :3] for p in (pose, moved))
    linear = np.cross(step[:, :3], before - pose[:, :3]) / RADIUS + step[:, 3:]
    rest = 0.5 * (np.linalg.norm(step[:, :3], axis=1) / RADIUS) ** 2 * np.linalg.norm(point, axis=1)
    assert (np.linalg.norm(after - before - linear, axis=1) < rest + 1e-6).all()
    direction = random.normal(size=(16, 3))
    line, weight = jacobian(before, (0.1, 0.2, 0.3), direction, RADIUS, device=device), tukey(before[:, 0], 0.2, device=device)
    along = np.cross(step[:, :3], before - (0.1, 0.2, 0.3)) / RADIUS + step[:, 3:]
    assert np.einsum("nk,nk->n", line, step) == pytest.approx(np.einsum("nk,nk->n", along, direction), abs=1e-7)
    inside = np.maximum(1.0 - (before[:, 0] / 0.2) ** 2, 0.0)
    assert weight == pytest.approx(inside**2, abs=1e-6)


class Scene:
    """Three instances of one box, of which the first two are seen; sums are set by hand."""

    def __init__(self, device) -> None:
        label = np.zeros((40, 80), np.uint8)
        label[5:35, 5:35], label[5:35, 45:75] = 1, 2
        table = table_of((0, 0, 0), (0, 1, 0), (0, 2, 0))
        self.observer = observe(drawn(label, np.full(label.shape, 0.5), 100.0), table, device)
        self.normals = Normals(build_models([model_of(box(0.12, 0.1, 0.08))], device, samples=32), self.observer)
        self.pose = random_poses(1, 3)
        self.radius = float(self.normals.models.models.radius.numpy()[0])
        self.area = float(self.observer.observation.area.numpy()[0] * self.observer.observation.points.numpy()[0])

    def put(self, hessian: np.ndarray, gradient: np.ndarray) -> None:
        """Spread sums for all instances over the lanes."""
        lanes = int(LANES)
        self.normals.sums.hessian.assign(np.tile(hessian / lanes, (3, lanes, 1, 1)).astype(np.float32))
        self.normals.sums.gradient.assign(np.tile(gradient / lanes, (3, lanes, 1)).astype(np.float32))


@pytest.fixture
def scene(device) -> Scene:
    return Scene(device)


def test_one_step_of_all_instances_that_are_seen(scene):
    step = np.array([0.002, -0.001, 0.003, 0.004, 0.005, -0.006])
    scene.put(scene.area * np.eye(6), scene.area * step)
    moved = scene.normals.step(scene.pose, step_limits())
    for row in (0, 1):
        rotation, translation = twin.stepped(scene.pose[row], step, scene.radius)
        assert moved[row, :3] == pytest.approx(translation, abs=1e-6)
        assert (Rotation.from_quat(moved[row, 3:]) * rotation.inv()).magnitude() < 1e-5
    assert np.array_equal(moved[2], scene.pose[2])


@pytest.mark.parametrize(
    ("step", "shift", "turn"), [((0, 0, 0, 1, 0, 0), 0.02, 0.0), ((0, 1, 0, 0, 0, 0), 0.0, 0.25), ((5, 0, 0, 0.1, 0, 0), None, 0.25)]
)
def test_steps_are_limited_in_their_direction(scene, step, shift, turn):
    step = np.array(step, np.float64)
    scene.put(scene.area * np.eye(6), scene.area * step)
    moved = scene.normals.step(scene.pose, step_limits())
    away = np.linalg.norm(moved[0, :3] - scene.pose[0, :3])
    angle = (Rotation.from_quat(moved[0, 3:]) * Rotation.from_quat(scene.pose[0, 3:]).inv()).magnitude()
    assert angle == pytest.approx(turn, abs=1e-4)
    # Both parts shrink by one factor.
    expected = shift if shift is not None else 0.1 * turn * scene.radius / 5.0
    assert away == pytest.approx(expected, rel=1e-3, abs=1e-6)


def test_the_prior_pulls_to_the_prior(scene):
    prior = scene.pose.copy()
    prior[:, :3] += (0.01, 0.0, 0.005)
    prior[:, 3:] = (Rotation.from_rotvec([0.0, 0.1, 0.0]) * Rotation.from_quat(prior[:, 3:])).as_quat()
    scene.put(np.zeros((6, 6)), np.zeros(6))
    # Without residuals at once; with some, in proportion to the weights.
    moved = scene.normals.step(scene.pose, step_limits(prior=1.0, damping=0.0), prior)
    distance, angle = pose_errors(moved[:2], prior[:2])
    assert distance.max() < 1e-6
    assert angle.max() < 1e-3
    scene.put(scene.area * np.eye(6), np.zeros(6))
    moved = scene.normals.step(scene.pose, step_limits(prior=0.25, damping=0.0), prior)
    assert moved[0, :3] - scene.pose[0, :3] == pytest.approx(0.2 * np.array([0.01, 0.0, 0.005]), abs=1e-6)
    angle = (Rotation.from_quat(moved[0, 3:]) * Rotation.from_quat(scene.pose[0, 3:]).inv()).magnitude()
    assert angle == pytest.approx(0.02, abs=1e-5)
    assert np.array_equal(moved[2], scene.pose[2])


def score(scene: Scene, device, points: tuple[float, float], samples: tuple[float, ...], color: float) -> np.ndarray:
    """Costs of two hypotheses per instance with equal sums, spread over the lanes."""
    lanes = int(LANES)
    sums = scene.normals.sums.__class__()
    for name, values in (("points", points), ("samples", samples)):
        kind = wp.vec2 if name == "points" else wp.vec4
        setattr(sums, name, wp.array(np.tile(np.array(values) / lanes, (6, lanes, 1)), dtype=kind, device=device))
    sums.hessian, sums.gradient = scene.normals.sums.hessian, scene.normals.sums.gradient
    out = wp.zeros(6, dtype=float, device=device)
    loss = make_loss(LossScales(color_cost=0.3), 0.01, 1, color)
    wp.launch(score_poses_kernel, dim=6, inputs=[loss, scene.observer.observation, sums, 2], outputs=[out], device=device)
    return out.numpy()


def test_costs_are_shares_of_the_observed_area(scene, device):
    unseen = [float(UNSEEN)] * 2
    assert score(scene, device, (0.5, 2.0), (0.3, 1.0, 0.0, 0.0), 0.0) == pytest.approx([0.4] * 4 + unseen)
    # A quarter of the colours do not fit; too few colours count as if none did.
    assert score(scene, device, (0.5, 2.0), (0.3, 1.0, 0.2, 0.8), 1.0) == pytest.approx([0.4 + 0.3 * 0.25] * 4 + unseen)
    assert score(scene, device, (0.5, 2.0), (0.3, 1.0, 0.0, 0.04), 1.0) == pytest.approx([0.4 + 0.3] * 4 + unseen)


def test_a_pose_is_refined_where_it_is(scene):
    """No gradient, no motion."""
    scene.put(scene.area * np.eye(6), np.zeros(6))
    still = pose_of((0.0, 0.0, 0.5), Rotation.identity())
    moved = scene.normals.step(np.tile(still, (3, 1)), step_limits())
    assert moved == pytest.approx(np.tile(still, (3, 1)), abs=1e-7)
