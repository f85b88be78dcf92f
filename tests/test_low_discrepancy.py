"""Low-discrepancy sequences: first values, evenness, and areas of triangles."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.system.low_discrepancy import r2_points, sample_triangles


def test_first_points_of_r2():
    """Fractional parts of multiples of the root p of p³ = p + 1: 1 / p = p² - 1 and 1 / p² = p - 1 / p."""
    plastic = np.roots([1.0, 0.0, -1.0, -1.0])[0].real
    steps = np.array([plastic**2 - 1.0, plastic - 1.0 / plastic])
    np.testing.assert_allclose(r2_points(np.arange(3)), np.stack([np.zeros(2), steps, 2.0 * steps - 1.0]), atol=1e-12)
    np.testing.assert_allclose(r2_points(np.arange(1), start=0.5), [[0.5, 0.5]])


def test_each_cell_of_a_grid_gets_about_its_part():
    cells = (8 * r2_points(np.arange(6400))).astype(int)
    counts = np.bincount(8 * cells[:, 0] + cells[:, 1], minlength=64)
    assert abs(counts - 100).max() <= 5


def test_triangles_get_points_by_their_area():
    areas = np.array([1.0, 0.0, 3.0, 6.0])
    face, weights = sample_triangles(areas, 1000)
    np.testing.assert_allclose(np.bincount(face, minlength=4), [100, 0, 300, 600], atol=3)
    assert (weights >= 0.0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    assert weights[face == 3].mean(axis=0) == pytest.approx([1 / 3] * 3, abs=0.02)
