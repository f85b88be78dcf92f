"""Progress display of a bake and of a pass over a data set, and a bake's summary: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.table import Table

from synpick_warp.system.progress import Progress, SilentProgress

if TYPE_CHECKING:
    from synpick_warp.codes import Ending, Outcome
    from synpick_warp.factory.episodes import BakeSummary, EpisodeOutcome
    from synpick_warp.stages.timing import Recorder

PLAIN_WIDTH = 120
"""Width of tables without a terminal [characters]."""
PLAIN_INTERVAL = 10.0
"""Minimum time between two plain progress lines [s]."""
BAR_WIDTH = 12
"""Width of a bake's bar, which leaves room for the counts beside it on a terminal of 80 columns [characters]."""
MAX_ROWS = 20
"""Maximum number of episodes in the table; with more, only failed ones are listed."""


def make_console() -> Console:
    """Console on the standard output, as wide as the terminal."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=PLAIN_WIDTH)


def make_progress(console: Console, remark: object = "") -> Progress:
    """Choose the display: live on a terminal, plain lines elsewhere. `remark`: its text, at any time, ends the line of counts."""
    return LiveProgress(console, remark) if console.is_terminal else PlainProgress(console, remark)


class LiveBar:
    """Live progress bar, which is shown within a `with` statement."""

    def __init__(self, console: Console, *columns: ProgressColumn, disable: bool = False) -> None:
        name = TextColumn("{task.description}", markup=False)
        self._bar = Bar(name, *columns, console=console, transient=True, disable=disable)
        self._task = self._bar.add_task("starting", total=None, detail="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()


class LiveProgress(LiveBar):
    """Live progress bar of a bake: stage, episodes, worlds, views, rate, remaining time."""

    def __init__(self, console: Console, remark: object = "") -> None:
        self._remark = remark
        detail = TextColumn("{task.fields[detail]}", markup=False)
        super().__init__(console, BarColumn(bar_width=BAR_WIDTH), MofNCompleteColumn(), TimeElapsedColumn(), detail)

    def stage(self, text: str) -> None:
        """Show the stage's name beside the bar."""
        self._bar.update(self._task, description=text, detail="")

    def update(self, *, episodes_done: int, episodes: int, views: int, **counts: Any) -> None:
        """Set the bar to the episodes done, with worlds, views and time left [s] beside it; it is named so from the first view on."""
        detail = _detail(self._remark, views=views, **counts)
        name = "episodes" if views or episodes_done else None
        self._bar.update(self._task, completed=episodes_done, total=episodes, detail=detail, description=name)

    def note(self, text: str) -> None:
        """Print a note as a line above the bar."""
        self._bar.console.print(text, markup=False)


class PlainProgress(SilentProgress):
    """Plain progress lines: one per stage and note, and rate-limited ones for counts, also for those of a stage ("name: 3 of 9")."""

    def __init__(self, console: Console, remark: object = "") -> None:
        self._console, self._remark = console, remark
        self._started = time.monotonic()
        self._printed_at = float("-inf")
        self._counted_at: dict[str, float] = {}

    def stage(self, text: str) -> None:
        """Print the stage's name as a line; of the counts of one stage at most one every `PLAIN_INTERVAL`."""
        name, counts, _ = text.partition(": ")
        now = time.monotonic()
        if counts and now - self._counted_at.get(name, float("-inf")) < PLAIN_INTERVAL:
            return
        self._counted_at[name] = now
        self.note(text)

    def update(self, *, episodes_done: int, episodes: int, **counts: Any) -> None:
        """Print counts, at most every `PLAIN_INTERVAL`."""
        now = time.monotonic()
        if now - self._printed_at >= PLAIN_INTERVAL:
            self._printed_at = now
            self.note(f"episodes {episodes_done}/{episodes} · {_detail(self._remark, **counts)}")

    def note(self, text: str) -> None:
        """Print a line with the time since the start."""
        self._console.print(f"{format_duration(time.monotonic() - self._started):>7}  {text}", markup=False, soft_wrap=True)
        self._console.file.flush()


