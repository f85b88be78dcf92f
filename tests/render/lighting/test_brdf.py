"""BRDF, sample points and importance sampling of environment maps; specular anti-aliasing."""

import numpy as np
import pytest
import trimesh
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.kernels.render.lighting import sampling
from synpick_warp.kernels.render.lighting.brdf import MAX_WIDENING, PIXEL_VARIANCE, widen_roughness
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.types import Material, TriangleMesh
from synpick_warp.stages.render import scene
from synpick_warp.stages.render.light_tables import build_environment_cdf, environment_cdf, measure_albedo
from synpick_warp.stages.render.scene import normal_gradient
from tests.harness.brdf_probe import evaluate, evaluate_discs, sample, toward
from tests.harness.environment import default_device
from tests.harness.probe import probe
from tests.worlds.shapes import UPRIGHT, ball, box, camera, entry, sun
from tests.worlds.toy_scene import ToyScene, render

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


# ---- sample points and environment maps ----


BITS = 32
sobol_point, scrambled_point = probe(sampling.sobol_point), probe(sampling.scrambled_point)
invert_marginal, invert_conditional = probe(sampling.invert_marginal), probe(sampling.invert_conditional)
sampled, pdf_of = probe(sampling.sample_environment), probe(sampling.environment_pdf)


def sobol(index: np.ndarray) -> np.ndarray:
    """Points (..., 2) of the Sobol' sequence by its direction numbers: 2^-j, and v_j = v_(j-1) ^ v_(j-1) / 2 of the polynomial x + 1."""
    first = [1 << (BITS - 1 - j) for j in range(BITS)]
    second = [1 << (BITS - 1)]
    for _ in range(1, BITS):
        second.append(second[-1] ^ (second[-1] >> 1))
    points = np.zeros((*index.shape, 2), np.uint64)
    for j in range(BITS):
        bit = (index >> j) & 1
        points ^= np.stack([np.where(bit, directions[j], 0) for directions in (first, second)], axis=-1).astype(np.uint64)
    return points / 2.0**BITS


@pytest.mark.parametrize("first", [0, 1000, 2**20 - 17])
def test_points_are_those_of_sobol(device, first):
    index = first + np.arange(600)
    np.testing.assert_allclose(sobol_point(index, device=device), sobol(index), atol=2.0**-24)


@settings(max_examples=20)
@given(key=st.integers(0, 2**64 - 1), dimension=st.integers(0, 12), run=st.integers(0, 40), power=st.integers(0, 8))
def test_aligned_runs_of_scrambled_points_are_nets(key, dimension, run, power):
    # A (0, 2) sequence: each box of 2^-a by 2^-(k - a) holds one of an aligned run of 2^k points.
    count = 2**power
    points = scrambled_point(key, run * count + np.arange(count), dimension)
    assert (points >= 0.0).all()
    assert (points < 1.0).all()
    for a in range(power + 1):
        boxes = np.floor(points * (2.0**a, 2.0 ** (power - a))).astype(int)
        assert len(np.unique(boxes, axis=0)) == count


def test_points_of_other_dimensions_and_keys_are_uncorrelated(device):
    # The correlation of 256 pairs of independent numbers is about 1/16. Owen scrambling flips the first digit of two neighbours
    # together, which makes it 1.2 times as much; dependent pairs have 0.5 and more.
    points = np.array([scrambled_point(key, np.arange(256), dimension, device=device) for key in range(1, 21) for dimension in range(3)])
    correlation = np.corrcoef(np.concatenate([points[..., 0], points[..., 1]]))
    other = np.abs(correlation[np.triu_indices(len(correlation), 1)])
    assert np.sqrt((other**2).mean()) < 1.5 / 16.0
    assert other.max() < 0.5


@settings(max_examples=30, deadline=None)
@given(rows=st.integers(2, 40), seed=st.integers(0, 1000), dark=st.floats(0.0, 1.0))
def test_guide_tables_find_what_a_search_of_the_whole_cdf_finds(rows: int, seed: int, dark: float):
    """Also for numbers next to an entry or a cell's end, in maps with lamps, black texels and black rows."""
    rng = np.random.default_rng(seed)
    radiance = rng.random((rows, 2 * rows, 3)) ** 8 * (rng.random((rows, 2 * rows, 1)) >= dark) * (rng.random((rows, 1, 1)) >= dark / 2)
    device = wp.get_device(default_device())
    cdf = build_environment_cdf(radiance[None].astype(np.float32), device)
    marginal, conditional = (values.numpy()[0] for values in (cdf.marginal, cdf.conditional))
    row = int(rng.integers(rows))
    ends = np.concatenate([marginal, conditional[row], np.arange(128) / 128.0]).astype(np.float32)
    numbers = np.concatenate([ends, np.nextafter(ends, np.float32(0.0)), np.nextafter(ends, np.float32(1.0)), rng.random(500, np.float32)])
    numbers = numbers[(numbers >= 0.0) & (numbers < 1.0)]
    for indices, entries in (
        (invert_marginal(cdf, 0, numbers), marginal),
        (invert_conditional(cdf, 0, row, numbers), conditional[row]),
    ):
        np.testing.assert_array_equal(indices, np.searchsorted(entries, numbers, side="right") - 1)


