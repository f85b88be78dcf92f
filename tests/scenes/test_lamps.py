"""Sun and lamp extraction, and suns of sIBL sets: direction, irradiance, sample points, and that no light is lost or counts twice."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.scenes.environment import (
    BACKGROUND_ROWS,
    LAMP_RADIUS,
    LUMINANCE,
    MAX_SUN_TANGENT,
    MIN_LAMP_SHARE,
    SOLAR_TANGENT,
    WHITE_VALUE,
    draw_sun_disc,
    extract_lamps,
    extract_sun,
    map_directions,
    replace_sun,
    resize_map,
    sample_disc,
    stratify_light,
)
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.types import EnvironmentMap, Sun
from synpick_warp.stages.render.light_tables import precompute_environment, sh_basis
from tests.worlds.shapes import UPRIGHT, camera, entry, sheet
from tests.worlds.toy_scene import ToyScene, render

ROWS = 64


EVEN = np.ones((8, 16, 3), np.float32)


def bright_picture(u: float, v: float, value: float = 200.0) -> np.ndarray:
    """A dim map with a bright pixel at image coordinates u (right) and v (down) in 0..1."""
    image = np.full((ROWS, 2 * ROWS, 3), 0.5, np.float32)
    image[int(v * ROWS), int(u * 2 * ROWS)] = value
    return image


def loaded(folder, lines: str, image: np.ndarray) -> EnvironmentMap:
    """Load a set with these lines in its section Sun."""
    assert cv2.imwrite(str(folder / "ref.hdr"), image[..., ::-1].copy())
    (folder / "room.ibl").write_text(f'[Reflection]\nREFfile = "ref.hdr"\n[Sun]\n{lines}')
    (light,) = load_lights(str(folder))
    return light


@given(u=st.floats(0.0, 0.999), v=st.floats(0.03, 0.47))
def test_the_sun_of_a_set_is_at_the_bright_pixel_of_its_map(u, v, tmp_path_factory):
    light = loaded(tmp_path_factory.mktemp("set"), f"SUNu = {u}\nSUNv = {v}\n", bright_picture(u, v))
    brightest = np.unravel_index(light.radiance.sum(axis=2).argmax(), light.radiance.shape[:2])
    assert light.sun is not None
    # Half a texel's diagonal.
    assert map_directions(ROWS)[0][brightest] @ light.sun.direction >= np.cos(np.pi / ROWS / np.sqrt(2.0)) - 1e-6


def test_colour_is_srgb_and_multi_is_the_radiance_of_a_white_surface(tmp_path):
    sun = loaded(tmp_path, "SUNcolor = 255,188,0\nSUNmulti = 1.5\nSUNu = 0.5\nSUNv = 0.2\n", EVEN).sun
    np.testing.assert_allclose(sun.irradiance / np.pi, (1.5, 1.5 * srgb_to_linear(188 / 255), 0.0))
    plain = loaded(tmp_path, "SUNu = 0.5\nSUNv = 0.2\n", EVEN).sun
    np.testing.assert_allclose(plain.irradiance / np.pi, 1.0)


@pytest.mark.parametrize(
    "lines",
    [
        "",
        "SUNcolor = 9,9,9\n",
        "SUNu = 0.5\nSUNv = 0.5\n",
        "SUNu = 0.5\nSUNv = 0.7\n",
        "SUNu = 0.5\nSUNv = 0.2\nSUNmulti = 0\n",
        "SUNu = 0.5\nSUNv = 0.2\nSUNmulti = 1e-300\n",
        "SUNu = 0.5\nSUNv = 0.2\nSUNcolor = 0, 0, 0\n",
    ],
)
def test_sets_without_a_sun(tmp_path, lines):
    assert loaded(tmp_path, lines, EVEN).sun is None


@pytest.mark.parametrize(("degrees", "believed"), [(0.0, True), (7.0, True), (14.0, False), (90.0, False)])
def test_a_sun_that_misses_the_maps_bright_place_is_ignored(tmp_path, degrees, believed):
    u, v = 0.30 + 0.5 / (2 * ROWS), 0.4
    light = loaded(tmp_path, f"SUNu = {u}\nSUNv = {v - degrees / 180 if degrees < 45 else 1 - v}\n", bright_picture(u, v))
    assert (light.sun is not None) == believed


def test_any_bright_place_of_the_map_supports_a_sun(tmp_path):
    image = bright_picture(0.2, 0.3, 4.0)
    image[int(0.3 * ROWS), int(0.8 * 2 * ROWS)] = 3.0
    assert loaded(tmp_path, "SUNu = 0.8\nSUNv = 0.3\n", image).sun is not None
    assert loaded(tmp_path, "SUNu = 0.5\nSUNv = 0.3\n", image).sun is None


def test_the_real_set(real_lights):
    """Kiara's sun stands 2° from the brightest pixel of its map, and is brighter and yellower than what the camera clipped."""
    light = next(light for light in load_lights(str(real_lights)) if light.sun is not None)
    assert light.name == "Kiara_Dawn"
    assert light.sun is not None
    brightest = np.unravel_index((light.radiance @ LUMINANCE).argmax(), light.radiance.shape[:2])
    assert light.sun.direction @ map_directions(512)[0][brightest] > np.cos(np.radians(3.0))
    np.testing.assert_allclose(light.sun.irradiance / np.pi, 1.5 * srgb_to_linear(np.array((255, 214, 170)) / 255))
    table, alone = precompute_environment(light, None), precompute_environment(EnvironmentMap("kiara", light.radiance), None)
    # The glow around it is wide: it is drawn into the map, of which its brightest part is a lamp. Facing it is as bright as the set says.
    replaced = replace_sun(alone.radiance.astype(np.float64), light.sun)
    assert replaced.radius_tangent > MAX_SUN_TANGENT
    (glow,) = table.lamps
    assert glow.direction @ light.sun.direction > np.cos(np.radians(10.0))
    np.testing.assert_allclose(facing(table.lampless, glow.direction) + glow.irradiance, facing(table.radiance, glow.direction), rtol=3e-3)
    rest = replaced.rest
    gained = facing(table.radiance, light.sun.direction) - facing(rest, light.sun.direction)
    np.testing.assert_allclose(gained, light.sun.irradiance, rtol=0.01)
    assert facing(table.radiance, light.sun.direction) @ LUMINANCE > facing(alone.radiance, light.sun.direction) @ LUMINANCE


