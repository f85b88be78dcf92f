"""The fast picture: known amounts of light, and how near it comes to the reference."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import warp as wp

from synpick_warp.arrays import allocate
from synpick_warp.configs.schema import FAST, REFERENCE, Config
from synpick_warp.scenes.appearance import linear_to_srgb
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.sun import MAX_SUN_ANGULAR_RADIUS
from synpick_warp.scenes.types import Catalog, EnvironmentMap, Material
from synpick_warp.stages.buffers import ViewBuffers
from synpick_warp.stages.render.gloss import measure_gloss
from synpick_warp.stages.render.light_tables import light_table
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.render.view_setup import make_views
from tests.harness.brdf_probe import evaluated, toward
from tests.worlds.toy_scene import UPRIGHT, ToyScene, ball, box, camera, entry, even_light, render, sheet, snapshot, sun

VIEW = camera(64, 48, 200.0, (0.0, 0.0, 2.0))
FLAT = (0.0, 0.0, 0.0, *UPRIGHT)
WHITE = (1.0, 1.0, 1.0)
EVEN = even_light()
HALF = (float(linear_to_srgb(0.5)),) * 3


def settings(mode=FAST, **render_settings) -> Config:
    return replace(Config(), render=replace(Config().render, mode=mode, **render_settings))


def surface(color=WHITE, metallic=0.0, roughness=1.0) -> Material:
    return Material(color=color, texture=None, metallic=metallic, roughness=roughness)


def shown(device, *placed, lights=(EVEN,), view=VIEW, config=None, **more):
    """Picture of (mesh, material, pose), pose left out: in the middle."""
    entries = [entry(mesh, material) for mesh, material, *_ in placed] or [entry(sheet(0.1, 0.1))]
    world = [(number, pose[0] if pose else FLAT) for number, (_, _, *pose) in enumerate(placed)]
    return render(ToyScene(entries, [world], (view,), lights=lights, config=config or settings(), **more), device)


def lamp(cosine: float, radius: float, radiance: float, sky: float = 0.0, rows: int = 256) -> EnvironmentMap:
    """An even sky with a disc of angular radius `radius` [rad] at azimuth 0, its edge one texel soft."""
    directions, _ = map_directions(rows)
    angle = np.arccos(np.clip(directions @ toward(cosine), -1.0, 1.0))
    share = np.clip((radius - angle) / (np.pi / rows) + 0.5, 0.0, 1.0)
    return EnvironmentMap("lamp", np.repeat(sky + radiance * share[..., None], 3, axis=2).astype(np.float32))


def clutter() -> list:
    """Boxes, balls and a plane of several materials, close together."""
    return [
        (sheet(0.6, 0.5), surface((0.8, 0.75, 0.7), 0.0, 0.7)),
        (box(0.08, 0.06, 0.1), surface((0.2, 0.5, 0.8), 0.0, 0.5), (0.06, 0.03, 0.05, *UPRIGHT)),
        (ball(0.045, 3), surface((0.9, 0.8, 0.5), 1.0, 0.4), (-0.05, 0.02, 0.045, *UPRIGHT)),
        (box(0.05, 0.12, 0.03), surface((0.8, 0.2, 0.2), 0.0, 0.9), (-0.02, -0.07, 0.015, 0.0, 0.0, np.sin(0.3), np.cos(0.3))),
    ]


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """[dB], white being the radiance of a white plane under a map of radiance 1."""
    return float(-10.0 * np.log10(np.mean((np.clip(a, 0.0, 1.0) - np.clip(b, 0.0, 1.0)) ** 2)))


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 0.25, 0.6, 1.0])
def test_a_white_ball_vanishes_in_an_even_room(device, metallic, roughness):
    view = camera(128, 96, 500.0, (0.0, 0.0, 2.0))
    picture = shown(device, (ball(0.1, 4), surface(WHITE, metallic, roughness)), lights=(even_light(2.0),), view=view)
    inside = picture.radiance[0][picture.instance[0] == 1]
    np.testing.assert_allclose(picture.radiance[0, 0, 0], 2.0, rtol=1e-5)
    np.testing.assert_allclose(inside.mean(axis=0), 2.0, rtol=0.01)


@pytest.mark.parametrize("table", [False, True])
def test_a_grey_plane_under_an_even_map_is_that_of_the_reference(device, table):
    things = (sheet(0.6, 0.5), surface(HALF, 0.0, 0.7))
    fast, path = (
        shown(device, things, table=table, config=settings(mode, cell_paths=16)).radiance.mean(axis=(0, 1, 2)) for mode in (FAST, REFERENCE)
    )
    np.testing.assert_allclose(fast, path, rtol=0.01)
    np.testing.assert_allclose(fast, 0.5, rtol=0.1)


@pytest.mark.parametrize("cosine", [1.0, 0.6, 0.25])
@pytest.mark.parametrize("degrees", [2.0, 3.5, 6.0, 12.0])
def test_a_plane_under_a_lamp_has_the_irradiance_worked_out_by_hand(device, cosine, degrees):
    # A disc of angular radius a and radiance L that is wholly above the horizon: E = π L sin² a cos θ. Narrow ones have rays of their
    # own, wide ones do not; a lamp of 8 times the even light at most is taken whole.
    radius = np.radians(degrees)
    radiance = 3.0 / (np.pi * np.sin(radius) ** 2)
    light = lamp(cosine, radius, radiance)
    view = camera(64, 48, 2000.0, (0.0, 0.0, 2.0))
    picture = shown(device, (sheet(1.0, 1.0), surface(HALF)), lights=(light,), view=view, config=settings(cell_paths=32))
    value, _ = evaluated(measure_gloss(device), ((0.5,) * 3, 0.0, 1.0), toward(1.0), toward(cosine))
    np.testing.assert_allclose(picture.radiance[0].mean(axis=(0, 1)), value[0] * 3.0, rtol=0.02)


@pytest.mark.parametrize(("degrees", "split"), [(1.0, True), (3.0, True), (6.0, False), (12.0, False)])
def test_wide_lamps_are_not_split(degrees, split):
    light = lamp(0.7, np.radians(degrees), 200.0, 0.2)
    table = light_table(light, None)
    assert (table.main_irradiance.max() > 0.0) == split
    assert (table.main_spread <= MAX_SUN_ANGULAR_RADIUS) == split
    assert (table.rest.max() < 10.0) == split
    # Split or not, no light is lost or counts twice.
    directions, solid = map_directions(len(table.rest))
    for normal in (toward(1.0), toward(0.5, 1.0), toward(0.7, -0.4)):
        cosine = np.maximum(directions @ normal, 0.0) * solid
        whole, rest = ((image * cosine[..., None]).sum(axis=(0, 1)) for image in (table.background, table.rest))
        main = table.main_irradiance * max(float(normal @ table.main_direction), 0.0)
        np.testing.assert_allclose(rest + main, whole, rtol=5e-3)


def test_a_cluttered_scene_is_that_of_the_reference(device):
    view = camera(160, 120, 700.0, (0.0, 0.0, 1.5))
    lights = (EnvironmentMap("room", 0.4 * even_light(1.0, 64).radiance + lamp(0.8, np.radians(14.0), 8.0, rows=64).radiance),)
    path = shown(device, *clutter(), lights=lights, view=view, config=settings(REFERENCE, samples=256)).radiance[0]
    near = {}
    for paths in (1, 4, 16):
        fast = shown(device, *clutter(), lights=lights, view=view, config=settings(cell_paths=paths)).radiance[0]
        near[paths] = psnr(fast, path)
        if paths > 1:
            np.testing.assert_allclose(fast.mean(axis=(0, 1)), path.mean(axis=(0, 1)), rtol=0.015)
    # More paths come nearer. Without any filter one path has 20 dB and four have 28; with blocks of 4 x 4 cells alone 29 and 36.
    assert near[1] < near[4] < near[16]
    assert near[1] > 33.0
    assert near[4] > 37.0


def test_two_frames_of_a_still_scene_are_identical(device):
    """Not even scratch of another scene's frame in between shows."""
    toy = ToyScene([entry(mesh, material) for mesh, material, *_ in clutter()], [[], []], (VIEW,), lights=(sun((0.5, 0.2, 0.8), rows=256),))
    toy.placed[0] = [(number, pose[0] if pose else FLAT) for number, (_, _, *pose) in enumerate(clutter())][1:]
    toy.placed[1] = [(0, (0.0, 0.0, 0.2, *UPRIGHT))]
    toy.config = settings(cell=4)
    scene = build_render_scene(toy.settings(), Catalog(tuple(toy.entries)), toy.fixtures, toy.cameras, toy.lights, device)
    renderer = Renderer(toy.settings(), scene, toy.room, 1)
    sizes = {"view": 1, "row": scene.height, "column": scene.width, "instance": toy.room, "count": 3, "box": 2, "side": 4}
    out = allocate(ViewBuffers, sizes, device)
    state, camera_zero, made = snapshot(toy, device), wp.zeros(1, dtype=wp.int32, device=device), []
    for world in (0, 1, 0, 0):
        views = make_views(wp.array([world], dtype=wp.int32, device=device), camera_zero, 1, toy.room)
        renderer.render(state, views, out)
        made.append(renderer.image.radiance.numpy().copy())
    assert made[0].tobytes() != made[1].tobytes()
    assert made[0].tobytes() == made[2].tobytes() == made[3].tobytes()


