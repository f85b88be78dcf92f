"""What tools/reports/pick.py counts: sequences of picking, tick by tick, and the table made of them beside the paper's."""

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
from tools.reports.rest import is_inside, place_of

MODES = {"pick": Mode.PICK, "target": Mode.TARGET}
TASKS = {int(task): task.name.lower() for task in Task if task is not Task.NONE}
PAPER = {
    "frames a sequence": {"pick": 573.0, "target": 687.0},
    "visibility, mean": {"pick": 0.77, "target": 0.77},
    "instances a view": {"pick": 7.8, "target": 7.8},
}
"""Training sequences; instances a view are the mean over all modes."""
FRAMES_WITHIN, VISIBILITY_WITHIN = 0.2, 0.05
"""How far from the paper's, as a share, and as a difference."""
MOST_SPEED = 5.0
"""Of any object [m/s]."""
PLACES = ("in the tote", "outside", "on the cup")


@dataclass
class Sequence:
    """One episode so far, or as a whole."""

    mode: str
    episode: int
    ending: str = ""
    frames: int = 0
    objects: int = 0
    """At the first frame."""
    left: int = 0
    """At the last."""
    picked: int = 0
    lost: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    """Attempts, by outcome."""
    tasks: Counter[str] = field(default_factory=Counter)
    """Frames, by task at their end."""
    visible_share: float = 0.0
    """Sum over instances and views of visible by all pixels of the silhouette."""
    instances: int = 0
    """How many of these there are: instances whose silhouette has a pixel."""
    views: int = 0
    hits: list[int] = field(default_factory=list)
    """Rays that hit, of attempts that had caught something."""
    loads: list[float] = field(default_factory=list)
    """Largest load of a seal in each of these [N]."""
    load: float = 0.0
    """Largest load in the running attempt [N]."""
    speed: list[float] = field(default_factory=lambda: [0.0] * len(PLACES))
    """Largest speed of an object in each of PLACES, by displacement over a tick [m/s]."""
    not_finite: int = 0
    """Poses that are no numbers."""

    @property
    def attempts(self) -> int:
        return self.outcomes.total()

    @property
    def successes(self) -> int:
        return sum(count for name, count in self.outcomes.items() if Outcome[name].succeeded)


@dataclass(frozen=True)
class ModeRow:
    """A line of the report: a number for each mode; with a bound if these must keep one."""

    name: str
    unit: str
    values: dict[str, float]
    bound: str = ""
    holds: dict[str, bool] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """For JSON, which knows no NaN."""
        values = {mode: value if np.isfinite(value) else None for mode, value in self.values.items()}
        return asdict(self) | {"values": values, "paper": PAPER.get(self.name, {})}


