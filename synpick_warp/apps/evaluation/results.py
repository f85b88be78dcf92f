"""BOP result files and target lists, read with checks and written; and their evaluation: estimates are matched with ground truth.

A line of a result file (CSV, version bop19 of the BOP toolkit) is `scene_id,im_id,obj_id,score,R,t,time`: R has 9 numbers row by row, t has
3 in millimetres, both separated by spaces, time is in seconds for the image, -1 if unknown. The header may be missing. Angles and units are
those of scene_gt.json: object to camera. A target list (test_targets_bop19.json) has the images and objects that poses are estimated for
and scored on.
"""

import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace as replace_struct

from synpick_warp.apps.evaluation.errors import Model, Scores, read_models, score
from synpick_warp.apps.evaluation.figures import Method
from synpick_warp.apps.evaluation.tables import GROUPS, ScoreRow, summarize
from synpick_warp.apps.evaluation.tracking import filter_poses
from synpick_warp.apps.evaluation.truth import CameraMotion, PoseTable, Truth, read_truth
from synpick_warp.dataset.annotations import TargetEntry
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import ConfigError, OutputError, ResultError, escape, format_value
from synpick_warp.exporters.writing.files import output_errors, write_atomically
from synpick_warp.system.inputs.files import read_file, read_json

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
FORMAT = f"{HEADER}, with 9 numbers in R and 3 in t [mm], separated by spaces"
MAX_RESULTS = 2**30
"""Largest result file [bytes]: some seven million rows."""
MAX_INDEX = 2**31 - 1
"""Largest scene, image or object index: data sets keep them in 32 bits."""
MAX_NUMBER = 1e9
"""Largest coordinate [mm], score or time: larger ones are mistakes, whose squares overflow."""
TOLERANCE = 1e-3
"""Of R Rᵀ = 1 in each element: three decimals of the matrix are enough."""
_BLOCK = 2**15
"""Lines that are converted at once."""
_UNITS = 100.0
"""Factor between the distances of estimates and truth from which on the unit is wrong, as objects lie at nearly the same distance."""
_NAMES = ("scene_id", "im_id", "obj_id")
_FIELDS = 7
_WHOLE = re.compile(rb"\s*[+-]?[0-9]{1,18}\s*")
_CHARACTERS = b"0123456789+-.eEnNaAiIfFtTyY, \t\r"


@dataclass(frozen=True, eq=False)
class ResultFile:
    """Pose estimates of one BOP result file, with the line number of each."""

    path: Path
    poses: PoseTable
    lines: np.ndarray
    """Line of each row in the file (N,) int64, from 1."""


def read_results(path: Path) -> ResultFile:
    """Read a BOP result file; rows are sorted by scene, image and object, and keep their order where these are equal. Raises ResultError in
    one line with the line's number: wrong columns, a number that is none, not finite or out of range, a matrix that is no rotation, a row
    that is there twice; or the file is empty, too large or cannot be read."""
    lines = read_file(path, MAX_RESULTS, ResultError).removeprefix(b"\xef\xbb\xbf").split(b"\n")
    while lines and not lines[-1].strip():
        lines.pop()
    first = 1 if lines and HEADER.encode() in lines[0] else 0
    if len(lines) <= first:
        raise ResultError(f"{path} has no pose estimates; each line is {FORMAT}")
    blocks = [_convert(lines[start : start + _BLOCK], path, start + 1) for start in range(first, len(lines), _BLOCK)]
    indices, reals = (np.concatenate(columns) for columns in zip(*blocks, strict=True))
    numbers = np.arange(first + 1, len(lines) + 1)
    _check_rows(indices, reals, numbers, path)
    order = np.lexsort(indices.T[::-1])
    indices, reals = indices[order], reals[order]
    poses = PoseTable(
        scene=indices[:, 0],
        image=indices[:, 1],
        object_id=indices[:, 2],
        rotation=reals[:, 1:10].reshape(-1, 3, 3),
        translation=1e-3 * reals[:, 10:13],
        score=reals[:, 0],
        seconds=np.where(reals[:, 13] < 0.0, -1.0, reals[:, 13]),
        instance=np.full(len(indices), -1, np.int64),
    )
    return ResultFile(path, poses, numbers[order])


