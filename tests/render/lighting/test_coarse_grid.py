"""Coarse pixels: interleaved order and Morton order."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.kernels.render.lighting import coarse_grid
from synpick_warp.kernels.render.lighting.paths.coarse import SEQUENCE_PERIOD
from synpick_warp.kernels.render.visibility.camera import in_image
from synpick_warp.stages.render.denoised import build_coarse_grid
from synpick_warp.stages.render.sampling_rates import interleaved_threads
from synpick_warp.stages.render.scene import build_grid
from tests.harness.devices import default_device
from tests.harness.probe import probe


@wp.func
def count_visit(coarse: coarse_grid.CoarseGrid, visits: wp.array3d[int], index: int):
    """Count a thread's coarse pixel in interleaved order."""
    view, row, column = coarse_grid.interleaved_pixel(coarse, index)
    if in_image(coarse.grid, row, column):
        wp.atomic_add(visits, view, row, column, 1)


count_visits, morton = probe(count_visit), probe(coarse_grid.morton_index)


@given(width=st.integers(1, 150), height=st.integers(1, 100), size=st.integers(1, 5), views=st.integers(1, 3))
def test_interleaved_order_visits_each_coarse_pixel_once(width, height, size, views):
    coarse = build_coarse_grid(build_grid(width, height), size, 1)
    assert (coarse.grid.width, coarse.grid.height) == (-(-width // size), -(-height // size))
    visits = wp.zeros((views, coarse.grid.height, coarse.grid.width), dtype=wp.int32, device=default_device())
    count_visits(coarse, visits, np.arange(views * interleaved_threads(coarse.grid.width, coarse.grid.height)))
    assert (visits.numpy() == 1).all()


@pytest.mark.parametrize("period", [2, 4, int(SEQUENCE_PERIOD)])
def test_aligned_squares_hold_aligned_runs_of_morton_indices(device, period):
    index = morton(period, *np.indices((3 * period, 2 * period)), device=device)
    size = 1
    while size <= period:
        for row in range(0, len(index), size):
            for column in range(0, 2 * period, size):
                run = np.sort(index[row : row + size, column : column + size].reshape(-1))
                assert run[0] % size**2 == 0
                np.testing.assert_array_equal(run, run[0] + np.arange(size**2))
        size *= 2
    # Any square as wide as the period holds each index once, aligned or not.
    for row, column in ((1, 0), (period // 2, 1), (period, period - 1)):
        np.testing.assert_array_equal(np.sort(index[row : row + period, column : column + period].reshape(-1)), np.arange(period**2))
