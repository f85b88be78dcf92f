"""Rules of the house: sizes, folders, packages, links, words."""

import ast
import fnmatch
import functools
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.files.load import sections
from synpick_warp.configs.schema import ObjectRow

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = {"synpick_warp", "kernels", "scenes", "configs", "tests", "tools"}
FILES = {"pyproject.toml", "README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", "Makefile"}
HIDDEN = (".gitignore", ".pre-commit-config.yaml", ".ci/run", ".github/CONTRIBUTING.md", ".github/workflows/ci.yml")
LINKS = ("kernels", "scenes", "configs")
MAX_FILE_LINES = 500
MAX_FUNCTION_LINES = 60
SLACK = 100
"""Lines below its budget that a room may have."""
PRIVATE_PATH = re.compile(r"(?<![\w.~:/])/(home|root|Users|work|mnt)/[\w.-]")
"""A path on somebody's own machine."""


def sources() -> Iterator[Path]:
    """Every Python file of the project, once."""
    for folder in sorted(FOLDERS - set(LINKS)):
        yield from sorted((ROOT / folder).rglob("*.py"))


class Module(NamedTuple):
    """What rules ask of a file, whose syntax tree is too large to keep."""

    documented: bool
    functions: tuple[tuple[int, str, int], ...]
    """First line, name and number of lines."""


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """All statements within, and the clauses that hold some; no expressions, which are most of a tree."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.stmt | ast.excepthandler | ast.match_case):
            yield child
            yield from statements(child)


@functools.cache
def parsed(path: Path) -> Module:
    tree = ast.parse(path.read_text())
    functions = [node for node in statements(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    sizes = tuple((node.lineno, node.name, (node.end_lineno or node.lineno) - node.lineno + 1) for node in functions)
    return Module(ast.get_docstring(tree) is not None, sizes)


def ignored(name: str) -> bool:
    patterns = (ROOT / ".gitignore").read_text().split()
    return name.startswith(".") or any(fnmatch.fnmatch(name, pattern.strip("/")) for pattern in patterns)


def test_the_top_level_is_fixed():
    present = {path.name for path in ROOT.iterdir() if not ignored(path.name)}
    assert present <= FOLDERS | FILES
    assert present >= FOLDERS


@pytest.mark.parametrize("name", LINKS)
def test_rooms_of_the_top_level_are_links_into_the_package(name):
    """An archive that stores links as text still installs."""
    link = ROOT / name
    assert link.is_symlink()
    assert link.readlink() == Path("synpick_warp") / name


def test_every_package_is_found():
    """The build takes all folders below synpick_warp that have an `__init__.py`."""
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]["find"]
    assert options == {"include": ["synpick_warp*"], "namespaces": False}
    code = {path.parent for path in (ROOT / "synpick_warp").rglob("*.py")}
    assert [folder for folder in sorted(code) if not (folder / "__init__.py").is_file()] == []


def test_every_room_keeps_its_budget_of_lines():
    """No room exceeds its budget, and a budget follows each cut, so that freed lines cannot be used unnoticed."""
    budget: dict[str, int] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["synpick-warp"]["lines"]
    lines = dict.fromkeys(budget, 0)
    for path in sources():
        places = [parent.relative_to(ROOT).as_posix() for parent in path.parents if parent.is_relative_to(ROOT)]
        lines[next(place for place in places if place in budget)] += len(path.read_text().splitlines())
    assert {room: (count, budget[room]) for room, count in lines.items() if not budget[room] - SLACK <= count <= budget[room]} == {}


def test_files_are_short():
    long = {str(path.relative_to(ROOT)): count for path in sources() if (count := len(path.read_text().splitlines())) > MAX_FILE_LINES}
    assert long == {}


def test_functions_are_short():
    long = {
        f"{path.relative_to(ROOT)}:{line} {name}": length
        for path in sources()
        for line, name, length in parsed(path).functions
        if length > MAX_FUNCTION_LINES
    }
    assert long == {}


def test_every_module_says_what_it_is_for():
    modules = [path for path in sources() if path.relative_to(ROOT).parts[0] != "tests"]
    assert [str(path.relative_to(ROOT)) for path in modules if not parsed(path).documented] == []


def test_nobodys_own_paths_are_in_the_tree():
    texts = [
        path for pattern in ("*.py", "*.toml", "*.md") for folder in sorted(FOLDERS - set(LINKS)) for path in (ROOT / folder).rglob(pattern)
    ]
    texts += [path for name in (*FILES, *HIDDEN) if (path := ROOT / name).is_file()]
    assert [str(path.relative_to(ROOT)) for path in texts if PRIVATE_PATH.search(path.read_text())] == []


@pytest.mark.parametrize("kind", [*sections().values(), ObjectRow], ids=lambda kind: kind.__name__)
def test_every_setting_says_what_it_means(kind):
    assert kind.__doc__
    for name, item in settings_of(kind).items():
        assert item.doc.endswith("."), name
