"""Evaluation target lists of BOP (test_targets_bop19.json, test_targets_bop24.json), from the committed scenes of the splits."""

import json
import re
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Annotated

import msgspec

from synpick_warp.configs.dataset import DataLayout, split_kind
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.files import join_lines, write_atomically
from synpick_warp.system.inputs.files import path_inside, read_json

BOP19, BOP24, MULTIVIEW = "test_targets_bop19.json", "test_targets_bop24.json", "test_targets_multiview_bop25.json"
_SCENE = re.compile(r"[0-9]{6,12}")
"""Name of a scene's folder."""
_Frame = Annotated[str, msgspec.Meta(pattern=r"\A(0|[1-9][0-9]{0,8})\Z")]
"""Key of a frame in a scene's JSON files."""
_ADVICE = "remove the scene and its episode's two files in manifest/, and resume the bake"


class _Truth(msgspec.Struct):
    """Schema of an instance in scene_gt.json, as far as targets need it: obj_id."""

    obj_id: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]


class _Info(msgspec.Struct):
    """Schema of an instance in scene_gt_info.json, as far as targets need it: visible fraction."""

    visib_fract: float


def sensor_suffixes(layout: DataLayout) -> tuple[str, ...]:
    """Suffixes of the sensors' files in a scene; one empty string in the classic layout."""
    return tuple(layout.scene(0, camera)[1] for camera in range(layout.cameras)) if layout.has_sensors else ("",)


def _kinds(layout: DataLayout) -> tuple[str, ...]:
    """Kinds of target lists; the multi-view one only with several sensors in a scene."""
    return (BOP19, BOP24, *((MULTIVIEW,) if layout.has_sensors else ()))


def scene_target_files(layout: DataLayout, folder: str) -> tuple[str, ...]:
    """Names of a split's target lists (BOP19, BOP24, and MULTIVIEW with several sensors), by the split's kind.

    Without splits, all scenes are in the lists named test, which the toolkit's scripts open for any split.

    Lists begin with the kind of their splits, as in val_targets_bop19.json; splits of one kind share them, as scene ids are unique.
    """
    kind = split_kind(folder) if layout.splits else "test"
    return tuple(name.replace("test", kind, 1) for name in _kinds(layout))


def target_files(layout: DataLayout) -> tuple[str, ...]:
    """All files that list targets. Those named test always exist, as BOP's toolkit opens them for any split."""
    return tuple(dict.fromkeys((*_kinds(layout), *(name for folder in layout.folders for name in scene_target_files(layout, folder)))))


def find_scenes(split: Path, scenes: Collection[int]) -> list[Path]:
    """Find the scene folders in a split's folder, sorted; other names and links are left out."""
    places = (path for path in split.iterdir() if _SCENE.fullmatch(path.name) and int(path.name) in scenes)
    return sorted(path for path in places if path.is_dir() and not path.is_symlink())


def write_scene_targets(scene: Path, folders: tuple[str, ...], visibility: float, sensors: tuple[str, ...] = ("",)) -> None:
    """Task: write a scene's targets (`make_scene_targets`) under its name into a folder for each list."""
    for folder, lines in zip(folders, make_scene_targets(scene, visibility, sensors), strict=False):
        Path(folder, scene.name).write_bytes(lines)


def make_scene_targets(scene: Path, visibility: float, sensors: tuple[str, ...]) -> Iterator[bytes]:
    """Yield a scene's targets, one per line, for each list: BOP19, BOP24, MULTIVIEW.

    BOP19: for each image and object, the number of instances of at least `visibility` (fraction), if any. BOP24: every image. Of several
    sensors, both list the images of the first, by which the toolkit evaluates. MULTIVIEW: the images of all sensors at a time.
    """
    truths, details = (path_inside(scene, f"scene_{name}{sensors[0]}.json", scene, DatasetError) for name in ("gt", "gt_info"))
    truth = read_json(truths, dict[_Frame, list[_Truth]], DatasetError, _ADVICE)
    infos = read_json(details, dict[_Frame, list[_Info]], DatasetError, _ADVICE)
    if {frame: len(entries) for frame, entries in truth.items()} != {frame: len(entries) for frame, entries in infos.items()}:
        raise DatasetError(f"{scene} has other objects in scene_gt.json than in scene_gt_info.json; {_ADVICE}")
    scene_id = int(scene.name)
    localize, detect, together = [], [], []
    for frame in sorted(truth, key=int):
        visible = Counter(entry.obj_id for entry, info in zip(truth[frame], infos[frame], strict=True) if info.visib_fract >= visibility)
        image = {"im_id": int(frame)}
        localize += [{**image, "inst_count": count, "obj_id": obj_id, "scene_id": scene_id} for obj_id, count in sorted(visible.items())]
        detect.append({**image, "scene_id": scene_id})
        together.append({"im_id": [[sensor.removeprefix("_"), int(frame)] for sensor in sensors], "scene_id": scene_id})
    for targets in (localize, detect, together):
        yield "".join(json.dumps(target) + "\n" for target in targets).encode()


def concatenate_targets(folder: Path, out: Path, names: tuple[str, ...]) -> None:
    """Concatenate the parts in `folder/name`, of a scene or of many, into the data set's files, in order of their numbers."""
    for name in names:
        parts = sorted((folder / name).iterdir(), key=lambda path: int(path.name))
        write_atomically(out / name, join_lines(parts, b"[", b"]\n"))
