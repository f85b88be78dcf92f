"""Check of prose for history: what counts, where, and that the project's has none."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.checks.history import documents, find_history


def kinds(text: str, name: str = "page.md") -> list[tuple[int, str]]:
    """(line, kind) of each finding."""
    return [(finding.line, finding.kind) for finding in find_history(Path(name), text)]


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("Measured 2026-11-24.", "date"),
        ("It no longer waits.", "state that is gone"),
        ("The solver used to be slower.", "state that is gone"),
        ("It was 5 ms and is\nnow 3 ms.", "state that is gone"),
        ("Since then it is faster.", "state that is gone"),
        ("1,200 views/s (before: 900).", "figure before and after"),
        ("| before / now |", "figure before and after"),
        ("It takes 97 instead of 130 ms.", "figure before and after"),
        ("(512 worlds; before, 3.5 min)", "figure before and after"),
    ],
)
def test_history_is_found(text, kind):
    assert kind in [found for _, found in kinds(text)]


@pytest.mark.parametrize(
    "text",
    [
        "Weights are used to sum rows.",
        "Four rays instead of one.",
        "The pose before the step.",
        "No longer than 3 m.",
        "before 3 worlds end",
        "Release what is now enqueued.",
        "<!-- results: speed -->\n2026-11-24\n<!-- end of results -->",
    ],
)
def test_other_words_are_no_history(text):
    assert kinds(text) == []


def test_of_programs_docstrings_and_comments_are_read():
    program = '"""Module."""\n\nX = "2026-11-24"\n"""Doc of\n2026-11-23."""\n# A comment,\n# no longer true.\nY = 1  # 2026-11-22\n'
    assert kinds(program, "a.py") == [(5, "date"), (7, "state that is gone"), (8, "date")]
    assert kinds('name = "2026-11-24"  # 2026-11-25\n', "a.toml") == [(1, "date")]


@pytest.mark.slow  # `make checks` finds it, too.
def test_the_project_tells_no_history():
    found = [f"{finding.path}:{finding.line}: {finding.text}" for path in documents() for finding in find_history(path, path.read_text())]
    assert found == []
