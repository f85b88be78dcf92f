"""Convex hull simplification: boxes, scans of boxes, spheres, random and degenerate points."""

from __future__ import annotations

import itertools
from unittest import mock

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist, pdist
from scipy.spatial.transform import Rotation

from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.schema import Objects
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.collision import simplification
from synpick_warp.scenes.collision.hulls import hull_planes, hull_volume, mass_properties
from synpick_warp.scenes.collision.simplification import MIN_VERTICES, simplify_hull
from synpick_warp.scenes.types import ConvexPiece
from tests.harness.pieces import assert_valid


def ring(radius: float, height: float, count: int) -> np.ndarray:
    """Points of a circle about the z-axis."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)])


def ball(rng: np.random.Generator, radius: float, count: int) -> np.ndarray:
    points = rng.normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def ladle(rng: np.random.Generator) -> np.ndarray:
    """A sphere with a thin, long handle."""
    thickness, length = rng.uniform(0.005, 0.1), rng.uniform(3.0, 10.0)
    return np.concatenate([ball(rng, rng.uniform(0.2, 1.0), 80), ring(thickness, length, 12), ring(0.7 * thickness, 1.01 * length, 12)])


def wedge(rng: np.random.Generator) -> np.ndarray:
    """A long body that tapers to an edge, with rough sides."""
    width, edge = rng.uniform(0.3, 1.0, 2), rng.uniform(0.001, 0.05)
    corners = [(x * width[0], y * width[1], 0.0) for x in (-1, 1) for y in (-1, 1)]
    corners += [(x * edge, y * rng.uniform(0.2, 1.0) * width[1], 3.0) for x in (-1, 1) for y in (-1, 1)]
    points = np.concatenate([corners, rng.dirichlet(np.full(8, 0.3), 150) @ corners])
    return points + rng.normal(size=points.shape) * 0.005


def cone(rng: np.random.Generator) -> np.ndarray:
    return np.concatenate([ring(1.0, 0.0, int(rng.integers(30, 90))), [(0.0, 0.0, rng.uniform(0.2, 6.0))]])


def rod(rng: np.random.Generator) -> np.ndarray:
    """A thin rod with one chamfered end."""
    radius, count = rng.uniform(0.001, 0.05), int(rng.integers(16, 40))
    return np.concatenate([ring(radius, -1.0, count), ring(radius, 1.0, count), ring(0.7 * radius, 1.0 + 0.4 * radius, count)])


def disc(rng: np.random.Generator) -> np.ndarray:
    """A thin disc with one chamfered rim."""
    thickness, count = rng.uniform(0.001, 0.05), int(rng.integers(30, 60))
    return np.concatenate([ring(1.0, -thickness, count), ring(1.0, thickness, count), ring(0.97, 1.2 * thickness, count)])


def tetrahedron(rng: np.random.Generator) -> np.ndarray:
    """A rounded tetrahedron of any shape."""
    return (rng.normal(size=(4, 1, 3)) + ball(rng, 0.08, 20)).reshape(-1, 3)


FAMILIES = (ladle, wedge, cone, rod, disc, tetrahedron)
SEEDS = st.integers(0, 2**32 - 1)


def turned(points: np.ndarray, seed: int) -> np.ndarray:
    """Points in a random orientation: quaternions of normal components are uniformly distributed."""
    return points @ Rotation.from_quat(np.random.default_rng(seed).normal(size=4)).as_matrix().T


def reach(piece: ConvexPiece, points: np.ndarray) -> float:
    """Largest distance of a piece's vertex from a side of the points' hull, outside of it."""
    planes = ConvexHull(points).equations
    return float((piece.vertices @ planes[:, :3].T + planes[:, 3]).max())


@settings(max_examples=12)
@pytest.mark.parametrize("family", FAMILIES)
@given(SEEDS, st.integers(8, 64), st.floats(-4.0, 4.0))
def test_hulls_of_any_shape_and_size_become_half_spaces_of_their_volume(family, seed, limit, exponent):
    points = (turned(family(np.random.default_rng(seed)), seed) * 10.0**exponent).astype(np.float32)
    with mock.patch.object(simplification, "_decimate", wraps=simplification._decimate) as decimate:
        piece = simplify_hull(points, limit)
    assert decimate.call_count <= 1  # A second call is the fallback.
    assert_valid(piece)
    assert len(piece.vertices) <= limit
    size = np.ptp(points, axis=0).max()
    assert mass_properties([piece]).volume == pytest.approx(ConvexHull(points.astype(np.float64)).volume, rel=2e-3)
    assert len(ConvexHull(piece.vertices.astype(np.float64)).vertices) == len(piece.vertices)
    assert pdist(piece.vertices.astype(np.float64)).min() > 4e-7 * size


@settings(max_examples=10)
@given(SEEDS, st.integers(8, 12))
def test_a_diagonal_rod_of_few_vertices_stays_thin(seed, limit):
    points = turned(rod(np.random.default_rng(seed)), seed)
    piece = simplify_hull(points, limit)
    radius = np.linalg.norm(np.cross(points, turned(np.array([(0.0, 0.0, 1.0)]), seed)), axis=1).max()
    assert reach(piece, points) < 4.0 * radius


@settings(max_examples=8)
@given(SEEDS, st.integers(8, 64))
def test_a_turned_hull_gives_the_turned_result(seed, limit):
    points = np.random.default_rng(seed).normal(size=(60, 3)) * (0.1, 0.06, 0.03)
    piece, other = simplify_hull(points, limit), simplify_hull(turned(points, seed), limit)
    assert mass_properties([other]).volume == pytest.approx(mass_properties([piece]).volume, rel=1e-5)
    distances = cdist(turned(piece.vertices, seed), other.vertices)
    assert max(distances.min(axis=0).max(), distances.min(axis=1).max()) < 1e-4


@settings(max_examples=8)
@given(SEEDS, st.integers(-30, 30))
def test_a_scaled_hull_gives_the_scaled_result(seed, exponent):
    points = tetrahedron(np.random.default_rng(seed)).astype(np.float32)
    scale = np.float32(2.0**exponent)
    assert np.array_equal(simplify_hull(points * scale, 24).vertices, simplify_hull(points, 24).vertices * scale)


@settings(max_examples=8)
@pytest.mark.parametrize("family", FAMILIES)
@given(SEEDS)
def test_no_useful_half_space_is_left_over(family, seed):
    """Without a limit: a candidate of little volume but great height must not end the selection."""
    hull = ConvexHull(turned(family(np.random.default_rng(seed)), seed))
    facets, frame = simplification._cluster(hull, simplification._centroid(hull))
    min_gain = 1e-3 * hull.volume
    chosen = simplification._select(facets, frame, len(facets.normal), min_gain)
    current = simplification._intersect(facets, chosen)
    for index in set(range(len(facets.normal))) - set(chosen):
        cut = simplification._intersect(facets, [*chosen, index])
        assert simplification._gain(current, cut, facets.normal[index], facets.offset[index]) < min_gain


def test_where_half_spaces_fail_the_hull_of_selected_points_is_returned():
    points = np.random.default_rng(0).normal(size=(300, 3))
    with mock.patch.object(simplification, "_choose_facets", side_effect=QhullError):
        piece = simplify_hull(points, 32)
    assert_valid(piece)
    assert 24 <= len(piece.vertices) <= 32
    assert reach(piece, points) < 1e-6


@pytest.mark.parametrize("limit", [0, 4, 7])
def test_fewer_vertices_than_a_box_has_are_refused(limit):
    with pytest.raises(ValueError, match=f"max_vertices is {limit}, but must be at least 8"):
        simplify_hull(np.random.default_rng(0).random((50, 3)), limit)


def test_the_settings_allow_no_fewer_vertices_either():
    lows = {name: settings_of(Objects)[name].bounds.low for name in ("hull_vertices", "piece_vertices")}
    assert lows == {"hull_vertices": MIN_VERTICES, "piece_vertices": MIN_VERTICES}


def test_a_cube_keeps_its_eight_corners():
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 6)] * 3), axis=-1).reshape(-1, 3)
    piece = simplify_hull(grid, 64)
    assert_valid(piece)
    assert np.array_equal(np.unique(piece.vertices, axis=0), np.unique(np.sign(grid[np.abs(grid).min(axis=1) == 0.5]) / 2, axis=0))


@given(st.integers(0, 2**32 - 1), st.integers(4, 400), st.integers(8, 64), st.floats(1e-3, 1.0))
@example(0, 4, 8, 1e-3)  # Half-spaces with a vertex at infinity in a plane through the inner point.
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
    sphere = trimesh.creation.icosphere(3, radius=0.05)
    piece = simplify_hull(sphere.vertices, 64)
    assert_valid(piece)
    assert 50 <= len(piece.vertices) <= 64
    assert mass_properties([piece]).volume == pytest.approx(hull_volume(sphere.vertices), rel=1e-3)
    assert np.linalg.norm(piece.vertices, axis=1).max() < 1.12 * 0.05
    assert hull_planes(piece)[:, 3].min() > 0.92 * 0.05


@pytest.mark.parametrize("points", [np.zeros((9, 3)), np.eye(3), np.random.default_rng(0).random((50, 3)) * (1, 1, 0), np.ones((1, 3))])
def test_coplanar_points_have_no_hull(points):
    assert hull_volume(points) == 0.0
    with pytest.raises(CatalogError, match="one plane"):
        simplify_hull(points, 64)
