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
from tests.worlds.box_views import batches, cameras, config, ends

LENSES = cameras()
SETTINGS = ViewSettings(".jpg", 95, (), masks=True, coco=True, camera={}, resolution=(LENSES[0].width, LENSES[0].height))


def list_on_device(instance: np.ndarray, amodal: np.ndarray, device: wp.Device) -> tuple[np.ndarray, np.ndarray]:
    """Counts and lists of run boundaries of images (B, H, W), of which the last view is not in use."""
    views, rows, columns = instance.shape
    sizes = view_buffer_sizes(views, columns, rows, 1)
    images = allocate(ViewBuffers, sizes, device)
    images.instance.assign(instance)
    images.amodal.assign(amodal)
    scratch, out = (allocate(kind, boundary_sizes(sizes), device) for kind in (BoundaryScratch, BoundaryBuffers))
    out.boundary_count.fill_(-1)
    list_boundaries(scratch, views - 1, images, out)
    return out.boundary_count.numpy(), out.boundaries.numpy()


def sample_blocks(rows: int, columns: int, views: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Instance and amodal images (B, H, W) of random blocks with a few values, up to the borders."""
    random = np.random.default_rng(7)
    small = random.integers(0, 4, (views, -(-rows // 3), -(-columns // 2)))
    blocks = np.repeat(np.repeat(small, 3, axis=1), 2, axis=2)[:, :rows, :columns]
    return np.array([0, 1, 9, 255], np.uint8)[blocks], np.array([0, 1, 2**31, 2**32 - 1], np.uint32)[blocks[:, ::-1]]


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (9, 1), (14, 11)])
def test_device_lists_the_same_boundaries_as_numpy(device, shape):
    images = sample_blocks(*shape)
    counts, boundaries = list_on_device(*images, device)
    assert (counts[-1] == -1).all()
    for view in range(2):
        for which, image in enumerate(images):
            packed = boundaries[view, which, :, : counts[view, which]]
            expected, found = find_run_boundaries(image[view]), unpack_run_boundaries(packed, shape[0])
            for name in ("place", "span", "above", "below"):
                np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_boundaries_beyond_the_capacity_are_counted(device, monkeypatch):
    images = sample_blocks(14, 11)
    complete, boundaries = list_on_device(*images, device)
    monkeypatch.setattr(mask_runs, "BOUNDARIES_PER_COLUMN", 1)
    counts, cut = list_on_device(*images, device)
    np.testing.assert_array_equal(counts, complete)
    assert (counts[:2] > cut.shape[-1]).all()
    np.testing.assert_array_equal(cut[:2], boundaries[:2, ..., : cut.shape[-1]])


def with_boundaries(batch, device):
    """The same views, with lists of run boundaries."""
    padded = [np.concatenate((image, image[:1])) for image in (batch.instance, batch.amodal)]
    counts, boundaries = list_on_device(*padded, device)
    return dataclasses.replace(batch, boundary_count=counts[:-1], boundaries=boundaries[:-1])


def test_masks_are_the_same_from_lists_and_from_images(device):
    for batch in batches(4, (0, 2), 3, LENSES):
        lists = with_boundaries(batch, device)
        for view in range(len(batch)):
            (*_, first, second), truth = make_view_task(lists, view, 0, SETTINGS)
            assert truth.listed
            assert first.nbytes < batch.instance[view].nbytes
            (*_, instance, amodal), plain = make_view_task(batch, view, 0, SETTINGS)
            height = batch.depth.shape[1]
            pairs = zip(extract_masks(first, second, truth, height), extract_masks(instance, amodal, plain, height), strict=True)
            for found, expected in pairs:
                for part in ("amodal", "visible"):
                    for name in ("column", "first", "past"):
                        np.testing.assert_array_equal(getattr(getattr(found, part), name), getattr(getattr(expected, part), name))


def test_lists_that_overflowed_or_are_large_are_not_used(device):
    batch = with_boundaries(next(batches(1, (0,), 1, LENSES)), device)
    assert make_view_task(batch, 0, 0, SETTINGS)[1].listed
    short = dataclasses.replace(batch, boundaries=batch.boundaries[..., : batch.boundary_count.max() - 1])
    noise = np.random.default_rng(0).integers(0, 256, batch.instance.shape).astype(np.uint8)
    for other in (short, with_boundaries(dataclasses.replace(batch, instance=noise), device)):
        images, truth = make_view_task(other, 0, 0, SETTINGS)
        assert not truth.listed
        assert images[2].dtype == np.uint8


@pytest.mark.parametrize("kind", [BopExporter, ShardsExporter])
def test_files_are_the_same_from_lists_and_from_images(tmp_path, device, kind):
    found = []
    for name, change in (("images", lambda batch: batch), ("lists", lambda batch: with_boundaries(batch, device))):
        with exporting(kind, tmp_path / name, config(), processes=0) as exporter:
            exporter.write_constants()
            for batch in batches(4, (0,), 3, LENSES):
                exporter.write_views(change(batch))
            exporter.end_episode(ends((0,), 3)[0], lambda: None)
            finish(exporter)
        found.append(digests(tmp_path / name))
    assert found[0] == found[1]
