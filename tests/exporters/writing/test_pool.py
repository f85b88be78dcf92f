"""Writer process pool: order, back-pressure, failures, processes."""

import errno
import os
import re
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
from synpick_warp.exporters.writing.pool import QUEUE_DEPTH, WriterPool, WriteTask
from synpick_warp.system.processes.shared_memory import shared_bytes
from tests.harness.environment import checkout_environment
from tests.harness.processes import wait_until_gone

SIZE = 1 << 16


def save(image: np.ndarray, path: Path) -> None:
    np.save(path, image)


def save_all(*parts: object) -> None:
    *images, path = parts
    np.savez(path, *images)


def note(path: Path, text: str) -> None:
    with path.open("a") as file:
        file.write(text)


def note_process(path: Path) -> None:
    note(path, f"{os.getpid()} ")


def fill_the_disk(path: Path) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def stumble(*_: object) -> None:
    raise ValueError("two\nlines")


def die(_: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def wait_for(*parts: object) -> None:
    gate = parts[-1]
    while not gate.exists():
        time.sleep(0.005)


def quit_python(_: Path) -> None:
    os._exit(3)


def interrupt(path: Path) -> None:
    os.kill(os.getpid(), signal.SIGINT)
    path.write_text(" ".join(sorted(sys.modules)))


def submit_and_wait(pool: WriterPool, function: object, *arguments: object) -> None:
    pool.submit(function, (), arguments, path=arguments[0])
    pool.wait()


def processes(pool: WriterPool) -> list[subprocess.Popen[bytes]]:
    return [worker.process for worker in pool._pool._workers]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_images_are_copied_before_submit_returns(tmp_path, count):
    ring = np.empty((40, 50, 3), np.uint8)
    done = []
    with WriterPool(count, SIZE) as pool:
        for value in range(30):
            ring[...] = value
            pool.submit(save, (ring[::2],), (tmp_path / f"{value}.npy",), path=tmp_path, on_done=lambda value=value: done.append(value))
    assert sorted(done) == list(range(30))
    for value in range(30):
        np.testing.assert_array_equal(np.load(tmp_path / f"{value}.npy"), np.full((20, 50, 3), value))


@pytest.mark.parametrize(("count", "side"), [(1, 3), (2, 700)])
def test_images_of_different_types_share_a_slot(tmp_path, monkeypatch, count, side):
    """Large ones are copied by threads."""
    monkeypatch.setattr(pool_module, "PROCESSES_PER_COPY_THREAD", 1)
    draw = np.random.default_rng(0)
    images = draw.integers(0, 256, (side, side, 6), np.uint8)[::2, 1:-1], np.zeros((0, 4), np.uint16), np.arange(6.0).reshape(2, 3)
    images += draw.integers(0, 9, (3, side, side)), np.arange(5, dtype=np.uint32)
    kept = [image.copy() for image in images]
    with WriterPool(count, shared_bytes(image.nbytes for image in images)) as pool:
        pool.submit(save_all, images, (tmp_path / "all.npz",), path=tmp_path)
        for image in images:
            image[...] = 0
    with np.load(tmp_path / "all.npz") as file:
        for image, back in zip(kept, file.values(), strict=True):
            assert back.dtype == image.dtype
            np.testing.assert_array_equal(back, image)


def test_more_tasks_than_slots_each_keep_their_own_image(tmp_path, monkeypatch):
    """Tasks are prepared one by one while threads copy the images of earlier ones."""
    monkeypatch.setattr(pool_module, "PROCESSES_PER_COPY_THREAD", 1)
    count, side = 5 * QUEUE_DEPTH, 700
    ring = np.empty((count, side, side), np.uint8)
    prepared, done = [], []

    def make_tasks(first: int) -> Iterator[WriteTask]:
        for value in range(first, first + count):
            prepared.append(value)
            ring[value - first] = value
            yield WriteTask(save, (ring[value - first],), (tmp_path / f"{value}.npy",), tmp_path, lambda value=value: done.append(value))

    with WriterPool(2, side * side) as pool:
        for first in (0, count):
            pool.submit_all(make_tasks(first))
            ring[...] = 255
    assert prepared == sorted(done) == list(range(2 * count))
    for value in prepared:
        np.testing.assert_array_equal(np.load(tmp_path / f"{value}.npy"), np.full((side, side), value))


def test_a_failure_stops_taking_tasks(tmp_path):
    prepared = []

    def make_tasks() -> Iterator[WriteTask]:
        while True:
            prepared.append(None)
            yield WriteTask(stumble, (np.zeros(4),), (tmp_path,), tmp_path)

    pool = WriterPool(2, SIZE)
    with pytest.raises(OutputError, match="ValueError: two lines"):
        pool.submit_all(make_tasks())
    assert len(prepared) <= 1 + 2 * QUEUE_DEPTH
    pool.abort()


def test_images_too_large_for_a_slot_are_refused(tmp_path):
    with WriterPool(1, 100) as pool, pytest.raises(ValueError, match="exceed"):
        pool.submit(save, (np.zeros(SIZE),), (tmp_path / "a",), path=tmp_path)


@pytest.mark.parametrize("count", [0, 2])
def test_on_done_may_submit_further_tasks(tmp_path, count):
    with WriterPool(count, SIZE) as pool:

        def follow(*names: str) -> None:
            if names:
                pool.submit(note, (), (tmp_path / names[0], "x"), path=tmp_path, on_done=lambda: follow(*names[1:]))

        follow("a", "b", "c")
        pool.wait()
        assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]


