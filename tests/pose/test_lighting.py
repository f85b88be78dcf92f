"""Light on an instance: first-order harmonics fitted to the colours of its samples."""

import numpy as np
import pytest
import warp as wp

from synpick_warp.kernels.pose.lighting import CHANNELS, LIGHT_RIDGE, accumulate_lighting_kernel, fit_lighting_kernel
from synpick_warp.kernels.pose.residuals import LANES
from synpick_warp.stages.arrays import allocate_struct
from synpick_warp.stages.pose.models import build_models
from synpick_warp.stages.pose.refine import LIGHTING, LossScales, make_loss
from tests.harness.pose_probe import view_samples
from tests.twins import pose as twin
from tests.worlds.pose_views import drawn, model_of, observe, rays, table_of
from tests.worlds.toy_scene import ball

FOCAL, SHAPE, RADIUS, DISTANCE = 300.0, (100, 120), 0.06, 0.5
POSE = np.array([0.0, 0.0, DISTANCE, 0.0, 0.0, 0.0, 1.0], np.float32)


class Ball:
    """A ball before a wall; base colours of its samples are set such that a given light explains the image."""

    def __init__(self, device) -> None:
        x, y = rays(SHAPE[1], SHAPE[0], FOCAL)
        square = x**2 + y**2 + 1.0
        root = DISTANCE**2 - square * (DISTANCE**2 - RADIUS**2)
        label = root > 0.0
        depth = np.where(label, (DISTANCE - np.sqrt(np.maximum(root, 0.0))) / square, 0.65)
        color = np.stack([0.5 + 0.8 * x, 0.4 - 0.6 * y, 0.45 + 0.5 * (x + y)], axis=-1)
        self.device = device
        self.observer = observe(drawn(label, depth, FOCAL, color), table_of((0, 0, 0)), device)
        self.models = build_models([model_of(ball(RADIUS, 4))], device)
        self.loss = make_loss(LossScales(), 0.01, 1, 1.0)
        found = view_samples(self.models, self.loss, self.observer, POSE)
        self.used = found["colored"][0] > 0
        self.normal, self.area = found["normal"][0][self.used].astype(np.float64), found["area"][0][self.used].astype(np.float64)
        self.intensity = found["color"][0][self.used].astype(np.float64)

    def light(self, coefficients: np.ndarray) -> np.ndarray:
        """Set base colours that this light (3, 4) turns into the image; returns them."""
        basis = np.concatenate([self.normal, np.ones((len(self.normal), 1))], axis=1)
        base = self.intensity / (basis @ coefficients.T)
        color = self.models.models.color.numpy()
        color[0, self.used] = base
        self.models.models.color.assign(color)
        return base

    def fit(self) -> np.ndarray:
        """Coefficients (3, 4) of the fit."""
        sizes = {"pose": 1, "lane": int(LANES), "channel": int(CHANNELS)}
        lighting = allocate_struct(LIGHTING, sizes, self.device)
        observer = self.observer
        inputs = [self.models.models, self.loss, observer.images, observer.targets, observer.observation]
        inputs += [wp.array(POSE[None], dtype=wp.transform, device=self.device), 1]
        wp.launch(accumulate_lighting_kernel, dim=(1, int(LANES)), inputs=inputs, outputs=[lighting], device=self.device)
        wp.launch(fit_lighting_kernel, dim=1, outputs=[lighting], device=self.device)
        return lighting.coefficients.numpy()[0]


@pytest.fixture(scope="module")
def scene(device) -> Ball:
    return Ball(device)


def test_even_light_is_recovered_exactly(scene):
    truth = np.array([[0.0, 0.0, 0.0, level] for level in (0.7, 0.9, 1.3)])
    scene.light(truth)
    assert scene.fit() == pytest.approx(truth, abs=2e-4)


@pytest.mark.parametrize("seed", range(4))
def test_light_with_a_direction_is_that_of_the_ridge_regression(scene, seed):
    random = np.random.default_rng(seed)
    direction = random.normal(size=(3, 3))
    truth = np.concatenate([0.3 * direction / np.linalg.norm(direction, axis=1, keepdims=True), np.ones((3, 1))], axis=1)
    base = scene.light(truth)
    fitted = scene.fit()
    ridge = float(LIGHT_RIDGE)
    for channel in range(3):
        inputs = scene.normal, base[:, channel], scene.intensity[:, channel], scene.area
        assert fitted[channel] == pytest.approx(twin.fit_light(*inputs, ridge), abs=1e-3)
        # Without the ridge, the twin finds the truth; with it, the image is explained to 5 %.
        assert twin.fit_light(*inputs, 0.0) == pytest.approx(truth[channel], abs=1e-6)
        shown = base[:, channel] * (scene.normal @ fitted[channel, :3] + fitted[channel, 3])
        assert np.abs(shown / scene.intensity[:, channel] - 1.0).mean() < 0.05


def test_black_objects_have_no_light(scene):
    scene.models.models.color.zero_()
    assert (scene.fit() == 0.0).all()
