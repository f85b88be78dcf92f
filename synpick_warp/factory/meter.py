"""Throughput of a bake and its remaining time, reported to the observer after each tick."""

from __future__ import annotations

import time

from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.system.progress import Progress


class ThroughputMeter:
    """Throughput and remaining time, reported to the observer."""

    def __init__(self, cameras: int, expected: float, summary: BakeSummary, progress: Progress) -> None:
        self.summary, self.progress = summary, progress
        self.started: float | None = None
        self.cameras, self.expected = cameras, expected
        """Number of cameras, and mean number of frames of an episode while none has ended."""
        self.counted = 0
        """Episodes of the summary of which `delivered` and `frames` are the sums."""
        self.delivered = self.frames = 0

    def show(self, active: int) -> None:
        """Report after a tick in which `active` worlds were busy. Time counts from the first view, when all kernels are compiled."""
        summary, now = self.summary, time.perf_counter()
        if self.started is None and summary.views:
            self.started = now
        elapsed = now - self.started if self.started is not None else 0.0
        self._count_delivered()
        left = None
        if summary.total > summary.resumed and elapsed > 0.0 and summary.views:
            # Short episodes end first: running ones can already be longer than the mean of the ended ones.
            running = summary.views / self.cameras / max(1, len(summary.episodes) - summary.resumed + active)
            frames = max(self.frames / self.delivered if self.delivered else self.expected, running)
            fraction = summary.views / ((summary.total - summary.resumed) * self.cameras * frames)
            left = (1.0 / fraction - 1.0) * elapsed if fraction < 1.0 else None
        self.progress.update(
            episodes_done=len(summary.episodes),
            episodes=summary.total,
            worlds_active=active,
            views=summary.views,
            views_per_s=summary.views / elapsed if elapsed > 0.0 else 0.0,
            seconds_left=left,
        )

    def _count_delivered(self) -> None:
        """Add the episodes that ended since the last report: a tick's work does not grow with the episodes before."""
        for row in self.summary.episodes[self.counted :]:
            if row.ending.delivers:
                self.delivered += 1
                self.frames += row.frames
        self.counted = len(self.summary.episodes)
