"""Post-processing: tone curves and camera effects against their laws and a NumPy twin."""

import re
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.codes import Effect, Tone, names
from synpick_warp.configs.cell.cameras import Effects, effect_ranges
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import Config
from synpick_warp.kernels.render.images.camera_effects import EffectParameters
from synpick_warp.kernels.render.lighting.environment import Lights
from synpick_warp.kernels.render.visibility.gbuffer import ALL_PASSES, GBuffer, ShadedImage, ViewBodies
from synpick_warp.scenes.assets.appearance import linear_to_srgb, srgb_to_linear
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.render.cameras import build_cameras
from synpick_warp.stages.render.postprocess import PostProcessor
from synpick_warp.stages.render.scene import build_grid
from synpick_warp.stages.render.view_setup import make_shot
from synpick_warp.system.hardware.device import pick_device
from tests.builders import refusal
from tests.harness.aimed_views import aimed_views
from tests.harness.environment import default_device
from tests.harness.memory_tables import device_arrays
from tests.worlds.shapes import UPRIGHT, box, camera, entry
from tests.worlds.toy_scene import ANNOTATIONS, ToyScene, assert_same, render

WIDTH, HEIGHT = 72, 40
LENS = camera(WIDTH, HEIGHT, 60.0, (0.0, 0.0, 2.0))
GAIN = 0.5
"""Exposure of the one light map."""


@dataclass(frozen=True)
class ViewKeys:
    """Episode, frame and camera of each view: the key of its random number stream."""

    episode: list[int]
    frame: list[int]
    camera: list[int]


ONE = ViewKeys([3], [5], [0])


def make_config(tone: str = "linear", seed: int = 7, **effects: Any) -> Config:
    config = Config(effects=Effects(**effects))
    return replace(config, render=replace(config.render, tone=tone), bake=replace(config.bake, seed=seed))


def postprocess(radiance: np.ndarray, config: Config, at: ViewKeys = ONE, stops: float = 0.0, lens=LENS) -> tuple[np.ndarray, np.ndarray]:
    """sRGB bytes (B, H, W, 3) and effect parameters (B, E) of an image of radiance (H, W, 3); each view has a world of its own."""
    device = pick_device(default_device())
    views = len(at.episode)
    lights = Lights()
    lights.exposure = wp.array([GAIN], dtype=wp.float32, device=device)
    height, width = radiance.shape[:2]
    scene = SimpleNamespace(grid=build_grid(width, height), lights=lights, width=width, height=height, device=device)

    world = allocate(Snapshot, {"world": views, "instance": 1, "fixture": 1}, device)
    world.episode.assign(at.episode)
    world.frame.assign(at.frame)
    world.light_exposure.fill_(stops)
    out = SimpleNamespace(
        color=wp.zeros((views, height, width), dtype=wp.vec3ub, device=device),
        effects=wp.zeros(views, dtype=EffectParameters, device=device),
    )
    image = ShadedImage()
    image.radiance = wp.array(np.repeat(radiance[None] / GAIN, views, axis=0), dtype=wp.vec3, device=device)
    image.resolve = wp.zeros((views, height, width), dtype=wp.uint32, device=device)
    image.passes = wp.full((views, scene.grid.tiles), ALL_PASSES, dtype=wp.uint8, device=device)
    batch = aimed_views(range(views), at.camera, 0, build_cameras((lens,) * 9, device), device)
    shot = make_shot(scene, world.frames, ViewBodies(), GBuffer(), batch)  # type: ignore[arg-type]
    PostProcessor(config.effects, config.render.tone, config.bake.seed, scene, views).process(shot, image, out)
    return out.color.numpy(), out.effects.numpy()


def linear(color: np.ndarray) -> np.ndarray:
    return srgb_to_linear(color / 255.0)


