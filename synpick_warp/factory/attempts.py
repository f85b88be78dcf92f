"""Attempt log: builds the records of attempts.jsonl and the counts of each episode from the reports of all ticks, on the host.

Fields of the record dataclasses are the JSON keys.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

import numpy as np

from synpick_warp.codes import Ending, Mode, Outcome, Phase, Task
from synpick_warp.configs.schema import Suction
from synpick_warp.stages.arrays import WORD_BITS, unpack_words
from synpick_warp.stages.stream import TickReport
from synpick_warp.views.bins import name_bin

DIGITS, PLACES = 6, 6
"""Significant digits and decimal places of the numbers in a record; more would be noise of single precision."""
FORCE_PLACES = 4
"""Decimal places of a seal force [N]."""

Vector = tuple[float, ...]


@dataclass(frozen=True)
class ObservedInstance:
    """Perception result of one instance, with the JSON keys as names; see `stages.perception.arrays` for units and meaning. Pixels are
    (column, row)."""

    instance: int
    object_id: int
    visible: int
    visible_fraction: float
    pole: Vector
    centroid: Vector
    midpoint: Vector
    distances: Vector
    grasp_pixel: tuple[int, ...]
    depth: float
    above: tuple[int, ...]
    """Instances from which an edge of the clutter graph runs to this one."""
    ancestors: tuple[int, ...]
    """Instances from which a path runs to this one."""


@dataclass(frozen=True)
class ObservationRecord:
    """Perception result on which an attempt is based: image size, instances, and votes (i, j, votes): evidence that j lies above i."""

    resolution: tuple[int, int]
    """Width and height of the perception image [px]."""
    instances: tuple[ObservedInstance, ...]
    """Instances in the scene, visible or not."""
    votes: tuple[tuple[int, int, float], ...]
    """(i, j, votes): occlusion votes of the contour of i for j lying above it; only nonzero ones."""


@dataclass(frozen=True)
class AttemptRecord:
    """Attempt to pick: its frames, outcome, target and grasp in the world (None: no object was visible), rays that hit, engaged and picked
    instances, seal force by tick of the lift [N], and what perception saw.
    """

    episode: int
    attempt: int
    """Index in the episode."""
    mode: str
    frame: int
    """Frame on which perception ran; its image does not show the gripper."""
    end_frame: int
    """Frame in which the attempt had ended."""
    outcome: Outcome
    target: int | None
    object_id: int | None
    """obj_id of the target."""
    point: Vector | None
    """Grasp point [m]."""
    normal: Vector | None
    """Unit surface normal at the grasp point."""
    yaw: float | None
    """Yaw of the gripper shaft about the vertical [rad]."""
    tilt: float | None
    """Tilt of the cup about the wrist axis, the shaft's y axis [rad]."""
    rays: int
    hits: int
    """Rays that hit an object when suction was switched on."""
    good_seal: bool
    """True if at most `suction.tolerated_misses` rays of each cup missed, so that seals had the break force of a good seal; with
    `suction.vacuum`, if leaks left at least half of it below each cup."""
    engaged: tuple[int, ...]
    """Engaged instances: those that rays hit."""
    picked: tuple[int, ...]
    """Instances that left the scene on the cup."""
    peak_force: Vector
    """Peak seal force [N] in each tick of the lift, that of a seal that broke included; 0 in the first, which ends as suction begins."""
    observation: ObservationRecord
    sealed: tuple[int, ...] | None = None
    """Cups with a good seal; None, and not in the file, for a gripper of one cup."""
    break_force: float | None = None
    """Least break force of the cups that had something below them [N]; None, and not in the file, without `suction.vacuum` or hits."""

    def line(self, bin: Mapping[str, Any] | None = None) -> str:
        """Serialize the record as one line of JSON with line break; `bin`: record of the episode's bin, if it is not a tote in its place.

        Raises:
            ValueError: A number is not finite.
        """
        record: dict[str, Any] = {}
        for item in fields(self):
            if item.default is MISSING or getattr(self, item.name) is not None:
                record[item.name] = getattr(self, item.name)
            if item.name == "outcome":
                record |= {item.name: self.outcome.name.lower(), "sentence": name_bin(self.outcome.sentence, bin)}
        # `dataclasses.asdict` would copy every number, which is slower than the serialization itself.
        return json.dumps(record, allow_nan=False, default=vars) + "\n"


@dataclass(frozen=True)
class EpisodeRecord:
    """Attempts and object counts (first and last frame) of an episode; empty if it is not part of the data set. Distractors count as no
    objects.
    """

    mode: str
    objects: int = 0
    """Instances at the first frame."""
    left: int = 0
    """Instances at the last frame."""
    attempts: tuple[AttemptRecord, ...] = ()
    distractors: tuple[tuple[int, str], ...] = ()
    """Instance and name of each distractor at the first frame."""

    @property
    def picked(self) -> int:
        """Instances that left the scene on the cup."""
        return sum(len(attempt.picked) for attempt in self.attempts)

    @property
    def lost(self) -> int:
        """Instances that left the scene in another way than on the cup."""
        return self.objects - self.left - self.picked


