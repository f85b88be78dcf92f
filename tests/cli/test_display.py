"""What people see of a bake, and at its end."""

from __future__ import annotations

import io
import re
import types
from collections import Counter
from pathlib import Path

import pytest
from rich.console import Console

from synpick_warp.cli import display
from synpick_warp.cli.display import CountProgress, LiveProgress, PlainProgress, print_summary
from synpick_warp.codes import Ending, Outcome
from synpick_warp.factory import episodes
from synpick_warp.factory.episodes import BakeSummary, EpisodeOutcome, ThroughputMeter
from synpick_warp.system.progress import Progress


def row(episode: int, arrangement: int, ending: Ending, frames: int, seconds: float, mode: str = "move", *counts: int) -> EpisodeOutcome:
    return EpisodeOutcome(episode, arrangement, ending, frames, seconds, mode, *(counts or (9, 0, 0, 0, 9)))


def printed(summary: BakeSummary) -> str:
    console = Console(file=io.StringIO(), width=120)
    print_summary(console, summary, Path("data"))
    return console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("summary", "said"),
    [
        (BakeSummary(), "data set: data\n"),
        (
            BakeSummary(1, [row(0, 1, Ending.FINISHED, 9, 1.0)], remedies={Ending.PERCEPTION_OVERFLOW: "raise contour_points (16)"}),
            "\nperception overflow: raise contour_points (16)\n",
        ),
        (
            BakeSummary(3, [row(number, 0, Ending.FINISHED, 10, 1.0) for number in range(3)], views=30, wall_seconds=10.0, resumed=2),
            "3 of 3 episodes (2 of them before) and 30 views in 0:10 (3.0 views/s)",
        ),
        (BakeSummary(1, [row(0, 0, Ending.FINISHED, 120, 61.0)]), "1:01 "),
        (BakeSummary(1, [row(0, 0, Ending.FINISHED, 119, 3661.0)]), "1:01:01"),
    ],
)
def test_a_summary_says_what_is_there(summary, said):
    text = printed(summary)
    assert said in text
    assert text.count(Ending.FINISHED.sentence) == len(summary.episodes)
    assert "attempts" not in text
    assert "picked" not in text


def test_a_bake_that_picked_tells_of_attempts():
    rows = [
        row(0, 0, Ending.EMPTIED, 573, 38.2, "pick", 9, 10, 9, 0, 0),
        row(1, 0, Ending.GAVE_UP, 90, 6.0, "target", 8, 4, 2, 1, 5),
        row(2, 0, Ending.FINISHED, 416, 27.7),
    ]
    outcomes = Counter({Outcome.DROPPED: 3, Outcome.TARGET_PICKED: 10, Outcome.OTHER_PICKED: 1})
    text = printed(BakeSummary(len(rows), rows, views=3000, wall_seconds=10.0, outcomes=outcomes))
    lines = [[cell.strip() for cell in line.split("│")[1:-1]] for line in text.splitlines()]
    assert [line[-3:] for line in lines if line and line[0] in "012"][:2] == [["10", "9 of 9", "0"], ["4", "2 of 8", "1"]]
    assert {line[1] for line in lines if line and line[1]} == {"pick", "target", "move"}
    expected = "14 attempts: target picked 10 (71%), dropped 3 (21%), other picked 1 (7%); 11 of 17 objects picked, 1 lost otherwise"
    assert expected in text.splitlines()


@pytest.mark.parametrize("many", [False, True])
def test_endings_are_those_of_the_bin(many):
    given = EpisodeOutcome(0, 0, Ending.EMPTIED, 9, 1.0, "pick", 3, 3, 3, 0, 0, bin={"name": "kanban"})
    text = printed(BakeSummary(100, [given] * (100 if many else 1)))
    assert "no object is left in the bin" in text
    assert "tote" not in text


def test_a_long_bake_lists_counts_and_failures():
    rows = [row(episode, 0, Ending.NOT_FINITE if episode % 4 == 0 else Ending.FINISHED, 5, 1.0) for episode in range(100)]
    text = printed(BakeSummary(len(rows), rows, views=1500, wall_seconds=10.0))
    assert text.count(Ending.FINISHED.sentence) == 1
    assert text.count(Ending.NOT_FINITE.sentence) == 1 + 20
    assert "and 5 more that delivered nothing" in text
    assert "75 of 100 episodes" in text


@pytest.mark.parametrize("kind", [LiveProgress, PlainProgress])
def test_progress_displays(kind):
    console = Console(file=io.StringIO(), width=120, highlight=False, force_terminal=kind is LiveProgress)
    progress: Progress = kind(console)
    with progress:
        progress.stage("baking [bold]")
        for done in range(5):
            progress.stage(f"compiling: {done} of 5 modules")
        for done in range(50):
            progress.update(episodes_done=done, episodes=50, worlds_active=4, views=done, views_per_s=3.0, seconds_left=90.0)
        progress.note("note [x]")
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "note [x]" in text
    assert "1:30 left" in text
    if kind is LiveProgress:
        plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)
        assert "episodes ━━━━━━━━━━━╸ 49/50 0:00:00 worlds 4 · views 49 · 3.0 views/s · 1:30 left" in plain
    if kind is PlainProgress:
        lines = ["baking [bold]", "compiling: 0 of 5 modules", "episodes 0/50 · worlds 4 · views 0 · 3.0 views/s · 1:30 left", "note [x]"]
        assert text.splitlines() == [f"   0:00  {line}" for line in lines]


def test_the_remaining_time_is_shown_from_the_first_views_on(monkeypatch):
    """While no episode has ended, by its predicted length: 100 of 2 x 3 x 50 views in 5 s."""
    clock = iter((10.0, 15.0))
    monkeypatch.setattr(episodes.time, "perf_counter", lambda: next(clock))
    left, summary = [], BakeSummary(2, views=1)
    progress = types.SimpleNamespace(update=lambda **counts: left.append(counts["seconds_left"]))
    shown = ThroughputMeter(3, 50.0, summary, progress)
    shown.show(2)
    summary.views = 100
    shown.show(2)
    assert left == [None, pytest.approx(10.0)]


@pytest.mark.parametrize("terminal", [True, False])
def test_an_estimation_counts_views(terminal, monkeypatch):
    """A bar on a terminal, which is gone at the end; lines elsewhere."""
    monkeypatch.setattr(display, "PLAIN_INTERVAL", 0.0)
    console = Console(file=io.StringIO(), width=80, force_terminal=terminal)
    with CountProgress(console) as counter:
        counter.report("views", 128, 3600)
        counter.report("views", 3600, 3600)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert ("views 128/3,600\n" in text) is not terminal
    assert "3600/3600" in text or not terminal
