"""Report of a data set: reads figures and samples, and writes one HTML file."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from synpick_warp._version import __version__
from synpick_warp.apps.report.charts import make_charts
from synpick_warp.apps.report.explained import DRAWS, PICKS_LEAD, calibration_chart, choose_attempts, make_attempt, picks_section
from synpick_warp.apps.report.findings import WARNING, Figures, Remark, find
from synpick_warp.apps.report.frames import (
    BUDGET,
    SURVEY_VIEWS,
    Album,
    Brightness,
    SampledEpisodes,
    choose_episodes,
    make_frame,
    make_strip,
    measure_brightness,
    read_episodes,
    sample_views,
)
from synpick_warp.apps.report.page import (
    Html,
    Page,
    PageSection,
    changed_settings,
    element,
    findings_list,
    join,
    read_vega,
    render,
    settings_tables,
    statistics_tables,
    summary,
    tiles,
)
from synpick_warp.apps.statistics import Statistics, compute_statistics
from synpick_warp.apps.statistics.picks import find_picks
from synpick_warp.apps.viz.drawing import bin_scale
from synpick_warp.configs.files.load import config_to_toml
from synpick_warp.dataset.commit.manifest import read_manifest
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.exporters.writing.files import output_errors, write_atomically
from synpick_warp.system.inputs.files import make_folder
from synpick_warp.system.progress import Report, ignore_progress

SUFFIXES = (".html", ".htm")
FRAMES = 12
"""Sampled frames on the page."""
MAX_FRAMES = 200


@dataclass(frozen=True)
class Samples:
    """Samples of a data set that the page shows."""

    data: dict[str, list[dict[str, Any]]]
    """Frames, strips and attempts, as the page's scripts expect them."""
    brightness: list[Brightness]
    asked: dict[str, int]
    """Number of frames, strips and attempts that were to be shown; fewer are if the pictures' budget is spent."""


def write_report(
    data_set: DataSet, out: Path, *, frames: int = FRAMES, paper: bool | None = None, threads: int = 0, report: Report | None = None
) -> Path:
    """Write the report of a data set, or of one of its splits.

        write_report(synpick_warp.open("DATA"), Path("report.html"))

    Args:
        out: HTML file to write; its folder is created. A file is replaced, a link never followed.
        frames: Number of sampled frames.
        paper: Whether the paper's numbers stand beside; None: if the objects are the paper's.
        threads, report: As of `compute_statistics`, whose errors are raised.

    Raises ChartError: the charts' library cannot run; OutputError: the file cannot be written."""
    check_out(out)
    read_vega()
    statistics = compute_statistics(data_set, threads=threads, report=report)
    episodes = read_episodes(data_set)
    album = Album()
    samples = take_samples(data_set, statistics, episodes, album, frames, report or ignore_progress)
    versions, remarks = _versions(data_set)
    config = data_set.config if data_set.found is None else None
    figures = Figures(statistics, episodes, samples.brightness, data_set.planned, config, data_set.period)
    findings = [*remarks, *find(figures)]
    findings.sort(key=lambda finding: finding.level != WARNING)
    shown = statistics if (statistics.has_paper_objects if paper is None else paper) else replace(statistics, paper=())
    picks = find_picks(data_set, DRAWS)
    tried = [] if picks is None else [PageSection("picks", "Picks", PICKS_LEAD, picks_section(data_set, picks))]
    parts = _parts(data_set, shown, samples, findings, versions)
    calibration = [calibration_chart(picks)] if picks is not None and picks.scores else []
    page = Page(
        title=data_set.folder.resolve().name or "data set",
        lead=_lead(data_set, statistics, findings),
        tiles=tiles(statistics),
        parts=[*parts[:3], *tried, *parts[3:]],
        findings=findings,
        data=samples.data,
        charts=[*calibration, *make_charts(figures)],
        album=album,
        footer=f"synpick-warp {__version__}, report of {data_set.folder.resolve().name}. The page loads nothing from anywhere.",
    )
    write_text(out, render(page))
    return out


def take_samples(
    data_set: DataSet, statistics: Statistics, episodes: SampledEpisodes, album: Album, frames: int, report: Report
) -> Samples:
    """Read all pictures of a report; none if the data set has no images. Raises DatasetError if a file is missing or damaged."""
    made: dict[str, list[dict[str, Any] | None]] = {"frames": [], "strips": [], "attempts": []}
    views = sample_views(data_set, episodes, frames) if statistics.total.annotations.views else []
    if not any(view.has(name) for view in views for name in ("rgb", "depth")):
        return Samples({name: [] for name in made}, [], dict.fromkeys(made, 0))
    names = {each.object_id: each.name for each in statistics.objects}
    for done, view in enumerate(views):
        report("frames", done, len(views))
        scale = None if data_set.found else bin_scale(data_set.config.cell.bins, [view.records.camera])
        made["frames"].append(make_frame(view, names, episodes.rows[view.episode].mode, album, scale))
    chosen = choose_episodes(episodes)
    for place, index in enumerate(chosen):
        progress = partial(report, f"film strip {place + 1}")
        made["strips"].append(make_strip(data_set, index, len(chosen) - place, album, progress))
    attempts = choose_attempts(data_set, episodes)
    for done, found in enumerate(attempts):
        report("attempts", done, len(attempts))
        made["attempts"].append(make_attempt(data_set, found, names, album))
    brightness = []
    views = sample_views(data_set, episodes, SURVEY_VIEWS)
    for done, view in enumerate(view for view in views if view.has("rgb")):
        report("brightness", done, len(views))
        brightness.append(measure_brightness(view))
    fitting = {name: [each for each in items if each is not None] for name, items in made.items()}
    return Samples(fitting, brightness, {name: len(items) for name, items in made.items()})