def uniform_image(value: float | tuple[float, float, float], width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.ones((height, width, 3)) * value


def parameter(effects: np.ndarray, name: str) -> Any:
    return effects[..., Effect[name.upper()]]


# ---- tone ----


def curve(x: np.ndarray, tone: str) -> np.ndarray:
    """Tone curves in float64."""
    if tone == "filmic":
        x = 0.7232 * x
        return x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    return np.where(x > 0.6, 1.0 - 0.4 * np.exp((0.6 - x) / 0.4), x) if tone == "shoulder" else x


@pytest.mark.parametrize("tone", names(Tone))
def test_tone_curves_follow_their_laws(tone):
    values = np.linspace(0.0, 4.0, WIDTH * HEIGHT * 3).reshape(HEIGHT, WIDTH, 3)
    color, effects = postprocess(values, make_config(tone), stops=0.5)
    expected = 255.0 * linear_to_srgb(np.clip(curve(2.0**0.5 * values, tone), 0.0, 1.0))
    np.testing.assert_allclose(color[0], expected, atol=0.501)
    assert not effects.any()


def test_all_tone_curves_keep_middle_grey_and_shoulder_is_the_default():
    grey = {tone: postprocess(uniform_image(0.18), make_config(tone))[0] for tone in names(Tone)}
    assert all((color == np.rint(255.0 * linear_to_srgb(0.18))).all() for color in grey.values())
    assert Config().render.tone == "shoulder"


# ---- one effect at a time ----


def test_effects_that_do_not_touch_radiance_leave_the_bytes_alone():
    device = pick_device(default_device())
    scene = SimpleNamespace(width=8, height=8, device=device)
    plain = PostProcessor(Effects(), "shoulder", 0, scene, 2)
    assert plain.effects is plain.filtered is None
    values = np.random.default_rng(1).uniform(0.0, 2.0, (HEIGHT, WIDTH, 3))
    color, effects = postprocess(values, make_config("shoulder", jpeg_quality=(30, 90)))
    np.testing.assert_array_equal(color, postprocess(values, make_config("shoulder"))[0])
    assert 30 <= parameter(effects, "jpeg_quality")[0] <= 90


def test_contrast_and_saturation_change_srgb_values():
    image = np.random.default_rng(3).uniform(0.0, 0.6, (HEIGHT, WIDTH, 3))
    plain = postprocess(image, make_config(read_noise=(1e-9, 1e-9)))[0][0] / 255.0
    for contrast, saturation in ((0.5, 0.0), (0.0, -1.0), (-0.3, 0.8)):
        made = make_config(contrast=(contrast, contrast), saturation=(saturation, saturation))
        value = 0.5 + (1 + contrast) * (plain - 0.5)
        luma = value @ np.array([0.299, 0.587, 0.114])
        expected = luma[..., None] + (1 + saturation) * (value - luma[..., None])
        np.testing.assert_allclose(postprocess(image, made)[0][0], 255.0 * np.clip(expected, 0.0, 1.0), atol=0.51)


def blob(row: float, column: float) -> np.ndarray:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return uniform_image(0.9 * np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / 8.0)[..., None])


def centroid(values: np.ndarray) -> np.ndarray:
    """Centre of mass: row and column."""
    return np.array([(values * grid).sum() / values.sum() for grid in np.mgrid[: values.shape[0], : values.shape[1]]])


def test_chromatic_aberration_magnifies_red_and_shrinks_blue():
    image = blob(7.0, 9.0)
    plain, _ = postprocess(image, make_config())
    color, _ = postprocess(image, make_config(chromatic_aberration=(2.0, 2.0)))
    np.testing.assert_array_equal(color[..., 1], plain[..., 1])
    at = centroid(linear(plain)[0, ..., 1])
    # From the middle of the image, pixel (19.5, 35.5), in proportion to the distance, 2 px in the corner.
    outward = (at - (19.5, 35.5)) / np.hypot(20.0, 36.0) * 2.0
    assert np.abs(outward).min() > 0.5
    for channel, sign in ((0, 1.0), (2, -1.0)):
        np.testing.assert_allclose(centroid(linear(color)[0, ..., channel]) - at, sign * outward, atol=0.05)


def test_blur_is_a_normalized_gaussian_of_its_sigma():
    point = uniform_image(0.0)
    point[20, 36] = 20.0
    color, effects = postprocess(point, make_config(blur=(1.5, 2.5)))
    values = linear(color)[0, ..., 1]
    sigma = float(parameter(effects, "blur")[0])
    assert 1.5 < sigma < 2.5
    np.testing.assert_allclose(values.sum(), 20.0, rtol=0.02)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    for grid, middle in ((rows, 20), (columns, 36)):
        # The Gaussian ends at three sigma, which takes 3 % of its variance.
        np.testing.assert_allclose((values * (grid - middle) ** 2).sum() / values.sum(), 0.973 * sigma**2, rtol=0.04)
    assert (postprocess(uniform_image(0.4), make_config(blur=(3.0, 3.0)))[0] == postprocess(uniform_image(0.4), make_config())[0]).all()