def clipped(direction, radius: float = 3.0, value: float = 20.0, rows: int = 128) -> np.ndarray:
    """A dim map with a white disc about a direction, as cameras clip suns; `radius` [°]."""
    towards = map_directions(rows)[0] @ direction
    return np.where(towards[..., None] > np.cos(np.radians(radius)), value, 0.5).astype(np.float32) * np.ones(3, np.float32)


def facing(radiance: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Irradiance (3) from a map on a surface with this normal, texel by texel."""
    towards, solid = map_directions(len(radiance))
    return (radiance * (np.maximum(towards @ normal, 0.0) * solid)[..., None]).sum(axis=(0, 1))


SUN = Sun(np.array([0.48, -0.64, 0.6]), np.array([30.0, 20.0, 10.0]))
WITH_SUN = EnvironmentMap("set", clipped(SUN.direction), SUN)
"""A map with a clipped disc where its set has the sun."""


def test_a_plane_that_faces_the_sun_receives_the_sun_and_the_rest_once():
    """The clipped disc is gone from diffuse light, reflections and background; the sun stands there instead."""
    table = precompute_environment(WITH_SUN, None)
    (sun,) = table.lamps
    np.testing.assert_allclose(sun.direction, SUN.direction, rtol=1e-6)
    np.testing.assert_allclose(sun.irradiance, SUN.irradiance, rtol=1e-6)
    assert (sun.points @ sun.direction).min() > 1.0 / np.sqrt(1.0 + sun.radius_tangent**2)
    assert 0.05 < sun.radius_tangent < 0.09
    rest, _, taken, _ = extract_sun(WITH_SUN.radiance.astype(np.float64), SUN.direction)
    assert taken.min() > 0.1
    around = facing(rest, SUN.direction)
    diffuse = sh_basis(SUN.direction) @ table.irradiance
    np.testing.assert_allclose(diffuse, around, rtol=0.03)
    np.testing.assert_allclose(diffuse + sun.irradiance, around + SUN.irradiance, rtol=0.01)
    np.testing.assert_allclose(facing(table.radiance, SUN.direction), around + SUN.irradiance, rtol=0.01)
    assert table.prefiltered.max() < 3.0
    # Exposure includes the sun; from below comes what the table sends back, which is all that a downward plane sees.
    upward = facing(table.radiance, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(table.exposure, WHITE_VALUE * np.pi / (upward @ LUMINANCE), rtol=0.01)
    ground = np.array([0.2, 0.3, 0.4])
    below = sh_basis(np.array([0.0, 0.0, -1.0])) @ precompute_environment(WITH_SUN, ground).irradiance
    np.testing.assert_allclose(below, ground * upward, rtol=0.1)
    # Without lamps the sun stays in the map.
    lampless = precompute_environment(WITH_SUN, None, max_lamps=0)
    assert lampless.lamps == []
    np.testing.assert_array_equal(lampless.lampless, lampless.radiance)
    np.testing.assert_array_equal(lampless.radiance, table.radiance)


def test_a_map_with_an_unclipped_sun_keeps_its_luminance():
    weak = Sun(SUN.direction, SUN.irradiance * 1e-4)
    light = EnvironmentMap("set", clipped(SUN.direction, value=4000.0), weak)
    taken = extract_sun(resize_map(light.radiance, BACKGROUND_ROWS), SUN.direction)[2]
    (sun,) = precompute_environment(light, None).lamps
    np.testing.assert_allclose(sun.irradiance @ LUMINANCE, taken @ LUMINANCE, rtol=1e-4)
    np.testing.assert_allclose(sun.irradiance / sun.irradiance[0], weak.irradiance / weak.irradiance[0], rtol=1e-5)


def test_a_sun_over_an_even_map_is_as_wide_as_the_sun():
    table = precompute_environment(EnvironmentMap("set", np.ones((64, 128, 3), np.float32), SUN), None)
    assert table.lamps[0].radius_tangent == pytest.approx(SOLAR_TANGENT)
    np.testing.assert_allclose(sh_basis(SUN.direction) @ table.irradiance, np.pi, rtol=1e-3)


@given(z=st.floats(1e-3, 1.0), azimuth=st.floats(-np.pi, np.pi), spread=st.floats(0.0, 0.5))
def test_a_sun_disc_has_its_irradiance_and_stays_above_the_horizon(z, azimuth, spread):
    across = np.sqrt(1.0 - z * z)
    direction = np.array([across * np.cos(azimuth), across * np.sin(azimuth), z])
    disc = draw_sun_disc(np.zeros((ROWS, 2 * ROWS), bool), direction, SUN.irradiance, spread)
    np.testing.assert_allclose(facing(disc, direction), SUN.irradiance)
    assert not disc[ROWS // 2 :].any()
    towards = map_directions(ROWS)[0][disc[..., 0] > 0.0] @ direction
    assert towards.min() > np.cos(max(np.arctan(spread), np.pi / ROWS)) - 1e-9


def test_hills_occlude_their_part_of_the_disc():
    """The half of the map on the +y side is dark: all light comes from the other, and as much as before."""
    direction = np.array([0.8, 0.0, 0.6])
    bright = map_directions(ROWS)[0][..., 1] < 0.0
    disc = draw_sun_disc(bright, direction, SUN.irradiance, 0.2)
    np.testing.assert_allclose(facing(disc, direction), SUN.irradiance)
    assert not disc[~bright].any()
    whole = draw_sun_disc(np.ones_like(bright), direction, SUN.irradiance, 0.2)
    assert (disc[..., 0] > 0.0).sum() == (whole[..., 0] > 0.0).sum() / 2
    # A sun wholly behind them is believed all the same.
    np.testing.assert_allclose(draw_sun_disc(np.zeros_like(bright), direction, SUN.irradiance, 0.2), whole)


def test_without_a_set_the_bright_place_of_the_map_is_a_lamp():
    light = EnvironmentMap("map", clipped(SUN.direction))
    table = precompute_environment(light, None)
    (sun,) = table.lamps
    assert sun.direction @ SUN.direction > np.cos(np.radians(2.0))
    np.testing.assert_array_equal(table.radiance, resize_map(light.radiance, BACKGROUND_ROWS).astype(np.float32))
    np.testing.assert_allclose(facing(table.lampless, sun.direction) + sun.irradiance, facing(table.radiance, sun.direction), rtol=1e-3)


def test_the_sun_of_a_set_casts_a_shadow_in_its_colour(device):
    """A small sheet 0.1 m above a large one; the set's sun at 45° over +x, red, over an even map: light returns where it does not reach."""
    view = camera(64, 48, 200.0, (0.0, 0.0, 2.0))
    flat, above = (0.0, 0.0, 0.0, *UPRIGHT), (0.0, 0.0, 0.1, *UPRIGHT)
    entries = [entry(sheet(0.6, 0.4)), entry(sheet(0.04, 0.04))]
    sun = Sun(np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0), np.array([4.0, 0.0, 0.0]))
    lights = (EnvironmentMap("set", np.ones((64, 128, 3), np.float32), sun),)
    lit = render(ToyScene(entries, [[(0, flat), (1, above)]], (view,), lights=lights), device).radiance[0]
    assert lit[24, 22, 0] < 0.7 * lit[24, 42, 0]
    np.testing.assert_allclose(lit[24, 22, 1:], lit[24, 42, 1:], rtol=0.1)


