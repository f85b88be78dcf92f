"""Compilation ahead of launches: dry launches run nothing and name modules, which are compiled once, in threads; SM partitions of a GPU.
Warm-up: it launches what a bake launches, writes caches only, and counts what was compiled."""

import ast
import dataclasses
import shutil
import subprocess
import sys
import threading
import time
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
import warp as wp
from newton._src.geometry import inertia
from warp._src import codegen

from synpick_warp.cli.main import main
from synpick_warp.configs.cell.cameras import CameraRow, Pose
from synpick_warp.configs.schema import Config
from synpick_warp.errors import DeviceError
from synpick_warp.factory import assembly
from synpick_warp.factory.assembly import launch_all, make_compiler
from synpick_warp.kernels.rng import uniform
from synpick_warp.newton_patches.narrow_phase import SHIPPED, slow_builds
from synpick_warp.system.hardware import device as hardware
from synpick_warp.system.hardware import kernels
from synpick_warp.system.hardware.device import SmPartition, opening_context
from synpick_warp.system.hardware.kernels import Compiler, ModuleBuild, build_of, compilation_lock, dry_launches, split_modules
from synpick_warp.system.progress import SilentProgress
from tests.builders import boxes, mistake
from tests.worlds.small_worlds import settings
from tools.narrow_phase import ARCHITECTURES, shipped_builds

MODULES = 1


