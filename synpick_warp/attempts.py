"""Follows the worlds tick by tick on the host: which attempts to pick they made, and what became of an episode's objects."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from synpick_warp.codes import Ending, Mode, Outcome, Phase, Task
from synpick_warp.configs.schema import Config
from synpick_warp.stages.stream import TickReport

DIGITS, PLACES = 6, 6
"""Significant digits and decimal places of the numbers in a record; more would be noise of single precision."""
LOAD_PLACES = 4
"""Decimal places of a load: a tenth of a millinewton."""

Vector = tuple[float, ...]


@dataclass(frozen=True)
class InstanceObservation:
    """Perception result of one instance, with the JSON keys as names: share is `Observation.visible_fraction`, middle `midpoint`,
    suction `grasp_pixel`, all_above `ancestors`; see `stages.perception.arrays` for units and meaning. Pixels are column, row."""

    instance: int
    object_id: int
    visible: int
    share: float
    pole: Vector
    centroid: Vector
    middle: Vector
    distances: Vector
    suction: tuple[int, ...]
    depth: float
    above: tuple[int, ...]
    """Instances from which an edge of the clutter graph runs to this one."""
    all_above: tuple[int, ...]
    """Instances from which a path does."""


@dataclass(frozen=True)
class ObservationRecord:
    """Perception result on which an attempt is based."""

    resolution: tuple[int, int]
    """Width and height of the perception image [px]."""
    instances: tuple[InstanceObservation, ...]
    """Those that were in the scene, visible or not."""
    votes: tuple[tuple[int, int, float], ...]
    """(i, j, votes): what the contour of i says for j lying above it; only votes that are not 0."""


@dataclass(frozen=True)
class AttemptRecord:
    """One try to pick. Of a look that found nothing there is no target, nor what follows from one (None)."""

    episode: int
    attempt: int
    """Its number in the episode, from 0."""
    mode: str
    frame: int
    """The frame from which was chosen; its image does not show the gripper."""
    end_frame: int
    """The frame at which the attempt had ended."""
    outcome: Outcome
    target: int | None
    object_id: int | None
    """Of the target."""
    point: Vector | None
    """Grasp point [m]."""
    normal: Vector | None
    """Unit normal there."""
    yaw: float | None
    """Of the finger about the vertical [rad]."""
    tilt: float | None
    """Of the cup about the finger's y axis [rad]."""
    rays: int
    hits: int
    """Rays that hit an object when the suction was switched on."""
    good_seal: bool
    """Whether no more rays missed than settings tolerate, which is never all of them, so that the seals were strong."""
    caught: tuple[int, ...]
    """Instances that the rays hit."""
    picked: tuple[int, ...]
    """Instances that left the scene on the cup."""
    load: Vector
    """Largest load of any seal [N] in each tick of the lift; in the first the suction was switched on at its end, so that is 0."""
    sight: ObservationRecord

    def line(self) -> str:
        """The record as one line of JSON, with its end.

        Raises:
            ValueError: A number is not finite.
        """
        record: dict[str, Any] = {}
        for key, value in asdict(self).items():
            record[key] = value
            if key == "outcome":
                record |= {key: self.outcome.name.lower(), "sentence": self.outcome.sentence}
        return json.dumps(record, allow_nan=False) + "\n"


@dataclass(frozen=True)
class EpisodeRecord:
    """What an episode did with its objects. An episode that delivers nothing has no objects and no attempts."""

    mode: str
    objects: int = 0
    """Instances at the first frame."""
    left: int = 0
    """Instances at the last."""
    attempts: tuple[AttemptRecord, ...] = ()

    @property
    def picked(self) -> int:
        """Instances that left the scene on the cup."""
        return sum(len(attempt.picked) for attempt in self.attempts)

    @property
    def lost(self) -> int:
        """Instances that left it otherwise."""
        return self.objects - self.left - self.picked


@dataclass
class _Running:
    """An arrangement that is being acted on."""

    episode: int
    objects: int
    attempts: list[AttemptRecord] = field(default_factory=list)
    begun: dict[str, Any] | None = None
    """What the running attempt's look says of its record."""
    load: list[float] = field(default_factory=list)


