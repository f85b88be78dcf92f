"""Bakes on several devices, here processes of the CPU: one data set with the bytes of one device, also if one of them is lost midway."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from synpick_warp.cli.main import EXIT_MISTAKE, main
from synpick_warp.dataset.commit.manifest import committed_episodes
from synpick_warp.dataset.commit.verify import verify
from synpick_warp.exporters.writing.files import PARTIAL
from tests.builders import assignments
from tests.harness.bake_server import TINY, TINY_PICKS
from tests.harness.exporter_contract import digests
from tests.worlds.small_worlds import QUICK

EPISODES = 10
"""So many that some are left when the process is killed, on a machine that is used by others, too."""
SETTINGS = TINY | {"bake.episodes": EPISODES, "bake.worlds": 1, "bake.formats": ["bop"], "arrangement.max_objects": 2, "render.layers": []}
SETTINGS |= TINY_PICKS
"""Objects are the embedded ones: each process loads them for itself."""


def bake(out: Path, *arguments: str) -> int:
    overrides = {key: value for key, value in (QUICK | SETTINGS).items() if key != "bake.device"}
    return main(["bake", "--out", str(out), "--config", "smoke", *assignments(overrides), *arguments])


def kill_one(out: Path, killed: list[int]) -> None:
    """Kill a device's process when an episode is committed."""
    deadline = time.monotonic() + 300
    while len(committed_episodes(out)) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    for process in device_processes()[:1]:
        killed.append(process)
        os.kill(process, signal.SIGKILL)


def device_processes() -> list[int]:
    """Process ids of the children of this process that simulate."""
    numbers = [number for task in Path("/proc/self/task").iterdir() for number in (task / "children").read_text().split()]
    return sorted(int(number) for number in numbers if b"generate_share" in Path(f"/proc/{number}/cmdline").read_bytes())


@pytest.mark.slow(minutes=2)
def test_a_lost_device_leaves_a_set_that_other_devices_finish_with_the_bytes_of_one(tmp_path, capsys):
    """Begun on one device, continued on two, of which one is killed, and finished on one."""
    one, several = tmp_path / "one", tmp_path / "several"
    assert bake(one, "--device", "cpu") == 0
    assert bake(several, "--device", "cpu", "--episodes", "1") == 0
    killed: list[int] = []
    killer = threading.Thread(target=kill_one, args=(several, killed))
    killer.start()
    assert bake(several, "--devices", "cpu,cpu") == EXIT_MISTAKE
    killer.join()
    there = committed_episodes(several)
    assert len(killed) == 1
    assert 2 <= len(there) < EPISODES
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("synpick-warp: error: ")]
    assert "lost cpu: its process was ended by SIGKILL" in line
    assert f"{len(there)} of {EPISODES} episodes are complete; the same command resumes" in line
    assert verify(several).problem == ""
    assert not (several / PARTIAL).exists()
    assert bake(several, "--device", "cpu") == 0
    assert f"{EPISODES} of {EPISODES} episodes ({len(there)} of them before)" in capsys.readouterr().out
    assert digests(several) == digests(one)
    assert device_processes() == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--devices", "cpu", "--device", "cpu"], "--device and --devices are both given"),
        (["--devices", "cpu,cpu", "--profile"], "--profile records the process of one device"),
        (["--devices", "cpu,cuda:99"], "cuda:99 was requested, but Warp finds "),
        (["--devices", ""], '--devices names ""; allowed: '),
    ],
)
def test_wrong_options_are_one_line_and_leave_nothing(tmp_path, capsys, arguments, said):
    assert bake(tmp_path / "set", *arguments) == EXIT_MISTAKE
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"synpick-warp: error: {said}")
    assert not (tmp_path / "set").exists()