class CountProgress(LiveBar):
    """Progress of a pass over a data set: a live bar on a terminal, plain lines elsewhere."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, BarColumn(bar_width=30), MofNCompleteColumn(), TimeRemainingColumn(), disable=not console.is_terminal)
        self._console, self._printed_at = console, time.monotonic()

    def report(self, unit: str, done: int, total: int) -> None:
        """Set the bar; without a terminal print a line, at most every PLAIN_INTERVAL. See `progress.Report`."""
        self._bar.update(self._task, description=unit, completed=done, total=total)
        now = time.monotonic()
        if not self._console.is_terminal and now - self._printed_at >= PLAIN_INTERVAL:
            self._printed_at = now
            self._console.print(f"{unit} {done:,}/{total:,}", markup=False)
            self._console.file.flush()


def count_on_stderr() -> CountProgress:
    """Progress of a pass beside results on the standard output."""
    return CountProgress(Console(stderr=True, highlight=False, soft_wrap=True))


def print_summary(console: Console, summary: BakeSummary, out: Path | str) -> None:
    """Print a bake's summary: endings of the episodes, totals, advice and the data set's path. A bake without episodes has only the path.

    Of more than `MAX_ROWS` episodes, only failed ones are listed.
    """
    many = len(summary.episodes) > MAX_ROWS
    if many:
        console.print(_counts(summary))
    failed = [row for row in summary.episodes if not row.ending.delivers]
    rows = failed if many else summary.episodes
    if rows:
        console.print(_listing(rows[:MAX_ROWS]))
    if len(rows) > MAX_ROWS:
        console.print(f"and {len(rows) - MAX_ROWS} more that delivered nothing", markup=False)
    if summary.total:
        console.print(_totals(summary, len(failed)), markup=False, soft_wrap=True)
    if summary.outcomes:
        console.print(_attempts(summary), markup=False, soft_wrap=True)
    for ending, advice in sorted(summary.remedies.items()):
        console.print(f"{_words(ending)}: {advice}", markup=False, soft_wrap=True)
    console.print(f"data set: {out}", markup=False, soft_wrap=True)


def _totals(summary: BakeSummary, failed: int) -> str:
    """One line with the numbers of episodes and views and the throughput."""
    rate = summary.views / summary.wall_seconds if summary.wall_seconds > 0.0 else 0.0
    before = f" ({summary.resumed:,} of them before)" if summary.resumed else ""
    return (
        f"{len(summary.episodes) - failed} of {summary.total} episodes{before} and {summary.views:,} views"
        f" in {format_duration(summary.wall_seconds)} ({rate:.1f} views/s); arrangements resampled: {summary.resampled}"
    )


def print_profile(console: Console, recorder: Recorder) -> None:
    """Print the time of each stage; nested stages are indented. Device time stands only where a GPU measured it."""
    times = recorder.times
    on_device = any(stage.device > 0.0 for stage in times.values())
    table = Table("stage", "calls", "total s", "mean ms", "% of wall", *(("device s",) if on_device else ()))
    for column in table.columns[1:]:
        column.justify = "right"
    for path in sorted(times, key=lambda path: [-times[path[:end]].host for end in range(1, len(path) + 1)]):
        stage = times[path]
        cells = [
            f"{stage.calls:,}",
            f"{stage.host:.3f}",
            f"{1e3 * stage.host / stage.calls:.3f}",
            f"{100.0 * stage.host / recorder.wall:.1f}",
        ]
        table.add_row("  " * (len(path) - 1) + path[-1], *cells, *((f"{stage.device:.3f}",) if on_device else ()))
    rest = recorder.wall - sum(stage.host for path, stage in times.items() if len(path) == 1)
    table.add_row("other", "", f"{rest:.3f}", "", f"{100.0 * rest / recorder.wall:.1f}", *(("",) if on_device else ()))
    console.print(table)
    console.print(
        f"wall time: {recorder.wall:.3f} s; stages are those of the main process; host time, where no device is named", markup=False
    )


def _listing(rows: Sequence[EpisodeOutcome]) -> Table:
    """Table of episodes, one line each: mode, ending, resamples, frames, simulated time, and attempts if there are any."""
    columns = ["episode", "mode", "ending", "resampled", "frames", "time"]
    cells = [
        [str(row.episode), row.mode, row.sentence, str(row.arrangement), str(row.frames), format_duration(row.seconds)] for row in rows
    ]
    if any(row.attempts for row in rows):
        columns += ["attempts", "picked", "lost"]
        for row, line in zip(rows, cells, strict=True):
            line += [str(row.attempts), f"{row.picked} of {row.objects}", str(row.lost)]
    table = Table(*columns)
    for column in table.columns:
        column.justify = "left" if column.header in ("mode", "ending") else "right"
    for line in cells:
        table.add_row(*line)
    return table


def _counts(summary: BakeSummary) -> Table:
    table = Table("mode", "ending", "episodes", "frames")
    table.columns[2].justify = table.columns[3].justify = "right"
    episodes: Counter = Counter()
    frames: Counter = Counter()
    for row in summary.episodes:
        kind = row.mode, row.sentence
        episodes[kind] += 1
        frames[kind] += row.frames
    for kind in sorted(episodes, key=lambda kind: (kind[0], -episodes[kind])):
        table.add_row(*kind, f"{episodes[kind]:,}", f"{frames[kind]:,}")
    return table


def _attempts(summary: BakeSummary) -> str:
    """Counts of attempts by outcome, the most frequent first, and of picked and lost objects."""
    total = summary.outcomes.total()
    fractions = [f"{_words(outcome)} {count:,} ({count / total:.0%})" for outcome, count in summary.outcomes.most_common()]
    picked, objects, lost = (
        sum(getattr(row, name) for row in summary.episodes if row.mode in ("pick", "target")) for name in ("picked", "objects", "lost")
    )
    return f"{total:,} attempts: {', '.join(fractions)}; {picked:,} of {objects:,} objects picked, {lost:,} lost otherwise"


def _words(code: Ending | Outcome) -> str:
    """Name of an ending or outcome in words; its sentence is too long for a list."""
    return code.name.lower().replace("_", " ")


def _detail(remark: object, worlds_active: int, views: int, views_per_s: float, seconds_left: float | None) -> str:
    """Worlds, views, rate, remaining time and a remark in one line."""
    left = "" if seconds_left is None else f" · {format_duration(seconds_left)} left"
    return f"worlds {worlds_active} · views {views:,} · {views_per_s:.1f} views/s{left}{f' · {remark}' if str(remark) else ''}"


def format_duration(seconds: float) -> str:
    """Format a duration as 0:07 or 1:02:03."""
    whole = round(seconds)
    minutes = f"{whole // 60 % 60:02}" if whole >= 3600 else str(whole // 60)
    return f"{whole // 3600}:{minutes}:{whole % 60:02}" if whole >= 3600 else f"{minutes}:{whole % 60:02}"
