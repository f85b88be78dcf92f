"""Observations: boxes, crops and feature transforms of instances' masks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.stages.pose.batch import RgbdBatch
from tests.twins import pose as twin
from tests.worlds.pose_views import COUNT, drawn, observe, table_of

WIDTH, HEIGHT, FOCAL = 96, 72, 100.0
TABLE = table_of((0, 0, 0), (1, 3, 0), (0, 6, 0), (1, 0, 0))
"""Two views with two instances each; further labels are nobody's."""


def random_batch(seed: int, cell: int) -> RgbdBatch:
    """Two views with labels 0 to 8 in blobs of `cell` px, noisy colours, and depth with holes."""
    random = np.random.default_rng(seed)
    labels = random.integers(0, 9, (2, HEIGHT // cell + 1, WIDTH // cell + 1))
    label = labels.repeat(cell, axis=1).repeat(cell, axis=2)[:, :HEIGHT, :WIDTH]
    depth = random.integers(50_000, 60_000, label.shape) * (random.uniform(size=label.shape) > 0.2)
    return RgbdBatch(
        color=random.integers(0, 256, (*label.shape, 3), dtype=np.uint8),
        depth=depth.astype(np.uint16),
        depth_scale=np.full(2, COUNT, np.float32),
        label=label.astype(np.uint8),
        intrinsics=np.tile(np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], np.float32), (2, 1)),
    )


def masks(batch: RgbdBatch, table=TABLE) -> list[np.ndarray]:
    return [batch.label[view] == slot + 1 for view, slot in zip(table.view, table.slot, strict=True)]


def linear(batch: RgbdBatch) -> np.ndarray:
    return srgb_to_linear(batch.color / 255.0)


def rectangle(height: int, width: int, rows: slice, columns: slice) -> RgbdBatch:
    """A view with one rectangular mask before noisy colours."""
    label = np.zeros((height, width), np.uint8)
    label[rows, columns] = 1
    color = np.random.default_rng(1).uniform(0.0, 1.0, (height, width, 3))
    return drawn(label, np.full((height, width), 0.5), FOCAL, color)


def test_a_rectangle_in_the_corner_of_the_image(device):
    batch = rectangle(20, 30, slice(14, 20), slice(25, 30))
    seen = observe(batch, table_of((0, 0, 0), (0, 1, 0)), device).observation
    assert seen.box.numpy().tolist() == [[25, 14, 29, 19], [30, 20, -1, -1]]
    assert seen.pixels.numpy().tolist() == [30, 0]
    assert seen.inside.numpy()[0].sum() == 30
    assert seen.points.numpy().tolist() == [30, 0]


@given(seed=st.integers(0, 2**32 - 1), cell=st.sampled_from([1, 3, 10, 40]))
def test_boxes_and_sizes_are_those_of_the_masks(device, seed, cell):
    batch = random_batch(seed, cell)
    seen = observe(batch, TABLE, device).observation
    boxes, sizes = zip(*(twin.find_box(mask) for mask in masks(batch)), strict=True)
    assert seen.box.numpy().tolist() == list(boxes)
    assert seen.pixels.numpy().tolist() == list(sizes)


@pytest.mark.parametrize("cell", [1, 3, 10, 40])
def test_crops_sample_mask_and_colour(device, cell):
    batch = random_batch(cell, cell)
    seen = observe(batch, TABLE, device).observation
    corner, pitch = seen.corner.numpy(), seen.pitch.numpy()
    # Where samples lie on the border of two pixels, a GPU's rounding decides; random pixels differ there.
    for row, mask in enumerate(masks(batch)):
        if mask.any():
            firm = np.ones((twin.CROP, twin.CROP), bool) if device.is_cpu else ~twin.on_borders(corner[row], pitch[row])
            assert firm.mean() > 0.8
            inside = seen.inside.numpy()[row] != twin.sample_mask(mask, corner[row], pitch[row])
            assert not inside[firm].any()
            color = twin.sample_color(linear(batch)[TABLE.view[row]], mask, corner[row], pitch[row])
            assert np.abs(seen.color.numpy()[row] - color).max(axis=-1)[firm].max() <= 1e-5


