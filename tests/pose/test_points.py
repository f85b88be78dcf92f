"""Surface points of observations and their normals, on analytic surfaces."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.scenes.assets.appearance import srgb_to_linear
from tests.twins import pose as twin
from tests.worlds.pose_views import COUNT, drawn, observe, rays, table_of

WIDTH, HEIGHT, FOCAL = 160, 120, 200.0
ONE = table_of((0, 0, 0))


def disc(radius: float, column: float = WIDTH / 2) -> np.ndarray:
    """Mask of a disc around the image's middle row and a column [px]."""
    rows, columns = np.indices((HEIGHT, WIDTH))
    return (columns + 0.5 - column) ** 2 + (rows + 0.5 - HEIGHT / 2) ** 2 < radius**2


def points_of(label, depth, device, capacity=256, table=ONE, color=None):
    """Points and normals of the first instance, and the observation."""
    seen = observe(drawn(label, depth, FOCAL, color), table, device, capacity).observation
    count = int(seen.points.numpy()[0])
    return seen.point.numpy()[0, :count], seen.normal.numpy()[0, :count], seen


@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.5, 0.2, -1.0), (-1.0, 1.0, -1.0)])
def test_points_and_normals_of_a_plane(device, normal):
    normal = np.array(normal) / np.linalg.norm(normal)
    x, y = rays(WIDTH, HEIGHT, FOCAL)
    depth = 0.4 * normal[2] / (x * normal[0] + y * normal[1] + normal[2])
    label = disc(30.0)
    points, normals, _ = points_of(label, np.where(label, depth, 0.0), device)
    # Depth is rounded to half a count, and the ray's slope adds little.
    assert np.abs((points - (0.0, 0.0, 0.4)) @ normal).max() < COUNT
    # Of 25 points 2 mm apart, rounded to 10 µm.
    assert np.degrees(np.arccos(np.clip(normals @ normal, -1.0, 1.0))).max() < 0.4


def test_points_and_normals_of_a_sphere(device):
    x, y = rays(WIDTH, HEIGHT, FOCAL)
    ray = np.stack([x, y, np.ones_like(x)], axis=-1)
    center, radius = np.array([0.01, -0.02, 0.45]), 0.08
    square = (ray**2).sum(axis=-1)
    half = ray @ center
    root = half**2 - square * (center @ center - radius**2)
    label = root > 0.0
    depth = np.where(label, (half - np.sqrt(np.maximum(root, 0.0))) / square, 0.0)
    points, normals, _ = points_of(label, depth, device)
    away = points - center
    assert np.linalg.norm(away, axis=1) == pytest.approx(np.full(len(points), radius), abs=2 * COUNT)
    facing = -np.einsum("nc,nc->n", away, points) / np.linalg.norm(points, axis=1) / radius
    known = np.linalg.norm(normals, axis=1) > 0.0
    assert known[facing > 0.3].all()
    angle = np.degrees(np.arccos(np.clip(np.einsum("nc,nc->n", normals, away) / radius, -1.0, 1.0)))
    # A plane is fitted to a window of 5 x 5 crop pixels: across 14 mm of a surface with a radius of 80 mm, more where it is averted.
    assert angle[facing > 0.8].max() < 2.0
    assert angle[facing > 0.5].max() < 4.0
    assert angle[known].max() < 15.0


@pytest.mark.parametrize("column", [40, 80, 120])
def test_normals_at_a_step_are_those_of_its_sides(device, column):
    """Also beside the optical axis, where points of two depths lie apart laterally although they are one behind the other."""
    label = disc(30.0, column)
    depth = np.where(np.arange(WIDTH)[None] < column, 0.35, 0.5) * label
    points, normals, _ = points_of(label, depth, device)
    known = np.linalg.norm(normals, axis=1) > 0.0
    assert known.mean() > 0.95
    assert normals[known] == pytest.approx(np.tile([0.0, 0.0, -1.0], (known.sum(), 1)), abs=1e-3)
    assert {round(float(z), 3) for z in points[:, 2]} == {0.35, 0.5}


def test_too_few_neighbours_have_no_normal(device):
    label = np.zeros((HEIGHT, WIDTH), bool)
    label[50, 40:60] = True
    points, normals, _ = points_of(label, np.full(label.shape, 0.5), device)
    assert len(points) == 20
    assert (normals == 0.0).all()


@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.01, 0.3, 1.0]), capacity=st.sampled_from([1, 7, 64]))
def test_as_many_points_as_there_are_and_the_capacity_allows(device, seed, share, capacity):
    random = np.random.default_rng(seed)
    label = disc(random.uniform(1.0, 28.0))
    depth = 0.5 * (random.uniform(size=label.shape) < share)
    points, _, seen = points_of(label, depth, device, capacity)
    # A mask this small has a crop pixel for each of its pixels.
    rows, columns = np.nonzero(label & (depth > 0.0))
    assert len(points) == min(capacity, len(rows))
    ranks = twin.chosen_ranks(len(rows), capacity)
    x, y = rays(WIDTH, HEIGHT, FOCAL)
    expected = np.stack([x, y, np.ones_like(x)], axis=-1)[rows[ranks], columns[ranks]] * 0.5
    assert points == pytest.approx(expected.reshape(-1, 3), abs=1e-6)
    assert seen.row_points.numpy().sum() == len(rows)


def test_points_are_evenly_spread(device):
    label = disc(50.0)
    points, _, _ = points_of(label, np.full(label.shape, 0.5), device)
    assert len(points) == 256
    quarters = np.histogram2d(points[:, 0], points[:, 1], bins=2, range=[[-0.2, 0.2], [-0.2, 0.2]])[0]
    assert np.abs(quarters / 64.0 - 1.0).max() < 0.1


def test_without_depth_there_are_no_points(device):
    label = disc(30.0)
    points, _, seen = points_of(label, np.zeros(label.shape), device)
    assert len(points) == 0
    assert seen.pixels.numpy()[0] == label.sum()
    assert seen.area.numpy()[0] >= 0.0
    assert np.isfinite(seen.intensity.numpy()).all()


def test_centroid_area_and_intensity(device):
    label = disc(25.0)
    color = np.random.default_rng(0).uniform(0.0, 1.0, (HEIGHT, WIDTH, 3))
    depth = 0.5 + 0.05 * rays(WIDTH, HEIGHT, FOCAL)[0]
    points, _, seen = points_of(label, depth, device, capacity=4096, color=color)
    centroid = points.mean(axis=0)
    assert seen.centroid.numpy()[0] == pytest.approx(centroid, abs=1e-6)
    assert seen.area.numpy()[0] * len(points) == pytest.approx(label.sum() * centroid[2] ** 2 / FOCAL**2, rel=1e-5)
    encoded = drawn(label, depth, FOCAL, color).color[0]
    assert seen.intensity.numpy()[0] == pytest.approx(srgb_to_linear(encoded / 255.0)[label].mean(), rel=1e-5)
