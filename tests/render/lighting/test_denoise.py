"""Variance-guided denoiser on synthetic input, orders of coarse pixels, and lists of those that trace paths."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.kernels.render.lighting import coarse_grid, denoise, upsampling
from synpick_warp.kernels.render.lighting.paths.coarse import SEQUENCE_PERIOD
from synpick_warp.kernels.render.lighting.paths.lists import AGED, FRESH, REGION_PIXELS, PathLists, append_pixel, listed_pixel
from synpick_warp.kernels.render.lighting.plane_distance import Plane
from synpick_warp.kernels.render.visibility.camera import in_image
from synpick_warp.kernels.render.visibility.records import read_record, write_record
from synpick_warp.stages.arrays import allocate_struct
from synpick_warp.stages.render.denoised import PATH_LISTS, build_coarse_grid
from synpick_warp.stages.render.sampling_rates import interleaved_threads
from synpick_warp.stages.render.scene import build_grid
from tests.harness.denoise_probe import FlatDenoiser
from tests.harness.environment import default_device
from tests.harness.probe import probe

colors = st.tuples(*[st.floats(0.0, 10.0)] * 3)

HALF_ROUNDING = 2.0**-11
"""Largest relative rounding of half precision, in which coarse light and ratios are stored."""


@wp.func
def repack_surface(records: wp.array3d[wp.vec4], index: int, segment: int, depth: float, normal: wp.vec3):
    """Round trip of a surface through the guide image: pack, store, load and unpack."""
    write_record(records, index, coarse_grid.pack_surface(segment, depth, normal))
    surface = read_record(records, index)
    return int(coarse_grid.surface_segment(surface)), coarse_grid.surface_depth(surface), coarse_grid.surface_normal(surface)


@wp.func
def upsample_step(records: wp.array3d[upsampling.RatioRecord], index: int, step: float):
    """Ratio halfway between coarse pixels of ratio 1 on its tangent plane and others of ratio 0, `step` coarse pixels behind it."""
    coarse = coarse_grid.CoarseGrid()
    coarse.size = 4
    coarse.grid.width = 4
    coarse.grid.height = 4
    coarse.image.width = 16
    coarse.image.height = 16
    plane = Plane()
    plane.segment = wp.uint8(1)
    plane.facing = -1.0
    plane.height = -1.0
    plane.width = 1.0e-3
    plane.normal = wp.vec3(0.0, 0.0, -1.0)
    for r in range(4):
        for c in range(4):
            ratio = wp.vec3(wp.where(c < 2, 1.0, 0.0))
            depth = wp.where(c < 2, 1.0, 1.0 + 4.0e-3 * step)
            records[index, r, c] = upsampling.pack_ratios(ratio, ratio, ratio, coarse_grid.pack_surface(1, depth, plane.normal))
    ratios = upsampling.RatioImages()
    ratios.record = records
    return upsampling.upsample_ratios(ratios, coarse, index, 8, 8, plane).specular[0]


shrink, repacked, upsampled = probe(denoise.shrink), probe(repack_surface), probe(upsample_step)


@given(wide=colors, narrow=colors, variance=st.floats(0.0, 20.0))
def test_shrinkage_follows_the_narrow_kernel_beyond_its_variance(wide, narrow, variance):
    result = shrink(wide, narrow, variance)
    wide, narrow = np.array(wide), np.array(narrow)
    square = float((narrow - wide) @ (0.2126, 0.7152, 0.0722)) ** 2
    expected = wide if square <= variance else wide + (1.0 - variance / square) * (narrow - wide)
    # Where both are nearly equal, rounding decides.
    if abs(square - variance) > 1e-4 * (1.0 + variance):
        np.testing.assert_allclose(result, expected, rtol=1e-3, atol=1e-3)
    if variance == 0.0 and square > 1e-3:
        np.testing.assert_allclose(result, narrow, rtol=1e-5, atol=1e-5)


def test_packed_surfaces_keep_id_depth_and_normal(device):
    """Towards the camera and away from it, along the axes too."""
    normal = np.concatenate([np.random.default_rng(0).normal(size=(250, 3)), np.eye(3), -np.eye(3)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    segment, depth = np.arange(256), np.linspace(0.3, 3.0, 256, dtype=np.float32)
    records = wp.empty((1, 1, 256), dtype=wp.vec4, device=device)
    found = repacked(records, np.arange(256), segment, depth, normal, device=device)
    np.testing.assert_array_equal(found[0], segment)
    np.testing.assert_array_equal(found[1], depth)
    # Near z = 0, the root of a rounding error; id 0 has no side.
    np.testing.assert_allclose(found[2][1:], normal[1:], atol=5e-4)


@settings(max_examples=10)
@given(width=st.integers(1, 40), height=st.integers(1, 30), seed=st.integers(0, 100))
def test_constant_visibility_ratios_are_kept_up_to_the_border(width, height, seed):
    # Unoccluded light of any strength, of which the same fraction arrives everywhere.
    flat = FlatDenoiser(width, height)
    rng = np.random.default_rng(seed)
    for name, ratio in (("diffuse", 0.7), ("specular", 0.4)):
        unoccluded = rng.uniform(0.2, 2.0, (height, width, 3))
        flat.assign(f"unoccluded_{name}", unoccluded)
        flat.assign(name, ratio * unoccluded)
    flat.assign("indirect", np.full((height, width), 0.3))
    result = flat.run()
    for name, expected in (("diffuse", 0.7), ("specular", 0.4), ("indirect", 0.3)):
        np.testing.assert_allclose(result[name], expected, rtol=2.001 * HALF_ROUNDING)  # the bound itself occurs


def test_steps_without_noise_stay_sharp_and_noise_is_averaged():
    flat = FlatDenoiser(64, 48)
    ones = np.ones((48, 64))
    step = np.where(np.arange(64) < 32, 0.2, 1.0)[None] * ones
    noise = np.random.default_rng(0).choice([0.0, 1.0], size=(48, 64))
    flat.assign("diffuse", step)
    flat.assign("specular", noise)
    result = flat.run()
    # A block is 4 coarse pixels wide, smoothing adds one on each side.
    np.testing.assert_allclose(result["diffuse"][:, :28], 0.2, atol=0.02)
    np.testing.assert_allclose(result["diffuse"][:, 38:], 1.0, atol=0.02)
    assert (np.diff(result["diffuse"][24, :, 0]) > -0.01).all()
    # 256 coarse pixels in the wide kernel: a sixteenth of the noise, except where a narrower kernel is chosen.
    inside = result["specular"][8:40, 8:56, 0]
    assert inside.std() < 0.3 * noise.std()
    assert inside.mean() == pytest.approx(noise[4:44, 4:60].mean(), abs=0.03)


def test_larger_variance_scale_widens_the_kernel():
    """Rare bright samples: a block with some of them looks bright, unless its variance is scaled up, because its estimate is too low."""
    flat = FlatDenoiser(64, 48)
    rare = 20.0 * (np.random.default_rng(0).uniform(size=(48, 64)) < 0.05)
    flat.assign("diffuse", rare)
    deviation = [flat.run(scale)["diffuse"][8:40, 8:56, 0].std() for scale in (0.0, 0.5, 1.0, 2.0, 1e9)]
    assert (np.diff(deviation) < 0.0).all()
    # At one end single blocks, at the other kernels of 256 coarse pixels.
    assert deviation[-1] == pytest.approx(rare.std() / 16.0, rel=0.4)
    assert deviation[0] > 3.0 * deviation[-1]


def test_one_bright_path_is_spread_over_the_wide_kernel():
    """A firefly has its whole block's variance, so that the block's mean is no evidence of a feature."""
    flat = FlatDenoiser(64, 48)
    firefly = np.full((48, 64), 0.5)
    firefly[24, 32] = 20.0
    for name in ("diffuse", "specular"):
        flat.assign(name, firefly)
    result = flat.run()
    for name in ("diffuse", "specular"):
        # A 256th of it in the wide kernel; a block alone would have a 16th.
        assert result[name][..., 0].max() < 0.5 + 2.0 * 20.0 / 256.0


def test_other_bodies_and_other_depths_do_not_mix():
    flat = FlatDenoiser(32, 32)
    left = np.arange(32)[None] * np.ones((32, 1)) < 16
    flat.show(np.where(left, 1, 2), np.ones((32, 32)))
    flat.assign("diffuse", np.where(left, 0.2, 0.9))
    np.testing.assert_allclose(flat.run()["diffuse"][..., 0], np.where(left, 0.2, 0.9), rtol=HALF_ROUNDING)
    # The same body in another plane counts little: SAME_BODY_WEIGHT.
    flat.show(np.ones((32, 32)), np.where(left, 1.0, 1.5))
    np.testing.assert_allclose(flat.run()["diffuse"][..., 0], np.where(left, 0.2, 0.9), atol=0.05)


# ---- coarse pixels ----


@wp.func
def count_visit(coarse: coarse_grid.CoarseGrid, visits: wp.array3d[int], index: int):
    """Count a thread's coarse pixel in interleaved order."""
    view, row, column = coarse_grid.interleaved_pixel(coarse, index)
    if in_image(coarse.grid, row, column):
        wp.atomic_add(visits, view, row, column, 1)


count_visits, morton = probe(count_visit), probe(coarse_grid.morton_index)


def test_light_does_not_leak_across_an_edge_of_the_same_body(device):
    """Between pixels of one plane it is interpolated; a face half a coarse pixel behind, or further away, has no share."""
    records = wp.empty((4, 4, 4), dtype=upsampling.RatioRecord, device=device)
    found = np.asarray(upsampled(records, np.arange(4), np.float32([0.0, 0.01, 0.5, 20.0]), device=device))
    assert found[0] == pytest.approx(0.5, abs=1e-3)
    assert 0.5 < found[1] < 0.6
    assert (found[2:] > 0.999).all()


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


# ---- lists of paths ----


VIEWS, REGIONS, MAX_KNOWN, MAX_BITS = 2, 3, 255, 7
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
    lists = allocate_struct(
        PATH_LISTS, {"view": VIEWS, "region": REGIONS, "rank": REGION, "path_kind": 2, "cell_row": 1, "cell_column": 1}, device
    )
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
