"""Lists of the coarse pixels that trace paths: each once, with its history, in the region of its own."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from synpick_warp.kernels.render.lighting.paths.lists import AGED, FRESH, REGION_PIXELS, PathLists, append_pixel, listed_pixel
from synpick_warp.stages.arrays import allocate_struct
from synpick_warp.stages.render.denoised import PATH_LISTS
from tests.harness.probe import probe

VIEWS, REGIONS, MAX_KNOWN, MAX_BITS = 2, 3, 255, 3
REGION = int(REGION_PIXELS)
THREADS = REGIONS * REGION


@wp.func
def append_if_known(lists: PathLists, view: int, index: int, known: int, bits: int):
    """Append a coarse pixel, unless `known` is negative."""
    if known >= 0:
        append_pixel(lists, view, index, known, bits)


append, read = probe(append_if_known), probe(listed_pixel)


@pytest.mark.parametrize("listed", [0.0, 0.3, 1.0])
def test_every_listed_pixel_is_read_once_with_its_history(device, listed):
    rng = np.random.default_rng(3)
    known = rng.choice([0, 1, 16, MAX_KNOWN], VIEWS * THREADS).astype(np.int32)
    bits = np.where(known > 0, rng.integers(0, MAX_BITS + 1, known.size), 0).astype(np.int32)
    known[rng.random(known.size) >= listed] = -1
    known[:REGION], bits[:REGION] = MAX_KNOWN, MAX_BITS  # A full region, to the last bit of its entries.
    lists = allocate_struct(PATH_LISTS, {"view": VIEWS, "region": REGIONS, "rank": REGION, "path_kind": 2}, device)
    lists.count.zero_()
    threads = np.arange(known.size)
    append(lists, threads // THREADS, threads, known, bits, device=device)
    found = np.stack(read(lists, threads, device=device), axis=1)
    counts = known.reshape(VIEWS, REGIONS, REGION)
    np.testing.assert_array_equal(lists.count.numpy()[..., int(FRESH)], (counts == 0).sum(axis=2))
    np.testing.assert_array_equal(lists.count.numpy()[..., int(AGED)], (counts > 0).sum(axis=2))
    taken = found[found[:, 0] >= 0]
    np.testing.assert_array_equal(taken[:, 0] // REGION, np.flatnonzero(found[:, 0] >= 0) // REGION)
    expected = np.flatnonzero(known >= 0)
    ordered = taken[np.argsort(taken[:, 0])]
    np.testing.assert_array_equal(ordered, np.stack((expected, known[expected], bits[expected]), axis=1))
