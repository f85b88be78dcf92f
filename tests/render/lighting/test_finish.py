"""Clear coats and anisotropy: energy, reciprocity, sampling, the formulas of glTF, and pictures."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.configs.schema import FAST, REFERENCE, UNOCCLUDED
from synpick_warp.scenes.types import PLAIN, Finish, TriangleMesh
from tests.harness.brdf_probe import evaluate, evaluate_discs, sample, toward
from tests.render.lighting.test_brdf import BLACK, FRACTION, ROUGHNESSES, WHITE, albedo, disc, hemisphere
from tests.render.lighting.test_brdf import tables as tables
from tests.render.lighting.test_transparency import COAT, INSIDE, PANE, VIEW
from tests.worlds.shapes import FLAT, ball, camera, sun, surface
from tests.worlds.toy_scene import render_objects, with_render

NONE, COATED = (0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
BRUSHED = (0.0, 0.0, 0.8, 0.0)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", ROUGHNESSES)
def test_white_furnace_of_a_coat(tables, metallic, roughness):
    """A smooth coat over a smooth base loses nothing; over a rough one what the base turns to where less passes."""
    for cosine in (0.1, 0.35, 0.7, 1.0):
        for finish in (COATED, (0.5, 0.3, 0.0, 0.0)):
            reflected = albedo(tables, (WHITE, metallic, roughness, finish), cosine)
            np.testing.assert_array_less(reflected, 1.01)
            np.testing.assert_array_less(0.97 if roughness < 0.2 else 0.93, reflected)


@pytest.mark.parametrize(("strength", "loss", "gain"), [(0.5, 0.08, 0.04), (0.7, 0.2, 0.04), (1.0, 0.4, 0.02)])
def test_white_furnace_of_an_anisotropic_metal(tables, strength, loss, gain):
    """Multiple scattering is that of the mean width; most is lost at grazing angles across the stretched direction."""
    outgoing = [toward(cosine, azimuth) for cosine in (0.1, 0.35, 1.0) for azimuth in (0.0, 0.8, np.pi / 2)]
    material = (WHITE, 1.0, 0.3, (0.0, 0.0, strength, 0.0))
    found = [integral(tables, material, each, sample(tables, material, each, 20_000)) for each in outgoing]
    assert 1.0 - loss < np.min(found) <= np.max(found) < 1.0 + gain


def integral(tables, material, outgoing, incoming):
    """Mean of the value over the density of sampled directions."""
    value, pdf = evaluate(tables, material, outgoing, incoming)
    return (value / np.where(pdf > 0.0, pdf, np.inf)[:, None]).mean(axis=0)


@settings(max_examples=40)
@given(
    base=st.tuples(FRACTION, FRACTION, FRACTION),
    metallic=FRACTION,
    roughness=FRACTION,
    finish=st.tuples(FRACTION, FRACTION, FRACTION, st.floats(-3.0, 3.0, width=32)),
    cosines=st.tuples(*[st.floats(0.05, 1.0)] * 2),
    azimuths=st.tuples(FRACTION, FRACTION),
)
def test_finished_brdf_is_reciprocal(tables, base, metallic, roughness, finish, cosines, azimuths):
    a, b = (toward(cosine, azimuth * 2 * np.pi) for cosine, azimuth in zip(cosines, azimuths, strict=True))
    forward, backward = (evaluate(tables, (base, metallic, roughness, finish), *pair)[0][0] for pair in ((a, b), (b, a)))
    np.testing.assert_allclose(forward / b[2], backward / a[2], rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("cosine", [0.25, 0.9])
@pytest.mark.parametrize("finish", [(1.0, 0.5, 0.0, 0.0), (0.0, 0.0, 0.6, 0.4), (0.7, 0.6, 0.5, -0.7)])
@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_samples_and_values_have_one_integral(tables, metallic, finish, cosine):
    """The pdf has the integral of the samples above the surface; their mean of value over pdf is the integral of the value."""
    material, outgoing = ((0.8, 0.6, 0.4), metallic, 0.6, finish), toward(cosine, 0.5)
    directions, solid_angle = hemisphere()
    value, pdf = evaluate(tables, material, outgoing, directions)
    samples = sample(tables, material, outgoing, 40_000)
    assert pdf.sum() * solid_angle == pytest.approx((samples[:, 2] > 0.0).mean(), abs=0.01)
    np.testing.assert_allclose(integral(tables, material, outgoing, samples), value.sum(axis=0) * solid_angle, rtol=0.02)
    # Also where they go: the mean direction.
    mean = (pdf[:, None] * directions).sum(axis=0) * solid_angle
    np.testing.assert_allclose(np.where(samples[:, 2:] > 0.0, samples, 0.0).mean(axis=0), mean, atol=0.01)


def test_without_coat_and_strength_it_is_the_plain_brdf(tables):
    directions = hemisphere()[0][::97]
    for metallic, roughness in ((0.0, 0.4), (1.0, 0.2), (0.5, 0.9)):
        plain, finished = (
            evaluate(tables, ((0.8, 0.5, 0.1), metallic, roughness, *more), toward(0.6), directions) for more in ((), (NONE,))
        )
        for one, other in zip(plain, finished, strict=True):
            np.testing.assert_allclose(other, one, rtol=2e-3, atol=1e-6)


def gltf_lobe(half, outgoing, incoming, roughness, strength):
    """Anisotropic GGX lobe D V cos θ of KHR_materials_anisotropy (section "Implementation"); directions are in the tangent frame: tangent,
    bitangent, normal."""
    narrow = roughness**2
    wide = narrow + (1.0 - narrow) * strength**2
    area = wide * narrow
    f = half * (narrow, wide, area)
    w2 = area / (f**2).sum(axis=-1)
    v, i = (np.linalg.norm(each * (wide, narrow, 1.0), axis=-1) for each in (outgoing, incoming))
    return area * w2**2 / np.pi * 0.5 / (incoming[..., 2] * v + outgoing[..., 2] * i) * incoming[..., 2]


@pytest.mark.parametrize("strength", [0.4, 0.8])
def test_the_lobe_is_that_of_gltf(tables, strength):
    """Compares differences between two rotations, in which multiple scattering, which is isotropic, cancels."""
    incoming, roughness = toward(np.repeat([0.4, 0.7, 0.9], 20), np.tile(np.arange(20) * 0.31, 3)).astype(np.float64), 0.4
    outgoing = toward(0.7, 0.2).astype(np.float64)
    values, expected = [], []
    for angle in (0.0, 0.6):
        turn = np.array([[np.cos(angle), np.sin(angle), 0.0], [-np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
        half = incoming + outgoing
        half /= np.linalg.norm(half, axis=-1, keepdims=True)
        expected.append(gltf_lobe(half @ turn.T, outgoing @ turn.T, incoming @ turn.T, roughness, strength))
        values.append(evaluate(tables, (WHITE, 1.0, roughness, (0.0, 0.0, strength, angle)), outgoing, incoming)[0][:, 0])
    np.testing.assert_allclose(values[0] - values[1], expected[0] - expected[1], rtol=2e-3, atol=2e-4)


def test_a_smooth_coat_over_black_reflects_by_fresnel(tables):
    """Albedo of the coat is Fresnel's reflectance; the base, a rough dielectric, is measured without a coat and subtracted."""
    for cosine, fresnel in ((1.0, COAT), (0.5, COAT + (1.0 - COAT) * 0.5**5)):
        bare, coated = (albedo(tables, (BLACK, 0.0, 0.8, (factor, 0.0, 0.0, 0.0)), cosine) for factor in (0.0, 1.0))
        np.testing.assert_allclose(coated - (1.0 - fresnel) * bare, fresnel, rtol=0.05)


