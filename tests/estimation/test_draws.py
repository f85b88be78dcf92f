"""Random numbers of an estimation: the twin of the kernels' generator, and disturbed poses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from synpick_warp.apps.estimation.disturbance import OFFSET, TURN, disturb_poses, unit_vectors
from synpick_warp.apps.estimation.draws import Draw, sample_uniform
from synpick_warp.codes import Stream
from tests.twins import rng


def test_samples_equal_those_of_the_kernels_twin():
    instances = np.array([0, 3, 254])
    samples = sample_uniform(7, 12, 345, Draw.DISTURBANCE, instances, 5)
    key = rng.stream_key(7, 12, 345, int(Draw.DISTURBANCE))
    with np.errstate(over="ignore"):
        keys = [rng.mix((key ^ np.uint64(instance)) + rng.GAMMA) for instance in instances]
    expected = [[float(rng.uniform(each, index)) for index in range(5)] for each in keys]
    np.testing.assert_array_equal(samples, expected)


def test_streams_are_those_of_no_bake():
    assert not {int(draw) for draw in Draw} & {int(stream) for stream in Stream}


def poses(count: int) -> np.ndarray:
    result = np.tile(np.eye(4), (count, 1, 1))
    result[:, :3, :3] = Rotation.random(count, rng=np.random.default_rng(1)).as_matrix()
    result[:, :3, 3] = np.random.default_rng(2).normal(size=(count, 3))
    return result


def test_disturbed_poses_are_off_by_exactly_the_offset_and_the_turn():
    true = poses(2000)
    disturbed = disturb_poses(true, np.arange(2000), 0, 5, 6)
    offset = disturbed[:, :3, 3] - true[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), OFFSET, rtol=1e-9)
    turn = Rotation.from_matrix(disturbed[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1))
    np.testing.assert_allclose(np.degrees(turn.magnitude()), TURN, rtol=1e-9)
    # Means of 2,000 uniform directions: their components have a standard deviation of 0.013.
    assert np.abs(offset.mean(axis=0) / OFFSET).max() < 0.05
    assert np.abs(turn.as_rotvec().mean(axis=0) / np.radians(TURN)).max() < 0.05


def test_an_instances_disturbance_depends_on_nothing_but_its_name():
    true = poses(4)
    all_of_them = disturb_poses(true, np.arange(4), 9, 1, 2)
    np.testing.assert_array_equal(disturb_poses(true[2:3], np.array([2]), 9, 1, 2), all_of_them[2:3])
    for seed, scene, frame in ((8, 1, 2), (9, 0, 2), (9, 1, 3)):
        assert np.abs(disturb_poses(true, np.arange(4), seed, scene, frame) - all_of_them).max() > 1e-3
    assert disturb_poses(np.empty((0, 4, 4)), np.empty(0, np.int64), 0, 0, 0).shape == (0, 4, 4)


def test_unit_vectors():
    np.testing.assert_allclose(unit_vectors(np.array([0.0, 0.5]), np.array([0.3, 0.25])), [[0, 0, 1], [0, 1, 0]], atol=1e-12)
    assert pytest.approx(0.02) == OFFSET
