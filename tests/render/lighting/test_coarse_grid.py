"""Cells of the fast picture: who visits them, which points they take, what the filter makes of them; and which bodies rays may meet."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.device import pick_device
from synpick_warp.kernels.render.lighting.coarse_paths import PERIOD
from synpick_warp.stages.render.denoised import cell_grid, spread_threads
from synpick_warp.stages.render.scene import build_grid
from synpick_warp.stages.render.view_setup import make_views
from tests.harness.denoise_probe import FlatFilter, narrowed_kernel, number_kernel, scrambled_kernel, sobol_kernel, visit_kernel
from tests.worlds.toy_scene import ToyScene, ball, box, camera, entry, sheet, traced

BITS = 32


@given(width=st.integers(1, 150), height=st.integers(1, 100), size=st.integers(1, 5), views=st.integers(1, 3))
def test_each_cell_of_each_view_is_visited_once(width, height, size, views):
    cells = cell_grid(build_grid(width, height), size, 1)
    assert (cells.cells.width, cells.cells.height) == (-(-width // size), -(-height // size))
    visits = wp.zeros((views, cells.cells.height, cells.cells.width), dtype=wp.int32, device="cpu")
    wp.launch(visit_kernel, views * spread_threads(cells), [cells], [visits], device="cpu")
    assert (visits.numpy() == 1).all()


@pytest.mark.parametrize("period", [2, 4, int(PERIOD)])
def test_aligned_squares_of_cells_hold_aligned_runs_of_numbers(device, period):
    number = wp.empty((3 * period, 2 * period), dtype=wp.int32, device=device)
    wp.launch(number_kernel, number.shape, [period], [number], device=device)
    number = number.numpy()
    size = 1
    while size <= period:
        for row in range(0, len(number), size):
            for column in range(0, 2 * period, size):
                run = np.sort(number[row : row + size, column : column + size].reshape(-1))
                assert run[0] % size**2 == 0
                np.testing.assert_array_equal(run, run[0] + np.arange(size**2))
        size *= 2
    # Wherever a square as wide as the period lies, it holds each number once.
    for row, column in ((1, 0), (period // 2, 1), (period, period - 1)):
        np.testing.assert_array_equal(np.sort(number[row : row + period, column : column + period].reshape(-1)), np.arange(period**2))


def sobol(index: np.ndarray) -> np.ndarray:
    """Points (..., 2) of the Sobol' sequence by its direction numbers: 2^-j, and v_j = v_(j-1) ^ v_(j-1) / 2 of the polynomial x + 1."""
    first = [1 << (BITS - 1 - j) for j in range(BITS)]
    second = [1 << (BITS - 1)]
    for _ in range(1, BITS):
        second.append(second[-1] ^ (second[-1] >> 1))
    made = np.zeros((*index.shape, 2), np.uint64)
    for j in range(BITS):
        chosen = (index >> j) & 1
        made ^= np.stack([np.where(chosen, numbers[j], 0) for numbers in (first, second)], axis=-1).astype(np.uint64)
    return made / 2.0**BITS


@pytest.mark.parametrize("first", [0, 1000, 2**20 - 17])
def test_points_are_those_of_sobol(device, first):
    points = wp.empty(600, dtype=wp.vec2, device=device)
    wp.launch(sobol_kernel, 600, [first], [points], device=device)
    np.testing.assert_allclose(points.numpy(), sobol(first + np.arange(600)), atol=2.0**-24)


@settings(max_examples=20)
@given(key=st.integers(0, 2**64 - 1), dimension=st.integers(0, 12), run=st.integers(0, 40), power=st.integers(0, 8))
def test_aligned_runs_of_scrambled_points_are_nets(key, dimension, run, power):
    # A (0, 2) sequence: each box of 2^-a by 2^-(k - a) holds one of an aligned run of 2^k points.
    count = 2**power
    made = wp.empty(count, dtype=wp.vec2, device="cpu")
    wp.launch(scrambled_kernel, count, [wp.uint64(key), dimension, run * count], [made], device="cpu")
    made = made.numpy()
    assert (made >= 0.0).all()
    assert (made < 1.0).all()
    for a in range(power + 1):
        boxes = np.floor(made * (2.0**a, 2.0 ** (power - a))).astype(int)
        assert len(np.unique(boxes, axis=0)) == count


