"""BOP target lists (test_targets_bop19.json): the images and objects that poses are estimated for and scored on."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from synpick_warp.errors import ResultError
from synpick_warp.evaluation.truth import Truth
from synpick_warp.inputs.json import read_json

_FORMAT = "a target list has objects with scene_id, im_id, obj_id and inst_count, as BOP's test_targets_bop19.json"
_Index = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]


class Target(msgspec.Struct, frozen=True, order=True, omit_defaults=True):
    """Entry of a target list. `inst_count` is written but not read, since the ground truth has it."""

    scene_id: _Index
    im_id: _Index
    obj_id: _Index | None = None
    """None: all objects of the image, as in test_targets_bop24.json."""
    inst_count: _Index = 0


@dataclass(frozen=True)
class TargetList:
    """Target list read from a file."""

    path: Path
    targets: tuple[Target, ...]

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


def read_targets(path: Path) -> TargetList:
    """Read a target list.

    Raises:
        ResultError: In one line: it cannot be read, is damaged, or is empty.
    """
    targets = read_json(path, list[Target], ResultError, _FORMAT)
    if not targets:
        raise ResultError(f"{path} lists no images; {_FORMAT}")
    return TargetList(path, tuple(targets))


def encode_targets(targets: Sequence[Target]) -> bytes:
    """Encode a target list, one target a line, sorted."""
    return b"[\n" + b",\n".join(json.dumps(msgspec.to_builtins(target)).encode() for target in sorted(targets)) + b"\n]\n"


def count_targets(rows: Sequence[tuple[int, int, int]]) -> list[Target]:
    """Count instances, given as (scene, image, obj_id), per target."""
    return [Target(scene, image, object_id, count) for (scene, image, object_id), count in Counter(rows).items()]


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
    columns = {name: getattr(truth, name)[rows] for name in ("visibility", "episode", "camera", "mode", "speed")}
    return replace(truth, poses=truth.poses.select(rows), images=truth.images[images], **columns)
