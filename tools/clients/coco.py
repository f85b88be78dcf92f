"""pycocotools: annotations of a BOP scene as masks, through its own index."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import Reading, Sources, first_scene, sample_frames, sampled_views

PACKAGES = ("pycocotools",)


def find(data: Path, sources: Sources) -> Path | None:
    """COCO file of the first scene."""
    scene = first_scene(data)
    return None if scene is None or not (scene / "scene_gt_coco.json").is_file() else scene / "scene_gt_coco.json"


def read(place: Path, data: Path, sources: Sources) -> Reading:
    """Masks and categories of the sampled images."""
    from pycocotools.coco import COCO

    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO(str(place))
    values: dict[str, np.ndarray] = {}
    for frame in sample_frames(len(coco.getImgIds())):
        rows = coco.loadAnns(sorted(coco.getAnnIds(imgIds=[frame])))
        values[f"category {frame}"] = np.array([row["category_id"] for row in rows])
        image = coco.loadImgs([frame])[0]
        shape = (-1, image["height"], image["width"])
        values[f"mask_visib {frame}"] = np.array([coco.annToMask(row) > 0 for row in rows], bool).reshape(shape)
    names = {category["name"] for category in coco.dataset["categories"]}
    remarks = ["categories are named by their number"] if all(name.isdigit() for name in names) else []
    return Reading(f"{place.parent.name}/{place.name}, {len(coco.anns)} annotations", values, remarks)


def expect(data_set: Any) -> dict[str, np.ndarray]:
    """Visible instances of the views in memory."""
    values: dict[str, np.ndarray] = {}
    for frame, view in sampled_views(data_set).items():
        seen = view.masks.any(axis=(1, 2))
        values |= {f"category {frame}": view.object_ids[seen], f"mask_visib {frame}": view.masks[seen]}
    return values
