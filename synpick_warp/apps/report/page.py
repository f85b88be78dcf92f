"""The page: template, static parts (headline figures, tables, findings, settings), styles and scripts, each allowed by its hash.

Data cannot break out of its HTML and JSON: text is escaped when it becomes markup, JSON when it is embedded in a script element.
"""

import base64
import functools
import hashlib
import html
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from string import Template
from typing import Any

from synpick_warp.apps.report.charts import Chart
from synpick_warp.apps.report.findings import NOTE, WARNING, Remark, count_levels
from synpick_warp.apps.report.frames import SUCCESSES, Album
from synpick_warp.apps.statistics import Statistics
from synpick_warp.apps.statistics.tables import make_tables
from synpick_warp.configs.files.load import format_toml, load_config, sections, settings_of
from synpick_warp.configs.schema import Config
from synpick_warp.system.codecs.charts import ChartError, read_bundle
from synpick_warp.system.codecs.tables import Table

SHOWN_TABLES = ("groups", "paper", "attempts", "depth", "looks")
"""Tables of `statistics.tables` that are shown as they are."""
UNKNOWN = "–"


class Html(str):
    """Finished markup; every other string is text."""

    __slots__ = ()


def element(tag: str, *children: str | Iterable[str], **attributes: str) -> Html:
    """An HTML element of a tag that is never from data; children are `Html`, or text, which is escaped, as are the values of attributes. A
    trailing underscore of an attribute's name is dropped, so `class_`; others become hyphens."""
    written = "".join(
        f' {name.removesuffix("_").replace("_", "-")}="{html.escape(printable(value))}"' for name, value in attributes.items()
    )
    return Html(f"<{tag}{written}>{''.join(_markup(child) for child in children)}</{tag}>")


def image(kind: str, data: str, text: str) -> Html:
    """An HTML image with its content; `kind` as in its media type, `data` in Base64, `text` for those who do not see it."""
    return Html(f'<img src="data:image/{kind};base64,{data}" alt="{html.escape(printable(text))}">')


def join(parts: Iterable[str]) -> Html:
    """Concatenate markup and texts (escaped)."""
    return Html("".join(map(_markup, parts)))


def _markup(child: str | Iterable[str]) -> str:
    """HTML of a child: text is escaped, HTML stays as it is, iterables are joined."""
    if isinstance(child, Html):
        return child
    return html.escape(printable(child)) if isinstance(child, str) else join(child)


def printable(text: str) -> str:
    """Replace characters that no page may have: lone surrogates, and control characters other than line breaks."""
    return "".join(letter if letter.isprintable() or letter in "\n\t " else "�" for letter in text)


