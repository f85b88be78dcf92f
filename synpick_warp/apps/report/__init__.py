"""Self-contained HTML report of a data set: frames, film strips, explained attempts, plots, findings and settings."""

from synpick_warp.apps.report.compose import write_report

__all__ = ["write_report"]
