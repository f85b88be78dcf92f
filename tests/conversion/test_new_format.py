"""A package of others (tests/plugins) adds a format and a gripper: bakes, `verify` and `convert` know them as they know ours."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import synpick_warp
from synpick_warp.apps.conversion.run import convert
from synpick_warp.configs.schema import FORMATS
from synpick_warp.exporters.formats import FORMAT_TABLE
from tests.builders import PICKING, assignments
from tests.conversion.test_convert import settings
from tests.harness import scripted_bake
from tests.harness.environment import checkout_environment
from tests.harness.scripted_bake import snapshot
from tests.worlds import box_views

PLUGINS = Path(__file__).parents[1] / "plugins"


@pytest.fixture
def boxes(monkeypatch) -> None:
    monkeypatch.syspath_prepend(PLUGINS)
    from synpick_extras.boxes import FORMAT

    monkeypatch.setitem(FORMAT_TABLE, "boxes", FORMAT)


def test_a_package_of_others_bakes_its_format_with_its_gripper(tmp_path):
    environment = checkout_environment()
    environment["PYTHONPATH"] += f":{PLUGINS}"

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "synpick_warp", *arguments]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)

    options = ("--formats", "boxes,zarr", "--device", "cpu", *assignments(PICKING | {"gripper.kind": "triangle"}))
    done = run("bake", "--config", "smoke", *options, "--out", "DATA")
    assert done.returncode == 0, done.stderr
    assert run("verify", "DATA").returncode == 0
    assert len(list((tmp_path / "DATA" / "boxes").glob("*/*.json"))) > 10
    assert "triangle" in (tmp_path / "DATA" / "config.toml").read_text()


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
    """Collections that name three formats or more, besides settings and their rules, which must not import exporters."""
    listing = set()
    root = Path(synpick_warp.__file__).parent
    for path in set(root.rglob("*.py")) - set((root / "configs").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            values = node.keys if isinstance(node, ast.Dict) else node.elts if isinstance(node, ast.Tuple | ast.List | ast.Set) else ()
            if sum(isinstance(value, ast.Constant) and value.value in FORMATS for value in values) >= 3:
                listing.add(path.name)
    assert listing == {"formats.py"}