@dataclass
class _Running:
    """Episode in phase ACT: its attempts so far, and the running one as far as it is known."""

    episode: int
    objects: int
    """Instances that are no distractors, at the first frame."""
    distractors: dict[int, str]
    """Name of each other instance."""
    attempts: list[AttemptRecord] = field(default_factory=list)
    planned: dict[str, Any] | None = None
    """Fields of the running attempt that are known from perception; None: no attempt runs."""
    forces: list[float] = field(default_factory=list)
    """Peak seal force of each tick of the running lift [N]."""


_OBSERVED = tuple(item.name for item in fields(ObservedInstance) if item.name not in ("instance", "object_id"))
"""Arrays of `Observation` that an `ObservedInstance` holds a row of."""


class AttemptLog:
    """State machine that turns the reports of all ticks into episode records."""

    def __init__(
        self,
        suction: Suction,
        resolution: tuple[int, int],
        object_ids: np.ndarray,
        distractors: Mapping[int, str] | None = None,
        cups: int = 1,
    ) -> None:
        """Start with no episode running.

        Args:
            resolution: Width and height of the perception image [px].
            object_ids: obj_id of each body of the catalog (body) int32.
            distractors: Name of each distractor, by its obj_id; None: there is none.
            cups: Number of the gripper's cups.
        """
        self.object_ids = np.append(object_ids, -1)
        self.distractors = distractors or {}
        self.resolution = resolution
        self.rays, self.cups = cups * (suction.rays + suction.mouth_rays), cups
        self.is_measured = suction.vacuum is not None
        self._running: dict[int, _Running] = {}

    def update(self, report: TickReport) -> dict[int, EpisodeRecord]:
        """Process the report of one tick; reports must come in the order of ticks.

        Returns:
            Records of all episodes that ended in this tick by episode index, with or without delivery.

        Raises:
            ValueError: An attempt ends that is not the one that began last: reports are missing.
        """
        ended = {}
        phase = report.column("phase")
        for world in self._eventful_worlds(report).tolist():
            running = self._running.get(world)
            if running is None:
                names = ((index, self.distractors.get(obj_id)) for index, obj_id in enumerate(self._ids(report, world).tolist()))
                distractors = {index: name for index, name in names if name is not None}
                objects = len(self._labelled(report, world))
                running = self._running[world] = _Running(_status(report, "episode", world), objects, distractors)
            self._update_attempt(running, report, world)
            if phase[world] == Phase.OVER:
                ended[running.episode] = self._finish_episode(report, world)
            elif _status(report, "task", world) == Task.LOOK:
                running.forces = []
                running.planned = self._begin_attempt(running.episode, report, world)
        return ended

    def _eventful_worlds(self, report: TickReport) -> np.ndarray:
        """Indices of the worlds with an event in a tick: an episode or attempt begins or ends, or the gripper is lifting (world) int."""
        phase, task = report.column("phase"), report.column("task")
        running = np.zeros(len(phase), bool)
        running[list(self._running)] = True
        changes = ~running | (task == Task.LOOK) | (task == Task.LIFT) | (report.column("outcome") != Outcome.NONE)
        return np.flatnonzero((phase == Phase.OVER) | ((phase == Phase.ACT) & changes))

    def _update_attempt(self, running: _Running, report: TickReport, world: int) -> None:
        """Record the peak force of a lift, and the end of an attempt."""
        outcome = Outcome(_status(report, "outcome", world))
        lifted = outcome not in (Outcome.NONE, Outcome.NOTHING_SEEN)
        if lifted or _status(report, "task", world) == Task.LIFT:
            running.forces.append(round(float(report.measure("peak_force")[world]), FORCE_PLACES))
        if outcome is not Outcome.NONE:
            self._end_attempt(running, report, world, outcome)

    def _finish_episode(self, report: TickReport, world: int) -> EpisodeRecord:
        """Return the record of the episode that ended in a world; empty without delivery."""
        running, mode = self._running.pop(world), Mode(_status(report, "mode", world)).name.lower()
        if not Ending(_status(report, "ending", world)).delivers:
            return EpisodeRecord(mode)
        left = len(self._labelled(report, world))
        return EpisodeRecord(mode, running.objects, left, tuple(running.attempts), tuple(running.distractors.items()))

    def _begin_attempt(self, episode: int, report: TickReport, world: int) -> dict[str, Any]:
        """Return the fields of an attempt that are known after perception."""
        target = int(report.plan.target[world])
        record = {
            "episode": episode,
            "attempt": _status(report, "attempt", world) + 1,
            "mode": Mode(_status(report, "mode", world)).name.lower(),
            "frame": _status(report, "frame", world),
            "observation": self._observation(report, world),
        }
        grasp = dict.fromkeys(("target", "object_id", "point", "normal", "yaw", "tilt"))
        if target >= 0:
            vectors = {name: _round_vector(getattr(report.plan, name)[world].tolist()) for name in ("point", "normal")}
            angles = {name: _round(getattr(report.plan, name)[world]) for name in ("yaw", "tilt")}
            grasp = {"target": target, "object_id": self._object_id(report, world, target), **vectors, **angles}
        return record | grasp

    def _end_attempt(self, running: _Running, report: TickReport, world: int, outcome: Outcome) -> None:
        """Complete the running attempt of a world with its outcome and seal forces; raises ValueError if it has no begin."""
        planned, attempt = running.planned, _status(report, "attempt", world)
        if planned is None or planned["attempt"] != attempt:
            raise ValueError(f"attempt {attempt} of episode {running.episode} ends, but its begin is not in the log")
        seen = outcome is not Outcome.NOTHING_SEEN
        hits, bits = (_status(report, name, world) if seen else 0 for name in ("hits", "sealed"))
        sealed = tuple(cup for cup in range(self.cups) if bits >> cup & 1)
        running.attempts.append(
            AttemptRecord(
                **planned,
                end_frame=_status(report, "frame", world),
                outcome=outcome,
                rays=self.rays,
                hits=hits,
                good_seal=len(sealed) == self.cups,
                engaged=_instances(report.engaged[world], running.distractors) if seen else (),
                picked=_instances(report.attached[world], running.distractors),
                peak_force=tuple(running.forces),
                sealed=sealed if self.cups > 1 else None,
                break_force=_round(report.measure("break_force")[world]) if hits and self.is_measured else None,
            )
        )
        running.planned = None

    def _observation(self, report: TickReport, world: int) -> ObservationRecord:
        """Record of what perception saw in a world: its present instances, and who lies above whom with votes."""
        present = self._labelled(report, world)
        votes = report.observation.votes[world][np.ix_(present, present)]
        lower, upper = np.nonzero(votes)
        pairs = zip(present[lower].tolist(), present[upper].tolist(), _round_vector(votes[lower, upper].tolist()), strict=True)
        columns = {name: getattr(report.observation, name)[world, present] for name in _OBSERVED}
        columns |= {"instance": present, "object_id": self.object_ids[report.catalog_index[world, present]]}
        sets = {name: [_instances(words) for words in columns.pop(name)] for name in ("above", "ancestors")}
        columns = {name: values.tolist() for name, values in columns.items()} | sets
        rows = zip(*columns.values(), strict=True)
        instances = tuple(_instance(dict(zip(columns, row, strict=True))) for row in rows)
        return ObservationRecord(self.resolution, instances, tuple(pairs))

    def _ids(self, report: TickReport, world: int) -> np.ndarray:
        """obj_id of each instance of a world; -1: none (instance) int32."""
        return self.object_ids[report.catalog_index[world]]

    def _labelled(self, report: TickReport, world: int) -> np.ndarray:
        """Instances of a world that are objects with labels (object) int."""
        return np.flatnonzero(self._ids(report, world) >= 0)

    def _object_id(self, report: TickReport, world: int, instance: int) -> int:
        """obj_id of an instance in a world."""
        return int(self.object_ids[report.catalog_index[world, instance]])


