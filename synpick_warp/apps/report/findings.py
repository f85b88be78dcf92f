"""Findings: what a person who looks through a data set's figures would raise. Pure functions of the figures."""

import statistics as mean_of
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from synpick_warp.apps.report.frames import Brightness, SampledEpisodes
from synpick_warp.apps.statistics import Statistics
from synpick_warp.codes import Ending, Outcome
from synpick_warp.configs.schema import Config

WARNING, NOTE = "warning", "note"
FAILURE_SHARE = 0.3
"""Threshold: fraction of all attempts that fail in the same way."""
LOST_SHARE = 0.2
"""Threshold: fraction of the objects that left the scene without being picked."""
GIVEN_UP_SHARE = 0.3
"""Share of the episodes with picking that ended after too many failures."""
RARE = 0.25
"""An object is rare below this fraction of the median number of instances."""
INVISIBLE_SHARE = 0.3
"""Share of the instances without a visible pixel."""
DARK, BRIGHT = 0.12, 0.88
"""Mean luma of a view below or above which it is too dark or too bright; middle grey is 0.46."""
EXTREME_SHARE = 0.1
"""Threshold: fraction of the measured views that are too dark, or too bright."""
MISSING_DEPTH = 0.2
"""Share of the depth pixels without measurement."""
ONE_MAP_SHARE = 0.5
"""Share of the episodes with the same light map."""
MIN_EPISODES = 5
"""Episodes from which shares of episodes mean something."""
MIN_ATTEMPTS = 10
"""Attempts from which shares of attempts mean something."""
COVERED = 0.25
"""Fraction of the viewing directions below which an object's coverage is raised, if it was seen MIN_COVERED_VIEWS times."""
MIN_COVERED_VIEWS = 2000
MAX_NAMED = 6
"""Most objects or episodes that a finding names."""


Rule = Iterator[tuple[str, str, str]]
"""Level, title and detail of each remark of a rule."""


class Remark(NamedTuple):
    """Remark of the report on the quality of a data set."""

    level: str
    """WARNING, or NOTE: may be meant."""
    title: str
    detail: str


@dataclass(frozen=True)
class Figures:
    """Figures that remarks and charts are derived from."""

    statistics: Statistics
    episodes: SampledEpisodes
    brightness: Sequence[Brightness]
    planned: int
    """Episodes that the settings plan."""
    config: Config | None = None
    """None: the data set is from another source."""
    period: float | None = None
    """Time between two frames [s]; None: not known."""


def find(figures: Figures) -> list[Remark]:
    """Apply all rules to the figures; returns the findings, warnings first."""
    causes = (_unfinished, _never_drawn, _rare, _failures, _without_attempt, _endings, _lost)
    looks = (_brightness, _invisible, _depth, _lights, _coverage, _missing)
    found = [Remark(*each) for rule in (*causes, *looks) for each in rule(figures)]
    return sorted(found, key=lambda remark: remark.level != WARNING)


def _unfinished(figures: Figures) -> Rule:
    present = figures.episodes.total
    if present < figures.planned:
        title = f"{figures.planned - present:,} of {figures.planned:,} planned episodes are missing"
        yield WARNING, title, "The bake is not finished, or gave them up; the command that started it resumes it."


def _never_drawn(figures: Figures) -> Rule:
    never = [each for each in figures.statistics.objects if not each.instances]
    if never and figures.statistics.total.annotations.views:
        listed = _listed(each.name or f"object {each.object_id}" for each in never)
        title = f"{len(never)} object{' was' if len(never) == 1 else 's were'} never drawn"
        remedy = "More episodes, or a larger arrangement.volume, draw more objects."
        yield WARNING, title, f"{listed}: in the models folder, but in no view. {remedy}"


def _rare(figures: Figures) -> Rule:
    counts = [each.instances for each in figures.statistics.objects if each.instances]
    if len(counts) < 3:
        return
    median = mean_of.median(counts)
    rare = [each for each in figures.statistics.objects if 0 < each.instances < RARE * median]
    if rare:
        listed = _listed(f"{each.name or f'object {each.object_id}'} ({each.instances:,})" for each in rare)
        yield NOTE, f"{len(rare)} object{'' if len(rare) == 1 else 's'} with few annotations", f"{listed}; the median is {median:,.0f}."


def _failures(figures: Figures) -> Rule:
    episodes = figures.statistics.total.episodes
    sentences = {outcome.name.lower(): outcome for outcome in Outcome}
    for name, count in episodes.outcomes.items():
        outcome = sentences.get(name)
        if outcome is not None and outcome.succeeded:
            continue
        share = count / episodes.attempts
        if share >= FAILURE_SHARE and episodes.attempts >= MIN_ATTEMPTS:
            reason = outcome.sentence if outcome is not None else name
            title = f"{share:.0%} of the attempts failed for one reason: {name.replace('_', ' ')}"
            yield WARNING, title, f"{count:,} of {episodes.attempts:,}: {reason}. The explained attempts show some of them."


