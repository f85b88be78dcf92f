"""Sample points (Sobol', Owen-scrambled) and importance sampling of environment maps."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.kernels.render.lighting import sampling
from synpick_warp.scenes.environment import map_directions
from synpick_warp.stages.render.light_tables import build_environment_cdf, environment_cdf
from tests.harness.devices import default_device
from tests.harness.probe import probe

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
