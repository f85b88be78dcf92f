"""COCO annotations of a whole split: the exporter contract, and pycocotools against the views."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO

from synpick_warp.configs.dataset.export import ExportSettings
from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.schema import Split
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.exporters.bop.coco.annotation_files import CATEGORIES, IMAGES, PARTS, commit_scenes, write_view
from synpick_warp.exporters.bop.coco.exporter import CocoExporter
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.view import ViewSettings
from synpick_warp.exporters.formats import FORMAT_TABLE
from tests.harness.exporter_contract import ExporterContract, export, without_objects
from tests.worlds.box_views import batches, cameras, config

LENSES = cameras()


class TestCocoContract(ExporterContract):
    exporter_class = CocoExporter


SPLITS = (
    Split("train", 2, 0, "pick", "train_pbr"),
    Split("test", 2, 2, "pick", "test_pbr"),
    Split("val", 5, 9, "pick", "val_pbr"),
)


def read(out: Path, split: str = "train_pbr") -> COCO:
    """The annotation file of a split, by pycocotools, which prints."""
    with contextlib.redirect_stdout(io.StringIO()):
        return COCO(out / "coco" / "annotations" / f"instances_{split}.json")


@pytest.mark.filterwarnings("ignore:__array__:DeprecationWarning")
def test_pycocotools_reads_back_masks_boxes_and_images(tmp_path):
    read_back = read(out := export(CocoExporter, tmp_path / "set", config(), (0, 2)))
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
            x_min, y_min, x_max, y_max = batch.boxes[0, row["instance_id"], 0].tolist()
            assert row["bbox_amodal"] == [x_min, y_min, x_max - x_min + 1, y_max - y_min + 1]
            assert (row["area"], row["category_id"]) == (visible.sum(), batch.object_id[0, row["instance_id"]])


def test_keypoints_are_those_of_bop_annotations(tmp_path):
    settings = config(keypoints=8)
    scenes = [export(kind, tmp_path / kind.__name__, settings, (0,)) for kind in (BopExporter, CocoExporter)]
    split = read(scenes[1])
    for camera in range(len(LENSES)):
        scene = json.loads((scenes[0] / "train_pbr" / f"{camera:06d}" / "scene_gt_coco.json").read_text())
        images = [index for index, image in split.imgs.items() if image["camera"] == camera]
        ours = [row for index in images for row in split.loadAnns(split.getAnnIds(imgIds=index))]
        assert [(row["keypoints"], row["num_keypoints"]) for row in ours] == [
            (row["keypoints"], row["num_keypoints"]) for row in scene["annotations"]
        ]
        for mine, other in zip(split.dataset["categories"], scene["categories"], strict=True):
            assert mine == {key: value for key, value in other.items() if key != "supercategory"}
            assert len(mine["keypoint_positions"]) == 8


def test_every_split_has_an_annotation_file(tmp_path):
    """Two splits of one episode each, and one that has not been baked."""
    settings = dataclasses.replace(config(), splits=SPLITS)
    out = export(CocoExporter, tmp_path / "set", settings, (0, 2))
    assert sorted(path.name for path in (out / IMAGES).iterdir()) == [f"{scene:06d}" for scene in (0, 1, 2, 6, 7, 8)]
    assert {out / name for name in CocoExporter.shared_files(DataLayout.of(settings)).indices} == set(
        (out / "coco" / "annotations").iterdir()
    )
    for split, episode in (("train_pbr", 0), ("test_pbr", 2)):
        found = read(out, split)
        assert sorted(found.imgs) == list(range(1, 10))
        assert sorted(found.anns) == list(range(1, len(found.anns) + 1))
        assert {image["episode"] for image in found.imgs.values()} == {episode}
        assert all((out / IMAGES / image["file_name"]).is_file() for image in found.imgs.values())
        assert found.dataset["info"]["description"] == f"synpick-warp, {split}"
    assert (len(read(out, "val_pbr").imgs), len(read(out, "val_pbr").cats)) == (0, 2)
    assert str(PARTS) == FORMAT_TABLE["coco"].part.folder


def test_scenes_are_checked_for_completeness(tmp_path):
    scene, settings = tmp_path / "hidden", ViewSettings(".jpg", 95, (), masks=True, coco=True, camera={}, resolution=(4, 3))
    empty = {frame: SimpleNamespace(frame=frame, color=(".jpg", b"image"), gt=[], gt_info=[], masks=list) for frame in range(3)}
    scene.mkdir()
    for frame in (2, 0):
        write_view(empty[frame], scene, settings)
    for name in (IMAGES, PARTS):
        (tmp_path / name).mkdir(parents=True)
    with pytest.raises(OutputError, match="has 2 of 3 frames"):
        commit_scenes(((scene, 7),), tmp_path, (range(3),))
    write_view(empty[1], scene, settings)
    commit_scenes(((scene, 7),), tmp_path, (range(3),))
    assert sorted(path.name for path in (tmp_path / IMAGES / "000007").iterdir()) == ["000000.jpg", "000001.jpg", "000002.jpg"]


def test_views_without_objects_have_no_annotations(tmp_path):
    out = export(CocoExporter, tmp_path, config(), (0,), frames=1, prepare=without_objects)
    assert (len(read(out).imgs), len(read(out).anns)) == (3, 0)


@pytest.mark.parametrize("name", [str(PARTS / "000001.jsonl"), str(CATEGORIES)])
def test_damaged_parts_are_one_error(tmp_path, name):
    out = export(CocoExporter, tmp_path / "set", config(), (0,))
    (out / name).write_text("[}\n")
    (out / ".partial").mkdir()
    with pytest.raises(DatasetError, match=Path(name).name):
        CocoExporter.finalize(out, ExportSettings.of(config()), None, (0,))  # type: ignore[arg-type]
