"""Surface residuals: distances from observed points to meshes, and their derivatives."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.stages.pose.models import build_models
from synpick_warp.stages.pose.refine import LossScales, Refiner, make_loss
from tests.harness.pose_probe import Normals, step_limits
from tests.twins import pose as twin
from tests.worlds.pose_views import drawn, model_of, observe, pose_of, table_of
from tests.worlds.toy_scene import ball, box

MESHES = {"ball": ball(0.06, 2), "box": box(0.12, 0.08, 0.05)}
POSE = pose_of((0.02, -0.01, 0.6), Rotation.from_rotvec([0.6, -0.7, 0.3]))
EYE = Rotation.from_quat(POSE[3:]).inv().apply(-POSE[:3])
"""The camera in the object's axes."""
SEEN = np.sign(EYE)
"""Signs of the sides of a box that the camera sees."""
FAR = 10.0
"""Cutoff and truncation beyond all distances [m]: Tukey's weights are then 1 to within 1e-4."""


class Points:
    """An instance of a mesh whose observed points are set by hand; one point stands for `area`."""

    area = 2e-5

    def __init__(self, device, mesh, capacity: int = 128) -> None:
        label = np.zeros((32, 32), np.uint8)
        label[8:24, 8:24] = 1
        self.observer = observe(drawn(label, np.full(label.shape, 0.6), 60.0), table_of((0, 0, 0)), device, capacity)
        self.normals = Normals(build_models([model_of(mesh)], device, samples=32), self.observer)
        self.radius = float(self.normals.models.models.radius.numpy()[0])

    def put(self, local: np.ndarray, normal: np.ndarray, pose: np.ndarray = POSE) -> np.ndarray:
        """Set points (N, 3) and normals given in the object's axes at a pose; returns the points in the camera's frame."""
        rotation = Rotation.from_quat(pose[3:])
        points = (rotation.apply(local) + pose[:3]).astype(np.float32)
        seen = self.observer.observation
        for array, values in ((seen.point, points), (seen.normal, rotation.apply(normal))):
            padded = np.zeros((1, array.shape[1], 3), np.float32)
            padded[0, : len(values)] = values
            array.assign(padded)
        seen.points.assign(np.array([len(local)], np.int32))
        seen.area.assign(np.array([self.area], np.float32))
        return points.astype(np.float64)

    def sums(self, pose: np.ndarray = POSE, cutoff: float = FAR, truncation: float = FAR, step: int = 1) -> dict[str, np.ndarray]:
        loss = make_loss(LossScales(truncation=truncation), cutoff, step, 0.0)
        return {name: values[0] for name, values in self.normals.from_points(pose, loss).items()}


