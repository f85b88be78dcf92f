"""Command `convert`: write a baked data set in other formats."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from synpick_warp.cli.folders import beside, find_data_set
from synpick_warp.cli.options import MAX_THREADS, WholeNumber, check_range
from synpick_warp.configs.schema import FORMATS
from synpick_warp.exporters.formats import convertible


def convert(
    folder: Annotated[
        Path | None,
        Parameter(name="DIR", help="A data set; its committed episodes are converted (default: the last one in the current folder)."),
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
    would have written, but for LeRobot's videos from JPEG images. BOP data sets from other sources become bop, shards, coco or yolo, with
    their own ids; interrupted, they are converted again from the start. Exit codes: 0, converted; 2, an error.
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