def _versions(data_set: DataSet) -> tuple[Mapping[str, str], list[Remark]]:
    """Versions of the packages that baked the set; a damaged manifest is a finding, as everything else can still be shown."""
    if data_set.found is not None:
        return {}, []
    try:
        return read_manifest(data_set.folder)["versions"], []
    except DatasetError as error:
        return {}, [Remark(WARNING, "The manifest cannot be read", f"{error}.")]


def _lead(data_set: DataSet, statistics: Statistics, findings: list[Remark]) -> Html:
    """Opening sentence of the report: modes, splits, resolution and seed, and a link to the findings."""
    modes = ", ".join(dict.fromkeys(group.mode for group in statistics.groups))
    splits = ", ".join(dict.fromkeys(group.split for group in statistics.groups))
    if data_set.found is not None:
        said = f"A BOP data set from another source than synpick-warp bake; splits {splits}. "
    else:
        sizes = ", ".join(dict.fromkeys(f"{width} x {height}" for width, height in data_set.config.rig.sizes))
        said = f"Modes {modes}; splits {splits}; images of {sizes} pixels; seed {data_set.config.bake.seed}. "
    return join([said, element("a", f"Findings: {summary(findings)}", href="#findings"), "."])


def _parts(
    data_set: DataSet, statistics: Statistics, samples: Samples, findings: list[Remark], versions: Mapping[str, str]
) -> list[PageSection]:
    """Sections of the report in order: frames, episodes, attempts (each says what did not fit the budget), figures, findings, settings."""
    shown, views = samples.data["frames"], statistics.total.annotations.views
    leads = {
        "frames": ("Frames", f"{len(shown)} of {views:,} views, evenly spread over episodes, cameras and time."),
        "strips": ("Episodes", "One episode of each mode, of median length, from its first frame to its last."),
        "attempts": ("Attempts", "What was perceived, chosen and engaged, and why: attempts of every outcome."),
        "figures": ("Figures", "Counts of all episodes and annotations; point at a mark for its numbers, click a mode to single it out."),
        "findings": ("Findings", "What a person who looks through the figures would raise. A note may be meant."),
        "settings": ("Configuration", "Settings that differ from the preset synpick, which has the paper's values."),
    }
    cut, bodies = dict.fromkeys(leads, ""), dict[str, Html]()
    for name, made in samples.data.items():
        bodies[name] = element("div", id=f"{name}-host") if made else element("p", _EMPTY[name], class_="empty")
        if left := samples.asked[name] - len(made):
            cut[name] = f" {left} more did not fit the {BUDGET / 1e6:.0f} MB of pictures."
    bodies["figures"] = join([element("div", id="charts-host"), statistics_tables(statistics)])
    bodies["findings"] = findings_list(findings)
    if data_set.found is None:
        bodies["settings"] = settings_tables(changed_settings(data_set.config), config_to_toml(data_set.config, comments=True), versions)
    else:
        bodies["settings"] = element("p", _EMPTY["settings"], class_="empty")
    return [PageSection(name, title, lead + cut[name], bodies[name]) for name, (title, lead) in leads.items()]


_EMPTY = {
    "frames": "This data set has no images.",
    "strips": "This data set has no images.",
    "attempts": "No attempts can be shown: no episode picks, or there are no images.",
    "settings": "A BOP data set from another source than synpick-warp bake: there are no settings.",
}


def check_out(out: Path) -> None:
    """Check the name of the file; raises OutputError if it is not that of an HTML file, or it is a folder."""
    if out.suffix.lower() not in SUFFIXES:
        raise OutputError(f"{out} is not an HTML file; its name must end in {', '.join(SUFFIXES)}")
    if out.is_dir() and not out.is_symlink():
        raise OutputError(f"cannot write {out}: it is a folder")


def write_text(out: Path, pieces: Iterable[str]) -> None:
    """Write a file atomically; raises OutputError if it cannot be written."""
    try:
        with output_errors(out):
            make_folder(out.parent)
            write_atomically(out, (piece.encode() for piece in pieces))
    except ValueError as error:
        raise OutputError(f"cannot write {out}: {error}") from error
