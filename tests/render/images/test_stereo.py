"""Active stereo camera: infrared pair against its geometry and light, matched depth against known planes, NumPy's twin and OpenCV."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import MAX_DISPARITIES
from synpick_warp.configs.cell.cameras import DepthSensor
from synpick_warp.configs.schema import Config
from synpick_warp.kernels.render.images.stereo_matching import sum_path_costs_kernel
from synpick_warp.stages.render import layers
from synpick_warp.stages.render.layers import StereoRenderer, count_disparities, sensor_parameters
from synpick_warp.stages.render.scene import blank_scene
from synpick_warp.stages.render.view_setup import first_views
from tests.twins.layers import matching_costs, path_costs, render_layers
from tests.worlds.shapes import UPRIGHT, box, camera, entry, sheet, surface
from tests.worlds.toy_scene import ToyScene

WIDTH, HEIGHT, FOCAL, TOP, BASELINE = 240, 120, 400.0, 2.0, 0.06
VIEW = camera(WIDTH, HEIGHT, FOCAL, (0.0, 0.0, TOP))
COUNT = 1e-4
"""One depth count [m]."""
QUIET: dict[str, Any] = {
    "baseline": BASELINE,
    "distances": (0.5, 10.0),
    "disparity_step": 1e-3,
    "max_disparity": 60.0,
    "infrared_noise": 0.0,
}
"""Settings of a camera without noise; its pattern is on."""
NOISY: dict[str, Any] = QUIET | {"infrared_noise": 0.005}
DARK: dict[str, Any] = QUIET | {"ambient": 0.0}


def speckles(size: int = 512, blur: float = 1.0) -> np.ndarray:
    """Random texture (size, size, 3) uint8 of grey speckles."""
    values = cv2.GaussianBlur(np.random.default_rng(2).random((size, size)), (0, 0), blur)
    values = (values - values.min()) / np.ptp(values)
    return np.repeat(np.rint(255.0 * values).astype(np.uint8)[..., None], 3, axis=-1)


def wall(depth: float, tilt: float = 0.0, texture: np.ndarray | None = None, view=VIEW, width: float = 4.0) -> ToyScene:
    """A white or textured sheet across the optical axis at a depth [m], rotated about the image's columns by `tilt` [rad]."""
    turn = (0.0, np.sin(tilt / 2.0), 0.0, np.cos(tilt / 2.0))
    return ToyScene([entry(sheet(width, width), surface(texture=texture))], [[(0, (0.0, 0.0, TOP - depth, *turn))]], (view,))


def step_scene(view=VIEW) -> ToyScene:
    """A wall at 1.5 m, and in front of it, at 1.0 m, a box that covers columns 100 to 139 and rows 40 to 79."""
    placed = [(0, (0.0, 0.0, TOP - 1.5, *UPRIGHT)), (1, (0.0, 0.0, TOP - 1.0 - 0.025, *UPRIGHT))]
    return ToyScene([entry(sheet(4.0, 4.0), surface()), entry(box(0.1, 0.1, 0.05), surface())], [placed], (view,))


@dataclass(frozen=True)
class Seen:
    """Layers of a batch of views, and the rendered depth [m]."""

    left: np.ndarray
    right: np.ndarray
    stereo: np.ndarray
    """Matched depth [m], NaN: hole."""
    exact: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """Errors of disparity [px]."""
        return FOCAL * BASELINE * (1.0 / self.stereo - 1.0 / self.exact)


def see(toy: ToyScene, device: wp.Device, **settings: Any) -> Seen:
    config = replace(Config(), depth_sensor=DepthSensor(**settings)).with_values({"bop.depth_scale": COUNT * 1e3})
    shown = render_layers(replace(toy, config=config), device, names=("depth_stereo", "ir_right", "ir_left"))
    counts = shown["depth_stereo"]
    return Seen(shown["ir_left"].astype(int), shown["ir_right"].astype(int), np.where(counts > 0, counts * COUNT, np.nan), shown.depth)


# ---- infrared images ----


def test_a_white_wall_in_even_light_has_the_exposure_of_ambient_light(device):
    images = [see(wall(1.5), device, **QUIET | {"dot_brightness": 0.0, "ambient": ambient}).left for ambient in (0.25, 0.5)]
    assert np.ptp(images[0]) == np.ptp(images[1]) == 0
    # White reflects the map's radiance, which automatic exposure maps to a grey between black and full scale.
    assert images[0].max() > 20
    np.testing.assert_allclose(images[1], 2.0 * images[0], atol=1.5)


def test_the_right_image_is_that_of_a_camera_at_the_end_of_the_baseline(device):
    """With the projector at that camera, pattern and shadows are its own, too."""
    beside = camera(WIDTH, HEIGHT, FOCAL, (BASELINE, 0.0, TOP))
    for toy in (step_scene, lambda view=VIEW: wall(1.2, 0.4, speckles(), view)):
        right = see(toy(), device, **QUIET | {"projector": 1.0}).right
        left = see(toy(beside), device, **QUIET | {"projector": 0.0}).left
        assert np.ptp(left) > 100
        assert (np.abs(right - left) > 1).mean() < 2e-3


