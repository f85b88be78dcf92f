"""The README's fenced lines, extracted and run as written in an empty folder; and its links."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness.environment import checkout_environment

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
BLOCK = re.compile(r"(?P<skipped><!-- not run: [^\n]* -->\n)?```(?P<language>bash|python)\n(?P<text>.*?)```\n", re.DOTALL)
DOCUMENTS = [
    *ROOT.glob("*.md"),
    *ROOT.glob("*/README.md"),
    ROOT / "synpick_warp" / "exporters" / "README.md",
    ROOT / "synpick_warp" / "online" / "README.md",
    ROOT / ".github" / "CONTRIBUTING.md",
]
SECONDS = 600
"""Longest time that a block may take."""


def blocks() -> list[tuple[str, str]]:
    """(language, text) of the blocks that run, in order."""
    return [(match["language"], match["text"]) for match in BLOCK.finditer(README) if not match["skipped"]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("readme")


@pytest.fixture(scope="module")
def environment(folder) -> dict[str, str]:
    """The package importable from anywhere, a stand-in for PyTorch where it is missing, and a command `synpick-warp`."""
    command = folder / "bin" / "synpick-warp"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m synpick_warp "$@"\n')
    command.chmod(0o755)
    stubs = [] if importlib.util.find_spec("torch") else [str(ROOT / "tests" / "stubs")]
    paths = os.pathsep.join([*stubs, *filter(None, [os.environ.get("PYTHONPATH")])])
    return checkout_environment(PYTHONPATH=os.pathsep.join([str(ROOT), paths]), PATH=f"{command.parent}:{os.environ['PATH']}")


@pytest.mark.slow
def test_the_lines_of_the_readme_run_as_written(folder, environment):
    assert [language for language, _ in blocks()].count("python") == 3
    for language, text in blocks():
        program = [sys.executable, "-c", text] if language == "python" else ["bash", "-e", "-c", text]
        done = subprocess.run(program, cwd=folder, env=environment, capture_output=True, text=True, timeout=SECONDS)
        assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
    assert (folder / "DATA.png").stat().st_size > 10_000
    assert (folder / "view.png").stat().st_size > 10_000


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_of_documents_lead_somewhere(document):
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", document.read_text())
    missing = [link for link in links if not link.startswith("http") and not (document.parent / link).exists()]
    assert missing == []


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 145
