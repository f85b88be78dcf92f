"""Data sets for training: samples of PyTorch are the views that were written, also in pickled copies and in batches by PyTorch or its
stand-in; the decoder for shards against webdataset itself, and what webdataset's own decoders make of 16 bits."""

from __future__ import annotations

import importlib.util
import json
import pickle
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

import synpick_warp
from synpick_warp.dataset.pytorch import FIELDS, Views, collate
from synpick_warp.dataset.webdataset import decode_view
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from synpick_warp.testing.box_views import batches, cameras, config
from synpick_warp.testing.exporters import FRAMES, export
from synpick_warp.views.layer_codec import decode_layer, encode_layer
from tests.twins.masks import masks_of_batch
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
    for wrong, said in (
        ({"cameras": (3,)}, "has the cameras 0 to 2"),
        ({"stride": 0}, "stride 0: at least 1"),
        ({"split": "nowhere"}, "nowhere"),
        ({"fields": ("colour",)}, "there is no field colour"),
    ):
        with pytest.raises(DatasetError, match=said):
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


# ---- webdataset ----

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # Its import looks for torch.
    import webdataset

LEFT_OPEN = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
"""webdataset leaves its files to the garbage collector."""
LENSES = cameras()


@pytest.fixture(scope="module")
def shard(tmp_path_factory) -> Path:
    out = export(ShardsExporter, tmp_path_factory.mktemp("decoder") / "set", config(("flow", "classes")), (0,))
    return out / "train_pbr_web" / "shard-000000.tar"


def read(shard: Path, *handlers: object) -> list[dict]:
    """All samples of a shard, through webdataset's own pipeline."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        return list(webdataset.WebDataset(str(shard), shardshuffle=False).decode(*handlers))


@LEFT_OPEN
def test_webdatasets_pipeline_gives_what_was_written(shard):
    truth = [batch for batch in batches(1, (0,), 3, LENSES) if int(batch.camera[0]) == 0]
    samples = read(shard, decode_view)
    assert len(samples) == len(truth) == 3
    for sample, batch in zip(samples, truth, strict=True):
        assert sample["depth.png"].dtype == np.uint16
        np.testing.assert_array_equal(sample["depth.png"], batch.depth[0])
        assert sample["rgb.jpg"].flags.c_contiguous
        assert np.median(np.abs(sample["rgb.jpg"].astype(int) - batch.color[0])) <= 3
        np.testing.assert_array_equal(sample["classes.png"], batch.layers["classes"][0])
        expected = decode_layer("flow", encode_layer("flow", batch.layers["flow"][0]))
        np.testing.assert_array_equal(sample["flow.png"], expected)
        instances = [row["instance_id"] for row in sample["gt.json"]]
        np.testing.assert_array_equal(sample["mask_visib.json"], [batch.instance[0] == 1 + index for index in instances])
        np.testing.assert_array_equal(sample["mask.json"], masks_of_batch(batch)[instances])
        assert sample["camera.json"]["depth_scale"] == 0.1


@LEFT_OPEN
def test_webdatasets_own_decoder_clips_depth_to_0_and_255(shard):
    """The reason why there is a decoder; if this fails, webdataset has learnt it."""
    depth = read(shard, "l8")[0]["depth.png"]
    assert depth.dtype == np.uint8
    assert set(np.unique(depth)) <= {0, 255}


def test_views_without_instances_have_no_masks_and_other_entries_are_left_to_webdataset():
    assert decode_view(".mask.json", b"{}").shape == (0, 0, 0)
    assert [decode_view(key, b"{}") for key in (".camera.json", ".txt", ".__key__")] == [None] * 3


@pytest.mark.parametrize(
    ("key", "data", "message"),
    [
        (".depth.png", b"\x89PNG", "not an image"),
        (".rgb.jpg", cv2.imencode(".jpg", np.zeros((4, 4, 3), np.uint8))[1].tobytes()[:60], "not an image"),
        (".mask.json", b'{"0": {"counts": [5], "size": [2, 2]}}', "5 of 4 pixels"),
        (".mask.json", b'{"1": {"counts": [4], "size": [2, 2]}}', "does not number its masks from 0"),
        (".mask.json", json.dumps({"0": {"counts": [4], "size": [2, 2]}, "1": {"counts": [6], "size": [2, 3]}}).encode(), "3 x 2 pixels"),
        (".mask.json", b'{"0": {"counts": [100000000000], "size": [100000, 1000000]}}', "is damaged"),
    ],
)
def test_damaged_entries_are_one_error(key, data, message):
    with pytest.raises(DatasetError, match=message):
        decode_view(key, data)
