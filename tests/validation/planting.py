"""Changes of a data set, from which faults are made: functions of its folder that edit annotations, images, masks or bytes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq

from synpick_warp.dataset.reading import open_data_set
from synpick_warp.exporters.picks import make_table, pick_files
from synpick_warp.views.picks import COLUMNS
from tests.harness.hostile import removed, replaced

SCENE = "train/000001"
GT, INFO, CAMERA, COCO = (f"{SCENE}/scene_{name}.json" for name in ("gt", "gt_info", "camera", "gt_coco"))
MODELS, TARGETS, SHARD = "models/models_info.json", "test_targets_bop19.json", "train_web/shard-000000.tar"
Plant = Callable[[Path], Any]


def edit(path: Path, change: Callable[[Any], Any]) -> None:
    """Change a JSON file in place."""
    content = json.loads(path.read_text())
    changed = change(content)
    path.write_text(json.dumps(content if changed is None else changed))


def edit_entry(folder: Path, name: str, index: int | None = None, image: str = "1", **values: Any) -> None:
    """Set keys of an entry in a scene's JSON file."""
    edit(folder / SCENE / f"scene_{name}.json", lambda content: (content[image] if index is None else content[image][index]).update(values))


def whole(name: str, change: Callable[[Any], Any]) -> Plant:
    """A JSON file's content is changed in place or, if the change returns something, replaced."""
    return lambda folder: edit(folder / name, change)


def put(name: str, *place: Any) -> Plant:
    """The last of the arguments stands at the place that the others name."""
    return whole(name, lambda content: replaced(content, place[:-1], place[-1]))


def moved(name: str, *place: Any) -> Plant:
    """A number at a place of a JSON file is larger by the last argument; numbers in a list, each."""

    def add(content: Any) -> Any:
        value = content
        for key in place[:-1]:
            value = value[key]
        return replaced(content, place[:-1], np.add(value, place[-1]).tolist())

    return whole(name, add)


def drop(name: str, *place: Any) -> Plant:
    """A JSON file lacks what stands at a place."""
    return whole(name, lambda content: removed(content, place))


def gone(name: str) -> Plant:
    """A file is missing."""
    return lambda folder: (folder / name).unlink()


def named(name: str, other: str) -> Plant:
    """A file or folder has another name."""
    return lambda folder: (folder / name).rename(folder / other)


def doubled(name: str, other: str) -> Plant:
    """A file is there twice."""
    return lambda folder: (folder / other).write_bytes((folder / name).read_bytes())


def raw(name: str, change: Callable[[bytes], bytes]) -> Plant:
    """A file has other bytes."""
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


def trials(change: Callable[[np.ndarray], Any]) -> Plant:
    """The trials of picks are changed in place or, if the change returns some, replaced."""

    def damage(folder: Path) -> None:
        path, rows = folder / pick_files(0)[0], open_data_set(folder)[0].picks
        changed = change(rows)
        pq.write_table(make_table(COLUMNS, rows if changed is None else changed), path)

    return damage


def pixels(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    """Images of scene 1 whose names fit the pattern have other pixels; a change in place returns the image, too."""

    def plant(folder: Path) -> None:
        paths = list((folder / SCENE).glob(name))
        assert paths
        for path in paths:
            write(path, change(read(path)))

    return plant


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def write(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image)


def mask_path(folder: Path, index: int, kind: str = "mask") -> Path:
    return folder / SCENE / kind / f"000001_{index:06d}.png"
