"""Records of pick attempts: read from attempts.jsonl, and explained in sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from synpick_warp.apps.viz.drawing import short_labels
from synpick_warp.configs.cell.gripper import Suction
from synpick_warp.configs.episodes.manipulation import ANOTHER, Pick, Target
from synpick_warp.dataset import records
from synpick_warp.dataset.annotations import ADVICE, check_content
from synpick_warp.dataset.commit.manifest import ATTEMPTS_FILE
from synpick_warp.dataset.records import InstanceObservation
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import read_file
from synpick_warp.system.inputs.json import MAX_JSON, decode_json

MODE_WORDS = {"pick": "untargeted", "target": "targeted"}
CANDIDATES = ("pole", "centroid", "midpoint", "drawn")
"""Kinds of suction points: those in the order of `InstanceObservation.candidates`, and one drawn where the surface is flat."""

MAX_ATTEMPTS = 100
"""Most attempts of one figure."""
MIN_CHOICE = 3
"""Fewest visible objects of an attempt that is worth seeing."""
MAX_RUNS = 20
"""Most ranges of numbers that a message lists."""


class SeenAttempt(records.Attempt, dict=True):
    """Pick attempt as its record, of which the target was visible, and all suction points are in the image."""

    def __post_init__(self) -> None:
        records.Attempt.__post_init__(self)
        width, height = self.observation.resolution
        if self.target is not None and self.target not in self.objects:
            raise ValueError(f"target is {self.target}, which was not visible")
        for one in self.seen:
            if not all(-1.0 <= column <= width and -1.0 <= row <= height for column, row in (*one.candidates, one.grasp_pixel)):
                raise ValueError(f"a point of instance {one.instance} is not in the image of {width} x {height}")

    @cached_property
    def seen(self) -> list[InstanceObservation]:
        """Observations of the visible instances, in the order of instances."""
        return [one for one in self.observation.instances if one.visible > 0]

    @cached_property
    def votes(self) -> dict[tuple[int, int], float]:
        """(lower, upper) -> occlusion votes along the contour of the lower that the upper lies above it."""
        return {(lower, upper): votes for lower, upper, votes in self.observation.votes}

    @property
    def objects(self) -> dict[int, InstanceObservation]:
        """Instance id -> its observation."""
        return {one.instance: one for one in self.seen}

    def ranked(self) -> list[InstanceObservation]:
        """Rank by the choice rule: fewest ancestors, then largest visible area; in targeted picking the reverse."""
        sign = -1 if self.mode == "target" else 1
        return sorted(self.seen, key=lambda one: (sign * len(one.ancestors), -sign * one.visible_fraction, one.instance))


def read_attempts(dataset: Path, episode: int, number: int | None) -> list[SeenAttempt]:
    """Read the attempts of an episode, sorted, or one of them.

    Raises:
        DatasetError: The file is missing or damaged, or has no such episode or attempt.
    """
    path, lines = _read_lines(dataset)
    keys = [decode_json(line, records.AttemptKey, _line(path, row), DatasetError, ADVICE) for row, line in enumerate(lines)]
    episodes = sorted({key.episode for key in keys})
    if episode not in episodes:
        raise DatasetError(f"{path} has no attempt of episode {episode}; {_which('episodes that have', episodes)}")
    rows = sorted((key.attempt, row) for row, key in enumerate(keys) if key.episode == episode)
    numbers = [row[0] for row in rows]
    if number is not None and number not in numbers:
        raise DatasetError(f"{path} has no attempt {number} of episode {episode}; {_which('attempts', numbers)}")
    if len(rows) > MAX_ATTEMPTS and number is None:
        raise DatasetError(
            f"{path} has {len(rows)} attempts of episode {episode}; a figure has at most {MAX_ATTEMPTS}: name one by --attempt"
        )
    return [decode_json(lines[row], SeenAttempt, _line(path, row), DatasetError, ADVICE) for count, row in rows if number in (None, count)]


def choose_attempts(dataset: Path, count: int) -> list[SeenAttempt]:
    """Choose the first attempts worth seeing; if there are fewer, others from the beginning stand in. In the order of the file.

    Worth seeing is an attempt that chose among MIN_CHOICE objects or more, of which some lie on others, and engaged one.

    Raises:
        DatasetError: The file is missing or damaged, or has no attempt.
    """
    path, lines = _read_lines(dataset)
    worthy: dict[int, SeenAttempt] = {}
    others: dict[int, SeenAttempt] = {}
    for row, line in enumerate(lines):
        attempt = decode_json(line, SeenAttempt, _line(path, row), DatasetError, ADVICE)
        chosen = attempt.target is not None and len(attempt.seen) >= MIN_CHOICE and any(one.above for one in attempt.seen)
        if chosen and attempt.engaged:
            worthy[row] = attempt
        elif len(others) < count:
            others[row] = attempt
        if len(worthy) == count:
            break
    if not worthy and not others:
        raise DatasetError(f"{path} has no attempt; explain draws those of a bake with mode pick, target, mixed or cycle")
    rows = [*worthy, *others][:count]
    return [(worthy | others)[row] for row in sorted(rows)]


def _read_lines(dataset: Path) -> tuple[Path, list[bytes]]:
    """The file of attempts, and its lines.

    Raises:
        DatasetError: It is missing or cannot be read.
    """
    path = dataset / ATTEMPTS_FILE
    if not path.exists():
        raise DatasetError(
            f"{dataset} has no {path.name}: it has no pick attempts; explain draws those of a bake with mode pick, target, mixed or cycle"
        )
    return path, read_file(path, MAX_JSON, DatasetError).splitlines()


def parse_attempt(content: Mapping[str, Any], source: str) -> SeenAttempt:
    """Parse a record of `synpick_warp.dataset.reading.Episode.attempts`.

    Raises:
        DatasetError: It is damaged.
    """
    return check_content(content, SeenAttempt, source)


def _line(path: Path, row: int) -> str:
    """Name of a line of a file, for messages."""
    return f"{path}, line {row + 1},"


def _which(what: str, numbers: list[int]) -> str:
    """List ascending integers with runs merged, up to MAX_RUNS runs: "attempts: 0 to 3, 5"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    shown = [f"{low}" if low == high else f"{low} to {high}" for low, high in runs[:MAX_RUNS]] + ["..."] * (len(runs) > MAX_RUNS)
    return f"{what}: {', '.join(shown) or 'none'}"


