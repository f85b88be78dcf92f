"""Dataset card of shards: header as Hugging Face's `datasets` reads it, offline and in a process of its own; size categories; licence."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from synpick_warp.configs.schema import Config
from synpick_warp.exporters.bop.card import CARD_FILE, CardContent, make_card, size_category
from synpick_warp.exporters.bop.shards import ShardsExporter
from tests.harness.exporter_contract import export
from tests.worlds.box_views import batches, cameras, config

LAYERS = ("flow", "classes")
CONTENT = CardContent("train_pbr", 18, 6, 1234567, True, ".jpg", True, 24, LAYERS, ("blur",))
READ = """
import datasets, json, sys
import numpy as np

datasets.disable_progress_bars()
answers = []
for arguments in json.loads(sys.argv[1]):
    (split, views), = datasets.load_dataset(**arguments, cache_dir=sys.argv[2]).items()
    views = sorted(views, key=lambda view: view["__key__"])
    answers.append({
        "split": split,
        "keys": [view["__key__"] for view in views],
        "direction": [view["camera.json"]["light"]["direction"] for view in views],
        "masks": [[index for index, mask in view["mask_visib.json"].items() if mask] for view in views],
        "depth": np.asarray(views[-1]["depth.png"]).astype(int).tolist(),
        "instances": [[row["instance_id"] for row in view["gt.json"]] for view in views],
        "sizes": [view["rgb.jpg"].size for view in views],
    })
print(json.dumps(answers))
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    """Two episodes: the first has no sun, the second does."""
    return export(ShardsExporter, tmp_path_factory.mktemp("card") / "set", config(LAYERS), (0, 2), processes=0)


def load(cache: Path, *arguments: dict[str, str]) -> list[dict]:
    """What `datasets.load_dataset` gives for each of these arguments."""
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "HF_HOME": str(cache)}
    command = (sys.executable, "-c", READ, json.dumps(arguments), str(cache))
    return json.loads(subprocess.run(command, env=environment, capture_output=True, check=True, text=True).stdout)


def test_datasets_reads_all_views_through_the_card(dataset, tmp_path):
    pytest.importorskip("datasets")
    by_card, by_files = load(
        tmp_path,
        {"path": str(dataset)},
        {"path": "webdataset", "data_dir": str(dataset / "train_pbr_web"), "data_files": "shard-00000[012].tar"},
    )
    keys = [f"{scene:06d}_{frame:06d}" for scene in (0, 1, 2, 6, 7, 8) for frame in range(3)]
    assert (by_card["split"], by_card["keys"], by_files["keys"]) == ("train", keys, keys[:9])
    assert by_card["direction"] == 9 * [None] + 9 * [[0.0, 0.6, 0.8]]
    assert by_card["instances"] == 18 * [[0, 2, 3]]
    assert by_card["masks"] == 18 * [["0", "1", "2"]]
    assert by_card["sizes"] == 18 * [[96, 72]]
    *_, last = batches(1, (2,), 3, cameras())
    assert by_card["depth"] == last.depth[0].tolist()


def test_card_describes_split_sizes_and_licence():
    text = make_card(CONTENT)
    assert text.startswith("---\nlicense: mit\n")
    assert "  - split: train\n    path: train_pbr_web/shard-*.tar\n" in text
    assert "18 views in 6 webdataset shards of 1,234,567 bytes" in text
    assert text.count('- name: "blur"') == 1
    others = make_card(dataclasses.replace(CONTENT, split="val", embedded=False, masks=False))
    assert "license: unknown\n" in others
    assert "set `license`" in others
    assert "split: validation\n    path: val_web/" in others
    assert "mask" not in others.partition("\n---\n")[0].replace("mask_", "")


@pytest.mark.parametrize(
    ("views", "category"),
    [
        (0, "n<1K"),
        (999, "n<1K"),
        (1000, "1K<n<10K"),
        (99_999, "10K<n<100K"),
        (100_000, "100K<n<1M"),
        (1_000_000, "1M<n<10M"),
        (10**11, "100B<n<1T"),
        (10**12, "n>1T"),
        (10**15, "n>1T"),
    ],
)
def test_size_categories_are_those_of_the_hub(views, category):
    assert size_category(views) == category


def test_card_is_an_index_of_the_data_set(dataset):
    assert Path(CARD_FILE) in ShardsExporter.shared_files(Config()).indices
    assert (dataset / CARD_FILE).read_text().isascii()
