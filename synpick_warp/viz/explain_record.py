"""Records of pick attempts: parsed and validated from attempts.jsonl, and explained in sentences."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from synpick_warp.configs.schema import Config
from synpick_warp.dataset.manifest import ATTEMPTS_FILE
from synpick_warp.errors import DatasetError

MODE_WORDS = {"pick": "untargeted", "target": "targeted"}
CANDIDATES = ("pole", "centroid", "midpoint")
"""Candidates of the suction point, in the order of `SeenObject.distances`."""

Pixel = tuple[float, float]
"""Column and row in the perception image; integers are pixel centres."""


@dataclass(frozen=True)
class SeenObject:
    """Observation of one visible instance."""

    instance: int
    object_id: int
    visible: int
    """Pixel count of its largest connected component."""
    visible_fraction: float
    """Visible fraction of the expected area."""
    candidates: tuple[Pixel, Pixel, Pixel]
    """Positions of `CANDIDATES`."""
    distances: tuple[float, float, float]
    """Distance of each candidate to the contour [px]."""
    grasp_pixel: Pixel
    above: frozenset[int]
    """Parents: instances with an edge of the clutter graph to this one."""
    ancestors: frozenset[int]
    """Ancestors: instances with a path to this one (transitive closure)."""


@dataclass(frozen=True)
class Attempt:
    """One pick attempt."""

    episode: int
    number: int
    mode: str
    frame: int
    """Frame of the observation."""
    end_frame: int
    sentence: str
    """The outcome in words."""
    target: int | None
    tilt: float | None
    """Tilt of the cup about the wrist axis [rad]; None: nothing was chosen."""
    rays: int
    hits: int
    good_seal: bool
    engaged: tuple[int, ...]
    picked: tuple[int, ...]
    peak_force: tuple[float, ...]
    """Largest seal force in each tick of the lift [N]; the suction is switched on at the end of the first."""
    resolution: tuple[int, int]
    """Width and height of the perception image [px]."""
    seen: tuple[SeenObject, ...]
    votes: dict[tuple[int, int], float]
    """(lower, upper) -> occlusion votes along the contour of the lower that the upper lies above it."""

    @property
    def objects(self) -> dict[int, SeenObject]:
        """Instance id -> its observation."""
        return {one.instance: one for one in self.seen}

    def ranked(self) -> list[SeenObject]:
        """Rank by the choice rule: fewest ancestors, then largest visible fraction; in targeted picking the reverse."""
        sign = -1 if self.mode == "target" else 1
        return sorted(self.seen, key=lambda one: (sign * len(one.ancestors), -sign * one.visible_fraction, one.instance))


def read_attempts(dataset: Path, episode: int, number: int | None) -> list[Attempt]:
    """Read the attempts of an episode, sorted, or one of them.

    Raises:
        DatasetError: The file is missing or damaged, or has no such episode or attempt.
    """
    path = dataset / ATTEMPTS_FILE
    records = _read_records(path)
    episodes = sorted({record["episode"] for _, record in records})
    if episode not in episodes:
        raise DatasetError(f"{path} has no attempt of episode {episode}; {_which('episodes that have', episodes)}")
    rows = sorted((record["attempt"], line, record) for line, record in records if record["episode"] == episode)
    numbers = [row[0] for row in rows]
    if number is not None and number not in numbers:
        raise DatasetError(f"{path} has no attempt {number} of episode {episode}; {_which('attempts', numbers)}")
    attempts = []
    for count, line, record in rows:
        if number in (None, count):
            try:
                attempts.append(_attempt(record))
            except KeyError as error:
                raise DatasetError(f"{path}, line {line}: the record has no {error.args[0]}") from error
            except (TypeError, ValueError, AttributeError, ArithmeticError) as error:
                raise DatasetError(f"{path}, line {line}: the record of an attempt has a value of the wrong type: {error}") from error
    return attempts


def _read_records(path: Path) -> list[tuple[int, dict[str, Any]]]:
    """Parse a JSON Lines file: line number and object of every line."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        raise DatasetError(
            f"{path.parent} has no {path.name}: it has no pick attempts; explain draws those of a bake with mode pick, target or mixed"
        ) from error
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path} is not text: byte {error.start} is not UTF-8") from error
    records = []
    for line, text in enumerate(lines, start=1):
        try:
            record = json.loads(text)
        except ValueError as error:
            raise DatasetError(f"{path}, line {line} is not JSON: {error}") from error
        if not isinstance(record, dict) or not all(type(record.get(key)) is int for key in ("episode", "attempt")):
            raise DatasetError(f"{path}, line {line} is not a record of an attempt: it needs integers episode and attempt")
        records.append((line, record))
    return records


