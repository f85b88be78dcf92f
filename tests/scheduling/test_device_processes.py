"""Processes of devices: what they report, how they are stopped and lost, that none outlives the bake; and the bytes of bakes on several."""

import os
import signal
import subprocess
import sys
import threading
from types import SimpleNamespace

import pytest

from synpick_warp.cli.main import EXIT_MISTAKE, main
from synpick_warp.dataset.commit.manifest import committed_episodes
from synpick_warp.dataset.commit.verify import verify
from synpick_warp.errors import OutputError
from synpick_warp.exporters.writing.files import PARTIAL
from synpick_warp.factory import pipeline
from synpick_warp.factory.devices import DeviceProcesses
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.system.hardware import device as devices
from synpick_warp.system.hardware.device import describe_kinds, pick_devices
from synpick_warp.system.progress import SilentProgress
from synpick_warp.testing.exporters import digests
from tests.builders import assignments, boxes, mistake, once, refusal
from tests.harness.device_programs import program
from tests.harness.processes import wait_for, wait_until_gone
from tests.test_bake import EPISODES, TINY, Baked
from tests.worlds.small_worlds import QUICK, catalog


class Reports(SilentProgress):
    """Observer that keeps all reports."""

    def __init__(self) -> None:
        self.stages, self.notes, self.updates = [], [], []

    def stage(self, text: str) -> None:
        self.stages.append(text)

    def note(self, text: str) -> None:
        self.notes.append(text)

    def update(self, **counts: object) -> None:
        self.updates.append(counts)

    def pids(self) -> list[int]:
        """Processes and writers that have reported themselves."""
        return [int(number) for note in self.notes for number in note.split() if number.isdigit()]


@pytest.fixture
def lock(tmp_path):
    handle = os.open(tmp_path, os.O_RDONLY)
    yield handle
    os.close(handle)


def run(lock: int, behaviour: str, shares: list[list[int]], reports: Reports | None = None) -> tuple[str, BakeSummary, Reports]:
    """Which devices were lost, and what was reported, of a bake with a share per device; two of five episodes are there from before."""
    summary, reports = BakeSummary(total=5, resumed=2, episodes=[10, 11]), reports or Reports()  # type: ignore[list-item]
    names = [f"cuda:{index}" for index in range(len(shares))]
    with DeviceProcesses(names, program(behaviour), lock) as processes:
        lost = processes.run([SimpleNamespace(episodes=share) for share in shares], summary, reports)  # type: ignore[arg-type]
    return lost, summary, reports


def test_reports_are_those_of_one_bake(lock):
    lost, summary, reports = run(lock, "finish", [[0, 2], [1]])
    assert lost == ""
    assert summary.episodes == [0, 1, 2, 10, 11]
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
    assert summary.episodes == [1, 2, 10, 11]
    assert any(note.startswith(lost) for note in reports.notes)


def test_the_users_error_ends_all_processes_and_their_writers(lock):
    reports = Reports()
    with pytest.raises(OutputError, match=r"^cannot write here$"):
        run(lock, "refuse", [[0], [1], [2]], reports)
    wait_until_gone(reports.pids(), timeout=10.0)


def test_sigterm_to_one_process_stops_all(lock):
    _, summary, reports = run(lock, "wait_for_stop", [[0], [1]])
    assert summary.stopped == signal.SIGTERM
    wait_until_gone(reports.pids(), timeout=10.0)


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
        wait_until_gone(reports.pids(), timeout=10.0)
    assert capfd.readouterr().err.count("stopping after this tick") == 2


def interrupt_when_running(reports: Reports, signals: int) -> None:
    wait_for(lambda: len(reports.notes) >= 2)
    for number in range(signals):
        handler = signal.getsignal(signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        # Signals that wait at the same time count as one: the second comes after the first one's handler, which restores the one before.
        if number + 1 < signals:
            wait_for(lambda handler=handler: signal.getsignal(signal.SIGINT) is not handler)


PARENT = """
import os, sys
from types import SimpleNamespace
from synpick_warp.factory.devices import DeviceProcesses
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


# ---- bakes on several devices, here processes of the CPU ----

COMMAND = ["bake", "--config", "smoke", *assignments({key: value for key, value in (QUICK | TINY).items() if key != "bake.device"})]


@pytest.mark.slow
def test_a_lost_device_leaves_a_set_that_other_devices_finish_with_the_bytes_of_one(tmp_path_factory, tmp_path, capsys, monkeypatch):
    """Begun on two devices, of which one is killed with an episode left, and finished on one."""
    several = [*COMMAND, "--out", str(tmp_path / "set")]
    monkeypatch.setattr(pipeline, "_DEVICE_PROGRAM", program("lose_one"))
    with boxes() as patch:
        patch.setattr("synpick_warp.factory.devices.load_catalog", lambda config, report: catalog())
        one, _ = once(tmp_path_factory, "stirred", lambda out: Baked(out).summary)
        assert main([*several, "--devices", "cpu,cpu"]) == EXIT_MISTAKE
        there = committed_episodes(tmp_path / "set")
        assert 1 <= len(there) < EPISODES
        (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("synpick-warp: error: ")]
        assert "lost cpu: its process was ended by SIGKILL" in line
        assert f"{len(there)} of {EPISODES} episodes are complete; the same command resumes" in line
        assert verify(tmp_path / "set").problem == ""
        assert not (tmp_path / "set" / PARTIAL).exists()
        assert main([*several, "--device", "cpu"]) == 0
    assert f"{EPISODES} of {EPISODES} episodes ({len(there)} of them before)" in capsys.readouterr().out
    assert digests(tmp_path / "set") == digests(one)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--devices", "cpu", "--device", "cpu"], "--device and --devices are both given"),
        (["--devices", "cpu,cpu", "--profile"], "--profile records the process of one device"),
        (["--devices", "cpu,cuda:99"], "cuda:99 was requested, but Warp finds "),
        (["--devices", ""], '--devices names ""; allowed: '),
    ],
)
def test_wrong_options_are_one_line_and_leave_nothing(tmp_path, arguments, said):
    assert mistake(*COMMAND, "--out", tmp_path / "set", *arguments).startswith(said)
    assert not (tmp_path / "set").exists()
