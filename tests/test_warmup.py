"""Warm-up: it launches what a bake launches, writes caches only, and counts what was compiled."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import warp as wp

from synpick_warp.cli.main import main
from synpick_warp.configs.cell.cameras import CameraRow, Pose
from synpick_warp.configs.schema import Config
from synpick_warp.factory import assembly, warmup
from synpick_warp.factory.assembly import launch_all, make_compiler
from synpick_warp.newton_patches.narrow_phase import slow_builds
from synpick_warp.system.hardware.kernels import Compiler, ModuleBuild, dry_launches
from synpick_warp.system.progress import SilentProgress
from tests.builders import boxes, mistake
from tests.worlds.small_worlds import settings

TINY = settings(bake__mode="pick", cameras__resolution=[32, 18], perception__resolution=[64, 36])


@pytest.fixture(autouse=True)
def all_boxes():
    with boxes():
        yield


def smallest(config: Config, device: wp.Device) -> assembly.Factory:
    return assembly.build_smallest(config, device, SilentProgress(), online=True)


def test_a_warm_up_loads_the_kernels_of_all_stages(monkeypatch):
    loaded = set()
    launch = wp.launch

    def record(kernel, *arguments, **options):
        loaded.add(kernel.module.name)
        return launch(kernel, *arguments, **options)

    monkeypatch.setattr(wp, "launch", record)
    result = warmup.warm_up(TINY, SilentProgress())
    rooms = {name.split(".")[2] for name in loaded if name.startswith("synpick_warp.kernels.")}
    assert rooms >= {"sim", "perception", "render", "encoding"}
    assert result.compiled >= 0
    assert result.seconds > 0.0


def test_a_warm_up_compiles_what_only_a_stream_launches(monkeypatch):
    submitted = []
    monkeypatch.setattr(Compiler, "submit", lambda compiler, builds: submitted.append([build.module.name for build in builds]))
    warmup.warm_up(settings(cameras__resolution=[32, 18]), SilentProgress())
    _, only_stream, others = submitted
    assert only_stream == ["synpick_warp.kernels.render.images.ground_truth"]
    assert not set(only_stream) & set(others)


def test_dry_launches_find_all_that_a_warm_up_loads(device):
    """What launches for real load afterwards has been found before, whatever the cache holds; the modules that are compiled first, too.

    These have all that building loads (on the CPU, on which the list was made)."""
    compiler: Any = SimpleNamespace(submitted=[])
    compiler.submit = compiler.submitted.extend
    assembly.submit_slow(compiler, device, TINY)
    early = {build: build.module.get_module_identifier(build.block) for build in compiler.submitted}
    with make_compiler(None, SilentProgress()) as building:
        factory = smallest(TINY, device)
    assert building._seen <= early.keys() or device.is_cuda
    found = []
    for _ in range(2):
        with dry_launches() as builds:
            launch_all(factory.simulation, factory.stream)
        factory.simulation.clear_graphs()
        found.append(set(builds))
        launch_all(factory.simulation, factory.stream)
        factory.simulation.clear_graphs()
    assert found[0] == found[1] >= set(slow_builds(device))
    assert {build: build.module.get_module_identifier(build.block) for build in early} == early
    assert all(build.is_cached() for build in found[0])


def test_a_dry_run_takes_a_camera_on_the_gripper(device):
    """Nothing has been simulated then: the poses of the gripper are zeros."""
    row = CameraRow(fov=60.0, pose=Pose(position=(0.1, 0.0, 0.1), look_at=(0.0, 0.0, -0.1), up=(0.0, 1.0, 0.0)), fixed_to="gripper")
    config = dataclasses.replace(settings(bake__mode="move", cameras__resolution=[32, 18]), camera=(row,))
    factory = smallest(config, device)
    with dry_launches():
        launch_all(factory.simulation, factory.stream)


def test_a_cold_start_says_how_many_modules_it_compiles(monkeypatch):
    """Worlds are built meanwhile; here one module is missing, the one that is compiled last."""
    stages = []
    monkeypatch.setattr(assembly, "is_cache_warm", lambda device: False)
    monkeypatch.setattr(ModuleBuild, "is_cached", lambda self: self.module.name != "synpick_warp.kernels.sim.snapshot")
    progress = SilentProgress()
    monkeypatch.setattr(progress, "stage", stages.append, raising=False)
    config = settings(cameras__resolution=[32, 18])
    assembly.build_factory(config, progress, [0])
    stages = [stage for stage in stages if not stage.startswith("waiting for another process")]  # Other tests may be compiling.
    assert stages[:2] == ["compiling kernels, once", "loading objects and lights"]
    assert stages[-2:] == [f"compiling kernels: {ready} of 1 modules" for ready in (0, 1)]


def test_the_command_says_what_it_did(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(warmup, "warm_up", lambda config, progress: warmup.WarmUp(3, 1.25))
    monkeypatch.chdir(tmp_path)
    assert main(["warmup", "--config", "smoke", "--device", "cpu"]) == 0
    assert capsys.readouterr().out == "ready in 1.2 s: 3 modules compiled, the others were in the kernel cache\n"
    assert list(Path(tmp_path).iterdir()) == []


@pytest.mark.parametrize(("variable", "name"), [("WARP_CACHE_PATH", "kernel"), ("XDG_CACHE_HOME", "shape")])
def test_a_cache_that_cannot_be_written_is_a_mistake(tmp_path, monkeypatch, variable, name):
    """The kernels went into a temporary folder, which was removed, with exit code 0."""
    monkeypatch.setattr(warmup, "warm_up", lambda config, progress: pytest.fail("it compiles"))
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "kernels"))
    (tmp_path / "file").touch()
    monkeypatch.setenv(variable, str(tmp_path / "file" / "cache"))
    line = mistake("warmup", "--config", "smoke", "--device", "cpu")
    assert line.startswith(f"the {name} cache {tmp_path}/file/cache")
    assert line.endswith(f"(Not a directory), so that a warm-up would be lost; set {variable} to a folder that can be written")
    assert "there is no models folder /nowhere/models" in mistake("warmup", "--models", "/nowhere/models")
