"""Command line of synpick-warp: its subcommands and their options. User errors: one line, exit code 2."""

import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import cyclopts
from cyclopts import App, Parameter

from synpick_warp._version import __version__
from synpick_warp.cli import options
from synpick_warp.cli.commands.data_sets import convert, prove, show_statistics, validate, verify, write_page
from synpick_warp.cli.commands.evaluate import estimate, evaluate
from synpick_warp.cli.commands.new_cell import new_cell
from synpick_warp.cli.commands.pictures import explain, preview
from synpick_warp.cli.options import DEFAULT_NAME, check_output_file, drop_fetched, name_fetched
from synpick_warp.cli.streams import StreamError, describe_fault, flush_output, safe_streams
from synpick_warp.configs.check import describe_allowed
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.fields import PATH_RULE, settings_of
from synpick_warp.configs.files import load
from synpick_warp.configs.schema import Config
from synpick_warp.errors import CatalogError, ConfigError, LightError, SynpickError
from synpick_warp.scenes.bin_meshes.loading import load_settings
from synpick_warp.system.inputs.urls import resolve_word, store_url
from synpick_warp.system.interpreter import collection_paused
from synpick_warp.system.processes.interrupt import KeptInterrupt, raising_sigterm
from synpick_warp.system.processes.isolation import start_server

if TYPE_CHECKING:
    from synpick_warp.factory.episodes import BakeSummary

NAME = "synpick-warp"
EXIT_MISTAKE = 2
EXIT_INTERRUPTED = 130
"""128 + SIGINT, the shell convention."""
EXIT_PIPE = 141
"""128 + SIGPIPE: the reader of the output has closed it."""
EXIT_SIGNAL = 128
"""Added to a signal's number, the shell convention."""
MAX_LISTED = 10
"""Maximum number of indices that a message lists."""

app = App(
    name=NAME,
    help="Generate data sets for dynamic bin picking: simulated totes, rendered RGB-D, exact 6D ground truth.",
    version=__version__,
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)


def _help(key: str, extra: str = "") -> str:
    """Help text of a setting from its declaration: meaning, range, default, unit and key."""
    section, name = key.split(".")
    item = settings_of(load.sections()[section])[name]
    unit = f" {item.unit}" if item.unit else ""
    default = "x".join(map(str, item.default)) if isinstance(item.default, tuple) else str(item.default) or "empty"
    rule = "" if item.kind is str and not item.choices else f"{describe_allowed(item)}; "
    return f"{item.doc}{extra} ({rule}default {default}{unit}; {key})"


ConfigOption = Annotated[
    str | None, Parameter(name="--config", help=f"Preset ({', '.join(load.preset_names())}) or .toml file (default {load.DEFAULT_PRESET}).")
]
SetOption = Annotated[
    list[str] | None,
    Parameter(
        name="--set",
        negative=(),
        help=f"Any other setting, as section.key=value; may be repeated. `{NAME} config` prints all, with units, ranges and values.",
    ),
]
WorldsOption = Annotated[options.Count | None, Parameter(help=_help("bake.worlds", " auto is 0."))]
ResolutionOption = Annotated[str | None, Parameter(help=_help("cameras.resolution", " As WIDTHxHEIGHT."))]
DevicesOption = Annotated[
    str | None,
    Parameter(
        help="Several devices with a process each, joined by commas: GPUs such as cuda:0,cuda:1, or cpu once per process, or all: every "
        "GPU, or without one a process per CPU core. They fill one data set, with the bytes of one device; others can resume it."
    ),
]
OutOption = Annotated[
    Path | None,
    Parameter(
        help="Output folder: new, empty, or of an interrupted bake with the same settings "
        f"(default {DEFAULT_NAME} in the current folder). Or a prefix in an object store, such as s3://bucket/prefix (pip install "
        "'synpick-warp[cloud]')."
    ),
]
DeviceOption = Annotated[str | None, Parameter(help=_help("bake.device"))]


