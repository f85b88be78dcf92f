"""Threads that may launch kernels beside the caller."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import rich.progress

from synpick_warp.system import threads


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
    ("name", "only"), [("pixels_0", True), ("copies_3", True), ("bake link", True), ("zarr_io", True), ("loader", False)]
)
def test_unknown_threads_may_launch_kernels(name, only):
    assert threads.is_only_launcher()
    with waiting_thread(name):
        assert threads.is_only_launcher() == only
    assert threads.is_only_launcher()


def test_progress_bars_launch_nothing():
    with rich.progress.Progress(disable=False):
        assert threading.active_count() > 1
        assert threads.is_only_launcher()


def test_another_thread_sees_the_main_thread_as_a_launcher():
    found: list[bool] = []
    thread = threading.Thread(target=lambda: found.append(threads.is_only_launcher()))
    thread.start()
    thread.join()
    assert found == [False]
