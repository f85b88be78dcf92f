"""Command `report`: one HTML page about a data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from synpick_warp.cli.folders import beside, check_output_file, find_data_set, open_split
from synpick_warp.cli.options import MAX_THREADS, PaperOption, WholeNumber, check_range
from synpick_warp.errors import escape

MEGABYTE = 1e6
"""Bytes."""


def write_page(
    folder: Annotated[Path | None, Parameter(name="DIR", help="A data set (default: the last one in the current folder).")] = None,
    /,
    *,
    out: Annotated[Path | None, Parameter(help="HTML file to write (default DIR-report.html, beside the data set).")] = None,
    split: Annotated[str | None, Parameter(help="Only the episodes of this split (default: all splits).")] = None,
    views: Annotated[WholeNumber, Parameter(help="Frames that are shown, spread over the data set.")] = 12,
    paper: PaperOption = None,
    threads: Annotated[WholeNumber, Parameter(help="Processes that count; 0: one per core.")] = 0,
) -> int:
    """Write a report: one HTML page with frames, film strips, explained attempts, plots, findings and settings.

    The page needs no network and no other file; its pictures have at most 25 MB. Exit codes: 0; 2, the folder is not a data set, a file
    of it is damaged, or the page cannot be written.
    """
    from synpick_warp.apps.report.compose import MAX_FRAMES, check_out, write_report

    check_range("--views", views, 1, MAX_FRAMES)
    check_range("--threads", threads, 0, MAX_THREADS)
    folder = find_data_set(folder, "synpick-warp report DIR")
    page = out or beside(folder, "-report.html")
    check_out(page)
    check_output_file(page, "--out", folder)
    from synpick_warp.cli.display import CountProgress

    data_set = open_split(folder, split)
    with CountProgress(Console(stderr=True, highlight=False, soft_wrap=True)) as counter:
        write_report(data_set, page, frames=views, paper=paper, threads=threads, report=counter.report)
    print(f"report: {escape(str(page))} ({page.stat().st_size / MEGABYTE:.1f} MB)")
    return 0
