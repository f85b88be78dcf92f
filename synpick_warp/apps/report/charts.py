"""Interactive plots of statistics as Vega-Lite specifications. Names from data are values only, never fields, expressions or titles.

A chart is a table of rows with the marks that show it: bars by name, a histogram, a line over time, or a heat map.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from synpick_warp.apps.report.findings import Figures
from synpick_warp.apps.statistics import GroupStatistics, ObjectStatistics, Statistics
from synpick_warp.apps.statistics.columns import BANDS, EXPOSURE_BIN, FORCE_BIN, MIN_VISIBILITY, SECTORS, TIME_BIN, VISIBILITY_BINS
from synpick_warp.system.codecs.charts import Spec, limit
from synpick_warp.system.codecs.charts import field as _field

MODES = ("pick", "target", "move")
"""Order of the modes in legends and stacks."""
BRIGHTNESS_BINS = 20
MAX_LINES = 40
"""Most objects or light maps of a bar chart; the rest are counted together."""
ROW = 19
"""Height of a line of a bar chart [px]."""
HEADROOM = 1.1
"""Upper axis limit of the chart of objects over time, relative to the largest value, so that the line stays inside the frame."""
MAX_TICKS = 10
"""Most labels of a histogram's axis, beside the first."""
HEIGHT = 220
"""Height of the other plots [px]."""
TURN, HALF_TURN = 360.0, 180.0
"""[°]."""
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Chart:
    """Vega-Lite chart of the report."""

    name: str
    title: str
    caption: str
    spec: Spec
    wide: bool = False
    """Whether it takes the page's whole width."""


def make_charts(figures: Figures) -> list[Chart]:
    """Make all charts of the report that have data."""
    makers = (_objects, _visibility, _timeline, _forces, _coverage, _outcomes, _endings, _exposure, _luma, _lights, _bins)
    return [chart for make in makers for chart in make(figures)]


def object_labels(objects: Sequence[ObjectStatistics]) -> dict[int, str]:
    """A distinct label of each object: its name, with the id where names are missing or shared."""
    names = [each.name for each in objects]
    return {
        each.object_id: each.name if each.name and names.count(each.name) == 1 else f"{each.name or 'object'} ({each.object_id})"
        for each in objects
    }


# ---- rows and marks ----

_COUNT_AXIS: Spec = {"tickCount": 6, "labelExpr": "datum.value == floor(datum.value) ? format(datum.value, ',d') : ''"}
"""Axis of counts: fractions between them have no label."""


def _by_mode(statistics: Statistics, counts: Callable[[GroupStatistics], Mapping[Any, int]]) -> dict[str, Counter[Any]]:
    """Counts of the groups by mode, summed over splits."""
    summed: dict[str, Counter[Any]] = {}
    for group in statistics.groups:
        summed.setdefault(group.mode, Counter()).update(counts(group))
    return summed


def _ranked(counts: Mapping[str, Counter[Any]]) -> list[Any]:
    """Categories by their count in all modes, the largest first."""
    total = sum(counts.values(), Counter())
    return sorted(total, key=lambda key: (-total[key], str(key)))


def _stacked(counts: Mapping[str, Counter[Any]], category: str, value: str) -> Rows:
    """Rows of bars from mode -> category -> count."""
    rank = {mode: index for index, mode in enumerate(MODES)}
    return [
        {category: key, "mode": mode, value: count, "rank": rank.get(mode, len(rank))}
        for mode, group in counts.items()
        for key, count in group.items()
        if count
    ]


def _binned(counts: Sequence[int], width: float, mode: str = "") -> Rows:
    """Rows of the non-empty bins of a histogram, which are `width` wide and begin at 0."""
    return [
        {"low": round(index * width, 6), "high": round((index + 1) * width, 6), "count": count, "mode": mode}
        for index, count in enumerate(counts)
        if count
    ]


def _binned_by_mode(statistics: Statistics, histogram: Callable[[GroupStatistics], Sequence[int]], width: float) -> Rows:
    """Rows of a histogram of the groups, by mode."""
    counts = _by_mode(statistics, lambda group: dict(enumerate(histogram(group))))
    return [row for mode, bins in counts.items() for row in _binned(list(bins.values()), width, mode)]


def _tip(name: str, title: str, style: str | None = None) -> Spec:
    """Line of a tooltip: a number in the format `style` (empty: as it is), or text (None)."""
    return _field(name, "nominal" if style is None else "quantitative", title, **({"format": style} if style else {}))


