"""Processes of devices: what they report, how they are stopped and lost, and that none of them outlives the bake."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import pytest

from synpick_warp.errors import OutputError
from synpick_warp.factory.devices import DeviceProcesses
from synpick_warp.system.hardware import device as devices
from synpick_warp.system.hardware.device import describe_kinds, pick_devices
from tests.builders import refusal
from tests.harness.device_programs import program
from tests.harness.processes import wait_until_gone


class Summary:
    """Summary of a bake, as far as the processes use it: two episodes are there from before."""

    def __init__(self) -> None:
        self.total, self.resumed, self.stopped = 5, 2, 0
        self.episodes = [10, 11]

    def take_summary(self, other: SimpleNamespace) -> None:
        self.episodes += other.episodes
        self.stopped = self.stopped or other.stopped


class Reports:
    """Observer that keeps all reports."""

    def __init__(self) -> None:
        self.stages: list[str] = []
        self.notes: list[str] = []
        self.updates: list[dict] = []

    def stage(self, text: str) -> None:
        self.stages.append(text)

    def note(self, text: str) -> None:
        self.notes.append(text)

    def update(self, **counts: object) -> None:
        self.updates.append(counts)


@pytest.fixture
def lock(tmp_path):
    handle = os.open(tmp_path, os.O_RDONLY)
    yield handle
    os.close(handle)


def run(lock: int, behaviour: str, shares: list[list[int]], reports: Reports | None = None) -> tuple[str, Summary, Reports]:
    """Which devices were lost, and what was reported, of a bake with a share per device."""
    summary, reports = Summary(), reports or Reports()
    names = [f"cuda:{index}" for index in range(len(shares))]
    with DeviceProcesses(names, program(behaviour), lock) as processes:
        lost = processes.run([SimpleNamespace(episodes=share) for share in shares], summary, reports)  # type: ignore[arg-type]
    return lost, summary, reports


def test_reports_are_those_of_one_bake(lock):
    lost, summary, reports = run(lock, "finish", [[0, 2], [1]])
    assert lost == ""
    assert sorted(summary.episodes) == [0, 1, 2, 10, 11]
    assert (reports.stages, reports.notes) == (["compiling"], ["an object is never drawn"])
    last = reports.updates[-1]
    assert (last["episodes_done"], last["episodes"], last["views"]) == (5, 5, 9)
    assert len(reports.updates) == 3
    # No estimate before all devices have one.
    assert reports.updates[0]["seconds_left"] in (None, 20.0)


@pytest.mark.parametrize(
    ("behaviour", "fault"),
    [("die", "its process was ended by SIGKILL"), ("fail", "RuntimeError: CUDA error 700: an illegal memory access")],
)
def test_a_lost_device_is_named_and_the_others_go_on(lock, behaviour, fault):
    lost, summary, reports = run(lock, behaviour, [[0], [1, 2]])
    assert lost.startswith(f"lost cuda:0: {fault}")
    assert sorted(summary.episodes) == [1, 2, 10, 11]
    assert any(note.startswith(lost) for note in reports.notes)


def test_the_users_error_ends_all_processes_and_their_writers(lock):
    reports = Reports()
    with pytest.raises(OutputError, match=r"^cannot write here$"):
        run(lock, "refuse", [[0], [1], [2]], reports)
    wait_until_gone(pids(reports), timeout=10.0)


def test_sigterm_to_one_process_stops_all(lock):
    _, summary, reports = run(lock, "wait_for_stop", [[0], [1]])
    assert summary.stopped == signal.SIGTERM
    wait_until_gone(pids(reports), timeout=10.0)


def test_ctrl_c_stops_all_and_the_second_ends_them(lock, capfd):
    for signals in (1, 2):
        reports = Reports()
        timer = threading.Thread(target=interrupt_when_running, args=(reports, signals))
        timer.start()
        if signals == 1:
            _, summary, _ = run(lock, "wait_for_stop", [[1], [2]], reports)
            assert summary.stopped == signal.SIGINT
        else:
            with pytest.raises(KeyboardInterrupt):
                run(lock, "ignore_stop", [[1], [2]], reports)
        timer.join()
        wait_until_gone(pids(reports), timeout=10.0)
    assert capfd.readouterr().err.count("stopping after this tick") == 2


def interrupt_when_running(reports: Reports, signals: int) -> None:
    deadline = time.monotonic() + 30
    while len(reports.notes) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    for number in range(signals):
        handler = signal.getsignal(signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        # Signals that wait at the same time count as one: the second comes after the first one's handler, which restores the one before.
        while number + 1 < signals and signal.getsignal(signal.SIGINT) is handler and time.monotonic() < deadline:
            time.sleep(0.01)


def pids(reports: Reports) -> list[int]:
    """Processes and writers that have reported themselves."""
    return [int(number) for note in reports.notes for number in note.split() if number.isdigit()]


PARENT = """
import os, sys
from types import SimpleNamespace
from synpick_warp.factory.devices import DeviceProcesses
from tests.builders import refusal
from tests.harness.device_programs import program
reports = SimpleNamespace(note=lambda text: print(text, flush=True))
with DeviceProcesses(["cuda:0", "cuda:1"], program("wait_for_stop"), os.open("/", os.O_RDONLY)) as processes:
    processes.run([SimpleNamespace(episodes=[1])] * 2, SimpleNamespace(stopped=0), reports)