def test_simultaneous_results_are_each_received_once(tmp_path):
    gate = tmp_path / "gate"
    with WriterPool(4, 1) as pool:

        def more() -> None:
            pool.submit(note, (), (tmp_path / "more", "x"), path=tmp_path)

        for _ in range(4):
            pool.submit(wait_for, (), (gate,), path=gate, on_done=more)
        gate.touch()
        # All four results are there before the pool receives any.
        time.sleep(0.5)
        listener = threading.Thread(target=pool.wait, daemon=True)
        listener.start()
        listener.join(30.0)
        assert not listener.is_alive()
    assert (tmp_path / "more").read_text() == "xxxx"


def test_tasks_without_images_run_in_order_wait_in_part_and_do_not_block(tmp_path, monkeypatch):
    """Here more tasks than fit into a pipe."""
    monkeypatch.setattr(pool_module, "MAX_WAITING", 5)
    for count, letters in ((1, "abcdefghijklmnop"), (2, 500 * "x")):
        with WriterPool(count, SIZE) as pool:
            for letter in letters:
                pool.submit(note, (), (tmp_path / str(count), letter), path=tmp_path)
                assert len(pool._waiting) <= 5
        assert (tmp_path / str(count)).read_text() == letters


def test_a_full_queue_blocks_the_caller(tmp_path):
    gate = tmp_path / "gate"
    with WriterPool(1, SIZE) as pool:
        for _ in range(QUEUE_DEPTH):
            pool.submit(wait_for, (np.zeros(4),), (gate,), path=tmp_path)
        threading.Timer(0.1, gate.touch).start()
        pool.submit(wait_for, (np.zeros(4),), (gate,), path=tmp_path)  # Returns when a slot is free, so not before the gate opens.
        assert gate.exists()


def test_a_task_goes_to_the_process_of_its_affinity_unless_others_are_idle(tmp_path):
    gate = tmp_path / "gate"
    with WriterPool(2, SIZE) as pool:
        for _ in range(6):
            pool.submit_all(WriteTask(note_process, (), (tmp_path / str(number),), tmp_path, affinity=number) for number in (4, 7, 6))
            pool.wait()
        first, second, third = ((tmp_path / str(number)).read_text().split() for number in (4, 7, 6))
        assert (len(set(first)), len(set(second))) == (1, 1)
        assert first == third != second
        pool.submit_all(WriteTask(wait_for, (), (gate,), tmp_path, affinity=4) for _ in range(4))
        assert sorted(len(worker.tasks) for worker in pool._pool._workers) == [1, 3]
        gate.touch()


def test_abort_kills_running_processes(tmp_path):
    pool = WriterPool(2, SIZE)
    pool.submit(wait_for, (), (tmp_path / "never",), path=tmp_path)
    running = processes(pool)
    pool.abort()
    assert [process.returncode for process in running] == [-signal.SIGKILL, -signal.SIGKILL]
    with pytest.raises(OutputError, match="have ended"):
        pool.submit(note, (), (tmp_path / "a", "a"), path=tmp_path)
    pool.abort()