@pytest.mark.parametrize("size", [1, 17, 40, 57, 58, 90, 300])
def test_the_crop_holds_the_mask_with_a_margin(device, size):
    batch = rectangle(320, 340, slice(7, 7 + size), slice(12, 12 + max(size // 2, 1)))
    seen = observe(batch, table_of((0, 0, 0)), device).observation
    pitch, corner = seen.pitch.numpy()[0], seen.corner.numpy()[0]
    assert pitch == pytest.approx(max(1.0, 1.12 * size / twin.CROP))
    box = seen.box.numpy()[0]
    end = corner + twin.CROP * pitch
    assert (corner <= box[:2] - 0.06 * size + 0.51).all()
    assert (end >= box[2:] + 1 + 0.06 * size - 0.51).all()


def test_a_crop_pixel_is_the_box_mean_of_its_footprint(device):
    # 400 px and the margins are 7 px a crop pixel.
    batch = rectangle(460, 460, slice(30, 430), slice(20, 420))
    seen = observe(batch, table_of((0, 0, 0)), device).observation
    assert seen.pitch.numpy()[0] == pytest.approx(7.0)
    left, top = np.rint(seen.corner.numpy()[0]).astype(int)
    assert (left, top) == (220 - 224, 230 - 224)
    footprints = linear(batch)[0][top + 7 : top + 63 * 7, left + 7 : left + 63 * 7].reshape(62, 7, 62, 7, 3)
    shown = batch.label[0][top + 7 : top + 63 * 7, left + 7 : left + 63 * 7].reshape(62, 7, 62, 7)
    whole = shown.all(axis=(1, 3))
    assert whole.sum() > 55 * 55
    assert seen.color.numpy()[0, 1:63, 1:63][whole] == pytest.approx(footprints.mean(axis=(1, 3))[whole], abs=1e-5)
    assert (seen.color.numpy()[0, 1:63, 1:63][~shown.any(axis=(1, 3))] == 0.0).all()


@pytest.mark.parametrize(("height", "width"), [(20, 30), (21, 31), (20, 31), (21, 30)])
def test_crop_pixels_of_a_small_mask_are_image_pixels(device, height, width):
    """Their centres coincide, too: half a pixel beside, silhouettes and colours would be drawn to one side."""
    batch = rectangle(90, 90, slice(30, 30 + height), slice(35, 35 + width))
    seen = observe(batch, table_of((0, 0, 0)), device).observation
    assert seen.pitch.numpy()[0] == 1.0
    corner = seen.corner.numpy()[0]
    assert corner.tolist() == np.rint(corner).tolist()
    left, top = corner.astype(int)
    rows, columns = slice(max(-top, 0), min(64, 90 - top)), slice(max(-left, 0), min(64, 90 - left))
    shown = linear(batch)[0][top + rows.start : top + rows.stop, left + columns.start : left + columns.stop]
    mask = batch.label[0][top:, left:][: rows.stop, : columns.stop][rows, columns] == 1
    assert seen.color.numpy()[0, rows, columns] == pytest.approx(np.where(mask[..., None], shown, 0.0), abs=1e-5)
    assert (seen.inside.numpy()[0, rows, columns] == (batch.label[0][top:, left:][: rows.stop, : columns.stop] == 1)).all()


@pytest.mark.parametrize("cell", [1, 3, 10, 40])
def test_feature_transform_is_the_exact_distance_transform(device, cell):
    batch = random_batch(100 + cell, cell)
    seen = observe(batch, TABLE, device).observation
    for row, mask in enumerate(masks(batch)):
        inside, offset = seen.inside.numpy()[row] > 0, seen.nearest.numpy()[row]
        if mask.any() and inside.any():
            assert np.linalg.norm(offset, axis=-1) == pytest.approx(ndimage.distance_transform_edt(~inside), abs=1e-5)
            rows, columns = np.indices(inside.shape)
            assert inside[rows + offset[..., 1].astype(int), columns + offset[..., 0].astype(int)].all()


def test_an_observer_forgets_the_batch_before(device):
    table = table_of((0, 0, 0))
    full = rectangle(80, 80, slice(10, 60), slice(10, 60))
    observer = observe(full, table, device)
    first = {name: getattr(observer.observation, name).numpy() for name in ("box", "inside", "point", "nearest", "color")}
    empty = drawn(np.zeros((80, 80), np.uint8), np.full((80, 80), 0.5), FOCAL)
    observer.observe(empty)
    assert observer.observation.points.numpy().tolist() == [0]
    assert observer.observation.pixels.numpy().tolist() == [0]
    observer.observe(full)
    for name, value in first.items():
        assert np.array_equal(getattr(observer.observation, name).numpy(), value), name
