"""BOP target lists (test_targets_bop19.json): the images and objects that poses are estimated for and scored on."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace as replace_struct

from synpick_warp.apps.evaluation.truth import Truth
from synpick_warp.dataset.annotations import TargetEntry
from synpick_warp.errors import ResultError, format_value
from synpick_warp.system.inputs.json import read_json

_FORMAT = "a target list has objects with scene_id, im_id, obj_id and inst_count, as BOP's test_targets_bop19.json"


class TargetRow(msgspec.Struct, frozen=True, order=True, omit_defaults=True):
    """Entry of a target list. `inst_count` is written but not read, since the ground truth has it."""

    scene_id: int
    im_id: int
    obj_id: int | None = None
    """None: all objects of the image, as in test_targets_bop24.json."""
    inst_count: int = 0
    sensor: str = ""
    """See `TargetEntry`."""


@dataclass(frozen=True)
class TargetList:
    """BOP target list, in the order of its file."""

    path: Path
    targets: tuple[TargetRow, ...]

    @cached_property
    def objects(self) -> dict[tuple[int, int], frozenset[int] | None]:
        """(scene, image) -> obj_ids of the targets; None: all objects."""
        found: dict[tuple[int, int], set[int] | None] = {}
        for target in self.targets:
            known = found.setdefault((target.scene_id, target.im_id), set())
            if target.obj_id is None:
                found[target.scene_id, target.im_id] = None
            elif known is not None:
                known.add(target.obj_id)
        return {image: None if known is None else frozenset(known) for image, known in found.items()}

    def in_classic_layout(self, sensors: Sequence[str]) -> TargetList:
        """The list with a scene for each camera, as result files have it; that of a data set of several sensors has one for all of them.

        Args:
            sensors: Names of the sensors; empty: each camera has scenes of its own.

        Raises:
            ResultError: It names a sensor that the data set does not have.
        """
        known = {name: index for index, name in enumerate(sensors)}
        for target in self.targets:
            if target.sensor and target.sensor not in known:
                found = f"sensors: {', '.join(known)}" if known else "it has a scene for each camera"
                raise ResultError(f"{self.path} names the sensor {format_value(target.sensor)}, which the data set does not have; {found}")
        if not known:
            return self
        classic = (
            replace_struct(each, scene_id=len(known) * each.scene_id + known.get(each.sensor, 0), sensor="") for each in self.targets
        )
        return TargetList(self.path, tuple(classic))


def read_targets(path: Path) -> TargetList:
    """Read a target list.

    Raises:
        ResultError: In one line: it cannot be read, is damaged, or is empty.
    """
    entries = read_json(path, list[TargetEntry], ResultError, _FORMAT)
    if not entries:
        raise ResultError(f"{path} lists no images; {_FORMAT}")
    return TargetList(path, tuple(target for entry in entries for target in _read_entry(entry)))


def _read_entry(entry: TargetEntry) -> list[TargetRow]:
    """Targets of an entry, one per image, as it may list several; object None: any object; count 0: not given."""
    images = [(entry.sensor, entry.im_id)] if isinstance(entry.im_id, int) else entry.im_id
    object_id, count = entry.obj_id if isinstance(entry.obj_id, int) else None, entry.inst_count or 0
    return [TargetRow(entry.scene_id, image, object_id, count, sensor) for sensor, image in images]


def in_layout(targets: Sequence[TargetRow], sensors: Sequence[str]) -> list[TargetRow]:
    """Convert targets from the classic layout, a scene for each camera, to scenes with `sensors`: the inverse of `in_classic_layout`.

    Without sensors the lists are alike."""
    if not sensors:
        return list(targets)
    count = len(sensors)
    return [replace_struct(each, scene_id=each.scene_id // count, sensor=sensors[each.scene_id % count]) for each in targets]


def encode_targets(targets: Sequence[TargetRow]) -> bytes:
    """Encode a target list, one target a line, sorted."""
    return b"[\n" + b",\n".join(json.dumps(msgspec.to_builtins(target)).encode() for target in sorted(targets)) + b"\n]\n"


def count_targets(rows: Sequence[tuple[int, int, int]]) -> list[TargetRow]:
    """Targets with their numbers of instances, from instances given as (scene, image, obj_id)."""
    return [TargetRow(scene, image, object_id, count) for (scene, image, object_id), count in Counter(rows).items()]


def select_targets(truth: Truth, targets: TargetList) -> Truth:
    """Reduce the ground truth to listed images and objects; speeds stay those of all frames.

    Raises:
        ResultError: A listed image is not in the data set.
    """
    objects = targets.objects
    known = set(map(tuple, truth.images.tolist()))
    for scene, image in objects:
        if (scene, image) not in known:
            raise ResultError(f"{targets.path}: the data set has no image {image} in scene {scene}")
    images = np.array([image in objects for image in map(tuple, truth.images.tolist())], bool)
    nothing: frozenset[int] = frozenset()
    keys = zip(truth.poses.scene.tolist(), truth.poses.image.tolist(), truth.poses.object_id.tolist(), strict=True)
    rows = np.array([(ids := objects.get((scene, image), nothing)) is None or object_id in ids for scene, image, object_id in keys], bool)
    return replace(truth.select(rows), images=truth.images[images])


def targets_file(results: Path) -> Path:
    """Target list beside a result file: the images and objects that were estimated."""
    return results.with_name(f"{results.stem}-targets.json")