def labels(attempt: SeenAttempt) -> dict[int, str]:
    """Short label of every visible instance, see `short_labels`."""
    return short_labels((one.instance, one.object_id) for one in attempt.seen)


def full_names(attempt: SeenAttempt, names: Mapping[int, str]) -> dict[int, str]:
    """Label and name of every visible instance."""
    short = labels(attempt)
    return {one.instance: f"{short[one.instance]} {names.get(one.object_id, '')}".rstrip() for one in attempt.seen}


def suction_kind(one: InstanceObservation) -> int:
    """Index in CANDIDATES of the suction point: of the nearest candidate, as the point is rounded to a pixel; the last beyond that."""
    distances = [math.dist(point, one.grasp_pixel) for point in one.candidates]
    return distances.index(min(distances)) if min(distances) <= 1.0 else len(distances)


def choice_words(attempt: SeenAttempt, names: Mapping[int, str], target: Target, pick: Pick) -> list[str]:
    """Explain in sentences the chosen target, the reason, and the suction point."""
    if attempt.target is None:
        return ["target: none, nothing is visible"]
    full = full_names(attempt, names)
    one = attempt.objects[attempt.target]
    kind = suction_kind(one)
    where = ("pole of inaccessibility", "centroid", "half-way point", "drawn where the surface is flattest")[kind]
    if 0 < kind < len(one.distances):
        where += f", {one.distances[kind] / one.distances[0] if one.distances[0] else 1.0:.2f} of the pole's distance"
    tilt = "" if attempt.tilt is None else f"; cup tilted by {abs(math.degrees(attempt.tilt)):.0f} degrees"
    return [f"target: {full[attempt.target]}: {_reason(attempt, one, full, target, pick)}", f"suction point: {where}{tilt}"]


def _reason(attempt: SeenAttempt, one: InstanceObservation, full: Mapping[int, str], target: Target, pick: Pick) -> str:
    """Clause on why an object was chosen: number of objects above it, and its visible area if several have as many.

    The area is relative to the largest face of the bounding box: seen obliquely, an object can show more.
    """
    targeted = attempt.mode == "target"
    count = len(one.ancestors)
    above = f"{count} object{'' if count == 1 else 's'} above"
    first = attempt.ranked()[0]
    if first.visible_fraction != one.visible_fraction or len(first.ancestors) != count:
        if targeted and target.random_after_failure:
            return f"{above}; chosen at random after a failed attempt"
        if pick.retry == ANOTHER:
            return f"{above}; attempts have failed at {full[first.instance]}"
        return f"{above}; the rule would name {full[first.instance]}"
    equals = sum(len(other.ancestors) == count for other in attempt.seen)
    if len(attempt.seen) == 1:
        return f"{above}; the only visible object"
    if equals == 1:
        return f"{above}, the {'most' if targeted else 'fewest'} of all"
    area = f"visible area {one.visible_fraction:.2f} of its box's largest face"
    return f"{above}; {area}, the {'smallest' if targeted else 'largest'} of {equals} such"


def seal_words(attempt: SeenAttempt, names: Mapping[int, str], suction: Suction) -> list[str]:
    """Explain in sentences the rays, the seal, its force and the picked objects; none if nothing was chosen."""
    if attempt.target is None:
        return []
    full = full_names(attempt, names)
    lines = [f"rays: {attempt.hits} of {attempt.rays} hit"]
    if attempt.hits:
        seal = f"{'good' if attempt.good_seal else 'poor'} seal, breaks"
        if attempt.sealed is not None:
            seal = f"{len(attempt.sealed)} of {attempt.rays // (suction.rays + suction.mouth_rays)} cups with a good seal, break"
        lines[0] += f"; {seal} at {break_force(attempt, suction):.3g} N"
        peak = f"; largest force {max(attempt.peak_force):.1f} N" if attempt.peak_force else ""
        lines.append(f"engaged: {_listed(attempt.engaged, full)}{peak}")
        lines.append(f"picked: {_listed(attempt.picked, full)}")
    return lines


def break_force(attempt: SeenAttempt, suction: Suction) -> float:
    """Force at which the strongest seal of the attempt breaks, or with `suction.vacuum` the weakest [N]."""
    if attempt.break_force is not None:
        return attempt.break_force
    return suction.good_force if attempt.good_seal or attempt.sealed else suction.poor_force


def _listed(instances: Sequence[int], full: Mapping[int, str]) -> str:
    """List names of instances; an engaged object can be invisible to the camera of perception."""
    return ", ".join(full.get(instance, f"instance {instance}, unseen") for instance in instances) or "nothing"
