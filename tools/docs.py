"""Generate the tables of READMEs that follow from code and results; the prose around them is as committed.

configs/REFERENCE.md: the settings; tools/README.md and tools/reports/real/README.md: the figures in tools/results.

    python -m tools.docs          # writes them
"""

import argparse
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from synpick_warp.configs.check import describe_allowed, is_table
from synpick_warp.configs.episodes.randomize import OFF, Distribution
from synpick_warp.configs.fields import Setting, settings_of
from synpick_warp.configs.files.load import format_toml, sections, table_lists
from synpick_warp.configs.files.table_lists import SPLITS
from synpick_warp.configs.schema import Split
from tools.figures import figures_tables, read_runs

ROOT = Path(__file__).resolve().parents[1]
SETTINGS_REFERENCE = ROOT / "configs" / "REFERENCE.md"
FIGURES = ROOT / "tools" / "README.md"
PHOTOGRAPHS = ROOT / "tools" / "reports" / "real" / "README.md"
STUDIES = ("photographs_ablation.json", "photographs_tuning.json")
"""Results whose many values are in no table."""
_SETTINGS_HEAD = """# Reference of the settings

<!-- Written by `python -m tools.docs` from the schema in this folder; edit the help texts there. -->

What they are for: the [guide](README.md). Intervals hold for each number of a list; a parenthesis leaves the bound out. Where the meaning
names the choices, or any text is allowed, nothing else is shown. A setting that allows a distribution is `"off"` unless a default is shown.
"""
_MEASURED = "measured"
"""Table of a bin that users do not set."""
_RESULTS = re.compile(r"(<!-- results: (\w+) -->\n).*?(<!-- end of results -->)", re.DOTALL)


def settings_reference() -> str:
    """The settings reference as Markdown: links to the sections, and a table of all settings by section."""
    parts = {f"[{name}]": (kind, f"{name}.") for name, kind in sections().items()}
    parts |= {f"[[{name}]]": (kind, "") for name, kind in table_lists().items()} | {f"[{SPLITS}.NAME]": (Split, "")}
    links = " · ".join(f"[{title.strip('[]')}](#{_anchor(title)})" for title in parts)
    lines = ["key | default; allowed | meaning", "---|---|---"]
    shown: dict[type[Any], str] = {}
    for title, (kind, prefix) in parts.items():
        lines += _section(title, kind, prefix, shown)
    return f"{_SETTINGS_HEAD}\n{links}\n\n" + "\n".join([*lines, ""])


def _anchor(title: str) -> str:
    return f"section-{title.strip('[]').partition('.')[0].replace('_', '-')}"


def _section(title: str, kind: type[Any], prefix: str, shown: dict[type[Any], str]) -> list[str]:
    """Rows of a table of settings. `shown`: tables that have rows, by type; what a table has in common with one of them has one row."""
    lines = [f'<a id="{_anchor(title)}"></a>**`{title}`** | | **{" ".join((kind.__doc__ or "").split())}**']
    settings = settings_of(kind)
    if inherited := [(settings_of(base), name) for base, name in shown.items() if issubclass(kind, base)]:
        [(common, name)] = inherited
        lines.append(f"{', '.join(f'`{key}`' for key in common)} | | As in {name}.")
        settings = {key: item for key, item in settings.items() if key not in common}
    shown[kind] = f"`{title}`"
    for name, item in settings.items():
        if name == _MEASURED:
            lines.append(f"`{name}` | | What the program measures of the mesh, and writes.")
        elif item.kind in shown:
            lines.append(f"`{prefix}{name}` | as in {shown[item.kind]} | {item.doc}")
        elif is_table(item.kind):
            lines += _section(title, item.kind, f"{prefix}{name}.", shown)[1:]
        else:
            off = item.default is None or (isinstance(item.default, Distribution) and item.default.kind == OFF)
            default = "" if off else f"`{format_toml(item.default)}`"
            lines.append(f"`{prefix}{name}` | {'; '.join(filter(None, (default, _allowed(item))))} | {item.doc}")
    return lines


def _allowed(item: Setting) -> str:
    """What a setting allows, beyond what its default shows: an interval with its unit, or words."""
    low, high, above = (None if bound is None else f"{bound:.10g}" for bound in (item.bounds.low, item.bounds.high, item.bounds.above))
    if (item.kind in (bool, str) and not item.choices and item.default is not None) or item.path:
        return "a path" if item.path else ""
    if item.choices and all(choice in item.doc for choice in item.choices):
        return ""
    if item.allowed or (low or high or above) is None:
        return describe_allowed(item) + f" [{item.unit}]" * bool(item.unit)
    interval = f"({above}" if above is not None else f"[{low}" if low is not None else "(-∞"
    interval += f", {high}]" if high is not None else ", ∞)"
    return f"{interval} {item.unit}".rstrip() + (" or distribution" if isinstance(item.default, Distribution) else "")


def photographs_reference() -> str:
    """The README of the report on photographs with its table of figures; the rest is as committed."""
    runs = {name: run for name, run in read_runs().items() if name not in STUDIES}
    table = figures_tables(runs)["photographs"].replace("](results/", "](../../results/")
    return _with_results(PHOTOGRAPHS, {"photographs": table})


def _with_results(path: Path, tables: Mapping[str, str]) -> str:
    """A README with these tables between its marks of results, by name; the rest is as committed."""
    return _RESULTS.sub(lambda found: f"{found[1]}{tables[found[2]]}\n{found[3]}", path.read_text(encoding="utf-8"))


REFERENCES: dict[Path, Callable[[], str]] = {
    SETTINGS_REFERENCE: settings_reference,
    FIGURES: lambda: _with_results(FIGURES, figures_tables(read_runs())),
    PHOTOGRAPHS: photographs_reference,
}
"""File -> its content with generated tables."""


def main() -> None:
    """Write all generated documentation."""
    argparse.ArgumentParser(description="Generate the documentation that follows from code.").parse_args()
    for path, make in REFERENCES.items():
        path.write_text(make(), encoding="utf-8")
        print(f"wrote {path.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
