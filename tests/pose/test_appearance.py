"""Silhouette and colour residuals: derivatives, and plates that they move back."""

import numpy as np
import pytest

from synpick_warp.stages.pose.models import build_models
from synpick_warp.stages.pose.refine import LossScales, make_loss
from tests.harness.pose_probe import Normals, step_limits, view_samples
from tests.twins import pose as twin
from tests.worlds.pose_views import FACING, as_material, model_of, observe, plate_view, pose_errors, smooth_texture, table_of
from tests.worlds.toy_scene import GREY, sheet

FOCAL, SHAPE, DISTANCE = 600.0, (140, 160), 0.5
POSE = np.array([0.0, 0.0, DISTANCE, *FACING], np.float32)
PIXEL = DISTANCE / FOCAL


def plate_scene(device, size: tuple[float, float], material=None, texture=None, wall=0.3):
    """Observer, normal equations and models of a plate that faces the camera."""
    texture = smooth_texture(3, 64, 64, cells=5) if texture is None else texture
    batch = plate_view(size, DISTANCE, FOCAL, SHAPE, texture, wall)
    observer = observe(batch, table_of((0, 0, 0)), device)
    models = build_models([model_of(sheet(*size), as_material(texture) if material is None else material)], device)
    return observer, Normals(models, observer), models


def moved(x: float, y: float) -> np.ndarray:
    return POSE + np.array([x, y, 0, 0, 0, 0, 0], np.float32)


def descend(normals: Normals, pose: np.ndarray, loss, iterations: int) -> np.ndarray:
    """Pose after steps on the samples' residuals alone; small damping keeps what they do not determine."""
    for _ in range(iterations):
        normals.from_samples(pose, loss)
        pose = normals.step(pose, step_limits(damping=1e-4))[0]
    return pose


def descend_in_the_plane(normals: Normals, pose: np.ndarray, loss, iterations: int) -> np.ndarray:
    """Pose after steps along x, y and about z: depth and tilt, which the surface would hold, stay."""
    radius, free = float(normals.models.models.radius.numpy()[0]), [2, 3, 4]
    for _ in range(iterations):
        sums, step = normals.from_samples(pose, loss), np.zeros(6)
        step[free] = np.linalg.solve(sums["hessian"][0][np.ix_(free, free)] + 1e-9 * np.eye(3), sums["gradient"][0][free])
        rotation, translation = twin.stepped(pose, step, radius)
        pose = np.concatenate([translation, rotation.as_quat()]).astype(np.float32)
    return pose


def test_the_silhouette_alone_moves_a_plate_back(device):
    """By 5 mm along the diagonal, up to the deadband of 3/4 pixels and a pixel that no sample reaches into."""
    _, normals, _ = plate_scene(device, (0.04, 0.035), GREY)
    loss = make_loss(LossScales(silhouette=1.0), 0.01, 1, 0.0)
    pose = descend(normals, moved(0.004, -0.003), loss, 30)
    assert np.abs(pose[:2]).max() < 1.75 * PIXEL
    sums = normals.from_samples(POSE, loss)
    assert sums["samples"][0, 0] == 0.0
    assert (sums["gradient"] == 0.0).all()


def test_the_silhouette_draws_as_its_residuals_say(device):
    """The gradient is Σ weight distance J, the Hessian Σ weight J Jᵀ, over the protruding samples, with Huber's weight."""
    observer, normals, models = plate_scene(device, (0.04, 0.035), GREY)
    loss, pose = make_loss(LossScales(silhouette=0.7), 0.002, 1, 0.0), moved(0.006, 0.002)
    found = {name: values[0] for name, values in view_samples(models, loss, observer, pose).items()}
    sums = normals.from_samples(pose, loss)
    out = (found["state"] == 2) & (found["way"][:, 3] > 0.0)
    direction, distance = found["way"][out, :3], found["way"][out, 3]
    radius = float(models.models.radius.numpy()[0])
    line = np.concatenate([np.cross(found["position"][out] - pose[:3], direction) / radius, direction], axis=1)
    weight = 0.7 * found["area"][out] * np.minimum(1.0, 0.002 / distance)
    assert (distance > 0.002).any()
    assert sums["gradient"][0] == pytest.approx((weight * distance) @ line, rel=1e-3, abs=1e-12)
    assert sums["hessian"][0] == pytest.approx(line.T @ (weight[:, None] * line), rel=1e-3, abs=1e-10)
    truncated = np.minimum(found["way"][:, 3] / 0.01, 1.0) * found["area"]
    assert sums["samples"][0, 0] == pytest.approx(truncated[found["state"] == 2].sum(), rel=1e-3)
    assert sums["samples"][0, 1] == pytest.approx(found["area"][found["state"] == 1].sum(), rel=1e-3)
    assert (sums["samples"][0, 2:] == 0.0).all()


