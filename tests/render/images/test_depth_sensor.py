"""Depth sensor model: noise, disparity quantization and invalid pixels against their laws, on scenes of known depth."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from synpick_warp.configs.calibration.tables import SENSORS, sensor_camera, sensor_settings
from synpick_warp.configs.cell.cameras import DepthSensor
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import LayerBuffers, ViewBuffers, view_buffer_sizes
from tests.worlds.shapes import UPRIGHT, box, camera, entry, sheet
from tests.worlds.toy_scene import ToyScene, build_scene, one, snapshot, views_of

WIDTH, HEIGHT, FOCAL = 160, 96, 400.0
TOP = 2.0
"""Height of the camera [m]."""
VIEW = camera(WIDTH, HEIGHT, FOCAL, (0.0, 0.0, TOP))
COUNT = 1e-4
"""One depth count [m]."""
PERFECT: dict[str, Any] = {
    "noise": 0.0,
    "noise_growth": 0.0,
    "noise_angle": 0.0,
    "lateral_noise": 0.0,
    "disparity_step": 1e-5,
    "edge_width": 0,
    "shadows": False,
    "grazing_angle": 89.0,
}
"""Settings of an ideal sensor; each test switches on one fault."""


@dataclass(frozen=True)
class Measured:
    """Depth images of a batch of views, as measured and as rendered."""

    counts: np.ndarray
    clean: np.ndarray
    """Counts of the rendered depth."""
    exact: np.ndarray
    """Rendered depth before rounding [m]."""
    count: float
    """One count [m]."""

    @property
    def depth(self) -> np.ndarray:
        """[m], NaN: hole."""
        return np.where(self.counts > 0, self.counts * self.count, np.nan)


def measure(
    toy: ToyScene, device: wp.Device, frames: int = 1, seed: int = 0, first_episode: int = 0, count: float = COUNT, **sensor: Any
) -> Measured:
    """Simulate the sensor for every world and camera, in `frames` batches for frames 0, 1, ..., stacked."""
    values = {"bop.depth_scale": count * 1e3, "bake.seed": seed, "render.layers": ("depth_sensor",)}
    config = replace(toy.settings(), depth_sensor=DepthSensor(**sensor)).with_values(values)
    scene, views = build_scene(toy, device), views_of(toy, device)
    renderer = make_renderer(config, scene, toy.instances, views.count, colors=False)
    sizes = view_buffer_sizes(views.count, scene.width, scene.height, toy.instances)
    images, layers = allocate(ViewBuffers, sizes, device), allocate(LayerBuffers, sizes, device, ("depth_sensor",))
    worlds_now = snapshot(toy, device)
    worlds_now.episode.assign(first_episode + np.arange(len(toy.placed)))
    frames_measured = []
    for frame in range(frames):
        worlds_now.frame.fill_(frame)
        renderer.render(worlds_now, views, images, layers)
        frames_measured.append(layers.depth_sensor.numpy().copy())
    return Measured(np.concatenate(frames_measured), images.depth.numpy(), renderer.gbuffer.depth.numpy(), count)


def wall(depth: float, tilt: float = 0.0) -> ToyScene:
    """A large sheet across the optical axis at a depth [m], rotated about the image's columns by `tilt` [rad]."""
    turn = (0.0, np.sin(tilt / 2.0), 0.0, np.cos(tilt / 2.0))
    return one(sheet(4.0, 4.0), (0.0, 0.0, TOP - depth, *turn), VIEW)


def deviation(depth: float, angle: float = 0.0, **given: float) -> float:
    """Axial noise by the law of Nguyen et al. (2012) [m]."""
    law = {"noise": 0.0012, "noise_growth": 0.0019, "noise_distance": 0.4, "noise_angle": 1e-4} | given
    off = depth - law["noise_distance"]
    return law["noise"] + law["noise_growth"] * off**2 + law["noise_angle"] / depth**0.5 * (angle / (np.pi / 2 - angle)) ** 2