def embed_json(content: Any) -> Html:
    """JSON for a script element: the characters that could end it, or begin a comment in it, are escaped."""
    text = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return Html(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def content_hash(text: str) -> str:
    """Source expression of a Content-Security-Policy that allows an inline script or style of exactly this text."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


# ---- static parts of a page ----


def tiles(statistics: Statistics) -> Html:
    """HTML of the key figures: terms and values."""
    total = statistics.total
    episodes, counted = total.episodes, total.annotations
    drawn = sum(1 for each in statistics.objects if each.instances)
    picked = sum(count for name, count in episodes.outcomes.items() if name in SUCCESSES)
    figures = [
        ("episodes", f"{episodes.episodes:,}"),
        ("cameras", f"{statistics.cameras}"),
        ("views", f"{counted.views:,}"),
        ("instances", f"{counted.instances:,}"),
        ("instances a view", UNKNOWN if counted.instances_per_view is None else f"{counted.instances_per_view:.1f}"),
        ("mean visibility", UNKNOWN if counted.visibility is None else f"{counted.visibility:.3f}"),
        ("objects drawn", f"{drawn} of {len(statistics.objects)}"),
        ("attempts that picked", f"{picked:,} of {episodes.attempts:,}" if episodes.attempts else UNKNOWN),
    ]
    return join(element("div", element("dt", term), element("dd", value)) for term, value in figures)


def statistics_tables(statistics: Statistics) -> Html:
    """HTML of SHOWN_TABLES: views by split and mode, comparison with the paper, attempts and seals, quantiles of depth and of looks."""
    return join(table_html(table) for table in make_tables(statistics) if table.name in SHOWN_TABLES and table.rows)


def table_html(table: Table) -> Html:
    """HTML of a table below its title, numbers aligned at the right."""
    classes = ["num" if column.style else "" for column in table.columns]
    return element("div", element("h3", table.title), plain_table(table.labels(), table.cells(UNKNOWN), classes), class_="scroll")


def plain_table(names: Sequence[str], rows: Iterable[Sequence[str]], classes: Sequence[str]) -> Html:
    """HTML of a table with a header; `classes` has the CSS class of each column."""
    head = element("tr", [element("th", name, class_=each, scope="col") for name, each in zip(names, classes, strict=True)])
    body = [element("tr", [element("td", value, class_=each) for value, each in zip(row, classes, strict=True)]) for row in rows]
    return element("table", element("thead", head), element("tbody", body))


def findings_list(findings: Sequence[Remark]) -> Html:
    """HTML list of what is odd in the data set's figures (`report.findings`), with level, title and detail; a sentence if nothing is."""
    if not findings:
        return element("p", "Nothing was found that a person would raise.", class_="empty")
    items = [
        element(
            "li",
            element("span", finding.level, class_=f"level {finding.level}" if finding.level == WARNING else "level"),
            element("div", element("b", finding.title), element("p", finding.detail)),
        )
        for finding in findings
    ]
    return element("ul", items, class_="findings")


def settings_tables(rows: Sequence[tuple[str, str, str, str]], toml: str, versions: Mapping[str, str]) -> Html:
    """Settings that differ from the default preset, as `changed_settings` has them, versions, and all settings as TOML."""
    if rows:
        changed = plain_table(("setting", "here", "default", "meaning"), rows, ("", "wide", "wide", "meaning"))
    else:
        changed = element("p", "All settings are those of the preset synpick.", class_="empty")
    parts = [element("div", changed, class_="scroll")]
    if versions:
        shown = [(name, version or "not installed") for name, version in versions.items()]
        parts.append(element("div", element("h3", "Versions"), plain_table(("package", "version"), shown, ("", "")), class_="scroll"))
    text = element("pre", toml, tabindex="0")
    return join([*parts, element("details", element("summary", "All settings, with units and ranges"), text)])


def changed_settings(config: Config) -> list[tuple[str, str, str, str]]:
    """Key, value, value of the default preset, and meaning of each setting that differs from it."""
    default, rows = load_config(), []
    for section, kind in sections().items():
        for name, item in settings_of(kind).items():
            key = f"{section}.{name}"
            here, there = config.value(key), default.value(key)
            if here != there:
                unit = f" [{item.unit}]" if item.unit else ""
                rows.append((key, format_toml(here), format_toml(there), f"{item.doc}{unit}"))
    return rows


FOLDER = Path(__file__).parent / "page"
SCRIPTS = ("base.js", "frames.js", "strips.js", "attempts.js", "charts.js")
"""Joined in this order to one script."""


@dataclass(frozen=True)
class PageSection:
    """Section of the page."""

    name: str
    title: str
    lead: str
    """What is seen, in a sentence or two."""
    body: Html


@dataclass(frozen=True)
class Page:
    """Content of a report's page."""

    title: str
    lead: str
    tiles: Html
    parts: Sequence[PageSection]
    findings: Sequence[Remark]
    data: Mapping[str, Any]
    """What the scripts show: frames, strips, attempts."""
    charts: Sequence[Chart]
    album: Album
    footer: str


@functools.cache
def read_vega() -> str:
    """Vega, Vega-Lite and Vega-Embed as one script, which sets `vegaEmbed`; raises ChartError if the charts' library cannot run, or its
    script cannot stand in a page."""
    script = read_bundle()
    # Neither an end of the element nor the states of HTML's parser that hide one can stand in the script, as its hash would not match.
    if any(text in script.lower() for text in ("</script", "<script", "<!--")):
        raise ChartError("the installed vl-convert-python has a script that cannot be inlined; install another version")
    return script


def render(page: Page) -> Iterator[str]:
    """Yield the page's text in pieces; each picture is a piece, so that all of them are never in memory twice."""
    vega = read_vega()
    style, boot = _read("style.css"), _read("boot.js")
    # Vega's script has global functions; those of the page must not replace them.
    script = "\n".join(["(() => {", *map(_read, SCRIPTS), "})();"])
    policy = (
        f"default-src 'none'; img-src data:; style-src {content_hash(style)}; "
        f"script-src {' '.join(map(content_hash, (boot, vega, script)))}; base-uri 'none'; form-action 'none'"
    )
    content = {**page.data, "charts": [asdict(chart) for chart in page.charts]}
    template = Template(_read("page.html"))
    head, _, tail = template.template.partition("$pictures")
    yield Template(head).substitute(
        policy=policy,
        title=join([page.title]),
        heading=join([page.title]),
        style=style,
        boot=boot,
        lead=join([page.lead]),
        tiles=page.tiles,
        navigation=_navigation(page),
        sections=join(element("section", element("h2", one.title), element("p", one.lead), one.body, id=one.name) for one in page.parts),
        footer=join([page.footer]),
    )
    for index, (kind, data) in enumerate(page.album.pictures):
        yield f'<script type="text/plain" id="picture-{index}" data-kind="{kind}">{data}</script>\n'
    yield Template(tail).substitute(content=embed_json(content), vega=vega, script=script)


def _read(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")


def _navigation(page: Page) -> Html:
    """Links to the sections; that to the findings has a badge with the number of warnings."""
    warnings = count_levels(page.findings)[WARNING]
    badge = [element("span", str(warnings), class_="count", title=f"{warnings} warnings")] if warnings else []
    return join(element("a", part.title, badge if part.name == "findings" else "", href=f"#{part.name}") for part in page.parts)


def summary(findings: Sequence[Remark]) -> str:
    """Numbers of warnings and notes, in words."""
    counts = count_levels(findings)
    words = [f"{counts[level]} {level}{'' if counts[level] == 1 else 's'}" for level in (WARNING, NOTE) if counts[level]]
    return " and ".join(words) or "no warnings"
