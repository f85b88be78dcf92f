"""Attempt log: builds the records of attempts.jsonl and the counts of each episode from the reports of all ticks, on the host."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from synpick_warp.codes import Ending, Mode, Outcome, Phase, Task
from synpick_warp.configs.schema import Suction
from synpick_warp.dataset.annotations import Attempt, InstanceObservation, RecordedObservation
from synpick_warp.stages.arrays import WORD_BITS, unpack_words
from synpick_warp.stages.stream import TickReport

DIGITS, PLACES = 6, 6
"""Significant digits and decimal places of the numbers in a record; more would be noise of single precision."""
FORCE_PLACES = 4
"""Decimal places of a seal force [N]."""

_OBSERVED = [name for name in InstanceObservation.__struct_fields__ if name not in ("instance", "object_id")]
"""Arrays of `stages.perception.arrays.Observation` that an `InstanceObservation` has a row of."""


@dataclass(frozen=True)
class EpisodeRecord:
    """Attempts and object counts (first and last frame) of an episode; empty if it was not baked. Distractors count as no objects."""

    mode: str
    objects: int = 0
    left: int = 0
    attempts: tuple[Attempt, ...] = ()
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
    attempts: list[Attempt] = field(default_factory=list)
    planned: dict[str, Any] | None = None
    """Fields of the running attempt that are known from perception; None: no attempt runs."""
    forces: list[float] = field(default_factory=list)
    """Peak seal force of each tick of the running lift [N]."""


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
        """Start with no episode running: `resolution` is width and height of the perception image [px], `object_ids` has the obj_id of each
        body of the catalog (body) int32, `distractors` the name of each distractor by its obj_id, and `cups` the number of cups."""
        self.object_ids = np.append(object_ids, -1)
        self.distractors = distractors or {}
        self.resolution = resolution
        self.rays, self.cups = cups * (suction.rays + suction.mouth_rays), cups
        self.is_measured = suction.vacuum is not None
        self._running: dict[int, _Running] = {}

    def update(self, report: TickReport) -> dict[int, EpisodeRecord]:
        """Process the report of one tick; reports must come in the order of ticks. Returns the records of all episodes that ended in this
        tick by episode index, with or without delivery; raises ValueError if an ended attempt did not begin last: reports are missing."""
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
            grasp = {name: _rounded(getattr(report.plan, name)[world].tolist()) for name in ("point", "normal", "yaw", "tilt")}
            grasp |= {"target": target, "object_id": int(self._ids(report, world)[target])}
        return record | grasp

    def _end_attempt(self, running: _Running, report: TickReport, world: int, outcome: Outcome) -> None:
        """Complete the running attempt of a world with its outcome and seal forces; raises ValueError if it has no begin."""
        planned, attempt = running.planned, _status(report, "attempt", world)
        if planned is None or planned["attempt"] != attempt:
            raise ValueError(f"attempt {attempt} of episode {running.episode} ends, but its begin is not in the log")
        seen = outcome is not Outcome.NOTHING_SEEN
        hits, bits = (_status(report, name, world) if seen else 0 for name in ("hits", "sealed"))
        sealed = [cup for cup in range(self.cups) if bits >> cup & 1]
        running.attempts.append(
            Attempt(
                **planned,
                end_frame=_status(report, "frame", world),
                outcome=outcome.name.lower(),
                sentence=outcome.sentence,
                rays=self.rays,
                hits=hits,
                good_seal=len(sealed) == self.cups,
                engaged=_instances(report.engaged[world], running.distractors) if seen else [],
                picked=_instances(report.attached[world], running.distractors),
                peak_force=list(running.forces),
                sealed=sealed if self.cups > 1 else None,
                break_force=_rounded(report.measure("break_force")[world].item()) if hits and self.is_measured else None,
            )
        )
        running.planned = None

    def _observation(self, report: TickReport, world: int) -> RecordedObservation:
        """Record of what perception saw in a world: its present instances, and who lies above whom with votes."""
        present = self._labelled(report, world)
        votes = report.observation.votes[world][np.ix_(present, present)]
        lower, upper = np.nonzero(votes)
        pairs = zip(present[lower].tolist(), present[upper].tolist(), _rounded(votes[lower, upper].tolist()), strict=True)
        columns = {name: getattr(report.observation, name)[world, present] for name in _OBSERVED}
        columns |= {"instance": present, "object_id": self._ids(report, world)[present]}
        lists = {name: values.tolist() for name, values in columns.items()}
        lists |= {name: [_instances(words) for words in columns[name]] for name in ("above", "ancestors")}
        rows = [dict(zip(lists, map(_rounded, row), strict=True)) for row in zip(*lists.values(), strict=True)]
        return RecordedObservation(self.resolution, [InstanceObservation(**row) for row in rows], list(pairs))

    def _ids(self, report: TickReport, world: int) -> np.ndarray:
        """obj_id of each instance of a world; -1: none (instance) int32."""
        return self.object_ids[report.catalog_index[world]]

    def _labelled(self, report: TickReport, world: int) -> np.ndarray:
        """Instances of a world that are objects with labels (object) int."""
        return np.flatnonzero(self._ids(report, world) >= 0)


def _status(report: TickReport, name: str, world: int) -> int:
    """Value of a named column of a world's status row."""
    return int(report.column(name)[world])


def _instances(words: np.ndarray, but: Collection[int] = ()) -> list[int]:
    """Members of a bit set of instances (word) uint32, but for those in `but`."""
    members = np.flatnonzero(unpack_words(words, WORD_BITS * len(words))).tolist()
    return [instance for instance in members if instance not in but]


def _rounded(value: Any) -> Any:
    """Round a float, or those of a list, to DIGITS significant digits and PLACES decimal places; never -0. Integers stay."""
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return round(float(f"{value:.{DIGITS}g}"), PLACES) + 0.0 if isinstance(value, float) else value
