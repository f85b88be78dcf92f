"""Statistics of picking sequences: accumulated tick by tick, and summarized as the rows of tools/reports/pick.py."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from synpick_warp.codes import Ending, Mode, Outcome, Phase, Task
from synpick_warp.configs.schema import Config
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.stream import TickReport
from tools.reports.rest import is_inside, transform_points

MODES = {"pick": Mode.PICK, "target": Mode.TARGET}
TASKS = {int(task): task.name.lower() for task in Task if task is not Task.NONE}
PAPER = {
    "frames a sequence": {"pick": 573.0, "target": 687.0},
    "visibility, mean": {"pick": 0.77, "target": 0.77},
    "instances a view": {"pick": 7.8, "target": 7.8},
}
"""The paper's values (training sequences), by row and mode; instances a view are its mean over all modes."""
FRAMES_TOLERANCE, VISIBILITY_TOLERANCE = 0.2, 0.05
"""Allowed deviation from the paper's value: relative, and absolute."""
MAX_SPEED = 5.0
"""Bound of the speed of any object [m/s]."""
PLACES = ("in the tote", "outside", "on the cup")
"""Locations of objects, for which speeds are reported separately."""


@dataclass
class Sequence:
    """Statistics of one episode, running or ended."""

    mode: str
    episode: int
    ending: str = ""
    frames: int = 0
    objects: int = 0
    """Objects in the first frame."""
    left: int = 0
    """Objects in the last frame."""
    picked: int = 0
    """Objects removed by a successful attempt while attached to the cup."""
    lost: int = 0
    """Objects removed otherwise."""
    outcomes: Counter[str] = field(default_factory=Counter)
    """Attempts, by outcome."""
    tasks: Counter[str] = field(default_factory=Counter)
    """Frames, by task at their end."""
    visible_fraction: float = 0.0
    """Sum of visible fractions (visible pixels / amodal pixels) over instances and views."""
    instances: int = 0
    """Instances summed over views: those whose silhouette has a pixel."""
    views: int = 0
    """Rendered views."""
    hits: list[int] = field(default_factory=list)
    """Suction rays that hit, for each attempt that engaged an object."""
    peak_forces: list[float] = field(default_factory=list)
    """Largest seal force of each of these attempts [N]."""
    peak_force: float = 0.0
    """Largest seal force of the running attempt so far [N]."""
    speed: list[float] = field(default_factory=lambda: [0.0] * len(PLACES))
    """Largest speed of an object in each of `PLACES`, by displacement over a tick [m/s]."""
    not_finite: int = 0
    """Poses that are not finite."""

    @property
    def attempts(self) -> int:
        """Count of ended attempts."""
        return self.outcomes.total()

    @property
    def successes(self) -> int:
        """Count of successful attempts."""
        return sum(count for name, count in self.outcomes.items() if Outcome[name].succeeded)


@dataclass(frozen=True)
class ModeRow:
    """Row of the report: a value for each mode, and their bound if there is one."""

    name: str
    unit: str
    values: dict[str, float]
    bound: str = ""
    holds: dict[str, bool] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Fields for JSON, with the paper's values; None for NaN and infinity, which JSON does not have."""
        values = {mode: value if np.isfinite(value) else None for mode, value in self.values.items()}
        return asdict(self) | {"values": values, "paper": PAPER.get(self.name, {})}