@pytest.mark.parametrize("settings", [PERFECT, sensor_settings("ideal")], ids=["perfect", "ideal"])
def test_an_ideal_sensor_measures_the_rendered_depth(device, settings):
    measured = measure(wall(1.3, 0.6), device, **settings)
    np.testing.assert_allclose(measured.counts.astype(int), measured.clean.astype(int), atol=1)
    np.testing.assert_allclose(measured.depth, measured.exact, atol=0.6 * COUNT)


@pytest.mark.parametrize("depth", [0.6, 1.1, 2.0])
def test_axial_noise_grows_with_the_square_of_depth(device, depth):
    noise = {name: getattr(DepthSensor(), name) for name in ("noise", "noise_growth", "noise_angle")}
    measured = measure(wall(depth), device, frames=2, **PERFECT | noise)
    middle = measured.depth[:, 30:66, 50:110]
    # Rays within this window meet the wall at up to 7°, whose part of the noise is below 1 %.
    np.testing.assert_allclose(middle.std(), deviation(depth), rtol=0.03)
    np.testing.assert_allclose(middle.mean(), depth, atol=4.0 * deviation(depth) / middle.size**0.5 + COUNT)
    pairs = measured.depth[0].ravel(), measured.depth[1].ravel()
    assert abs(np.corrcoef(*pairs)[0, 1]) < 0.05


@pytest.mark.parametrize("depth", [0.6, 1.0, 1.95])
@pytest.mark.parametrize("name", [name for name in SENSORS if name != "ideal"])
def test_presets_as_they_are_have_the_noise_of_their_steps_too(device, name, depth):
    """σz = z² √(σd² + step² / 12) / (f b) within the preset's range, and nothing outside."""
    settings, lens = sensor_settings(name), sensor_camera(name)
    assert lens is not None
    toy = replace(wall(depth), cameras=(camera(WIDTH, HEIGHT, lens.fx, (0.0, 0.0, TOP)),))
    middle = measure(toy, device, count=depth / 60000, **settings | {"noise_width": 1}).depth[0, 20:76, 20:140]
    scale, (near, far), most = lens.fx * settings["baseline"], settings["distances"], settings["max_disparity"]
    if not near < depth < far or scale > depth * most > 0.0:
        assert np.isnan(middle).all()
        return
    expected = depth**2 * np.hypot(settings["disparity_noise"], settings["disparity_step"] / 12**0.5) / scale
    np.testing.assert_allclose(middle.std(), expected, rtol=0.05)
    np.testing.assert_allclose(middle.mean(), depth, atol=4.0 * expected / middle.size**0.5 + 2e-3 * depth**2)


def test_no_disparity_beyond_the_search_is_measured(device):
    settings = PERFECT | {"baseline": 0.05, "max_disparity": FOCAL * 0.05 / 1.2}
    assert not measure(wall(1.19), device, **settings).counts.any()
    assert measure(wall(1.21), device, **settings).counts.all()


def test_axial_noise_grows_with_the_angle_of_incidence(device):
    measured = measure(wall(1.5, np.radians(75.0)), device, **PERFECT | {"noise_angle": 1e-3})
    # The column through the optical axis meets the sheet at 75°, and at that depth.
    off = (measured.depth - measured.exact)[0, :, 76:84]
    np.testing.assert_allclose(off.std(), deviation(1.5, np.radians(75.0), noise=0.0, noise_growth=0.0, noise_angle=1e-3), rtol=0.07)
    straight = measure(wall(1.5), device, **PERFECT | {"noise_angle": 1e-3})
    assert np.abs(straight.depth - straight.exact).max() < 2.0 * COUNT


@pytest.mark.parametrize("depth", [0.8, 1.9])
def test_depth_is_quantized_in_steps_of_disparity(device, depth):
    step, baseline = 0.25, 0.06
    measured = measure(wall(depth, 0.5), device, **PERFECT | {"disparity_step": step, "baseline": baseline})
    levels = np.unique(measured.depth)
    number = FOCAL * baseline / (levels * step)
    assert np.abs(number - np.rint(number)).max() < 0.6 * COUNT * number.max() / levels.min()
    near = levels[np.abs(levels - depth) < 0.1]
    expected = near[:-1] * near[1:] * step / (FOCAL * baseline)
    np.testing.assert_allclose(np.diff(near), expected, atol=1.1 * COUNT)
    # Each pixel has the nearest of these levels, by disparity.
    off = FOCAL * baseline * np.abs(1.0 / measured.depth - 1.0 / measured.exact)
    assert off.max() < 0.51 * step