colors = st.tuples(*[st.floats(0.0, 10.0)] * 3)


@given(wide=colors, narrow=colors, variance=st.floats(0.0, 20.0))
def test_a_narrow_window_is_believed_as_far_as_it_is_certain(wide, narrow, variance):
    arrays = [wp.array([value], dtype=wp.vec3, device="cpu") for value in (wide, narrow)]
    made = wp.empty(1, dtype=wp.vec3, device="cpu")
    wp.launch(narrowed_kernel, 1, [*arrays, wp.array([variance], dtype=wp.float32, device="cpu")], [made], device="cpu")
    wide, narrow = np.array(wide), np.array(narrow)
    square = float((narrow - wide) @ (0.2126, 0.7152, 0.0722)) ** 2
    expected = wide if square <= variance else wide + (1.0 - variance / square) * (narrow - wide)
    # Where both are nearly equal, rounding decides.
    if abs(square - variance) > 1e-4 * (1.0 + variance):
        np.testing.assert_allclose(made.numpy()[0], expected, rtol=1e-3, atol=1e-3)
    if variance == 0.0 and square > 1e-3:
        np.testing.assert_allclose(made.numpy()[0], narrow, rtol=1e-5, atol=1e-5)


@settings(max_examples=10)
@given(width=st.integers(1, 40), height=st.integers(1, 30), seed=st.integers(0, 100))
def test_the_filter_keeps_an_even_share_wherever_cells_end(width, height, seed):
    # Even light of any strength, of which the same share arrives everywhere.
    flat = FlatFilter(width, height, pick_device("cpu"))
    rng = np.random.default_rng(seed)
    for name, share in (("diffuse", 0.7), ("gloss", 0.4)):
        even = rng.uniform(0.2, 2.0, (height, width, 3))
        flat.assign(f"even_{name}", even)
        flat.assign(name, share * even)
    flat.assign("between", np.full((height, width), 0.3))
    made = flat.run()
    for name, expected in (("diffuse", 0.7), ("gloss", 0.4), ("between", 0.3)):
        np.testing.assert_allclose(made[name], expected, rtol=1e-4)


def test_the_filter_follows_a_step_without_noise_and_averages_noise():
    flat = FlatFilter(64, 48, pick_device("cpu"))
    ones = np.ones((48, 64))
    for name in ("even_diffuse", "even_gloss"):
        flat.assign(name, ones)
    step = np.where(np.arange(64) < 32, 0.2, 1.0)[None] * ones
    noise = np.random.default_rng(0).choice([0.0, 1.0], size=(48, 64))
    flat.assign("diffuse", step)
    flat.assign("gloss", noise)
    made = flat.run()
    # A block is 4 cells wide, softening adds one on each side.
    np.testing.assert_allclose(made["diffuse"][:, :28], 0.2, atol=0.02)
    np.testing.assert_allclose(made["diffuse"][:, 38:], 1.0, atol=0.02)
    assert (np.diff(made["diffuse"][24, :, 0]) > -0.01).all()
    # 256 cells in a window: a sixteenth of the noise, but where the filter believes a narrower one.
    inside = made["gloss"][8:40, 8:56, 0]
    assert inside.std() < 0.3 * noise.std()
    assert inside.mean() == pytest.approx(noise[4:44, 4:60].mean(), abs=0.03)


def test_who_doubts_more_believes_fewer_narrow_windows():
    """Rare bright cells: a block that has some is taken for bright, unless its variance is known to be found too low."""
    flat = FlatFilter(64, 48, pick_device("cpu"))
    for name in ("even_diffuse", "even_gloss"):
        flat.assign(name, np.ones((48, 64)))
    rare = 20.0 * (np.random.default_rng(0).uniform(size=(48, 64)) < 0.05)
    flat.assign("diffuse", rare)
    spread = [flat.run(doubt)["diffuse"][8:40, 8:56, 0].std() for doubt in (0.0, 0.5, 1.0, 2.0, 1e9)]
    assert (np.diff(spread) < 0.0).all()
    # At one end blocks as they are, at the other windows of 256 cells.
    assert spread[-1] == pytest.approx(rare.std() / 16.0, rel=0.4)
    assert spread[0] > 3.0 * spread[-1]