ShardOption = Annotated[
    str | None, Parameter(help="i/n: only episodes with index % n == i, such as 0/4; combine the data sets with merge.")
]
ClaimOption = Annotated[
    bool,
    Parameter(
        negative=(), help="Be one of any number of equal workers, which share the episodes of a prefix in an object store among them."
    ),
]
EngineOption = Annotated[
    str | None,
    Parameter(
        help="ray: claiming workers, one a GPU, or a CPU core with --device cpu, on a Ray cluster of this machine, or that of RAY_ADDRESS. "
        "ray://HOST:PORT: by a cluster's Ray Client. pip install 'synpick-warp[ray]'."
    ),
]
WorkersOption = Annotated[options.WholeNumber, Parameter(help="Workers of --engine; 0: as many as the cluster has room for at any time.")]
PriceOption = Annotated[
    float, Parameter(help="Price an hour of a worker of --engine or --claim --devices: the progress shows the cost so far.")
]
DryRunOption = Annotated[bool, Parameter(negative=(), help="Bake nothing: print the expected views, size on disk, memory and time.")]
SplitOption = Annotated[
    str | None,
    Parameter(help="Only these splits of the settings, such as train or train,test (default: all of a file's; a preset's must be named)."),
]


@app.command
def bake(
    *,
    out: OutOption = None,
    config: ConfigOption = None,
    worlds: WorldsOption = None,
    episodes: Annotated[options.WholeNumber | None, Parameter(help=_help("bake.episodes"))] = None,
    mode: Annotated[str | None, Parameter(help=_help("bake.mode", " Weights of mixed: --set bake.mix=[pick, target, move]."))] = None,
    seed: Annotated[options.WholeNumber | None, Parameter(help=_help("bake.seed"))] = None,
    device: DeviceOption = None,
    devices: DevicesOption = None,
    models: Annotated[str | None, Parameter(help=_help("bake.models"))] = None,
    lights: Annotated[str | None, Parameter(help=_help("bake.lights"))] = None,
    resolution: ResolutionOption = None,
    writers: Annotated[options.Count | None, Parameter(help=_help("bake.writers", " auto is 0."))] = None,
    formats: Annotated[str | None, Parameter(help=_help("bake.formats", " Joined by commas."))] = None,
    shard: ShardOption = None,
    split: SplitOption = None,
    claim: ClaimOption = False,
    engine: EngineOption = None,
    workers: WorkersOption = 0,
    price: PriceOption = 0.0,
    set_: SetOption = None,
    profile: Annotated[
        bool, Parameter(negative=(), help="Print the time of each stage at the end, and write a Chrome trace (see --profile-out).")
    ] = False,
    profile_out: Annotated[
        Path | None, Parameter(help="Trace file of --profile, for ui.perfetto.dev (default: OUT-profile.json beside the data set).")
    ] = None,
    dry_run: DryRunOption = False,
) -> int:
    """Simulate, render and write a data set. After an interruption, the same command resumes with the remaining episodes.

    Options override the file, the file overrides the preset. Ctrl-C stops after the current tick, a second Ctrl-C at once.

    Exit codes: 0, all episodes were delivered; 1, some were given up; 2, an error in options, files or folders; 130 and 143, interrupted.
    """
    given = {
        "bake.worlds": worlds,
        "bake.episodes": episodes,
        "bake.mode": mode,
        "bake.seed": seed,
        "bake.device": device,
        "bake.models": models,
        "bake.lights": lights,
        "bake.writers": writers,
        "bake.formats": None if formats is None else [name.strip() for name in formats.split(",")],
    }
    profiles = profile or profile_out is not None
    several, names = options.parse_devices(devices, device, profiles), options.parse_splits(split)
    part = options.parse_shard(shard) if shard is not None else (0, 1)
    resolved = _resolve(config, given, resolution, set_, splits=split is not None)
    planned = DataLayout.of(resolved).plan_shard(names, part, "--shard")
    options.check_store_options(out, claim=claim, shard=shard, profile=profiles)
    options.check_engine_options(engine, workers, price, out, devices or shard, claim)
    if dry_run:
        return _forecast(resolved, out, [episode for split in planned for episode in split])
    out = out or _default_out()
    run = partial(_bake, resolved, out, part, names, several, claim, engine or "", workers, price)
    return _profiled(run, profile_out, out) if profiles else run()


