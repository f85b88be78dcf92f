"""Tests of checksum verification: with any number of processes the verdict is the same."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from synpick_warp.cli.main import main
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.dataset.commit import manifest, verify
from synpick_warp.exporters.writing.checksums import write_manifest_entry
from synpick_warp.system.processes import pool
from synpick_warp.system.processes.worker import ProcessError
from tests.builders import mistake
from tests.harness.entries import episode_content
from tests.worlds.small_worlds import settings

EPISODES, FILES = 4, 7
TOTAL = 1 + EPISODES * FILES
"""Number of files, including the one that all episodes share."""
THREADS = [1, 3]
CONFIG = settings()


@pytest.fixture
def out(tmp_path, monkeypatch) -> Path:
    """Data set of EPISODES episodes with FILES files each; the minimum work per process is lowered, so that `verify` uses all `threads`."""
    monkeypatch.setattr(verify, "_FILES_PER_PROCESS", 1)
    (tmp_path / manifest.MANIFEST_FILE).write_bytes(manifest.encode_manifest(manifest.make_manifest(CONFIG)))
    (tmp_path / manifest.CONFIG_FILE).write_text(config_to_toml(CONFIG))
    (tmp_path / "manifest").mkdir()
    write_files(tmp_path, manifest.CONSTANTS, ["models/obj_000001.ply"], {})
    for episode in range(EPISODES):
        write_files(
            tmp_path, manifest.episode_entry(episode), [name(episode, each) for each in range(FILES)], episode_content(episode, FILES)
        )
    return tmp_path


def name(episode: int, file: int) -> str:
    return f"train/{len(CONFIG.cameras.positions) * episode:06d}/rgb/{file:06d}.jpg"


def write_files(out: Path, entry: Path, names: list[str], content: dict) -> None:
    for each in names:
        (out / each).parent.mkdir(parents=True, exist_ok=True)
        (out / each).write_text(each)
    write_manifest_entry(out, entry, [Path(each) for each in names], content)


@pytest.mark.parametrize("threads", THREADS)
def test_all_files_are_counted(out, threads):
    seen = []
    verdict = verify.verify(out, threads, lambda *progress: seen.append(progress))
    assert verdict == ("", EPISODES, TOTAL, False)
    assert {(unit, total) for unit, _, total in seen} == {("files", TOTAL)}
    done = [done for _, done, _ in seen]
    assert done == sorted(done)
    assert set(done) >= {1 + episode * FILES for episode in range(1 + EPISODES)}


@pytest.mark.parametrize("split", [False, True])
def test_several_processes_share_the_entries_or_their_parts(out, monkeypatch, split):
    tasks = []
    monkeypatch.setattr(verify, "_ENTRIES_PER_PROCESS", 100 if split else 1)
    monkeypatch.setattr(verify, "map_ordered", lambda program, given, processes: tasks.extend(given) or [])
    verify.verify(out, 2)
    parts = 2 * verify._PARTS_PER_PROCESS if split else 1
    assert len(tasks) == (1 + EPISODES) * parts
    names = [task(verify._Checker(out)).files for task in tasks]
    assert sum(names) == TOTAL
    assert max(names) == (1 if split else FILES)


@pytest.mark.parametrize("threads", THREADS)
def test_of_several_damaged_files_the_first_is_named(out, threads):
    (out / name(3, 0)).unlink()
    (out / name(1, 6)).write_text("other")
    (out / name(2, 1)).unlink()
    verdict = verify.verify(out, threads)
    assert verdict.problem == f"{out / name(1, 6)} has changed since it was written: its checksum differs"
    assert verdict.files == 1 + 2 * FILES


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("damage", ["list", "no list", "entry"])
def test_a_damaged_list_is_said_after_the_files_before_it(out, threads, damage):
    path = out / f"manifest/000002.{'json' if damage == 'entry' else 'sha256'}"
    if damage == "no list":
        path.unlink()
    else:
        path.write_text("")
    (out / name(3, 0)).unlink()
    verdict = verify.verify(out, threads)
    assert str(path) in verdict.problem
    assert verdict.files == 1 + 2 * FILES
    (out / name(1, 2)).unlink()
    assert verify.verify(out, threads).problem == f"{out / name(1, 2)} is missing"


@pytest.mark.parametrize("threads", THREADS)
def test_a_link_is_no_file_of_a_data_set(out, threads):
    file = out / name(0, 1)
    file.rename(file.with_suffix(".moved"))
    file.symlink_to(file.with_suffix(".moved"))
    assert "symbolic link" in verify.verify(out, threads).problem


def test_few_small_files_are_read_by_the_calling_process(out, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(pool, "start_process", None)
    assert verify.verify(out, 8).files == TOTAL


def test_few_large_files_are_read_by_several_processes():
    assert verify._useful_processes(20, 1 << 30) == 4
    assert verify._useful_processes(40_000, 0) == 4
    assert verify._useful_processes(0, 0) == 1


@pytest.mark.parametrize("moment", ["before the data set", "with a task"])
def test_a_process_that_dies_is_one_line(out, monkeypatch, capfd, moment):
    tell = pool.WorkerPool._send

    def tell_and_kill(self, worker, message, handle=None):
        if (not worker.tasks) == (moment == "before the data set"):
            os.kill(worker.process.pid, signal.SIGKILL)
            worker.process.wait()
        tell(self, worker, message, handle)

    monkeypatch.setattr(pool.WorkerPool, "_send", tell_and_kill)
    with pytest.raises(ProcessError, match="a process that verifies was ended by SIGKILL; if memory ran out, set --threads"):
        verify.verify(out, 2)
    assert main(["verify", str(out), "--threads", "2"]) == 2
    assert len(capfd.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("threads", ["-1", "1025", "x"])
def test_other_numbers_of_processes_are_refused(out, threads):
    assert "--threads is" in mistake("verify", out, "--threads", threads)