@pytest.mark.parametrize("finish", [(1.0, 0.3, 0.0, 0.0), (0.0, 0.0, 0.5, 0.6)])
def test_disc_lights_on_finished_surfaces(tables, finish):
    material, outgoing, tangent = (WHITE, 1.0, 0.5, finish), toward(0.9), 0.05
    centers = toward(np.array([0.9, 0.85, 0.7]), np.pi + np.array([0.0, 0.2, 0.5]))
    for value, center in zip(evaluate_discs(tables, material, outgoing, centers, tangent), centers, strict=True):
        np.testing.assert_allclose(value, evaluate(tables, material, outgoing, disc(center, tangent))[0].mean(axis=0), rtol=0.04)


# ---- pictures ----


@pytest.mark.parametrize(("mode", "tolerance"), [(UNOCCLUDED, 0.01), (FAST, 0.03), (REFERENCE, 0.03)])
def test_a_coat_over_white_vanishes_in_even_light_and_shows_over_black(device, mode, tolerance):
    def shown(color, clearcoat):
        finish = Finish(clearcoat, 0.1) if clearcoat else PLAIN
        made = replace(surface(color, roughness=0.9), finish=finish)
        return render_objects(device, (PANE, made, FLAT), view=VIEW, config=with_render(mode, samples=64)).radiance[INSIDE].mean()

    white = shown(WHITE, 0.0)
    assert shown(WHITE, 1.0) == pytest.approx(white, rel=tolerance)
    bare = shown(BLACK, 0.0)
    assert shown(BLACK, 1.0) == pytest.approx(COAT * white + (1.0 - COAT) * bare, rel=2.0 * tolerance)


def spread(device, finish, mode=UNOCCLUDED):
    """Second moments of a lamp's highlight on a metal ball along both axes of the image [px²]; u grows along x."""
    mesh = ball(0.05, 4)
    mesh = TriangleMesh(mesh.vertices, mesh.faces, mesh.normals, np.ascontiguousarray(mesh.vertices[:, :2]))
    material = replace(surface((0.9, 0.9, 0.9), 1.0, 0.2), finish=finish)
    view, config = camera(48, 48, 360.0, (0.0, 0.0, 1.0)), with_render(mode, samples=16)
    light = (sun((0.0, 0.0, 1.0), 1e-4, 3e4),)
    picture = render_objects(device, (mesh, material, FLAT), view=view, config=config, lights=light).radiance[0].mean(axis=-1)
    weight = np.where(picture > 0.05 * picture.max(), picture, 0.0)
    away = np.arange(48) - 23.5
    return float((weight * away[None, :] ** 2).sum() / weight.sum()), float((weight * away[:, None] ** 2).sum() / weight.sum())


@pytest.mark.parametrize("mode", [UNOCCLUDED, REFERENCE])
def test_highlights_are_stretched_along_the_direction(device, mode):
    along, across = spread(device, Finish(anisotropy=0.5), mode)
    assert along > 3.0 * across
    turned = spread(device, Finish(anisotropy=0.5, rotation=np.pi / 2), mode)
    assert turned[1] > 3.0 * turned[0]
    even = spread(device, Finish(1.0, 0.2), mode)
    assert even[0] == pytest.approx(even[1], rel=0.1)