def make_kernel(factor: float) -> wp.Kernel:
    """A kernel in a module of its own."""
    constant = wp.constant(factor)

    @wp.kernel(module="unique")
    def scale_kernel(values: wp.array[float]):
        values[wp.tid()] *= constant

    return scale_kernel


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    """A kernel cache of this test's own."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    return tmp_path


def test_dry_launches_run_nothing_and_list_what_they_would_load(device, empty_cache):
    scale = make_kernel(3.0)
    values = wp.ones(4, dtype=float, device=device)
    load = wp.Module.load
    with dry_launches() as builds:
        for block in (64, 128, 64):
            wp.launch(scale, dim=4, inputs=[values], device=device, block_dim=block)
        wp.launch(scale, dim=4, inputs=[values], device=device)
    assert wp.Module.load is load
    np.testing.assert_array_equal(values.numpy(), 1.0)
    blocks = (64, 128, 256) if device.is_cuda else (1,)
    assert list(builds) == [ModuleBuild(scale.module, device.alias, block) for block in blocks]
    assert build_of(scale, device) == list(builds)[-1]
    assert list(empty_cache.iterdir()) == []
    wp.launch(scale, dim=4, inputs=[values], device=device)
    np.testing.assert_array_equal(values.numpy(), 3.0)


def test_a_shipped_module_is_taken_if_it_is_of_the_same_sources_and_versions(device, empty_cache, tmp_path_factory, monkeypatch):
    build, other = (build_of(make_kernel(factor), device) for factor in (31.0, 37.0))
    build.module.load(build.device, build.block)
    (folder,), archive = empty_cache.iterdir(), tmp_path_factory.mktemp("shipped") / "modules.zip"
    content = {name: (folder / name).read_bytes() for name in build.names()}
    for version in (None, wp.config.version):  # There is no archive at first.
        shutil.rmtree(folder, ignore_errors=True)
        build.take_shipped(archive)
        assert build.is_cached() is (version is not None)
        with ZipFile(archive, "w") as shipped:
            for name, data in content.items():
                shipped.writestr(f"{build.shipped_key()}/{name}", data)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == content
    other.take_shipped(archive)
    shutil.rmtree(folder)
    monkeypatch.setattr(wp.config, "version", "0.0.0")
    build.take_shipped(archive)
    assert list(empty_cache.iterdir()) == []


def test_the_shipped_modules_are_those_of_the_present_sources():
    """`python -m tools.narrow_phase` compiles them again. With other versions than these, a bake compiles what it does not find."""
    made_for = {"warp-lang": "1.19.0", "newton": "1.8.0"}
    if made_for != {name: metadata.version(name) for name in made_for}:
        pytest.skip("the modules are shipped for other versions")
    expected = {f"{build.shipped_key()}/{name}" for build in shipped_builds() for each in ARCHITECTURES for name in build.names(each)}
    with ZipFile(SHIPPED) as archive:
        assert set(archive.namelist()) == expected


def test_modules_that_the_cache_lacks_are_compiled_once_and_counted(device, empty_cache):
    """Submitted ones, a marker after them, and one that a launch compiles."""
    scales = [make_kernel(5.0 + index) for index in range(MODULES + 2)]
    builds = [build_of(scale, device) for scale in scales]
    assert not any(build.is_cached() for build in builds)
    values, reports = wp.ones(4, dtype=float, device=device), []
    with Compiler(lambda *counts: reports.append(counts), last=builds[MODULES]) as compiler:
        compiler.submit(builds[: MODULES + 1])
        assert not builds[MODULES].is_cached()
        for scale in scales:
            wp.launch(scale, dim=4, inputs=[values], device=device)
    assert (compiler.compiled, reports[-1]) == (MODULES + 2, (MODULES + 2, MODULES + 2))
    assert all(ready <= total for ready, total in reports)
    np.testing.assert_array_equal(values.numpy(), 5.0 * 6.0 * 7.0)
    assert len(kernels.list_binaries()) == MODULES + 2
    with Compiler(lambda *_: pytest.fail("nothing is missing")) as compiler:
        compiler.submit(builds)
    assert compiler.compiled == 0


def test_a_context_is_created_in_a_thread_and_its_faults_are_left_to_the_first_use():
    class Device:
        @property
        def context(self):
            threads.append(threading.current_thread())
            raise RuntimeError("there is no memory")

    threads = []
    for device in (Device(), None):
        with opening_context(device):
            pass
    assert len(threads) == 1
    assert threads[0] is not threading.current_thread()


def test_a_launch_waits_for_the_thread_that_compiles_its_module(device, empty_cache, monkeypatch):
    """Reports go on meanwhile, and nothing is compiled twice."""
    scale, reports, loads, load = make_kernel(13.0), [], [], wp.Module.load
    begun = threading.Event()

    def load_slowly(module, *arguments, **options):
        loads.append(threading.current_thread().name)
        if loads[-1].startswith("compile"):
            begun.set()
            while len(reports) < 3:
                time.sleep(0.01)
        return load(module, *arguments, **options)

    monkeypatch.setattr(wp.Module, "load", load_slowly)
    monkeypatch.setattr(kernels, "REPORT_INTERVAL", 0.01)
    values = wp.ones(4, dtype=float, device=device)
    with Compiler(lambda *counts: reports.append(counts)) as compiler:
        compiler.submit([build_of(scale, device)])
        assert begun.wait(60)
        wp.launch(scale, dim=4, inputs=[values], device=device)
    np.testing.assert_array_equal(values.numpy(), 13.0)
    assert loads[0].startswith("compile")
    assert (reports[0], reports[-1], compiler.compiled) == ((0, 1), (1, 1), 1)


def test_hashes_that_warp_drops_meanwhile_are_made_again(device, empty_cache, monkeypatch):
    """As by an overload that another thread registers while a module compiles: its load ends with a KeyError, and the next one succeeds."""
    scale, load, loads = make_kernel(17.0), wp.Module.load, []

    def load_without_hashes(module, *arguments, **options):
        loads.append(module)
        done = load(module, *arguments, **options)
        if len(loads) == 1:
            module.mark_modified()
            return module.hashers[1]
        return done

    monkeypatch.setattr(wp.Module, "load", load_without_hashes)
    values = wp.ones(4, dtype=float, device=device)
    with Compiler(lambda *_: None) as compiler:
        compiler.submit([build_of(scale, device)])
        wp.launch(scale, dim=4, inputs=[values], device=device)
    np.testing.assert_array_equal(values.numpy(), 17.0)
    assert compiler.compiled == 1
    assert len(loads) > 1
    assert len(kernels.list_binaries()) == 1


def test_a_compiler_that_fails_is_told(device, empty_cache, monkeypatch):
    builds = [build_of(make_kernel(9.0 + index), device) for index in range(MODULES)]

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("no space left")

    monkeypatch.setattr(wp.Module, "load", fail)
    with pytest.raises(RuntimeError, match="no space left"), Compiler(lambda *_: None) as compiler:
        compiler.submit(builds)
    assert wp.Module.load is fail


def test_kernels_of_a_library_get_modules_of_their_own(device, empty_cache):
    """One is launched, and the other one is not compiled; a generic kernel's overloads do not compile others again."""
    module = wp.get_module("tests.library")

    def double(values: wp.array[float]):
        values[wp.tid()] *= 2.0

    def triple(values: wp.array[Any]):
        values[wp.tid()] *= values.dtype(3.0)

    doubling, tripling = (wp.Kernel(func, key=func.__name__, module=module) for func in (double, triple))
    split_modules(("tests.lib",))
    values = wp.ones(4, dtype=float, device=device)
    wp.launch(doubling, dim=4, inputs=[values], device=device)
    assert len(kernels.list_binaries()) == 1
    wp.launch(tripling, dim=4, inputs=[values], device=device)
    wp.launch(tripling, dim=4, inputs=[wp.ones(4, dtype=wp.float64, device=device)], device=device)
    np.testing.assert_array_equal(values.numpy(), 6.0)
    assert {kernel.module.name for kernel in (doubling, tripling)} == {"tests.library.double", "tests.library.triple"}
    assert len(kernels.list_binaries()) == 3


