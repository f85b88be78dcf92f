"""Commands `estimate`, which writes pose estimates as a BOP result file, and `eval`, which scores those of one or several methods and
prints the command of the BOP toolkit for BOP's own scores."""

from __future__ import annotations

import math
import re
import shlex
import statistics
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from synpick_warp.cli.options import (
    MAX_THREADS,
    EpisodesOfOption,
    WholeNumber,
    check_new_folder,
    check_output_file,
    check_range,
    find_data_set,
    name_fetched,
    open_split,
)
from synpick_warp.configs.dataset import split_kind
from synpick_warp.errors import ConfigError, DatasetError, OutputError, escape, format_value

if TYPE_CHECKING:
    from synpick_warp.apps.estimation.run import EstimationOptions, EstimationRun
    from synpick_warp.apps.estimation.scenes import ImageSelection
    from synpick_warp.apps.evaluation.figures import Settings
    from synpick_warp.apps.evaluation.results import Evaluation
    from synpick_warp.configs.schema import Config
    from synpick_warp.dataset.reading import DataSet


FILTER = "ema"
"""Exponential moving average: the only filter."""
MAX_FAILURES = 12
"""Objects on a sheet of failures."""
_MAX_VERTICES = 10**7
_FIRST_SENSOR = "awk -F, -v OFS=, 'NR == 1 || $1 %% %d == 0 { if (NR > 1) $1 /= %d; print }'"
"""Command that keeps results of the first of several sensors, and replaces a camera's scene id by the episode's."""
_TRACK = re.compile(r"([0-9]{1,9}):([0-9]{1,9})")


DataOption = Annotated[
    Path | None, Parameter(name="--data", help="A data set in the format bop or shards (default: synpick-data in the current folder).")
]
PlotsOption = Annotated[
    Path | None,
    Parameter(help="New or empty folder for pictures: recall, error by visibility and speed, trajectory, sweep of alpha, worst estimates."),
]


def evaluate(
    data: DataOption = None,
    *,
    results: Annotated[
        list[Path],
        Parameter(negative=(), consume_multiple=True, help="BOP result files, one per method; methods stand side by side in the table."),
    ],
    format_: Annotated[str, Parameter(name="--format", help="text, latex, csv or json; csv and json have both conventions.")] = "text",
    out: Annotated[Path | None, Parameter(help="File to write (default: the standard output).")] = None,
    visib_min: Annotated[float, Parameter(help="Smallest visible fraction of an instance that is to be found, from 0 to 1.")] = 0.1,
    convention: Annotated[str, Parameter(help="Area under the curve in text and LaTeX: exact, or vocap (PoseCNN's).")] = "exact",
    top: Annotated[
        WholeNumber, Parameter(help="Estimates that count per image and object, by score; -1: as many as instances to be found; 0: all.")
    ] = -1,
    vertices: Annotated[
        WholeNumber,
        Parameter(help="Vertices of a model that errors are averaged over; 0: all. 1000 is faster; ADD-S comes out about one point lower."),
    ] = 0,
    targets: Annotated[
        Path | None, Parameter(help="Score only images and objects of this list, such as estimate writes or BOP's test_targets_bop19.json.")
    ] = None,
    split: EpisodesOfOption = None,
    filter_: Annotated[
        str | None,
        Parameter(name="--filter", help="ema: score each method a second time, through the tracking filter of the SynPick paper."),
    ] = None,
    alpha: Annotated[float | None, Parameter(help="Weight of the new estimate in --filter ema, above 0, at most 1 (default 0.05).")] = None,
    plots: PlotsOption = None,
    track: Annotated[
        str | None, Parameter(help="SCENE:INSTANCE of the trajectory in --plots (default: the one that moves farthest).")
    ] = None,
) -> int:
    """Score pose estimates: AUC of ADD, ADD-S and ADD(-S) to 0.1 m, per object, mode, camera, visibility and speed.

    Instances without an estimate count as missed. BOP's own scores come from the BOP toolkit, by the command that is printed.
    """
    check_options(results, format_, out, visib_min, convention, top, vertices)
    data = find_data_set(data, "synpick-warp eval DIR")
    if out is not None:
        check_output_file(out, "--out", data, [*results, *([] if targets is None else [targets])])
    if plots is not None:
        check_output_file(plots, "--plots", data, is_folder=True)
    weight, chosen = check_filter(filter_, alpha), check_plots(plots, track)
    from synpick_warp.apps.evaluation.figures import Settings, write_figures
    from synpick_warp.apps.evaluation.results import score_files
    from synpick_warp.apps.evaluation.tables import render
    from synpick_warp.dataset.reading import open_data_set

    data_set = open_data_set(data) if split is None else open_data_set(data).split(split)
    scored = score_files(
        data_set, results, visib_min, top, vertices, weight, targets, remark=lambda line: print(escape(line), file=sys.stderr)
    )
    pictures = {} if plots is None else draw_pictures(data_set, scored, Settings(scored.models, visib_min, top), chosen)
    show_table(render(scored.rows, scored.truth, scored.scores, format_, convention), out, end="\n" if format_ == "text" else "")
    # What does not mix with a table for a program.
    stream = sys.stdout if format_ == "text" or out is not None else sys.stderr
    for path in () if plots is None else write_figures(plots, pictures):
        print(f"picture: {escape(str(path))}", file=stream)
    print(toolkit_command(data_set, results, targets), file=stream)
    return 0