# ---- lamps ----


LAMP_ROWS = 128
DIRECTIONS = map_directions(LAMP_ROWS)[0]


def toward(polar: float, azimuth: float = 0.0) -> np.ndarray:
    """Unit direction (3) at a polar angle and an azimuth [°]."""
    p, a = np.radians([polar, azimuth])
    return np.array([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)])


def room(*discs: tuple[np.ndarray, float, float], wall: float = 0.2) -> np.ndarray:
    """A map of constant radiance `wall` with discs (direction, angular radius [°], radiance)."""
    radiance = np.full((LAMP_ROWS, 2 * LAMP_ROWS, 3), wall)
    for direction, radius, value in discs:
        radiance[np.cos(np.radians(radius)) < DIRECTIONS @ direction] = value
    return radiance


def test_lamps_have_the_directions_and_the_light_of_the_discs_strongest_first():
    discs = [(toward(60.0, 100.0), 3.0, 60.0), (toward(20.0, -40.0), 3.0, 40.0), (toward(40.0, 10.0), 4.0, 50.0)]
    _, lamps = extract_lamps(room(*discs), 8, 16)
    assert [int(np.argmax([lamp.direction @ disc[0] for disc in discs])) for lamp in lamps] == [2, 1, 0]
    for lamp, index in zip(lamps, (2, 1, 0), strict=True):
        direction, degrees, value = discs[index]
        assert lamp.direction @ direction > np.cos(np.radians(0.3))
        # The part above the contrast threshold.
        np.testing.assert_allclose(lamp.irradiance, value * np.pi * np.sin(np.radians(degrees)) ** 2, rtol=0.15)
        np.testing.assert_allclose(np.degrees(np.arctan(lamp.radius_tangent)), degrees, rtol=0.12)


