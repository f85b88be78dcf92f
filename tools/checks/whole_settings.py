"""Check of parameters: functions that take all settings (`Config`), where sections or a part such as `DataLayout` would say what they read.

python -m tools.checks.whole_settings   # prints each such function, and their number by package
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("configs", "kernels", "scenes", "synpick_warp", "tools")
_CONFIG = re.compile(r"\bConfig\b")


class Finding(NamedTuple):
    """A function with a parameter of the type `Config`, also as one of several types."""

    path: Path
    line: int
    function: str


def find_functions(path: Path, text: str) -> Iterator[Finding]:
    """Yield the functions and methods of a module that take all settings."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            arguments = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
            if any(each.annotation is not None and _CONFIG.search(ast.unparse(each.annotation)) for each in arguments):
                yield Finding(path, node.lineno, node.name)


def find_all() -> list[Finding]:
    """Findings of all packages; the links in `synpick_warp` to others are not followed."""
    paths = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py")) if path.resolve() == path]
    return [finding for path in paths for finding in find_functions(path.relative_to(ROOT), path.read_text(encoding="utf-8"))]


def main() -> None:
    """Print every function that takes a whole Config, and their number by folder."""
    findings = find_all()
    for finding in findings:
        print(f"{finding.path}:{finding.line}: {finding.function}")
    counts = Counter(finding.path.parts[0] for finding in findings)
    print(f"{len(findings)} functions take a whole Config: {', '.join(f'{name} {count}' for name, count in sorted(counts.items()))}")


if __name__ == "__main__":
    main()
