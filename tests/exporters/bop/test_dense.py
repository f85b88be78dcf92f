"""A tick and views of 200 instances in all formats: read back by their clients, from lists and from words, and checked in float64."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import zarr

import synpick_warp
from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.configs.schema import Arrangement
from synpick_warp.exporters.bop.coco.exporter import CocoExporter
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from synpick_warp.exporters.bop.yolo.exporter import YoloExporter
from synpick_warp.exporters.trajectory.exporter import TrajectoryExporter
from synpick_warp.exporters.usd.exporter import UsdExporter
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.testing.box_views import cameras, ends, ticks
from synpick_warp.testing.exporters import digests, exporting, finish
from tests.harness.devices import default_device
from tests.twins.masks import masks_of_batch
from tests.worlds import trajectories
from tests.worlds.dense_views import dense_batch, dense_toy
from tools.checks import dataset as check
from tools.clients.base import pose_matrix
from tools.clients.trajectories import read_newton

COUNT = 200
LENSES = cameras(240, 180)


@pytest.fixture(scope="module")
def batch():
    return dense_batch(dense_toy(COUNT, LENSES, MAX_INSTANCES), pick_device(default_device()))


@pytest.fixture(scope="module")
def masks(batch) -> list[np.ndarray]:
    """Amodal masks of each view (N, H, W)."""
    return [masks_of_batch(batch, view)[:COUNT] for view in range(len(batch))]


def write(kind: type, out: Path, batch) -> Path:
    """A data set of one frame."""
    settings = dataclasses.replace(trajectories.config(), arrangement=Arrangement(max_objects=MAX_INSTANCES))
    tick = dataclasses.replace(next(ticks(1, (0,), 1)), object_id=batch.object_id[:1], pose=batch.pose[:1])
    with exporting(kind, out, settings, 0, LENSES) as exporter:
        exporter.write_constants()
        exporter.write_ticks(trajectories.with_physics(tick))
        exporter.write_views(batch)
        exporter.end_episode(ends((0,), 1)[0], lambda: None)
        finish(exporter)
    return out


@pytest.fixture(scope="module")
def bop(batch, tmp_path_factory) -> Path:
    return write(BopExporter, tmp_path_factory.mktemp("dense") / "set", batch)


def test_masks_and_counts_of_files_are_those_of_the_renderer(bop, batch, masks):
    """In scenes and in shards; without a manifest, each camera's scene is an episode."""
    for folder in (bop, write(ShardsExporter, bop.parent / "shards", batch)):
        for camera, expected in enumerate(masks):
            view = synpick_warp.open(folder)[camera].view(0)
            np.testing.assert_array_equal(view.amodal_masks, expected)
            np.testing.assert_array_equal(view.masks, batch.instance[camera] == 1 + np.arange(COUNT)[:, None, None])
            infos = view.records.gt_info
            assert [info["px_count_visib"] for info in infos] == view.masks.sum(axis=(1, 2)).tolist()
            beyond = np.array([info["px_count_all"] for info in infos]) - expected.sum(axis=(1, 2))
            assert (beyond >= 0).all()
            assert (beyond == 0).sum() > COUNT // 10
    assert len(np.unique(batch.instance)) > 60


def test_an_independent_check_in_float64_finds_nothing(bop):
    check.read_json.cache_clear()
    check.read_model.cache_clear()
    report = check.check(bop, 3)
    assert [name for name, measure in vars(report).items() if not measure.holds] == []


@pytest.mark.parametrize("kind", [BopExporter, CocoExporter, ShardsExporter, YoloExporter])
def test_files_are_the_same_from_lists_and_from_words(kind, batch, tmp_path):
    words = dataclasses.replace(batch, boundaries=None, boundary_count=None, runs=None, run_count=None)
    assert digests(write(kind, tmp_path / "lists", batch)) == digests(write(kind, tmp_path / "words", words))


def read_zarr(out: Path) -> tuple[np.ndarray, np.ndarray]:
    """Instances and poses (N, 4, 4) in the first tick of the zarr store."""
    tick = zarr.open_group(out / "trajectory.zarr", mode="r")["episodes/000000/ticks"]
    present = np.flatnonzero(tick["object_id"][0] >= 0)
    return present, np.array([pose_matrix(pose) for pose in tick["pose"][0][present]])


def read_usd(out: Path) -> tuple[np.ndarray, np.ndarray]:
    """Instances and poses (N, 4, 4) of the bodies that Newton imports."""
    values = read_newton(out / "usd" / "000000.usdc", out, "").values
    return values["instance_id"], values["object_to_world"]


@pytest.mark.parametrize(("kind", "read"), [(TrajectoryExporter, read_zarr), (UsdExporter, read_usd)])
def test_stores_of_trajectories_have_every_body(batch, tmp_path, kind, read):
    present, poses = read(write(kind, tmp_path / "set", batch))
    assert present.tolist() == list(range(COUNT))
    np.testing.assert_allclose(poses, [pose_matrix(pose) for pose in batch.pose[0, :COUNT]], atol=1e-6)
