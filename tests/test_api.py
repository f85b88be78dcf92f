"""The Python API: names that `import synpick_warp` offers, and modules that it does not load."""

from __future__ import annotations

import importlib
import logging
import subprocess
import sys
import tomllib
import types
from pathlib import Path

import pytest

import synpick_warp
from synpick_warp.configs.files.load import load_config
from synpick_warp.system.progress import SilentProgress

ROOT = Path(__file__).resolve().parent.parent
HEAVY = ("warp", "newton", "numpy", "cv2", "zarr", "pxr", "trimesh", "scipy", "coacd", "rich", "cyclopts")


@pytest.fixture
def calls(monkeypatch) -> list:
    """A stand-in for the pipeline collects the arguments of each bake."""
    module, calls = types.ModuleType("synpick_warp.factory.pipeline"), []
    module.run_bake = lambda *arguments: calls.append(arguments)
    monkeypatch.setitem(sys.modules, "synpick_warp.factory.pipeline", module)
    return calls


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


def test_settings_of_a_preset_are_overridden(tmp_path, calls, caplog):
    synpick_warp.bake("smoke", str(tmp_path / "set"), {"bake.mode": "move"}, shard=(1, 2))
    [(config, out, progress, shard, *_)] = calls
    assert config == load_config("smoke", {"bake.mode": "move"}) == synpick_warp.load_config("smoke", {"bake.mode": "move"})
    assert synpick_warp.load_config() == load_config(None, {})
    assert (out, shard) == (tmp_path / "set", (1, 2))
    progress.note("masses are guessed")
    assert caplog.record_tuples == [("synpick_warp", logging.WARNING, "masses are guessed")]


def test_a_config_is_taken_as_it_is(tmp_path, calls):
    config, progress = synpick_warp.load_config("smoke"), SilentProgress()
    synpick_warp.bake(config, tmp_path, progress=progress)
    synpick_warp.bake(config, tmp_path, devices=("cpu", "cpu"), progress=progress)
    assert calls == [(config, tmp_path, progress, (0, 1), (), devices) for devices in ((), ("cpu", "cpu"))]
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
