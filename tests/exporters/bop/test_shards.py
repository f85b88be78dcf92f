"""Webdataset shards written by the real pool from views of boxes, read back with webdataset, tarfile, OpenCV and pycocotools."""

from __future__ import annotations

import contextlib
import io
import json
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco
from webdataset import tariterators

from synpick_warp.configs.schema import Config
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.shards import tar_files
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from synpick_warp.exporters.registry import Exporters
from tests.harness.exporter_contract import ExporterContract, digests, export, export_context, exporting, finish, without_objects
from tests.twins.masks import masks_of_batch
from tests.worlds.box_views import batches, cameras, config, ends

EPISODES = (0, 2)
FRAMES = 3
SCENES = (0, 1, 2, 6, 7, 8)
LENSES = cameras()
LAYERS = ("flow", "classes")
ENTRIES = ("rgb.jpg", "depth.png", "camera.json", "gt.json", "gt_info.json", "mask.json", "mask_visib.json")


class TestShardsContract(ExporterContract):
    exporter_class = ShardsExporter

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


def test_webdataset_reads_back_the_views(split):
    views = samples(split)
    assert list(views) == [f"{scene:06d}_{frame:06d}" for scene in SCENES for frame in range(FRAMES)]
    for batch in batches(1, EPISODES, FRAMES, LENSES):
        view = views[f"{3 * int(batch.episode[0]) + int(batch.camera[0]):06d}_{int(batch.frame[0]):06d}"]
        assert {name for name in view if not name.startswith("__")} == set(ENTRIES)
        np.testing.assert_array_equal(decode(view["depth.png"]), batch.depth[0])
        assert np.median(np.abs(decode(view["rgb.jpg"])[..., ::-1].astype(int) - batch.color[0])) <= 3
        truth = json.loads(view["gt.json"])
        assert [record["instance_id"] for record in truth] == [0, 2, 3]
        for index, record in enumerate(truth):
            instance = record["instance_id"]
            for name, expected in (("mask", masks_of_batch(batch)[instance]), ("mask_visib", batch.instance[0] == 1 + instance)):
                np.testing.assert_array_equal(toolkit_mask(json.loads(view[f"{name}.json"])[str(index)]), expected)


def toolkit_mask(record: dict) -> np.ndarray:
    """Decode like bop_toolkit_lib.pycoco_utils.rle_to_binary_mask: column-major runs that alternate between False and True."""
    counts = record["counts"]
    return np.repeat(np.arange(len(counts)) % 2 == 1, counts).reshape(record["size"], order="F")


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
def test_views_equal_those_of_the_bop_format(split, tmp_path):
    folders = export(BopExporter, tmp_path / "set", config(), EPISODES) / "train_pbr"
    for key, view in samples(split).items():
        scene, frame = key.split("_")
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


def test_key_index_leads_to_shards(split):
    keys = json.loads((split / "key_to_shard.json").read_text())
    assert list(keys) == list(samples(split))
    for key, index in keys.items():
        with tarfile.open(split / f"shard-{index:06d}.tar") as shard:
            for entry in ENTRIES:
                assert shard.extractfile(f"{key}.{entry}").read()


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
    monkeypatch.setattr(tar_files, "MAX_SHARD_VIEWS", 2)
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
    keys = json.loads((split / "key_to_shard.json").read_text())
    assert keys["000006_000001"] == 6
    assert keys["000006_000002"] == 1_000_006
    assert len(keys) == 3 * FRAMES
    views = samples(split)
    for key, view in samples(dataset / "train_pbr_web").items():
        if key in views:
            assert all(view[entry] == views[key][entry] for entry in ENTRIES)
    assert len(views) == 3 * FRAMES


def test_an_empty_data_set_has_an_empty_key_index(tmp_path):
    with exporting(ShardsExporter, tmp_path, config()) as exporter:
        exporter.write_constants()
        assert finish(exporter) == [Path("train_pbr_web/key_to_shard.json"), Path("README.md")]
    assert json.loads((tmp_path / "train_pbr_web/key_to_shard.json").read_text()) == {}
    assert set(digests(tmp_path / "train_pbr_web")) == {"key_to_shard.json"}


def test_files_shared_with_the_bop_format_are_listed_once(tmp_path):
    with exporting(ShardsExporter, tmp_path, config()) as exporter:
        constants = Exporters((BopExporter, ShardsExporter), export_context(exporter)).write_constants()
    assert sorted(map(str, constants)) == ["bop_dataset_params.py", "camera.json", "dataset_info.md", "models", "models_eval"]