def test_warp_finds_what_modules_of_others_use_alone():
    """It unloads them with what they use, if that is imported anew."""

    def draw(values: wp.array[float]):
        values[wp.tid()] = uniform(wp.uint64(1), 0)

    others, ours = (wp.Module(name, None) for name in ("theirs", "synpick_warp.kernels.drawing"))
    for module in (others, ours):
        wp.Kernel(draw, key="draw", module=module)
    assert (others.references, ours.references) == ({uniform.module}, set())


def test_source_code_of_newtons_functions_is_read_when_it_is_needed():
    """Known: source and syntax tree that Warp reads at definition. Parameters are known before the source is read."""
    function = inertia.triangle_inertia.func
    adjoint, read = codegen.Adjoint(function), codegen.Adjoint.extract_function_source(function)
    assert list(adjoint.arg_types) == [each.label for each in adjoint.args] == ["v0", "v1", "v2"]
    assert "tree" not in vars(adjoint)
    assert (adjoint.source, adjoint.fun_lineno, adjoint.fun_name) == (*read[:2], "triangle_inertia")
    assert adjoint.source_lines == read[0].splitlines()
    assert ast.dump(adjoint.tree) == ast.dump(read[2])
    assert not hasattr(adjoint, "branch")


HOLDER = """
import sys, warp as wp
from synpick_warp.system.hardware.kernels import compilation_lock
wp.config.kernel_cache_dir = sys.argv[1]
with compilation_lock(lambda: None):
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_one_process_compiles_and_the_others_wait_for_it(empty_cache):
    """The other process ends, and with it its lock, when this one says that it waits."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(empty_cache)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdin
        assert other.stdout
        assert other.stdout.readline() == "locked\n"
        waited = []
        with compilation_lock(lambda: waited.append(other.stdin.close())):  # type: ignore[union-attr]
            assert len(waited) == 1
    with compilation_lock(lambda: waited.append(None)):
        assert len(waited) == 1


def test_a_cache_that_cannot_be_locked_is_used_unlocked(tmp_path, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "missing"))
    with compilation_lock(lambda: pytest.fail("nobody holds it")):
        pass
    assert not (tmp_path / "missing").exists()


# ---- SM partitions: placement of kernels, and errors of drivers that do not support them ----


BLOCKS, SPINS = 4096, 2000
GPU = SimpleNamespace(alias="cuda:0", ordinal=0, sm_count=132)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned index;
    asm volatile("mov.u32 %0, %%smid;" : "=r"(index));
    return static_cast<wp::int32>(index);
#else
    return 0;