@app.command
def merge(
    *parts: Annotated[Path, Parameter(name="PARTS", help="Data sets that were baked with --shard.")],
    out: Annotated[Path, Parameter(help="Folder of the merged data set: new or empty.")],
) -> int:
    """Merge data sets of --shard into one; files are hard-linked where the file system allows, else copied.

    Exit codes: 0, all episodes are there; 1, some are in no part; 2, the parts do not match.
    """
    from synpick_warp.dataset.commit.merge import merge as merge_parts

    if not parts:
        raise ConfigError("merge needs data sets, and none is named; name the folders that `bake --shard` wrote")
    merged = merge_parts(parts, out)
    print(f"data set: {out}, {merged.episodes:,} episodes", *merged.left_out, sep="\n")
    if merged.missing:
        shown = ", ".join(map(str, merged.missing[:MAX_LISTED])) + (", ..." if len(merged.missing) > MAX_LISTED else "")
        print(f"{len(merged.missing):,} are in no part: {shown}; `bake --out {out}` with the same settings generates them")
    return options.EXIT_INCOMPLETE if merged.missing else 0


@app.command
def doctor(
    *,
    config: ConfigOption = None,
    worlds: WorldsOption = None,
    resolution: ResolutionOption = None,
    device: DeviceOption = None,
    set_: SetOption = None,
    memory: Annotated[bool, Parameter(negative=(), help="Also list the device arrays of a bake with their memory.")] = False,
) -> int:
    """Show device, versions and caches, and whether a bake with these settings fits."""
    resolved = _resolve(config, {"bake.worlds": worlds, "bake.device": device}, resolution, set_)
    from synpick_warp.cli.commands.doctor import print_report

    print_report(resolved, with_arrays=memory)
    return 0


@app.command
def warmup(
    *,
    config: ConfigOption = None,
    mode: Annotated[str | None, Parameter(help=_help("bake.mode"))] = None,
    device: DeviceOption = None,
    models: Annotated[str | None, Parameter(help=_help("bake.models"))] = None,
    lights: Annotated[str | None, Parameter(help=_help("bake.lights"))] = None,
    formats: Annotated[str | None, Parameter(help=_help("bake.formats", " Joined by commas."))] = None,
    resolution: ResolutionOption = None,
    set_: SetOption = None,
) -> int:
    """Compile all kernels of a bake with these settings ahead, and prepare its objects and lights; later bakes find them in the caches."""
    names = None if formats is None else [name.strip() for name in formats.split(",")]
    given = {"bake.mode": mode, "bake.device": device, "bake.models": models, "bake.lights": lights, "bake.formats": names}
    resolved = _resolve(config, given, resolution, set_)
    _check_inputs(resolved.bake.models, resolved.bake.lights)
    from synpick_warp.cli.display import make_console, make_progress
    from synpick_warp.factory.assembly import check_caches, warm_up

    check_caches()

    with make_progress(make_console()) as progress:
        result = warm_up(resolved, progress)
    print(f"ready in {result.seconds:.1f} s: {result.compiled} modules compiled, the others were in the kernel cache")
    return 0


@app.command
def gap(
    folder: Annotated[Path, Parameter(name="DIR", help="A data set in BOP's folders, ours or not: images with poses and models.")],
    /,
    *,
    out: Annotated[Path, Parameter(help="Folder of the twins: new or empty.")],
    split: options.EpisodesOfOption = None,
    config: ConfigOption = None,
    device: DeviceOption = None,
    lights: Annotated[str | None, Parameter(help=_help("bake.lights"))] = None,
    set_: SetOption = None,
) -> int:
    """Render the annotated objects of real images in front of these (twins), as a BOP data set: score a network on both.

    A table compares statistics of the objects in both, and gives their likeness from 0 to 1. All but colour images is linked or copied.
    After an interruption, the same command goes on.
    """
    from synpick_warp.cli.commands.evaluate import write_gap

    given = {"bake.device": device, "bake.lights": lights, "render.table": False}
    return write_gap(folder, out, split, _resolve(config, given, None, set_))


