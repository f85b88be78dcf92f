"""How surfaces scatter light: energy, reciprocity, and directions drawn as they are said to be."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.stages.render.gloss import measure_gloss
from tests.harness.brdf_probe import evaluate_disc_kernel, evaluated, scatter_kernel, toward

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
ROUGHNESSES = (0.0, 0.13, 0.3, 0.55, 0.8, 1.0)
SHARE = st.floats(0.0, 1.0, width=32)
ROWS, COLUMNS = 256, 512
"""Steps of integrals over the hemisphere."""


@pytest.fixture(scope="module")
def gloss(device):
    return measure_gloss(device)


def scattered(gloss, material, outgoing, count):
    """Directions (count, 3) drawn with random numbers."""
    numbers = wp.array(np.random.default_rng(3).random((count, 3), dtype=np.float32), dtype=wp.vec3, device=gloss.albedo.device)
    drawn = wp.empty(count, dtype=wp.vec3, device=numbers.device)
    base, metallic, roughness = material
    inputs = [gloss, wp.vec3(*base), metallic, roughness, wp.vec3(*outgoing), numbers]
    wp.launch(scatter_kernel, count, inputs, [drawn], device=numbers.device)
    return drawn.numpy().astype(np.float64)


def hemisphere():
    """Directions, even in cosine and azimuth, and the solid angle of each."""
    cosine = (np.arange(ROWS) + 0.5) / ROWS
    azimuth = (np.arange(COLUMNS) + 0.5) / COLUMNS * 2 * np.pi
    return toward(cosine[:, None], azimuth[None, :]).reshape(-1, 3), 2 * np.pi / (ROWS * COLUMNS)


def albedo(gloss, material, cosine, count=20_000):
    """Share of light from one direction that is reflected, by drawing: (3)."""
    outgoing = toward(cosine)
    incoming = scattered(gloss, material, outgoing, count)
    value, density = evaluated(gloss, material, outgoing, incoming)
    return (value / np.where(density > 0.0, density, np.inf)[:, None]).mean(axis=0)


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", ROUGHNESSES)
def test_white_reflects_all_light(gloss, metallic, roughness):
    for cosine in (0.1, 0.35, 0.7, 1.0):
        np.testing.assert_allclose(albedo(gloss, (WHITE, metallic, roughness), cosine), 1.0, atol=0.01)


def test_what_is_smooth_reflects_as_fresnel_says(gloss):
    np.testing.assert_allclose(albedo(gloss, (BLACK, 0.0, 0.05), 1.0), 0.04, rtol=0.01)
    np.testing.assert_allclose(albedo(gloss, ((0.9, 0.5, 0.1), 1.0, 0.05), 1.0), (0.9, 0.5, 0.1), rtol=0.01)
    np.testing.assert_allclose(albedo(gloss, (BLACK, 0.0, 0.05), 0.5), 0.04 + 0.96 * 0.5**5, rtol=0.02)


def test_the_mean_of_the_table_is_that_of_its_rows(gloss):
    # Σ over the hemisphere of the single lobe, F = 1, smooth: nothing is lost; rough: Smith's masking loses more than a third.
    kept = gloss.mean.numpy().sum(axis=1)
    assert 0.99 < kept[0] <= 1.0
    assert (np.diff(kept) < 1e-4).all()
    assert 0.4 < kept[-1] < 0.65


@settings(max_examples=40)
@given(base=st.tuples(SHARE, SHARE, SHARE), metallic=SHARE, roughness=SHARE, cosines=st.tuples(*[st.floats(0.05, 1.0)] * 2), azimuth=SHARE)
def test_the_law_is_reciprocal(gloss, base, metallic, roughness, cosines, azimuth):
    a, b = toward(cosines[0]), toward(cosines[1], azimuth * 2 * np.pi)
    there, _ = evaluated(gloss, (base, metallic, roughness), a, b)
    back, _ = evaluated(gloss, (base, metallic, roughness), b, a)
    np.testing.assert_allclose(there[0] / b[2], back[0] / a[2], rtol=2e-3, atol=1e-6)


@settings(max_examples=20)
@given(base=st.tuples(SHARE, SHARE, SHARE), metallic=SHARE, roughness=SHARE, cosine=st.floats(0.05, 1.0))
def test_no_surface_sends_back_more_than_it_gets(gloss, base, metallic, roughness, cosine):
    found = albedo(gloss, (base, metallic, roughness), cosine)
    assert (found >= 0.0).all()
    assert (found <= 1.01).all()


@pytest.mark.parametrize("cosine", [0.2, 0.9])
@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_directions_are_drawn_with_the_density_that_is_said(gloss, metallic, roughness, cosine):
    material, outgoing = ((0.8, 0.6, 0.4), metallic, roughness), toward(cosine)
    directions, solid = hemisphere()
    _, density = evaluated(gloss, material, outgoing, directions)
    # Bins of 16 x 16 in cosine and azimuth, and one for what falls below the surface.
    expected = (density * solid).reshape(16, ROWS // 16, 16, COLUMNS // 16).sum(axis=(1, 3)).reshape(-1)
    count = 40_000
    drawn = scattered(gloss, material, outgoing, count)
    above = drawn[drawn[:, 2] > 0.0]
    assert expected.sum() + 1.0 - len(above) / count == pytest.approx(1.0, abs=0.01)
    row = np.minimum((above[:, 2] * 16).astype(int), 15)
    column = (np.arctan2(above[:, 1], above[:, 0]) / (2 * np.pi) % 1.0 * 16).astype(int) % 16
    found = np.bincount(row * 16 + column, minlength=256)
    large = expected * count > 10.0
    assert large.sum() > 10
    chi = ((found - count * expected)[large] ** 2 / (count * expected)[large]).sum()
    # Mean n, standard deviation sqrt(2n); five of them, and 2 % for the integral over the bins.
    assert chi < large.sum() + 5.0 * np.sqrt(2.0 * large.sum())


def disc(middle: np.ndarray, spread: float, count: int = 4096) -> np.ndarray:
    """Directions (count, 3) spread evenly over a disc about a direction; `spread` is the tangent of its angular radius."""
    number = np.arange(count) + 0.5
    radius, angle = spread * np.sqrt(number / count), number * np.pi * (3.0 - np.sqrt(5.0))
    aside = np.cross(middle, (0.0, 1.0, 0.0))
    aside /= np.linalg.norm(aside)
    across = np.cross(middle, aside)
    made = middle + radius[:, None] * (np.cos(angle)[:, None] * aside + np.sin(angle)[:, None] * across)
    return made / np.linalg.norm(made, axis=1, keepdims=True)


def discs(gloss, material, outgoing, middles, spread):
    """Mean f cos (N, 3) over discs about directions (N, 3)."""
    base, metallic, roughness = material
    given = wp.array(middles.astype(np.float32), dtype=wp.vec3, device=gloss.albedo.device)
    value = wp.empty(len(middles), dtype=wp.vec3, device=given.device)
    inputs = [gloss, wp.vec3(*base), metallic, roughness, wp.vec3(*outgoing), given, spread]
    wp.launch(evaluate_disc_kernel, len(middles), inputs, [value], device=given.device)
    return value.numpy().astype(np.float64)


@pytest.mark.parametrize("spread", [0.005, 0.035, 0.07])
@pytest.mark.parametrize("roughness", [0.15, 0.3, 0.5, 1.0])
def test_a_discs_light_is_the_mean_of_its_points(gloss, roughness, spread):
    """Within the highlight, on its slope, far outside. A disc of half vectors stands for an ellipse, as a sharp highlight shows."""
    material, outgoing = (WHITE, 1.0, roughness), toward(0.9)
    azimuth = np.pi + np.array([0.0, 0.0, 0.0, 0.0, 0.3])
    middles = toward(np.array([0.9, 0.88, 0.8, 0.5, 0.9]), azimuth)
    for found, middle in zip(discs(gloss, material, outgoing, middles, spread), middles, strict=True):
        mean = evaluated(gloss, material, outgoing, disc(middle, spread))[0].mean(axis=0)
        np.testing.assert_allclose(found, mean, rtol=0.08 if roughness < 0.2 else 0.04)


@given(cosine=st.floats(0.02, 1.0), other=st.floats(0.02, 1.0), azimuth=st.floats(0.0, 6.3), roughness=SHARE, metallic=SHARE)
@settings(max_examples=60, deadline=None)
def test_a_point_is_a_disc_without_width(gloss, cosine, other, azimuth, roughness, metallic):
    outgoing, middle = toward(cosine), toward(other, azimuth)
    material = (WHITE, metallic, roughness)
    expected = evaluated(gloss, material, outgoing, middle[None])[0]
    np.testing.assert_allclose(discs(gloss, material, outgoing, middle[None], 0.0), expected, rtol=2e-3, atol=1e-6)