def _convert(lines: list[bytes], path: Path, start: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices (N, 3) int64, and score, R, t and time (N, 14) float64 of lines from line `start` on; raises ResultError."""
    rows = [line.split(b",") for line in lines]
    for number, (line, row) in enumerate(zip(lines, rows, strict=True), start):
        # Cheap checks of every line, which make the conversion below fit; the messages are composed only if one fails.
        if len(row) != _FIELDS or len(row[4].split()) != 9 or len(row[5].split()) != 3 or line.translate(None, _CHARACTERS):
            raise ResultError(_find_fault(line, f"{path}, line {number}"))
    try:
        indices = np.array([[int(text) for text in row[:3]] for row in rows], np.int64)
        reals = np.array(
            [[float(row[3]), *map(float, row[4].split()), *map(float, row[5].split()), float(row[6])] for row in rows], np.float64
        )
        return indices, reals
    except (ValueError, OverflowError):
        for number, line in enumerate(lines, start):
            if message := _find_fault(line, f"{path}, line {number}"):
                raise ResultError(message) from None
        raise


def _find_fault(line: bytes, place: str) -> str:
    """Message about the first fault of a line: wrong number of columns or of their numbers, a text that is no number; empty: none."""
    row = line.split(b",")
    if not line.strip():
        return f"{place} is empty; each line is {FORMAT}"
    if len(row) != _FIELDS:
        return f"{place} has {len(row)} columns; allowed: {_FIELDS} separated by commas, {FORMAT}"
    for name, part, count in (("R", row[4], 9), ("t", row[5], 3)):
        if len(part.split()) != count:
            return f"{place} has {len(part.split())} numbers in {name}; allowed: {count} separated by spaces"
    for name, text in zip(_NAMES, row, strict=False):
        if _WHOLE.fullmatch(text) is None:
            return f"{place}: {name} is {_show(text)}; allowed: a whole number from 0 to {MAX_INDEX}"
    for name, part in zip(("score", "R", "t", "time"), row[3:], strict=True):
        for text in part.split() or [b""]:
            try:
                float(text)
            except ValueError:
                return f"{place}: {name} has {_show(text)}, which is no number"
        if name in ("score", "time") and len(part.split()) != 1:
            return f"{place}: {name} is {_show(part)}; allowed: one number"
    return f"{place} has a character that is not part of a number: {_show(line)}" if line.translate(None, _CHARACTERS) else ""


def _show(text: bytes) -> str:
    """Text of a file for a message, cut and printable."""
    shown = text.strip().decode("utf-8", "replace")
    return f'"{shown if len(shown) <= 40 else shown[:39] + "…"}"'


def _check_rows(indices: np.ndarray, reals: np.ndarray, numbers: np.ndarray, path: Path) -> None:
    """Check ranges, rotations and duplicates; names the first line at fault."""

    def refuse(bad: Any, text: str) -> None:
        if bad.any():
            raise ResultError(f"{path}, line {numbers[np.argmax(bad)]}: {text}")

    for column, name in enumerate(_NAMES):
        values = indices[:, column]
        bad = (values < 0) | (values > MAX_INDEX)
        refuse(bad, f"{name} is {values[np.argmax(bad)]}; allowed: 0 to {MAX_INDEX}")
    for name, part in (("score", slice(0, 1)), ("R", slice(1, 10)), ("t", slice(10, 13)), ("time", slice(13, 14))):
        refuse(np.any(~np.isfinite(reals[:, part]), axis=1), f"{name} is not finite; leave out rows without a pose")
        refuse(np.any(np.abs(reals[:, part]) > MAX_NUMBER, axis=1), f"{name} has a number above {MAX_NUMBER:g}")
    rotation = reals[:, 1:10].reshape(-1, 3, 3)
    off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    worst = off[np.argmax(off > TOLERANCE)]
    refuse(off > TOLERANCE, f"R is no rotation: R Rᵀ differs from 1 by {worst:.2g}; allowed: {TOLERANCE:g}")
    refuse(np.linalg.det(rotation) < 0.0, "R is a reflection, its determinant is -1; allowed: rotations")
    _check_duplicates(indices, reals, numbers, path)


def _check_duplicates(indices: np.ndarray, reals: np.ndarray, numbers: np.ndarray, path: Path) -> None:
    """Refuse a row whose scene, image, object and pose another row has."""
    columns = np.concatenate((indices, reals[:, 1:13]), axis=1) + 0.0  # -0 becomes 0.
    order = np.lexsort(columns.T)
    same = np.flatnonzero((np.diff(columns[order], axis=0) == 0.0).all(axis=1))
    if len(same):
        lines = np.sort(numbers[order[same[:, None] + (0, 1)]], axis=1)
        first, second = lines[np.argmin(lines[:, 1])]
        raise ResultError(f"{path}, line {second} has the object and the pose of line {first}; keep one of them")


def check_results(results: ResultFile, truth: Truth, object_ids: Collection[int]) -> None:
    """Raise ResultError, with the line's number, unless scenes, images and objects of estimates exist, and lengths are in millimetres."""
    poses = results.poses
    scenes = np.unique(truth.images[:, 0])
    _refuse_unknown(results, poses.scene, scenes, "scene")
    _refuse_unknown(results, poses.object_id, np.unique(np.array(sorted(object_ids), np.int64)), "object")
    images = truth.images[:, 0] * (MAX_INDEX + 1) + truth.images[:, 1]
    unknown = ~np.isin(poses.scene * (MAX_INDEX + 1) + poses.image, images)
    if unknown.any():
        row = _first(results, unknown)
        scene = poses.scene[row]
        known = truth.images[truth.images[:, 0] == scene, 1]
        raise ResultError(
            f"{results.path}, line {results.lines[row]}: scene {scene} has no image {poses.image[row]};"
            f" its images are {known.min()} to {known.max()}"
        )
    _check_units(results, truth)


def _refuse_unknown(results: ResultFile, values: np.ndarray, known: np.ndarray, what: str) -> None:
    """Raise ResultError for the first row whose value (scene, image, object) is not in `known`; the message lists these."""
    unknown = ~np.isin(values, known)
    if unknown.any():
        row = _first(results, unknown)
        shown = ", ".join(map(str, known[:10].tolist())) + (", ..." if len(known) > 10 else "")
        raise ResultError(f"{results.path}, line {results.lines[row]}: the data set has no {what} {values[row]}; its {what}s: {shown}")


def _first(results: ResultFile, bad: np.ndarray) -> int:
    """Row of the bad entry that comes first in the file."""
    rows = np.flatnonzero(bad)
    return int(rows[np.argmin(results.lines[rows])])


def _check_units(results: ResultFile, truth: Truth) -> None:
    """Raise ResultError if the median distance from the camera is so far from the truth's that t seems to have another unit."""
    if not len(truth):
        return
    estimated, true = (float(np.median(np.linalg.norm(poses.translation, axis=1))) for poses in (results.poses, truth.poses))
    if estimated * _UNITS < true:
        reason = "t seems to be in metres; BOP result files have millimetres: multiply t by 1000"
    elif estimated > true * _UNITS:
        reason = "t seems to be 1000 times too large; BOP result files have millimetres: divide t by 1000"
    else:
        return
    line = int(results.lines.min())
    raise ResultError(
        f"{results.path}, line {line}: {reason}"
        f" (median distance from the camera {1e3 * estimated:.4g} mm, in the data set {1e3 * true:.4g} mm)"
    )


def encode_results(poses: PoseTable) -> bytes:
    """Encode pose estimates as a BOP result file; numbers have all of their digits."""
    lines = [HEADER]
    for row in range(len(poses)):
        rotation = " ".join(map(repr, poses.rotation[row].reshape(-1).tolist()))
        translation = " ".join(map(repr, (1e3 * poses.translation[row]).tolist()))
        key = f"{poses.scene[row]},{poses.image[row]},{poses.object_id[row]}"
        lines.append(f"{key},{float(poses.score[row])!r},{rotation},{translation},{float(poses.seconds[row])!r}")
    return ("\n".join(lines) + "\n").encode("ascii")


def write_results(path: Path, poses: PoseTable) -> None:
    """Write pose estimates as a BOP result file, atomically; raises OutputError if the file cannot be written."""
    if path.is_dir():
        raise OutputError(f"{path} is a folder; name a file")
    with output_errors(path):
        write_atomically(path, encode_results(poses))


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

    def in_classic_layout(self, sensors: Sequence[str]) -> "TargetList":
        """The list with a scene for each camera, as result files have it; that of a data set of several `sensors` has one for all of them.
        Raises ResultError if it names a sensor that the data set does not have."""
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
    """Read a target list; raises ResultError in one line if it cannot be read, is damaged, or is empty."""
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
    """Convert targets from the classic layout, a scene for each camera, to scenes with `sensors` (none: as they are); the inverse of
    `in_classic_layout`."""
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
    """Ground truth of listed images and objects; speeds stay those of all frames. Raises ResultError if a listed image is missing."""
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


class Evaluation(NamedTuple):
    """Scores of several methods on the same targets, and what they were made of."""

    truth: Truth
    methods: list[Method]
    scores: list[Scores]
    rows: list[ScoreRow]
    """Averages by object, mode, camera, visibility and speed."""
    models: Mapping[int, Model]


def score_files(
    data_set: DataSet,
    results: Sequence[Path],
    min_visibility: float,
    top: int,
    vertices: int,
    alpha: float | None = None,
    targets: Path | None = None,
    remark: Callable[[str], None] = lambda _: None,
) -> Evaluation:
    """Score BOP result files, one for each method, as `synpick_warp.evaluate`; `remark` receives a line for each file without estimates in
    some images. Raises SynpickError if a file is missing, damaged or of another data set, or nothing is as visible as that."""
    # Result files first: their mistakes are the likely ones, and quick to find.
    files = [read_results(path) for path in results]
    truth = read_truth(data_set)
    models = read_models(data_set.folder, truth.poses.object_id.tolist(), vertices)
    for file in files:
        check_results(file, truth, set(data_set.models_info) | set(models))
    if targets is not None:
        truth = select_targets(truth, read_targets(targets).in_classic_layout(data_set.sensors))
    if not truth.shown(min_visibility).any():
        raise ConfigError(f"--visib-min is {min_visibility:g}; no instance of {data_set.folder} is as visible as that; lower it")
    for line in describe_gaps(files, truth, listed=targets is not None):
        remark(line)
    methods = make_methods(results, files, alpha, truth.motion)
    scores = [score(label, truth, poses, models, min_visibility, top) for method in methods for label, poses in method.variants()]
    # Modes are those of a bake.
    groups = [group for group in GROUPS if group != "mode" or data_set.found is None]
    return Evaluation(truth, methods, scores, summarize(truth, scores, object_names(data_set), groups), models)


def describe_gaps(files: Sequence[ResultFile], truth: Truth, *, listed: bool) -> Iterator[str]:
    """A line for each result file without any estimate in an image that has targets. `listed`: images are those of a target list."""
    wanted = set(zip(truth.poses.scene.tolist(), truth.poses.image.tolist(), strict=True))
    for file in files:
        missing = len(wanted - set(zip(file.poses.scene.tolist(), file.poses.image.tolist(), strict=True)))
        own = targets_file(file.path)
        advice = f"; --targets {own} scores those that were estimated" if not listed and own.is_file() else ""
        if missing:
            yield f"{file.path} has no estimate in {missing:,} of {len(wanted):,} images, whose objects count as missed{advice}"


def make_methods(results: Sequence[Path], files: Sequence[ResultFile], alpha: float | None, motion: CameraMotion) -> list[Method]:
    """Named estimates of each file, with the filtered ones, by their motion in the world, if there is a weight `alpha`."""

    def filtered(poses: PoseTable) -> PoseTable | None:
        return None if alpha is None else motion.to_camera(filter_poses(motion.to_world(poses), alpha))

    return [Method(name, file.poses, filtered(file.poses), alpha) for name, file in zip(method_names(results), files, strict=True)]


def object_names(data_set: DataSet) -> dict[int, str]:
    """Names of objects by obj_id, which the trajectory store has; empty without."""
    return {item.object_id: item.name for item in data_set.objects} if data_set.has_store else {}


def method_names(results: Sequence[Path]) -> list[str]:
    """Name of each method: its file's up to the first underscore, as BOP has it; the whole path where two would be equal."""
    stems = [escape(path.stem) for path in results]
    short = [stem.partition("_")[0] or stem for stem in stems]
    if len(set(short)) == len(short):
        return short
    return stems if len(set(stems)) == len(stems) else [escape(str(path)) for path in results]
