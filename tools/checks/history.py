"""Check of prose for history: dates, figures before and after a change, and states of the code that are gone.

Documents, docstrings and comments describe what is; git, CHANGELOG.md and tools/results say what was. Read are Markdown files as a whole,
comments of Python, shell, TOML and YAML files, and docstrings. Code, other strings, and what stands between two "results" marks in a
document (figures from tools/results) are left out.

    python -m tools.checks.history          # prints each finding; exit code 1 if there is one
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (".github", "configs", "kernels", "scenes", "synpick_warp", "tests", "tools")
EXCLUDED = frozenset({"CHANGELOG.md"})
"""Documents of what was."""
_RESULTS = re.compile(r"<!-- results: \w+ -->.*?<!-- end of results -->", re.DOTALL)
_FIGURE = r"[(\[]?[\d.,]*\d[\d.,]*"
_UNIT = r"(?:%|ms|us|s|dB|GB|MB|GiB|min|views/s|/s)(?!\w)"


def _compile(*patterns: str) -> re.Pattern[str]:
    """Any of the patterns; a blank in them is any white space, so that phrases over two lines are found."""
    return re.compile("|".join(patterns).replace(" ?", r"\s*").replace(" ", r"\s+"), re.IGNORECASE | re.DOTALL)


PATTERNS = {
    "date": _compile(r"\b20\d\d-\d\d-\d\d\b"),
    "state that is gone": _compile(
        r"\bno longer\b(?! than)",
        r"\bused to (?:be|have|do|take|need|run|lie|make|give)\b",
        r"\b(?:since then|until now|formerly|previously)\b",
        r"\bwas [^.;]{1,80}\bnow\b",
        r"\bbefore (?:this|that|the) (?:change|rebuild)\b",
        r"\bthe (?:old|former|earlier) (?:code|version|solver|renderer|shape|kernel)s?\b",
    ),
    "figure before and after": _compile(
        rf"[(;,|] ?before[:,]? {_FIGURE} ?{_UNIT}",
        rf"{_FIGURE} before\)",
        rf"[(;,|] ?before[:,] {_FIGURE}",
        r"\b(?:were before|before it was)\b",
        r"\bbefore [/|] (?:after|now)\b",
        r"\bbefore\b[^.;]{0,80}\bnow\b",
        r"\bnow\b[^.;]{0,80}\bbefore\b",
        rf"{_FIGURE}(?: [%\w/]+)? instead of {_FIGURE} ?{_UNIT}",
    ),
}


class Finding(NamedTuple):
    """Place in a text whose words tell history: file, line, kind of words, text."""

    path: Path
    line: int
    kind: str
    text: str


def find_history(path: Path, text: str) -> list[Finding]:
    """Find words that tell history in a file's documentation, by line."""
    found = [
        Finding(path, start + prose[: match.start()].count("\n"), kind, " ".join(match[0].split()))
        for start, prose in _passages(path, text)
        for kind, pattern in PATTERNS.items()
        for match in pattern.finditer(prose)
    ]
    return sorted(found, key=lambda finding: finding.line)


def _name(path: Path) -> str:
    """Path relative to the repository, or else its name."""
    return path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else path.name


def _passages(path: Path, text: str) -> Iterator[tuple[int, str]]:
    """(line, prose) of each paragraph of a document; of each docstring and block of comments of a program."""
    if path.suffix == ".md":
        prose = _RESULTS.sub(lambda found: re.sub(r"[^\n]", "", found[0]), text)
        yield from _paragraphs(prose)
    elif path.suffix == ".py":
        yield from _docstrings(text)
        yield from _comments(text)
    else:
        yield from _blocks((number, line.partition("#")[2]) for number, line in enumerate(text.splitlines(), 1) if "#" in line)


def _paragraphs(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line, text) of each paragraph of a text."""
    yield from _blocks((number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip())


def _blocks(lines: Iterator[tuple[int, str]]) -> Iterator[tuple[int, str]]:
    """Yield (first line, text) of lines that follow each other."""
    first, block = 0, []
    for number, line in lines:
        if block and number != first + len(block):
            yield first, "\n".join(block)
            block = []
        first = first if block else number
        block.append(line)
    if block:
        yield first, "\n".join(block)


def _docstrings(text: str) -> Iterator[tuple[int, str]]:
    """Docstrings of modules, classes, functions and attributes: all strings that are statements."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value


def _comments(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line, text) of each block of comments in Python source."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    yield from _blocks((token.start[0], token.string.lstrip("#")) for token in tokens if token.type == tokenize.COMMENT)


def documents() -> Iterator[Path]:
    """Yield the files with documentation, each once."""
    paths = [*ROOT.glob("*.md"), ROOT / "Makefile", ROOT / "pyproject.toml"]
    for folder in FOLDERS:
        paths += [path for suffix in ("py", "md", "toml", "sh", "yml") for path in sorted((ROOT / folder).rglob(f"*.{suffix}"))]
    yield from (path for path in paths if path.resolve() == path and _name(path) not in EXCLUDED)


def main() -> int:
    """Print all findings; returns the exit code."""
    findings = [finding for path in documents() for finding in find_history(path, path.read_text(encoding="utf-8"))]
    for finding in findings:
        print(f"{_name(finding.path)}:{finding.line}: {finding.kind}: {finding.text}")
    print(f"{len(findings)} lines of history")
    return int(bool(findings))


if __name__ == "__main__":
    sys.exit(main())
