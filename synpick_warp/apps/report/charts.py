"""Interactive plots of statistics as Vega-Lite specifications. Names from data are values only, never fields, expressions or titles."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from synpick_warp.apps.report.sampling import Brightness
from synpick_warp.apps.statistics import ObjectStatistics, Statistics
from synpick_warp.apps.statistics.annotations import VISIBILITY_BINS
from synpick_warp.apps.statistics.attempts import FORCE_BIN
from synpick_warp.apps.statistics.coverage import BANDS, MIN_VISIBILITY, SECTORS
from synpick_warp.apps.statistics.lights import EXPOSURE_BIN
from synpick_warp.apps.statistics.timeline import TIME_BIN
from synpick_warp.configs.schema import Config
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
    """Vega-Lite chart of the report: name, title, caption, specification, and whether it takes the page's width."""

    name: str
    title: str
    caption: str
    spec: Spec
    wide: bool = False
    """Whether it takes the page's whole width."""


@dataclass(frozen=True)
class Source:
    """Data that the charts show: statistics, brightness of views, settings (None: the data set is of another program), duration by mode
    [s].
    """

    statistics: Statistics
    brightness: Sequence[Brightness]
    config: Config | None
    """None: the data set is from another source."""
    durations: Mapping[str, float] = field(default_factory=dict)
    """Mode -> time from the first frame to the end of the last, of its longest episode [s]."""


def make_charts(source: Source) -> list[Chart]:
    """Make all charts of the report that have data."""
    makers: tuple[Callable[[Source], Chart | None], ...] = (
        _objects,
        _visibility,
        _timeline,
        _forces,
        _coverage,
        _outcomes,
        _endings,
        _exposure,
        _luma,
        _lights,
        _own_bins,
    )
    return [chart for make in makers if (chart := make(source)) is not None]


def object_labels(objects: Sequence[ObjectStatistics]) -> dict[int, str]:
    """A distinct label of each object: its name, with the id where names are missing or shared."""
    names = [each.name for each in objects]
    return {
        each.object_id: each.name if each.name and names.count(each.name) == 1 else f"{each.name or 'object'} ({each.object_id})"
        for each in objects
    }


def _stack(rows: Rows, category: str, value: str, order: Sequence[str], titles: tuple[str, str]) -> Spec:
    """Horizontal bars by category, stacked by mode; a click in the legend singles out a mode."""
    return {
        "data": {"values": rows},
        "height": ROW * len(order),
        "params": [_LEGEND],
        "mark": {"type": "bar", "cornerRadiusEnd": 2},
        "encoding": {
            "y": _field(category, "nominal", None, sort=list(order), axis={"labelLimit": 190, "ticks": False, "domain": False}),
            "x": _field(value, "quantitative", titles[1], stack="zero", axis=_COUNT_AXIS),
            "color": _mode_color(rows),
            "opacity": _FADED,
            "order": {"field": "rank", "type": "quantitative"},
            "tooltip": [
                _field(category, "nominal", titles[0]),
                _field("mode", "nominal", "mode"),
                _field(value, "quantitative", titles[1], format=","),
            ],
        },
    }


_COUNT_AXIS: Spec = {"tickCount": 6, "labelExpr": "datum.value == floor(datum.value) ? format(datum.value, ',d') : ''"}
"""Axis of counts: fractions between them have no label."""
_LEGEND: Spec = {"name": "chosen", "select": {"type": "point", "fields": ["mode"]}, "bind": "legend"}
"""Selection bound to the legend: a click on a mode selects it."""
_FADED: Spec = {"condition": {"param": "chosen", "value": 1}, "value": 0.15}


def _mode_color(rows: Rows) -> Spec:
    """Colour by mode, in a fixed order, so that a mode has one colour in all plots; the page sets the range `category`."""
    present = {row["mode"] for row in rows}
    domain = [*MODES, *sorted(present - set(MODES))]
    legend = None if len(present) < 2 else {"orient": "top", "offset": 22, "values": [mode for mode in domain if mode in present]}
    return _field("mode", "nominal", None, scale={"domain": domain}, legend=legend)


