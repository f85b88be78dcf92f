"""Lamp extraction: which light of a map becomes a lamp, that none is lost or counts twice, and the sample points of lamps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.lamps import LAMP_RADIUS, MIN_LAMP_SHARE, extract_lamps, sample_disc, stratify_light

ROWS = 128
DIRECTIONS, SOLID_ANGLES = map_directions(ROWS)


def toward(polar: float, azimuth: float = 0.0) -> np.ndarray:
    """Unit direction (3) at a polar angle and an azimuth [°]."""
    p, a = np.radians([polar, azimuth])
    return np.array([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)])


def room(*discs: tuple[np.ndarray, float, float], wall: float = 0.2) -> np.ndarray:
    """A map of constant radiance `wall` with discs (direction, angular radius [°], radiance)."""
    radiance = np.full((ROWS, 2 * ROWS, 3), wall)
    for direction, radius, value in discs:
        radiance[np.cos(np.radians(radius)) < DIRECTIONS @ direction] = value
    return radiance


def irradiance(radiance: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Irradiance (3) of a map on a surface of unit `normal` (3)."""
    return (radiance * (np.maximum(DIRECTIONS @ normal, 0.0) * SOLID_ANGLES)[..., None]).sum(axis=(0, 1))


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
        split = irradiance(rest, normal) + sum(lamp.irradiance * max(float(lamp.direction @ normal), 0.0) for lamp in lamps)
        np.testing.assert_allclose(split, irradiance(radiance, normal), rtol=6e-3 if polar < 60.0 else 0.02)


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
    for radiance in (room((toward(60.0), 1.0, 20.0), wall=0.4), room((toward(87.0), 4.0, 100.0)), room()):
        rest, lamps = extract_lamps(radiance, 8, 16)
        assert not lamps
        np.testing.assert_array_equal(rest, radiance)


@pytest.mark.parametrize("polar", [78.0, 84.0, 91.0, 97.0])
def test_bright_light_at_or_below_the_horizon_hides_no_lamp(polar):
    """Although the Gaussian blur spreads it to heights at which searches start."""
    _, lamps = extract_lamps(room((toward(polar), 3.0, 400.0), (toward(40.0, 120.0), 3.0, 100.0)), 8, 16)
    assert any(lamp.direction @ toward(40.0, 120.0) > 0.999 for lamp in lamps)
    assert all(lamp.direction[2] > 0.15 for lamp in lamps)


def test_a_black_map_has_no_lamps():
    assert extract_lamps(np.zeros((16, 32, 3)), 8, 16)[1] == []


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