def show_table(table: str, out: Path | None, end: str) -> None:
    """Print a table, or write it into a file."""
    from synpick_warp.exporters.writing.files import output_errors, write_atomically

    if out is None:
        print(table, end=end)
        return
    with output_errors(out):
        write_atomically(out, table.encode("utf-8"))
    print(f"table: {escape(str(out))}")


def draw_pictures(data_set: DataSet, scored: Evaluation, settings: Settings, track: tuple[int, int] | None) -> dict[str, bytes]:
    """File name -> PNG file: the figures, and a sheet of the worst estimate of each object for each method, if there are images for it."""
    from synpick_warp.apps.evaluation.figures import draw_figures, file_names
    from synpick_warp.apps.evaluation.results import object_names
    from synpick_warp.exporters.writing.png import encode_png
    from synpick_warp.system.hardware.device import pick_device

    attempts = {index: [int(attempt["frame"]) for attempt in data_set[index].attempts] for index in data_set if data_set.has_store}
    figures = draw_figures(scored.truth, scored.methods, scored.scores, settings, track, attempts)
    # Not before: the simulator's libraries crash without memory, where the charts' library has an error.
    from synpick_warp.apps.estimation.failures import draw_failures, find_failures
    from synpick_warp.apps.estimation.run import read_object_models

    truth, by_name = scored.truth, {each.name: each for each in scored.scores}
    sheets, objects = {}, object_names(data_set)
    for method, name in zip(scored.methods, file_names([method.name for method in scored.methods]), strict=True):
        failures = find_failures(truth, by_name[method.name], method.poses, MAX_FAILURES)
        models = read_object_models(data_set.folder, [int(truth.poses.object_id[each.truth]) for each in failures])
        try:
            sheet = draw_failures(data_set, truth, method.poses, failures, models, objects, pick_device("auto"))
        except DatasetError as error:
            print(f"no pictures of the worst estimates: {error}", file=sys.stderr)
            return figures
        sheets[f"failures_{name}.png"] = encode_png(sheet)
    return figures | sheets


def check_options(
    results: Sequence[Path], style: str, out: Path | None, visib_min: float, convention: str, top: int, vertices: int
) -> None:
    """Check the options before anything is read; raises ConfigError, or OutputError if `--out` is no file in an existing folder."""
    from synpick_warp.apps.evaluation.errors import CONVENTIONS
    from synpick_warp.apps.evaluation.tables import FORMATS

    for option, value, allowed in (("--format", style, FORMATS), ("--convention", convention, CONVENTIONS)):
        if value not in allowed:
            raise ConfigError(f"{option} is {format_value(value)}; allowed: {', '.join(allowed)}")
    if not results:
        raise ConfigError("--results has no value; name BOP result files, such as those that estimate writes")
    check_range("--visib-min", visib_min, 0, 1)
    if not -1 <= top <= 2**31 - 1:
        raise ConfigError(f"--top is {top}; allowed: -1 for as many as instances, 0 for all, or a number of estimates")
    if not 0 <= vertices <= _MAX_VERTICES:
        raise ConfigError(f"--vertices is {vertices}; allowed: 0 for all, to {_MAX_VERTICES}")
    if out is not None and (out.is_dir() or not out.absolute().parent.is_dir()):
        raise OutputError(f"--out is {out}; allowed: a file in an existing folder")


def check_filter(name: str | None, alpha: float | None) -> float | None:
    """Weight of the new estimate of `--filter` and `--alpha`, None: no filter; raises ConfigError."""
    from synpick_warp.apps.evaluation.tracking import PAPER_ALPHAS, check_alpha

    if name not in (None, FILTER):
        raise ConfigError(f"--filter is {format_value(name)}; allowed: {FILTER}")
    if name is None and alpha is not None:
        raise ConfigError(f"--alpha is {alpha:g}, but there is no filter; add --filter ema")
    alpha = PAPER_ALPHAS[0] if alpha is None else alpha
    check_alpha(alpha)
    return None if name is None else alpha


def check_plots(folder: Path | None, track: str | None) -> tuple[int, int] | None:
    """Scene and instance of `--track`, None: to be chosen; raises ConfigError, or OutputError if the folder is neither new nor empty."""
    if folder is not None:
        check_new_folder(folder, "--plots")
    if track is None:
        return None
    match = _TRACK.fullmatch(track)
    if match is None:
        raise ConfigError(f"--track is {format_value(track)}; allowed: SCENE:INSTANCE, such as 3:12")
    if folder is None:
        raise ConfigError(f"--track is {track}, but there are no plots; add --plots DIR")
    return int(match[1]), int(match[2])


