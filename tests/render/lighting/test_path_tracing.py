"""The reference picture: known amounts of light, the same by each way of drawing; and the draws behind it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from synpick_warp.configs.schema import REFERENCE, Config
from synpick_warp.kernels.render.lighting.path_tracing import BY_LIGHT, BY_SURFACE
from synpick_warp.scenes.appearance import linear_to_srgb
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.types import EnvironmentMap, Material
from synpick_warp.stages.render import reference
from synpick_warp.stages.render.chances import build_chances, chance_table
from synpick_warp.stages.render.gloss import measure_gloss
from tests.harness.brdf_probe import evaluated, light_kernel, point_kernel, toward
from tests.worlds.toy_scene import UPRIGHT, ToyScene, ball, box, camera, entry, even_light, render, sheet, sun

VIEW = camera(64, 48, 200.0, (0.0, 0.0, 2.0))
FLAT = (0.0, 0.0, 0.0, *UPRIGHT)
WHITE = (1.0, 1.0, 1.0)
EVEN = even_light()


def settings(samples=32, bounces=4, **bake) -> Config:
    config = Config()
    render_settings = replace(config.render, mode=REFERENCE, samples=samples, bounces=bounces)
    return replace(config, render=render_settings, bake=replace(config.bake, **bake))


def surface(color=WHITE, metallic=0.0, roughness=1.0) -> Material:
    return Material(color=color, texture=None, metallic=metallic, roughness=roughness)


def shown(device, *placed, lights=(EVEN,), view=VIEW, config=None, **more):
    """Picture of (mesh, material, pose), pose left out: in the middle."""
    entries = [entry(mesh, material) for mesh, material, *_ in placed]
    world = [(number, pose[0] if pose else FLAT) for number, (_, _, *pose) in enumerate(placed)]
    return render(ToyScene(entries, [world], (view,), lights=lights, config=config or settings(), **more), device)


def lamp(cosine, radius, radiance, rows=256):
    """A map that is black but for a disc of angular radius `radius` [rad] at azimuth 0, its edge one texel soft."""
    directions, _ = map_directions(rows)
    angle = np.arccos(np.clip(directions @ toward(cosine), -1.0, 1.0))
    share = np.clip((radius - angle) / (np.pi / rows) + 0.5, 0.0, 1.0)
    return EnvironmentMap("lamp", np.repeat(radiance * share[..., None], 3, axis=2).astype(np.float32))


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 0.25, 0.6, 1.0])
def test_a_white_ball_vanishes_in_an_even_room(device, metallic, roughness):
    picture = shown(device, (ball(0.1, 4), surface(WHITE, metallic, roughness)), lights=(even_light(2.0),))
    inside = picture.radiance[0][picture.instance[0] == 1]
    np.testing.assert_allclose(picture.radiance[0, 0, 0], 2.0, rtol=1e-5)
    np.testing.assert_allclose(inside.mean(axis=0), 2.0, rtol=0.01)


def test_white_things_that_light_each_other_vanish_too(device):
    # Light that is reflected many times: roulette and the limit of bounces take none of it away.
    things = [
        (sheet(0.6, 0.4), surface()),
        (box(0.1, 0.1, 0.1), surface(), (0.08, 0.0, 0.055, *UPRIGHT)),
        (box(0.1, 0.1, 0.1), surface(WHITE, 1.0, 0.5), (-0.08, 0.0, 0.055, *UPRIGHT)),
    ]
    even, few = (shown(device, *things, config=settings(bounces=bounces)).radiance for bounces in (32, 1))
    assert even.mean() == pytest.approx(1.0, abs=0.01)
    assert few.mean() < 0.98


def test_roulette_ends_paths_but_takes_no_light(device, monkeypatch):
    grey = surface((float(linear_to_srgb(0.5)),) * 3)
    walls = [(box(0.02, 0.3, 0.2), grey, (x, 0.0, 0.1, *UPRIGHT)) for x in (0.03, -0.03)]
    view = camera(8, 24, 200.0, (0.0, 0.0, 2.0))
    pictures = []
    for roulette in (0, 2, 100):
        monkeypatch.setattr(reference, "ROULETTE", roulette)
        radiance = shown(device, (sheet(0.3, 0.3), grey), *walls, config=settings(1024, 16), view=view).radiance
        # Between the walls, where light comes by several reflections.
        pictures.append(radiance[0, 4:20, 3:5].mean())
    np.testing.assert_allclose(pictures, pictures[-1], rtol=0.02)
    assert pictures[-1] < 0.3


@pytest.mark.parametrize("cosine", [1.0, 0.6, 0.25])
def test_a_plane_under_a_lamp_has_the_irradiance_worked_out_by_hand(device, cosine):
    # A disc of angular radius a and radiance L that is wholly above the horizon: E = π L sin² a cos θ.
    radius, radiance = np.radians(6.0), 50.0
    color = (float(linear_to_srgb(0.5)),) * 3
    view = camera(16, 16, 2000.0, (0.0, 0.0, 2.0))
    picture = shown(device, (sheet(1.0, 1.0), surface(color)), lights=(lamp(cosine, radius, radiance),), view=view, config=settings(64))
    irradiance = np.pi * radiance * np.sin(radius) ** 2 * cosine
    value, _ = evaluated(measure_gloss(device), ((0.5,) * 3, 0.0, 1.0), toward(1.0), toward(cosine))
    np.testing.assert_allclose(picture.radiance[0].mean(axis=(0, 1)), value[0] / cosine * irradiance, rtol=0.01)
    # The law that the irradiance is multiplied by is nearly Lambert's: gloss adds about what it takes from the diffuse part.
    np.testing.assert_allclose(value[0] / cosine, 0.5 / np.pi, rtol=0.1)


def test_each_way_of_drawing_light_has_the_same_mean(device, monkeypatch):
    things = [
        (sheet(0.6, 0.4), surface((0.7, 0.6, 0.5), 0.0, 0.5)),
        (ball(0.06, 3), surface((0.9, 0.8, 0.7), 1.0, 0.35), (0.05, 0.0, 0.06, *UPRIGHT)),
        (box(0.1, 0.1, 0.1), surface((0.3, 0.5, 0.7)), (-0.1, 0.0, 0.05, *UPRIGHT)),
    ]
    radiance = 0.3 * even_light(1.0, 64).radiance + lamp(0.7, np.radians(12.0), 20.0, 64).radiance
    lights = (EnvironmentMap("room", radiance),)
    both = shown(device, *things, lights=lights, config=settings(64), light_yaw=0.7).radiance[0]
    noise = {}
    for strategy in (BY_LIGHT, BY_SURFACE):
        monkeypatch.setattr(reference, "BOTH", strategy)
        alone = shown(device, *things, lights=lights, config=settings(128), light_yaw=0.7).radiance[0]
        np.testing.assert_allclose(alone.mean(axis=(0, 1)), both.mean(axis=(0, 1)), rtol=0.01)
        noise[strategy] = np.abs(alone - both).mean()
    assert noise[BY_LIGHT] < noise[BY_SURFACE]


def test_a_mirror_shows_what_hangs_above_it(device):
    # A black box 0.5 m above the mirror and 0.2 m to the side: its image appears at 0.2 · 2 / 2.5 m, 16 px from the middle.
    things = [(sheet(1.0, 1.0), surface(WHITE, 1.0, 0.0)), (box(0.06, 0.06, 0.06), surface((0.0, 0.0, 0.0)), (0.2, 0.0, 0.5, *UPRIGHT))]
    seen = shown(device, *things).radiance[0, 24, :, 0]
    assert seen[48] < 0.15
    np.testing.assert_allclose(seen[16], 1.0, rtol=0.03)


def test_no_light_leaks_through_from_behind(device):
    # The lamp stands below the sheet's plane, but above that of its tilted interpolated normals.
    tilted = sheet(0.6, 0.4)
    tilted.normals[:] = toward(0.7)
    lights = (lamp(-0.3, np.radians(8.0), 100.0),)
    assert shown(device, (tilted, surface()), lights=lights).radiance[0, 10:38, 10:54].max() == 0.0
    assert shown(device, (sheet(0.6, 0.4), surface()), lights=(lamp(0.3, np.radians(8.0), 100.0),)).radiance[0, 24, 32].min() > 0.1


def test_depth_and_masks_are_those_of_the_fast_picture(device):
    things = [(ball(0.1, 3), surface()), (box(0.1, 0.1, 0.1), surface(), (0.1, 0.0, 0.05, *UPRIGHT))]
    path, fast = shown(device, *things, config=settings(1)), shown(device, *things, config=Config())
    for name in ("depth", "instance", "amodal", "pixels", "boxes"):
        np.testing.assert_array_equal(getattr(path, name), getattr(fast, name))
    assert (path.color != fast.color).any()


def test_a_picture_is_the_same_twice_and_finite(device):
    things = [(ball(0.1, 3), surface(WHITE, 1.0, 0.0)), (box(0.1, 0.1, 0.1), surface(), (0.1, 0.0, 0.05, *UPRIGHT))]
    lights = (sun((0.3, 0.2, 0.8)),)
    first, second, other = (shown(device, *things, lights=lights, table=True, config=settings(4, seed=seed)).radiance for seed in (1, 1, 2))
    assert first.tobytes() == second.tobytes()
    assert first.tobytes() != other.tobytes()
    assert np.isfinite(first).all()
    assert (first >= 0.0).all()


def test_a_map_without_light_makes_a_black_picture(device):
    assert not shown(device, (ball(0.1, 3), surface()), lights=(even_light(0.0),), table=True).radiance.any()


def test_lamps_are_drawn_as_often_as_they_are_bright(device):
    rows = 16
    radiance = np.random.default_rng(0).gamma(0.3, size=(rows, 2 * rows, 1)).astype(np.float32) * np.ones(3, np.float32)
    radiance[3, 5] = 500.0
    chances = build_chances(radiance[None], device)
    share = np.diff(chances.row.numpy()[0])[:, None] * np.diff(chances.column.numpy()[0], axis=1)
    assert share.sum() == pytest.approx(1.0, abs=1e-5)
    assert share[3, 5] == share.max()
    count = 50_000
    numbers = wp.array(np.random.default_rng(1).random((count, 2), dtype=np.float32), dtype=wp.vec2, device=device)
    direction = wp.empty(count, dtype=wp.vec3, device=device)
    drawn, found = (wp.empty(count, dtype=wp.float32, device=device) for _ in range(2))
    wp.launch(light_kernel, count, [chances, numbers], [direction, drawn, found], device=device)
    at = direction.numpy().astype(np.float64)
    row = np.minimum((np.arccos(at[:, 2]) / np.pi * rows).astype(int), rows - 1)
    column = ((np.arctan2(at[:, 1], at[:, 0]) / (2 * np.pi) + 0.5) * 2 * rows).astype(int) % (2 * rows)
    seen = np.bincount(row * 2 * rows + column, minlength=share.size)
    expected = count * share.reshape(-1)
    large = expected > 10.0
    assert ((seen - expected)[large] ** 2 / expected[large]).sum() < large.sum() + 5.0 * np.sqrt(2.0 * large.sum())
    # Density is chance by solid angle, and the same whichever way it is asked for; but for directions on a texel's edge.
    _, solid = map_directions(rows)
    np.testing.assert_allclose(drawn.numpy(), (share / solid)[row, column], rtol=1e-3, atol=1e-6)
    assert (np.abs(found.numpy() - drawn.numpy()) <= 1e-4 * drawn.numpy()).mean() > 0.999


@pytest.mark.parametrize("black", [False, True])
@pytest.mark.parametrize("table", [False, True])
def test_nothing_below_the_horizon_of_a_table_is_drawn(device, table, black):
    rows = 16
    radiance = np.random.default_rng(3).gamma(0.5, size=(rows, 2 * rows, 3)).astype(np.float32) * (not black)
    made = chance_table(radiance, table)
    assert (np.diff(made.row) >= 0.0).all()
    assert (np.diff(made.column, axis=1) >= 0.0).all()
    assert made.row[0] == 0.0
    assert made.row[-1] == 1.0
    assert (made.column[:, 0] == 0.0).all()
    assert (made.column[:, -1] == 1.0).all()
    share = np.diff(made.row)[:, None] * np.diff(made.column, axis=1)
    assert share.sum() == pytest.approx(1.0, abs=1e-5)
    # One row below the horizon is left: interpolation carries light across it.
    assert (share[rows // 2 + 1 :].max() == 0.0) == table
    # Light that counts is drawn, however little it is.
    assert (share[: rows // 2 + 1] > 0.0).all()
    # Low light counts less: LOW_SHARE of it at the horizon, and the more the higher.
    if black:
        density = share[:, 0] / map_directions(rows)[1][:, 0]
        assert (np.diff(density[: rows // 2]) < 0.0).all()
    count = 20_000
    numbers = wp.array(np.random.default_rng(1).random((count, 2), dtype=np.float32), dtype=wp.vec2, device=device)
    direction = wp.empty(count, dtype=wp.vec3, device=device)
    drawn, found = (wp.empty(count, dtype=wp.float32, device=device) for _ in range(2))
    wp.launch(light_kernel, count, [build_chances(radiance[None], device, table), numbers], [direction, drawn, found], device=device)
    assert (drawn.numpy() > 0.0).all()
    lowest = direction.numpy()[:, 2].min()
    assert lowest >= -np.sin(np.pi / rows) - 1e-6 if table else lowest < -0.9
    # The mean of 1 / density is the solid angle that can be drawn.
    solid = map_directions(rows)[1][: rows // 2 + 1 if table else rows].sum()
    inverse = 1.0 / drawn.numpy().astype(np.float64)
    assert abs(inverse.mean() - solid) < 5.0 * inverse.std() / np.sqrt(count)


def points(device, key: int, dimension: int, count: int = 256) -> np.ndarray:
    made = wp.empty(count, dtype=wp.vec2, device=device)
    wp.launch(point_kernel, count, [wp.uint64(key), dimension], [made], device=device)
    return made.numpy()


def test_points_fill_the_square_evenly(device):
    for key, dimension in ((1, 0), (1, 1), (2, 0)):
        for part in points(device, key, dimension).reshape(4, 64, 2):
            assert len({tuple(cell) for cell in (part * 8).astype(int)}) == 64
            assert all(len(set((part[:, axis] * 64).astype(int))) == 64 for axis in (0, 1))


def test_points_of_other_dimensions_and_keys_are_unrelated(device):
    # Of 256 pairs of independent numbers the correlation is about 1/16. Owen's scrambling flips the first digit of two neighbours
    # together, which makes it 1.2 times as much; pairs that are related have 0.5 and more.
    made = np.array([points(device, key, dimension) for key in range(1, 21) for dimension in range(3)])
    correlation = np.corrcoef(np.concatenate([made[..., 0], made[..., 1]]))
    other = np.abs(correlation[np.triu_indices(len(correlation), 1)])
    assert np.sqrt((other**2).mean()) < 1.5 / 16.0
    assert other.max() < 0.5
