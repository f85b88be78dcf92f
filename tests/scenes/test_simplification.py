"""Convex hull simplification: boxes, scans of boxes, spheres, random and degenerate points."""

from __future__ import annotations

import itertools
from dataclasses import fields

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.configs.schema import Objects
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.collision.hull_planes import hull_planes
from synpick_warp.scenes.collision.hulls import hull_volume, mass_properties
from synpick_warp.scenes.collision.simplification import MIN_VERTICES, simplify_hull
from tests.harness.pieces import assert_valid


@pytest.mark.parametrize("limit", [0, 4, 7])
def test_fewer_vertices_than_a_box_has_are_refused(limit):
    with pytest.raises(ValueError, match=f"max_vertices is {limit}, but must be at least 8"):
        simplify_hull(np.random.default_rng(0).random((50, 3)), limit)


def test_the_settings_allow_no_fewer_vertices_either():
    lows = {field.name: field.metadata["low"] for field in fields(Objects) if field.name in ("hull_vertices", "piece_vertices")}
    assert lows == {"hull_vertices": MIN_VERTICES, "piece_vertices": MIN_VERTICES}


def test_a_cube_keeps_its_eight_corners():
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 6)] * 3), axis=-1).reshape(-1, 3)
    piece = simplify_hull(grid, 64)
    assert_valid(piece)
    assert np.array_equal(np.unique(piece.vertices, axis=0), np.unique(np.sign(grid[np.abs(grid).min(axis=1) == 0.5]) / 2, axis=0))


@given(st.integers(0, 2**32 - 1), st.integers(4, 400), st.integers(8, 64), st.floats(1e-3, 1.0))
def test_simplified_hulls_are_valid(seed, count, limit, flatness):
    points = np.random.default_rng(seed).normal(size=(count, 3)) * (0.1, 0.05, 0.1 * flatness)
    piece = simplify_hull(points, limit)
    assert_valid(piece)
    assert len(piece.vertices) <= limit
    assert np.array_equal(simplify_hull(points, limit).vertices, piece.vertices)


@given(st.integers(0, 2**32 - 1), st.floats(1e-5, 2e-4))
def test_a_scanned_box_gets_six_planar_sides(seed, roughness):
    """Points of a box's sides, moved by up to `roughness` [m]: each side becomes one plane, no farther from it than twice that."""
    rng, size = np.random.default_rng(seed), np.array((0.1, 0.15, 0.05))
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 9)] * 3), axis=-1).reshape(-1, 3)
    points = grid[np.abs(grid).max(axis=1) == 0.5] * size
    scanned = points + rng.uniform(-roughness, roughness, points.shape)
    piece = simplify_hull(scanned, 64)
    assert mass_properties([piece]).volume == pytest.approx(hull_volume(scanned), rel=2e-3)
    vertices, planes = piece.vertices.astype(np.float64), hull_planes(piece)
    for axis, side in itertools.product(range(3), (-1.0, 1.0)):
        assert (side * vertices[:, axis]).max() == pytest.approx(size[axis] / 2, abs=2 * roughness)
        facing = planes[side * planes[:, axis] > np.cos(np.radians(2.0))]
        distances = np.abs(vertices @ facing[:, :3].T - facing[:, 3])
        corners = vertices[distances[:, (distances < 1e-6).sum(axis=0).argmax()] < 1e-6]
        assert len(corners) >= 4
        assert (np.ptp(np.delete(corners, axis, axis=1), axis=0) > 0.9 * np.delete(size, axis)).all()


def test_a_sphere_keeps_its_volume_in_64_vertices():
    # Its vertices lie outside and the middles of its facets inside: by 12 and 8 % of the radius at most.
    ball = trimesh.creation.icosphere(4, radius=0.05)
    piece = simplify_hull(ball.vertices, 64)
    assert_valid(piece)
    assert 50 <= len(piece.vertices) <= 64
    assert mass_properties([piece]).volume == pytest.approx(hull_volume(ball.vertices), rel=1e-3)
    assert np.linalg.norm(piece.vertices, axis=1).max() < 1.12 * 0.05
    assert hull_planes(piece)[:, 3].min() > 0.92 * 0.05


@pytest.mark.parametrize("points", [np.zeros((9, 3)), np.eye(3), np.random.default_rng(0).random((50, 3)) * (1, 1, 0), np.ones((1, 3))])
def test_coplanar_points_have_no_hull(points):
    assert hull_volume(points) == 0.0
    with pytest.raises(CatalogError, match="one plane"):
        simplify_hull(points, 64)
