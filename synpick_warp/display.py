"""Shows a bake to people: live on a terminal, in plain lines elsewhere; and what became of it at the end."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.table import Table

from synpick_warp.progress import Progress

if TYPE_CHECKING:
    from synpick_warp.bake import BakeSummary, EpisodeRow

PLAIN_WIDTH = 120
"""Width of tables where there is no terminal [characters]."""
PLAIN_INTERVAL = 10.0
"""Least time between two plain lines of the same stage [s]."""
LISTED = 20
"""Episodes are listed one by one up to this number; of more, only those that failed."""


def make_console() -> Console:
    """The standard output, as wide as the terminal."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=PLAIN_WIDTH)


def make_progress(console: Console) -> Progress:
    """A live display on a terminal, plain lines elsewhere."""
    return LiveProgress(console) if console.is_terminal else PlainProgress(console)


class LiveProgress:
    """One line that redraws itself: stage, bar of episodes, worlds, views, rate, time left."""

    def __init__(self, console: Console) -> None:
        stage, detail = TextColumn("{task.description}", markup=False), TextColumn("{task.fields[detail]}", markup=False)
        columns = (stage, BarColumn(bar_width=30), MofNCompleteColumn(), detail, TimeElapsedColumn())
        self._bar = Bar(*columns, console=console, transient=True)
        self._task = self._bar.add_task("starting", total=None, detail="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._bar.stop()

    def stage(self, text: str) -> None:
        """Name the stage."""
        self._bar.update(self._task, description=text, detail="")

    def update(
        self, *, episodes_done: int, episodes: int, worlds_active: int, views: int, views_per_s: float, seconds_left: float | None
    ) -> None:
        """Move the bar."""
        detail = _detail(worlds_active, views, views_per_s, seconds_left)
        self._bar.update(self._task, completed=episodes_done, total=episodes, detail=detail)

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        self._bar.console.print(text, markup=False)


class PlainProgress:
    """A line for every stage and note, and now and then one for how far it is."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._started = time.monotonic()
        self._printed_at = float("-inf")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        return None

    def stage(self, text: str) -> None:
        """Print the stage."""
        self.note(text)

    def update(
        self, *, episodes_done: int, episodes: int, worlds_active: int, views: int, views_per_s: float, seconds_left: float | None
    ) -> None:
        """Print how far it is, unless a line was printed a short while ago."""
        now = time.monotonic()
        if now - self._printed_at >= PLAIN_INTERVAL:
            self._printed_at = now
            self.note(f"episodes {episodes_done}/{episodes} · {_detail(worlds_active, views, views_per_s, seconds_left)}")

    def note(self, text: str) -> None:
        """Print a line, after the time since the start."""
        self._console.print(f"{_duration(time.monotonic() - self._started):>7}  {text}", markup=False, soft_wrap=True)
        self._console.file.flush()


def print_summary(console: Console, summary: BakeSummary, out: Path) -> None:
    """Print what became of every episode, and the totals. Of many episodes, only those are listed that delivered nothing."""
    many = len(summary.episodes) > LISTED
    if many:
        console.print(_counts(summary))
    failed = [row for row in summary.episodes if not row[2].delivers]
    rows = failed if many else summary.episodes
    if rows:
        console.print(_listing(rows[:LISTED]))
    if len(rows) > LISTED:
        console.print(f"and {len(rows) - LISTED} more that delivered nothing", markup=False)
    rate = summary.views / summary.wall_seconds if summary.wall_seconds > 0.0 else 0.0
    console.print(
        f"{len(summary.episodes) - len(failed)} of {len(summary.episodes)} episodes and {summary.views:,} views"
        f" in {_duration(summary.wall_seconds)} ({rate:.1f} views/s); arrangements drawn again: {summary.redraws}",
        markup=False,
        soft_wrap=True,
    )
    console.print(f"data set: {out}", markup=False, soft_wrap=True)


def _listing(rows: Sequence[EpisodeRow]) -> Table:
    table = Table("episode", "ending", "drawn again", "frames", "time")
    for column in (0, 2, 3, 4):
        table.columns[column].justify = "right"
    for episode, redraw, ending, frames, seconds in rows:
        table.add_row(str(episode), ending.sentence, str(redraw), str(frames), _duration(seconds))
    return table


def _counts(summary: BakeSummary) -> Table:
    table = Table("ending", "episodes", "frames")
    table.columns[1].justify = table.columns[2].justify = "right"
    episodes: Counter = Counter()
    frames: Counter = Counter()
    for _, _, ending, count, _ in summary.episodes:
        episodes[ending] += 1
        frames[ending] += count
    for ending, number in episodes.most_common():
        table.add_row(ending.sentence, f"{number:,}", f"{frames[ending]:,}")
    return table


def _detail(worlds_active: int, views: int, views_per_s: float, seconds_left: float | None) -> str:
    left = "" if seconds_left is None else f" · {_duration(seconds_left)} left"
    return f"worlds {worlds_active} · views {views:,} · {views_per_s:.1f} views/s{left}"


def _duration(seconds: float) -> str:
    """Such as 0:07 or 1:02:03."""
    whole = round(seconds)
    minutes = f"{whole // 60 % 60:02}" if whole >= 3600 else str(whole // 60)
    return f"{whole // 3600}:{minutes}:{whole % 60:02}" if whole >= 3600 else f"{minutes}:{whole % 60:02}"
