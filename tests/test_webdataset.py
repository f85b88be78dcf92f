"""Decoder for shards against webdataset itself: full depth of images, masks, layers; what webdataset's own decoders make of 16 bits."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

from synpick_warp.dataset.webdataset import decode_view
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from synpick_warp.views.layer_codec import decode_layer, encode_layer
from tests.harness.exporter_contract import export
from tests.twins.masks import masks_of_batch
from tests.worlds.box_views import batches, cameras, config

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # Its import looks for torch.
    import webdataset

LENSES = cameras()


@pytest.fixture(scope="module")
def shard(tmp_path_factory) -> Path:
    out = export(ShardsExporter, tmp_path_factory.mktemp("decoder") / "set", config(("flow", "classes")), (0,))
    return out / "train_pbr_web" / "shard-000000.tar"


def read(shard: Path, *handlers: object) -> list[dict]:
    """All samples of a shard, through webdataset's own pipeline, which leaves its files to the garbage collector."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        return list(webdataset.WebDataset(str(shard), shardshuffle=False).decode(*handlers))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
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


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
def test_webdatasets_own_decoder_clips_depth_to_0_and_255(shard):
    """The reason why there is a decoder; if this fails, webdataset has learnt it."""
    depth = read(shard, "l8")[0]["depth.png"]
    assert depth.dtype == np.uint8
    assert set(np.unique(depth)) <= {0, 255}


@pytest.mark.parametrize("key", [".camera.json", ".txt", ".__key__"])
def test_other_entries_are_left_to_webdataset(key):
    assert decode_view(key, b"{}") is None


def test_views_without_instances_have_no_masks():
    assert decode_view(".mask.json", b"{}").shape == (0, 0, 0)


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
