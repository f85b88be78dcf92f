"""Run of a conversion: output folder, processes, episodes, commits, indices; resumed by running it again."""

from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from synpick_warp.apps.conversion.foreign import convert_foreign
from synpick_warp.apps.conversion.source import ConversionSource, StoredContext
from synpick_warp.codes import Ending
from synpick_warp.configs.dataset import ExportSettings
from synpick_warp.configs.schema import CLASSIC
from synpick_warp.dataset.commit.writing import OutputFolder, commit_episode, finalize_data_set
from synpick_warp.dataset.reading import open_data_set
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.formats import Content, contents_of, convertible, find_format, format_names
from synpick_warp.exporters.registry import Exporters, load_exporter_classes
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.progress import Report
from synpick_warp.views.frames import EpisodeEnd

AHEAD = 2
"""Episodes in work for each process: enough to keep all busy, few enough to need little memory and disk space."""


class Converted(NamedTuple):
    """Result of a conversion: numbers of episodes of the converted data set and of those that earlier runs had converted, and a remark."""

    episodes: int
    resumed: int
    remark: str = ""
    """What was made that the source does not have."""


def convert(folder: Path, out: Path, formats: Sequence[str], processes: int, report: Report, split: str | None = None) -> Converted:
    """Convert the committed episodes of a data set to other formats, into a data set of its own; the scenes of one from another source. As
    `synpick_warp.convert`, whose errors are ConfigError if a format cannot be converted to, or `out` was started with other settings,
    DatasetError if the source is no data set, is damaged, or lacks what a format needs, and OutputError if a file cannot be written."""
    data = open_data_set(folder)
    if data.found is not None:
        _check_apart(folder, out)
        count, remark = convert_foreign(data if split is None else data.split(split), out, formats, processes, report)
        return Converted(count, 0, remark)
    if split is not None:
        raise ConfigError("--split is for data sets from other sources; those of synpick-warp bake are converted as a whole")
    source = ConversionSource(folder)
    check_formats(formats, source.config.bop.layout, source.config.bake.formats, folder)
    contents: set[Content] = {content for name in formats for content in contents_of(name, source.config.bop)}
    source.check_contents(contents)
    _check_apart(folder, out)
    config = source.config.with_values({"bake.formats": tuple(formats)})
    classes = load_exporter_classes(formats)
    with OutputFolder(out, config, source.episodes) as output:
        resumed = len(output.committed)
        if output.is_finished:
            return Converted(resumed, resumed)
        with WriterPool(processes or count_cores(), 0, output.lock) as pool:
            settings = ExportSettings.of(config)
            exporters = Exporters(classes, StoredContext(source, out, settings, pool))
            output.prepare(exporters, source.inputs, pool)
            _convert_episodes(source, output, exporters, pool, contents, report)
            pool.wait()
            exporters.close()
            finalize_data_set(out, settings, classes, pool)
    return Converted(len(source.episodes), resumed)


def _convert_episodes(
    source: ConversionSource, output: OutputFolder, exporters: Exporters, pool: WriterPool, contents: Collection[Content], report: Report
) -> None:
    """Pass what formats are made of, the views and ticks of all remaining episodes, to their exporters."""
    total, working = len(output.episodes), [0]
    done = [len(output.committed)]
    limit = AHEAD * max(1, len(pool.pids()))

    def commit(end: EpisodeEnd) -> None:
        commit_episode(output.out, exporters, pool, end)
        working[0] -= 1
        done[0] += 1
        report("episodes", done[0], total)

    for index in output.remaining:
        pool.wait_until(lambda: working[0] < limit)
        end = source.episode_end(index)
        working[0] += 1
        if Ending(end.ending).delivers:
            if "views" in contents:
                exporters.write_stored(index, source.scenes(end))
                if (picks := source.picks(index)) is not None:
                    exporters.write_picks(picks)
            for batch in source.ticks(end) if "poses" in contents else ():
                exporters.write_ticks(batch)
        exporters.end_episode(end, partial(commit, end))


def check_formats(names: Sequence[str], layout: str, present: Collection[str], folder: Path) -> None:
    """Raise ConfigError unless a data set with this `bop.layout` and the formats `present` can be converted to formats of these names: they
    are known, follow from others, and are not there already."""
    if layout != CLASSIC:
        raise ConfigError(f'{folder} has bop.layout = "{layout}", which convert does not read; bake the other formats')
    for name in names:
        if name not in convertible() or find_format(name).sources is None:
            why = f"; no other format has the physics of {name}" if name in format_names() else ""
            raise ConfigError(f"--to names {name}; allowed: {', '.join(convertible())}{why}")
        if name in present:
            raise ConfigError(f"--to names {name}, which {folder} has already; copy the folder")


def _check_apart(folder: Path, out: Path) -> None:
    """Raise DatasetError if the data set and the output folder are the same, or one lies in the other."""
    try:
        source, target = folder.resolve(), out.resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise DatasetError(f"the data set or --out cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if target.is_relative_to(source) or source.is_relative_to(target):
        raise DatasetError(f"--out is {out}, which is, holds or lies in {folder}; name a folder outside of it")