def _by_mode(counts: Mapping[str, Mapping[Any, int]], key: str, value: str) -> Rows:
    """Rows of a stack from mode -> category -> count."""
    rank = {mode: index for index, mode in enumerate(MODES)}
    return [
        {key: category, "mode": mode, value: count, "rank": rank.get(mode, len(rank))}
        for mode, group in counts.items()
        for category, count in group.items()
        if count
    ]


def _sum_modes(groups: Sequence[tuple[str, Mapping[Any, int]]]) -> dict[str, dict[Any, int]]:
    """Counts by mode and category, summed over splits."""
    summed: dict[str, dict[Any, int]] = {}
    for mode, counts in groups:
        for key, count in counts.items():
            summed.setdefault(mode, {})[key] = summed.get(mode, {}).get(key, 0) + count
    return summed


def _ranked(counts: Mapping[str, Mapping[Any, int]]) -> list[Any]:
    """Categories by their count in all modes, the largest first."""
    total: dict[Any, int] = {}
    for group in counts.values():
        for key, count in group.items():
            total[key] = total.get(key, 0) + count
    return sorted(total, key=lambda key: (-total[key], str(key)))


def _objects(source: Source) -> Chart | None:
    """Chart of annotated instances by object and mode, the most frequent objects first; None: no instance."""
    names = object_labels(source.statistics.objects)
    groups = [
        (group.mode, {names.get(key, str(key)): count for key, count in group.annotations.objects.items()})
        for group in source.statistics.groups
    ]
    counts = _sum_modes(groups)
    order = [*_ranked(counts), *(names[each.object_id] for each in source.statistics.objects if not each.instances)]
    if not counts:
        return None
    rows = [row for row in _by_mode(counts, "object", "instances") if row["object"] in order[:MAX_LINES]]
    more = len(order) - MAX_LINES
    caption = "Annotated instances in all views, by object and mode of the episode" + (
        f"; {more} rarer objects are left out." if more > 0 else "."
    )
    spec = _stack(rows, "object", "instances", order[:MAX_LINES], ("object", "instances"))
    spec["encoding"]["y"]["scale"] = {"domain": order[:MAX_LINES]}
    return Chart("objects", "Annotations per object", caption, spec, wide=True)


def _edges(rows: Rows, width: float, top: float) -> list[float]:
    """Edges of bins, at equal steps, the last one among them; 0 lies on the axis, and at most MAX_TICKS follow the first edge."""
    first, last = min(0.0, *(row["low"] for row in rows)), max(top, *(row["high"] for row in rows))
    bins = round((last - first) / width)
    step = -(-bins // MAX_TICKS)
    return [round(last - index * width, 6) for index in range(0, bins + 1, step)][::-1]


def _histogram(rows: Rows, width: float, titles: tuple[str, str], labels: str, colored: bool = True, top: float = -math.inf) -> Spec:
    """Bars of a width from `low` to `high` with a count, stacked by mode if there are modes; the axis reaches `top`."""
    edges = _edges(rows, width, top)
    encoding = {
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
            *([_field("mode", "nominal", "mode")] if colored else []),
            _field("low", "quantitative", "from", format=labels),
            _field("high", "quantitative", "to", format=labels),
            _field("count", "quantitative", titles[1], format=","),
        ],
    }
    spec: Spec = {"data": {"values": rows}, "height": HEIGHT, "mark": {"type": "bar", "binSpacing": 1}, "encoding": encoding}
    if colored:
        encoding |= {"color": _mode_color(rows), "opacity": _FADED}
        spec["params"] = [_LEGEND]
    return spec