def _colored(spec: Spec) -> Spec:
    """The chart in a colour for each mode of its rows, the same in all charts; a click in the legend singles out a mode."""
    present = {row["mode"] for row in spec["data"]["values"]}
    domain = [*MODES, *sorted(present - set(MODES))]
    legend = None if len(present) < 2 else {"orient": "top", "offset": 22, "values": [mode for mode in domain if mode in present]}
    spec["params"] = [{"name": "chosen", "select": {"type": "point", "fields": ["mode"]}, "bind": "legend"}]
    spec["encoding"] |= {
        "color": _field("mode", "nominal", None, scale={"domain": domain}, legend=legend),
        "opacity": {"condition": {"param": "chosen", "value": 1}, "value": 0.15},
    }
    return spec


def _bars(rows: Rows, order: Sequence[str], category: str, value: str, titles: tuple[str, str]) -> Spec:
    """Horizontal bars by category; stacked by mode if the rows have modes."""
    modes = any("mode" in row for row in rows)
    spec: Spec = {
        "data": {"values": rows},
        "height": ROW * len(order),
        "mark": {"type": "bar", "cornerRadiusEnd": 2},
        "encoding": {
            "y": _field(category, "nominal", None, sort=list(order), axis={"labelLimit": 190, "ticks": False, "domain": False}),
            "x": _field(value, "quantitative", titles[1], axis=_COUNT_AXIS, **({"stack": "zero"} if modes else {})),
            "tooltip": [_tip(category, titles[0]), *([_tip("mode", "mode")] if modes else []), _tip(value, titles[1], ",")],
        },
    }
    if modes:
        spec["encoding"]["order"] = {"field": "rank", "type": "quantitative"}
        return _colored(spec)
    return spec


def _histogram(rows: Rows, width: float, titles: tuple[str, str], labels: str, colored: bool = True, top: float = -math.inf) -> Spec:
    """Bars of a width from `low` to `high` with a count, stacked by mode if there are modes; the axis reaches `top`."""
    edges = _edges(rows, width, top)
    spec: Spec = {
        "data": {"values": rows},
        "height": HEIGHT,
        "mark": {"type": "bar", "binSpacing": 1},
        "encoding": {
            "x": _field(
                "low",
                "quantitative",
                titles[0],
                bin={"binned": True, "step": width},
                axis={"format": labels, "values": edges, "labelOverlap": False},
                scale={"domain": [min(0.0, *(row["low"] for row in rows)), edges[-1]]},
            ),
            "x2": {"field": "high"},
            "y": _field("count", "quantitative", titles[1], stack="zero", axis=_COUNT_AXIS),
            "tooltip": [
                *([_tip("mode", "mode")] if colored else []),
                _tip("low", "from", labels),
                _tip("high", "to", labels),
                _tip("count", titles[1], ","),
            ],
        },
    }
    return _colored(spec) if colored else spec


