"""Boxes of every format, by the conventions of exporters/README.md: of an instance that is wholly visible they are one box."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pytest
from pycocotools.coco import COCO

from synpick_warp.exporters.bop.coco.exporter import CocoExporter
from synpick_warp.exporters.bop.exporter import BopExporter
from tests.harness.exporter_contract import export
from tests.twins.masks import masks_of_batch
from tests.worlds.box_views import batches, cameras, config

FRAMES = 3


@pytest.fixture(scope="module")
def sets(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("boxes")
    bop, coco = (export(kind, folder / kind.__name__, config(), (0,)) for kind in (BopExporter, CocoExporter))
    return bop, coco


def read(place: Path) -> COCO:
    with contextlib.redirect_stdout(io.StringIO()):
        return COCO(place)


def test_boxes_of_an_instance_agree_between_formats(sets):
    """Corners x_min, y_min, x_max, y_max of the pixels, inclusive, from each format by its convention, against the view's images."""
    bop, coco = sets
    split = read(coco / "coco" / "annotations" / "instances_train_pbr.json")
    images = {(image["camera"], image["frame"]): index for index, image in split.imgs.items()}
    compared = clipped = 0
    for batch in batches(1, (0,), FRAMES, cameras()):
        camera, frame = int(batch.camera[0]), int(batch.frame[0])
        annotations = {row["instance_id"]: row for row in split.loadAnns(split.getAnnIds(imgIds=images[camera, frame]))}
        folder = bop / "train_pbr" / f"{camera:06d}"
        truths, infos = (json.loads((folder / f"scene_{name}.json").read_text())[str(frame)] for name in ("gt", "gt_info"))
        info = {truth["instance_id"]: info for truth, info in zip(truths, infos, strict=True)}
        scene = read(folder / "scene_gt_coco.json")
        amodal_boxes = [row["bbox"] for row in scene.loadAnns(scene.getAnnIds(imgIds=frame))]
        for place, (index, row) in enumerate(annotations.items()):
            visible, inside = tight(batch.instance[0] == 1 + index), tight(masks_of_batch(batch)[index])
            amodal = batch.boxes[0, index, 0].tolist()
            assert visible == corners(row["bbox"], 1) == corners(info[index]["bbox_visib"], 0)
            assert amodal == corners(row["bbox_amodal"], 1) == corners(info[index]["bbox_obj"], 0)
            assert inside == corners(amodal_boxes[place], 1)
            clipped += inside != amodal
            if row["visib_fract"] == 1.0:
                assert row["bbox"] == row["bbox_amodal"] == amodal_boxes[place]
                compared += 1
    assert compared > 3
    assert clipped


def tight(mask: np.ndarray) -> list[int]:
    """Inclusive corners of the pixels of a mask."""
    rows, columns = np.nonzero(mask)
    return [int(side) for side in (columns.min(), rows.min(), columns.max(), rows.max())]


def corners(box: object, counted: int) -> list[int]:
    """Inclusive corners of a box x, y, width, height; `counted`: 1 if its sizes count pixels, 0 if they are differences."""
    x, y, width, height = map(int, box)  # type: ignore[call-overload]
    return [x, y, x + width - counted, y + height - counted]
