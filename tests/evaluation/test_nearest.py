"""Search of nearest vertices by subdivision: the toolkit's and the k-d tree's distances, also for gross errors and duplicates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation import nearest
from synpick_warp.apps.evaluation.errors import adds_errors
from synpick_warp.apps.evaluation.nearest import VertexSearch
from tests.harness.fuzz import fuzz_examples
from tests.twins import pose_errors as twin

SHAPES = ("cloud", "duplicates", "sphere", "cylinder", "plane", "line", "point", "far")


@pytest.fixture(autouse=True)
def always(monkeypatch):
    """Use the subdivision for any number of queries."""
    monkeypatch.setattr(nearest, "MANY", 0)


def vertices_of(shape: str, size: int, random: np.random.Generator) -> np.ndarray:
    """Vertices (V, 3) [m]: also of shapes whose points have many vertices at the same distance."""
    angle, height = random.uniform(0.0, 2.0 * np.pi, size), random.choice([-0.05, 0.0, 0.05], size)
    circle = np.stack((0.04 * np.cos(angle), 0.04 * np.sin(angle), height), axis=1)
    cloud = random.normal(0.0, 0.05, (size, 3))
    return {
        "cloud": cloud,
        "duplicates": cloud[random.integers(0, max(1, size // 3), size)],
        "sphere": 0.05 * cloud / np.linalg.norm(cloud, axis=1, keepdims=True),
        "cylinder": circle,
        "plane": cloud * (1.0, 1.0, 0.0),
        "line": cloud * (0.0, 1.0, 0.0),
        "point": np.repeat(cloud[:1], size, axis=0),
        "far": cloud + np.array([0.3, -0.2, 5.0]),
    }[shape]


def pairs_of(vertices: np.ndarray, count: int, random: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Estimated and true poses: errors of about 0, 3 mm and 2°, 10 mm and 8°, and gross ones, some too far off to be matched."""
    kind = random.integers(0, 4, count)
    length = np.array([0.0, 0.003, 0.01, 0.3])[kind, None] * random.normal(size=(count, 3))
    angle = np.array([0.0, 0.03, 0.14, 2.0])[kind, None] * random.normal(size=(count, 3))
    true = Rotation.random(count, rng=random)
    estimated = (true * Rotation.from_rotvec(angle)).as_matrix()
    place = random.uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.5), (count, 3))
    # Turned about the centroid, where an estimator's errors are.
    shift = (true.as_matrix() - estimated) @ vertices.mean(axis=0)
    return estimated, place + shift + length, true.as_matrix(), place


@pytest.mark.parametrize("shape", SHAPES)
def test_subdivision_agrees_with_the_toolkit(shape):
    random = np.random.default_rng(SHAPES.index(shape))
    vertices = vertices_of(shape, 200, random)
    pairs = pairs_of(vertices, fuzz_examples(50), random)
    expected = [twin.adi(*row, vertices) for row in zip(*pairs, strict=True)]
    np.testing.assert_allclose(adds_errors(*pairs, vertices), expected, rtol=0.0, atol=1e-9)


@given(seed=st.integers(0, 2**32 - 1), size=st.integers(1, 300), shape=st.sampled_from(SHAPES))
@settings(max_examples=fuzz_examples(4), deadline=None)
def test_fuzz_subdivision_agrees_with_the_tree(seed, size, shape):
    random = np.random.default_rng(seed)
    vertices = vertices_of(shape, size, random)
    pairs = pairs_of(vertices, 8, random)
    search = VertexSearch(vertices)
    fast = adds_errors(*pairs, vertices, search)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nearest, "MANY", 2**62)
        slow = adds_errors(*pairs, vertices, search)
    np.testing.assert_allclose(fast, slow, rtol=0.0, atol=1e-9)


def test_poses_that_lead_out_of_the_subdivision_are_searched_in_the_tree():
    """Offsets beyond every match, and matrices that stretch a model out of reach."""
    random = np.random.default_rng(3)
    vertices = random.normal(0.0, 0.05, (60, 3))
    one = np.repeat(np.eye(3)[None], 4, axis=0)
    offset = np.array([[0.0, 0.0, 0.05], [0.0, 0.0, 50.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    true = one * np.array([1.0, 1.0, 100.0, 1.0005])[:, None, None]
    expected = [twin.adi(*row, vertices) for row in zip(one, offset, true, 0 * offset, strict=True)]
    np.testing.assert_allclose(adds_errors(one, offset, true, 0 * offset, vertices), expected, rtol=1e-12, atol=1e-12)


def test_large_models_are_left_to_the_tree(monkeypatch):
    monkeypatch.setattr(nearest, "MAX_VERTICES", 10)
    monkeypatch.setattr(nearest, "NearestVertices", None)
    vertices = np.random.default_rng(4).normal(0.0, 0.05, (11, 3))
    one, zero = np.eye(3)[None], np.zeros((1, 3))
    assert adds_errors(one, zero, one, zero, vertices) == pytest.approx([0.0])


def test_results_do_not_depend_on_how_poses_are_fetched(monkeypatch):
    random = np.random.default_rng(5)
    vertices = vertices_of("cloud", 700, random)
    pairs = pairs_of(vertices, 50, random)
    whole = adds_errors(*pairs, vertices)
    monkeypatch.setattr("synpick_warp.stages.pose.nearest._SUMS", 7)
    monkeypatch.setattr("synpick_warp.stages.pose.nearest._TASKS", 2)
    np.testing.assert_array_equal(adds_errors(*pairs, vertices), whole)