def _edges(rows: Rows, width: float, top: float) -> list[float]:
    """Edges of bins, at equal steps, the last one among them; 0 lies on the axis, and at most MAX_TICKS follow the first edge."""
    first, last = min(0.0, *(row["low"] for row in rows)), max(top, *(row["high"] for row in rows))
    bins = round((last - first) / width)
    step = -(-bins // MAX_TICKS)
    return [round(last - index * width, 6) for index in range(0, bins + 1, step)][::-1]


# ---- charts: each yields itself, or nothing without data ----


def _objects(figures: Figures) -> Iterator[Chart]:
    names = object_labels(figures.statistics.objects)
    counts = _by_mode(
        figures.statistics, lambda group: {names.get(key, str(key)): count for key, count in group.annotations.objects.items()}
    )
    order = [*_ranked(counts), *(names[each.object_id] for each in figures.statistics.objects if not each.instances)]
    if any(counts.values()):
        shown, more = order[:MAX_LINES], len(order) - MAX_LINES
        rows = [row for row in _stacked(counts, "object", "instances") if row["object"] in shown]
        caption = "Annotated instances in all views, by object and mode of the episode"
        caption += f"; {more} rarer objects are left out." if more > 0 else "."
        spec = _bars(rows, shown, "object", "instances", ("object", "instances"))
        spec["encoding"]["y"]["scale"] = {"domain": shown}
        yield Chart("objects", "Annotations per object", caption, spec, wide=True)


def _visibility(figures: Figures) -> Iterator[Chart]:
    rows = _binned_by_mode(figures.statistics, lambda group: group.annotations.histogram, 1 / VISIBILITY_BINS)
    mean = figures.statistics.total.annotations.visibility
    if rows and mean is not None:
        caption = f"Visible fraction of each instance's silhouette; the mean is {mean:.3f}. Invisible instances are in the first bar."
        spec = _histogram(rows, 1 / VISIBILITY_BINS, ("visible fraction", "instances"), ".0%", top=1.0)
        yield Chart("visibility", "Visibility", caption, spec)


def _outcomes(figures: Figures) -> Iterator[Chart]:
    episodes = figures.statistics.total.episodes
    caption = f"How {episodes.attempts:,} attempts to pick ended; {episodes.good_seals:,} had a good seal."
    counts = _by_mode(figures.statistics, lambda group: group.episodes.outcomes)
    yield from _in_words("outcomes", "Attempts by outcome", caption, counts, ("outcome", "attempts"))


def _endings(figures: Figures) -> Iterator[Chart]:
    caption = "Why the episodes ended: bin empty, corners visited, or too many failures."
    counts = _by_mode(figures.statistics, lambda group: group.episodes.endings)
    yield from _in_words("endings", "Episodes by ending", caption, counts, ("ending", "episodes"))


def _in_words(name: str, title: str, caption: str, counts: Mapping[str, Counter[str]], titles: tuple[str, str]) -> Iterator[Chart]:
    """Counts by mode and name, in which underscores become spaces."""
    readable = {mode: Counter({key.replace("_", " "): count for key, count in group.items()}) for mode, group in counts.items()}
    if rows := _stacked(readable, "what", titles[1]):
        yield Chart(name, title, caption, _bars(rows, _ranked(readable), "what", titles[1], titles))


def _forces(figures: Figures) -> Iterator[Chart]:
    """Histogram of the largest seal force of attempts [N], with the break forces of the settings."""
    rows = _binned_by_mode(figures.statistics, lambda group: group.episodes.force_histogram, FORCE_BIN)
    if not rows or figures.config is None:
        return
    suction = figures.config.suction
    rules = [_limit(suction.good_force, "good seal breaks" if suction.vacuum is None else "tight seal breaks", "right")]
    if suction.vacuum is None:
        rules.insert(0, _limit(suction.poor_force, "poor seal breaks", "left"))
    bars = _histogram(rows, FORCE_BIN, (_FORCE, "attempts"), "~g", top=-(-suction.good_force // FORCE_BIN) * FORCE_BIN)
    caption = f"Largest force on a seal during each of {figures.statistics.total.episodes.seals:,} lifts that engaged an object."
    yield Chart("forces", "Seal forces", caption, {"height": bars.pop("height"), "layer": [bars, *rules]})


_FORCE = "largest seal force [N]"
"""Title of the forces' axis."""


def _limit(force: float, text: str, side: str) -> Spec:
    """Dashed rule at a force [N] with a label; `side` is how the label is aligned to the rule."""
    label = {"align": side, "dx": 5 if side == "left" else -5, "baseline": "bottom", "y": -4}
    return limit({"x": _field("limit", "quantitative", _FORCE)}, force, text, {"strokeDash": [4, 3], "color": "gray"}, label)


def _timeline(figures: Figures) -> Iterator[Chart]:
    sums: dict[tuple[str, float], tuple[int, float]] = {}
    for group in figures.statistics.groups:
        for point in group.objects_over_time:
            frames, total = sums.get((group.mode, point.time), (0, 0.0))
            sums[group.mode, point.time] = frames + point.frames, total + point.frames * point.objects
    if not sums:
        return
    rows = [
        {"mode": mode, "time": time, "objects": round(total / frames, 3), "frames": frames}
        for (mode, time), (frames, total) in sorted(sums.items())
    ]
    # A bin's mean holds from its begin to the next one's, and the last one's to the end of the longest episode.
    last = {row["mode"]: row for row in rows}
    frames = {mode: max((each.frames for each in figures.episodes.rows.values() if each.mode == mode), default=0) for mode in last}
    rows += [{**row, "time": max(row["time"], round(frames[mode] * (figures.period or 0.0), 3))} for mode, row in last.items()]
    most, longest = max(row["objects"] for row in rows), max(row["time"] for row in rows)
    high = {"domain": [0, round(HEADROOM * most, 3) or 1], "nice": False}
    spec: Spec = {
        "data": {"values": rows},
        "height": HEIGHT,
        "mark": {"type": "line", "interpolate": "step-after", "strokeWidth": 2, "clip": True},
        "encoding": {
            "x": _field("time", "quantitative", "time since the first frame [s]", scale={"domain": [0, longest]}),
            "y": _field("objects", "quantitative", "objects in the scene", scale=high),
            "tooltip": [
                _tip("mode", "mode"),
                _tip("time", "from [s]", ""),
                _tip("objects", "objects", ".2f"),
                _tip("frames", "frames", ","),
            ],
        },
    }
    caption = f"Mean number of objects in the scene in each {TIME_BIN:g} s, over the episodes that last so long."
    yield Chart("timeline", "Objects over time", caption, _colored(spec))


def _coverage(figures: Figures) -> Iterator[Chart]:
    seen = sorted((each for each in figures.statistics.objects if each.coverage.views), key=lambda each: -each.coverage.views)[:MAX_LINES]
    if not seen:
        return
    names = object_labels(figures.statistics.objects)
    rows = [
        {"object": names[each.object_id], "bin": index, "views": count}
        for each in seen
        for index, count in enumerate(each.coverage.bins)
        if count
    ]
    options = [names[each.object_id] for each in seen]
    band, sector = 2.0 / BANDS, TURN / SECTORS
    bottom, left = f"floor(datum.bin / {SECTORS}) * {band} - 1", f"(datum.bin % {SECTORS}) * {sector} - {HALF_TURN}"
    edges = {"z": bottom, "z2": f"{bottom} + {band}", "longitude": left, "longitude2": f"{left} + {sector}"}
    across = {"scale": {"domain": [-HALF_TURN, HALF_TURN]}, "axis": {"values": [-180, -90, 0, 90, 180]}}
    up = {"scale": {"domain": [-1, 1]}, "axis": {"values": [-1, -0.5, 0, 0.5, 1]}}
    spec: Spec = {
        "data": {"values": rows},
        "height": HEIGHT,
        "params": [{"name": "shown", "value": options[0], "bind": {"input": "select", "options": options, "name": "object "}}],
        "transform": [{"filter": "datum.object == shown"}, *({"calculate": edge, "as": name} for name, edge in edges.items())],
        "mark": {"type": "rect"},
        "encoding": {
            "x": _field("longitude", "quantitative", "longitude [°]", **across),
            "x2": {"field": "longitude2"},
            "y": _field("z", "quantitative", "z of the direction", **up),
            "y2": {"field": "z2"},
            "color": _field("views", "quantitative", "views", legend={"gradientLength": HEIGHT - 60}),
            "tooltip": [_tip("longitude", "longitude from [°]", ""), _tip("z", "z from", ".2f"), _tip("views", "views", ",")],
        },
    }
    caption = (
        f"Directions from the object, in its frame, to the camera, where at least {MIN_VISIBILITY:.0%} is visible. "
        "All cells have the same area on the sphere."
    )
    yield Chart("coverage", "Pose coverage", caption, spec)


def _lights(figures: Figures) -> Iterator[Chart]:
    if lights := figures.statistics.lights:
        plural = "" if len(lights.maps) == 1 else "s"
        caption = f"{len(lights.maps):,} environment map{plural} in {lights.episodes:,} episodes."
        yield Chart("lights", "Light maps", caption, _episodes_by_name(lights.maps, "map"))


def _bins(figures: Figures) -> Iterator[Chart]:
    """Episodes by bin, the most frequent bins, if there are several."""
    uses = {name: use.episodes for name, use in figures.statistics.bins.items()}
    if len(uses) > 1:
        yield Chart("bins", "Bins", f"{len(uses):,} bins in {sum(uses.values()):,} episodes.", _episodes_by_name(uses, "bin"))


def _episodes_by_name(counts: Mapping[str, int], noun: str) -> Spec:
    """Bars of the first MAX_LINES names."""
    shown = dict(list(counts.items())[:MAX_LINES])
    rows = [{"what": name, "count": count} for name, count in shown.items()]
    return _bars(rows, list(shown), "what", "count", (noun, "episodes"))


def _exposure(figures: Figures) -> Iterator[Chart]:
    """Histogram of the episodes' exposure compensation [EV], if at least two bins have episodes."""
    lights = figures.statistics.lights
    if lights is not None and len(lights.exposure) > 1:
        rows = [{"low": low, "high": round(low + EXPOSURE_BIN, 6), "count": count} for low, count in lights.exposure.items()]
        spec = _histogram(rows, EXPOSURE_BIN, ("exposure compensation [EV]", "episodes"), ".1f", colored=False)
        yield Chart("exposure", "Exposure", "Exposure compensation of the episodes' light.", spec)


def _luma(figures: Figures) -> Iterator[Chart]:
    bins = Counter(min(int(view.mean * BRIGHTNESS_BINS), BRIGHTNESS_BINS - 1) for view in figures.brightness)
    if bins:
        rows = _binned([bins[index] for index in range(BRIGHTNESS_BINS)], 1 / BRIGHTNESS_BINS)
        spec = _histogram(rows, 1 / BRIGHTNESS_BINS, ("mean brightness (sRGB)", "views"), ".0%", colored=False, top=1.0)
        yield Chart("brightness", "Brightness", f"Mean luma of {len(figures.brightness)} views, spread over the data set.", spec)