@pytest.mark.parametrize("cell", [0, 1, 2, 4, 7])
@pytest.mark.parametrize("size", [(64, 48), (61, 35), (3, 5), (1, 1)])
def test_cells_and_images_of_any_size_make_a_picture(device, cell, size):
    view = camera(*size, 4.0 * size[0], (0.0, 0.0, 2.0))
    picture = shown(device, *clutter(), lights=(sun((0.5, 0.2, 0.8)),), view=view, table=True, config=settings(cell=cell))
    assert picture.radiance.shape[1:3] == size[::-1]
    assert np.isfinite(picture.radiance).all()
    assert (picture.radiance > 0.0).all()


@pytest.mark.parametrize("cell", [1, 2, 4])
def test_wider_cells_have_the_same_light(device, cell):
    view = camera(160, 120, 700.0, (0.0, 0.0, 1.5))
    fine, wide = (shown(device, *clutter(), view=view, config=settings(cell=size, cell_paths=8)).radiance[0] for size in (1, cell))
    np.testing.assert_allclose(wide.mean(axis=(0, 1)), fine.mean(axis=(0, 1)), rtol=0.015)
    assert psnr(wide, fine + 1e-6) > 28.0


@pytest.mark.parametrize("light", [EVEN, sun((0.3, 0.2, 0.8))])
def test_things_smaller_than_a_cell_are_lit(device, light):
    # 3 px in cells of 16 px, over background: no cell's middle lies on it.
    thing = (sheet(0.03, 0.03), surface(HALF), (0.055, 0.035, 0.0, *UPRIGHT))
    small, fine = (shown(device, thing, lights=(light,), config=settings(cell=size, cell_paths=16)) for size in (16, 1))
    seen = small.instance[0] == 1
    assert 4 <= seen.sum() <= 16
    np.testing.assert_allclose(small.radiance[0][seen].mean(), fine.radiance[0][seen].mean(), rtol=0.05)