def around(mesh, count: int, seed: int, spread: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) within `spread` of the side of a mesh that the camera sees, and outward normals of their triangles, in its axes."""
    random = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    shown = np.flatnonzero(np.einsum("fc,fc->f", normal, EYE - corners.mean(axis=1)) > 0.15 * np.linalg.norm(EYE))
    face = shown[random.integers(0, len(shown), count)]
    corners, normal = corners[face], normal[face]
    weights = random.dirichlet((2.0, 2.0, 2.0), count)
    place = np.einsum("nk,nkc->nc", weights, corners)
    return place + normal * random.uniform(-spread / 10.0, spread, (count, 1)), normal


def test_known_distances_from_a_box(device):
    points = Points(device, MESHES["box"])
    local = np.array([(0.0, 0.0, 0.025 + 0.003), (0.06 + 0.004, 0.01, 0.0), (0.06 + 0.003, 0.04 + 0.004, 0.0), (0.0, 0.0, 0.025 + 0.5)])
    normal = SEEN * np.array([(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    local *= SEEN
    for row, price in enumerate([0.3, 0.4, 0.5, 1.0]):
        points.put(local[row : row + 1], normal[row : row + 1])
        found = points.sums(cutoff=0.02, truncation=0.01)
        assert found["points"] == pytest.approx([price * points.area, points.area], rel=1e-3)
    points.put(local, normal)
    assert points.sums(truncation=0.01, cutoff=0.02)["points"] == pytest.approx([2.2 * points.area, 4.0 * points.area], rel=1e-3)


def test_a_point_on_the_mesh_draws_along_its_normal_alone(device):
    points = Points(device, MESHES["box"])
    points.put(SEEN * np.array([(0.0, 0.0, 0.025)]), SEEN * np.array([(0.0, 0.0, 1.0)]))
    found = points.sums()
    axis = Rotation.from_quat(POSE[3:]).apply((0.0, 0.0, 1.0))
    line = np.concatenate([np.zeros(3), axis])
    assert found["gradient"] == pytest.approx(np.zeros(6), abs=1e-11)
    assert found["hessian"] == pytest.approx(points.area * np.outer(line, line), abs=1e-3 * points.area)


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("seed", [1, 2])
def test_the_gradient_is_that_of_the_sum_of_squares(device, name, seed):
    """Central differences of ½ Σ area distance² by brute force in float64; a step moves the mesh."""
    mesh, points = MESHES[name], Points(device, MESHES[name])
    pose = POSE.copy()
    # The surface moves towards the points, so that none ends up behind it.
    pose[:3] += (0.001, -0.002, 0.004)
    seen = points.put(*around(mesh, 60, seed))
    found = points.sums(pose)
    numeric = twin.numeric_gradient(lambda step: twin.surface_energy(pose, step, points.radius, seen, mesh))
    assert found["gradient"] == pytest.approx(-points.area * numeric, rel=5e-3, abs=5e-3 * points.area * np.abs(numeric).max())
    assert np.linalg.eigvalsh(found["hessian"]).min() > -1e-9
    assert found["hessian"] == pytest.approx(found["hessian"].T, abs=1e-12)


def test_steps_along_the_gradient_bring_the_box_back(device):
    points = Points(device, MESHES["box"])
    points.put(*around(MESHES["box"], 128, 3, spread=0.0))
    pose = POSE.copy()
    pose[:3] += (0.006, -0.004, 0.005)
    pose[3:] = (Rotation.from_rotvec([0.1, 0.05, -0.08]) * Rotation.from_quat(pose[3:])).as_quat()
    for _ in range(12):
        points.sums(pose, cutoff=0.05)
        pose = points.normals.step(pose, step_limits())[0]
    assert pose[:3] == pytest.approx(POSE[:3], abs=1e-4)
    assert np.degrees((Rotation.from_quat(pose[3:]) * Rotation.from_quat(POSE[3:]).inv()).magnitude()) < 0.1


THICKNESS = 0.004
FRONT = THICKNESS / 2.0


@pytest.mark.parametrize("depth", [-0.001, 0.001, 0.003, 0.005])
@pytest.mark.parametrize("normal", [1.0, 0.0, -1.0])
def test_points_of_a_thin_wall_are_drawn_to_its_front(device, depth, normal):
    """Whether they lie before it, in its front half, in its back half or behind: the camera cannot see the back.

    The point's own normal decides nothing here: an opposing one only makes the camera's ray the judge.
    """
    points = Points(device, box(0.1, 0.1, THICKNESS))
    local = np.array([(0.01, 0.02, FRONT - depth)]) * SEEN
    points.put(local, normal * SEEN * np.array([(0.0, 0.0, 1.0)]))
    found = points.sums(cutoff=0.02, truncation=0.02)
    assert found["points"] == pytest.approx([abs(depth) / 0.02 * points.area, points.area], rel=2e-3)
    axis = Rotation.from_quat(POSE[3:]).apply(SEEN * (0.0, 0.0, 1.0))
    drawn_by = -depth * points.area * (1.0 - (depth / 0.02) ** 2) ** 2
    assert found["gradient"][3:] == pytest.approx(drawn_by * axis, rel=2e-3, abs=1e-12)


def test_what_the_camera_cannot_see_is_no_match(device):
    """Points behind a thick box, and beside it in its shadow: at full cost, without weight."""
    points = Points(device, MESHES["box"])
    local = np.array([(0.0, 0.0, -0.025 - 0.001), (-0.06 - 0.001, -0.03, -0.02)]) * SEEN
    points.put(local, SEEN * np.array([(0.0, 0.0, -1.0), (-1.0, 0.0, 0.0)]))
    found = points.sums(cutoff=0.01, truncation=0.01)
    assert found["points"] == pytest.approx([2.0 * points.area, 2.0 * points.area])
    assert (found["gradient"] == 0.0).all()
    assert (found["hessian"] == 0.0).all()


def test_outliers_have_no_weight(device):
    points = Points(device, MESHES["box"])
    points.put(SEEN * np.array([(0.0, 0.0, 0.025 + 0.012)]), SEEN * np.array([(0.0, 0.0, 1.0)]))
    assert (points.sums(cutoff=0.01, truncation=0.02)["gradient"] == 0.0).all()
    found = points.sums(cutoff=0.02, truncation=0.02)
    assert np.linalg.norm(found["gradient"][3:]) == pytest.approx(points.area * 0.012 * (1.0 - 0.36) ** 2, rel=1e-3)


def test_every_second_point_counts_twice(device):
    points = Points(device, MESHES["ball"])
    local, normal = around(MESHES["ball"], 128, 4)
    points.put(local, normal)
    half = points.sums(truncation=0.01, step=2)
    points.put(local[::2], normal[::2])
    every = points.sums(truncation=0.01)
    for name in every:
        assert half[name] == pytest.approx(2.0 * every[name], rel=1e-4, abs=1e-6 * np.abs(every[name]).max()), name


def test_hypotheses_are_independent(device):
    """Of two hypotheses of an instance each has the sums that it has alone."""
    points = Points(device, MESHES["box"])
    points.put(*around(MESHES["box"], 100, 5))
    alone = points.sums()
    refined = wp.zeros(2, dtype=wp.transform, device=device)
    other = POSE.copy()
    other[:3] += 0.01
    refined.assign(np.stack([other, POSE]))
    pair = Refiner(points.normals.models, points.observer, 2, LossScales())
    cost = pair.score(refined, color=False).numpy()
    single = Refiner(points.normals.models, points.observer, 1, LossScales())
    assert cost[1] == single.score(points.normals.poses(POSE), color=False).numpy()[0]
    assert cost[0] > cost[1]
    assert alone["points"][1] == pytest.approx(100 * points.area, rel=1e-4)