def test_dots_have_the_places_of_the_projector_and_fall_with_the_square_of_depth(device):
    settings = DARK | {"projector": 0.0, "dot_brightness": 0.95}
    near, far = (see(wall(depth), device, **settings).left for depth in (1.0, 2.0))
    assert near.max() > 200
    np.testing.assert_allclose(far, near / 4.0, atol=1.0)
    # Half a baseline away, they are displaced by half the disparity.
    moved = see(wall(1.0), device, **settings | {"projector": 0.5}).left
    np.testing.assert_allclose(moved[..., 12:], near[..., :-12], atol=2.0)
    # One dot in each cell.
    assert cv2.connectedComponents((near[0] > 150).astype(np.uint8))[0] > 0.4 * WIDTH * HEIGHT / 16


def test_objects_cast_shadows_of_the_projector(device):
    dots = see(step_scene(), device, **DARK | {"projector": 1.0}).left[0]
    # f b (1 / 1.0 - 1 / 1.5) = 8 px to the left of the box.
    assert not dots[44:76, 93:99].any()
    assert dots[44:76, 80:88].mean() > 10
    assert dots[44:76, 142:150].mean() > 10
    assert see(step_scene(), device, **DARK | {"projector": 0.0}).left[0, 44:76, 93:99].mean() > 10


def test_noise_is_of_each_image_alone(device):
    toy = wall(1.5)
    toy.cameras, toy.placed = (VIEW, VIEW), toy.placed * 2
    seen = see(toy, device, **QUIET | {"dot_brightness": 0.0, "infrared_noise": 0.02})
    images = np.concatenate([seen.left, seen.right]).reshape(6 + 2, -1)
    np.testing.assert_allclose(images.std(axis=1), 0.02 * 255.0, rtol=0.05)
    # Both worlds are at the same frame of the same episode.
    np.testing.assert_array_equal(images[0], images[2])
    correlation = np.corrcoef(images[[0, 1, 4, 5]]) - np.eye(4)
    assert np.abs(correlation).max() < 0.03


# ---- matching ----


@pytest.mark.parametrize("shape", [(23, 41), (64, 37)])
@pytest.mark.parametrize("count", [7, 33, 64, MAX_DISPARITIES])
def test_path_costs_are_those_of_the_twin(device, shape, count):
    rng = np.random.default_rng(count)
    height, width = shape
    images = rng.integers(0, 4, (2, *shape)).astype(np.uint8)
    images[1, :, : width - 5] = images[0, :, 5:]
    renderer, views = matcher(device, height, width, replace(DepthSensor(), max_disparity=count - 2.0), focal=3.2)
    costs, _ = match(renderer, views, images[0], images[1])
    np.testing.assert_array_equal(costs, path_costs(matching_costs(images[0], images[1], 3, count)))


def test_the_kernels_compile_for_a_gpu(tmp_path):
    """Paths are followed by a branch that a CPU does not compile. None is needed."""
    wp.compile_aot_module(sum_path_costs_kernel.module, arch=90, module_dir=tmp_path, use_ptx=True)
    (program,) = tmp_path.glob("*.ptx")
    assert "shfl.sync" in program.read_text()


def matcher(device: wp.Device, height: int, width: int, sensor: DepthSensor, focal: float) -> tuple[StereoRenderer, Any]:
    """Renderer that only matches, of cameras whose f b is `focal` metres times pixels, and a view; depth is up to 1 m."""
    views = first_views(1, 1, 0, device)
    views.cameras.intrinsics.assign(np.array([[focal / sensor.baseline, focal / sensor.baseline, 0.0, 0.0]], np.float32))
    parameters = sensor_parameters(replace(sensor, distances=(1e-3, 1.0)), 0, COUNT * 1e3)
    return StereoRenderer(("depth_stereo",), parameters, blank_scene(1, width, height, device), 1), views