def _without_attempt(figures: Figures) -> Rule:
    rows = figures.episodes.rows
    idle = [index for index, row in rows.items() if row.mode in ("pick", "target") and not figures.episodes.attempts[index]]
    if idle:
        listed = _listed(map(str, idle))
        yield WARNING, f"{_number(len(idle), 'picking episode')} without an attempt", f"Episodes {listed} have images but no attempt."


def _endings(figures: Figures) -> Rule:
    endings = figures.statistics.total.episodes.endings
    given_up = endings.get(Ending.GAVE_UP.name.lower(), 0)
    picking = sum(group.episodes.episodes for group in figures.statistics.groups if group.mode in ("pick", "target"))
    if picking >= MIN_EPISODES and given_up / picking >= GIVEN_UP_SHARE:
        title = f"{given_up / picking:.0%} of the picking episodes were given up"
        yield WARNING, title, f"{given_up:,} of {picking:,}: {Ending.GAVE_UP.sentence}. Their bins are not empty at the end."
    short = [index for index, row in figures.episodes.rows.items() if row.frames <= (row.mode != "still")]
    if short:
        yield WARNING, f"{_number(len(short), 'episode')} of one frame or none", f"Episodes {_listed(map(str, short))}."


def _lost(figures: Figures) -> Rule:
    episodes = figures.statistics.total.episodes
    if episodes.objects and episodes.lost / episodes.objects >= LOST_SHARE:
        share = episodes.lost / episodes.objects
        yield WARNING, f"{share:.0%} of the objects fell out of the scene", f"{episodes.lost:,} of {episodes.objects:,} were lost."


def _brightness(figures: Figures) -> Rule:
    views = figures.brightness
    dark, bright = [each for each in views if each.mean < DARK], [each for each in views if each.mean > BRIGHT]
    for word, found, side, limit in (("dark", dark, "below", DARK), ("bright", bright, "above", BRIGHT)):
        if views and len(found) / len(views) >= EXTREME_SHARE:
            listed = _listed(f"episode {each.episode}, camera {each.camera}, frame {each.frame}" for each in found)
            title = f"{len(found)} of {len(views)} measured views are too {word}"
            yield WARNING, title, f"Mean brightness {side} {limit:.0%}: {listed}."


def _invisible(figures: Figures) -> Rule:
    counted = figures.statistics.total.annotations
    if counted.instances and counted.invisible / counted.instances >= INVISIBLE_SHARE:
        share = counted.invisible / counted.instances
        title = f"{share:.0%} of the instances have no visible pixel"
        yield NOTE, title, "They lie below others or outside of the image; targets leave them out."


def _depth(figures: Figures) -> Rule:
    depth = figures.statistics.depth
    if depth is not None and depth.missing >= MISSING_DEPTH:
        yield WARNING, f"{depth.missing:.0%} of the depth pixels have no measurement", f"In {depth.views:,} sampled views."


def _lights(figures: Figures) -> Rule:
    lights = figures.statistics.lights
    if lights is None or lights.episodes < MIN_EPISODES:
        return
    name, count = next(iter(lights.maps.items()))
    if count / lights.episodes > ONE_MAP_SHARE:
        others = len(lights.maps) - 1
        detail = f"{name}; {_number(others, 'other map')} for the rest." if others else f"{name}; --lights takes a folder of more."
        yield NOTE, f"{count / lights.episodes:.0%} of the episodes have the same light map", detail


def _coverage(figures: Figures) -> Rule:
    poor = [each for each in figures.statistics.objects if each.coverage.views >= MIN_COVERED_VIEWS and each.coverage.occupied < COVERED]
    if poor:
        listed = _listed(f"{each.name or f'object {each.object_id}'} ({each.coverage.occupied:.0%})" for each in poor)
        yield NOTE, f"{_number(len(poor), 'object')} seen from few directions", f"Seen part of the sphere of viewing directions: {listed}."


def _missing(figures: Figures) -> Rule:
    for sentence in figures.statistics.missing:
        title, _, detail = sentence.partition(": ")
        yield NOTE, title[:1].upper() + title[1:], f"{detail[:1].upper()}{detail[1:]}." if detail else ""


def _number(count: int, noun: str) -> str:
    """Count with its noun, in the plural unless it is 1."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _listed(items: Iterable[str]) -> str:
    """List items; of more than MAX_NAMED, the first, and the number of the others."""
    listed = list(items)
    more = len(listed) - MAX_NAMED
    return ", ".join(listed[:MAX_NAMED]) + (f" and {more:,} more" if more > 0 else "")


def count_levels(findings: Sequence[Remark]) -> Mapping[str, int]:
    """Number of findings of each level."""
    return {level: sum(finding.level == level for finding in findings) for level in (WARNING, NOTE)}