@pytest.mark.parametrize(("tilt", "seen"), [(70.0, True), (84.0, False)])
def test_grazing_incidence_is_invalid(device, tilt, seen):
    measured = measure(wall(1.5, np.radians(tilt)), device, **PERFECT | {"grazing_angle": 78.0})
    assert measured.clean[0, :, 78:82].all()
    assert (measured.counts[0, :, 78:82] > 0).all() == seen
    assert (measured.counts[0, :, 78:82] > 0).any() == seen


def step_scene() -> ToyScene:
    """A wall at 1.5 m, and in front of it, at 1.2 m, a sheet that covers columns 60 to 99 and rows 28 to 67."""
    side = 40.0 / FOCAL * 1.2
    placed = [(0, (0.0, 0.0, TOP - 1.5, *UPRIGHT)), (1, (0.0, 0.0, TOP - 1.2, *UPRIGHT))]
    return ToyScene([entry(sheet(4.0, 4.0)), entry(sheet(side, side))], [placed], (VIEW,))


def test_disparity_discontinuities_are_invalid_on_both_sides(device):
    measured = measure(step_scene(), device, **PERFECT | {"edge_width": 2})
    near = np.abs(measured.exact[0] - 1.2) < 1e-3
    assert near.sum() == 1600
    wide = np.pad(near, 2, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(wide, (5, 5))
    mixed = windows.any(axis=(2, 3)) & ~windows.all(axis=(2, 3))
    np.testing.assert_array_equal(measured.counts[0] == 0, mixed)
    # A threshold above the step of disparity, 400 * 0.075 * (1 / 1.2 - 1 / 1.5) = 5 px, finds no discontinuity.
    assert measure(step_scene(), device, **PERFECT | {"edge_width": 2, "edge_step": 5.1}).counts.all()


def test_projector_shadow_is_invalid(device):
    # The sheet's disparity is larger by 5 px with this baseline, 10 px with twice as much: the shadow's width on the wall, to the left.
    for baseline, width in ((0.075, 5), (0.15, 10)):
        measured = measure(step_scene(), device, **PERFECT | {"shadows": True, "baseline": baseline})
        holes = np.zeros((HEIGHT, WIDTH), bool)
        holes[28:68, 60 - width : 60] = True
        assert (holes != (measured.counts[0] == 0)).sum() <= 40
        assert (measured.counts[0][28:68, 60 - width + 1 : 59] == 0).all()
        assert (measured.counts[0][28:68, 100:] > 0).all()


@pytest.mark.parametrize("registration", [0.2, 0.5, 1.0])
def test_registered_depth_has_shadows_at_both_sides(device, registration):
    # 10 px of disparity: those to the projector, at the right, are hidden at the left, and those to the infrared camera at the right.
    measured = measure(step_scene(), device, **PERFECT | {"shadows": True, "baseline": 0.15, "registration": registration})
    left = round(10 * (1.0 - registration))
    holes = np.flatnonzero(measured.counts[0, 48] == 0)
    expected = [*range(60 - left, 60), *range(100, 110 - left)]
    assert len(set(holes) ^ set(expected)) <= 2


def test_noise_on_a_lattice_keeps_its_variance_and_correlates_neighbours(device):
    noise = {"noise": 0.002, "noise_width": 6}
    measured = measure(wall(1.0), device, frames=40, **PERFECT | noise)
    off = (measured.depth - 1.0)[:, 12:84, 12:148]
    # Each phase of the lattice has the variance of one pixel.
    phases = np.array([[off[:, row::6, column::6].std() for column in range(6)] for row in range(6)])
    np.testing.assert_allclose(phases, 0.002, rtol=0.05)

    def correlation(away: int) -> float:
        return float((off[:, :, away:] * off[:, :, : off.shape[2] - away]).mean() / off.var())

    assert correlation(1) > 0.9
    assert 0.35 < correlation(3) < 0.75
    assert abs(correlation(12)) < 0.05


def test_a_narrow_body_casts_its_shadow_beside_it(device):
    # Two columns wide, 20 px more disparity than the wall: its shadow falls 20 px to the left, and the wall in between is measured.
    bar = sheet(2.0 / FOCAL * 0.75, 0.1)
    placed = [(0, (0.0, 0.0, TOP - 1.5, *UPRIGHT)), (1, (0.0, 0.0, TOP - 0.75, *UPRIGHT))]
    toy = ToyScene([entry(sheet(4.0, 4.0)), entry(bar)], [placed], (VIEW,))
    measured = measure(toy, device, **PERFECT | {"shadows": True})
    holes = np.flatnonzero(measured.counts[0, 48] == 0)
    assert np.abs(measured.exact[0, 48, 79:81] - 0.75).max() < 1e-3
    assert 1 <= len(holes) <= 4
    assert np.abs(holes - 59.5).max() <= 2.0


def test_a_body_around_the_camera_and_out_of_its_sight_changes_nothing(device):
    """Shadows are searched for, and triangles drawn, as if it were not there."""
    toy, around = step_scene(), box(1.8, 1.8, 2.0)
    sides = replace(around, faces=around.faces[np.abs(around.normals[around.faces[:, 0], 2]) < 0.5])
    alone = measure(toy, device)
    toy.entries, toy.placed = [*toy.entries, entry(sides)], [[*toy.placed[0], (2, (0.0, 0.0, TOP, *UPRIGHT))]]
    beside = measure(toy, device)
    np.testing.assert_array_equal(beside.counts, alone.counts)
    np.testing.assert_array_equal(beside.exact, alone.exact)


def test_background_and_depth_out_of_range_are_invalid(device):
    measured = measure(one(box(0.1, 0.1, 0.1), (0.0, 0.0, TOP - 1.0, *UPRIGHT), VIEW), device, **PERFECT)
    np.testing.assert_array_equal(measured.counts > 0, measured.clean > 0)
    assert (measured.counts == 0).any()
    for distances in ((1.2, 5.0), (0.1, 0.5)):
        assert not measure(wall(1.0), device, **PERFECT | {"distances": distances}).counts.any()


def test_lateral_noise_changes_depth_only_near_silhouettes(device):
    measured = measure(step_scene(), device, **PERFECT | {"lateral_noise": 0.7})
    off = np.abs(measured.depth - measured.exact)[0] > 0.1
    assert off[26:70, 58:102].sum() > 50
    assert not off[:24].any()
    assert not off[32:64, 66:94].any()


def test_noise_follows_from_seed_episode_frame_and_camera_alone(device):
    toy = wall(1.2)
    toy.cameras, toy.placed = (VIEW, VIEW), toy.placed * 2
    measured = measure(toy, device, frames=2)
    assert measured.counts.shape == (8, HEIGHT, WIDTH)
    assert len({view.tobytes() for view in measured.counts}) == 8
    np.testing.assert_array_equal(measured.counts, measure(toy, device, frames=2).counts)
    assert (measure(toy, device, seed=1).counts != measured.counts[:4]).any(axis=(1, 2)).all()
    # World 1 alone, as episode 1: its views are those of the batch of both worlds.
    toy.placed = toy.placed[1:]
    np.testing.assert_array_equal(measure(toy, device, first_episode=1).counts, measured.counts[2:4])


def test_default_sensor_measures_most_pixels_accurately(device):
    measured = measure(step_scene(), device)
    seen = measured.counts[0] > 0
    assert 0.85 < seen.mean() < 1.0
    off = (measured.depth - measured.exact)[0]
    # Steps at 1.5 m are 9 mm wide with this short focal length, and noise is 3.5 mm.
    assert np.nanpercentile(np.abs(off), 99) < 0.02
    assert abs(np.nanmean(off)) < 0.003
    # The rendered depth is unchanged.
    np.testing.assert_allclose(measured.clean[0] * COUNT, measured.exact[0], atol=0.51 * COUNT)
