"""Configuration of pytest: devices, hypothesis profile, real data."""

import gc
import itertools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import warp as wp
from hypothesis import settings

from synpick_warp.exporters.writing import pool
from synpick_warp.system.hardware.device import pick_device, start_warp
from tests.harness.environment import VARIABLE

ROOT = Path(__file__).resolve().parent.parent
REAL_DATA = ROOT.parent / "shared" / "data"
"""Real objects and lights, where somebody has put them beside the checkout; tests that want them are skipped elsewhere."""

MEMORY, ROOM = Path("/dev/shm"), 4 << 30
"""RAM disk for the temporary files of tests, and the free space it must have [B]: on a disk, file operations take five times as long."""

# Examples follow from the test's name, so that two runs do the same; compiling a kernel may take any time.
settings.register_profile("house", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("house")


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--device cuda:0` runs all tests that simulate or render on that device."""
    parser.addoption(
        "--device",
        action="append",
        help="device under test; may be repeated (default: cpu, and cuda:0 where there is one for tests with the fixture `device`)",
    )

    parser.addoption("--check-bounds", action="store_true", help="compile kernels in Warp's debug mode, which checks array indices")


def pytest_configure(config: pytest.Config) -> None:
    """Start Warp before the first test, so that its messages stay out of captured output.

    Shells let background jobs ignore SIGINT, and so would all processes that tests start; it acts here as in the foreground.
    """
    gc.disable()  # What is imported stays: to look through it again and again takes a third of the time of the collection of tests.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # Neither other processes of this run nor those that tests start compile the sources again, whatever the shell says.
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ[VARIABLE] = devices(config)[0]
    if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > ROOM:
        tempfile.tempdir = os.environ["TMPDIR"] = str(MEMORY)
    # USD starts a thread a core, of which some wait by polling for the rest of the run. Without the second it reports the first.
    os.environ.update({"PXR_WORK_THREAD_LIMIT": "1", "TF_ENV_SETTING_ALERTS_ENABLED": "0"})
    if config.getoption("--check-bounds"):
        _check_bounds(config)
    start_warp()
    # Writer processes of lower priority get little CPU time while other tests saturate all cores, and stall their bakes.
    pool.NICENESS = 0


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Each process begins with its share of the tests that take minutes, so that none has one left when the others have ended.

    `--dist worksteal` hands each process one part of the list at the start.
    """
    minutes = {item: mark.kwargs.get("minutes", 0) for item in items if (mark := item.get_closest_marker("slow"))}
    long = sorted((item for item in items if minutes.get(item)), key=lambda item: -minutes[item])
    others = iter([item for item in items if not minutes.get(item)])
    left, processes = len(items), getattr(config, "workerinput", {}).get("workercount", 1)
    items.clear()
    for index in range(processes):
        share = long[index::processes]
        size = left // (processes - index)
        items += [*share, *itertools.islice(others, max(0, size - len(share)))]
        left -= size
    items += others


def pytest_collection_finish() -> None:
    """Garbage collections pass over modules and tests from here on."""
    gc.freeze()
    gc.enable()


def _check_bounds(config: pytest.Config) -> None:
    """Debug mode, with one core a process: in that mode CPU kernels share a static variable, so launches in several threads crash."""
    wp.config.mode = "debug"
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    cores = sorted(os.sched_getaffinity(0))
    if worker or not config.getoption("numprocesses", None):
        os.sched_setaffinity(0, {cores[int(worker.removeprefix("gw") or 0) % len(cores)]})


def devices(config: pytest.Config) -> list[str]:
    """Names of the devices under test; the first is the default device of settings in tests."""
    return config.getoption("--device") or ["cpu", *(["cuda:0"] if wp.get_cuda_device_count() else [])]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrize the fixture `device`."""
    if "device" in metafunc.fixturenames:
        metafunc.parametrize("device", devices(metafunc.config), indirect=True, scope="session")


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> wp.Device:
    """Device under test. On the CPU results must agree to the bit; a GPU may round differently where a test says so."""
    return pick_device(request.param)


@pytest.fixture(scope="session", autouse=True)
def quick_worlds() -> Iterator[None]:
    """What takes most of the time to build small worlds is made once a process, and small data sets are written in it."""
    from tests.harness.made_once import made_once, written_here

    with made_once(), written_here():
        yield


@pytest.fixture(scope="session")
def picked_set(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two episodes of mode pick as scenes with two layers, shards, stages and trajectories, baked once for all processes. Read only."""
    from tests.builders import PICKED, bake_boxes, once

    folder, _ = once(tmp_path_factory, "picked", lambda out: bake_boxes(out, PICKED))
    before = _times(folder)
    yield folder
    assert _times(folder) == before, "a test has changed the shared data set"


def _times(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """Factory of file systems of a size [kB]; the test is skipped where none may be mounted."""
    folder = tmp_path / "disk"

    def mount(size: int) -> Path:
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", str(folder)]
        if os.geteuid() or subprocess.run(command, capture_output=True).returncode:
            pytest.skip("mounting needs root")
        return folder

    yield mount
    if folder.is_mount():
        subprocess.run(["umount", folder], check=True)


@pytest.fixture(scope="session")
def real_models() -> Path:
    """Folder of the 21 YCB-Video objects in BOP's layout."""
    return _real("ycbv_models", "models_info.json")


@pytest.fixture(scope="session")
def real_lights() -> Path:
    """Folder of Radiance maps and sIBL sets."""
    return _real("hdri", "sibl_kiara_dawn")


def _real(name: str, last: str) -> Path:
    """A folder of real data; a GPU machine may hold a part of it, without its `last` entry."""
    folder = REAL_DATA / name
    if not (folder / last).exists():
        pytest.skip(f"no real data at {folder / last}")
    return folder