def test_only_background_and_only_table(device):
    light = sun((0.3, 0.2, 0.8))
    nothing, table = (shown(device, lights=(light,), table=table).radiance[0] for table in (False, True))
    np.testing.assert_allclose(nothing[0, 0], 0.3, rtol=1e-5)
    assert (shown(device, lights=(light,)).instance == 0).all()
    # The table is an open plane: even.
    assert (table.std(axis=(0, 1)) < 0.02 * table.mean(axis=(0, 1))).all()
    with_paths = shown(device, lights=(light,), table=True, config=settings(REFERENCE, samples=256)).radiance[0]
    np.testing.assert_allclose(table.mean(axis=(0, 1)), with_paths.mean(axis=(0, 1)), rtol=0.02)


@pytest.mark.parametrize("turn", [0.0, np.pi / 2, 2.0])
def test_a_main_lights_shadow_edge_lies_where_geometry_says(device, turn):
    # A sheet 0.2 m across floats 0.1 m above another; the sun stands at 45°: its shadow is as large, 0.1 m away from the sun.
    view = camera(160, 160, 400.0, (0.0, 0.0, 2.0))
    things = [(sheet(2.0, 2.0), surface(HALF)), (sheet(0.06, 0.06), surface(HALF), (0.0, 0.0, 0.1, *UPRIGHT))]
    light = sun((1.0, 0.0, 1.0), rows=256, strength=6000.0)
    found = light_table(light, None)
    direction = found.main_direction
    assert found.main_irradiance.max() > 0.0
    lit = shown(device, *things, lights=(light,), view=view, light_yaw=turn, config=settings(cell_paths=16))
    ground = lit.instance[0] == 1
    rows, columns = np.mgrid[:160, :160]
    x, y = (columns + 0.5 - 80.0) / 200.0, -(rows + 0.5 - 80.0) / 200.0
    offset = (
        -0.1
        / direction[2]
        * np.array([np.cos(turn) * direction[0] - np.sin(turn) * direction[1], np.sin(turn) * direction[0] + np.cos(turn) * direction[1]])
    )
    # How far inside the shadow's square, negative outside [m]; the filter blurs the edge by 2 px to either side, the sun by less.
    inside = 0.03 - np.maximum(np.abs(x - offset[0]), np.abs(y - offset[1]))
    value = lit.radiance[0, ..., 0]
    blur = 3.5 / 200.0
    dark, bright = value[ground & (inside > blur)], value[ground & (inside < -blur) & (np.hypot(x, y) > 0.12)]
    assert len(dark) > 20
    middle = 0.5 * (dark.mean() + bright.mean())
    assert dark.max() < middle < bright.min()
    # The edge itself: as many pixels are darker than half as the square has.
    np.testing.assert_allclose((value[ground] < middle).sum(), (ground & (inside > 0.0)).sum(), rtol=0.12)