@pytest.mark.parametrize(
    ("shot", "read", "value"), [*((0.03, 0.008, value) for value in (0.08, 0.3, 0.8)), (0.0, 0.02, 0.2), (0.0, 0.02, 0.7)]
)
def test_sensor_noise_follows_its_law(shot, read, value):
    color, _ = postprocess(uniform_image(value, width=240, height=160), make_config(shot_noise=(shot, shot), read_noise=(read, read)))
    values = linear(color)[0]
    variance = shot**2 * value + read**2
    np.testing.assert_allclose(values.mean(axis=(0, 1)), value, atol=4.0 * np.sqrt(variance / values[..., 0].size) + 1e-4)
    # Rounding to bytes adds a twelfth of a squared step.
    step = 2.0 * np.ptp(srgb_to_linear(linear_to_srgb(value) + np.array([-0.25, 0.25]) / 255.0))
    np.testing.assert_allclose(values.var(axis=(0, 1)), variance + step**2 / 12.0, rtol=0.04)
    assert np.abs(np.corrcoef(values.reshape(-1, 3).T) - np.eye(3)).max() < 0.03
    assert abs(np.corrcoef(values[:, 1:, 0].ravel(), values[:, :-1, 0].ravel())[0, 1]) < 0.03


def test_shot_noise_vanishes_in_the_dark():
    assert not postprocess(uniform_image(0.0), make_config(shot_noise=(0.1, 0.1)))[0].any()


# ---- all effects ----


def lens_twin(image: np.ndarray, parameters: np.ndarray, lens: Camera) -> np.ndarray:
    """NumPy twin of lens and exposure in float64: vignette, exposure, blur and chromatic aberration in sequence."""
    get = dict(zip(names(Effect), parameters.astype(np.float64), strict=True))
    height, width = image.shape[:2]
    (fx, _, cx), (_, fy, cy) = lens.matrix[:2]
    rows, columns = np.mgrid[:height, :width] + 0.5
    corner = np.array([max(cx, width - cx), max(cy, height - cy)])
    fourth = (1.0 + ((columns - cx) / fx) ** 2 + ((rows - cy) / fy) ** 2) ** -2
    last = (1.0 + (corner[0] / fx) ** 2 + (corner[1] / fy) ** 2) ** -2
    lit = image * (1.0 - get["vignette"] * (1.0 - fourth) / (1.0 - last))[..., None]
    lit = lit * 2.0 ** (get["exposure"] + np.array([get["red"], 0.0, get["blue"]]))
    result = np.zeros_like(lit)
    for channel, sign in enumerate((1.0, 0.0, -1.0)):
        scale = 1.0 + sign * get["chromatic_aberration"] / np.hypot(*corner)
        along_rows = resample(lit[..., channel], cx, scale, get["blur"])
        result[..., channel] = resample(along_rows.T, cy, scale, get["blur"]).T
    return result


def resample(values: np.ndarray, center: float, scale: float, sigma: float) -> np.ndarray:
    """Blur along the last axis, then magnify about `center`."""
    size, reach = values.shape[1], int(np.ceil(3.0 * sigma))
    taps = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (taps / sigma) ** 2) if sigma > 0.0 else np.ones(1)
    pad = reach + 8
    wide = np.pad(values, ((0, 0), (pad + reach, pad + reach)), mode="edge")
    blurred = np.stack([np.convolve(row, weights / weights.sum(), mode="valid") for row in wide])
    at = center + (np.arange(size) + 0.5 - center) / scale - 0.5
    return np.stack([np.interp(at, np.arange(-pad, size + pad), row) for row in blurred])


@settings(max_examples=15)
@given(
    st.floats(0.0, 1.0),
    st.floats(-3.0, 3.0),
    st.sampled_from([0.0, 0.3, 1.0, 2.7]),
    st.floats(0.0, 1.0),
    st.integers(0, 2**31 - 1),
)
def test_lens_and_exposure_match_the_numpy_twin(vignette, aberration, blur, jitter, episode):
    image = np.random.default_rng(episode).uniform(0.0, 0.6, (HEIGHT, WIDTH, 3))
    config = make_config(
        vignette=(vignette, vignette),
        chromatic_aberration=(aberration, aberration),
        blur=(blur, blur),
        exposure_jitter=jitter,
        white_balance_jitter=jitter,
    )
    lens = replace(LENS, matrix=np.array([[60.0, 0.0, 30.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]]))  # Off the image's centre.
    color, effects = postprocess(image, config, ViewKeys([episode], [1], [2]), lens=lens)
    np.testing.assert_allclose(parameter(effects, "vignette"), vignette, rtol=1e-6, atol=1e-12)
    expected = 255.0 * linear_to_srgb(np.clip(lens_twin(image, effects[0], lens), 0.0, 1.0))
    np.testing.assert_allclose(color[0], expected, atol=0.52)


ALL = {
    "exposure_jitter": 0.5,
    "white_balance_jitter": 0.2,
    "vignette": (0.1, 0.5),
    "chromatic_aberration": (-1.0, 2.0),
    "blur": (0.2, 1.5),
    "shot_noise": (0.01, 0.05),
    "read_noise": (0.001, 0.01),
    "jpeg_quality": (40, 95),
    "contrast": (-0.2, 0.6),
    "saturation": (-0.5, 1.0),
}