@pytest.mark.parametrize("degrees", [1.5, 5.0, 12.0, 25.0])
@pytest.mark.parametrize("polar", [5.0, 45.0, 70.0])
def test_no_light_is_lost_or_counts_twice(degrees, polar):
    """Narrow lamps and wide ones, which are split: surfaces that see all of them receive what they receive of the whole map."""
    radiance = room((toward(polar), degrees, 30.0)) * np.array([1.0, 0.7, 0.4])
    rest, lamps = extract_lamps(radiance, 8, 16)
    assert lamps
    assert (rest >= 0.0).all()
    for normal in (toward(polar), toward(0.0)):
        split = facing(rest, normal) + sum(lamp.irradiance * max(float(lamp.direction @ normal), 0.0) for lamp in lamps)
        np.testing.assert_allclose(split, facing(radiance, normal), rtol=6e-3 if polar < 60.0 else 0.02)


def test_lamps_are_no_wider_than_the_search_window():
    _, lamps = extract_lamps(room((toward(30.0), 20.0, 30.0)), 8, 16)
    assert len(lamps) == 8
    # The second moment is largest for light at two opposite sides of the window.
    assert all(lamp.radius_tangent <= np.tan(np.sqrt(2.0) * LAMP_RADIUS) for lamp in lamps)
    assert all((lamp.points @ lamp.points.T).min() > np.cos(2.0 * LAMP_RADIUS) for lamp in lamps)