def toolkit_name(data_set: DataSet) -> str:
    """Name of a data set in the BOP toolkit: lower-case letters and digits of its folder's."""
    return re.sub("[^A-Za-z0-9]", "", data_set.folder.absolute().name).lower() or "synpick"


def toolkit_ending(data_set: DataSet) -> str:
    """Data set and split as in the names of BOP result files, such as "synpickdata-train-pbr"."""
    folders = tuple(data_set.split_folders.values())
    split, _, kind = next((name for name in folders if split_kind(name) == "test"), folders[0]).partition("_")
    return f"{toolkit_name(data_set)}-{split}{f'-{kind}' if kind else ''}"


def toolkit_command(data_set: DataSet, results: Sequence[Path], targets: Path | None = None) -> str:
    """Command that computes BOP's scores (VSD, MSSD, MSPD), with comments about names that the toolkit needs otherwise.

    A target list replaces that of the data set. For several sensors, results of the first one get the data set's scene ids, and VSD, which
    the toolkit does not compute, is left out.
    """
    cameras = len(data_set.sensors)
    folder = data_set.folder.absolute()
    if (url := name_fetched(str(folder))) != str(folder):
        return escape(f"# BOP scores by the BOP toolkit need a copy of {url} on this machine, of which eval prints the command")
    name, ending = toolkit_name(data_set), toolkit_ending(data_set)
    lines = [f"# BOP scores by the BOP toolkit, once `{name}` is in its dataset_params.py:"]
    if name != folder.name:
        lines.append(f"ln -sfn {shlex.quote(str(folder))} {shlex.quote(str(folder.parent / name))}")
    place = results[0].absolute().parent
    files: list[str] = []
    for path in results:
        file = path.name if path.absolute().parent == place else str(path.absolute())
        if cameras or not re.fullmatch(rf"[^_.-]+_{re.escape(ending)}(_[^.]*)?\.csv", path.name):
            method = re.sub("[^A-Za-z0-9]", "", path.stem) or "method"
            file = f"{method}_{ending}.csv"
            while file in files:
                method += "B"
                file = f"{method}_{ending}.csv"
            source, target = shlex.quote(str(path.absolute())), shlex.quote(str(place / file))
            lines.append(f"{_FIRST_SENSOR % (cameras, cameras)} {source} > {target}" if cameras else f"cp {source} {target}")
        files.append(file)
    where, year = shlex.quote(str(place)), "24" if cameras else "19"
    listed = f"test_targets_bop{year}.json" if targets is None else shlex.quote(str(targets.absolute()))
    lines.append(
        f"BOP_PATH={shlex.quote(str(folder.parent))} python scripts/eval_bop{year}_pose.py --results_path={where} --eval_path={where}"
        f" --result_filenames={shlex.quote(','.join(files))} --targets_filename={listed}"
    )
    return "\n".join(map(escape, lines))


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
    modes: Annotated[str | None, Parameter(help="Only episodes of these modes: pick, target, move, still; joined by commas.")] = None,
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


def write_gap(data: Path, out: Path, split: str | None, settings: Config) -> int:
    """Write twins of a data set, or of one split, and print how its objects look in both; returns the exit code."""
    from synpick_warp.apps.evaluation.twins import RECORD, Appearance, average, write_twins
    from synpick_warp.cli.display import count_on_stderr

    data = find_data_set(data, "synpick-warp gap DIR")
    check_new_folder(out, "--out")
    check_output_file(out, "--out", data, is_folder=True)
    with count_on_stderr() as counter:
        found = write_twins(open_split(data, split), out, settings, counter.report, lambda line: print(escape(line), file=sys.stderr))
    scores, means, none = ("appearance", "geometry", "score"), average(found), Appearance(*[math.nan] * len(Appearance._fields))
    print("obj_id", *(f"{name:>16}" for name in Appearance._fields), *(f"{name:>10}" for name in scores), "  (image, twin; likeness)")
    for row in means:
        pairs = (f"{real:>9.3f} {twin:>6.3f}" for real, twin in zip(row.image or none, row.twin or none, strict=True))
        print(f"{row.obj_id:>6}", *pairs, *(f"{getattr(row, name):>10.3f}" for name in scores))
    total = {name: statistics.fmean(getattr(row, name) for row in means) for name in scores}
    print(f"likeness, mean of the objects: {total['score']:.3f} (appearance {total['appearance']:.3f}, geometry {total['geometry']:.3f})")
    print(f"twins: {escape(str(out))}, likeness by image in {RECORD}; the scores of one network on both differ by what appearance costs")
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