def test_effects_and_noise_follow_from_seed_episode_frame_and_camera_alone():
    image = np.random.default_rng(0).uniform(0.0, 1.2, (HEIGHT, WIDTH, 3))
    at = ViewKeys([4, 4, 4, 9, 4], [0, 1, 0, 0, 0], [0, 0, 1, 0, 0])
    together, effects = postprocess(image, make_config("filmic", **ALL), at)
    for view in range(4):
        alone = ViewKeys([at.episode[view]], [at.frame[view]], [at.camera[view]])
        color, parameters = postprocess(image, make_config("filmic", **ALL), alone)
        np.testing.assert_array_equal(color[0], together[view])
        np.testing.assert_array_equal(parameters[0], effects[view])
    np.testing.assert_array_equal(together[4], together[0])
    other = postprocess(image, make_config("filmic", seed=8, **ALL), ViewKeys([4], [0], [0]))
    sampled = [*effects[:4], other[1][0]]
    assert len({tuple(row) for row in sampled}) == 5
    # Noise alone differs as well, not only its parameter.
    fixed = make_config(read_noise=(0.1, 0.1))
    images, _ = postprocess(uniform_image(0.5), fixed, at)
    assert (
        len({image.tobytes() for image in (*images, postprocess(uniform_image(0.5), make_config(seed=8, read_noise=(0.1, 0.1)), ONE)[0])})
        == 5
    )


def test_effects_change_only_colour(device):
    toy = ToyScene([entry(box(0.3, 0.2, 0.1))], [[(0, (0.02, 0.0, 0.0, *UPRIGHT))]] * 2, (LENS,), table=True)
    toy.config = make_config("shoulder")
    plain = render(toy, device)
    toy.config = make_config("shoulder", **ALL)
    changed = render(toy, device)
    assert (changed.color != plain.color).any(axis=(1, 2, 3)).all()
    assert_same(changed, plain, "exact_depth", "radiance", *ANNOTATIONS)


def test_effect_parameters_are_uniform_in_their_ranges():
    views = 2000
    at = ViewKeys(list(range(views)), [0] * views, [0] * views)
    _, effects = postprocess(np.zeros((1, 1, 3)), make_config(**ALL), at)
    for name, (low, high) in effect_ranges(Effects(**ALL)).items():
        values = parameter(effects, name)
        assert low <= values.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < values.max() <= high
        np.testing.assert_allclose(values.mean(), (low + high) / 2.0, atol=0.03 * (high - low))
    quality = parameter(effects, "jpeg_quality")
    assert set(quality) == set(range(40, 96))
    assert np.abs(np.corrcoef(effects.T) - np.eye(len(Effect))).max() < 0.08


def test_scratch_of_the_lens_filter_is_declared_only_if_needed():
    for effects, needed in (({}, False), ({"vignette": (0.1, 0.2)}, False), ({"blur": (0.0, 1.0)}, True)):
        names = {name for name, *_ in device_arrays(make_config(**effects))}
        assert ("LensArrays.radiance" in names) == needed


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("render.tone", "filmy", 'render.tone is "filmy" .*allowed: shoulder, linear, filmic; did you mean filmic'),
        ("effects.blur", [2.0, 1.0], r"effects.blur is \[2.0, 1.0\] .*allowed: minimum and maximum in this order: \[1.0, 2.0\]"),
        ("effects.blur", [-1.0, 1.0], r"effects.blur .*at least 0"),
        ("effects.vignette", 0.5, r"effects.vignette is 0.5 .*2 numbers in a list"),
        ("effects.vignette", [0.0, 1.5], r"effects.vignette .*at most 1"),
        ("effects.jpeg_quality", [0, 50], r"effects.jpeg_quality .*allowed: from 1 to 100, or 0, 0"),
        ("effects.jpeg_quality", [10.5, 50], r"effects.jpeg_quality .*2 whole numbers"),
        ("effects.exposure_jitter", -1.0, r"effects.exposure_jitter .*at least 0"),
        ("depth_sensor.distances", [3.0, 1.0], r"depth_sensor.distances .*minimum and maximum in this order"),
        ("depth_sensor.grazing_angle", 90.0, r"depth_sensor.grazing_angle .*at most 89"),
        ("depth_sensor.baseline", 0.0, r"depth_sensor.baseline .*above 0"),
        ("bop.color_format", "png", r"effects.jpeg_quality .*allowed: 0, 0 with bop.color_format png"),
    ],
)
def test_invalid_settings_are_reported_in_one_line(key, value, message):
    others = {"effects.jpeg_quality": [50, 60], "bop.split": "test"} if value == "png" else {}
    assert re.search(message, refusal(load_config, None, others | {key: value}))
