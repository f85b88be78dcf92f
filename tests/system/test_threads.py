"""Detection of other threads that may launch kernels."""

from __future__ import annotations

import contextlib
import gc
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import pytest
import rich.progress
import zarr

from synpick_warp.dataset.stored_array import open_array
from synpick_warp.dataset.trajectory import GroupContext
from synpick_warp.system.interpreter import collection_paused
from synpick_warp.system.processes import threads


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
    assert threads.is_only_launcher()
    with waiting_thread(name):
        assert threads.is_only_launcher() == only
    assert threads.is_only_launcher()


def test_reading_a_zarr_array_starts_harmless_threads(tmp_path):
    values = np.arange(10_000, dtype=np.float32)
    zarr.create_array(tmp_path / "array", data=values, chunk_key_encoding={"name": "default", "separator": "."})
    assert open_array(tmp_path / "array", None, GroupContext())[5] == 5.0
    assert any(thread.name.startswith("zarr_") for thread in threading.enumerate())
    assert threads.is_only_launcher()


def test_progress_bars_launch_nothing_and_another_thread_sees_the_main_thread_as_a_launcher():
    with rich.progress.Progress(disable=False):
        assert threading.active_count() > 1
        assert threads.is_only_launcher()
    with ThreadPoolExecutor(1) as other:
        assert not other.submit(threads.is_only_launcher).result()


def test_a_parallel_map_keeps_the_order_and_raises_the_first_items_error(monkeypatch):
    monkeypatch.setattr(threads, "count_cores", lambda: 2)
    barrier = threading.Barrier(2, timeout=30.0)  # Both items must be in progress at once.

    def invert(number: int) -> float:
        barrier.wait()
        return 1.0 / number

    assert threads.map_in_threads(invert, [4, 2]) == [0.25, 0.5]
    with pytest.raises(ZeroDivisionError):
        threads.map_in_threads(lambda number: 1.0 / number, [0, 1, 2])
    assert threads.map_in_threads(str, []) == []
    assert threads.is_only_launcher()


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
