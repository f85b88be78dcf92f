"""Commands `stats`, `report` and `convert`: statistics of a data set beside the paper's, one HTML page about it, and other formats."""

import sys
import time
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from synpick_warp.cli.folders import beside, check_new_folder, check_output_file, find_data_set, open_split
from synpick_warp.cli.options import MAX_THREADS, DataSetArgument, EpisodesOfOption, PaperOption, WholeNumber, check_range
from synpick_warp.configs.schema import FORMATS
from synpick_warp.errors import escape
from synpick_warp.exporters.formats import convertible

MAX_DEPTH_VIEWS = 100_000
MEBIBYTE, MEGABYTE = 2**20, 1e6
"""Bytes."""


def show_statistics(
    folder: DataSetArgument = None,
    /,
    *,
    json: Annotated[bool, Parameter(negative=(), help="Print all statistics as JSON instead of tables.")] = False,
    csv: Annotated[Path | None, Parameter(help="New or empty folder for all tables as CSV files.")] = None,
    split: EpisodesOfOption = None,
    depth_views: Annotated[WholeNumber, Parameter(help="Views whose depth image is read, spread over the data set; 0: none.")] = 64,
    paper: PaperOption = None,
    threads: Annotated[WholeNumber, Parameter(help="Processes that read; 0: one per core.")] = 0,
) -> int:
    """Count views, instances, visibility, attempts, seal forces, viewing directions, depth and lights.

    The paper's numbers stand beside those of its own objects, or if --paper asks for them; --json and --csv always have them.

    Reads each annotation file once and holds only counts. Exit codes: 0; 2, the folder is not a data set, or a file of it is damaged.
    """
    check_range("--depth-views", depth_views, 0, MAX_DEPTH_VIEWS)
    check_range("--threads", threads, 0, MAX_THREADS)
    folder = find_data_set(folder, "synpick-warp stats DIR")
    from synpick_warp.apps.statistics.tables import print_statistics, to_json, write_csv

    if csv is not None:
        check_new_folder(csv, "--csv")
        check_output_file(csv, "--csv", folder)
    from synpick_warp.apps.statistics.compute import assemble, collect
    from synpick_warp.cli.display import count_on_stderr, make_console
    from synpick_warp.system.hardware.cores import count_cores

    data_set = open_split(folder, split)
    started = time.perf_counter()
    with count_on_stderr() as counter:
        collected = collect(data_set, depth_views, threads or count_cores(), counter.report)
    wall = max(time.perf_counter() - started, 1e-9)
    statistics = assemble(data_set, collected)
    if csv is not None:
        for path in write_csv(statistics, csv):
            print(f"table: {escape(str(path))}", file=sys.stderr if json else sys.stdout)
    if json:
        print(to_json(statistics))
    elif csv is None:
        print_statistics(make_console(), statistics, paper)
    rate = f"{collected.views / wall:,.0f} views/s"
    summary = f"{collected.views:,} views in {wall:.1f} s ({rate}); peak memory {collected.memory / MEBIBYTE:,.0f} MiB"
    print(summary, file=sys.stderr if json else sys.stdout)
    return 0


def write_page(
    folder: DataSetArgument = None,
    /,
    *,
    out: Annotated[Path | None, Parameter(help="HTML file to write (default DIR-report.html, beside the data set).")] = None,
    split: EpisodesOfOption = None,
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
    from synpick_warp.cli.display import count_on_stderr

    data_set = open_split(folder, split)
    with count_on_stderr() as counter:
        write_report(data_set, page, frames=views, paper=paper, threads=threads, report=counter.report)
    print(f"report: {escape(str(page))} ({page.stat().st_size / MEGABYTE:.1f} MB)")
    return 0


def convert(
    folder: Annotated[
        Path | None,
        Parameter(name="DIR", help="A data set; its committed episodes are converted (default: synpick-data in the current folder)."),
    ] = None,
    /,
    *,
    to: Annotated[str, Parameter(help=f"Formats to write, joined by commas: {', '.join(convertible())}.")],
    out: Annotated[
        Path | None,
        Parameter(
            help="Folder of the converted data set: new, empty, or of an interrupted conversion (default DIR-FORMATS, beside the data set)."
        ),
    ] = None,
    split: Annotated[str | None, Parameter(help="Split to convert, of a BOP data set from another source (default: the only one).")] = None,
    threads: Annotated[WholeNumber, Parameter(name=("--threads", "--processes"), help="Processes that convert; 0: one per core.")] = 0,
) -> int:
    """Convert a data set to other formats. After an interruption, the same command resumes with the remaining episodes.

    Formats of images need bop or shards in the data set, those of motion alone (usd) zarr, and lerobot both. Files are those that a bake
    would have written, but for LeRobot's videos from JPEG images. BOP data sets from other sources become bop, shards, coco, yolo or
    points, with their own ids; interrupted, they are converted again from the start. Exit codes: 0, converted; 2, an error.
    """
    check_range("--threads", threads, 0, MAX_THREADS)
    from synpick_warp.apps.conversion.run import convert as run_conversion
    from synpick_warp.cli.display import CountProgress, make_console
    from synpick_warp.dataset.commit.manifest import MANIFEST_FILE

    names = [name.strip() for name in to.split(",")]
    folder = find_data_set(folder, "synpick-warp convert DIR")
    out = out or beside(folder, f"-{'-'.join(name for name in names if name in FORMATS) or 'converted'}")
    with CountProgress(make_console()) as counter:
        converted = run_conversion(folder, out, names, threads, counter.report, split)
    unit = "episodes" if (folder / MANIFEST_FILE).exists() else "scenes"
    before = f" ({converted.resumed:,} of them before)" if converted.resumed else ""
    print(f"{converted.episodes:,} {unit} converted to {', '.join(names)}{before}")
    if converted.remark:
        print(converted.remark)
    print(f"data set: {out}")
    return 0