def _instance(row: Mapping[str, Any]) -> ObservedInstance:
    """Record of an instance from its values, as Python numbers and lists, by the names of `ObservedInstance`."""
    return ObservedInstance(
        instance=row["instance"],
        object_id=row["object_id"],
        visible=row["visible"],
        visible_fraction=_round(row["visible_fraction"]),
        pole=_round_vector(row["pole"]),
        centroid=_round_vector(row["centroid"]),
        midpoint=_round_vector(row["midpoint"]),
        distances=_round_vector(row["distances"]),
        grasp_pixel=tuple(row["grasp_pixel"]),
        depth=_round(row["depth"]),
        above=row["above"],
        ancestors=row["ancestors"],
    )


def _status(report: TickReport, name: str, world: int) -> int:
    """Value of a named column of a world's status row."""
    return int(report.column(name)[world])


def _instances(words: np.ndarray, but: Collection[int] = ()) -> tuple[int, ...]:
    """Members of a bit set of instances (word) uint32, but for those in `but`."""
    members = np.flatnonzero(unpack_words(words, WORD_BITS * len(words))).tolist()
    return tuple(instance for instance in members if instance not in but)


def _round(value: float) -> float:
    """Round to DIGITS significant digits and PLACES decimal places; never -0."""
    return round(float(f"{value:.{DIGITS}g}"), PLACES) + 0.0


def _round_vector(values: Sequence[float]) -> Vector:
    """Tuple of rounded numbers."""
    return tuple(map(_round, values))
