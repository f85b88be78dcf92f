"""Scenes as BOP has them: a view's records put together into the files of a scene, and the scene moved into place.

Runs in writer processes, so it imports neither Warp nor Newton.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from synpick_warp.errors import OutputError
from synpick_warp.exporters.bop_view import RECORDS
from synpick_warp.exporters.files import flush_folder

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
    for name in (RECORDS, "rgb", "depth", *(("mask", "mask_visib") if masks else ()), *layers):
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
        flush_folder(folder)


def drop_scenes(scenes: tuple[Path, ...]) -> None:
    """Remove scenes that will not be delivered."""
    for scene in scenes:
        shutil.rmtree(scene)


def _finish_scene(scene: Path, settings: SceneSettings) -> None:
    records = sorted((scene / RECORDS).iterdir(), key=lambda path: int(path.name))
    if [int(path.name) for path in records] != list(range(settings.frames)):
        raise OutputError(f"{scene} has {len(records)} of {settings.frames} frames; this is an error of synpick-warp, please report it")
    names = ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")
    for line, name in enumerate(names):
        _write_lines(scene / name, _keyed(records, line))
    if settings.coco:
        _write_lines(scene / "scene_gt_coco.json", _coco(records, len(names), settings))
    shutil.rmtree(scene / RECORDS)
    for folder in (*(entry for entry in sorted(scene.iterdir()) if entry.is_dir()), scene):
        flush_folder(folder)


def _keyed(records: list[Path], line: int) -> Iterator[str]:
    """One entry a view: `"frame": record`."""
    yield "{\n"
    for index, path in enumerate(records):
        text = path.read_text(encoding="ascii").split("\n")[line]
        yield ("" if index == 0 else ",\n") + f'  "{int(path.name)}": {text}'
    yield "\n}\n"


def _coco(records: list[Path], first_line: int, settings: SceneSettings) -> Iterator[str]:
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
        "images": [_coco_image(int(path.name), settings) for path in records],
    }
    yield json.dumps(head)[:-1] + ', "annotations": [\n'
    number = 0
    for path in records:
        for text in path.read_text(encoding="ascii").split("\n")[first_line:-1]:
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
