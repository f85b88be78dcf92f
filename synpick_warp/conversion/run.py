"""Run of a conversion: output folder, processes, episodes, commits, indices; resumed by running it again."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from synpick_warp.codes import Ending
from synpick_warp.conversion.converters import Converters, check_formats, check_trajectories
from synpick_warp.conversion.source import Source
from synpick_warp.dataset.writing import OutputFolder, finalize_data_set
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.registry import load_exporter_classes
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.system.cores import count_cores

AHEAD = 2
"""Episodes in work for each process: enough to keep all busy, few enough to need little memory and disk space."""


class Converted(NamedTuple):
    """Result of a conversion."""

    episodes: int
    """Episodes of the converted data set."""
    resumed: int
    """Those of earlier runs."""


def convert(folder: Path, out: Path, formats: Sequence[str], processes: int, report: Callable[[str, int, int], None]) -> Converted:
    """Convert the committed episodes of a data set to other formats, into a data set of its own.

    Args:
        folder: The data set.
        out: Folder of the converted one: new, empty, or of an interrupted conversion.
        formats: Names of formats.
        processes: Number of processes; 0: one per core.
        report: Observer: unit, number done, total.

    Raises:
        ConfigError: A format cannot be converted to, or `out` was started with other settings.
        DatasetError: The source is no data set, is damaged, or lacks what a format needs.
        OutputError: A file cannot be written.
    """
    source = Source(folder)
    check_formats(formats, source.config, folder)
    check_trajectories(formats, source)
    _check_apart(folder, out)
    config = dataclasses.replace(source.config, bake=dataclasses.replace(source.config.bake, formats=tuple(formats)))
    classes = load_exporter_classes(formats)
    with OutputFolder(out, config, source.episodes) as output:
        resumed = len(output.committed)
        if output.is_finished:
            return Converted(resumed, resumed)
        with WriterPool(processes or count_cores(), 0, output.lock) as pool:
            converters = Converters(source, out, config, pool)
            output.prepare(converters, source.inputs, pool)
            _convert_episodes(source, output, converters, pool, report)
            pool.wait()
            finalize_data_set(out, config, classes, pool)
    return Converted(len(source.episodes), resumed)


def _convert_episodes(
    source: Source, output: OutputFolder, converters: Converters, pool: WriterPool, report: Callable[[str, int, int], None]
) -> None:
    total, working = len(output.episodes), [0]
    done = [len(output.committed)]
    limit = AHEAD * max(1, len(pool.pids()))

    def commit(end) -> None:
        output.commit(converters, pool, end)
        working[0] -= 1
        done[0] += 1
        report("episodes", done[0], total)

    for index in output.remaining:
        pool.wait_until(lambda: working[0] < limit)
        episode = source.episode(index)
        working[0] += 1
        if Ending(episode.end.ending).delivers:
            converters.convert(episode, partial(commit, episode.end))
        else:
            commit(episode.end)


def _check_apart(folder: Path, out: Path) -> None:
    """Check that neither folder holds the other."""
    try:
        source, target = folder.resolve(), out.resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise DatasetError(f"the data set or --out cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if target.is_relative_to(source) or source.is_relative_to(target):
        raise DatasetError(f"--out is {out}, which is, holds or lies in {folder}; name a folder outside of it")