class Tally:
    """Accumulator of the statistics of all worlds' sequences.

    The selected sequences of a mode are those with the lowest episode indices: the first ones to end would be biased to short ones.
    """

    def __init__(self, config: Config, catalog: Catalog, modes: tuple[str, ...], count: int) -> None:
        """Select `count` sequences of each of `modes`."""
        self.config, self.modes, self.count = config, modes, count
        self.center = np.array([entry.center_of_mass for entry in catalog.entries])
        self.tick = config.physics.step * config.physics.steps_per_tick
        self.running: dict[int, Sequence] = {}
        self.episodes: dict[str, set[int]] = {mode: set() for mode in modes}
        self.ended: dict[int, Sequence | None] = {}
        """Episode -> its statistics; None: given up."""
        self.resampled: Counter[str] = Counter()
        """Arrangements that failed, by ending."""
        self._before: TickReport | None = None

    def add_tick(self, report: TickReport, visibility: dict[int, tuple[float, int, int]]) -> None:
        """Add one tick to the statistics.

        Args:
            report: Report of the tick.
            visibility: World -> (sum of visible fractions, instances, views), for live worlds that were rendered.
        """
        speeds = self._max_speeds(report)
        status = {name: report.column(name).tolist() for name in ("phase", "mode", "episode", "arrangement", "live", "task", "ending")}
        names = {code: name for name, code in MODES.items()}
        for world, phase in enumerate(status["phase"]):
            mode, episode = names.get(status["mode"][world]), status["episode"][world]
            if mode not in self.modes or episode < 0 or phase not in (Phase.SETTLE, Phase.ACT, Phase.OVER):
                continue
            self.episodes[mode].add(episode)
            if status["live"][world]:
                sequence = self.running.setdefault(world, Sequence(mode, episode))
                self._count_frame(sequence, report, world)
                sequence.tasks[TASKS.get(status["task"][world], "no task")] += 1
                sequence.speed = np.maximum(sequence.speed, speeds[world]).tolist()
                fraction, instances, views = visibility.get(world, (0.0, 0, 0))
                sequence.visible_fraction += fraction
                sequence.instances += instances
                sequence.views += views
            if phase == Phase.OVER:
                self._end_sequence(world, episode, Ending(status["ending"][world]), status["arrangement"][world])
        self._before = report

    def _count_frame(self, sequence: Sequence, report: TickReport, world: int) -> None:
        """Add a frame of a world: objects present and removed, seal forces, and the outcome of an attempt that ended."""
        present = report.catalog_index[world] >= 0
        attached = _bits(int(report.column("attached")[world]), len(present))
        outcome = Outcome(int(report.column("outcome")[world]))
        if sequence.frames == 0:
            sequence.objects = int(present.sum())
        elif self._before is not None:
            removed = (self._before.catalog_index[world] >= 0) & ~present
            picked = int((removed & attached).sum()) if outcome.succeeded else 0
            sequence.picked += picked
            sequence.lost += int(removed.sum()) - picked
        sequence.frames += 1
        sequence.left = int(present.sum())
        sequence.not_finite += int((~np.isfinite(report.pose[world][present]).all(axis=1)).sum())
        sequence.peak_force = max(sequence.peak_force, float(report.measure("peak_force")[world]))
        if outcome is not Outcome.NONE:
            sequence.outcomes[outcome.name] += 1
            if report.column("engaged")[world] != 0:
                sequence.hits.append(int(report.column("hits")[world]))
                sequence.peak_forces.append(sequence.peak_force)
            sequence.peak_force = 0.0

    def _end_sequence(self, world: int, episode: int, ending: Ending, arrangement: int) -> None:
        """Store the sequence of a world whose episode ended, or count its failed arrangement (index `arrangement`)."""
        sequence = self.running.pop(world, None)
        if ending.delivers and sequence is not None:
            sequence.ending = ending.name.lower()
            self.ended[episode] = sequence
            return
        self.resampled[ending.name.lower()] += 1
        if arrangement + 1 >= self.config.settle.tries:
            self.ended[episode] = None

    def _max_speeds(self, report: TickReport) -> np.ndarray:
        """Largest speed of each world's objects in each of `PLACES` (world, place) [m/s], by displacement since the frame before."""
        max_speed = np.zeros((len(report.status), len(PLACES)))
        if (before := self._before) is None:
            return max_speed
        unchanged = [report.column(name) == before.column(name) for name in ("episode", "arrangement")]
        both = (report.column("live") != 0) & (before.column("live") != 0) & unchanged[0] & unchanged[1]
        world, instance = np.nonzero(both[:, None] & (report.catalog_index >= 0) & (before.catalog_index >= 0))
        center = self.center[report.catalog_index[world, instance]]
        position, _ = transform_points(report.pose[world, instance], center)
        last, _ = transform_points(before.pose[world, instance], center)
        attached = (report.column("attached")[world] | before.column("attached")[world]) >> instance & 1
        place = np.where(attached, 2, np.where(is_inside(self.config, last), 0, 1))
        # fmax ignores NaN; poses that are not finite are counted by `_count_frame`.
        np.fmax.at(max_speed, (world, place), np.linalg.norm(position - last, axis=1) / self.tick)
        return max_speed

    def selected(self, mode: str) -> list[int]:
        """Episode indices of the mode's selected sequences that have begun."""
        return sorted(self.episodes[mode])[: self.count]

    def sequences(self, mode: str) -> list[Sequence]:
        """Selected sequences of the mode that have ended."""
        return [sequence for episode in self.selected(mode) if (sequence := self.ended.get(episode)) is not None]

    def complete(self) -> bool:
        """Whether all selected sequences have ended."""
        return all(len(episodes := self.selected(mode)) == self.count and all(i in self.ended for i in episodes) for mode in self.modes)


def _bits(bits: int, count: int) -> np.ndarray:
    """The lowest `count` bits as booleans."""
    return np.array([bits >> i & 1 for i in range(count)], dtype=bool)