def match(renderer: StereoRenderer, views: Any, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Costs along paths, and sub-pixel disparity of two images before it is filtered [px]; negative: none."""
    device = renderer.scene.device
    images = [wp.array(image[None], dtype=wp.uint8, device=device) for image in (left, right)]
    renderer.match(0, 1, views, images, wp.zeros((1, *left.shape), dtype=wp.uint16, device=device))
    assert renderer.scratch is not None
    return renderer.scratch.cost.numpy()[0], renderer.scratch.disparity.numpy()[0] / 256.0


@pytest.mark.parametrize("tilt", [0.0, 0.3, 0.8])
def test_depth_of_a_textured_plane_is_exact_to_a_fraction_of_a_pixel(device, tilt):
    seen = see(wall(1.3, tilt, speckles(1024), width=2.0), device, **NOISY | {"dot_brightness": 0.0})
    # The leftmost columns have no partner.
    middle = seen.error[0, :, 40:]
    assert np.isfinite(middle).mean() > 0.98
    assert abs(np.nanmedian(middle)) < 0.05
    assert np.nanstd(middle) < 0.25
    assert np.nanpercentile(np.abs(middle), 95) < 0.35


@pytest.mark.parametrize("depth", [0.8, 1.0, 1.07, 1.5, 2.0])
def test_a_plain_plane_is_matched_by_the_pattern_alone(device, depth):
    seen = see(wall(depth), device, **NOISY)
    middle = seen.error[0, :, 40:]
    assert np.isfinite(middle).mean() > 0.995
    assert abs(np.nanmedian(middle)) < 0.06
    assert np.nanstd(middle) < 0.1
    dark = see(wall(depth), device, **NOISY | {"dot_brightness": 0.0})
    assert np.isfinite(dark.stereo[0, :, 40:]).mean() < 0.1


def test_holes_lie_at_the_left_of_objects(device):
    seen = see(step_scene(), device, **NOISY)
    holes = np.isnan(seen.stereo[0, 44:76])
    # As wide as the difference of disparities, 8 px.
    np.testing.assert_allclose(holes[:, 88:100].sum(axis=1).mean(), 8.0, atol=2.0)
    assert holes[:, 104:136].mean() < 0.01
    assert holes[:, 142:].mean() < 0.01
    middle = seen.error[0, 44:76]
    assert np.abs(middle[:, 104:136]).max() < 0.5
    assert np.nanpercentile(np.abs(middle[:, 144:]), 99) < 0.5


def test_opencv_finds_the_same_disparities(device):
    """`cv2.StereoSGBM` with the same penalties, whose costs are sums over a block of 7 x 7."""
    seen = see(wall(1.3, 0.3, speckles(1024), width=2.0), device, **NOISY)
    twin = cv2.StereoSGBM.create(0, 64, 7, P1=8 * 49, P2=32 * 49, disp12MaxDiff=1, uniquenessRatio=15)
    theirs = twin.compute(seen.left[0].astype(np.uint8), seen.right[0].astype(np.uint8)) / 16.0
    ours = FOCAL * BASELINE / seen.stereo[0]
    both = np.isfinite(ours) & (theirs > 0.0)
    assert both[:, 64:].mean() > 0.97
    off = (ours - theirs)[both]
    assert abs(np.median(off)) < 0.1
    assert np.percentile(np.abs(off), 99) < 0.75


@pytest.mark.parametrize("fraction", np.arange(0.0, 1.0, 0.125))
def test_fractions_of_a_pixel_are_not_drawn_to_whole_ones(device, fraction):
    fine, height, width = 8, 80, 160
    values = cv2.GaussianBlur(np.random.default_rng(0).random((height, fine * (width + 40))), (0, 0), sigmaX=fine, sigmaY=1.0)
    values = np.rint(255.0 * (values - values.min()) / np.ptp(values)).astype(np.uint8)
    true = 20 + fraction
    left, right = (np.ascontiguousarray(values[:, start : start + fine * width : fine]) for start in (0, int(fine * true)))
    renderer, views = matcher(device, height, width, replace(DepthSensor(), max_disparity=40.0), focal=1.0)
    off = (match(renderer, views, left, right)[1] - true)[10:-10, 40:-10]
    assert abs(np.median(off)) < 0.04
    assert off.std() < 0.08


@pytest.mark.parametrize("slots", [1, 2])
def test_depth_is_that_of_single_views_and_of_unstored_images(device, slots, monkeypatch):
    """Also if the last views do not fill the slots."""
    monkeypatch.setattr(layers, "CPU_SLOTS", slots)
    monkeypatch.setattr(layers, "GPU_SLOTS", slots)
    toy = step_scene()
    toy.placed = [*toy.placed, *wall(1.3, 0.5).placed, *toy.placed]
    together = see(toy, device, **NOISY)
    alone = see(step_scene(), device, **NOISY)
    np.testing.assert_array_equal(together.stereo[[0, 2]], alone.stereo[[0, 0]])
    assert (together.stereo[1] != alone.stereo[0]).any()
    config = replace(Config(), depth_sensor=DepthSensor(**NOISY)).with_values({"bop.depth_scale": COUNT * 1e3})
    only = render_layers(replace(step_scene(), config=config), device, names=("depth_stereo",))["depth_stereo"]
    np.testing.assert_array_equal(only[0] * COUNT, np.nan_to_num(alone.stereo[0]))


def test_range_and_steps_are_those_of_the_settings(device):
    assert np.isnan(see(wall(1.3), device, **NOISY | {"distances": (1.4, 10.0)}).stereo).mean() > 0.97
    assert np.isnan(see(wall(1.3), device, **NOISY | {"max_disparity": 17.0}).stereo).mean() > 0.95
    disparity = FOCAL * BASELINE / see(wall(1.3), device, **NOISY | {"disparity_step": 0.5}).stereo
    np.testing.assert_allclose(np.unique(np.rint(disparity[np.isfinite(disparity)] * 4.0)) % 2, 0)
    assert [count_disparities(most) for most in (0.0, 5.0, 126.0, 1e4)] == [MAX_DISPARITIES, 7, 128, MAX_DISPARITIES]
