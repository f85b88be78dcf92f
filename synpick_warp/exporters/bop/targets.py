"""Evaluation target lists of BOP (test_targets_bop19.json, test_targets_bop24.json), from the committed scenes of a split."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec

from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.files import write_atomically
from synpick_warp.inputs.json import read_json
from synpick_warp.inputs.paths import path_inside

BOP19, BOP24 = "test_targets_bop19.json", "test_targets_bop24.json"

_SCENE = re.compile(r"[0-9]{6,12}")
"""Name of a scene's folder."""
_Frame = Annotated[str, msgspec.Meta(pattern=r"\A(0|[1-9][0-9]{0,8})\Z")]
"""Key of a frame in a scene's JSON files."""
_Content = TypeVar("_Content")
_ADVICE = "remove the scene and its episode's two files in manifest/, and resume the bake"


class _Truth(msgspec.Struct):
    obj_id: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]


class _Info(msgspec.Struct):
    visib_fract: float


def find_scenes(split: Path) -> list[Path]:
    """Find the scene folders of a split, sorted; other names, and links, are not ours."""
    return sorted(path for path in split.iterdir() if _SCENE.fullmatch(path.name) and path.is_dir() and not path.is_symlink())


def write_scene_targets(scene: Path, folder: Path, visibility: float) -> None:
    """Task: write a scene's targets, one per line, to `folder/<file name>/<scene name>`; the folders must exist.

    BOP19: for each image and object, the number of instances whose visible fraction is at least `visibility`. BOP24: every image.
    """
    truth = _read(scene, "scene_gt.json", dict[_Frame, list[_Truth]])
    infos = _read(scene, "scene_gt_info.json", dict[_Frame, list[_Info]])
    if {frame: len(entries) for frame, entries in truth.items()} != {frame: len(entries) for frame, entries in infos.items()}:
        raise DatasetError(f"{scene} has other objects in scene_gt.json than in scene_gt_info.json; {_ADVICE}")
    scene_id = int(scene.name)
    localize, detect = [], []
    for frame in sorted(truth, key=int):
        visible = Counter(entry.obj_id for entry, info in zip(truth[frame], infos[frame], strict=True) if info.visib_fract >= visibility)
        image = {"im_id": int(frame)}
        localize += [{**image, "inst_count": count, "obj_id": obj_id, "scene_id": scene_id} for obj_id, count in sorted(visible.items())]
        detect.append({**image, "scene_id": scene_id})
    for name, targets in ((BOP19, localize), (BOP24, detect)):
        (folder / name / scene.name).write_text("".join(json.dumps(target) + "\n" for target in targets), encoding="ascii")


def _read(scene: Path, name: str, schema: type[_Content]) -> _Content:
    return read_json(path_inside(scene, name, scene, DatasetError), schema, DatasetError, _ADVICE)


def concatenate_targets(folder: Path, out: Path) -> None:
    """Concatenate the parts that `write_scene_targets` wrote into the data set's two files, in order of scenes."""
    for name in (BOP19, BOP24):
        parts = sorted((folder / name).iterdir(), key=lambda path: int(path.name))
        lines = [line for part in parts for line in part.read_bytes().splitlines()]
        write_atomically(out / name, b"[\n" + b",\n".join(lines) + b"\n]\n")