def test_other_bodies_and_other_depths_do_not_mix():
    flat = FlatFilter(32, 32, pick_device("cpu"))
    for name in ("even_diffuse", "even_gloss"):
        flat.assign(name, np.ones((32, 32)))
    left = np.arange(32)[None] * np.ones((32, 1)) < 16
    code = np.where(left, 1, 2).astype(np.uint8)
    flat.guide.segment.assign(code[None])
    flat.assign("diffuse", np.where(left, 0.2, 0.9))
    np.testing.assert_allclose(flat.run()["diffuse"][..., 0], np.where(left, 0.2, 0.9), rtol=1e-5)
    # The same body in another plane counts little: BODY_WEIGHT.
    flat.guide.segment.fill_(1)
    flat.guide.depth.assign(np.where(left, 1.0, 1.5)[None].astype(np.float32))
    np.testing.assert_allclose(flat.run()["diffuse"][..., 0], np.where(left, 0.2, 0.9), atol=0.05)


def pile(rng, count: int) -> ToyScene:
    """A thing in the origin and others of many shapes anywhere about it, seen from anywhere; some stand around the camera."""
    meshes = [box(0.16, 0.07, 0.2), ball(0.06, 2), box(0.3, 0.004, 0.02), sheet(0.2, 0.1), box(0.02, 0.02, 0.02)]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    view = camera(83, 46, rng.uniform(40.0, 250.0), tuple(turn.T @ (0.0, 0.0, -rng.uniform(0.1, 1.5))), turn)
    placed = []
    for number in range(count):
        quaternion = rng.normal(size=4)
        position = rng.uniform(-0.4, 0.4, 3) * min(number, 1)
        placed.append((int(rng.integers(len(meshes))), (*position, *(quaternion / np.linalg.norm(quaternion)))))
    return ToyScene([entry(mesh) for mesh in meshes], [placed], (view,), room=count + 2)


@pytest.mark.parametrize("seed", range(12))
def test_no_body_that_a_tiles_rays_meet_is_left_out(device, seed):
    toy = pile(np.random.default_rng(seed), 14)
    out, renderer = traced(toy, device)
    candidates = renderer.bodies.body_mask.numpy()[0].copy()
    present = renderer.bodies.present.numpy()[0]
    assert present == 14
    kept = {name: getattr(out, name).numpy().copy() for name in ("instance", "depth", "amodal")}
    renderer.bodies.body_mask.fill_(wp.uint64((1 << 14) - 1))
    zero = wp.zeros(1, dtype=wp.int32, device=device)
    renderer.rasterize(make_views(zero, zero, 1, toy.room), out)
    for name, image in kept.items():
        np.testing.assert_array_equal(image, getattr(out, name).numpy())
    counts = np.array([int(value).bit_count() for value in candidates])
    assert counts.max() <= present
    assert counts.mean() < 0.9 * present
    assert (kept["instance"] > 0).any()


@pytest.mark.parametrize("seed", range(4))
def test_bodies_are_listed_the_nearest_first_and_the_tote_last(device, seed):
    toy = pile(np.random.default_rng(seed), 9)
    toy.fixtures_visible = (1, 0, 1)
    _, renderer = traced(toy, device)
    mesh, near, order = (getattr(renderer.bodies, name).numpy()[0] for name in ("mesh", "near", "order"))
    present = int(renderer.bodies.present.numpy()[0])
    there = np.flatnonzero(mesh >= 0)
    assert present == len(there) == 11
    assert set(order[:present]) == set(there)
    tote = toy.room
    others = there[there != tote]
    np.testing.assert_array_equal(order[:present], [*others[np.argsort(near[others], kind="stable")], tote])
