"""Search of nearest vertices: the toolkit's distances, also for gross errors and duplicates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation.errors import adds_errors
from tests.harness.fuzz import fuzz_examples
from tests.twins import pose_errors as twin

SHAPES = ("cloud", "duplicates", "sphere", "cylinder", "plane", "line", "point", "far")


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
def test_the_tree_agrees_with_the_toolkit(shape):
    random = np.random.default_rng(SHAPES.index(shape))
    vertices = vertices_of(shape, 200, random)
    pairs = pairs_of(vertices, fuzz_examples(50), random)
    expected = [twin.adi(*row, vertices) for row in zip(*pairs, strict=True)]
    np.testing.assert_allclose(adds_errors(*pairs, vertices), expected, rtol=0.0, atol=1e-9)
