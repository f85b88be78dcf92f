"""COCO annotations of a whole split: the exporter contract, and pycocotools against the views."""

from __future__ import annotations

import contextlib
import dataclasses
import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO

from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.coco import CATEGORIES, PARTS, CocoExporter
from tests.harness.exporter_contract import ExporterContract, export, exporting, finish
from tests.worlds.box_views import batches, cameras, config, ends

LENSES = cameras()


class TestCocoContract(ExporterContract):
    exporter_class = CocoExporter


def read(out: Path) -> COCO:
    """The annotation file, by pycocotools, which prints."""
    with contextlib.redirect_stdout(io.StringIO()):
        return COCO(out / "coco" / "annotations" / "instances_train_pbr.json")


@pytest.mark.filterwarnings("ignore:__array__:DeprecationWarning")
def test_pycocotools_reads_back_masks_boxes_and_images(tmp_path):
    read_back = read(out := export(CocoExporter, tmp_path / "set", config(), (0, 2), processes=0))
    assert {category["id"]: category["name"] for category in read_back.loadCats(read_back.getCatIds())} == {3: "box 3", 7: "box 7"}
    views = {(row["episode"], row["camera"], row["frame"]): row for row in read_back.loadImgs(read_back.getImgIds())}
    assert len(views) == 18
    for batch in batches(1, (0, 2), 3, LENSES):
        image = views[int(batch.episode[0]), int(batch.camera[0]), int(batch.frame[0])]
        color = cv2.imread(str(out / "coco" / "images" / image["file_name"]))[..., ::-1]
        assert np.median(np.abs(color.astype(int) - batch.color[0])) <= 3
        found = read_back.loadAnns(read_back.getAnnIds(imgIds=image["id"]))
        assert [row["instance_id"] for row in found] == [index for index in (0, 2, 3) if (batch.instance[0] == 1 + index).any()]
        for row in found:
            visible = batch.instance[0] == 1 + row["instance_id"]
            np.testing.assert_array_equal(read_back.annToMask(row), visible)
            rows, columns = np.flatnonzero(visible.any(axis=1)), np.flatnonzero(visible.any(axis=0))
            assert row["bbox"] == [columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1]
            assert (row["area"], row["category_id"]) == (visible.sum(), batch.object_id[0, row["instance_id"]])


def test_views_without_objects_have_no_annotations(tmp_path):
    with exporting(CocoExporter, tmp_path, config(), 0) as exporter:
        exporter.write_constants()
        for batch in batches(5, (0,), 1, LENSES):
            nothing = {"object_id": np.full_like(batch.object_id, -1), "instance": np.zeros_like(batch.instance)}
            exporter.write_views(dataclasses.replace(batch, **nothing))
        exporter.end_episode(ends((0,), 1)[0], lambda: None)
        finish(exporter)
    assert (len(read(tmp_path).imgs), len(read(tmp_path).anns)) == (3, 0)


@pytest.mark.parametrize("name", [str(PARTS / "000001.jsonl"), str(CATEGORIES)])
def test_damaged_parts_are_one_error(tmp_path, name):
    out = export(CocoExporter, tmp_path / "set", config(), (0,), processes=0)
    (out / name).write_text("[}\n")
    (out / ".partial").mkdir()
    with pytest.raises(DatasetError, match=Path(name).name):
        CocoExporter.finalize(out, config(), None)  # type: ignore[arg-type]
