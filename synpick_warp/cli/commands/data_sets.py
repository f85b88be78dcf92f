"""Commands on finished data sets: `stats`, `report`, `convert`; `validate` by the rules of BOP and re-rendered views, `verify` by
checksums, and `prove` by replication."""

from __future__ import annotations

import sys
import time
from collections import Counter
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from synpick_warp.cli.options import (
    EXIT_INCOMPLETE,
    MAX_THREADS,
    DataSetArgument,
    EpisodesOfOption,
    PaperOption,
    WholeNumber,
    beside,
    check_new_folder,
    check_output_file,
    check_range,
    find_data_set,
    one_line,
    open_split,
)
from synpick_warp.configs.schema import FORMATS
from synpick_warp.errors import ConfigError, OutputError, escape
from synpick_warp.exporters.formats import convertible
from synpick_warp.system.inputs.urls import store_url

if TYPE_CHECKING:
    from synpick_warp.apps.validation.registry import Violation
    from synpick_warp.apps.validation.run import Summary, ValidationOptions


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


EXIT_VIOLATIONS = 1
_MAX_SAMPLE = 10**9


def validate(
    folder: Annotated[
        Path | None,
        Parameter(
            name="DIR", help="A BOP data set: the folder that contains train_pbr, models, ... (default: synpick-data in the current folder)"
        ),
    ] = None,
    /,
    *,
    sample: Annotated[
        WholeNumber | None, Parameter(help="Views that are rendered again to check poses, spread evenly; 0: none (default 200).")
    ] = None,
    poses: Annotated[bool, Parameter(negative=(), help="Render every view again.")] = False,
    fast: Annotated[bool, Parameter(negative=(), help="Only files, annotations, models and target lists; no image is read.")] = False,
    json: Annotated[bool, Parameter(negative=(), help="Print JSON Lines: one object per violation, and one with the totals.")] = False,
    tolerance: Annotated[
        str | None,
        Parameter(
            name="--tolerance",
            help="MM,PX: the data set is measured. Deviations of depth up to MM millimetres, of outlines and boxes up to PX pixels, and "
            "surplus pixels up to PX per pixel of the outline, are no errors; their distribution is printed by rule and "
            "object. Logical rules stay strict.",
        ),
    ] = None,
    limit: Annotated[WholeNumber, Parameter(help="Violations that are printed of each rule; 0: all. --json prints all.")] = 20,
    threads: Annotated[WholeNumber, Parameter(help="Number of processes; 0: one per core.")] = 0,
    rules: Annotated[bool, Parameter(negative=(), help="List all rules instead.")] = False,
) -> int:
    """Check a BOP data set, ours or not: files, annotations, masks, models, target lists, and poses against re-rendered views.

    A line per violation: level, file, rule, what is wrong and how to mend it. Nothing is written.

    Exit codes: 0, no errors (there may be warnings); 1, errors were found; 2, the folder is not a BOP data set.
    """
    if rules:
        _print_rules(as_json=json)
        return 0
    options = _make_options(sample, threads, tolerance, poses=poses, fast=fast)
    if limit < 0:
        raise ConfigError(f"--limit is {limit}; allowed: 0 for all, or more")
    folder = find_data_set(folder, "synpick-warp validate DIR")
    from synpick_warp.apps.validation.run import Summary
    from synpick_warp.apps.validation.run import validate as check
    from synpick_warp.cli.display import count_on_stderr

    summary, counts = Summary(), Counter()
    with count_on_stderr() as counter:
        for violation in check(folder, options, summary, counter.report):
            counts[violation.rule] += 1
            if json or not limit or counts[violation.rule] <= limit:
                print(_line(violation, as_json=json))
    _print_summary(summary, counts, 0 if json else limit, as_json=json)
    return EXIT_VIOLATIONS if summary.errors else 0


def _make_options(sample: int | None, threads: int, tolerance: str | None, *, poses: bool, fast: bool) -> ValidationOptions:
    """Make the options of the validation from the command's options; raises ConfigError."""
    from synpick_warp.apps.validation.registry import parse_tolerance
    from synpick_warp.apps.validation.run import DEFAULT_SAMPLE, ValidationOptions

    if fast and (poses or sample):
        raise ConfigError("--fast reads no images, so it renders none; drop it, or --sample and --poses")
    if poses and sample is not None:
        raise ConfigError("--poses renders every view; drop it, or --sample")
    check_range("--sample", sample or 0, 0, _MAX_SAMPLE)
    check_range("--threads", threads, 0, MAX_THREADS)
    given: dict[str, Any] = {"threads": threads} if threads else {}
    bounds = None if tolerance is None else parse_tolerance(tolerance)
    return ValidationOptions(None if poses else DEFAULT_SAMPLE if sample is None else sample, not fast, tolerance=bounds, **given)


