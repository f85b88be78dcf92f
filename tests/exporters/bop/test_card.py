"""Dataset card of shards: header as Hugging Face's `datasets` reads it, offline and in a process of its own; size categories; licence."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.schema import Config, Split
from synpick_warp.exporters.bop.shards.card import CARD_FILE, CardContent, SplitContent, hub_splits, make_card, size_category
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from tests.harness.exporter_contract import export
from tests.worlds.box_views import batches, cameras, config

LAYERS = ("flow", "classes")
SPLITS = (
    Split("train", 2, 0, "pick", "train_pbr"),
    Split("test", 1, 2, "pick", "test_pbr"),
    Split("val", 5, 9, "pick", "val_pbr"),
)
"""The last one has not been baked."""
CONTENT = CardContent((SplitContent("train", "train_pbr_web", 18, 6, 1234567),), True, ".jpg", True, 24, LAYERS, ("blur",))
READ = """
import datasets, json, sys
import numpy as np

datasets.disable_progress_bars()
answers = []
sets = (datasets.load_dataset(**arguments, cache_dir=sys.argv[2]) for arguments in json.loads(sys.argv[1]))
for split, views in (item for each in sets for item in each.items()):
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
    """Two splits of an episode each: the first has no sun, the second does."""
    settings = dataclasses.replace(config(LAYERS), splits=SPLITS)
    return export(ShardsExporter, tmp_path_factory.mktemp("card") / "set", settings, (0, 2))


def load(cache: Path, *arguments: dict[str, str]) -> list[dict]:
    """Each split of what `datasets.load_dataset` gives for each of these arguments."""
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "HF_HOME": str(cache)}
    command = (sys.executable, "-c", READ, json.dumps(arguments), str(cache))
    return json.loads(subprocess.run(command, env=environment, capture_output=True, check=True, text=True).stdout)


def test_datasets_reads_all_views_through_the_card(dataset, tmp_path):
    pytest.importorskip("datasets")
    train, test, by_files = load(
        tmp_path,
        {"path": str(dataset)},
        {"path": "webdataset", "data_dir": str(dataset / "train_pbr_web"), "data_files": "*.tar"},
    )
    keys = [f"{scene:06d}_{frame:06d}" for scene in (0, 1, 2, 6, 7, 8) for frame in range(3)]
    assert (train["split"], test["split"]) == ("train", "test")
    assert (train["keys"], test["keys"], by_files["keys"]) == (keys[:9], keys[9:], keys[:9])
    assert train["direction"] == 9 * [None]
    assert test["direction"] == 9 * [[0.0, 0.6, 0.8]]
    for split in (train, test):
        assert split["instances"] == 9 * [[0, 2, 3]]
        assert split["masks"] == 9 * [["0", "1", "2"]]
        assert split["sizes"] == 9 * [[96, 72]]
    *_, last = batches(1, (2,), 3, cameras())
    assert test["depth"] == last.depth[0].tolist()


def test_card_describes_split_sizes_and_licence():
    text = make_card(CONTENT)
    assert text.startswith("---\nlicense: mit\n")
    assert "  - split: train\n    path: train_pbr_web/shard-*.tar\n" in text
    assert "18 views in 6 webdataset shards of 1,234,567 bytes" in text
    assert text.count('- name: "blur"') == 1
    splits = (CONTENT.splits[0], SplitContent("validation", "val_web", 2, 1, 10), SplitContent("test", "test_web", 0, 0, 0))
    others = make_card(dataclasses.replace(CONTENT, splits=splits, embedded=False, masks=False))
    assert "license: unknown\n" in others
    assert "set `license`" in others
    assert "  - split: train\n    path: train_pbr_web/shard-*.tar\n  - split: validation\n    path: val_web/shard-*.tar\n" in others
    assert "20 views in 7 webdataset shards of 1,234,577 bytes" in others
    assert "| train | train_pbr_web | 18 | 6 | 1,234,567 |\n| validation | val_web | 2 | 1 | 10 |\n" in others
    assert "test_web" not in others
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


def test_splits_are_named_as_on_the_hub():
    config = Config()
    assert hub_splits(DataLayout.of(config)) == ("train",)
    assert hub_splits(DataLayout.of(dataclasses.replace(config, bop=dataclasses.replace(config.bop, split="val_pbr")))) == ("validation",)
    assert hub_splits(DataLayout.of(dataclasses.replace(config, splits=SPLITS))) == ("train", "test", "validation")
    taken = Split("validation", 1, 20, "pick", "val_b_pbr")
    assert hub_splits(DataLayout.of(dataclasses.replace(config, splits=(*SPLITS, taken)))) == ("train", "test", "val", "validation")


def test_card_is_an_index_of_the_data_set(dataset):
    assert Path(CARD_FILE) in ShardsExporter.shared_files(DataLayout.of(Config())).indices
    assert (dataset / CARD_FILE).read_text().isascii()
