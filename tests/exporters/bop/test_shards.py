"""Webdataset shards written by the real pool from views of boxes, read back with webdataset, tarfile, OpenCV and pycocotools. Their card,
as Hugging Face's `datasets` reads it, offline and in a process of its own; size categories; licence."""

import contextlib
import dataclasses
import io
import json
import os
import subprocess
import sys
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco
from webdataset import tariterators

from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import Config, Split
from synpick_warp.exporters.bop import shards
from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.exporters.bop.shards import CARD_FILE, ShardsExporter, SplitContent, hub_splits, make_card, size_category
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.registry import Exporters
from synpick_warp.testing.box_views import batches, cameras, config, ends
from synpick_warp.testing.exporters import ExporterContract, export, export_context, exporting, finish, without_objects

EPISODES = (0, 2)
FRAMES = 3
SCENES = (0, 1, 2, 6, 7, 8)
LENSES = cameras()
LAYERS = ("flow", "classes")
ENTRIES = ("rgb.jpg", "depth.png", "camera.json", "gt.json", "gt_info.json", "mask.json", "mask_visib.json")


class TestShardsContract(ExporterContract):
    exporter_class, row = ShardsExporter, FORMAT_TABLE["shards"]

    @classmethod
    def config(cls) -> Config:
        return config(LAYERS)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return export(ShardsExporter, tmp_path_factory.mktemp("shards") / "set", config(), EPISODES)


@pytest.fixture(scope="module")
def split(dataset) -> Path:
    return dataset / "train_pbr_web"


def samples(split: Path) -> dict[str, dict[str, bytes]]:
    """All views by key, as `webdataset.WebDataset` reads them, but without its opener, which leaves files open."""
    with contextlib.ExitStack() as stack:
        shards = [{"url": str(path), "stream": stack.enter_context(path.open("rb"))} for path in sorted(split.glob("shard-*.tar"))]
        read = list(tariterators.group_by_keys(tariterators.tar_file_expander(shards)))
    views = {sample["__key__"]: sample for sample in read}
    assert len(views) == len(read)
    return views


