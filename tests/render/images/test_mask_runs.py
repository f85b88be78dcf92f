"""Run boundaries listed on the device against those that NumPy finds, and the masks that writers build from them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from synpick_warp.exporters.bop.view import ViewSettings, extract_masks, make_view_task
from synpick_warp.exporters.writing.rle import find_run_boundaries, unpack_run_boundaries
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import ViewBuffers, view_buffer_sizes
from synpick_warp.stages.render import mask_runs
from synpick_warp.stages.render.mask_runs import BoundaryBuffers, BoundaryScratch, boundary_sizes, list_boundaries
from tests.harness.exporter_contract import digests, exporting, finish
from tests.twins.masks import masks_of_batch, pack_into
from tests.worlds.box_views import batches, cameras, config, ends

LENSES = cameras()
SETTINGS = ViewSettings(".jpg", 95, (), masks=True, coco=True, camera={}, resolution=(LENSES[0].width, LENSES[0].height))


def list_on_device(instance: np.ndarray, masks: np.ndarray, device: wp.Device) -> BoundaryBuffers:
    """Lists of ids (B, H, W) and masks (B, I, H, W) bool, of which the last view is not in use."""
    views, rows, columns = instance.shape
    sizes = view_buffer_sizes(views, columns, rows, masks.shape[1])
    images = allocate(ViewBuffers, sizes, device)
    images.instance.assign(instance)
    pack_into(images, masks)
    scratch, out = (allocate(kind, boundary_sizes(sizes), device) for kind in (BoundaryScratch, BoundaryBuffers))
    out.boundary_count.fill_(-1)
    list_boundaries(scratch, views - 1, images, out)
    return out


def sample_blocks(rows: int, columns: int, instances: int = 40, views: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Ids (B, H, W) of random blocks with a few values, and masks (B, I, H, W) bool of such, up to the borders; some are empty."""
    random = np.random.default_rng(7)

    def blocks(*shape: int) -> np.ndarray:
        small = random.integers(0, 4, (*shape, -(-rows // 3), -(-columns // 2)))
        return np.repeat(np.repeat(small, 3, axis=-2), 2, axis=-1)[..., :rows, :columns]

    masks = blocks(views, instances) > 1
    masks[:, ::5] = False
    return np.array([0, 1, 9, 255], np.uint8)[blocks(views)], masks


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (9, 1), (14, 11), (64, 70), (31, 33), (70, 5)])
def test_device_lists_the_same_boundaries_as_numpy(device, shape):
    ids, masks = sample_blocks(*shape)
    lists = list_on_device(ids, masks, device)
    counts, boundaries, run_counts, runs = (array.numpy() for array in vars(lists).values())
    assert counts[-1] == -1
    assert not run_counts[-1].any()
    for view in range(2):
        expected, found = find_run_boundaries(ids[view]), unpack_run_boundaries(boundaries[view, :, : counts[view]], shape[0])
        for name in ("place", "span", "above", "below"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        edges = np.diff(np.pad(masks[view], ((0, 0), (1, 1), (0, 0))).astype(int), axis=1).swapaxes(1, 2).reshape(len(masks[view]), -1)
        np.testing.assert_array_equal(run_counts[view], np.count_nonzero(edges, axis=1))
        listed = runs[view, : run_counts[view].sum()]
        np.testing.assert_array_equal(listed, edges.nonzero()[1][: runs.shape[1]])


def test_boundaries_beyond_the_capacity_are_counted(device, monkeypatch):
    ids, masks = sample_blocks(14, 11)
    complete = list_on_device(ids, masks[:, :9], device)
    monkeypatch.setattr(mask_runs, "BOUNDARIES_PER_COLUMN", 1)
    cut = list_on_device(ids, masks[:, :9], device)
    for name in ("boundary_count", "run_count"):
        np.testing.assert_array_equal(getattr(cut, name).numpy(), getattr(complete, name).numpy())
    for count, name in (("boundary_count", "boundaries"), ("run_count", "runs")):
        part = getattr(cut, name).numpy()[:2]
        assert (getattr(cut, count).numpy()[:2].reshape(2, -1).sum(axis=1) > part.shape[-1]).all()
        np.testing.assert_array_equal(part, getattr(complete, name).numpy()[:2, ..., : part.shape[-1]])


def with_boundaries(batch, device):
    """The same views, with lists of run boundaries."""
    masks = np.stack([masks_of_batch(batch, view) for view in range(len(batch))])
    lists = list_on_device(*(np.concatenate((images, images[:1])) for images in (batch.instance, masks)), device)
    return dataclasses.replace(batch, **{name: array.numpy()[:-1] for name, array in vars(lists).items()})


def test_masks_are_the_same_from_lists_and_from_images(device):
    for batch in batches(4, (0, 2), 3, LENSES):
        lists = with_boundaries(batch, device)
        for view in range(len(batch)):
            (*_, first, second), truth = make_view_task(lists, view, 0, SETTINGS)
            assert truth.listed
            assert truth.run_count.size
            assert first.nbytes < batch.instance[view].nbytes
            (*_, instance, words), plain = make_view_task(batch, view, 0, SETTINGS)
            assert not plain.listed
            assert not plain.run_count.size
            height = batch.depth.shape[1]
            pairs = zip(extract_masks(first, second, truth, height), extract_masks(instance, words, plain, height), strict=True)
            for found, expected in pairs:
                for part in ("amodal", "visible"):
                    for name in ("column", "first", "past"):
                        np.testing.assert_array_equal(getattr(getattr(found, part), name), getattr(getattr(expected, part), name))


def test_lists_that_overflowed_or_are_large_are_not_used(device):
    batch = with_boundaries(next(batches(1, (0,), 1, LENSES)), device)
    truth = make_view_task(batch, 0, 0, SETTINGS)[1]
    assert truth.listed
    assert truth.run_count.size
    short = dataclasses.replace(batch, boundaries=batch.boundaries[..., : batch.boundary_count.max() - 1])
    noise = np.random.default_rng(0).integers(0, 256, batch.instance.shape).astype(np.uint8)
    for other in (short, with_boundaries(dataclasses.replace(batch, instance=noise), device)):
        images, truth = make_view_task(other, 0, 0, SETTINGS)
        assert not truth.listed
        assert truth.run_count.size
        assert images[2].dtype == np.uint8
    cut = dataclasses.replace(batch, runs=batch.runs[:, : batch.run_count[0].sum() - 1])
    images, truth = make_view_task(cut, 0, 0, SETTINGS)
    assert truth.listed
    assert not truth.run_count.size
    np.testing.assert_array_equal(images[3], batch.mask_words[0, : batch.mask_length[0]])


@pytest.mark.parametrize("kind", [BopExporter, ShardsExporter])
def test_files_are_the_same_from_lists_and_from_images(tmp_path, device, kind):
    found = []
    for name, change in (("images", lambda batch: batch), ("lists", lambda batch: with_boundaries(batch, device))):
        with exporting(kind, tmp_path / name, config()) as exporter:
            exporter.write_constants()
            for batch in batches(4, (0,), 3, LENSES):
                exporter.write_views(change(batch))
            exporter.end_episode(ends((0,), 3)[0], lambda: None)
            finish(exporter)
        found.append(digests(tmp_path / name))
    assert found[0] == found[1]