@pytest.mark.parametrize("max_lamps", [0, 1, 2, 3])
def test_the_strongest_lamps_are_taken_and_the_others_stay(max_lamps):
    discs = [(toward(30.0, 90.0 * i), 2.0, 20.0 * (i + 1)) for i in range(4)]
    radiance = room(*discs)
    rest, lamps = extract_lamps(radiance, max_lamps, 16)
    assert len(lamps) == max_lamps
    for i, (direction, *_) in enumerate(discs):
        taken = i >= 4 - max_lamps
        assert any(lamp.direction @ direction > 0.999 for lamp in lamps) == taken
        inside = DIRECTIONS @ direction > np.cos(np.radians(2.0))
        assert (rest[inside] < radiance[inside]).all() == taken


def test_weak_low_and_uniform_light_gives_no_lamps():
    share = np.pi * np.sin(np.radians(1.0)) ** 2 * 20.0 * 0.5 / (np.pi * 0.4)
    assert share < MIN_LAMP_SHARE
    weak, low = room((toward(60.0), 1.0, 20.0), wall=0.4), room((toward(87.0), 4.0, 100.0))
    for radiance in (weak, low, room(), np.zeros((16, 32, 3))):
        rest, lamps = extract_lamps(radiance, 8, 16)
        assert not lamps
        np.testing.assert_array_equal(rest, radiance)


@pytest.mark.parametrize("polar", [78.0, 84.0, 91.0, 97.0])
def test_bright_light_at_or_below_the_horizon_hides_no_lamp(polar):
    """Although the Gaussian blur spreads it to heights at which searches start."""
    _, lamps = extract_lamps(room((toward(polar), 3.0, 400.0), (toward(40.0, 120.0), 3.0, 100.0)), 8, 16)
    assert any(lamp.direction @ toward(40.0, 120.0) > 0.999 for lamp in lamps)
    assert all(lamp.direction[2] > 0.15 for lamp in lamps)


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 2, 4, 16]))
def test_points_stand_for_equal_parts_of_the_light(seed, count):
    """The mean of the points is the weighted centroid of the texels, for random weights; points are unit vectors."""
    random = np.random.default_rng(seed)
    texels = int(random.integers(1, 200))
    directions = np.array([0.3, 0.2, 0.9]) + 0.1 * random.normal(size=(texels, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    weight = random.exponential(size=texels) ** 3 + 1e-9
    points = stratify_light(weight, directions, count)
    assert points.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, rtol=1e-12)
    # Points are normalized, which moves them outwards by a part that is quadratic in the light's width.
    np.testing.assert_allclose(points.mean(axis=0), np.average(directions, axis=0, weights=weight), atol=0.03)


def test_points_of_a_square_lie_on_a_grid_and_aligned_runs_spread_over_it():
    across = np.linspace(-0.02, 0.02, 32)
    directions = np.stack([*np.meshgrid(across, across), np.ones((32, 32))], axis=-1).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = stratify_light(np.ones(1024), directions, 16)
    cells = np.floor((points[:, :2] / points[:, 2:] + 0.0206) / 0.0104).astype(int)
    assert sorted(map(tuple, cells.tolist())) == [(i, j) for i in range(4) for j in range(4)]
    for start in range(0, 16, 4):
        quarters = cells[start : start + 4] // 2
        assert len({tuple(quarter) for quarter in quarters.tolist()}) == 4


def test_points_of_a_disc_have_its_second_moment():
    direction, radius = toward(50.0, 20.0), 0.07
    points = sample_disc(direction, radius, 16)
    slopes = points / (points @ direction)[:, None] - direction
    # Of a uniform disc it is r² / 2; the parts' own extent is missing.
    assert 0.4 * radius**2 < (slopes**2).sum(axis=1).mean() < 0.5 * radius**2
    np.testing.assert_allclose(points.mean(axis=0) / np.linalg.norm(points.mean(axis=0)), direction, atol=1e-3)