class Tally:
    """Follows all worlds, and keeps the first sequences of each mode.

    Which sequences count is settled when they begin: the first by number. Taking the first to end would favour short ones.
    """

    def __init__(self, config: Config, catalog: Catalog, modes: tuple[str, ...], wanted: int) -> None:
        """`wanted` sequences of each of `modes`."""
        self.config, self.modes, self.wanted = config, modes, wanted
        self.center = np.array([entry.center_of_mass for entry in catalog.entries])
        self.tick = config.physics.step * config.physics.steps_per_tick
        self.running: dict[int, Sequence] = {}
        self.numbers: dict[str, set[int]] = {mode: set() for mode in modes}
        self.ended: dict[int, Sequence | None] = {}
        """By episode number; None: given up."""
        self.redrawn: Counter[str] = Counter()
        self._before: TickReport | None = None

    def see(self, report: TickReport, shares: dict[int, tuple[float, int, int]]) -> None:
        """Count one tick.

        Args:
            report: The tick.
            shares: Of live worlds that were rendered: sum of visible shares, number of instances, number of views.
        """
        places = self._speeds(report)
        status = {name: report.column(name).tolist() for name in ("phase", "mode", "episode", "redraw", "live", "task", "ending")}
        names = {code: name for name, code in MODES.items()}
        for world, phase in enumerate(status["phase"]):
            mode, number = names.get(status["mode"][world]), status["episode"][world]
            if mode not in self.modes or number < 0 or phase not in (Phase.SETTLE, Phase.ACT, Phase.OVER):
                continue
            self.numbers[mode].add(number)
            if status["live"][world]:
                sequence = self.running.setdefault(world, Sequence(mode, number))
                self._count_frame(sequence, report, world)
                sequence.tasks[TASKS.get(status["task"][world], "no task")] += 1
                sequence.speed = np.maximum(sequence.speed, places[world]).tolist()
                share, instances, views = shares.get(world, (0.0, 0, 0))
                sequence.visible_share += share
                sequence.instances += instances
                sequence.views += views
            if phase == Phase.OVER:
                self._end(world, number, Ending(status["ending"][world]), status["redraw"][world])
        self._before = report

    def _count_frame(self, sequence: Sequence, report: TickReport, world: int) -> None:
        """Objects that are there and that have gone, and the attempt that ended in this tick."""
        present = report.catalog_index[world] >= 0
        held = _bits(int(report.column("held")[world]), len(present))
        outcome = Outcome(int(report.column("outcome")[world]))
        if sequence.frames == 0:
            sequence.objects = int(present.sum())
        elif self._before is not None:
            gone = (self._before.catalog_index[world] >= 0) & ~present
            picked = int((gone & held).sum()) if outcome.succeeded else 0
            sequence.picked += picked
            sequence.lost += int(gone.sum()) - picked
        sequence.frames += 1
        sequence.left = int(present.sum())
        sequence.not_finite += int((~np.isfinite(report.pose[world][present]).all(axis=1)).sum())
        sequence.load = max(sequence.load, float(report.measure("load")[world]))
        if outcome is not Outcome.NONE:
            sequence.outcomes[outcome.name] += 1
            if report.column("caught")[world] != 0:
                sequence.hits.append(int(report.column("hits")[world]))
                sequence.loads.append(sequence.load)
            sequence.load = 0.0

    def _end(self, world: int, number: int, ending: Ending, redraw: int) -> None:
        sequence = self.running.pop(world, None)
        if ending.delivers and sequence is not None:
            sequence.ending = ending.name.lower()
            self.ended[number] = sequence
            return
        self.redrawn[ending.name.lower()] += 1
        if redraw + 1 >= self.config.settle.tries:
            self.ended[number] = None

    def _speeds(self, report: TickReport) -> np.ndarray:
        """Largest speed of each world's objects in each of PLACES (world, place) [m/s]; of what moves from one frame to the next."""
        fastest = np.zeros((len(report.status), len(PLACES)))
        if (before := self._before) is None:
            return fastest
        same = [report.column(name) == before.column(name) for name in ("episode", "redraw")]
        both = (report.column("live") != 0) & (before.column("live") != 0) & same[0] & same[1]
        world, instance = np.nonzero(both[:, None] & (report.catalog_index >= 0) & (before.catalog_index >= 0))
        center = self.center[report.catalog_index[world, instance]]
        place, _ = place_of(report.pose[world, instance], center)
        last, _ = place_of(before.pose[world, instance], center)
        held = (report.column("held")[world] | before.column("held")[world]) >> instance & 1
        where = np.where(held, 2, np.where(is_inside(self.config, last), 0, 1))
        # A pose that is no number is counted elsewhere.
        np.fmax.at(fastest, (world, where), np.linalg.norm(place - last, axis=1) / self.tick)
        return fastest

    def chosen(self, mode: str) -> list[int]:
        """Numbers of the mode's sequences that count, as far as they have begun."""
        return sorted(self.numbers[mode])[: self.wanted]

    def sequences(self, mode: str) -> list[Sequence]:
        """Those that have ended."""
        return [sequence for number in self.chosen(mode) if (sequence := self.ended.get(number)) is not None]

    def complete(self) -> bool:
        """Whether all that count have ended."""
        return all(len(numbers := self.chosen(mode)) == self.wanted and all(n in self.ended for n in numbers) for mode in self.modes)


def _bits(bits: int, count: int) -> np.ndarray:
    return np.array([bits >> i & 1 for i in range(count)], dtype=bool)


