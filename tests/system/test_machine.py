"""The machine: usable CPU cores and free memory; cache folders, whose replacement is a note that names folder and variable; other threads
that may launch kernels."""

import contextlib
import gc
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import rich.progress
import zarr
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from synpick_warp.dataset.stored_array import open_array
from synpick_warp.dataset.trajectory import GroupContext
from synpick_warp.scenes.collision.shapes import default_cache_dir
from synpick_warp.system.hardware import cores, kernels
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.hardware.free_memory import free_host_memory
from synpick_warp.system.hardware.kernels import CacheError, find_fault, kernel_cache, usable_kernel_cache, user_cache
from synpick_warp.system.interpreter import collection_paused
from tests.harness.hostile import fuzz_examples
from tests.worlds.model_files import put

MASK = 64
"""Cores of the affinity mask in these tests."""
MEMINFO = "MemTotal:       1000 kB\nMemAvailable:    800 kB\nSwapFree:        50 kB\n"


def interface(root: Path, groups: str | None, files: dict[str, str]) -> Path:
    """The kernel's interface below `root`, which is returned: memory, the control groups of this process (None: no file), and theirs."""
    put(root / "proc/meminfo", MEMINFO)
    if groups is not None:
        put(root / "proc/self/cgroup", groups)
    for name, text in files.items():
        put(root / "sys/fs/cgroup" / name, text)
    return root


@pytest.fixture
def mask(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(MASK)))