def decode(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


def test_one_shard_per_scene_and_bops_common_files(dataset, split):
    assert {path.name for path in split.iterdir()} == {"key_to_shard.json", *(f"shard-{scene:06d}.tar" for scene in SCENES)}
    names = {"README.md", "bop_dataset_params.py", "camera.json", "dataset_info.md", "models", "models_eval", "train_pbr_web"}
    assert {path.name for path in dataset.iterdir()} == names


def toolkit_mask(record: dict) -> np.ndarray:
    """Decode like bop_toolkit_lib.pycoco_utils.rle_to_binary_mask: column-major runs that alternate between False and True."""
    counts = record["counts"]
    return np.repeat(np.arange(len(counts)) % 2 == 1, counts).reshape(record["size"], order="F")


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
def test_views_that_webdataset_reads_equal_those_of_the_bop_format(split, tmp_path):
    folders = export(BopExporter, tmp_path / "set", config(), EPISODES) / "train_pbr"
    views = samples(split)
    assert list(views) == [f"{scene:06d}_{frame:06d}" for scene in SCENES for frame in range(FRAMES)]
    assert list(views) == list(json.loads((split / "key_to_shard.json").read_text()))
    for key, view in views.items():
        scene, frame = key.split("_")
        assert {name for name in view if not name.startswith("__")} == set(ENTRIES)
        assert view["rgb.jpg"] == (folders / scene / "rgb" / f"{frame}.jpg").read_bytes()
        assert view["depth.png"] == (folders / scene / "depth" / f"{frame}.png").read_bytes()
        for name in ("camera", "gt", "gt_info"):
            theirs = json.loads((folders / scene / f"scene_{name}.json").read_text())
            assert json.loads(view[f"{name}.json"]) == theirs[str(int(frame))]
        infos = json.loads(view["gt_info.json"])
        for kind in ("mask", "mask_visib"):
            masks = json.loads(view[f"{kind}.json"])
            assert list(masks) == [str(index) for index in range(len(infos))]
            for index, record in masks.items():
                file = cv2.imread(str(folders / scene / kind / f"{frame}_{int(index):06d}.png"), cv2.IMREAD_UNCHANGED)
                compressed = coco.frPyObjects(record, *record["size"])
                np.testing.assert_array_equal(255 * toolkit_mask(record), file)
                np.testing.assert_array_equal(255 * coco.decode(compressed), file)
                if kind == "mask_visib" and infos[int(index)]["px_count_visib"]:
                    x, y, width, height = coco.toBbox(compressed)
                    assert infos[int(index)]["bbox_visib"] == [x, y, width - 1, height - 1]
                    assert infos[int(index)]["px_count_visib"] == coco.area(compressed)


def test_layers_equal_those_of_the_bop_format(tmp_path):
    folders = export(BopExporter, tmp_path / "bop", config(LAYERS), (2,)) / "train_pbr"
    views = samples(export(ShardsExporter, tmp_path / "shards", config(LAYERS), (2,)) / "train_pbr_web")
    assert list(views) == [f"{scene:06d}_{frame:06d}" for scene in (6, 7, 8) for frame in range(FRAMES)]
    for key, view in views.items():
        scene, frame = key.split("_")
        assert [name for name in view if not name.startswith("__")] == [*ENTRIES, "flow.png", "classes.png"]
        for name in LAYERS:
            assert view[f"{name}.png"] == (folders / scene / name / f"{frame}.png").read_bytes()


def test_tar_files_are_reproducible_and_well_formed(split):
    for path in split.glob("*.tar"):
        with tarfile.open(path) as shard:
            for info in shard:
                assert (info.mtime, info.uid, info.gid, info.uname, info.gname, info.mode) == (0, 0, 0, "", "", 0o644)
        data = path.read_bytes()
        assert len(data) % 512 == 0
        assert not any(data[-1024:])
        copy = io.BytesIO()
        with (
            tarfile.open(fileobj=io.BytesIO(data)) as shard,
            tarfile.open(fileobj=copy, mode="w", format=tarfile.USTAR_FORMAT) as again,
        ):
            for info in shard:
                again.addfile(info, shard.extractfile(info))
        assert copy.getvalue().rstrip(b"\0") == data.rstrip(b"\0")


def test_views_without_objects_are_written(tmp_path):
    export(ShardsExporter, tmp_path, config(), (1,), frames=1, prepare=without_objects)
    views = samples(tmp_path / "train_pbr_web")
    assert list(views) == ["000003_000000", "000004_000000", "000005_000000"]
    for view in views.values():
        assert [json.loads(view[f"{name}.json"]) for name in ("gt", "gt_info", "mask", "mask_visib")] == [[], [], {}, {}]


def test_png_colour_without_masks(tmp_path):
    out = export(ShardsExporter, tmp_path, config(split="test", color_format="png", masks=False), (0,), frames=1)
    with tarfile.open(out / "test_web" / "shard-000000.tar") as shard:
        entries = ("rgb.png", "depth.png", "camera.json", "gt.json", "gt_info.json")
        assert shard.getnames() == [f"000000_000000.{entry}" for entry in entries]
        np.testing.assert_array_equal(
            decode(shard.extractfile("000000_000000.rgb.png").read())[..., ::-1], next(batches(1, (0,), 1, LENSES)).color[0]
        )


def test_a_long_scene_has_several_shards(tmp_path, dataset, monkeypatch):
    monkeypatch.setattr(shards, "MAX_SHARD_VIEWS", 2)
    out = tmp_path / "set"
    with exporting(ShardsExporter, out, config()) as exporter:
        exporter.write_constants()
        for batch in batches(4, (2,), FRAMES, LENSES):
            exporter.write_views(batch)
        exporter.end_episode(ends((2,), FRAMES)[0], lambda: None)
        finish(exporter)
        names = [f"train_pbr_web/shard-{number:06d}.tar" for number in (6, 7, 8, 1_000_006, 1_000_007, 1_000_008)]
        assert sorted(names) == [str(path) for path in exporter.files(2)]
    split = out / "train_pbr_web"
    keys, views = json.loads((split / "key_to_shard.json").read_text()), samples(split)
    assert (keys["000006_000001"], keys["000006_000002"]) == (6, 1_000_006)
    assert sorted(keys) == sorted(views)
    assert len(views) == 3 * FRAMES
    for key, index in keys.items():
        with tarfile.open(split / f"shard-{index:06d}.tar") as shard:
            assert all(shard.extractfile(f"{key}.{entry}").read() == views[key][entry] for entry in ENTRIES)
    whole = samples(dataset / "train_pbr_web")
    assert all(whole[key][entry] == views[key][entry] for key in keys for entry in ENTRIES)


def test_an_empty_data_set_has_an_empty_key_index_and_files_shared_with_the_bop_format_once(tmp_path):
    with exporting(ShardsExporter, tmp_path, config()) as exporter:
        constants = Exporters((BopExporter, ShardsExporter), export_context(exporter)).write_constants()
        assert finish(exporter) == [Path("train_pbr_web/key_to_shard.json"), Path("README.md")]
    assert {path.name: json.loads(path.read_text()) for path in (tmp_path / "train_pbr_web").iterdir()} == {"key_to_shard.json": {}}
    assert sorted(map(str, constants)) == ["bop_dataset_params.py", "camera.json", "dataset_info.md", "models", "models_eval"]


# ---- the card of shards ----

SPLITS = (Split("train", 2, 0, "pick", "train_pbr"), Split("test", 1, 2, "pick", "test_pbr"), Split("val", 5, 9, "pick", "val_pbr"))
"""The last one has not been baked."""
TRAIN = SplitContent("train", "train_pbr_web", 18, 6, 1234567)
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
def two_splits(tmp_path_factory) -> Path:
    """Two splits of an episode each: the first has no sun, the second does."""
    settings = dataclasses.replace(config(LAYERS), splits=SPLITS)
    return export(ShardsExporter, tmp_path_factory.mktemp("card") / "set", settings, (0, 2))


def load(cache: Path, *arguments: dict[str, str]) -> list[dict]:
    """Each split of what `datasets.load_dataset` gives for each of these arguments."""
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "HF_HOME": str(cache)}
    command = (sys.executable, "-c", READ, json.dumps(arguments), str(cache))
    return json.loads(subprocess.run(command, env=environment, capture_output=True, check=True, text=True).stdout)