#endif
""")
def multiprocessor() -> int:
    """Index of the multiprocessor on which the thread runs."""


@wp.kernel(enable_backward=False)
def count_blocks_kernel(spins: int, blocks_out: wp.array[int]):
    """Histogram of threads over multiprocessors (multiprocessor). Threads spin, so that the grid spreads over all that it may use."""
    x = float(wp.tid())
    for _ in range(spins):
        x = wp.sin(x) + 1.0
    wp.atomic_add(blocks_out, multiprocessor() + wp.min(0, int(x)), 1)


def find_multiprocessors(device: wp.Device, stream: wp.Stream, captured: bool = False) -> set[int]:
    """Multiprocessors that the blocks of a kernel on `stream` run on, or of a graph in which another stream forks to it and joins it."""
    blocks = wp.zeros(2 * device.sm_count, dtype=int, device=device)

    def launch() -> None:
        with wp.ScopedStream(stream, sync_exit=True):
            wp.launch(count_blocks_kernel, dim=32 * BLOCKS, inputs=[SPINS], outputs=[blocks], block_dim=32, device=device)

    launch()
    if captured:
        with wp.ScopedStream(wp.Stream(device), sync_exit=True):
            with wp.ScopedCapture(device) as capture:
                launch()
            blocks.zero_()
            wp.capture_launch(capture.graph)
    found = blocks.numpy()
    assert int(found.sum()) == 32 * BLOCKS
    return set(np.flatnonzero(found).tolist())


@pytest.mark.parametrize("reserved", [8, 24])
def test_kernels_on_a_stream_of_a_partition_leave_the_other_multiprocessors_free(device, reserved):
    if not device.is_cuda:
        pytest.skip("a CPU has no multiprocessors")
    partition = SmPartition(device, reserved)
    assert partition.size + partition.reserved == device.sm_count
    assert partition.reserved >= reserved
    main, kept = (find_multiprocessors(device, partition.make_stream(on_reserved)) for on_reserved in (False, True))
    assert (len(main), len(kept)) == (partition.size, partition.reserved)
    assert not main & kept
    assert find_multiprocessors(device, wp.Stream(device)) == main | kept
    assert find_multiprocessors(device, partition.make_stream(on_reserved=True), captured=True) == kept
    with pytest.raises(DeviceError, match="cuDevSmResourceSplitByCount failed"):
        SmPartition(device, 2 * device.sm_count)  # More than there are.


SPLIT = ("cuDeviceGet", "cuDeviceGetDevResource", "cuDevSmResourceSplitByCount", "cuDevResourceGenerateDesc", "cuGreenCtxCreate")
"""Driver functions that create a partition, in call order."""


@pytest.fixture
def drive(monkeypatch):
    """Factory that replaces the CUDA driver by a fake with the first functions of SPLIT; the last one returns `code`. Records all calls."""

    def install(functions: int, code: int = 0) -> list[tuple[str, tuple]]:
        calls: list[tuple[str, tuple]] = []
        names = SPLIT[:functions]
        driver = {
            name: lambda *arguments, name=name: calls.append((name, arguments)) or code * (name == names[-1])  # type: ignore[func-returns-value]
            for name in names
        }
        monkeypatch.setattr(hardware, "_load_driver", lambda: SimpleNamespace(**driver))
        return calls

    return install


@pytest.mark.parametrize("functions", range(1, len(SPLIT) + 1))
def test_an_old_driver_has_no_partitions_or_none_with_streams(drive, functions):
    """CUDA 12.4 has partitions, but no streams on them."""
    drive(functions)
    missing = (*SPLIT, "cuGreenCtxStreamCreate")[functions]
    with pytest.raises(DeviceError, match=rf"cuda:0: the driver has no {missing}: green contexts with streams need CUDA 12\.5"):
        SmPartition(GPU, 8).make_stream()


def test_a_device_that_cannot_be_divided_is_an_error_of_one_line(drive):
    calls = drive(3, code=801)
    with pytest.raises(DeviceError, match=r"^cuda:0: cuDevSmResourceSplitByCount failed with CUDA error 801$"):
        SmPartition(GPU, 24)
    assert [name for name, _ in calls] == list(SPLIT[:3])
    assert calls[-1][1][-1] == 24


# ---- warm-up ----

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
    result = assembly.warm_up(TINY, SilentProgress())
    rooms = {name.split(".")[2] for name in loaded if name.startswith("synpick_warp.kernels.")}
    assert rooms >= {"sim", "perception", "render", "encoding"}
    assert result.compiled >= 0
    assert result.seconds > 0.0


def test_a_warm_up_compiles_what_only_a_stream_launches(monkeypatch):
    submitted = []
    monkeypatch.setattr(Compiler, "submit", lambda compiler, builds: submitted.append([build.module.name for build in builds]))
    assembly.warm_up(settings(cameras__resolution=[32, 18]), SilentProgress())
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
    monkeypatch.setattr(assembly, "warm_up", lambda config, progress: assembly.WarmUp(3, 1.25))
    monkeypatch.chdir(tmp_path)
    assert main(["warmup", "--config", "smoke", "--device", "cpu"]) == 0
    assert capsys.readouterr().out == "ready in 1.2 s: 3 modules compiled, the others were in the kernel cache\n"
    assert list(Path(tmp_path).iterdir()) == []


@pytest.mark.parametrize(("variable", "name"), [("WARP_CACHE_PATH", "kernel"), ("XDG_CACHE_HOME", "shape")])
def test_a_cache_that_cannot_be_written_is_a_mistake(tmp_path, monkeypatch, variable, name):
    """The kernels went into a temporary folder, which was removed, with exit code 0."""
    monkeypatch.setattr(assembly, "warm_up", lambda config, progress: pytest.fail("it compiles"))
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "kernels"))
    (tmp_path / "file").touch()
    monkeypatch.setenv(variable, str(tmp_path / "file" / "cache"))
    line = mistake("warmup", "--config", "smoke", "--device", "cpu")
    assert line.startswith(f"the {name} cache {tmp_path}/file/cache")
    assert line.endswith(f"(Not a directory), so that a warm-up would be lost; set {variable} to a folder that can be written")
    assert "there is no models folder /nowhere/models" in mistake("warmup", "--models", "/nowhere/models")
