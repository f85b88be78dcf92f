"""A format that nothing but the table of formats knows: bakes and `convert` write it, byte for byte the same."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

import synpick_warp
from synpick_warp.apps.conversion.run import convert
from synpick_warp.configs.schema import FORMATS
from synpick_warp.exporters.formats import FORMAT_TABLE, Format
from tests.conversion.test_convert import settings
from tests.harness import scripted_bake
from tests.harness.scripted_bake import snapshot
from tests.worlds import box_views, boxes_format


@pytest.fixture
def boxes(monkeypatch) -> None:
    """All that makes it known to bakes, `convert`, manifest and reader: its row in the table of formats."""
    row = Format("boxes", "BoxesExporter", "", lambda _, episode: f"boxes/{episode:06d}/.*", sources=lambda _: ("views", "masks"))
    monkeypatch.setitem(FORMAT_TABLE, "boxes", row)
    monkeypatch.setitem(sys.modules, "synpick_warp.exporters.boxes", boxes_format)


def test_a_new_format_is_converted_for_free(tmp_path, boxes, monkeypatch):
    monkeypatch.setattr("synpick_warp.scenes.cameras.make_cameras", lambda _: box_views.cameras(16, 12))
    for name in ("bop", "shards", "boxes"):
        scripted_bake.bake(tmp_path / name, settings(name))
    baked = snapshot(tmp_path / "boxes")
    assert sum(name.endswith("_flow.png") for name in baked) == 2 * 3 * scripted_bake.FRAMES
    for source in ("bop", "shards"):
        convert(tmp_path / source, tmp_path / f"{source}-boxes", ("boxes",), 1, lambda *_: None)
        assert snapshot(tmp_path / f"{source}-boxes") == baked


def test_nothing_else_lists_formats():
    """Collections that name three formats or more, besides the values of the setting `bake.formats`, which must not import exporters."""
    listing = set()
    for path in Path(synpick_warp.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            values = node.keys if isinstance(node, ast.Dict) else node.elts if isinstance(node, ast.Tuple | ast.List | ast.Set) else ()
            if sum(isinstance(value, ast.Constant) and value.value in FORMATS for value in values) >= 3:
                listing.add(path.name)
    assert listing == {"formats.py"}