def sample_environment(device, cdf, count):
    """Sampled directions (count, 3), the sampler's pdf and the evaluated pdf (count)."""
    found = sampled(cdf, 0, np.random.default_rng(1).random((count, 2), dtype=np.float32), device=device)
    return found["direction"], found["pdf"], pdf_of(cdf, 0, found["direction"], device=device)


def test_texels_are_sampled_in_proportion_to_their_light(device):
    rows = 16
    radiance = np.random.default_rng(0).gamma(0.3, size=(rows, 2 * rows, 1)).astype(np.float32) * np.ones(3, np.float32)
    radiance[3, 5] = 500.0
    cdf = build_environment_cdf(radiance[None], device)
    probability = np.diff(cdf.marginal.numpy()[0])[:, None] * np.diff(cdf.conditional.numpy()[0], axis=1)
    assert probability.sum() == pytest.approx(1.0, abs=1e-5)
    assert probability[3, 5] == probability.max()
    count = 50_000
    directions, sampled_pdf, evaluated_pdf = sample_environment(device, cdf, count)
    at = directions.astype(np.float64)
    row = np.minimum((np.arccos(at[:, 2]) / np.pi * rows).astype(int), rows - 1)
    column = ((np.arctan2(at[:, 1], at[:, 0]) / (2 * np.pi) + 0.5) * 2 * rows).astype(int) % (2 * rows)
    counted = np.bincount(row * 2 * rows + column, minlength=probability.size)
    expected = count * probability.reshape(-1)
    large = expected > 10.0
    # Chi-squared: mean n, standard deviation sqrt(2n); five of these.
    assert ((counted - expected)[large] ** 2 / expected[large]).sum() < large.sum() + 5.0 * np.sqrt(2.0 * large.sum())
    # The pdf is probability over solid angle, and the evaluated pdf agrees except for directions on a texel's border.
    _, solid_angles = map_directions(rows)
    np.testing.assert_allclose(sampled_pdf, (probability / solid_angles)[row, column], rtol=1e-3, atol=1e-6)
    assert (np.abs(evaluated_pdf - sampled_pdf) <= 1e-4 * sampled_pdf).mean() > 0.999