def visible_shares(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum of visible shares and number of instances of each view (view): BOP's visib_fract of those with px_count_all > 0.

    Args:
        pixels: px_count_all, px_count_valid, px_count_visib (view, instance, 3).
    """
    whole, visible = pixels[..., 0], pixels[..., 2]
    return (visible / np.maximum(whole, 1)).sum(axis=1), (whole > 0).sum(axis=1)


def report(tally: Tally) -> list[ModeRow]:
    """The lines of the report."""
    sequences = {mode: tally.sequences(mode) for mode in tally.modes}
    rows = [
        ModeRow("sequences", "", {mode: len(found) for mode, found in sequences.items()}),
        ModeRow("begun, but not ended", "", {mode: sum(n not in tally.ended for n in tally.chosen(mode)) for mode in tally.modes}),
        ModeRow("given up", "", {mode: sum(tally.ended.get(n, 0) is None for n in tally.chosen(mode)) for mode in tally.modes}),
    ]
    columns = {mode: dict(_numbers(found)) for mode, found in sequences.items()}
    names = list(dict.fromkeys(key for column in columns.values() for key in column))
    for name, unit in names:
        values = {mode: float(columns[mode].get((name, unit), 0.0)) for mode in tally.modes}
        rows.append(_bounded(ModeRow(name, unit, values)))
    return rows


def _bounded(row: ModeRow) -> ModeRow:
    """The row with what the issue asks of it."""
    paper = PAPER.get(row.name, {})
    values = row.values.items()  # NaN holds nowhere.
    if row.name == "frames a sequence":
        within = {mode: abs(value / paper[mode] - 1.0) <= FRAMES_WITHIN for mode, value in values}
        return ModeRow(row.name, row.unit, row.values, f"±{100 * FRAMES_WITHIN:.0f} %", within)
    if row.name == "visibility, mean":
        return ModeRow(
            row.name, row.unit, row.values, f"±{VISIBILITY_WITHIN}", {m: abs(v - paper[m]) <= VISIBILITY_WITHIN for m, v in values}
        )
    if row.name.startswith("largest speed"):
        return ModeRow(row.name, row.unit, row.values, f"< {MOST_SPEED:g}", {mode: value < MOST_SPEED for mode, value in values})
    if row.name == "poses that are no numbers":
        return ModeRow(row.name, row.unit, row.values, "= 0", {mode: value == 0 for mode, value in values})
    return row


def _numbers(sequences: list[Sequence]) -> Iterator[tuple[tuple[str, str], float]]:
    """Name and unit, and number, of each line of one mode."""
    frames = np.array([sequence.frames for sequence in sequences])
    yield from _spread("frames a sequence", frames)
    views, instances = (sum(getattr(sequence, name) for sequence in sequences) for name in ("views", "instances"))
    if views:
        shares = np.array([sequence.visible_share / max(sequence.instances, 1) for sequence in sequences])
        yield ("visibility, mean", ""), sum(sequence.visible_share for sequence in sequences) / max(instances, 1)
        yield ("visibility, standard error over sequences", ""), _error(shares)
        yield ("instances a view", ""), instances / views
    attempts = sum(sequence.attempts for sequence in sequences)
    successes = sum(sequence.successes for sequence in sequences)
    yield ("attempts a sequence", ""), _mean([sequence.attempts for sequence in sequences])
    yield ("attempts that succeed", "%"), _share(successes, attempts)
    for outcome in list(Outcome)[1:]:
        yield (f"  {outcome.sentence}", "%"), _share(sum(sequence.outcomes[outcome.name] for sequence in sequences), attempts)
    for name, text in (("objects", "objects at the start"), ("picked", "picked"), ("lost", "lost"), ("left", "left at the end")):
        yield (text, ""), _mean([getattr(sequence, name) for sequence in sequences])
    yield ("objects a success", ""), sum(sequence.picked for sequence in sequences) / max(successes, 1)
    for ending in Ending:
        if ending.delivers:
            count = sum(sequence.ending == ending.name.lower() for sequence in sequences)
            yield (f"sequences that end: {ending.name.lower()}", "%"), _share(count, len(sequences))
    for task in (*TASKS.values(), "no task"):
        yield (f"frames a sequence: {task}", ""), _mean([sequence.tasks[task] for sequence in sequences])
    hits = [hit for sequence in sequences for hit in sequence.hits]
    yield ("rays that hit, where something was caught", ""), _mean(hits)
    loads = np.array([load for sequence in sequences for load in sequence.loads])
    for level, name in ((50, "median"), (90, "90 %"), (100, "most")):
        yield (f"largest seal load of an attempt, {name}", "N"), float(np.percentile(loads, level)) if len(loads) else np.nan
    for number, place in enumerate(PLACES):
        yield (f"largest speed {place}", "m/s"), max((sequence.speed[number] for sequence in sequences), default=np.nan)
    yield ("poses that are no numbers", ""), sum(sequence.not_finite for sequence in sequences)


def _spread(name: str, values: np.ndarray) -> Iterator[tuple[tuple[str, str], float]]:
    yield (name, ""), _mean(values)
    yield (f"{name}, standard error", ""), _error(values)
    for level, word in ((0, "least"), (50, "median"), (100, "most")):
        yield (f"{name}, {word}", ""), float(np.percentile(values, level)) if len(values) else np.nan


def _mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def _error(values: np.ndarray) -> float:
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else np.nan


def _share(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else np.nan
