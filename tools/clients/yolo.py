"""Ultralytics and supervision: labels of a split and of a scene, as masks, boxes and oriented boxes, through their own data set classes."""

# Runs where the packages are, which the type checker may not see.
# pyright: reportMissingImports=false

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import Reading, Sources, first_episode, sample_frames, sampled_views

PACKAGES = ("ultralytics", "supervision")
BOUNDS = {"box": 1e-3, "box_of_segment": 0.61, "oriented_area": 0.02}
"""Boxes [px], those that Ultralytics takes from segments [px], and areas of oriented boxes, relative."""


def find(data: Path, sources: Sources) -> Path | None:
    """Path of data.yaml; None: there is none."""
    place = data / "yolo" / "data.yaml"
    return place if place.is_file() else None


def read(place: Path, data: Path, sources: Sources) -> Reading:
    """Labels of the sampled images of the first camera of the first episode. Ultralytics writes a cache beside labels: it gets a copy."""
    row = first_episode(data)
    frames = sample_frames(row["frames"])
    with tempfile.TemporaryDirectory() as folder:
        os.environ["YOLO_CONFIG_DIR"] = folder
        copy = Path(shutil.copytree(place.parent, Path(folder) / "yolo"))
        lists = sorted(copy.glob("[0-9]*.txt"))
        scene = lists[0].stem
        split = lists[0].read_text().split("/")[2]
        values, names = _read_ultralytics(copy, split, scene, frames)
        values |= _read_supervision(copy, split, scene, frames)
    return Reading(f"{len(lists)} scenes, {len(names)} classes", values)


def _read_ultralytics(copy: Path, split: str, scene: str, frames: list[int]) -> tuple[dict[str, np.ndarray], dict[int, str]]:
    """Segments, filled by its own function, and oriented boxes."""
    from ultralytics.data.dataset import YOLODataset
    from ultralytics.data.utils import check_det_dataset, polygon2mask

    data = check_det_dataset(str(copy / "data.yaml"), autodownload=False)
    values: dict[str, np.ndarray] = {}
    for task in ("segment", "obb"):
        items = YOLODataset(img_path=str(copy / "images" / split), data=data, task=task, augment=False, imgsz=64)
        assert len(items.labels) == len(list((copy / "images" / split).rglob("*.*g"))), "images were left out"
        for index, label in enumerate(items.labels):
            name, (height, width) = Path(label["im_file"]).stem, label["shape"]
            if name not in {f"{scene}_{frame:06d}" for frame in frames}:
                continue
            frame, size = int(name[-6:]), np.array([width, height])
            if task == "segment":
                masks = [polygon2mask((height, width), [(part * size).reshape(-1)]) > 0 for part in label["segments"]]
                values[f"mask_visib {frame}"] = np.array(masks, bool).reshape(-1, height, width)
                values[f"class {frame}"] = label["cls"].ravel().astype(int)
                values[f"box_of_segment {frame}"] = label["bboxes"] * np.tile(size, 2)
            else:
                box = items[index]["bboxes"].numpy()
                values[f"oriented boxes {frame}"] = np.array(len(box))
    return values, data["names"]


def _read_supervision(copy: Path, split: str, scene: str, frames: list[int]) -> dict[str, np.ndarray]:
    """Masks of segments, boxes, and areas of oriented boxes."""
    import supervision

    values: dict[str, np.ndarray] = {}
    for kind, options in (("labels", {"force_masks": True}), ("boxes", {}), ("oriented_boxes", {"is_obb": True})):
        found = supervision.DetectionDataset.from_yolo(
            str(copy / "images" / split / scene), str(copy / kind / split / scene), str(copy / "data.yaml"), **options
        )
        for path, _, detections in found:
            frame = int(Path(path).stem[-6:])
            if frame not in frames:
                continue
            if kind == "labels":
                values[f"mask_visib supervision {frame}"] = detections.mask
            elif kind == "boxes":
                low, high = detections.xyxy[:, :2], detections.xyxy[:, 2:]
                values[f"box {frame}"] = np.concatenate(((low + high) / 2, high - low), axis=1)
            else:
                x, y = np.moveaxis(detections.data["xyxyxyxy"].astype(float), 2, 0)
                crosses = x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y
                values[f"oriented_area {frame}"] = np.abs(crosses.sum(axis=1)) / 2
    return values


def expect(data_set: Any) -> dict[str, np.ndarray]:
    """Expected result of `read`, from the views in memory: visible instances; bridges join the parts of a mask into one polygon."""
    import cv2

    from synpick_warp.exporters.bop.outlines import join_parts, trace_outlines
    from synpick_warp.exporters.writing.rle import find_run_boundaries

    values: dict[str, np.ndarray] = {}
    obj_ids = sorted(info.object_id for info in data_set.objects)
    for frame, view in sampled_views(data_set).items():
        seen = view.masks.any(axis=(1, 2))
        masks, boxes, areas = [], [], []
        for mask in view.masks[seen]:
            parts = trace_outlines(find_run_boundaries(mask.astype(np.uint8)).runs_of(1))
            joined = join_parts(parts)
            bridged = np.zeros(mask.shape, np.uint8)
            cv2.fillPoly(bridged, [joined.at_pixels().astype(np.int32)], 1)
            masks.append(mask if len(parts) == 1 else bridged > 0)
            rows, columns = np.nonzero(mask)
            low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()]) + 1
            boxes.append(np.concatenate(((low + high) / 2, high - low)))
            corners = np.clip(cv2.boxPoints(cv2.minAreaRect(joined.points.astype(np.float32))), 0, mask.shape[::-1])
            areas.append(cv2.contourArea(corners.astype(np.float32)))
        values |= {
            f"class {frame}": np.array([obj_ids.index(obj_id) for obj_id in view.object_ids[seen]]),
            f"mask_visib {frame}": np.array(masks),
            f"mask_visib supervision {frame}": np.array(masks),
            f"box {frame}": np.array(boxes),
            f"box_of_segment {frame}": np.array(boxes),
            f"oriented boxes {frame}": np.array(len(masks)),
            f"oriented_area {frame}": np.array(areas),
        }
    return values