"""


def test_processes_and_writers_end_if_the_bake_is_killed():
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True)
    assert parent.stdout
    running = [int(number) for _ in range(2) for number in parent.stdout.readline().split()]
    assert len(running) == 4
    parent.kill()
    parent.wait()
    parent.stdout.close()
    wait_until_gone(running)


# ---- names ----


@pytest.fixture
def machine(monkeypatch):
    """A machine with three GPUs, one of another kind."""
    names = {"cpu": "x86_64", "cuda:0": "NVIDIA H200", "cuda:1": "NVIDIA H200", "cuda:2": "NVIDIA H100"}
    monkeypatch.setattr(devices, "start_warp", lambda: None)
    monkeypatch.setattr(devices.wp, "get_cuda_device_count", lambda: 3)
    monkeypatch.setattr(
        devices.wp, "get_device", lambda name: SimpleNamespace(alias=name, name=names[name], is_cuda=name.startswith("cuda"))
    )


def test_names_of_devices(machine):
    assert pick_devices(["all"]) == ("cuda:0", "cuda:1", "cuda:2")
    assert pick_devices(["cuda:1", "cuda:0"]) == ("cuda:1", "cuda:0")
    assert pick_devices(["cpu", "cpu"]) == ("cpu", "cpu")
    assert describe_kinds(("cuda:0", "cuda:1")) == ""
    assert describe_kinds(("cuda:0", "cuda:2")) == "cuda:0 is NVIDIA H200, cuda:2 NVIDIA H100"


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["cuda:0", "cuda:3"], "cuda:3 was requested, but Warp finds only cuda:0 to cuda:2 here; use --device cuda:0"),
        (["cuda:0", "cuda:0"], "--devices names cuda:0 twice; name each GPU once: its one process simulates bake.worlds totes"),
        (["cuda:0", "cpu"], "--devices names cpu beside cuda:0, which computes other last bits; name either GPUs or cpu"),
        (["cuda:0", "all"], "--devices names all beside others; allowed: all, or GPUs such as cuda:0,cuda:1, or cpu once per process"),
        (["auto"], "--devices is auto; allowed: all, or GPUs such as cuda:0,cuda:1, or cpu once per process"),
        ([], "--devices names none; allowed: all, or GPUs such as cuda:0,cuda:1, or cpu once per process"),
        (["gpu0"], '--devices names "gpu0"; allowed: all, or GPUs such as cuda:0,cuda:1, or cpu once per process'),
    ],
)
def test_wrong_names_of_devices_are_one_line(machine, names, said):
    assert refusal(pick_devices, names) == said


def test_without_a_gpu_all_is_the_cpu(machine, monkeypatch):
    monkeypatch.setattr(devices.wp, "get_cuda_device_count", lambda: 0)
    assert pick_devices(["all"]) == ("cpu",)
