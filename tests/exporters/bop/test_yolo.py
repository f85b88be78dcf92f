"""YOLO labels: the exporter contract, and every label against the views."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml

from synpick_warp.configs.schema import Split
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.exporters.bop.view import ViewSettings
from synpick_warp.exporters.bop.yolo.exporter import YoloExporter
from synpick_warp.exporters.bop.yolo.label_files import CONTENTS, commit_scenes, write_view
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.writing.rle import Masks, find_run_boundaries
from tests.harness.exporter_contract import ExporterContract, export
from tests.worlds.box_views import batches, cameras, config

LENSES = cameras()
SIZE = np.array([LENSES[0].width, LENSES[0].height])


class TestYoloContract(ExporterContract):
    exporter_class = YoloExporter


def rows(file: Path) -> list[tuple[int, np.ndarray]]:
    """Class and points [px] of each row."""
    parts = [line.split() for line in file.read_text().splitlines()]
    return [(int(index), np.array(list(map(float, values))).reshape(-1, 2) * SIZE) for index, *values in parts]


def test_labels_are_those_of_the_views(tmp_path):
    """Segments as readers fill them, boxes of the visible masks, and oriented boxes that hold them."""
    out = export(YoloExporter, tmp_path / "set", config(), (0, 2)) / "yolo"
    assert yaml.safe_load((out / "data.yaml").read_text())["names"] == {0: "box 3", 1: "box 7"}
    whole = unclipped = 0
    for batch in batches(1, (0, 2), 3, LENSES):
        scene = int(len(LENSES) * batch.episode[0] + batch.camera[0])
        place = f"train_pbr/{scene:06d}/{scene:06d}_{int(batch.frame[0]):06d}"
        color = cv2.imread(str(out / "images" / f"{place}.jpg"))[..., ::-1]
        assert np.median(np.abs(color.astype(int) - batch.color[0])) <= 3
        assert f"./images/{place}.jpg" in (out / f"{scene:06d}.txt").read_text().splitlines()
        masks = [batch.instance[0] == 1 + index for index in (0, 2, 3) if (batch.instance[0] == 1 + index).any()]
        classes = [(3, 7).index(batch.object_id[0, index]) for index in (0, 2, 3) if (batch.instance[0] == 1 + index).any()]
        labels = [rows(out / kind / f"{place}.txt") for kind in CONTENTS[1:]]
        assert [[index for index, _ in kind] for kind in labels] == [classes] * 3
        for mask, (_, segment), (_, box), (_, oriented) in zip(masks, *labels, strict=True):
            filled = np.zeros(mask.shape, np.uint8)
            cv2.fillPoly(filled, [segment.astype(np.int32)], 1)
            # Between parts lies a bridge, which readers fill as well.
            parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[0] - 1
            assert filled[mask].all()
            assert (filled > mask).sum() <= 24 * (parts - 1)
            whole += parts == 1
            (y, x), (middle, size) = np.nonzero(mask), box
            np.testing.assert_allclose(middle - size / 2, (x.min(), y.min()), atol=1e-3)
            np.testing.assert_allclose(middle + size / 2, (x.max() + 1, y.max() + 1), atol=1e-3)
            assert oriented.shape == (4, 2)
            centers = np.stack((x, y), axis=1) + 0.5
            if ((oriented > 0) & (oriented < SIZE)).all():
                assert all(cv2.pointPolygonTest(oriented.astype(np.float32), point.tolist(), True) > 0 for point in centers)
                unclipped += 1
    assert min(whole, unclipped) > 20


def test_segments_of_several_parts_are_one_row(tmp_path):
    """Two pixels apart: the bridge between them is filled as well."""
    mask = np.zeros((3, 4), np.uint8)
    mask[1, 0] = mask[1, 3] = 1
    for kind in CONTENTS:
        (tmp_path / kind).mkdir()
    settings = ViewSettings(".jpg", 95, (), masks=True, coco=True, camera={}, resolution=(4, 3), classes=(5,))
    runs = find_run_boundaries(mask).runs_of(1)
    view = SimpleNamespace(scene=0, frame=0, color=(".jpg", b"image"), gt=[{"obj_id": 5}], masks=lambda: [Masks(runs, runs)])
    write_view(view, tmp_path, settings)
    assert (tmp_path / "boxes" / "000000_000000.txt").read_text() == "0 0.500000 0.500000 1.000000 0.333333\n"
    assert len((tmp_path / "labels" / "000000_000000.txt").read_text().split()) == 1 + 2 * (4 + 4 + 2)
    with pytest.raises(DatasetError, match="obj_id 5, which is none of the objects"):
        write_view(view, tmp_path, dataclasses.replace(settings, classes=(6,)))


@pytest.mark.parametrize(
    ("folders", "keys"),
    [
        (("train_pbr", "test_pbr"), ("train_pbr", "test_pbr", "test_pbr")),
        (("train_pbr", "val_pbr"), ("train_pbr", "val_pbr", None)),
        (("test_pbr",), ("test_pbr", "test_pbr", "test_pbr")),
        (("mine",), ("mine", "mine", None)),
    ],
)
def test_readers_find_images_to_train_and_to_validate(tmp_path, folders, keys):
    splits = tuple(Split(f"s{index}", 1, index, "pick", folder) for index, folder in enumerate(folders))
    out = export(YoloExporter, tmp_path / "set", dataclasses.replace(config(), splits=splits), (0,))
    data = yaml.safe_load((out / "yolo" / "data.yaml").read_text())
    assert [data.get(key) for key in ("train", "val", "test")] == [key and f"images/{key}" for key in keys]
    note = {"train_pbr": "train", "test_pbr": "test", "mine": "all", "val_pbr": None}[keys[1]]
    assert (f"# No split for validation: these are the {note} images." in (out / "yolo" / "data.yaml").read_text()) == (note is not None)
    assert all((out / "yolo" / "images" / folder).is_dir() for folder in folders)
    assert FORMAT_TABLE["yolo"].part.file(0) == "yolo/000000.txt"


def test_scenes_are_checked_for_completeness(tmp_path):
    for kind in CONTENTS:
        (tmp_path / "hidden" / kind).mkdir(parents=True)
    with pytest.raises(OutputError, match="has 0 of 3 frames"):
        commit_scenes(((tmp_path / "hidden", 7),), tmp_path, "train_pbr", (range(3),))