def _bins(counts: Sequence[int], width: float, mode: str = "") -> Rows:
    """Rows of the non-empty bins of a histogram: low and high edge, count, mode; bins are `width` wide and begin at 0."""
    return [
        {"low": round(index * width, 6), "high": round((index + 1) * width, 6), "count": count, "mode": mode}
        for index, count in enumerate(counts)
        if count
    ]


def _visibility(source: Source) -> Chart | None:
    """Histogram of the visible fraction of instances, by mode; None: no instance with a known fraction."""
    groups = [(group.mode, dict(enumerate(group.annotations.histogram))) for group in source.statistics.groups]
    rows = [row for mode, bins in _sum_modes(groups).items() for row in _bins(list(bins.values()), 1 / VISIBILITY_BINS, mode)]
    if not rows:
        return None
    mean = source.statistics.total.annotations.visibility
    if mean is None:
        return None
    caption = f"Visible fraction of each instance's silhouette; the mean is {mean:.3f}. Invisible instances are in the first bar."
    return Chart(
        "visibility", "Visibility", caption, _histogram(rows, 1 / VISIBILITY_BINS, ("visible fraction", "instances"), ".0%", top=1.0)
    )


def _named(source: Source, counts: dict[str, dict[Any, int]], value: str) -> tuple[Rows, list[str]]:
    """Rows and order of a stack by words, in which underscores are spaces."""
    readable = {mode: {key.replace("_", " "): count for key, count in group.items()} for mode, group in counts.items()}
    return _by_mode(readable, "what", value), _ranked(readable)


def _outcomes(source: Source) -> Chart | None:
    """Chart of attempts by outcome and mode; None: no attempt."""
    rows, order = _named(source, _sum_modes([(group.mode, group.episodes.outcomes) for group in source.statistics.groups]), "attempts")
    if not rows:
        return None
    episodes = source.statistics.total.episodes
    caption = f"How {episodes.attempts:,} attempts to pick ended; {episodes.good_seals:,} had a good seal."
    return Chart("outcomes", "Attempts by outcome", caption, _stack(rows, "what", "attempts", order, ("outcome", "attempts")))


def _endings(source: Source) -> Chart | None:
    """Chart of episodes by ending and mode; None: no ending."""
    rows, order = _named(source, _sum_modes([(group.mode, group.episodes.endings) for group in source.statistics.groups]), "episodes")
    caption = "Why the episodes ended: bin empty, corners visited, or too many failures."
    return (
        Chart("endings", "Episodes by ending", caption, _stack(rows, "what", "episodes", order, ("ending", "episodes"))) if rows else None
    )


