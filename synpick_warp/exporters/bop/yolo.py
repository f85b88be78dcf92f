"""YOLO's text labels, as Ultralytics reads them: images, segments, boxes and oriented boxes of the visible masks, and data.yaml; their
exporter.

Runs in writer processes, too, so it imports neither Warp nor Newton.
"""

import dataclasses
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from synpick_warp.configs.dataset import DataLayout, split_kind
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.exporters.base import EncodedView, ExportContext, SharedFiles
from synpick_warp.exporters.bop.outlines import join_parts, trace_outlines
from synpick_warp.exporters.bop.scene_exporter import SceneExporter, SceneImages
from synpick_warp.exporters.bop.view import ViewSettings
from synpick_warp.exporters.writing.files import open_folder, output_errors, sync_folder, write_synced
from synpick_warp.exporters.writing.notes import note_files, write_notes

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


class YoloExporter(SceneExporter):
    """`Exporter` of YOLO labels. Each scene has a folder of images, a folder per kind of label, and a list of its images. Class indices
    follow the sorted obj_ids."""

    writes_depth = False
    staging = "yolo"

    write_view = staticmethod(write_view)

    def __init__(self, context: ExportContext) -> None:
        super().__init__(context)
        classes = tuple(sorted(context.names))
        self._views = tuple(dataclasses.replace(view, classes=classes) for view in self._views)

    @staticmethod
    def folder_name(split: str) -> str:
        return FOLDER.name

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        splits = tuple(FOLDER / kind / split for kind in CONTENTS for split in layout.folders)
        return SharedFiles((DATA, *note_files(layout)), (), (*splits, *(FOLDER / kind for kind in CONTENTS), FOLDER))

    def write_constants(self) -> list[Path]:
        context = self._context
        with output_errors(self._out):
            for folder in reversed(self.shared_files(context.layout).folders):
                (self._out / folder).mkdir(exist_ok=True)
            write_data_file(self._out, context.names, context.layout.folders)
            return [DATA, *write_notes(self._out, context.settings, context.names, self._cameras)]

    def places(self, episode: int) -> list[Path]:
        split, scenes = self._context.layout.folder(episode), self.scene_ids(episode)
        return [*map(image_list, scenes), *(FOLDER / kind / split / f"{scene:06d}" for scene in scenes for kind in CONTENTS)]

    def _stage_scene(self, scene: Path, settings: ViewSettings) -> None:
        scene.mkdir()
        for kind in CONTENTS:
            (scene / kind).mkdir()

    def _commit_task(self, scenes: tuple[tuple[Path, int], ...], images: SceneImages) -> tuple[Callable[..., None], tuple[Any, ...]]:
        split = self._context.layout.folder(scenes[0][1] // len(self._cameras))
        return commit_scenes, (scenes, self._out, split, images)
