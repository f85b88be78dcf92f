"""The way of a frame through the code, as kernels/README.md draws it: each arrow is followed by calls and launches of a bake."""

from __future__ import annotations

import ast
import functools
import re
import sys
import threading
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import networkx as nx
import pytest
import warp as wp

import synpick_warp
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.stages.launch import launch
from tests.builders import bake_boxes
from tests.harness.exporter_contract import export
from tests.test_bake import TINY
from tests.worlds import box_views

ROOT = Path(synpick_warp.__file__).parent
README = (ROOT / "kernels" / "README.md").read_text(encoding="utf-8")
NAME = re.compile(r"`([a-z_/]+(?::[A-Za-z_.]+)?)`")
COMMENT = re.compile(r"\([^()]*\)")
"""What a CPU does not launch, and remarks."""
ITEM = re.compile(r"\n(?=\d+\. | +- )")


def chains(section: str) -> list[list[list[str]]]:
    """Items of a numbered list of the README: steps, separated by arrows, each with one name or several; indented ones begin with their
    item's last step."""
    text = README.split(f"\n## {section}\n")[1].split("\n## ")[0]
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
    for file in (ROOT / "kernels").rglob("*.py"):
        place = str(file.relative_to(ROOT).with_suffix(""))
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("synpick_warp.kernels."):
                graph.add_edge(place, node.module.removeprefix("synpick_warp.").replace(".", "/"))
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
            inside = path.is_relative_to(ROOT)
            place = path.relative_to(ROOT).with_suffix("") if inside else None
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