def _line(violation: Violation, *, as_json: bool) -> str:
    """Violation as one line of text, or of JSON in ASCII; file names that are not UTF-8 have their bytes as lone surrogates."""
    from synpick_warp.apps.validation.registry import load_rules

    cure = load_rules()[violation.rule].cure
    if as_json:
        return dumps({**violation._asdict(), "cure": cure})
    return one_line(f"{violation.level} {violation.file}: {violation.rule}: {violation.text}. To mend it: {cure}.")


def _print_rules(*, as_json: bool) -> None:
    from synpick_warp.apps.validation.registry import load_rules

    for item in load_rules().values():
        record = {"rule": item.name, "level": item.level, "unit": item.unit, "sentence": item.sentence, "cure": item.cure}
        print(dumps(record) if as_json else f"{item.name} ({item.level}): {item.sentence}")


def _print_summary(summary: Summary, counts: Counter, limit: int, *, as_json: bool) -> None:
    """Print how many violations were held back by rule (limit 0: none), distributions of deviations, and the totals; or these as JSON."""
    from synpick_warp.apps.validation.registry import distributions

    found = distributions(summary.deviations)
    if as_json:
        for item in found:
            print(dumps({"deviation": item._asdict()}))
        print(dumps({"totals": {name: value for name, value in vars(summary).items() if name != "deviations"}}))
        return
    for name, count in counts.items():
        if limit and count > limit:
            print(f"{name}: {count - limit:,} more; --limit 0 prints all")
    if found:
        print(f"{'deviation':<17} {'object':>6} {'instances':>9} {'median':>8} {'95 %':>8} {'largest':>8}")
    for item in found:
        name, numbers = item.obj_id or "all", f"{item.median:8.2f} {item.percentile_95:8.2f} {item.largest:8.2f}"
        print(f"{item.rule:<17} {name:>6} {item.instances:>9} {numbers} {item.unit}")
    rendered = f"{summary.rendered:,} of them rendered again" if summary.models else "none of them rendered again, without models"
    checked = f"{summary.scenes:,} scenes, {summary.models:,} models, {summary.views:,} views, {rendered}"
    print(f"{checked}: {summary.errors:,} errors, {summary.warnings:,} warnings")
    sys.stdout.flush()


def verify(
    folder: DataSetArgument = None,
    /,
    *,
    threads: Annotated[WholeNumber, Parameter(help="Maximum number of processes; 0: one per core.")] = 0,
) -> int:
    """Verify the SHA-256 checksum of every file of a data set.

    Exit codes: 0, all match; 1, a file is damaged or missing (it is named), or the bake is not finished; 2, the folder is not a data set.
    """
    check_range("--threads", threads, 0, MAX_THREADS)
    url = store_url(folder)
    place = find_data_set(folder, "synpick-warp verify DIR") if url is None else Path()
    from synpick_warp.cli.display import count_on_stderr
    from synpick_warp.dataset.commit.verify import verify as check

    with count_on_stderr() as counter:
        if url is None:
            verdict = check(place, threads or None, counter.report)
        else:
            from synpick_warp.cloud.reading import verify_store

            verdict = verify_store(url, counter.report)
    if verdict.problem:
        print(verdict.problem)
        return EXIT_INCOMPLETE
    episodes = f"{verdict.episodes:,} episode{'' if verdict.episodes == 1 else 's'}"
    print(f"{verdict.files:,} files of {episodes} match their checksums")
    if not verdict.finished:
        print("the data set is not finished: the command that started it resumes it")
    return 0 if verdict.finished else EXIT_INCOMPLETE


def prove(
    folder: DataSetArgument = None,
    /,
    *,
    share: Annotated[float, Parameter(help="Share of the episodes, above 0 to 1; at least one is baked.")] = 0.01,
    seed: Annotated[WholeNumber, Parameter(help="Seed by which they are drawn.")] = 0,
    device: Annotated[str | None, Parameter(help="Device that bakes, such as cuda:0 (default: that of the settings).")] = None,
) -> int:
    """Bake a share of a data set's episodes again, in a temporary folder, and compare their files byte by byte.

    If all are equal, a line in proofs.md of the data set says so, with date, version and device.

    Exit codes: 0, all are equal; 1, a file differs (it is named); 2, it cannot be compared here, as with other versions or objects.
    """
    if not 0.0 < share <= 1.0:
        raise ConfigError(f"--share is {share:g}; allowed: above 0, to 1")
    check_range("--seed", seed, 0, _MAX_SAMPLE)
    place = find_data_set(folder, "synpick-warp prove DIR")
    from synpick_warp.apps.validation.proof import prove as bake_again
    from synpick_warp.apps.validation.proof import record_proof
    from synpick_warp.cli.display import make_console, make_progress

    with make_progress(make_console()) as progress:
        proof = bake_again(place, share, seed, progress, device)
    episodes = f"{len(proof.episodes):,} episode{'' if len(proof.episodes) == 1 else 's'}"
    if proof.problem:
        print(proof.problem)
        return EXIT_VIOLATIONS
    print(f"{episodes} baked again, {proof.files:,} files compared: all are equal")
    try:
        record_proof(place, proof)
    except OutputError as error:
        print(f"not recorded: {error}")
    return 0