def test_scratch_follows_the_scenes_image_whatever_the_setting_says(device):
    config = replace(settings(cell=4), cameras=replace(Config().cameras, resolution=(8, 8)))
    scene = build_render_scene(config, Catalog((entry(sheet(0.1, 0.1)),)), ToyScene([], [], ()).fixtures, (VIEW,), (EVEN,), device)
    shading = Renderer(config, scene, 1, 2).shading
    assert shading.guide.segment.shape == shading.shares.gloss.shape == (2, 12, 16)
    assert shading.shadows.smooth.shape == (2, 24, 32)


def test_edges_of_a_dark_pit_do_not_take_the_light_of_its_rim(device):
    """Pixels of a pit's floor next to its rim, none of whose four cells lies on the floor."""
    rim = [
        (sheet(*size), surface(HALF), (sign * x, sign * y, 0.4, *UPRIGHT))
        for size, x, y in (((0.4, 0.8), 0.27, 0.0), ((0.14, 0.4), 0.0, 0.27))
        for sign in (-1.0, 1.0)
    ]
    things = [(sheet(0.5, 0.5), surface(HALF), (0.0, 0.0, 0.0, *UPRIGHT)), *rim]
    view = camera(64, 48, 300.0, (0.0, 0.0, 2.0))
    fast, path = (
        shown(device, *things, view=view, room=5, config=settings(mode, cell=5, cell_paths=16, samples=256)) for mode in (FAST, REFERENCE)
    )
    floor = fast.instance[0] == 1
    bright = [np.quantile(picture.radiance[0][floor].mean(axis=-1), 0.98) for picture in (fast, path)]
    assert bright[0] < 1.1 * bright[1]


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_a_slope_that_only_a_sunlit_one_lights_is_as_bright_as_in_the_reference(device, metallic):
    """A valley under a low sun and a nearly black sky: the slope that turns away has light from the other one alone, diffuse or gloss."""
    half = np.pi / 8
    slopes = [
        (sheet(0.2, 0.3), surface((0.9, 0.9, 0.9), share), (side * 0.0707, 0.0, 0.0707, 0.0, side * -np.sin(half), 0.0, np.cos(half)))
        for side, share in ((-1, metallic), (1, 0.0))
    ]
    low_sun = (sun((-0.9, 0.0, 0.3), sky=0.002),)
    configs = (settings(cell_paths=16, cell=1), settings(REFERENCE, samples=256))
    fast, reference = (shown(device, *slopes, lights=low_sun, config=config) for config in configs)
    for instance in (1, 2):
        inside = cv2.erode((fast.instance[0] == instance).astype(np.uint8), np.ones((3, 3))) > 0
        seen = [picture.radiance[0][inside].mean() for picture in (fast, reference)]
        assert seen[0] == pytest.approx(seen[1], rel=0.05)


@pytest.mark.parametrize("roughness", [0.2, 0.5])
@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_a_small_lamp_shines_on_gloss_as_in_the_reference(device, metallic, roughness):
    """Beside its highlight, and in it."""
    plate = (sheet(0.3, 0.2), surface((0.8, 0.8, 0.8), metallic, roughness))
    for cosine in (0.9, 0.99):
        light = (lamp(cosine, np.radians(2.0), 500.0, 0.01),)
        configs = (settings(cell_paths=16, cell=1), settings(REFERENCE, samples=256))
        fast, reference = (shown(device, plate, lights=light, config=config) for config in configs)
        inside = cv2.erode((fast.instance[0] == 1).astype(np.uint8), np.ones((5, 5))) > 0
        assert fast.radiance[0][inside].mean() == pytest.approx(reference.radiance[0][inside].mean(), rel=0.02)