FULL = "cannot write {path}: No space left on device; free space or rights there, or name another folder with --out"


@pytest.mark.parametrize(
    ("count", "function", "said"),
    [
        (0, fill_the_disk, FULL),
        (2, fill_the_disk, FULL),
        (2, die, "was ended by SIGKILL while it wrote {path}; if memory ran out, set bake.writers"),
        (2, quit_python, "ended with exit code 3 while it wrote {path}; see its message above"),
    ],
)
def test_what_ends_a_writer_is_reported_in_one_line_with_its_path(tmp_path, count, function, said):
    """Memory is not blamed for a process that exits."""
    pool = WriterPool(count, SIZE)
    with pytest.raises(OutputError, match=re.escape(said.format(path=tmp_path / "scene 3"))) as caught:
        submit_and_wait(pool, function, tmp_path / "scene 3")
    assert ("ran out" in str(caught.value)) == (function is die)
    pool.abort()


@pytest.mark.parametrize("count", [0, 2])
def test_a_failure_is_raised_by_this_and_every_later_call(tmp_path, count):
    pool = WriterPool(count, SIZE)
    with pytest.raises(OutputError, match="ValueError: two lines") as caught:
        submit_and_wait(pool, stumble, tmp_path)
    assert str(tmp_path) in str(caught.value)
    assert "Traceback" in caught.value.__notes__[0]
    for call in (pool.poll, pool.wait, pool.close):
        with pytest.raises(OutputError, match="ValueError: two lines"):
            call()
    pool.close()


def test_a_process_that_dies_while_idle_is_reported(tmp_path):
    pool = WriterPool(2, SIZE)
    processes(pool)[1].kill()
    processes(pool)[1].wait()
    with pytest.raises(OutputError, match="while it had nothing to do"):
        submit_and_wait(pool, note, tmp_path / "a", "a")
    pool.abort()


def test_processes_are_niced_ignore_ctrl_c_and_never_import_the_simulator(tmp_path, monkeypatch):
    monkeypatch.setattr(pool_module, "NICENESS", 7)
    with WriterPool(1, SIZE) as pool:
        (writer,) = pool.pids()
        assert os.getpgid(writer) != os.getpgid(0)
        pool.submit(interrupt, (), (tmp_path / "modules",), path=tmp_path)
        pool.submit(note, (), (tmp_path / "after", "x"), path=tmp_path)
        pool.wait()
        assert os.getpriority(os.PRIO_PROCESS, writer) == min(19, os.getpriority(os.PRIO_PROCESS, 0) + 7)
    assert (tmp_path / "after").exists()
    assert not {"warp", "newton", "trimesh"} & set((tmp_path / "modules").read_text().split())


def test_processes_exit_when_the_bake_is_killed(tmp_path):
    script = """
import os, signal
from synpick_warp.exporters.writing.pool import WriterPool
pool = WriterPool(2, 1 << 16)
print(*pool.pids(), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    killed = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert killed.returncode == -signal.SIGKILL
    assert killed.stderr == ""
    wait_until_gone([int(pid) for pid in killed.stdout.split()])


UNGUARDED_SCRIPT = """
from pathlib import Path
from synpick_warp.exporters.writing.files import write_synced
from synpick_warp.exporters.writing.pool import WriterPool
print("imported", flush=True)
with WriterPool(2, 1) as pool:
    for name in ("a", "b"):
        pool.submit(write_synced, (), (Path(name), b"x"), path=Path(name))
"""


def test_a_script_without_main_guard_can_use_the_pool(tmp_path):
    """Processes started by `multiprocessing` with spawn would run the script again, and fail."""
    (tmp_path / "script.py").write_text(UNGUARDED_SCRIPT)
    command = [sys.executable, "script.py"]
    ran = subprocess.run(command, cwd=tmp_path, env=checkout_environment(), capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stderr, ran.stdout) == (0, "", "imported\n")
    assert [(tmp_path / name).read_text() for name in ("a", "b")] == ["x", "x"]