def sum_visibility(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum of visible fractions (BOP's visib_fract) and count of instances of each view (view), over those with px_count_all > 0.

    Args:
        pixels: Pixel counts px_count_all, px_count_valid, px_count_visib (view, instance, 3).
    """
    amodal, visible = pixels[..., 0], pixels[..., 2]
    return (visible / np.maximum(amodal, 1)).sum(axis=1), (amodal > 0).sum(axis=1)


def report(tally: Tally) -> list[ModeRow]:
    """Rows of the report."""
    sequences = {mode: tally.sequences(mode) for mode in tally.modes}
    rows = [
        ModeRow("sequences", "", {mode: len(ended) for mode, ended in sequences.items()}),
        ModeRow("unfinished", "", {mode: sum(i not in tally.ended for i in tally.selected(mode)) for mode in tally.modes}),
        ModeRow("given up", "", {mode: sum(tally.ended.get(i, 0) is None for i in tally.selected(mode)) for mode in tally.modes}),
    ]
    columns = {mode: dict(_statistics(ended)) for mode, ended in sequences.items()}
    names = list(dict.fromkeys(key for column in columns.values() for key in column))
    for name, unit in names:
        values = {mode: float(columns[mode].get((name, unit), 0.0)) for mode in tally.modes}
        rows.append(_add_bound(ModeRow(name, unit, values)))
    return rows


def _add_bound(row: ModeRow) -> ModeRow:
    """Add the bound to a row that has one."""
    paper = PAPER.get(row.name, {})
    values = row.values.items()  # NaN violates every bound.
    if row.name == "frames a sequence":
        within = {mode: abs(value / paper[mode] - 1.0) <= FRAMES_TOLERANCE for mode, value in values}
        return ModeRow(row.name, row.unit, row.values, f"±{100 * FRAMES_TOLERANCE:.0f} %", within)
    if row.name == "visibility, mean":
        return ModeRow(
            row.name, row.unit, row.values, f"±{VISIBILITY_TOLERANCE}", {m: abs(v - paper[m]) <= VISIBILITY_TOLERANCE for m, v in values}
        )
    if row.name.startswith("largest speed"):
        return ModeRow(row.name, row.unit, row.values, f"< {MAX_SPEED:g}", {mode: value < MAX_SPEED for mode, value in values})
    if row.name == "poses that are not finite":
        return ModeRow(row.name, row.unit, row.values, "= 0", {mode: value == 0 for mode, value in values})
    return row


def _statistics(sequences: list[Sequence]) -> Iterator[tuple[tuple[str, str], float]]:
    """((name, unit), value) of each row of one mode."""
    frames = np.array([sequence.frames for sequence in sequences])
    yield from _distribution("frames a sequence", frames)
    views, instances = (sum(getattr(sequence, name) for sequence in sequences) for name in ("views", "instances"))
    if views:
        fractions = np.array([sequence.visible_fraction / max(sequence.instances, 1) for sequence in sequences])
        yield ("visibility, mean", ""), sum(sequence.visible_fraction for sequence in sequences) / max(instances, 1)
        yield ("visibility, standard error over sequences", ""), _standard_error(fractions)
        yield ("instances a view", ""), instances / views
    attempts = sum(sequence.attempts for sequence in sequences)
    successes = sum(sequence.successes for sequence in sequences)
    yield ("attempts a sequence", ""), _mean([sequence.attempts for sequence in sequences])
    yield ("successful attempts", "%"), _percentage(successes, attempts)
    for outcome in list(Outcome)[1:]:
        yield (f"  {outcome.sentence}", "%"), _percentage(sum(sequence.outcomes[outcome.name] for sequence in sequences), attempts)
    for name, text in (("objects", "objects at the start"), ("picked", "picked"), ("lost", "lost"), ("left", "left at the end")):
        yield (text, ""), _mean([getattr(sequence, name) for sequence in sequences])
    yield ("objects a successful attempt", ""), sum(sequence.picked for sequence in sequences) / max(successes, 1)
    for ending in Ending:
        if ending.delivers:
            count = sum(sequence.ending == ending.name.lower() for sequence in sequences)
            yield (f"sequences by ending: {ending.name.lower()}", "%"), _percentage(count, len(sequences))
    for task in (*TASKS.values(), "no task"):
        yield (f"frames a sequence: {task}", ""), _mean([sequence.tasks[task] for sequence in sequences])
    hits = [hit for sequence in sequences for hit in sequence.hits]
    yield ("rays that hit, in attempts that engaged an object", ""), _mean(hits)
    forces = np.array([force for sequence in sequences for force in sequence.peak_forces])
    for level, name in ((50, "median"), (90, "90 %"), (100, "max")):
        yield (f"peak seal force of an attempt, {name}", "N"), float(np.percentile(forces, level)) if len(forces) else np.nan
    for index, place in enumerate(PLACES):
        yield (f"largest speed {place}", "m/s"), max((sequence.speed[index] for sequence in sequences), default=np.nan)
    yield ("poses that are not finite", ""), sum(sequence.not_finite for sequence in sequences)


def _distribution(name: str, values: np.ndarray) -> Iterator[tuple[tuple[str, str], float]]:
    """Rows of mean, standard error, minimum, median and maximum."""
    yield (name, ""), _mean(values)
    yield (f"{name}, standard error", ""), _standard_error(values)
    for level, word in ((0, "min"), (50, "median"), (100, "max")):
        yield (f"{name}, {word}", ""), float(np.percentile(values, level)) if len(values) else np.nan


def _mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def _standard_error(values: np.ndarray) -> float:
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else np.nan


def _percentage(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else np.nan
