"""Files of the YOLO format: images and text labels of a scene, as views are written, and data.yaml.

Runs in writer processes, so it imports neither Warp nor Newton.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.configs.dataset import split_kind
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.exporters.base import EncodedView
from synpick_warp.exporters.bop.outlines import join_parts, trace_outlines
from synpick_warp.exporters.bop.view import ViewSettings
from synpick_warp.exporters.writing.files import open_folder, sync_folder, write_synced

FOLDER = Path("yolo")
"""Folder in the data set."""
IMAGES, SEGMENTS, BOXES, ORIENTED_BOXES = CONTENTS = ("images", "labels", "boxes", "oriented_boxes")
"""Its folders: images, and a text file for each image with a row for each visible instance, a class index and coordinates as fractions of
width and height. Readers expect labels in a folder named so beside the images, and take boxes from segments where a row has one."""
DATA = FOLDER / "data.yaml"


def image_list(scene: int) -> Path:
    """List of a scene's images: data.yaml may name such lists, instead of folders, to choose scenes."""
    return FOLDER / f"{scene:06d}.txt"


def image_name(scene: int, frame: int) -> str:
    """Name of an image and its labels, unique in a data set."""
    return f"{scene:06d}_{frame:06d}"


def write_data_file(out: Path, names: Mapping[int, str], splits: Sequence[str]) -> None:
    """Write data.yaml: folders of images for training, validation and tests, and the objects' names in the order of obj_id.

    Readers want images for training and validation: without a split for one, it is that for tests, or that there is.
    """
    kinds = {split_kind(split): f"{IMAGES}/{split}" for split in splits}
    any_split = next(iter(kinds.values()))
    train = kinds.get("train", any_split)
    val = kinds.get("val", kinds.get("test", train))
    used = next((kind for kind in ("train", "test") if val == kinds.get(kind)), "all")
    note = "" if "val" in kinds else f"  # No split for validation: these are the {used} images."
    lines = [
        f"train: {train}",
        f"val: {val}{note}",
        *([f"test: {kinds['test']}"] if "test" in kinds else []),
        f"nc: {len(names)}",
        "names:",
    ]
    lines += [f"  {index}: {json.dumps(names[obj_id], ensure_ascii=False)}" for index, obj_id in enumerate(sorted(names))]
    (out / DATA).write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_view(view: EncodedView, scene: Path, settings: ViewSettings) -> None:
    """Write a view's image and labels to the staging folder of its scene."""
    suffix, color = view.color
    name = image_name(view.scene, view.frame)
    rows = list(_make_rows(view, settings))
    with open_folder(scene) as folder:
        folder.write(f"{IMAGES}/{name}{suffix}", color)
        for column, kind in enumerate((SEGMENTS, BOXES, ORIENTED_BOXES)):
            folder.write(f"{kind}/{name}.txt", "".join(row[column] for row in rows).encode())


def _make_rows(view: EncodedView, settings: ViewSettings) -> Iterator[tuple[str, str, str]]:
    """Rows of a view's visible instances: segment, box, oriented box."""
    size = np.array(settings.resolution, float)
    for pose, mask in zip(view.gt, view.masks(), strict=True):
        box = mask.visible.box()
        if box is None:
            continue
        if pose["obj_id"] not in settings.classes:
            raise DatasetError(f"image {view.frame} of scene {view.scene} has obj_id {pose['obj_id']}, which is none of the objects")
        index = settings.classes.index(pose["obj_id"])
        outline = join_parts(trace_outlines(mask.visible))
        low, high = np.array(box[:2]), np.array(box[2:]) + 1
        corners = cv2.boxPoints(cv2.minAreaRect(outline.points.astype(np.float32)))
        yield (
            _format_row(index, outline.at_pixels() / size),
            _format_row(index, np.concatenate(((low + high) / 2, high - low)).reshape(2, 2) / size),
            # Readers refuse corners outside the image.
            _format_row(index, np.clip(corners / size, 0.0, 1.0)),
        )


def _format_row(index: int, points: np.ndarray) -> str:
    """Line of a label file: class index and coordinates, relative to the image size."""
    return f"{index} {' '.join(f'{value:.6f}' for value in points.ravel().tolist())}\n"


def commit_scenes(scenes: tuple[tuple[Path, int], ...], out: Path, split: str, frames: Sequence[Sequence[int]]) -> None:
    """Task: complete an episode's scenes, (staging folder, scene_id): list their images, and rename all to their places in a split; raises
    OutputError if not all `frames` (im_id) of a scene have arrived."""
    for (scene, scene_id), own in zip(scenes, frames, strict=True):
        images = sorted(os.listdir(scene / IMAGES))
        if [image_name(scene_id, frame) for frame in own] != [name.partition(".")[0] for name in images]:
            raise OutputError(f"{scene} has {len(images)} of {len(own)} frames; this is an error of synpick-warp, please report it")
        lines = "".join(f"./{IMAGES}/{split}/{scene_id:06d}/{name}\n" for name in images)
        write_synced(scene / "list", lines.encode())
        (scene / "list").rename(out / image_list(scene_id))
        for kind in CONTENTS:
            sync_folder(scene / kind)
            (scene / kind).rename(out / FOLDER / kind / split / f"{scene_id:06d}")
    for folder in (FOLDER, *(FOLDER / kind / split for kind in CONTENTS)):
        sync_folder(out / folder)
