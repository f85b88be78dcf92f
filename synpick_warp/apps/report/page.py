"""The page: fills the template with content, styles and scripts, each allowed by its hash, and forbids everything else."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from string import Template
from typing import Any

from synpick_warp.apps.report.album import Album
from synpick_warp.apps.report.charts import Chart
from synpick_warp.apps.report.findings import NOTE, WARNING, Remark, count_levels
from synpick_warp.apps.report.markup import Html, content_hash, element, embed_json, join
from synpick_warp.system.codecs.charts import ChartError, read_bundle

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
    """Vega, Vega-Lite and Vega-Embed as one script, which sets `vegaEmbed`.

    Raises:
        ChartError: The charts' library cannot run, or its script cannot stand in a page.
    """
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
        sections=join(map(_section, page.parts)),
        footer=join([page.footer]),
    )
    for index, (kind, data) in enumerate(page.album.encoded()):
        yield f'<script type="text/plain" id="picture-{index}" data-kind="{kind}">{data}</script>\n'
    yield Template(tail).substitute(content=embed_json(content), vega=vega, script=script)


def _read(name: str) -> str:
    """Text of a file that comes with the page: template, style or script."""
    return (FOLDER / name).read_text(encoding="utf-8")


def _navigation(page: Page) -> Html:
    """Links to the sections; that to the findings has a badge with the number of warnings."""
    warnings = count_levels(page.findings)[WARNING]
    badge = [element("span", str(warnings), class_="count", title=f"{warnings} warnings")] if warnings else []
    return join(element("a", part.title, badge if part.name == "findings" else "", href=f"#{part.name}") for part in page.parts)


def _section(part: PageSection) -> Html:
    """Section of the page: heading, lead, body."""
    return element("section", element("h2", part.title), element("p", part.lead), part.body, id=part.name)


def summary(findings: Sequence[Remark]) -> str:
    """Numbers of warnings and notes, in words."""
    counts = count_levels(findings)
    words = [f"{counts[level]} {level}{'' if counts[level] == 1 else 's'}" for level in (WARNING, NOTE) if counts[level]]
    return " and ".join(words) or "no warnings"
