"""Command `estimate`: estimate the poses of a data set's objects, and write them as a BOP result file."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from synpick_warp.cli.folders import check_output_file, find_data_set
from synpick_warp.cli.options import MAX_THREADS, EpisodesOfOption, WholeNumber, check_range
from synpick_warp.errors import ConfigError, OutputError, escape, format_value

if TYPE_CHECKING:
    from synpick_warp.apps.estimation.run import EstimationOptions, EstimationRun
    from synpick_warp.apps.estimation.scenes import ImageSelection
    from synpick_warp.dataset.reading import DataSet

DEFAULT_VISIBILITY = 0.1
"""As in `eval` and in BOP."""
_MAX_SEED = 2**63 - 1
_MAX_INDEX = 2**31 - 1
_RANGE = re.compile(r"\s*([0-9]{1,9})\s*(?:-\s*([0-9]{1,9})\s*)?")
_MAX_RANGE = 10**6
"""Most indices of an option: more are a mistake."""


def estimate(
    data: Annotated[
        Path | None,
        Parameter(
            name="--data",
            help="A data set in the format bop or shards, with masks (bop.masks; default: synpick-data in the current folder).",
        ),
    ] = None,
    *,
    out: Annotated[
        Path | None,
        Parameter(
            help="BOP result file to write; an existing file is replaced (default METHOD_DATASET-SPLIT.csv in the current folder, where "
            "DATASET is the folder's name in lower-case letters and digits)."
        ),
    ] = None,
    method: Annotated[
        str,
        Parameter(
            help="single: each frame by itself; refine: from the truth moved by 2 cm and turned by 15°; track: from the truth in an"
            " instance's first frame on, without restart."
        ),
    ],
    depth: Annotated[str, Parameter(help="Depth images: clean, or sensor for the layer depth_sensor.")] = "clean",
    every: Annotated[
        WholeNumber | None, Parameter(help="Every n-th frame of a scene, from the first one (default 20; track takes every frame).")
    ] = None,
    targets: Annotated[
        Path | None, Parameter(help="Images and objects to estimate, as in BOP's test_targets_bop19.json; instead of --every.")
    ] = None,
    modes: Annotated[str | None, Parameter(help="Only episodes of these modes: pick, target, move; joined by commas.")] = None,
    cameras: Annotated[str | None, Parameter(help="Only these cameras, such as 0,2.")] = None,
    episodes: Annotated[str | None, Parameter(help="Only these episodes, such as 0-9,12.")] = None,
    split: EpisodesOfOption = None,
    visib_min: Annotated[float, Parameter(help="Smallest visible fraction of an instance that is estimated, from 0 to 1.")] = (
        DEFAULT_VISIBILITY
    ),
    seed: Annotated[WholeNumber, Parameter(help="Seed of disturbed starts.")] = 0,
    threads: Annotated[WholeNumber, Parameter(help="Threads; 0: one per core.")] = 0,
) -> int:
    """Estimate object poses by generalized ICP (small_gicp) from depth and visible masks, and write a BOP result file for `eval`.

    Unless all images of the data set are estimated, their list is written beside it as OUT-targets.json, for `eval --targets`.
    """
    from synpick_warp.cli.commands.evaluate import toolkit_ending
    from synpick_warp.dataset.reading import open_data_set

    selection = make_selection(method, every, targets, modes, cameras, episodes)
    options = make_options(method, depth, visib_min, seed, threads)
    data = find_data_set(data, "synpick-warp estimate DIR")
    whole = open_data_set(data)
    out = Path(f"{method}_{toolkit_ending(whole)}.csv") if out is None else out
    check_output(out, selection)
    check_output_file(out, "--out", data)
    run, listed = run_method(whole if split is None else whole.split(split), selection, options, out, part=split is not None)
    rate = f"{len(run.poses) / max(run.wall, 1e-9):,.0f} poses/s"
    print(f"{run.views:,} views, {len(run.poses):,} poses in {run.wall:.1f} s ({rate})", f"results: {escape(str(out))}", sep="\n")
    if listed is not None:
        print(f"targets: {escape(str(listed))}; eval --targets {escape(str(listed))}")
    return 0


def run_method(
    data_set: DataSet, selection: ImageSelection, options: EstimationOptions, out: Path, *, part: bool
) -> tuple[EstimationRun, Path | None]:
    """Estimate in a data set, or a `part` of one, and write the files; returns the run, and the file of targets if it was written."""
    from synpick_warp.apps.estimation.run import Aligner, list_targets, read_object_models, read_scenes, run_estimation
    from synpick_warp.apps.estimation.scenes import plan_scenes
    from synpick_warp.apps.evaluation.results import encode_targets, in_layout, targets_file, write_results
    from synpick_warp.cli.display import CountProgress, make_console
    from synpick_warp.exporters.writing.files import output_errors, write_atomically

    if selection.targets is not None:
        selection = replace(selection, targets=selection.targets.in_classic_layout(data_set.sensors))
    plans, complete = plan_scenes(data_set, selection)
    with CountProgress(make_console()) as counter:
        scenes = read_scenes(data_set, plans, options, selection.targets, counter.report)
        wanted = sorted({int(object_id) for scene in scenes for object_id in scene.truth.object_id[scene.asked]})
        run = run_estimation(scenes, Aligner(read_object_models(data_set.folder, wanted)), options, counter.report)
    listed = None if complete and not part else targets_file(out)
    if listed is not None:
        with output_errors(listed):
            write_atomically(listed, encode_targets(in_layout(list_targets(scenes), data_set.sensors)))
    write_results(out, run.poses)
    return run, listed


def make_selection(
    method: str, every: int | None, targets: Path | None, modes: str | None, cameras: str | None, episodes: str | None
) -> ImageSelection:
    """Make the selection of images from the command's options; raises ConfigError, or ResultError if the target list cannot be read."""
    from synpick_warp.apps.estimation.run import METHODS, SPARSE, TRACK
    from synpick_warp.apps.estimation.scenes import ImageSelection
    from synpick_warp.apps.evaluation.results import read_targets

    if method not in METHODS:
        raise ConfigError(f"--method is {format_value(method)}; allowed: {', '.join(METHODS)}")
    if every is not None and not 1 <= every <= _MAX_INDEX:
        raise ConfigError(f"--every is {every}; allowed: 1 for all frames, or more")
    if method == TRACK and (targets is not None or every not in (None, 1)):
        raise ConfigError("--method track takes every frame, so neither --every nor --targets; `eval --targets` scores some of them")
    if targets is not None and every is not None:
        raise ConfigError("--every and --targets both choose images; drop one of them")
    return ImageSelection(
        modes=None if modes is None else tuple(name.strip() for name in modes.split(",")),
        cameras=None if cameras is None else parse_indices("--cameras", cameras),
        episodes=None if episodes is None else parse_indices("--episodes", episodes),
        every=1 if method == TRACK or targets is not None else SPARSE if every is None else every,
        targets=None if targets is None else read_targets(targets),
    )