def test_datasets_reads_all_views_through_the_card(two_splits, tmp_path):
    pytest.importorskip("datasets")
    train, test, by_files = load(
        tmp_path,
        {"path": str(two_splits)},
        {"path": "webdataset", "data_dir": str(two_splits / "train_pbr_web"), "data_files": "*.tar"},
    )
    assert (two_splits / CARD_FILE).read_text().isascii()
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
    settings = dataclasses.replace(ExportSettings.of(config(LAYERS)), effects=("blur",))
    text = make_card(settings, [TRAIN])
    assert text.startswith("---\nlicense: mit\n")
    assert "  - split: train\n    path: train_pbr_web/shard-*.tar\n" in text
    assert "18 views in 6 webdataset shards of 1,234,567 bytes" in text
    assert text.count('- name: "blur"') == 1
    splits = (TRAIN, SplitContent("validation", "val_web", 2, 1, 10), SplitContent("test", "test_web", 0, 0, 0))
    others = make_card(ExportSettings.of(config(LAYERS, masks=False).with_values({"bake.lights": "own"})), splits)
    assert "license: unknown\n" in others
    assert "set `license`" in others
    assert "  - split: train\n    path: train_pbr_web/shard-*.tar\n  - split: validation\n    path: val_web/shard-*.tar\n" in others
    assert "20 views in 7 webdataset shards of 1,234,577 bytes" in others
    assert "| train | train_pbr_web | 18 | 6 | 1,234,567 |\n| validation | val_web | 2 | 1 | 10 |\n" in others
    assert "test_web" not in others
    assert "mask" not in others.partition("\n---\n")[0].replace("mask_", "")


CATEGORIES = {0: "n<1K", 999: "n<1K", 1000: "1K<n<10K", 99_999: "10K<n<100K", 100_000: "100K<n<1M", 1_000_000: "1M<n<10M"}
CATEGORIES |= {10**11: "100B<n<1T", 10**12: "n>1T", 10**15: "n>1T"}


def test_size_categories_are_those_of_the_hub():
    assert {views: size_category(views) for views in CATEGORIES} == CATEGORIES


def test_splits_are_named_as_on_the_hub():
    taken = Split("validation", 1, 20, "pick", "val_b_pbr")
    for given, names in (({}, ("train",)), ({"bop.split": "val_pbr"}, ("validation",))):
        assert hub_splits(DataLayout.of(Config().with_values(given))) == names
    for splits, names in ((SPLITS, ("train", "test", "validation")), ((*SPLITS, taken), ("train", "test", "val", "validation"))):
        assert hub_splits(DataLayout.of(dataclasses.replace(Config(), splits=splits))) == names
