"""Documents: fenced lines of the README and of the page on a cell of one's own run as written, links lead somewhere, each arrow of a
frame's way in kernels/README.md is followed by calls and launches of a bake, and the Python API offers what exists."""

import functools
import importlib
import importlib.util
import io
import logging
import os
import re
import shlex
import subprocess
import sys
import threading
import tomllib
import types
from contextlib import redirect_stdout
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import networkx as nx
import pytest
import warp as wp

import synpick_warp
from synpick_warp.configs.files.load import load_config
from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.stages.launch import launch
from synpick_warp.system.progress import SilentProgress
from synpick_warp.testing import box_views
from synpick_warp.testing.exporters import export
from tests.builders import PICKING, STIRRING, assignments, bake_boxes, run
from tests.harness.environment import checkout_environment
from tests.test_bake import TINY

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


def run_blocks(document: str, folder: Path, monkeypatch: pytest.MonkeyPatch, **quick: object) -> str:
    """Execute the code blocks of a document in a folder; returns their output. Commands and Python code run in this process, which has the
    kernels loaded, except for PyTorch's data loader, which forks. `quick`: settings that are added to bakes."""
    stubs = [] if importlib.util.find_spec("torch") else [str(ROOT / "tests" / "stubs")]
    paths = os.pathsep.join([*stubs, *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = checkout_environment(PYTHONPATH=os.pathsep.join([str(ROOT), paths]))
    monkeypatch.chdir(folder)
    monkeypatch.setattr(synpick_warp, "bake", lambda *given, real=synpick_warp.bake: real(*given[:2], quick | given[2]))
    said = ""
    for language, text in blocks(document):
        parts = [text] if language == "python" else re.split(r"^(synpick-warp .*)\n", text, flags=re.MULTILINE)
        for part in filter(str.strip, parts):
            name, *arguments = shlex.split(part, comments=True) if language == "bash" else [part]
            if name == "synpick-warp":
                code, printed, err = run(*arguments, *(("--device", "cpu", *assignments(quick)) if arguments[0] == "bake" else ()))
                assert code == 0, f"{part}\n{printed}\n{err}"
            elif language == "python" and "import torch" not in part:
                with redirect_stdout(io.StringIO()) as out:
                    exec(compile(part, "block", "exec"), {"__name__": "__main__"})
                printed = out.getvalue()
            else:
                program = [sys.executable, "-c", part] if language == "python" else ["bash", "-e", "-c", part]
                done = subprocess.run(program, env=environment, capture_output=True, text=True, timeout=SECONDS)
                assert done.returncode == 0, f"{part}\n{done.stdout}\n{done.stderr}"
                printed = done.stdout
            said += printed
    return said


@pytest.mark.slow(minutes=1)
def test_the_lines_of_the_readme_run_as_written(tmp_path, monkeypatch):
    assert [language for language, _ in blocks(README)].count("python") == 3
    run_blocks(
        README, tmp_path, monkeypatch, **STIRRING | {"cameras.resolution": [160, 90], "arrangement.max_objects": 4, "move.rounds": 1}
    )
    assert (tmp_path / "DATA.png").stat().st_size > 10_000
    assert (tmp_path / "view.png").stat().st_size > 10_000


@pytest.mark.slow(minutes=1)
def test_the_page_on_ones_own_cell_leads_to_a_valid_data_set(tmp_path, monkeypatch):
    said = run_blocks(CELL, tmp_path, monkeypatch, **PICKING)
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
    shown = re.search(r"^    \(cli .*?(?=\n\n)", (ROOT / ".github" / "CONTRIBUTING.md").read_text(), re.DOTALL | re.MULTILINE)
    assert shown
    levels = [re.findall(r"\w+", level) for level in shown[0].split("►")]
    assert levels == [re.findall(r"\w+", layer) for layer in layers]


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 110


# ---- the way of a frame through the code ----


PACKAGE = Path(synpick_warp.__file__).parent
PAGE = (PACKAGE / "kernels" / "README.md").read_text(encoding="utf-8")
NAME = re.compile(r"`([a-z_/]+(?::[A-Za-z_.]+)?)`")
COMMENT = re.compile(r"\([^()]*\)")
"""What a CPU does not launch, and remarks."""
ITEM = re.compile(r"\n(?=\d+\. | +- )")


def chains(section: str) -> list[list[list[str]]]:
    """Items of a numbered list of the page: steps, separated by arrows, each with one name or several; indented ones begin with their
    item's last step."""
    text = PAGE.split(f"\n## {section}\n")[1].split("\n## ")[0]
    items: list[list[list[str]]] = []
    parent: list[list[str]] = []
    for item in ITEM.split(text)[1:]:
        steps = [[match.group(1) for match in NAME.finditer(step)] for step in COMMENT.sub("", item).split("→")]
        nested = item.startswith(" ")
        items.append([*(parent[-1:] if nested else []), *steps])
        parent = parent if nested else steps
    return items


@functools.cache
def device_imports() -> nx.DiGraph:
    """Files of device code, and which they import."""
    graph = nx.DiGraph()
    for file in (PACKAGE / "kernels").rglob("*.py"):
        place = str(file.relative_to(PACKAGE).with_suffix(""))
        for module in re.findall(r"^ *from synpick_warp\.(kernels\.[\w.]+) import", file.read_text(encoding="utf-8"), re.MULTILINE):
            graph.add_edge(place, module.replace(".", "/"))
    return graph


class CallGraph:
    """Functions, as "path:name" below the package, and which called or launched which."""

    def __init__(self) -> None:
        self.graph = nx.DiGraph()
        self._names: dict[CodeType, str | None] = {}

    def name(self, code: CodeType) -> str | None:
        """Name of a function of the package; comprehensions and local functions belong to the function around them."""
        if code not in self._names:
            path = Path(code.co_filename)
            inside = path.is_relative_to(PACKAGE)
            place = path.relative_to(PACKAGE).with_suffix("") if inside else None
            self._names[code] = f"{place}:{code.co_qualname.split('.<')[0]}" if inside else None
        return self._names[code]

    def caller(self, frame: FrameType | None) -> str | None:
        """The function of the package that called, also through others' code."""
        while frame is not None:
            if name := self.name(frame.f_code):
                return name
            frame = frame.f_back
        return None

    def watch(self, frame: FrameType, event: str, _: Any) -> None:
        """Profile function of the interpreter."""
        if event == "call" and (called := self.name(frame.f_code)) and (caller := self.caller(frame.f_back)):
            self.graph.add_edge(caller, called)

    def launched(self, kernel: wp.Kernel) -> None:
        """Add a launch from the frame that called `wp.launch`, or `launch`, which finds arguments by name."""
        frame = sys._getframe(2)
        frame = frame.f_back if frame.f_code is launch.__code__ else frame
        if (called := self.name(kernel.func.__code__)) and (caller := self.caller(frame)):
            self.graph.add_edge(caller, called)

    def leads(self, first: str, second: str) -> bool:
        """Whether calls or launches lead from a function, or one of a file, to another, or to device code that these import."""
        begin = [name for name in self.graph if name == first or name.startswith(f"{first}:")]
        reached = set(begin).union(*(nx.descendants(self.graph, name) for name in begin))
        files = {name.partition(":")[0] for name in reached}
        imports = device_imports()
        imported = set().union(*(nx.descendants(imports, name) for name in files if name in imports))
        return second in reached | files | imported


@pytest.fixture(scope="module")
def calls(tmp_path_factory):
    """Of a bake of one episode, and of an export in this process, whose tasks run in it."""
    calls = CallGraph()
    warps, out = wp.launch, tmp_path_factory.mktemp("spine")

    def record(kernel: Any, *arguments: Any, **options: Any) -> Any:
        calls.launched(kernel)
        return warps(kernel, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wp, "launch", record)
        sys.setprofile(calls.watch)
        threading.setprofile(calls.watch)
        try:
            bake_boxes(out / "bake", TINY | {"bake.episodes": 1, "bake.worlds": 1})
            export(BopExporter, out / "export", box_views.config(), (0,))
        finally:
            sys.setprofile(None)
            threading.setprofile(None)  # type: ignore[arg-type]
    return calls


@pytest.mark.parametrize("chain", chains("A frame, from contact to PNG"), ids=lambda chain: chain[0][0])
def test_each_arrow_of_a_frame_is_followed_by_calls(calls, chain):
    assert len(chain) > 1
    for before, after in pairwise(chain):
        missing = [name for name in after if not any(calls.leads(first, name) for first in before)]
        assert not missing, f"nothing leads from {before} to {missing}"


# ---- the Python API ----

HEAVY = ("warp", "newton", "numpy", "cv2", "zarr", "pxr", "trimesh", "scipy", "coacd", "rich", "cyclopts")


@pytest.fixture
def bakes(monkeypatch) -> list:
    """A stand-in for the pipeline collects the arguments of each bake."""
    module, bakes = types.ModuleType("synpick_warp.factory.pipeline"), []
    module.run_bake = lambda *arguments: bakes.append(arguments)
    monkeypatch.setitem(sys.modules, "synpick_warp.factory.pipeline", module)
    return bakes


def test_everything_offered_exists():
    assert all(hasattr(synpick_warp, name) for name in synpick_warp.__all__)
    errors = [getattr(synpick_warp, name) for name in synpick_warp.__all__ if name.endswith("Error")]
    assert all(issubclass(error, synpick_warp.SynpickError) for error in errors)
    assert len(errors) == 9


def test_no_module_takes_the_name_of_a_function():
    """Importing a submodule sets an attribute of its package, which would replace the function."""
    functions = [name for name in synpick_warp.__all__ if isinstance(getattr(synpick_warp, name), types.FunctionType)]
    assert functions == ["bake", "convert", "evaluate", "load_config", "make_env", "open", "render", "stream", "validate"]
    modules = {path.stem for path in (ROOT / "synpick_warp").iterdir()}
    assert modules.isdisjoint(functions)


def test_notes_of_data_sets_name_what_exists():
    decode_view = importlib.import_module("synpick_warp.dataset.webdataset").decode_view
    assert synpick_warp.webdataset.decode_view is decode_view
    with pytest.raises(AttributeError, match="has no attribute 'pipeline'"):
        _ = synpick_warp.pipeline


def test_importing_and_reading_settings_load_nothing_heavy():
    code = f"import sys, synpick_warp; synpick_warp.load_config('smoke'); print([name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "[]\n"


def test_the_version_stands_in_one_place_and_the_type_marker_is_packaged():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" not in project["project"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "synpick_warp._version.__version__"}
    assert project["tool"]["setuptools"]["package-data"]["synpick_warp"] == ["py.typed"]
    assert (ROOT / "synpick_warp" / "py.typed").is_file()


def test_settings_of_a_preset_are_overridden(tmp_path, bakes, caplog):
    synpick_warp.bake("smoke", str(tmp_path / "set"), {"bake.mode": "move"}, shard=(1, 2))
    [(config, out, progress, shard, *_)] = bakes
    assert config == load_config("smoke", {"bake.mode": "move"}) == synpick_warp.load_config("smoke", {"bake.mode": "move"})
    assert synpick_warp.load_config() == load_config(None, {})
    assert (out, shard) == (tmp_path / "set", (1, 2))
    progress.note("masses are guessed")
    assert caplog.record_tuples == [("synpick_warp", logging.WARNING, "masses are guessed")]


def test_a_config_is_taken_as_it_is(tmp_path, bakes):
    config, progress = synpick_warp.load_config("smoke"), SilentProgress()
    synpick_warp.bake(config, tmp_path, progress=progress)
    synpick_warp.bake(config, tmp_path, devices=("cpu", "cpu"), progress=progress)
    assert bakes == [(config, tmp_path, progress, (0, 1), (), devices) for devices in ((), ("cpu", "cpu"))]
    with pytest.raises(TypeError, match="pass them to load_config"):
        synpick_warp.bake(config, tmp_path, {"bake.mode": "move"})


def test_a_shard_without_episodes_leaves_no_folder(tmp_path):
    for shard, said in (((2, 2), "shard is 2/2; allowed"), ((0, 0), "shard is 0/0"), ((5, 8), "shard 5/8 has none of 2 episodes")):
        with pytest.raises(synpick_warp.ConfigError, match=said):
            synpick_warp.bake("smoke", tmp_path / "set", shard=shard)
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: synpick_warp.evaluate("none", ["a.csv"], min_visibility=2.0), "--visib-min is 2"),
        (lambda: synpick_warp.evaluate("none", [], top=-2), "--results has no value"),
        (lambda: synpick_warp.evaluate("none", ["a.csv"], alpha=0.0), "alpha"),
        (lambda: synpick_warp.validate("none", sample=-1), "sample is -1"),
        (lambda: synpick_warp.validate("none", tolerance=(0.0, 3.0)), "tolerance"),
        (lambda: synpick_warp.convert("none", "out", ("coco",), threads=-1), "threads is -1"),
    ],
)
def test_values_out_of_range_are_refused_before_anything_is_read(call, said):
    with pytest.raises(synpick_warp.ConfigError, match=said):
        call()
