"""Command `verify`: checksums of a data set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from synpick_warp.cli.folders import find_data_set
from synpick_warp.cli.options import EXIT_INCOMPLETE, MAX_THREADS, WholeNumber, check_range
from synpick_warp.system.inputs.urls import store_url

if TYPE_CHECKING:
    from synpick_warp.cli.display import CountProgress
    from synpick_warp.dataset.commit.verify import Verdict


def verify(
    folder: Annotated[Path | None, Parameter(name="DIR", help="A data set (default: the last one in the current folder).")] = None,
    /,
    *,
    threads: Annotated[WholeNumber, Parameter(help="Maximum number of processes; 0: one per core.")] = 0,
) -> int:
    """Verify the SHA-256 checksum of every file of a data set.

    Exit codes: 0, all match; 1, a file is damaged or missing (it is named), or the bake is not finished; 2, the folder is not a data set.
    """
    check_range("--threads", threads, 0, MAX_THREADS)
    url = store_url(folder)
    place = Path() if url is not None else find_data_set(folder, "synpick-warp verify DIR")
    from rich.console import Console

    from synpick_warp.cli.display import CountProgress
    from synpick_warp.dataset.commit.verify import verify as check

    with CountProgress(Console(stderr=True, highlight=False)) as counter:
        verdict = check(place, threads or None, counter.report) if url is None else _check_store(url, counter)
    if verdict.problem:
        print(verdict.problem)
        return EXIT_INCOMPLETE
    episodes = f"{verdict.episodes:,} episode{'' if verdict.episodes == 1 else 's'}"
    print(f"{verdict.files:,} files of {episodes} match their checksums")
    if not verdict.finished:
        print("the data set is not finished: the command that started it resumes it")
    return 0 if verdict.finished else EXIT_INCOMPLETE


def _check_store(url: str, counter: CountProgress) -> Verdict:
    """Verify a data set in an object store."""
    from synpick_warp.cloud.reading import verify_store

    return verify_store(url, counter.report)