@app.command(name="config")
def show_config(
    *,
    config: ConfigOption = None,
    set_: SetOption = None,
    presets: Annotated[bool, Parameter(negative=(), help="List the presets with their meaning instead.")] = False,
) -> int:
    """Print all settings as TOML with meaning, unit and range: a template for your own file."""
    if presets:
        print(*(f"{name:18}{text}" for name, text in load.describe_presets().items()), sep="\n")
        return 0
    print(load.config_to_toml(_resolve(config, {}, None, set_), comments=True), end="")
    return 0


app.command(new_cell)
app.command(preview)
app.command(explain)
app.command(evaluate, name="eval")
app.command(estimate)
app.command(convert)
app.command(show_statistics, name="stats")
app.command(validate)
app.command(verify)
app.command(prove)
app.command(write_page, name="report")
for _name, _lines in options.EXAMPLES.items():
    app[_name].help_epilogue = "\n".join(["Examples:", "", "```", *(f"{NAME} {line}" for line in _lines), "```"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code. `arguments`: command line without the program's name; None: `sys.argv`."""
    with safe_streams() as output:
        code = _run(sys.argv[1:] if arguments is None else list(arguments))
        flush_output()
        if output.fault is None:
            return code
        if isinstance(output.fault, BrokenPipeError):
            return EXIT_PIPE
        print(f"{NAME}: error: {describe_fault(output.fault)}", file=sys.stderr)
        return EXIT_MISTAKE


def _run(arguments: list[str]) -> int:
    """Run the command line; mistakes are one line on the standard error, except those of the standard output."""
    try:
        with raising_sigterm(), KeptInterrupt():
            return app(list(map(resolve_word, arguments)), exit_on_error=False, print_error=False) or 0
    except StreamError:
        return EXIT_MISTAKE
    except (SynpickError, cyclopts.CycloptsError) as error:
        print(*getattr(error, "__notes__", ()), sep="", end="", file=sys.stderr)  # The traceback of a fault of ours, see `TaskError`.
        said = options.describe_misuse(error) if isinstance(error, cyclopts.CycloptsError) else str(error)
        print(f"{NAME}: error: {options.one_line(name_fetched(said))}", file=sys.stderr)
        return EXIT_MISTAKE
    except KeyboardInterrupt:
        print(f"{NAME}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except Exception as error:
        said = options.describe_limit(error)
        if said is None:
            raise
        print(f"{NAME}: error: {options.one_line(said)}", file=sys.stderr)
        return EXIT_MISTAKE
    finally:
        drop_fetched()


def _resolve(
    config: str | None, given: dict[str, object], resolution: str | None, assignments: list[str] | None, *, splits: bool = False
) -> Config:
    """Resolve settings from file and options; named options override --set."""
    overrides = dict(load.parse_assignment(text) for text in assignments or [])
    overrides |= {key: value for key, value in given.items() if value is not None}
    if resolution is not None:
        overrides["cameras.resolution"] = options.parse_resolution(resolution)
    return load_settings(config, overrides, source=load.COMMAND_LINE, splits=splits)


def check_trace_file(trace: Path, out: Path) -> None:
    """Check that a trace can be written, and not into the data set; raises ConfigError if the file is inside the data set, or its folder
    does not exist, and OutputError if it is inside another data set."""
    if trace.resolve().is_relative_to(out.resolve()):
        raise ConfigError(f"--profile-out is {trace}, inside the data set {out}; name a file outside of it")
    check_output_file(trace, "--profile-out")
    if trace.is_dir() or (trace.parent != out.parent and not trace.parent.is_dir()):
        raise ConfigError(f"--profile-out is {trace}; allowed: a file in an existing folder")


def _profiled(bake: Callable[[], int], named: Path | None, out: Path) -> int:
    """Bake with the profiler on; print the table and write the trace into the named file, or beside the data set."""
    trace = named or out.with_name(f"{out.name}-profile.json")
    check_trace_file(trace, out)
    from synpick_warp.cli.display import make_console, print_profile
    from synpick_warp.exporters.writing.files import output_errors
    from synpick_warp.stages.timing import record

    with record() as recorder:
        code = bake()
    print_profile(make_console(), recorder)
    with output_errors(trace):
        recorder.write_trace(trace)
    print(f"trace: {trace}")
    return code


def _default_out() -> Path:
    """Output folder of a bake without --out, which is printed."""
    print(f"data set: ./{DEFAULT_NAME} (--out names another folder)", flush=True)
    return Path(DEFAULT_NAME)


def _forecast(config: Config, out: Path | None, episodes: Sequence[int]) -> int:
    _check_inputs(config.bake.models, config.bake.lights)
    from synpick_warp.cli.commands.doctor import print_forecast

    return print_forecast(config, out, episodes)


def _check_inputs(models: str, lights: str) -> None:
    """Check that the folders of models and lights exist; raises CatalogError without models, LightError without lights."""
    if models and not os.path.isdir(models):
        raise CatalogError(
            f"there is no models folder {models}; --models takes a folder of BOP models or of PLY, OBJ, glTF, STL or STEP files; "
            f"{PATH_RULE}"
        )
    if lights and not os.path.isdir(lights):
        raise LightError(f"there is no lights folder {lights}; --lights takes a folder of .hdr maps and sIBL sets; {PATH_RULE}")


def _bake(
    config: Config,
    out: Path,
    shard: tuple[int, int],
    splits: Sequence[str],
    devices: Sequence[str],
    claim: bool,
    engine: str,
    workers: int,
    price: float,
) -> int:
    """Check device and folders, which is cheap, then bake: in this process and its children, or by the workers of an engine."""
    if (config.bake.models or config.bake.lights) and not (devices or engine):
        start_server()
    with collection_paused(freezes=True):
        from synpick_warp.cli.display import make_console, make_progress, print_summary
        from synpick_warp.exporters.writing.files import check_output_folder
        from synpick_warp.system.hardware.device import opening_context, pick_device, pick_devices

    own = None if devices or engine else pick_device(config.bake.device)
    if devices:
        pick_devices(devices)
    _check_inputs(config.bake.models, config.bake.lights)
    url = store_url(out)
    if url is None:
        check_output_folder(out)
    bake: Callable[..., BakeSummary]
    remark: object = ""
    with collection_paused(freezes=True), opening_context(own):
        if url is None:
            from synpick_warp.factory.pipeline import run_bake

            bake = partial(run_bake, config, out)
        else:
            from synpick_warp.cloud.workers import Crew, Job, start_bake

            crew = Crew(price)
            remark = crew if engine or price else ""
            bake = partial(start_bake, Job(config, url), claim=claim, engine=engine, workers=workers, crew=crew)

    console = make_console()
    with make_progress(console, remark) as progress:
        summary = bake(progress, shard, splits, devices)
    print_summary(console, summary, url or out)
    if summary.stopped:
        kind = "claimed episodes" if (claim or engine) and not devices else "episodes"
        done = f"{len(summary.episodes)} of {summary.total} {kind} are complete"
        rest = "completes the data set" if len(summary.episodes) == summary.total else "resumes with the others"
        print(f"{NAME}: interrupted: {done}; the same command {rest}", file=sys.stderr)
        return EXIT_SIGNAL + summary.stopped
    delivered = sum(1 for row in summary.episodes if row[2].delivers)
    return 0 if delivered == summary.total else options.EXIT_INCOMPLETE
