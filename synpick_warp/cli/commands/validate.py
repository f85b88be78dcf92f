"""Commands `validate`, `verify` and `prove`: rules of BOP data sets, and poses against re-rendered views; checksums; replication."""

from __future__ import annotations

import sys
from collections import Counter
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from synpick_warp.cli.folders import find_data_set
from synpick_warp.cli.options import EXIT_INCOMPLETE, MAX_THREADS, DataSetArgument, WholeNumber, check_range, one_line
from synpick_warp.errors import ConfigError, OutputError
from synpick_warp.system.inputs.urls import store_url

if TYPE_CHECKING:
    from synpick_warp.apps.validation.registry import Violation
    from synpick_warp.apps.validation.run import Summary, ValidationOptions

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