@pytest.mark.parametrize("black", [False, True])
@pytest.mark.parametrize("table", [False, True])
def test_nothing_below_the_horizon_of_a_table_is_sampled(device, table, black):
    rows = 16
    radiance = np.random.default_rng(3).gamma(0.5, size=(rows, 2 * rows, 3)).astype(np.float32) * (not black)
    marginal, conditional = environment_cdf(radiance, table)
    assert (np.diff(marginal) >= 0.0).all()
    assert (np.diff(conditional, axis=1) >= 0.0).all()
    assert marginal[0] == 0.0
    assert marginal[-1] == 1.0
    assert (conditional[:, 0] == 0.0).all()
    assert (conditional[:, -1] == 1.0).all()
    probability = np.diff(marginal)[:, None] * np.diff(conditional, axis=1)
    assert probability.sum() == pytest.approx(1.0, abs=1e-5)
    # One row below the horizon is left: interpolation carries light across it.
    assert (probability[rows // 2 + 1 :].max() == 0.0) == table
    # All light that counts can be sampled, however little it is.
    assert (probability[: rows // 2 + 1] > 0.0).all()
    # Low light has less weight: HORIZON_WEIGHT at the horizon, and more the higher it is.
    if black:
        density = probability[:, 0] / map_directions(rows)[1][:, 0]
        assert (np.diff(density[: rows // 2]) < 0.0).all()
    count = 20_000
    directions, sampled_pdf, _ = sample_environment(device, build_environment_cdf(radiance[None], device, table), count)
    assert (sampled_pdf > 0.0).all()
    lowest = directions[:, 2].min()
    assert lowest >= -np.sin(np.pi / rows) - 1e-6 if table else lowest < -0.9
    # The mean of 1 / pdf is the solid angle of the sampled domain.
    solid_angle = map_directions(rows)[1][: rows // 2 + 1 if table else rows].sum()
    inverse = 1.0 / sampled_pdf.astype(np.float64)
    assert abs(inverse.mean() - solid_angle) < 5.0 * inverse.std() / np.sqrt(count)


# ---- specular anti-aliasing ----


RADIUS = 6.0
SHINY = Material(color=(0.9, 0.9, 0.9), texture=None, metallic=1.0, roughness=0.1)


def cylinder(radius: float) -> TriangleMesh:
    """A tube without lids, with smooth normals [m]."""
    tube = trimesh.creation.cylinder(radius=radius, height=0.2, sections=48, cap=False)
    vertices = np.asarray(tube.vertices)
    outer = np.hypot(vertices[:, 0], vertices[:, 1]) > 0.5 * radius
    faces = np.asarray(tube.faces)[outer[tube.faces].all(axis=1)]
    normals = vertices * (1.0, 1.0, 0.0) / radius
    uv = np.zeros((len(vertices), 2), np.float32)
    return TriangleMesh(vertices.astype(np.float32), faces.astype(np.int32), normals.astype(np.float32), uv)


def test_normal_gradient_is_the_curvature():
    # One radian per radius along each curved direction; the norm adds both in quadrature.
    np.testing.assert_allclose(normal_gradient(ball(0.05, 2)), np.sqrt(2.0) / 0.05, rtol=1e-4)
    tube = cylinder(0.05)
    assert len(tube.faces) == 96
    np.testing.assert_allclose(normal_gradient(tube), 1.0 / 0.05, rtol=1e-4)
    np.testing.assert_allclose(normal_gradient(box(0.1, 0.2, 0.3)), 0.0, atol=1e-5)


def test_degenerate_triangles_have_no_normal_gradient():
    flat = ball(0.05, 0)
    flat.faces[0] = flat.faces[0][[0, 0, 1]]
    assert normal_gradient(flat)[0] == 0.0


widen = probe(widen_roughness)


def test_squared_widths_add_up_to_max_widening(device):
    roughness, spread = (grid.ravel().astype(np.float32) for grid in np.meshgrid(np.linspace(0.0, 1.0, 11), [0.0, 1e-3, 0.1, 1.0, 100.0]))
    widened = widen(roughness, spread, device=device)
    added = np.minimum(float(PIXEL_VARIANCE) * spread.astype(np.float64) ** 2, float(MAX_WIDENING))
    np.testing.assert_allclose(widened, np.minimum(roughness.astype(np.float64) ** 4 + added, 1.0) ** 0.25, atol=2e-6)


def brightness_while_moving(device, light) -> np.ndarray:
    """Mean radiance (8) of images of a metal ball, of radius RADIUS px, that moves by a quarter of a pixel per image."""
    view = camera(32, 24, 120.0, (0.0, 0.0, 1.0))
    means = []
    for step in range(8):
        pose = (step / 4 / 120.0, step / 9 / 120.0, 0.0, *UPRIGHT)
        toy = ToyScene([entry(ball(RADIUS / 120.0, 4), SHINY)], [[(0, pose)]], (view,), lights=(light,))
        picture = render(toy, device)
        means.append(np.where(picture.instance[0][..., None] == 1, picture.radiance[0], 0.0).mean())
    return np.array(means)


def test_subpixel_highlights_are_neither_lost_nor_sparkle(device, monkeypatch):
    rows, sky, strength = 128, 0.3, 3e4
    light = sun((0.3, 0.2, 1.0), sky, strength, rows)
    # A mirroring ball reflects light uniformly: in each direction a quarter of what its disc receives.
    row = np.unravel_index(light.radiance[..., 0].argmax(), light.radiance.shape[:2])[0]
    irradiance = strength * (np.pi / rows) ** 2 * np.sin(np.pi * (row + 0.5) / rows)
    truth = 0.9 * RADIUS**2 * (irradiance / 4.0 + np.pi * sky) / (32 * 24)
    steady = brightness_while_moving(device, light)
    assert steady.mean() == pytest.approx(truth, rel=0.12)
    assert np.abs(steady / truth - 1.0).max() < 0.35
    monkeypatch.setattr(scene, "normal_gradient", lambda mesh: np.zeros(len(mesh.faces), np.float32))
    # Without it, most images lose the highlight, and it sparkles in the others.
    sparkling = brightness_while_moving(device, light) / truth
    assert np.median(sparkling) < 0.6
    assert sparkling.max() > 1.5
