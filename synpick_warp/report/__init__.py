"""Report of a data set as one HTML page: frames, film strips, explained attempts, plots, findings, settings; it loads nothing."""

from synpick_warp.report.compose import write_report

__all__ = ["write_report"]
