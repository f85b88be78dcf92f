"""Charts as Vega-Lite specifications (Satyanarayan et al., 2017), which report, eval and explain share, and their rendering as PNG.

A chart is made of panels above each other with a common x axis; a panel has layers, each with data of its own. Names from data are values
only, never fields, expressions or titles.
"""

import json
import signal
import struct
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from synpick_warp.errors import SynpickError

Spec = dict[str, Any]
"""Part of a Vega-Lite specification."""
VEGA_LITE = "6.4"
"""Version of Vega-Lite: fixed, so that a chart looks the same whatever vl-convert offers."""
SCALE = 2
"""Pixels of a PNG file per pixel of a specification."""
INK, SOFT, GRID = "#1e1e1e", "#6e6e6e", "#e2e2e2"
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Colours that colour-blind readers tell apart (Okabe and Ito, 2008)."""
_TIMEOUT = 120.0
"""Longest time that the library may take [s]; it takes one."""
_LIMITS = "free memory, or raise the limits of memory and open files (ulimit -v, ulimit -n), or install the package again"
_BUNDLE = "import sys, vl_convert; sys.stdout.buffer.write(vl_convert.javascript_bundle(vl_version=sys.argv[1]).encode())"
_RENDER = """import json, struct, sys, vl_convert
for spec in json.load(sys.stdin):
    picture = vl_convert.vegalite_to_png(spec, vl_version=sys.argv[1], scale=spec["usermeta"]["scale"])
    sys.stdout.buffer.write(struct.pack("<q", len(picture)) + picture)"""
MAX_LABEL = 36
"""Maximum number of letters of a legend entry."""
_LETTER, _SYMBOL = 9.0, 50.0
"""Widths of a letter, somewhat above the mean, and of a symbol with its gaps [px]."""
WIDTH = 700
"""Width of a chart [px]."""
_PANEL, _LEFT, _GAP = 605, 56, 16
"""Width of a panel, distance of its y axis' label, and gap between two panels [px]."""
_TEXT = 16
"""Font size [px]: at a width of 3.5 inches, a column of a paper, some 6 points."""
_FAR = 20.0
"""How far beyond its axis a value may lie before it is clamped, in lengths of the axis."""
_STROKE = {"symbolType": "stroke", "symbolStrokeWidth": 3, "symbolSize": 500, "symbolOpacity": 1}
"""Symbols of the legend: a piece of each line."""
_DISC = {"symbolType": ("'circle'", _STROKE["symbolType"]), "symbolSize": (110, _STROKE["symbolSize"])}
"""Symbol of an entry with a disc, and of the others."""


class ChartError(SynpickError):
    """Error: the charts' library cannot run."""


def read_bundle() -> str:
    """Vega, Vega-Lite and Vega-Embed as one script, which sets `vegaEmbed`. Raises ChartError: the library cannot run."""
    return _run(_BUNDLE).decode(errors="replace")


def render_charts(specs: Sequence[Spec], scale: float = SCALE) -> list[bytes]:
    """Render charts in one process: a PNG file of each, with `scale` pixels per pixel. Raises ChartError: the library cannot run."""
    if not specs:
        return []
    data = _run(_RENDER, json.dumps([{**spec, "usermeta": {"scale": scale}} for spec in specs], allow_nan=False).encode())
    pictures, start = [], 0
    for _ in specs:
        (size,) = struct.unpack_from("<q", data, start)
        pictures.append(data[start + 8 : start + 8 + size])
        start += 8 + size
    return pictures


def _run(code: str, data: bytes = b"") -> bytes:
    """Standard output of a script that uses vl_convert.

    It runs in a process of its own: the library is a browser's engine, which reserves much memory, and aborts where it does not get it.
    """
    # Without -P, a json.py in the current folder would be imported in place of Python's.
    command = [sys.executable, "-P", "-c", code, VEGA_LITE]
    try:
        done = subprocess.run(command, input=data, capture_output=True, check=False, timeout=_TIMEOUT)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ChartError(f"the process of the charts' library cannot be run: {error}; {_LIMITS}") from None
    if done.returncode or not done.stdout:
        raise ChartError(f"the charts' library vl-convert-python {_describe_end(done.returncode)}; {_LIMITS}")
    return done.stdout


def _describe_end(code: int) -> str:
    """How a process ended by its return code: a signal's number is negative."""
    return f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"


def field(name: str, kind: str, title: str | None, **more: Any) -> Spec:
    """Encoding of a channel by a field of the data; `kind` is Vega-Lite's type."""
    return {"field": name, "type": kind, "title": title, **more}


def axis(channel: str, title: str | None, low: float, high: float, **more: Any) -> Spec:
    """Encoding of the field `channel` on a linear axis from `low` to `high`; `more` are options of the axis."""
    return field(channel, "quantitative", title, scale={"domain": [low, high], "nice": False, "zero": False}, axis=more)