def _forces(source: Source) -> Chart | None:
    """Histogram of the largest seal force of attempts [N], with the break forces of the settings; None: no seal, or no settings."""
    groups = [(group.mode, dict(enumerate(group.episodes.force_histogram))) for group in source.statistics.groups]
    rows = [row for mode, bins in _sum_modes(groups).items() for row in _bins(list(bins.values()), FORCE_BIN, mode)]
    if not rows or source.config is None:
        return None
    suction = source.config.suction
    rules = [_limit(suction.good_force, "good seal breaks" if suction.vacuum is None else "tight seal breaks", "right")]
    if suction.vacuum is None:
        rules.insert(0, _limit(suction.poor_force, "poor seal breaks", "left"))
    bars = _histogram(rows, FORCE_BIN, (_FORCE, "attempts"), "~g", top=-(-suction.good_force // FORCE_BIN) * FORCE_BIN)
    spec = {"height": bars.pop("height"), "layer": [bars, *rules]}
    caption = f"Largest force on a seal during each of {source.statistics.total.episodes.seals:,} lifts that engaged an object."
    return Chart("forces", "Seal forces", caption, spec)


_FORCE = "largest seal force [N]"
"""Title of the forces' axis."""


def _limit(force: float, text: str, side: str) -> Spec:
    """Dashed rule at a force [N] with a label; `side` is how the label is aligned to the rule."""
    label = {"align": side, "dx": 5 if side == "left" else -5, "baseline": "bottom", "y": -4}
    encoding = {"x": _field("limit", "quantitative", _FORCE)}
    return limit(encoding, force, text, {"strokeDash": [4, 3], "color": "gray"}, label)


def _timeline(source: Source) -> Chart | None:
    """Chart of the mean number of objects over time, by mode; None: no frame."""
    sums: dict[tuple[str, float], tuple[int, float]] = {}
    for group in source.statistics.groups:
        for point in group.objects_over_time:
            frames, total = sums.get((group.mode, point.time), (0, 0.0))
            sums[group.mode, point.time] = frames + point.frames, total + point.frames * point.objects
    if not sums:
        return None
    rows = [
        {"mode": mode, "time": time, "objects": round(total / frames, 3), "frames": frames}
        for (mode, time), (frames, total) in sorted(sums.items())
    ]
    for mode in dict.fromkeys(row["mode"] for row in rows):
        # A bin's mean holds from its begin to the next one's, and the last one's to the end of the longest episode.
        last = [row for row in rows if row["mode"] == mode][-1]
        rows.append({**last, "time": max(last["time"], round(source.durations.get(mode, 0.0), 3))})
    most = max(row["objects"] for row in rows)
    spec: Spec = {
        "data": {"values": rows},
        "height": HEIGHT,
        "params": [_LEGEND],
        "mark": {"type": "line", "interpolate": "step-after", "strokeWidth": 2, "clip": True},
        "encoding": {
            "x": _field("time", "quantitative", "time since the first frame [s]", scale={"domain": [0, max(row["time"] for row in rows)]}),
            "y": _field(
                "objects", "quantitative", "objects in the scene", scale={"domain": [0, round(HEADROOM * most, 3) or 1], "nice": False}
            ),
            "color": _mode_color(rows),
            "opacity": _FADED,
            "tooltip": [
                _field("mode", "nominal", "mode"),
                _field("time", "quantitative", "from [s]"),
                _field("objects", "quantitative", "objects", format=".2f"),
                _field("frames", "quantitative", "frames", format=","),
            ],
        },
    }
    caption = f"Mean number of objects in the scene in each {TIME_BIN:g} s, over the episodes that last so long."
    return Chart("timeline", "Objects over time", caption, spec)


def _coverage(source: Source) -> Chart | None:
    """Heat map of viewing directions, for an object that the reader selects; None: no object was seen."""
    seen = sorted((each for each in source.statistics.objects if each.coverage.views), key=lambda each: -each.coverage.views)[:MAX_LINES]
    if not seen:
        return None
    names = object_labels(source.statistics.objects)
    rows = [
        {"object": names[each.object_id], "bin": index, "views": count}
        for each in seen
        for index, count in enumerate(each.coverage.bins)
        if count
    ]
    options = [names[each.object_id] for each in seen]
    band, sector = 2.0 / BANDS, TURN / SECTORS
    bottom, left = f"floor(datum.bin / {SECTORS}) * {band} - 1", f"(datum.bin % {SECTORS}) * {sector} - {HALF_TURN}"
    spec: Spec = {
        "data": {"values": rows},
        "height": HEIGHT,
        "params": [{"name": "shown", "value": options[0], "bind": {"input": "select", "options": options, "name": "object "}}],
        "transform": [
            {"filter": "datum.object == shown"},
            {"calculate": bottom, "as": "z"},
            {"calculate": f"{bottom} + {band}", "as": "z2"},
            {"calculate": left, "as": "longitude"},
            {"calculate": f"{left} + {sector}", "as": "longitude2"},
        ],
        "mark": {"type": "rect"},
        "encoding": {
            "x": _field(
                "longitude",
                "quantitative",
                "longitude [°]",
                scale={"domain": [-HALF_TURN, HALF_TURN]},
                axis={"values": [-180, -90, 0, 90, 180]},
            ),
            "x2": {"field": "longitude2"},
            "y": _field("z", "quantitative", "z of the direction", scale={"domain": [-1, 1]}, axis={"values": [-1, -0.5, 0, 0.5, 1]}),
            "y2": {"field": "z2"},
            "color": _field("views", "quantitative", "views", legend={"gradientLength": HEIGHT - 60}),
            "tooltip": [
                _field("longitude", "quantitative", "longitude from [°]"),
                _field("z", "quantitative", "z from", format=".2f"),
                _field("views", "quantitative", "views", format=","),
            ],
        },
    }
    caption = (
        f"Directions from the object, in its frame, to the camera, where at least {MIN_VISIBILITY:.0%} is visible. "
        "All cells have the same area on the sphere."
    )
    return Chart("coverage", "Pose coverage", caption, spec)


def _bars(rows: Rows, order: Sequence[str], titles: tuple[str, str]) -> Spec:
    """Specification of a horizontal bar chart in the accent colour."""
    return {
        "data": {"values": rows},
        "height": ROW * len(order),
        "mark": {"type": "bar", "cornerRadiusEnd": 2},
        "encoding": {
            "y": _field("what", "nominal", None, sort=list(order), axis={"labelLimit": 190, "ticks": False, "domain": False}),
            "x": _field("count", "quantitative", titles[1], axis=_COUNT_AXIS),
            "tooltip": [_field("what", "nominal", titles[0]), _field("count", "quantitative", titles[1], format=",")],
        },
    }


def _lights(source: Source) -> Chart | None:
    """Chart of episodes by environment map, the most frequent maps; None: lights are not known."""
    lights = source.statistics.lights
    if lights is None:
        return None
    rows = [{"what": name, "count": count} for name, count in list(lights.maps.items())[:MAX_LINES]]
    caption = f"{len(lights.maps):,} environment map{'' if len(lights.maps) == 1 else 's'} in {lights.episodes:,} episodes."
    return Chart("lights", "Light maps", caption, _bars(rows, [row["what"] for row in rows], ("map", "episodes")))


def _own_bins(source: Source) -> Chart | None:
    """Chart of episodes by bin, the most frequent bins; None: there is one, or none is told."""
    bins = source.statistics.bins
    if len(bins) < 2:
        return None
    rows = [{"what": name, "count": use.episodes} for name, use in list(bins.items())[:MAX_LINES]]
    caption = f"{len(bins):,} bins in {sum(use.episodes for use in bins.values()):,} episodes."
    return Chart("bins", "Bins", caption, _bars(rows, [row["what"] for row in rows], ("bin", "episodes")))


def _exposure(source: Source) -> Chart | None:
    """Histogram of the episodes' exposure compensation [EV]; None: fewer than two bins have episodes."""
    lights = source.statistics.lights
    if lights is None or len(lights.exposure) < 2:
        return None
    rows = [{"low": low, "high": round(low + EXPOSURE_BIN, 6), "count": count} for low, count in lights.exposure.items()]
    spec = _histogram(rows, EXPOSURE_BIN, ("exposure compensation [EV]", "episodes"), ".1f", colored=False)
    return Chart("exposure", "Exposure", "Exposure compensation of the episodes' light.", spec)


def _luma(source: Source) -> Chart | None:
    """Histogram of the mean luma of views; None: no view was measured."""
    counts = [0] * BRIGHTNESS_BINS
    for view in source.brightness:
        counts[min(int(view.mean * BRIGHTNESS_BINS), BRIGHTNESS_BINS - 1)] += 1
    if not any(counts):
        return None
    rows, titles = _bins(counts, 1 / BRIGHTNESS_BINS), ("mean brightness (sRGB)", "views")
    spec = _histogram(rows, 1 / BRIGHTNESS_BINS, titles, ".0%", colored=False, top=1.0)
    return Chart("brightness", "Brightness", f"Mean luma of {len(source.brightness)} views, spread over the data set.", spec)
