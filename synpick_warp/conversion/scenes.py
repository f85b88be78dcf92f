"""Tasks that convert one scene: to shards, to a scene folder, to videos. They run in writer processes.

Images are copied as they are, never decoded and encoded again; annotations are read, checked, and written as a bake writes them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from synpick_warp.conversion.masks import read_masks
from synpick_warp.dataset.view_files import SceneFiles, SceneFolder, SceneShards, ViewRecords, check_planes
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.exporters.bop.coco.annotation_files import make_annotations, write_image
from synpick_warp.exporters.bop.keypoints import Keypoints, project_keypoints
from synpick_warp.exporters.bop.scene import create_scene_folders
from synpick_warp.exporters.bop.shards.tar_files import END_OF_ARCHIVE, MAX_SHARD_VIEWS, mask_json, shard_name, tar_entry, view_key
from synpick_warp.exporters.bop.view import (
    ANNOTATIONS,
    ViewTruth,
    annotation_block,
    encode_masks,
    make_coco_annotations,
    to_json,
)
from synpick_warp.exporters.writing.files import sync_folder
from synpick_warp.exporters.writing.folder import Buffer, open_folder


@dataclass(frozen=True)
class SceneSource:
    """A scene of the source: its folder, or else its shards."""

    folder: Path | None
    shards: tuple[Path, ...]
    scene: int
    """BOP scene_id."""
    size: tuple[int, int]
    """Width and height of the images [px]."""
    frames: int

    def open(self) -> SceneFiles:
        """The scene's files."""
        return SceneFolder(self.folder, self.size) if self.folder is not None else SceneShards(self.shards, self.scene, self.size)


@dataclass(frozen=True)
class SceneContent:
    """Configured contents of a converted scene: masks, COCO annotations, layers and keypoints."""

    masks: bool
    coco: bool
    layers: tuple[str, ...]
    keypoints: dict[int, Keypoints] = field(default_factory=dict)
    """Keypoints in COCO annotations, by obj_id; empty: none."""


def write_shards(source: SceneSource, content: SceneContent, staging: Path) -> None:
    """Task: write the shards of a scene to a staging folder, which exists."""
    files = source.open()
    for part, begin in enumerate(range(0, source.frames, MAX_SHARD_VIEWS)):
        with (staging / shard_name(source.scene, part)).open("wb") as shard:
            for frame in range(begin, min(begin + MAX_SHARD_VIEWS, source.frames)):
                _write_view(shard, files, source, content, frame)
            shard.write(END_OF_ARCHIVE)
            shard.flush()
            os.fsync(shard.fileno())


def _write_view(shard: BinaryIO, files: SceneFiles, source: SceneSource, content: SceneContent, frame: int) -> None:
    key = view_key(source.scene, frame)
    for name, data in _list_entries(files, source, content, frame):
        shard.writelines(tar_entry(f"{key}.{name}", data))


def _list_entries(files: SceneFiles, source: SceneSource, content: SceneContent, frame: int) -> Iterator[tuple[str, Buffer]]:
    """Entries of a view, in the order of a bake's."""
    for name in ("rgb", "depth"):
        suffix, data = files.image_file(name, frame)
        yield f"{name}{suffix}", data
    records = files.records(frame)
    for name, record in (("camera", records.camera), ("gt", records.gt), ("gt_info", records.gt_info)):
        yield f"{name}.json", to_json(record)
    if content.masks:
        masks = read_masks(files, frame, records.gt_info, source.size)
        width, height = source.size
        yield "mask.json", mask_json((mask.amodal for mask in masks), height, width)
        yield "mask_visib.json", mask_json((mask.visible for mask in masks), height, width)
    for name in content.layers:
        suffix, data = files.image_file(name, frame)
        yield f"{name}{suffix}", data


