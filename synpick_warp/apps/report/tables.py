"""Static parts of a page: headline figures, tables, findings, settings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from synpick_warp.apps.report.findings import WARNING, Remark
from synpick_warp.apps.report.markup import Html, element, join
from synpick_warp.apps.statistics import Statistics
from synpick_warp.apps.statistics.tables import make_tables
from synpick_warp.codes import Outcome
from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.files.load import load_config, sections
from synpick_warp.configs.files.write import format_toml
from synpick_warp.configs.schema import Config
from synpick_warp.system.codecs.tables import Table

SHOWN_TABLES = ("groups", "paper", "attempts", "depth", "looks")
"""Tables of `statistics.tables` that are shown as they are."""
UNKNOWN = "–"


def tiles(statistics: Statistics) -> Html:
    """HTML of the key figures: terms and values."""
    total = statistics.total
    episodes, counted = total.episodes, total.annotations
    drawn = sum(1 for each in statistics.objects if each.instances)
    picked = sum(count for name, count in episodes.outcomes.items() if name in _SUCCESSES)
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


_SUCCESSES = {outcome.name.lower() for outcome in Outcome if outcome.succeeded}


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
