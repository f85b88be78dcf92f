"""Scenes as BOP has them: a view's records put together into the files of a scene, and the scene moved into place.

Runs in writer processes, so it imports neither Warp nor Newton.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from synpick_warp.errors import OutputError
from synpick_warp.exporters.bop.view import ANNOTATIONS
from synpick_warp.exporters.writing.files import sync_folder

DATE = "1970-01-01 00:00:00"
"""Where COCO asks for a date: constant, so that the same seed gives the same bytes."""


@dataclass(frozen=True)
class SceneSettings:
    """What all scenes share."""

    split: str
    frames: int
    """Frames that each scene must have."""
    width: int
    height: int
    color_suffix: str
    coco: bool
    object_ids: tuple[int, ...]
    """Every object that may come."""


def make_scene(scene: Path, masks: bool, layers: tuple[str, ...]) -> None:
    """Make the folders of a scene that is not whole yet."""
    scene.mkdir()
    for name in ("rgb", "depth", *(("mask", "mask_visib") if masks else ()), *layers):
        (scene / name).mkdir()


def finish_episode(scenes: tuple[tuple[Path, Path], ...], settings: SceneSettings) -> None:
    """Complete an episode's scenes, and move each from its hidden folder to its place: (from, to).

    JSON files and folder entries are on the disk before the move. Pictures are in the system's cache at least: they survive
    the end of this process, whatever ends it.
    """
    for scene, _ in scenes:
        _finish_scene(scene, settings)
    for scene, place in scenes:
        scene.rename(place)
    for folder in {place.parent for _, place in scenes}:
        sync_folder(folder)


def drop_scenes(scenes: tuple[Path, ...]) -> None:
    """Remove scenes that will not be delivered."""
    for scene in scenes:
        shutil.rmtree(scene)


def _finish_scene(scene: Path, settings: SceneSettings) -> None:
    with (scene / ANNOTATIONS).open("rb") as file:
        records = _Records(file)
        if records.frames != list(range(settings.frames)):
            raise OutputError(
                f"{scene} has {len(records.frames)} of {settings.frames} frames; this is an error of synpick-warp, please report it"
            )
        names = ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")
        for record, name in enumerate(names):
            _write_lines(scene / name, _keyed(records, record))
        if settings.coco:
            _write_lines(scene / "scene_gt_coco.json", _coco(records, len(names), settings))
    (scene / ANNOTATIONS).unlink()
    for folder in (*(entry for entry in sorted(scene.iterdir()) if entry.is_dir()), scene):
        sync_folder(folder)


class _Records:
    """A file of `annotation_block`s, read by frame and record: whole, they would fill the memory."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.frames: list[int] = []
        """Of each block, sorted."""
        self._places: dict[int, list[tuple[int, int]]] = {}
        while head := file.readline():
            frame, *sizes = map(int, head.split())
            *begins, end = itertools.accumulate((size + 1 for size in sizes), initial=file.tell())
            self._places[frame] = list(zip(begins, sizes, strict=True))
            self.frames.append(frame)
            file.seek(end)
        self.frames.sort()

    def texts(self, frame: int, begin: int, end: int | None) -> Iterator[str]:
        """Records `begin` to `end`, exclusive, of a frame."""
        for offset, size in self._places[frame][begin:end]:
            self._file.seek(offset)
            yield self._file.read(size).decode("ascii")


def _keyed(records: _Records, record: int) -> Iterator[str]:
    """One entry a view: `"frame": record`."""
    yield "{\n"
    for index, frame in enumerate(records.frames):
        (text,) = records.texts(frame, record, record + 1)
        yield ("" if index == 0 else ",\n") + f'  "{frame}": {text}'
    yield "\n}\n"


def _coco(records: _Records, first: int, settings: SceneSettings) -> Iterator[str]:
    head = {
        "info": {
            "description": f"synpick_{settings.split}",
            "url": "",
            "version": "1.0",
            "year": int(DATE[:4]),
            "contributor": "synpick-warp",
            "date_created": DATE,
        },
        "licenses": [{"id": 1, "name": "as of the models", "url": ""}],
        "categories": [{"id": obj_id, "name": str(obj_id), "supercategory": "synpick"} for obj_id in settings.object_ids],
        "images": [_coco_image(frame, settings) for frame in records.frames],
    }
    yield json.dumps(head)[:-1] + ', "annotations": [\n'
    number = 0
    for frame in records.frames:
        for text in records.texts(frame, first, None):
            number += 1
            yield ("" if number == 1 else ",\n") + f'{{"id": {number}, {text[1:]}'
    yield "\n]}\n"


def _coco_image(frame: int, settings: SceneSettings) -> dict[str, object]:
    return {
        "id": frame,
        "file_name": f"rgb/{frame:06d}{settings.color_suffix}",
        "width": settings.width,
        "height": settings.height,
        "date_captured": DATE,
        "license": 1,
        "coco_url": "",
        "flickr_url": "",
    }


def _write_lines(path: Path, parts: Iterable[str]) -> None:
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(parts)
        file.flush()
        os.fsync(file.fileno())