def points(layer: Spec, low: float, high: float, y: Iterable[float], **columns: Iterable[float]) -> Spec:
    """A layer with data: rows of `y` and other columns. NaN in `y` breaks a line; what lies far beyond the axis is clamped."""
    span = _FAR * (high - low)
    heights = [None if np.isnan(height) else float(np.clip(height, low - span, high + span)) for height in y]
    rows = [
        dict(zip(("y", *columns), row, strict=True)) for row in zip(heights, *(map(float, each) for each in columns.values()), strict=True)
    ]
    return {"data": {"values": rows}, **layer}


def line(width: float, color: Spec, dots: float = 0.0) -> Spec:
    """Polyline layer, whose points are discs of the area `dots` [px²], if any; a single point between two breaks is a dot."""
    mark = {"type": "line", "clip": True, "strokeWidth": width, "strokeCap": "round", "strokeJoin": "round"}
    return {"mark": mark | ({"point": {"filled": True, "opacity": 1, "size": dots}} if dots else {}), "encoding": {"color": color}}


def limit(encoding: Spec, place: float, text: str, mark: Spec, label: Spec) -> Spec:
    """Rule across a panel with a text beside it; `encoding` has a channel with the field `limit`, at whose value `place` it lies."""
    return {
        "data": {"values": [{"limit": place, "what": text}]},
        "encoding": encoding,
        "layer": [{"mark": {"type": "rule", **mark}}, {"mark": {"type": "text", **label}, "encoding": {"text": {"field": "what"}}}],
    }


class Legend:
    """Legend above a chart: names, made printable and distinct, with a piece of each line, or a disc."""

    def __init__(self, colors: Mapping[str, str], disc: str | None = None) -> None:
        """Colours by name; `disc` is the name that has a disc."""
        self._shown: dict[str, str] = {}
        self._symbols: Spec = {}
        for name, color in colors.items():
            shown, number = printable(name), 2
            while shown in self._shown.values():
                shown, number = f"{printable(name)} ({number})", number + 1
            self._shown[name] = shown
            if name == disc:
                symbols = _DISC | {"symbolFillColor": (f"'{color}'", None)}
                chosen = f"datum.index === {len(self._shown) - 1}"
                self._symbols = {key: {"expr": f"{chosen} ? {one} : {json.dumps(other)}"} for key, (one, other) in symbols.items()}
        self._scale = {"domain": list(self._shown.values()), "range": list(colors.values())}

    def color(self, name: str) -> Spec:
        """Vega-Lite colour channel of the entry `name`."""
        legend = {"columns": self._columns(), **self._symbols}
        return {"datum": self._shown[name], "type": "nominal", "scale": self._scale, "legend": legend}

    def _columns(self) -> int:
        """Number of columns that fit above a panel, as wide as the longest entry."""
        return max(1, int(_PANEL / (_SYMBOL + _LETTER * max(map(len, self._shown.values()), default=0))))


def panel(y: Spec, height: int, layers: Sequence[Spec]) -> Spec:
    """Panel of a chart: layers with a common y axis, drawn in order, of this height [px]."""
    return {"height": height, "width": _PANEL, "encoding": {"y": y}, "layer": list(layers)}


def chart(x: Spec, panels: Sequence[Spec]) -> Spec:
    """Chart of panels above each other with a common x axis, whose labels are below the lowest."""
    for number, each in enumerate(panels, start=1):
        upper = {"title": None, "axis": {**x["axis"], "labels": False}} if number < len(panels) else {}
        each["encoding"] = {"x": {**x, **upper}, **each["encoding"]}
    return {"vconcat": list(panels), "spacing": _GAP, "background": "white", "padding": 8, "config": theme(_TEXT, _LEFT)}


def theme(text: int, left: int | None = None) -> Spec:
    """Configuration of charts for print: font size [px], axes with a grid; `left` is the distance of the y axis' title [px]."""
    ink = {"labelColor": INK, "titleColor": INK, "labelFontSize": text, "titleFontSize": text, "titleFontWeight": "normal"}
    return {
        "font": "Liberation Sans",  # Part of vl-convert, so that charts are the same on every machine.
        "axis": {**ink, "gridColor": GRID, "domainColor": INK, "tickColor": INK},
        "axisX": {"labelFlush": True},
        "axisY": {"labelFlush": False} | ({} if left is None else {"minExtent": left, "maxExtent": left}),
        "legend": {**ink, "labelLimit": 0, "columnPadding": 18, "orient": "top", "title": None} | _STROKE,
        "view": {"stroke": GRID},
    }


def printable(text: str) -> str:
    """One line of text with letters that the font has, "?" for others, shortened in the middle."""
    shown = "".join(letter if letter.isprintable() and ord(letter) < 256 else "?" for letter in text)
    return shown if len(shown) <= MAX_LABEL else f"{shown[: MAX_LABEL // 2 - 2]}...{shown[-(MAX_LABEL // 2 - 1) :]}"
