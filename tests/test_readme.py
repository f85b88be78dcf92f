"""Fenced lines of the README and of the page on a cell of one's own, extracted and run in an empty folder; and links of documents."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.builders import PICKING, assignments
from tests.harness.environment import checkout_environment

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
CELL = (ROOT / "configs" / "CELL.md").read_text()
BLOCK = re.compile(r"(?P<skipped><!-- not run: [^\n]* -->\n)?```(?P<language>bash|python)\n(?P<text>.*?)```\n", re.DOTALL)
FOLDERS = (".github", "configs", "kernels", "scenes", "synpick_warp", "tests", "tools")
HISTORY = ROOT / "CHANGELOG.md"
"""Its paths are those of their time."""
DOCUMENTS = sorted({*ROOT.glob("*.md"), *(path.resolve() for folder in FOLDERS for path in (ROOT / folder).rglob("*.md"))})
SOURCE = re.compile(r"`([\w.-]+(?:/[\w.*-]+)+)/?(?::[\w.]+)?`")
"""A path in backticks, such as `stages/ticks:TickLoop.advance` or `tests/stubs/`."""
BASES = ("", "synpick_warp", "synpick_warp/stages", "synpick_warp/exporters", "kernels", "kernels/render")
"""Folders that paths in backticks leave out, besides that of their document."""
DATA = {"..", "SPLIT", "Shoe", "coco", "episodes", "manifest", "materials", "meta", "models", "picks", "source", "train_pbr_web", "usd"}
"""First parts of paths in data sets, in folders of models, and beside the checkout."""
SECONDS = 600
"""Longest time that a block may take."""


def blocks(document: str) -> list[tuple[str, str]]:
    """(language, text) of the blocks that run, in order."""
    return [(match["language"], match["text"]) for match in BLOCK.finditer(document) if not match["skipped"]]


@pytest.fixture
def environment(tmp_path) -> dict[str, str]:
    """The package importable from anywhere, a stand-in for PyTorch where it is missing, and a command `synpick-warp`."""
    command = tmp_path / "bin" / "synpick-warp"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m synpick_warp "$@"\n')
    command.chmod(0o755)
    stubs = [] if importlib.util.find_spec("torch") else [str(ROOT / "tests" / "stubs")]
    paths = os.pathsep.join([*stubs, *filter(None, [os.environ.get("PYTHONPATH")])])
    return checkout_environment(PYTHONPATH=os.pathsep.join([str(ROOT), paths]), PATH=f"{command.parent}:{os.environ['PATH']}")


def run_blocks(document: str, folder: Path, environment: dict[str, str]) -> str:
    """Run the blocks of a document; returns what they print."""
    said = ""
    for language, text in blocks(document):
        program = [sys.executable, "-c", text] if language == "python" else ["bash", "-e", "-c", text]
        done = subprocess.run(program, cwd=folder, env=environment, capture_output=True, text=True, timeout=SECONDS)
        assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
        said += done.stdout
    return said


@pytest.mark.slow(minutes=2)
def test_the_lines_of_the_readme_run_as_written(tmp_path, environment):
    assert [language for language, _ in blocks(README)].count("python") == 3
    run_blocks(README, tmp_path, environment)
    assert (tmp_path / "DATA.png").stat().st_size > 10_000
    assert (tmp_path / "view.png").stat().st_size > 10_000


@pytest.mark.slow(minutes=1)
def test_the_page_on_ones_own_cell_leads_to_a_valid_data_set(tmp_path, environment):
    """Settings of a quick bake are all that is added."""
    bake = "synpick-warp bake "
    assert CELL.count(f"\n{bake}") == 1
    said = run_blocks(CELL.replace(f"\n{bake}", f"\n{bake}{shlex.join(assignments(PICKING))} --device cpu "), tmp_path, environment)
    assert "0 errors" in said
    assert "bracket.stl: 80 x 40 x 30 mm, unit mm" in said
    for name in ("CELL/cell.png", "symmetries.png", "DATA.png", "DATA-report.html", "DATA/camera_left.json", "DATA/usd/000000.usdc"):
        assert (tmp_path / name).stat().st_size > 100, name


def anchors(document: Path) -> set[str]:
    """Anchors of a Markdown file: those of its headings, as GitHub makes them, and those it names."""
    text = document.read_text()
    titles = re.findall(r"^#+ (.*)", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles} | set(re.findall(r'<a id="([^"]*)"', text))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_of_documents_lead_somewhere(document):
    links = [link for link in re.findall(r"\]\(([^)#]*)(?:#([^)]*))?\)", document.read_text()) if not link[0].startswith("http")]
    assert [path for path, _ in links if not (document.parent / path).exists()] == []
    targets = [(document.parent / path if path else document, anchor) for path, anchor in links if anchor]
    assert [anchor for path, anchor in targets if anchor not in anchors(path)] == []


@pytest.mark.parametrize("document", [path for path in DOCUMENTS if path != HISTORY], ids=lambda path: path.relative_to(ROOT).as_posix())
def test_paths_in_documents_exist(document):
    named = {path for path in SOURCE.findall(document.read_text()) if path.partition("/")[0] not in DATA}
    bases = (document.parent, *(ROOT / base for base in BASES))
    missing = {path for path in named if not any(list(base.glob(path + suffix)) for base in bases for suffix in ("", ".py"))}
    assert missing == set()


def test_the_levels_of_contributing_are_those_of_the_import_contract():
    layers = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]["layers"]
    shown = re.search(r"^    cli .*?(?=\n\n)", (ROOT / ".github" / "CONTRIBUTING.md").read_text(), re.DOTALL | re.MULTILINE)
    assert shown
    levels = [re.findall(r"\w+", level) for level in shown[0].split("►")]
    assert levels == [re.findall(r"\w+", layer) for layer in layers]


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 110