@pytest.mark.parametrize("offset", [(0.005, 0.0), (-0.003, 0.004), (0.0, -0.005)])
def test_colour_alone_moves_a_textured_plate_back(device, offset):
    _, normals, _ = plate_scene(device, (0.1, 0.08))
    loss = make_loss(LossScales(silhouette=0.0, color_cutoff=3.0), 0.01, 1, 0.005)
    pose = descend_in_the_plane(normals, moved(*offset), loss, 15)
    # A quarter of a pixel: the observed colours are means of pixels, those of the model are texels.
    assert np.abs(pose[:2]).max() < 0.25 * PIXEL
    assert pose_errors(pose[None], POSE[None])[1][0] < 0.2


def test_without_texture_colour_moves_nothing_in_the_plane(device):
    _, normals, _ = plate_scene(device, (0.1, 0.08), texture=np.full((8, 8, 3), 0.4), wall=0.4)
    loss = make_loss(LossScales(silhouette=0.0), 0.01, 1, 0.005)
    pose = descend_in_the_plane(normals, moved(0.005, 0.0), loss, 5)
    assert pose[:2] == pytest.approx([0.005, 0.0], abs=1e-4)


def test_the_derivative_of_colour_is_that_of_the_image(device):
    """Central differences of the interpolated red along the steps, where they stay between the same four pixels."""
    observer, _, models = plate_scene(device, (0.1, 0.08))
    pose = moved(0.001, 0.002)
    found = {name: values[0] for name, values in view_samples(models, make_loss(LossScales(), 0.01, 1, 0.005), observer, pose).items()}
    seen = observer.observation
    red = seen.color.numpy()[0, :, :, :1].astype(np.float64)
    corner, pitch = seen.corner.numpy()[0], float(seen.pitch.numpy()[0])
    radius = float(models.models.radius.numpy()[0])
    used = (found["colored"] > 0) & (np.abs(found["crop"] - np.rint(found["crop"])) > 0.05).all(axis=1)
    local = models.models.position.numpy()[0][used].astype(np.float64)

    def intensity(step: np.ndarray) -> np.ndarray:
        rotation, translation = twin.stepped(pose, step, radius)
        point = rotation.apply(local) + translation
        pixel = point[:, :2] / point[:, 2:] * FOCAL + (SHAPE[1] / 2, SHAPE[0] / 2)
        return twin.bilinear(red, (pixel - corner) / pitch - 0.5)[:, 0]

    numeric = twin.numeric_gradient(intensity).T
    line = found["line"][used].astype(np.float64)
    analytic = np.concatenate([np.cross(found["position"][used] - pose[:3], line) / radius, line], axis=1)
    assert analytic == pytest.approx(numeric, abs=2e-3 * np.abs(numeric).max())


def test_colour_residuals_are_weighted_sums(device):
    """The cost is the mean of |error| / cutoff, truncated; the gradient draws against the error."""
    observer, normals, models = plate_scene(device, (0.1, 0.08))
    scales, pose = LossScales(silhouette=0.0, color_cutoff=0.4), moved(0.003, 0.0)
    loss = make_loss(scales, 0.01, 1, 0.005)
    found = {name: values[0] for name, values in view_samples(models, loss, observer, pose).items()}
    normals.even_light(0.9)
    sums = normals.from_samples(pose, loss)
    used = found["colored"] > 0
    mean = float(observer.observation.intensity.numpy()[0])
    error = (found["color"][used] - 0.9 * models.models.color.numpy()[0][used]) / mean
    area = found["area"][used]
    assert sums["samples"][0, 3] == pytest.approx(area.sum(), rel=1e-3)
    assert sums["samples"][0, 2] == pytest.approx(area @ np.minimum(np.abs(error) / 0.4, 1.0).mean(axis=1), rel=2e-3)
    red = area * np.maximum(1.0 - (error[:, 0] / 0.4) ** 2, 0.0) ** 2 / 3.0 * 0.005 * error[:, 0]
    assert red.any()
    # Of the three channels, red alone: the others' colours are set to the observed ones.
    color = models.models.color.numpy()
    color[0, used, 1:] = found["color"][used, 1:] / 0.9
    models.models.color.assign(color)
    alone = normals.from_samples(pose, loss)["gradient"][0]
    line = found["line"][used] * 0.005 / mean
    assert alone[3:] == pytest.approx(-red @ line, rel=2e-3, abs=1e-9)


def test_every_second_sample_counts_twice(device):
    _, normals, _ = plate_scene(device, (0.1, 0.08))
    pose = moved(0.004, 0.002)
    full, half = (normals.from_samples(pose, make_loss(LossScales(), 0.01, step, 0.005)) for step in (1, 2))
    assert half["samples"][0] == pytest.approx(full["samples"][0], rel=0.1)
    assert half["gradient"][0, 3:5] == pytest.approx(full["gradient"][0, 3:5], rel=0.2)
