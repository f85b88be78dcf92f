"""Warm-up: it launches what a bake launches, writes caches only, and counts what was compiled."""

from __future__ import annotations

from pathlib import Path

import pytest
import warp as wp

from synpick_warp import pipeline, warmup
from synpick_warp.cli.commands import main
from synpick_warp.progress import SilentProgress
from tests.worlds.small_worlds import catalog, settings


@pytest.fixture(autouse=True)
def boxes(monkeypatch):
    monkeypatch.setattr(pipeline, "load_catalog", lambda config, report: catalog())


def test_a_warm_up_loads_the_kernels_of_all_stages(monkeypatch):
    loaded = set()
    launch = wp.launch

    def record(kernel, *arguments, **options):
        loaded.add(kernel.module.name)
        return launch(kernel, *arguments, **options)

    monkeypatch.setattr(wp, "launch", record)
    result = warmup.warm_up(settings(bake__mode="pick", cameras__resolution=[32, 18], perception__resolution=[64, 36]), SilentProgress())
    rooms = {name.split(".")[2] for name in loaded if name.startswith("synpick_warp.kernels.")}
    assert rooms >= {"sim", "perception", "render", "encoding"}
    assert result.compiled >= 0
    assert result.seconds > 0.0


def test_compiled_modules_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    (tmp_path / "wp_old").mkdir()
    (tmp_path / "wp_old" / "old.o").touch()
    watch = warmup.CompilationWatch(SilentProgress())
    with watch:
        (tmp_path / "wp_new").mkdir()
        (tmp_path / "wp_new" / "new.cubin").touch()
        (tmp_path / "wp_new" / "new.meta").touch()
    assert watch.compiled == 1


def test_the_command_says_what_it_did(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(warmup, "warm_up", lambda config, progress: warmup.WarmUp(3, 1.25))
    monkeypatch.chdir(tmp_path)
    assert main(["warmup", "--config", "smoke", "--device", "cpu"]) == 0
    assert capsys.readouterr().out == "ready in 1.2 s: 3 modules compiled, the others were in the kernel cache\n"
    assert list(Path(tmp_path).iterdir()) == []


def test_folders_that_are_missing_are_named(capsys):
    assert main(["warmup", "--models", "/nowhere/models"]) == 2
    assert "there is no models folder /nowhere/models" in capsys.readouterr().err