@pytest.mark.usefixtures("mask")
@pytest.mark.parametrize(
    ("groups", "files", "cores"),
    [
        (None, {}, MASK),
        ("0::/job\n", {"job/cpu.max": "max 100000\n"}, MASK),
        ("0::/\n", {"cpu.max": "200000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "150000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "10000 100000\n"}, 1),
        ("0::/\n", {"cpu.max": "9900000 100000\n"}, MASK),
        # The tightest of nested groups counts.
        ("0::/a/b\n", {"a/b/cpu.max": "800000 100000\n", "a/cpu.max": "300000 100000\n"}, 3),
        (
            "4:memory:/docker/1\n3:cpu,cpuacct:/docker/1\n",
            {"cpu/docker/1/cpu.cfs_quota_us": "400000\n", "cpu/docker/1/cpu.cfs_period_us": "100000\n"},
            4,
        ),
        ("3:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, MASK),
    ],
)
def test_quotas_of_control_groups_limit_the_cores_of_the_mask(groups, files, cores, tmp_path):
    assert count_cores(interface(tmp_path, groups, files)) == cores


LIMITED = {"a/memory.max": f"{600 * 1024}\n", "a/memory.current": f"{500 * 1024}\n"}
DOCKER = {"memory/memory.limit_in_bytes": f"{300 * 1024}", "memory/memory.usage_in_bytes": f"{100 * 1024}"}


@pytest.mark.parametrize(
    ("groups", "files", "kibibytes"),
    [
        (None, {}, 850),
        ("0::/a/b\n", {"a/memory.max": "max\n", "a/memory.current": "1024\n"}, 850),
        ("0::/a/b\n", LIMITED | {"a/memory.stat": f"anon 7\ninactive_file {100 * 1024}\n"}, 250),
        ("0::/\n", {"memory.max": "2048\n", "memory.current": "4096\n"}, 50),
        ("5:cpu:/x\n4:memory:/docker/1\n", DOCKER, 250),
    ],
)
def test_free_memory_counts_caches_swap_and_the_limits_of_control_groups(groups, files, kibibytes, tmp_path):
    assert free_host_memory(interface(tmp_path, groups, files)) == kibibytes * 1024


@pytest.mark.usefixtures("mask")
@given(
    st.text(alphabet="0123456789 max-²\n", max_size=20),
    st.dictionaries(st.sampled_from(("memory.max", "memory.current", "memory.stat")), st.binary(max_size=40)),
    st.binary(max_size=40),
)
@hypothesis_settings(max_examples=fuzz_examples(50), deadline=None)
def test_any_text_in_the_files_of_control_groups_gives_a_number(tmp_path_factory, quota, files, groups):
    root = interface(tmp_path_factory.mktemp("root"), "0::/\n", {"cpu.max": quota})
    assert 1 <= count_cores(root) <= MASK
    (root / "proc/self/cgroup").write_bytes(b"0::/\n" + groups)
    for name, content in files.items():
        (root / "sys/fs/cgroup" / name).write_bytes(content)
    assert 0 <= free_host_memory(root) <= 850 * 1024


# ---- cache folders ----

HANG = 60.0


@pytest.fixture
def home(tmp_path, monkeypatch) -> Path:
    """A home, and no variable that moves a cache."""
    for variable in ("WARP_CACHE_PATH", "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return tmp_path / "home"


def test_a_home_that_can_be_written_is_used(home, capsys):
    assert usable_kernel_cache("1.0") is None
    assert kernel_cache("1.0") == home / ".cache" / "warp" / "1.0"
    assert default_cache_dir() == home / ".cache" / "synpick-warp" / "collision"
    assert capsys.readouterr().err == ""


def check_note(capsys, folder: Path | None, reason: str) -> None:
    """Check the temporary folder and the note on it."""
    assert folder is not None
    assert find_fault(folder) is None
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("synpick-warp: note: the kernel cache ")
    assert f"cannot be used ({reason}); kernels are compiled into {folder}, " in line
    assert line.endswith("set WARP_CACHE_PATH to a folder that can be written")


def no_home() -> Path:
    raise RuntimeError("Could not determine home directory.")


@pytest.mark.parametrize("kind", ["a file", "like a read-only file system", "missing"])
def test_a_home_that_cannot_be_used_is_replaced(home, capsys, monkeypatch, kind):
    """Fault 6: /proc refuses even root; a container's user has no entry in the password file."""
    if kind == "missing":
        monkeypatch.setattr(Path, "home", no_home)
        assert user_cache() is None
        assert find_fault(default_cache_dir()) == "Not a directory"
    elif kind == "a file":
        home.write_text("")
    else:
        monkeypatch.setenv("HOME", "/proc")
    reason = {"a file": "Not a directory", "missing": "the user has no home"}.get(kind, "No such file or directory")
    check_note(capsys, usable_kernel_cache("1.0"), reason)


def test_a_full_disk_is_replaced_and_its_kernels_are_linked(home, capsys, monkeypatch):
    """Fault 6."""
    monkeypatch.setattr(kernels, "MIN_FREE", 2**70)
    module = home / ".cache" / "warp" / "1.0" / "wp_a"
    module.mkdir(parents=True)
    (module / "a.o").write_text("code")
    folder = usable_kernel_cache("1.0")
    assert folder is not None
    assert (folder / "1.0" / "wp_a" / "a.o").read_text() == "code"
    (folder / "1.0" / "wp_a" / "b.o").write_text("new")
    assert not (module / "b.o").exists()
    assert re.search(r"\(only \d+ MiB are free\)", capsys.readouterr().err)


def test_a_variable_moves_the_kernel_cache(home, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "kernels"))
    home.write_text("")
    assert usable_kernel_cache("1.0") is None
    assert kernel_cache("1.0") == tmp_path / "kernels" / "1.0"
    monkeypatch.setenv("WARP_CACHE_PATH", str(home / "kernels"))
    check_note(capsys, usable_kernel_cache("1.0"), "Not a directory")


def test_no_temporary_folder_either_is_one_line(home, monkeypatch):
    def full(**_: str) -> str:
        raise OSError(28, "No space left on device")

    home.write_text("")
    monkeypatch.setattr("synpick_warp.system.hardware.kernels.tempfile.mkdtemp", full)
    with pytest.raises(CacheError, match=r"^the kernel cache cannot be used \([^\n]*; set WARP_CACHE_PATH to a folder [^\n]*$"):
        usable_kernel_cache("1.0")


def test_warp_starts_without_a_home_and_its_cache_is_removed(home):
    """Fault 6, in a real process: a traceback before."""
    home.write_text("")
    code = "from synpick_warp.system.hardware.device import start_warp; import warp as wp; start_warp(); print(wp.config.kernel_cache_dir)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=HANG, check=False, env=dict(os.environ))
    assert (result.returncode, len(result.stderr.splitlines())) == (0, 1), result.stderr
    folder = Path(result.stdout.strip())
    assert str(folder.parent) in result.stderr
    assert not folder.parent.exists()


# ---- threads ----


@pytest.fixture(autouse=True)
def no_older_threads(monkeypatch):
    """Exclude threads left over from other tests."""
    current, enumerate_all = threading.current_thread(), threading.enumerate
    older = {thread for thread in enumerate_all() if thread is not current and not thread.name.startswith("zarr_")}
    monkeypatch.setattr(threading, "enumerate", lambda: [thread for thread in enumerate_all() if thread not in older])


@contextmanager
def waiting_thread(name: str) -> Iterator[None]:
    end = threading.Event()
    thread = threading.Thread(target=end.wait, name=name)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


@pytest.mark.parametrize(
    ("name", "only"),
    [
        *((name, True) for name in ("pixels_0", "copies_3", "setup_0", "bake link", "zarr_io")),
        *((name, False) for name in ("copies_worker", "loader")),
    ],
)
def test_unknown_threads_may_launch_kernels(name, only):
    assert cores.is_only_launcher()
    with waiting_thread(name):
        assert cores.is_only_launcher() == only
    assert cores.is_only_launcher()


def test_reading_a_zarr_array_starts_harmless_threads(tmp_path):
    values = np.arange(10_000, dtype=np.float32)
    zarr.create_array(tmp_path / "array", data=values, chunk_key_encoding={"name": "default", "separator": "."})
    assert open_array(tmp_path / "array", None, GroupContext())[5] == 5.0
    assert any(thread.name.startswith("zarr_") for thread in threading.enumerate())
    assert cores.is_only_launcher()


def test_progress_bars_launch_nothing_and_another_thread_sees_the_main_thread_as_a_launcher():
    with rich.progress.Progress(disable=False):
        assert threading.active_count() > 1
        assert cores.is_only_launcher()
    with ThreadPoolExecutor(1) as other:
        assert not other.submit(cores.is_only_launcher).result()


def test_a_parallel_map_keeps_the_order_and_raises_the_first_items_error(monkeypatch):
    monkeypatch.setattr(cores, "count_cores", lambda: 2)
    barrier = threading.Barrier(2, timeout=30.0)  # Both items must be in progress at once.

    def invert(number: int) -> float:
        barrier.wait()
        return 1.0 / number

    assert cores.map_in_threads(invert, [4, 2]) == [0.25, 0.5]
    with pytest.raises(ZeroDivisionError):
        cores.map_in_threads(lambda number: 1.0 / number, [0, 1, 2])
    assert cores.map_in_threads(str, []) == []
    assert cores.is_only_launcher()


# ---- pausing the garbage collection ----


@pytest.mark.parametrize("before", [True, False])
def test_collection_goes_on_as_before(before):
    try:
        (gc.enable if before else gc.disable)()
        with contextlib.suppress(ZeroDivisionError), collection_paused():
            assert not gc.isenabled()
            raise ZeroDivisionError
        assert gc.isenabled() is before
    finally:
        gc.enable()


@pytest.mark.parametrize("imports", [True, False])
def test_collections_pass_over_what_a_program_imported(imports, monkeypatch):
    frozen = []
    monkeypatch.setattr(gc, "freeze", lambda: frozen.append(True))
    with collection_paused(freezes=True):
        if imports:
            monkeypatch.setitem(sys.modules, "imported_meanwhile", sys)
    assert frozen == [True] * imports
