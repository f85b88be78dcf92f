"""Findings: each is raised where a person would raise it, and not in a good set."""

from __future__ import annotations

from dataclasses import replace

import pytest

from synpick_warp.apps.report.findings import NOTE, WARNING, Figures, find
from synpick_warp.apps.report.sampling import Brightness, SampledEpisodes, spread
from synpick_warp.apps.statistics import GroupStatistics, ObjectStatistics, Statistics
from synpick_warp.apps.statistics.columns import EpisodeFacts
from synpick_warp.apps.statistics.figures import Annotations, Coverage, Depth, EpisodeFigures, LightFigures

ANNOTATIONS = Annotations(600, 6000, 0.7, 200, (0,) * 20, {1: 3000, 2: 2000, 3: 1000})
EPISODES = EpisodeFigures(
    20, 2000, {"emptied": 19, "gave_up": 1}, 200, 180, 5, 100, {"target_picked": 80, "dropped": 20}, 90, 95, 5.0, (0,) * 30
)
COVERAGE = Coverage(5000, 0.8, 0.9, ())
LIGHTS = LightFigures(20, {"day": 8, "lamp": 7, "night": 5}, (0,) * 12, {})
ROWS = {index: EpisodeFacts("pick", 100, "emptied", 10) for index in range(20)}


def figures(**more) -> Figures:
    """Figures of a good set of 20 picking episodes, in which some fields of statistics or figures are replaced."""
    episodes, counted = more.pop("episodes", EPISODES), more.pop("annotations", ANNOTATIONS)
    group = GroupStatistics("train", "pick", episodes, counted, ())
    objects = tuple(ObjectStatistics(key, f"thing {key}", counted.objects.get(key, 0), COVERAGE) for key in (1, 2, 3))
    depth = Depth(64, 10**6, 0.01, {})
    own = {key: more.pop(key) for key in ("brightness", "planned", "rows", "attempts") if key in more}
    statistics = replace(Statistics(3, (group,), group, objects, depth, LIGHTS, (), ()), **more)
    known = SampledEpisodes(own.get("rows", ROWS), own.get("attempts", dict.fromkeys(ROWS, 5)), 20)
    brightness = own.get("brightness", [Brightness(0, 0, frame, 0.4) for frame in range(20)])
    return Figures(statistics, known, brightness, own.get("planned", 20))


def test_a_good_set_has_no_findings():
    assert find(figures()) == []


CASES = {
    "never drawn": ({"annotations": replace(ANNOTATIONS, objects={1: 3000, 3: 3000})}, WARNING, "1 object was never drawn", "thing 2"),
    "rare": (
        {"annotations": replace(ANNOTATIONS, objects={1: 3000, 2: 2000, 3: 90})},
        NOTE,
        "1 object with few annotations",
        "thing 3 (90)",
    ),
    "one reason": (
        {"episodes": replace(EPISODES, outcomes={"target_picked": 70, "dropped": 30})},
        WARNING,
        "30% of the attempts failed for one reason: dropped",
        "30 of 100: every seal broke",
    ),
    "no attempt": ({"attempts": dict.fromkeys(ROWS, 5) | {4: 0}}, WARNING, "1 picking episode without an attempt", "Episodes 4 "),
    "given up": ({"episodes": replace(EPISODES, endings={"gave_up": 8, "emptied": 12})}, WARNING, "40% of the picking episodes", "8 of 20"),
    "short": ({"rows": ROWS | {7: EpisodeFacts("pick", 1, "emptied")}}, WARNING, "1 episode of one frame or none", "Episodes 7."),
    "lost": ({"episodes": replace(EPISODES, lost=50)}, WARNING, "25% of the objects fell out", "50 of 200"),
    "dark": (
        {"brightness": [Brightness(2, 1, 9, 0.05), *4 * [Brightness(0, 0, 0, 0.5)]]},
        WARNING,
        "1 of 5 measured views are too dark",
        "episode 2",
    ),
    "bright": ({"brightness": [Brightness(2, 1, 9, 0.95)]}, WARNING, "1 of 1 measured views are too bright", "camera 1, frame 9"),
    "invisible": ({"annotations": replace(ANNOTATIONS, invisible=3000)}, NOTE, "50% of the instances", "below others"),
    "depth": ({"depth": Depth(64, 100, 0.5, {})}, WARNING, "50% of the depth pixels", "64 sampled"),
    "one light": ({"lights": replace(LIGHTS, maps={"day": 20})}, NOTE, "100% of the episodes have the same light map", "day; --lights"),
    "missing": ({"missing": ("no depth images: no depth range",)}, NOTE, "No depth images", "No depth range."),
    "unfinished": ({"planned": 60}, WARNING, "40 of 60 planned episodes are missing", "resumes"),
}


@pytest.mark.parametrize("name", CASES)
def test_each_fault_is_raised_once(name):
    faults, level, title, detail = CASES[name]
    (finding,) = find(figures(**faults))
    assert (finding.level, finding.title.startswith(title), detail in finding.detail) == (level, True, True), finding


def test_objects_that_are_seen_from_one_side():
    good = figures().statistics
    flat = replace(good.objects[1], coverage=replace(COVERAGE, occupied=0.1))
    (finding,) = find(replace(figures(), statistics=replace(good, objects=(good.objects[0], flat, good.objects[2]))))
    assert finding.title == "1 object seen from few directions"


def test_warnings_come_first_and_long_lists_are_cut():
    found = find(figures(attempts=dict.fromkeys(ROWS, 0), missing=("no depth images: x",)))
    assert [finding.level for finding in found] == [WARNING, NOTE]
    assert "0, 1, 2, 3, 4, 5 and 14 more" in found[0].detail


def test_spread_takes_both_ends():
    assert spread(range(10), 4) == [0, 3, 6, 9]
    assert spread(range(3), 4) == [0, 1, 2]
    assert spread(range(5), 1) == [2]
    assert spread([], 3) == []