def _which(what: str, numbers: list[int]) -> str:
    """List ascending integers with runs merged: "attempts: 0 to 3, 5"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return f"{what}: {', '.join(f'{low}' if low == high else f'{low} to {high}' for low, high in runs) or 'none'}"


def _attempt(record: dict[str, Any]) -> Attempt:
    """Parse and validate the record of an attempt."""
    observation = record["observation"]
    width, height = map(int, observation["resolution"])
    if min(width, height) < 1:
        raise ValueError(f"resolution is {width} x {height}")
    seen = tuple(_seen(one) for one in observation["instances"] if one["visible"] > 0)
    target = None if record["target"] is None else int(record["target"])
    if target is not None and target not in {one.instance for one in seen}:
        raise ValueError(f"target is {target}, which was not visible")
    if record["mode"] not in MODE_WORDS:
        raise ValueError(f"mode is {json.dumps(record['mode'])}")
    return Attempt(
        episode=record["episode"],
        number=record["attempt"],
        mode=record["mode"],
        frame=int(record["frame"]),
        end_frame=int(record["end_frame"]),
        sentence=str(record["sentence"]),
        target=target,
        tilt=None if record["tilt"] is None else float(record["tilt"]),
        rays=int(record["rays"] or 0),
        hits=int(record["hits"] or 0),
        good_seal=bool(record["good_seal"]),
        engaged=tuple(map(int, record["engaged"])),
        picked=tuple(map(int, record["picked"])),
        peak_force=tuple(map(_finite, record["peak_force"])),
        resolution=(width, height),
        seen=seen,
        votes={(int(lower), int(upper)): _finite(votes) for lower, upper, votes in observation["votes"]},
    )


def _seen(record: dict[str, Any]) -> SeenObject:
    first, second, third = map(_finite, record["distances"])
    return SeenObject(
        instance=int(record["instance"]),
        object_id=int(record["object_id"]),
        visible=int(record["visible"]),
        visible_fraction=float(record["visible_fraction"]),
        candidates=(_pixel(record["pole"]), _pixel(record["centroid"]), _pixel(record["midpoint"])),
        distances=(first, second, third),
        grasp_pixel=_pixel(record["grasp_pixel"]),
        above=frozenset(map(int, record["above"])),
        ancestors=frozenset(map(int, record["ancestors"])),
    )


def _pixel(value: Any) -> Pixel:
    column, row = map(_finite, value)
    return column, row


def _finite(value: Any) -> float:
    """Check that a number is finite."""
    if not math.isfinite(value):
        raise ValueError(f"{value} is not finite")
    return float(value)


def labels(attempt: Attempt) -> dict[int, str]:
    """Short label of every visible instance: its obj_id, with a letter where several share it."""
    by_object: dict[int, list[int]] = {}
    for one in attempt.seen:
        by_object.setdefault(one.object_id, []).append(one.instance)
    return {
        instance: f"{object_id}{chr(ord('a') + place) if len(group) > 1 else ''}"
        for object_id, group in by_object.items()
        for place, instance in enumerate(group)
    }


def full_names(attempt: Attempt, names: Mapping[int, str]) -> dict[int, str]:
    """Label and name of every visible instance."""
    short = labels(attempt)
    return {one.instance: f"{short[one.instance]} {names.get(one.object_id, '')}".rstrip() for one in attempt.seen}


def suction_kind(one: SeenObject) -> int:
    """Index of the candidate that became the suction point: the nearest, as the point is rounded to a pixel."""
    return min(range(len(CANDIDATES)), key=lambda kind: math.dist(one.candidates[kind], one.grasp_pixel))


def choice_words(attempt: Attempt, names: Mapping[int, str], config: Config) -> list[str]:
    """Explain in sentences the chosen target, the reason, and the suction point."""
    if attempt.target is None:
        return ["target: none, nothing is visible"]
    full = full_names(attempt, names)
    one = attempt.objects[attempt.target]
    kind = suction_kind(one)
    share = one.distances[kind] / one.distances[0] if one.distances[0] else 1.0
    where = ("pole of inaccessibility", "centroid", "half-way point")[kind] + (f", {share:.2f} of the pole's distance" if kind else "")
    tilt = "" if attempt.tilt is None else f"; cup tilted by {abs(math.degrees(attempt.tilt)):.0f} degrees"
    return [f"target: {full[attempt.target]}: {_reason(attempt, one, full, config)}", f"suction point: {where}{tilt}"]


def _reason(attempt: Attempt, one: SeenObject, full: Mapping[int, str], config: Config) -> str:
    targeted = attempt.mode == "target"
    count = len(one.ancestors)
    above = f"{count} object{'' if count == 1 else 's'} above"
    first = attempt.ranked()[0]
    if first.visible_fraction != one.visible_fraction or len(first.ancestors) != count:
        if targeted and config.target.random_after_failure:
            return f"{above}; chosen at random after a failed attempt"
        return f"{above}; the rule would name {full[first.instance]}"
    equals = sum(len(other.ancestors) == count for other in attempt.seen)
    if len(attempt.seen) == 1:
        return f"{above}; the only visible object"
    if equals == 1:
        return f"{above}, the {'most' if targeted else 'fewest'} of all"
    return f"{above}; visible fraction {one.visible_fraction:.2f}, the {'smallest' if targeted else 'largest'} of {equals} such"


def seal_words(attempt: Attempt, names: Mapping[int, str], config: Config) -> list[str]:
    """Explain in sentences the rays, the seal, its force and the picked objects; none if nothing was chosen."""
    if attempt.target is None:
        return []
    full = full_names(attempt, names)
    lines = [f"rays: {attempt.hits} of {attempt.rays} hit"]
    if attempt.hits:
        lines[0] += f"; {'good' if attempt.good_seal else 'poor'} seal, breaks at {break_force(attempt, config):g} N"
        peak = f"; largest force {max(attempt.peak_force):.1f} N" if attempt.peak_force else ""
        lines.append(f"engaged: {_listed(attempt.engaged, full)}{peak}")
        lines.append(f"picked: {_listed(attempt.picked, full)}")
    return lines


def break_force(attempt: Attempt, config: Config) -> float:
    """Force at which a seal of the attempt breaks [N]."""
    return config.suction.good_force if attempt.good_seal else config.suction.poor_force


def _listed(instances: tuple[int, ...], full: Mapping[int, str]) -> str:
    """List names of instances; an engaged object can be invisible to camera 0."""
    return ", ".join(full.get(instance, f"instance {instance}, unseen") for instance in instances) or "nothing"
