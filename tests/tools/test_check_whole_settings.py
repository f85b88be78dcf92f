"""Check of parameters: which functions take all settings, and that no more do."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from tools.checks.whole_settings import find_all, find_functions

MAX_PROGRAM, MAX_TOOLS = 52, 19
"""Functions that may take a whole `Config`: whoever assembles, rewrites, stores or prints all settings. New ones take sections."""

MODULE = """
class Stage:
    def __init__(self, config: Config) -> None: ...
    def run(self, bop: Bop, config: "Config | None" = None): ...

def make(render: Render, *, config: schema.Config) -> Config: ...
def none(settings: RenderConfig, section: Callable[[Bake], None]) -> Config: ...
def also_none(config): ...
"""


def test_functions_with_all_settings_are_found():
    assert [finding.function for finding in find_functions(Path("x.py"), MODULE)] == ["make", "__init__", "run"]


def test_functions_take_sections():
    counts = Counter(finding.path.parts[0] == "tools" for finding in find_all())
    assert counts[False] <= MAX_PROGRAM
    assert counts[True] <= MAX_TOOLS
