"""PyTorch dataset: samples are the views that were written; pickled copies give the same; batches by PyTorch or its stand-in."""

from __future__ import annotations

import importlib.util
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest

import synpick_warp
from synpick_warp.dataset.pytorch import FIELDS, Views, collate
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from tests.harness.exporter_contract import FRAMES
from tests.worlds.box_sets import EPISODES, write_set

STUBS = Path(__file__).parent / "stubs"


@pytest.fixture(scope="module", params=[BopExporter, ShardsExporter], ids=["bop", "shards"])
def folder(request, tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("torch") / "set", request.param)


@pytest.fixture
def torch(monkeypatch):
    """PyTorch, or its stand-in where it is not installed, which is gone after the test: other libraries would take it for PyTorch."""
    missing = importlib.util.find_spec("torch") is None
    if missing:
        monkeypatch.syspath_prepend(str(STUBS))
    import torch

    yield torch
    if missing:
        for name in [name for name in sys.modules if name.partition(".")[0] == "torch"]:
            del sys.modules[name]


def test_fields_are_checked_when_it_is_made(folder):
    with pytest.raises(DatasetError, match=r"no field depht; did you mean depth\?; fields: rgb, .*pick_weights; layers: .*normals"):
        Views(folder, fields=("rgb", "depht"))


def test_samples_are_views_in_order_with_what_is_visible_enough(folder):
    fields = (name for name in FIELDS if not name.startswith("pick_"))  # This set has no picks.
    views = Views(folder, fields=(*fields, "classes"), min_visibility=0.8)
    expected = [(episode, camera, frame) for episode in EPISODES for frame in range(FRAMES) for camera in range(3)]
    assert len(views) == len(expected)
    data = synpick_warp.open(folder)
    dropped = 0
    for index, (episode, camera, frame) in enumerate(expected):
        sample, view = views[index], data[episode].view(frame, camera)
        assert (sample["episode"], sample["camera"], sample["frame"]) == (episode, camera, frame)
        np.testing.assert_array_equal(sample["rgb"], view.rgb.transpose(2, 0, 1))
        np.testing.assert_array_equal(sample["depth"], view.depth[None])
        np.testing.assert_array_equal(sample["classes"], view.layer("classes"))
        kept = (view.visibility >= 0.8) & view.masks.any(axis=(1, 2))
        dropped += int((~kept).sum())
        np.testing.assert_array_equal(sample["masks"], view.masks[kept])
        np.testing.assert_array_equal(sample["object_ids"], view.object_ids[kept])
        np.testing.assert_allclose(sample["poses"], view.object_to_camera[kept], rtol=1e-6)
        for mask, (x_min, y_min, x_max, y_max) in zip(sample["masks"], sample["boxes"].astype(int), strict=True):
            rows, columns = np.nonzero(mask)
            assert (x_min, y_min, x_max, y_max) == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    assert dropped > 0
    assert views[-1]["frame"] == FRAMES - 1
    with pytest.raises(IndexError):
        views[len(expected)]


def test_choices_of_cameras_and_frames(folder):
    views = Views(folder, split="train", cameras=(2,), stride=2)
    assert [(sample["episode"], sample["camera"], sample["frame"]) for sample in views] == [(e, 2, f) for e in EPISODES for f in (0, 2)]
    for wrong in ({"cameras": (3,)}, {"stride": 0}, {"split": "nowhere"}, {"fields": ("colour",)}):
        with pytest.raises(DatasetError):
            Views(folder, **wrong)[0]


def test_a_pickled_copy_is_small_and_gives_the_same(folder):
    views = Views(folder)
    first = [views[index] for index in (3, 0)]
    data = pickle.dumps(views)
    assert len(data) < 5000
    for before, after in zip(first, (pickle.loads(data)[index] for index in (3, 0)), strict=True):
        assert before.keys() == after.keys()
        for name in before:
            np.testing.assert_array_equal(before[name], after[name])


def test_batches_of_workers_equal_those_of_this_process(folder, torch):
    views = Views(folder, fields=("rgb", "masks", "poses"))
    loaders = [torch.utils.data.DataLoader(views, batch_size=4, num_workers=workers, collate_fn=collate) for workers in (0, 2)]
    seen = []
    for alone, shared in zip(*loaders, strict=True):
        assert alone["rgb"].shape[1:] == (3, 72, 96)
        seen += [int(frame) for frame in alone["frame"]]
        np.testing.assert_array_equal(np.asarray(alone["rgb"]), np.asarray(shared["rgb"]))
        for one, other in zip(alone["masks"], shared["masks"], strict=True):
            np.testing.assert_array_equal(np.asarray(one), np.asarray(other))
    assert seen == [frame for _ in EPISODES for frame in range(FRAMES) for _ in range(3)]
