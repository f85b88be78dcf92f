"""Writer processes: order, back-pressure, failures."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from synpick_warp.errors import OutputError
from synpick_warp.exporters.writing import pool as pool_module
from synpick_warp.exporters.writing.pool import QUEUE_DEPTH, WriterPool, WriteTask, shared_bytes
from synpick_warp.exporters.writing.worker import NICENESS

SIZE = 1 << 16


def save(image: np.ndarray, path: Path) -> None:
    np.save(path, image)


def save_all(*parts: object) -> None:
    *images, path = parts
    np.savez(path, *images)


def note(path: Path, text: str) -> None:
    with path.open("a") as file:
        file.write(text)


def fill_the_disk(path: Path) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def stumble(_: Path) -> None:
    raise ValueError("two\nlines")


def stumble_on(_image: np.ndarray, path: Path) -> None:
    stumble(path)


def die(_: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def wait_for(*parts: object) -> None:
    gate = parts[-1]
    while not gate.exists():
        time.sleep(0.005)


def interrupt(path: Path) -> None:
    os.kill(os.getpid(), signal.SIGINT)
    path.write_text(" ".join(sorted(sys.modules)))


def submit_and_wait(pool: WriterPool, function: object, argument: Path, path: Path) -> None:
    pool.submit(function, (), (argument,), path=path)
    pool.wait()


def run_one(count: int, function: object, argument: Path, path: Path) -> None:
    with WriterPool(count, SIZE) as pool:
        submit_and_wait(pool, function, argument, path)


def kill_one(path: Path) -> None:
    with WriterPool(2, SIZE) as pool:
        processes(pool)[1].kill()
        processes(pool)[1].wait()
        pool.submit(note, (), (path, "a"), path=path)
        pool.wait()


def processes(pool: WriterPool) -> list[subprocess.Popen[bytes]]:
    return [worker.process for worker in pool._workers]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_images_arrive_whole_though_the_callers_buffer_changes(tmp_path, count):
    ring = np.empty((40, 50, 3), np.uint8)
    done = []
    with WriterPool(count, SIZE) as pool:
        for value in range(30):
            ring[...] = value
            pool.submit(save, (ring[::2],), (tmp_path / f"{value}.npy",), path=tmp_path, on_done=lambda value=value: done.append(value))
    assert sorted(done) == list(range(30))
    for value in range(30):
        np.testing.assert_array_equal(np.load(tmp_path / f"{value}.npy"), np.full((20, 50, 3), value))


def test_several_images_of_different_types_share_a_slot(tmp_path):
    images = (np.arange(7, dtype=np.uint8), np.arange(6.0).reshape(2, 3), np.zeros((0, 4), np.uint16), np.full((3, 3), 7, np.uint32))
    with WriterPool(1, shared_bytes(image.nbytes for image in images)) as pool:
        pool.submit(save_all, images, (tmp_path / "all.npz",), path=tmp_path)
    with np.load(tmp_path / "all.npz") as file:
        for image, back in zip(images, file.values(), strict=True):
            assert back.dtype == image.dtype
            np.testing.assert_array_equal(back, image)


def test_threads_copy_large_images(tmp_path, monkeypatch):
    monkeypatch.setattr(pool_module, "PROCESSES_PER_COPY_THREAD", 1)
    draw = np.random.default_rng(0)
    images = (draw.integers(0, 256, (700, 900, 6), np.uint8)[::2, 3:-3], np.zeros((0, 4)), np.arange(5), draw.integers(0, 9, (3, 1 << 20)))
    kept = [image.copy() for image in images]
    with WriterPool(2, shared_bytes(image.nbytes for image in images)) as pool:
        pool.submit(save_all, images, (tmp_path / "all.npz",), path=tmp_path)
        for image in images:
            image[...] = 0
    with np.load(tmp_path / "all.npz") as file:
        for image, back in zip(kept, file.values(), strict=True):
            np.testing.assert_array_equal(back, image)


def test_many_orders_are_taken_at_once_each_with_its_own_images(tmp_path, monkeypatch):
    """More than there are slots, made one by one, while threads copy the images of those before."""
    monkeypatch.setattr(pool_module, "PROCESSES_PER_COPY_THREAD", 1)
    count, side = 5 * QUEUE_DEPTH, 700
    ring = np.empty((count, side, side), np.uint8)
    made, done = [], []

    def orders(first: int) -> Iterator[WriteTask]:
        for value in range(first, first + count):
            made.append(value)
            ring[value - first] = value
            yield WriteTask(save, (ring[value - first],), (tmp_path / f"{value}.npy",), tmp_path, lambda value=value: done.append(value))

    with WriterPool(2, side * side) as pool:
        for first in (0, count):
            pool.submit_all(orders(first))
            ring[...] = 255
    assert made == sorted(done) == list(range(2 * count))
    for value in made:
        np.testing.assert_array_equal(np.load(tmp_path / f"{value}.npy"), np.full((side, side), value))


def test_a_failure_ends_the_orders(tmp_path):
    made = []

    def orders() -> Iterator[WriteTask]:
        while True:
            made.append(None)
            yield WriteTask(stumble_on, (np.zeros(4),), (tmp_path,), tmp_path)

    pool = WriterPool(2, SIZE)
    with pytest.raises(OutputError, match="ValueError: two lines"):
        pool.submit_all(orders())
    assert len(made) <= 1 + 2 * QUEUE_DEPTH
    pool.abort()


def test_images_too_large_for_a_slot_are_refused(tmp_path):
    with WriterPool(1, 100) as pool, pytest.raises(ValueError, match="exceed"):
        pool.submit(save, (np.zeros(SIZE),), (tmp_path / "a",), path=tmp_path)


@pytest.mark.parametrize("count", [0, 2])
def test_a_finished_task_may_have_others_done(tmp_path, count):
    with WriterPool(count, SIZE) as pool:

        def follow() -> None:
            pool.submit(
                note, (), (tmp_path / "b", "b"), path=tmp_path, on_done=lambda: pool.submit(note, (), (tmp_path / "c", "c"), path=tmp_path)
            )

        pool.submit(note, (), (tmp_path / "a", "a"), path=tmp_path, on_done=follow)
        pool.wait()
        assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]


def test_answers_that_come_together_are_each_heard_once(tmp_path):
    gate = tmp_path / "gate"
    with WriterPool(4, 1) as pool:

        def more() -> None:
            pool.submit(note, (), (tmp_path / "more", "x"), path=tmp_path)

        for _ in range(4):
            pool.submit(wait_for, (), (gate,), path=gate, on_done=more)
        gate.touch()
        # All four have answered before anybody listens.
        time.sleep(0.5)
        listener = threading.Thread(target=pool.wait, daemon=True)
        listener.start()
        listener.join(30.0)
        assert not listener.is_alive()
    assert (tmp_path / "more").read_text() == "xxxx"


def test_one_process_keeps_the_order(tmp_path):
    with WriterPool(1, SIZE) as pool:
        for letter in "abcdefghijklmnop":
            pool.submit(note, (), (tmp_path / "all", letter), path=tmp_path)
    assert (tmp_path / "all").read_text() == "abcdefghijklmnop"


def test_many_tasks_without_images_do_not_block(tmp_path):
    with WriterPool(2, SIZE) as pool:
        for _ in range(500):
            pool.submit(note, (), (tmp_path / "all", "x"), path=tmp_path)
    assert len((tmp_path / "all").read_text()) == 500


def test_a_full_queue_makes_the_caller_wait(tmp_path):
    gate = tmp_path / "gate"
    with WriterPool(1, SIZE) as pool:
        for _ in range(QUEUE_DEPTH):
            pool.submit(wait_for, (np.zeros(4),), (gate,), path=tmp_path)
        threading.Timer(0.1, gate.touch).start()
        pool.submit(wait_for, (np.zeros(4),), (gate,), path=tmp_path)  # Returns when there is room, so not before the gate opens.
        assert gate.exists()


def test_an_abort_ends_what_runs(tmp_path):
    pool = WriterPool(2, SIZE)
    pool.submit(wait_for, (), (tmp_path / "never",), path=tmp_path)
    running = processes(pool)
    pool.abort()
    assert [process.returncode for process in running] == [-signal.SIGKILL, -signal.SIGKILL]
    with pytest.raises(OutputError, match="have ended"):
        pool.submit(note, (), (tmp_path / "a", "a"), path=tmp_path)
    pool.abort()


@pytest.mark.parametrize("count", [0, 2])
def test_a_full_disk_is_one_clear_line(tmp_path, count):
    path = tmp_path / "picture.png"
    with pytest.raises(OutputError) as caught:
        run_one(count, fill_the_disk, path, tmp_path)
    line = str(caught.value)
    assert line == f"cannot write {path}: No space left on device; free space or rights there, or name another folder with --out"


@pytest.mark.parametrize("count", [0, 2])
def test_a_failure_comes_up_at_the_next_call_and_stays(tmp_path, count):
    pool = WriterPool(count, SIZE)
    with pytest.raises(OutputError, match="ValueError: two lines") as caught:
        submit_and_wait(pool, stumble, tmp_path, tmp_path)
    assert str(tmp_path) in str(caught.value)
    assert "Traceback" in caught.value.__notes__[0]
    for call in (pool.poll, pool.wait, pool.close):
        with pytest.raises(OutputError, match="ValueError: two lines"):
            call()
    pool.close()


def test_a_dead_process_is_reported_with_what_it_wrote(tmp_path):
    with pytest.raises(OutputError, match=r"was ended by SIGKILL while it wrote .*scene 3"):
        run_one(2, die, tmp_path, tmp_path / "scene 3")


def test_a_process_that_dies_while_it_waits_is_noticed(tmp_path):
    with pytest.raises(OutputError, match="while it had nothing to do"):
        kill_one(tmp_path / "a")


def test_processes_survive_ctrl_c_and_never_load_the_simulator(tmp_path):
    with WriterPool(1, SIZE) as pool:
        (writer,) = pool.pids()
        assert os.getpgid(writer) != os.getpgid(0)
        pool.submit(interrupt, (), (tmp_path / "modules",), path=tmp_path)
        pool.submit(note, (), (tmp_path / "after", "x"), path=tmp_path)
        pool.wait()
        assert os.getpriority(os.PRIO_PROCESS, writer) == min(19, os.getpriority(os.PRIO_PROCESS, 0) + NICENESS)
    assert (tmp_path / "after").exists()
    assert not {"warp", "newton", "trimesh"} & set((tmp_path / "modules").read_text().split())


def test_the_processes_end_when_the_bake_is_killed(tmp_path):
    script = """
import os, signal
from synpick_warp.exporters.writing.pool import WriterPool
pool = WriterPool(2, 1 << 16)
print(*(worker.process.pid for worker in pool._workers), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == -signal.SIGKILL
    assert done.stderr == ""
    deadline = time.monotonic() + 30
    while any(_alive(int(pid)) for pid in done.stdout.split()):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def _alive(pid: int) -> bool:
    """Whether a process runs; one that ended and waits to be collected does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
