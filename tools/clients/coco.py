"""pycocotools: annotations of a BOP scene, and of a whole split (format coco), as masks, through its own index."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import Reading, Sources, first_episode, first_scene, sample_frames, sampled_views

PACKAGES = ("pycocotools",)


def find(data: Path, sources: Sources) -> Path | None:
    """COCO file of the first scene; without one, that of the first split."""
    return _scene_file(data) or _split_file(data)


def _scene_file(data: Path) -> Path | None:
    """COCO file of the first scene; None: there is none."""
    scene = first_scene(data)
    return scene / "scene_gt_coco.json" if scene is not None and (scene / "scene_gt_coco.json").is_file() else None


def _split_file(data: Path) -> Path | None:
    """COCO file of the first split; None: there is none."""
    return min(data.glob("coco/annotations/instances_*.json"), default=None)


def read(place: Path, data: Path, sources: Sources) -> Reading:
    """Masks and categories of the sampled images, of scene and split."""
    from pycocotools.coco import COCO

    row = first_episode(data)
    frames = sample_frames(row["frames"])
    values: dict[str, np.ndarray] = {}
    texts, remarks = [], []
    for prefix, file in (("", _scene_file(data)), ("split ", _split_file(data))):
        if file is None:
            continue
        with contextlib.redirect_stdout(io.StringIO()):
            coco = COCO(str(file))
        for image in coco.dataset["images"]:
            frame = image.get("frame", image["id"])
            if frame not in frames or image.get("episode", row["episode"]) != row["episode"] or image.get("camera", 0):
                continue
            rows = coco.loadAnns(sorted(coco.getAnnIds(imgIds=[image["id"]])))
            masks = np.array([coco.annToMask(item) > 0 for item in rows], bool).reshape(-1, image["height"], image["width"])
            values |= {f"{prefix}category {frame}": np.array([item["category_id"] for item in rows]), f"{prefix}mask_visib {frame}": masks}
        if all(category["name"].isdigit() for category in coco.dataset["categories"]):
            remarks.append(f"{file.name}: categories are named by their number")
        texts.append(f"{file.name}, {len(coco.anns)} annotations")
    return Reading("; ".join(texts), values, remarks)


def expect(data_set: Any) -> dict[str, np.ndarray]:
    """Values that `read` must return, from the views in memory: visible instances."""
    values: dict[str, np.ndarray] = {}
    for frame, view in sampled_views(data_set).items():
        seen = view.masks.any(axis=(1, 2))
        for prefix in ("", "split "):
            values |= {f"{prefix}category {frame}": view.object_ids[seen], f"{prefix}mask_visib {frame}": view.masks[seen]}
    return values
