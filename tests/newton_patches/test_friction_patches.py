"""Friction patches: the order of contacts is that of Newton's sort."""

import numpy as np
import pytest
import warp as wp

from synpick_warp.kernels.newton_patches.friction_patches import sort_contacts_kernel

WORLDS, BODIES, CAPACITY = 5, 7, 512
UNUSED = 0x7FFFFFFFFFFFFFFF


@pytest.mark.parametrize("count", [0, 1, 300, CAPACITY])
def test_contacts_are_sorted_as_by_a_stable_sort(device, count):
    """Keys of random pairs of bodies, grouped by worlds, one of which has none; the rest of the array is unused."""
    random = np.random.default_rng(count)
    world = np.sort(random.choice([0, 1, 3, 4], count))
    first = world * BODIES + random.integers(0, BODIES, count) + 1
    keys = np.full(2 * CAPACITY, UNUSED)
    keys[:count] = (first << 32) | (first + random.integers(1, 60, count))
    found = wp.array(keys, dtype=wp.int64, device=device)
    order = wp.array(np.arange(2 * CAPACITY), dtype=wp.int32, device=device)
    block = 64 if device.is_cuda else 1
    wp.launch_tiled(sort_contacts_kernel, dim=[WORLDS], inputs=[BODIES, found, order], block_dim=block, device=device)
    expected = np.argsort(keys[:CAPACITY], kind="stable")
    np.testing.assert_array_equal(order.numpy()[:CAPACITY], expected)
    np.testing.assert_array_equal(found.numpy()[:CAPACITY], keys[expected])