class AttemptLog:
    """Makes records of the reports of all ticks."""

    def __init__(self, config: Config, object_ids: np.ndarray) -> None:
        """Follow worlds from their first tick on.

        Args:
            config: Settings.
            object_ids: obj_id of each catalog entry (entry) int32.
        """
        self.object_ids = object_ids
        self.resolution = config.sight.resolution
        self.rays, self.tolerated_misses = config.suction.rays, config.suction.tolerated_misses
        self._running: dict[int, _Running] = {}

    def see(self, report: TickReport) -> dict[int, EpisodeRecord]:
        """Follow one tick; reports come in the order of ticks.

        Returns:
            By number, every episode that ended in this tick, whether it delivers or will be drawn again.

        Raises:
            ValueError: An attempt ends that is not the one that began last: reports are missing.
        """
        ended = {}
        phase = report.column("phase")
        for world in np.flatnonzero((phase == Phase.ACT) | (phase == Phase.OVER)).tolist():
            running = self._running.get(world)
            if running is None:
                running = self._running[world] = _Running(_number(report, "episode", world), int((report.catalog_index[world] >= 0).sum()))
            self._follow(running, report, world)
            if phase[world] == Phase.OVER:
                ended[running.episode] = self._hand_over(report, world)
            elif _number(report, "task", world) == Task.LOOK:
                running.load = []
                running.begun = self._begin(running.episode, report, world)
        return ended

    def _follow(self, running: _Running, report: TickReport, world: int) -> None:
        """What the tick adds to the running attempt."""
        outcome = Outcome(_number(report, "outcome", world))
        lifted = outcome not in (Outcome.NONE, Outcome.NOTHING_SEEN)
        if lifted or _number(report, "task", world) == Task.LIFT:
            running.load.append(round(float(report.measure("load")[world]), LOAD_PLACES))
        if outcome is not Outcome.NONE:
            self._end(running, report, world, outcome)

    def _hand_over(self, report: TickReport, world: int) -> EpisodeRecord:
        """The world's episode is over: what it did; nothing if it delivers nothing."""
        running, mode = self._running.pop(world), Mode(_number(report, "mode", world)).name.lower()
        if not Ending(_number(report, "ending", world)).delivers:
            return EpisodeRecord(mode)
        return EpisodeRecord(mode, running.objects, int((report.catalog_index[world] >= 0).sum()), tuple(running.attempts))

    def _begin(self, episode: int, report: TickReport, world: int) -> dict[str, Any]:
        """What is known of an attempt when its world has been looked at."""
        target = int(report.plan.target[world])
        record = {
            "episode": episode,
            "attempt": _number(report, "attempt", world) + 1,
            "mode": Mode(_number(report, "mode", world)).name.lower(),
            "frame": _number(report, "frame", world),
            "sight": self._sight(report, world),
        }
        grasp = dict.fromkeys(("target", "object_id", "point", "normal", "yaw", "tilt"))
        if target >= 0:
            vectors = {name: _tidy_vector(getattr(report.plan, name)[world]) for name in ("point", "normal")}
            angles = {name: _tidy(getattr(report.plan, name)[world]) for name in ("yaw", "tilt")}
            grasp = {"target": target, "object_id": self._object_id(report, world, target), **vectors, **angles}
        return record | grasp

    def _end(self, running: _Running, report: TickReport, world: int, outcome: Outcome) -> None:
        begun, number = running.begun, _number(report, "attempt", world)
        if begun is None or begun["attempt"] != number:
            raise ValueError(f"attempt {number} of episode {running.episode} ends, but none that is followed has that number")
        seen = outcome is not Outcome.NOTHING_SEEN
        hits = _number(report, "hits", world) if seen else 0
        running.attempts.append(
            AttemptRecord(
                **begun,
                end_frame=_number(report, "frame", world),
                outcome=outcome,
                rays=self.rays,
                hits=hits,
                good_seal=self.rays - hits <= self.tolerated_misses,
                caught=_instances(_number(report, "caught", world)) if seen else (),
                picked=_instances(_number(report, "held", world)),
                load=tuple(running.load),
            )
        )
        running.begun = None

    def _sight(self, report: TickReport, world: int) -> ObservationRecord:
        present = np.flatnonzero(report.catalog_index[world] >= 0)
        votes = report.observation.votes[world][np.ix_(present, present)]
        lower, upper = np.nonzero(votes)
        pairs = zip(present[lower].tolist(), present[upper].tolist(), _tidy_vector(votes[lower, upper]), strict=True)
        instances = tuple(self._instance(report, world, instance) for instance in present.tolist())
        return ObservationRecord(self.resolution, instances, tuple(pairs))

    def _instance(self, report: TickReport, world: int, instance: int) -> InstanceObservation:
        row = {name: values[world, instance] for name, values in vars(report.observation).items() if name != "overflow"}
        return InstanceObservation(
            instance=instance,
            object_id=self._object_id(report, world, instance),
            visible=int(row["visible"]),
            share=_tidy(row["visible_fraction"]),
            pole=_tidy_vector(row["pole"]),
            centroid=_tidy_vector(row["centroid"]),
            middle=_tidy_vector(row["midpoint"]),
            distances=_tidy_vector(row["distances"]),
            suction=tuple(row["grasp_pixel"].tolist()),
            depth=_tidy(row["depth"]),
            above=_instances(int(row["above"])),
            all_above=_instances(int(row["ancestors"])),
        )

    def _object_id(self, report: TickReport, world: int, instance: int) -> int:
        return int(self.object_ids[report.catalog_index[world, instance]])


def _number(report: TickReport, name: str, world: int) -> int:
    return int(report.column(name)[world])


def _instances(bits: int) -> tuple[int, ...]:
    """Instances whose bits are set in 32 bits, signed or not."""
    return tuple(instance for instance in range(32) if bits >> instance & 1)


def _tidy(value: float) -> float:
    """A number with the digits that are kept; never -0."""
    return round(float(f"{value:.{DIGITS}g}"), PLACES) + 0.0


def _tidy_vector(values: np.ndarray) -> Vector:
    return tuple(map(_tidy, values.tolist()))