def make_options(method: str, depth: str, visib_min: float, seed: int, threads: int) -> EstimationOptions:
    """Make the options of the estimation from the command's options; raises ConfigError."""
    from synpick_warp.apps.estimation.run import DEPTHS, EstimationOptions

    if depth not in DEPTHS:
        raise ConfigError(f"--depth is {format_value(depth)}; allowed: {', '.join(DEPTHS)}")
    check_range("--visib-min", visib_min, 0, 1)
    check_range("--seed", seed, 0, _MAX_SEED)
    check_range("--threads", threads, 0, MAX_THREADS)
    given = {"threads": threads} if threads else {}
    return EstimationOptions(method, depth, visib_min, seed, **given)


def parse_indices(option: str, text: str) -> tuple[int, ...]:
    """Parse "0-2,5" into 0, 1, 2, 5; raises ConfigError for another form, or too many."""
    indices: set[int] = set()
    for part in text.split(","):
        match = _RANGE.fullmatch(part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not 0 <= last - first < _MAX_RANGE:
            raise ConfigError(f"{option} is {format_value(text)}; allowed: indices and ranges joined by commas, such as 0-9,12")
        indices.update(range(first, last + 1))
    return tuple(sorted(indices))


def check_output(out: Path, selection: ImageSelection) -> None:
    """Raise OutputError if the folder of the output does not exist, it or the list beside it is a folder, or it would replace the list that
    is read."""
    from synpick_warp.apps.evaluation.results import targets_file

    if out.is_dir() or not out.absolute().parent.is_dir() or targets_file(out).is_dir():
        raise OutputError(f"--out is {out}; allowed: a file in an existing folder")
    given = selection.targets
    if given is not None and given.path.resolve() in (out.resolve(), targets_file(out).resolve()):
        raise OutputError(f"--out is {out}, which would replace {given.path}; name another file")