def write_scene(source: SceneSource, content: SceneContent, staging: Path) -> None:
    """Task: write the images and annotation blocks of a scene folder to a staging folder, which it creates."""
    files = source.open()
    create_scene_folders(staging, content.masks, content.layers)
    width, height = source.size
    with open_folder(staging) as folder:
        for frame in range(source.frames):
            for name in ("rgb", "depth", *content.layers):
                suffix, data = files.image_file(name, frame)
                folder.write(f"{name}/{frame:06d}{suffix}", data)
            records = files.records(frame)
            masks = read_masks(files, frame, records.gt_info, source.size) if content.masks or content.coco else []
            if content.masks:
                for index, mask in enumerate(masks):
                    amodal, visible = encode_masks(mask, height, width)
                    folder.write(f"mask/{frame:06d}_{index:06d}.png", amodal)
                    folder.write(f"mask_visib/{frame:06d}_{index:06d}.png", visible)
            entries: list[object] = [records.camera, records.gt, records.gt_info]
            if content.coco:
                truth, points = _make_truth(source, frame, records), _project_keypoints(files, frame, records, content)
                entries += make_coco_annotations(truth, records.gt_info, masks, height, width, points)
            folder.append(ANNOTATIONS, annotation_block(frame, map(to_json, entries)))


def _project_keypoints(files: SceneFiles, frame: int, records: ViewRecords, content: SceneContent) -> list[dict[str, Any]] | None:
    """Keys of keypoints in the annotations of a view's instances; None: there are none."""
    if not content.keypoints:
        return None
    if unknown := {row["obj_id"] for row in records.gt} - content.keypoints.keys():
        raise DatasetError(f"image {frame} in {files.place} has obj_id {min(unknown)}, which is none of the bake's objects")
    depth = check_planes(files.image("depth", frame), None, f"depth of image {frame} in {files.place}", "uint16")
    return project_keypoints(records.gt, records.camera, depth, content.keypoints)


def _make_truth(source: SceneSource, frame: int, records: ViewRecords) -> ViewTruth:
    """Ground truth for COCO annotations, which take the frame and object ids from it."""
    nothing = np.empty(0)
    object_id = np.array([row["obj_id"] for row in records.gt], np.int64)
    return ViewTruth(source.scene, frame, 0, {}, nothing, object_id, nothing, nothing, nothing, False, 0, 0)


def write_video_group(source: SceneSource, first: int, rate: Fraction, path: Path) -> None:
    """Task: encode a group of frames from the source's colour images."""
    from synpick_warp.exporters.lerobot.video import GROUP, count_levels, split_planes, write_group

    files = source.open()
    planes, levels = [], np.zeros((3, 256), np.int64)
    for frame in range(first, min(first + GROUP, source.frames)):
        image = check_planes(files.image("rgb", frame), 3, f"rgb of image {frame} in {files.place}", "uint8")
        color = np.ascontiguousarray(image[..., ::-1])
        levels += count_levels(color)
        planes.append(split_planes(color))
    write_group(planes, levels, rate, path)


def write_coco(source: SceneSource, content: SceneContent, staging: Path) -> None:
    """Task: write the images and annotations of a COCO scene to a staging folder, which it creates."""
    files = source.open()
    staging.mkdir()
    width, height = source.size
    for frame in range(source.frames):
        suffix, data = files.image_file("rgb", frame)
        records = files.records(frame)
        masks = read_masks(files, frame, records.gt_info, source.size)
        points = _project_keypoints(files, frame, records, content)
        write_image(staging, frame, suffix, data, make_annotations(records.gt, records.gt_info, masks, height, width, points))


def place_shards(scenes: tuple[tuple[Path, int], ...], split: Path, frames: int) -> None:
    """Task: rename the shards of an episode's scenes, (staging folder, scene_id), to their places."""
    for staging, scene in scenes:
        names = [shard_name(scene, part) for part in range(-(-frames // MAX_SHARD_VIEWS))]
        if sorted(path.name for path in staging.iterdir()) != sorted(names):
            raise OutputError(f"{staging} does not hold the shards of {frames} frames; this is an error of synpick-warp, please report it")
        for name in names:
            (staging / name).rename(split / name)
        staging.rmdir()
    sync_folder(split)
