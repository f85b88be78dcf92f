"""BRDF: white furnace, reciprocity, and samples that follow their pdf."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.stages.render.light_tables import measure_albedo
from tests.harness.brdf_probe import evaluate, evaluate_discs, sample, toward

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
ROUGHNESSES = (0.0, 0.13, 0.3, 0.55, 0.8, 1.0)
FRACTION = st.floats(0.0, 1.0, width=32)
ROWS, COLUMNS = 256, 512
"""Steps of the integrals over the hemisphere."""


@pytest.fixture(scope="module")
def tables(device):
    return measure_albedo(device)


def hemisphere():
    """Directions, uniform in cosine and azimuth, and the solid angle of each."""
    cosine = (np.arange(ROWS) + 0.5) / ROWS
    azimuth = (np.arange(COLUMNS) + 0.5) / COLUMNS * 2 * np.pi
    return toward(cosine[:, None], azimuth[None, :]).reshape(-1, 3), 2 * np.pi / (ROWS * COLUMNS)


def albedo(tables, material, cosine, count=20_000):
    """Directional albedo (3) by Monte Carlo."""
    outgoing = toward(cosine)
    incoming = sample(tables, material, outgoing, count)
    value, pdf = evaluate(tables, material, outgoing, incoming)
    return (value / np.where(pdf > 0.0, pdf, np.inf)[:, None]).mean(axis=0)


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", ROUGHNESSES)
def test_white_furnace(tables, metallic, roughness):
    for cosine in (0.1, 0.35, 0.7, 1.0):
        np.testing.assert_allclose(albedo(tables, (WHITE, metallic, roughness), cosine), 1.0, atol=0.01)


def test_smooth_surfaces_reflect_by_fresnel(tables):
    np.testing.assert_allclose(albedo(tables, (BLACK, 0.0, 0.05), 1.0), 0.04, rtol=0.01)
    np.testing.assert_allclose(albedo(tables, ((0.9, 0.5, 0.1), 1.0, 0.05), 1.0), (0.9, 0.5, 0.1), rtol=0.01)
    np.testing.assert_allclose(albedo(tables, (BLACK, 0.0, 0.05), 0.5), 0.04 + 0.96 * 0.5**5, rtol=0.02)


def test_mean_albedo_falls_with_roughness(tables):
    # Mean albedo of the single-scattering lobe for F = 1. Smooth: nothing is lost; rough: Smith's masking loses more than a third.
    mean = tables.mean.numpy().sum(axis=1)
    assert 0.99 < mean[0] <= 1.0
    assert (np.diff(mean) < 1e-4).all()
    assert 0.4 < mean[-1] < 0.65


@settings(max_examples=40)
@given(
    base=st.tuples(FRACTION, FRACTION, FRACTION),
    metallic=FRACTION,
    roughness=FRACTION,
    cosines=st.tuples(*[st.floats(0.05, 1.0)] * 2),
    azimuth=FRACTION,
)
def test_brdf_is_reciprocal(tables, base, metallic, roughness, cosines, azimuth):
    a, b = toward(cosines[0]), toward(cosines[1], azimuth * 2 * np.pi)
    forward, _ = evaluate(tables, (base, metallic, roughness), a, b)
    backward, _ = evaluate(tables, (base, metallic, roughness), b, a)
    np.testing.assert_allclose(forward[0] / b[2], backward[0] / a[2], rtol=2e-3, atol=1e-6)


@settings(max_examples=20)
@given(base=st.tuples(FRACTION, FRACTION, FRACTION), metallic=FRACTION, roughness=FRACTION, cosine=st.floats(0.05, 1.0))
def test_no_surface_reflects_more_light_than_it_receives(tables, base, metallic, roughness, cosine):
    reflected = albedo(tables, (base, metallic, roughness), cosine)
    assert (reflected >= 0.0).all()
    assert (reflected <= 1.01).all()


@pytest.mark.parametrize("cosine", [0.2, 0.9])
@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_sampled_directions_follow_the_pdf(tables, metallic, roughness, cosine):
    material, outgoing = ((0.8, 0.6, 0.4), metallic, roughness), toward(cosine)
    directions, solid_angle = hemisphere()
    _, pdf = evaluate(tables, material, outgoing, directions)
    # Bins of 16 x 16 in cosine and azimuth, and one for samples below the surface.
    expected = (pdf * solid_angle).reshape(16, ROWS // 16, 16, COLUMNS // 16).sum(axis=(1, 3)).reshape(-1)
    count = 40_000
    samples = sample(tables, material, outgoing, count)
    above = samples[samples[:, 2] > 0.0]
    assert expected.sum() + 1.0 - len(above) / count == pytest.approx(1.0, abs=0.01)
    row = np.minimum((above[:, 2] * 16).astype(int), 15)
    column = (np.arctan2(above[:, 1], above[:, 0]) / (2 * np.pi) % 1.0 * 16).astype(int) % 16
    counted = np.bincount(row * 16 + column, minlength=256)
    large = expected * count > 10.0
    assert large.sum() > 10
    chi = ((counted - count * expected)[large] ** 2 / (count * expected)[large]).sum()
    # Chi-squared: mean n, standard deviation sqrt(2n); five of these.
    assert chi < large.sum() + 5.0 * np.sqrt(2.0 * large.sum())


def disc(center: np.ndarray, tangent: float, count: int = 4096) -> np.ndarray:
    """Directions (count, 3), uniform over a disc light about a direction; `tangent` is that of its angular radius (golden-angle spiral)."""
    index = np.arange(count) + 0.5
    radius, angle = tangent * np.sqrt(index / count), index * np.pi * (3.0 - np.sqrt(5.0))
    x = np.cross(center, (0.0, 1.0, 0.0))
    x /= np.linalg.norm(x)
    y = np.cross(center, x)
    directions = center + radius[:, None] * (np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * y)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("tangent", [0.005, 0.035, 0.07])
@pytest.mark.parametrize("roughness", [0.15, 0.3, 0.5, 1.0])
def test_disc_light_is_the_mean_over_its_points(tables, roughness, tangent):
    """Within the highlight, on its slope, far outside. Half vectors are approximated by a disc instead of an ellipse; sharp highlights
    show it."""
    material, outgoing = (WHITE, 1.0, roughness), toward(0.9)
    azimuth = np.pi + np.array([0.0, 0.0, 0.0, 0.0, 0.3])
    centers = toward(np.array([0.9, 0.88, 0.8, 0.5, 0.9]), azimuth)
    for value, center in zip(evaluate_discs(tables, material, outgoing, centers, tangent), centers, strict=True):
        mean = evaluate(tables, material, outgoing, disc(center, tangent))[0].mean(axis=0)
        np.testing.assert_allclose(value, mean, rtol=0.08 if roughness < 0.2 else 0.04)


@given(cosine=st.floats(0.02, 1.0), other=st.floats(0.02, 1.0), azimuth=st.floats(0.0, 6.3), roughness=FRACTION, metallic=FRACTION)
@settings(max_examples=60, deadline=None)
def test_point_light_is_a_disc_of_radius_zero(tables, cosine, other, azimuth, roughness, metallic):
    outgoing, center = toward(cosine), toward(other, azimuth)
    material = (WHITE, metallic, roughness)
    expected = evaluate(tables, material, outgoing, center[None])[0]
    np.testing.assert_allclose(evaluate_discs(tables, material, outgoing, center[None], 0.0), expected, rtol=2e-3, atol=1e-6)
