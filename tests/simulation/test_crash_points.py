"""Every crash point, enumerated: of bakes and merges in a local folder, and of workers that bake into a store; the next run repairs all."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from synpick_warp.cloud import run
from synpick_warp.cloud.ledger import Ledger
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit import manifest
from synpick_warp.dataset.commit.manifest import read_entry
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.dataset.commit.verify import verify
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing import files as checksums
from synpick_warp.system.progress import SilentProgress
from synpick_warp.system.stores.store import CONTROL, Probe
from tests.builders import once
from tests.cloud.conftest import files
from tests.harness import scripted_bake
from tests.simulation.claiming import FAULTS, LEASE
from tests.simulation.crashing_disk import CrashingDisk
from tests.simulation.faulty_store import FaultyStore
from tests.simulation.scheduler import Dead, Process, Simulation

CONFIG = scripted_bake.small_settings()
SENSORS = scripted_bake.settings(2, ("bop",)).with_values({"bop.layout": "multisensor", "bop.keypoints": 4, "bop.coco": False})
PICKS = scripted_bake.settings(2, ("bop", "picks"))
EVERY = 16
"""Each test takes every EVERY-th crash point. Fast tests begin with the first, slow tests with the others, of some cases."""


BAKES = {
    "new": (lambda out: None, lambda out: scripted_bake.bake(out, CONFIG)),
    "resumed": (lambda out: scripted_bake.bake(out, CONFIG, stop_after=1), lambda out: scripted_bake.bake(out, CONFIG)),
    "several sensors": (lambda out: None, lambda out: scripted_bake.bake(out, SENSORS)),
    "picks": (lambda out: None, lambda out: scripted_bake.bake(out, PICKS, picks=True)),
}
"""Initial state of the folder, and the bake that crashes and is then repeated, by name of the case."""


def turns(*cases: str, all_of: str) -> list[Any]:
    """Rows (case, turn): the first turn of each case, and all turns of one; SYNPICK_CRASH_POINTS=all: of each."""
    rows = [(case, turn) for turn in range(EVERY) for case in cases if turn == 0 or case == all_of or "SYNPICK_CRASH_POINTS" in os.environ]
    return [pytest.param(*row, marks=[pytest.mark.slow] * (row[1] > 0)) for row in rows]


@pytest.fixture(scope="session")
def expected(tmp_path_factory) -> dict[str, bytes]:
    """Files of an undisturbed bake."""
    folder, _ = once(tmp_path_factory, "crash-points", BAKES["new"][1])
    return files(folder)


def crash(folder: Path, prepare: Callable[[Path], object], change: Callable[[Path], object], turn: int, *, power: bool) -> dict[int, Path]:
    """Run `change` on prepared folders, each with a simulated crash at another modification, every EVERY-th; returns the folder of each
    crash point, by its number."""
    prepare(folder / "counted")
    with CrashingDisk(folder / "counted") as disk:
        change(folder / "counted")
    left = {}
    for number in range(1 + turn, disk.changes + 1, EVERY):
        out = left[number] = folder / str(number)
        prepare(out)
        with CrashingDisk(out, number) as crashing, contextlib.suppress(Dead):
            change(out)
        if power:
            crashing.cut_power()
    assert disk.changes > 4 * EVERY
    return left


@pytest.mark.parametrize(("case", "turn"), turns(*BAKES, "new, power cut", all_of="new"))
def test_a_bake_may_end_at_any_change_to_its_folder(tmp_path, case, turn):
    name, _, power = case.partition(", ")
    prepare, bake = BAKES[name]
    left = crash(tmp_path, prepare, bake, turn, power=bool(power))
    assert verify(tmp_path / "counted").finished
    undisturbed = files(tmp_path / "counted")
    for number, out in left.items():
        bake(out)
        assert files(out) == undisturbed, number
        shutil.rmtree(out)


def test_a_finished_data_set_outlives_a_power_cut(tmp_path):
    with CrashingDisk(tmp_path) as disk:
        scripted_bake.bake(tmp_path / "out", CONFIG)
    disk.cut_power()
    verdict = verify(tmp_path / "out")
    assert (verdict.problem, verdict.finished) == ("", True)


def test_a_file_system_is_flushed_where_the_system_can(tmp_path, monkeypatch):
    checksums.sync_file_system(tmp_path)
    with pytest.raises(FileNotFoundError):
        checksums.sync_file_system(tmp_path / "missing")
    calls: list[str] = []
    monkeypatch.setattr(os, "sync", lambda: calls.append("sync"))
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: SimpleNamespace(syncfs=lambda handle: -1))
    monkeypatch.setattr(ctypes, "get_errno", lambda: errno.EPERM)
    checksums.sync_file_system(tmp_path)
    assert calls == ["sync"]
    monkeypatch.setattr(ctypes, "get_errno", lambda: errno.EIO)
    with pytest.raises(OSError, match=os.strerror(errno.EIO)):
        checksums.sync_file_system(tmp_path)
    assert calls == ["sync"]


@pytest.mark.parametrize(("case", "turn"), turns("merge", all_of="merge"))
def test_a_merge_may_end_at_any_change_to_its_folder(tmp_path, expected, case, turn):
    """Its parts stay as they are, and nothing that it leaves is taken for a data set."""
    parts = [tmp_path / "parts" / str(number) for number in range(2)]
    for number, part in enumerate(parts):
        scripted_bake.bake(part, CONFIG, shard=(number, 2))
    before = [files(part) for part in parts]
    for number, out in crash(tmp_path, lambda out: None, lambda out: merge(parts, out), turn, power=False).items():
        if not (out / "manifest.json").exists():
            shutil.rmtree(out, ignore_errors=True)
            merge(parts, out)
        assert files(out) == expected, number
        assert [files(part) for part in parts] == before


BUGS = {
    "a mark is not synchronized": lambda patch: patch.setattr(checksums, "write_atomically", lambda path, data: path.write_bytes(data)),
    "a mark counts without its files": lambda patch: patch.setattr(
        manifest, "is_complete", lambda folder, entry: read_entry(folder, entry) is not None
    ),
}
"""Planted bugs, by name."""


@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_of_a_folder_is_found(tmp_path, expected, monkeypatch, bug):
    BUGS[bug](monkeypatch)
    prepare, bake = BAKES["new"]
    left = crash(tmp_path, prepare, bake, 0, power=True)
    with pytest.raises((AssertionError, DatasetError)):  # noqa: PT012
        for out in left.values():
            bake(out)
            assert files(out) == expected


class Upload:
    """Data set of a store into which simulated workers bake; `first` dies at a scheduling point, or with `in_writes` after a write."""

    def __init__(self, config: Config, store: FaultyStore, die_at: int = 0, *, in_writes: bool = False) -> None:
        self.store, self.count, self._die_at, self._in_writes = store, 0, die_at, in_writes
        self._job = run.Job(config, "s3://simulated", bake=scripted_bake.bake_episodes, lease=LEASE)

    def _seen(self, process: Process) -> None:
        if process.name == "first":
            self.count += 1
            process.dead |= self.count == self._die_at

    def run(self, seed: object, *names: str, shards: int) -> None:
        """Run workers together, which have one of the first of these shards each; 0 shards: they claim."""
        simulation = self.store.simulation = Simulation(seed)
        if self._in_writes:
            self.store.observe = lambda write: self._seen(write.process)
        else:
            simulation.at_point = self._seen
        with simulation, pytest.MonkeyPatch.context() as patch:
            patch.setattr(run, "open_ledger", lambda job: Ledger(self.store.open(simulation.process), job.config, Probe(0.0, True)))
            patch.setattr(run.gc, "collect", lambda: 0)  # It takes most of the time.
            bake = functools.partial(run.bake_into_store, self._job, SilentProgress(), claim=not shards)
            shares = [(number, shards) if shards else (0, 1) for number in range(len(names))]
            simulation.run(*((Process(name), functools.partial(bake, share)) for name, share in zip(names, shares, strict=True)))
            assert simulation.errors == []

    @property
    def files(self) -> dict[str, bytes]:
        return {key: data for key, (data, _) in self.store.objects.items() if not key.startswith(f"{CONTROL}/")}


def upload(shards: int, die_at: int = 0) -> Upload:
    """Bake into an empty store by one worker, and, if it dies, by another; to those that claim faults happen then."""
    seed = 0 if shards else die_at
    upload = Upload(CONFIG, FaultyStore(Simulation(seed), FAULTS if seed else {}), die_at)
    for name in ("first", "second")[: 1 + bool(die_at)]:
        upload.run((seed, name), name, shards=shards)
    return upload


@pytest.mark.parametrize(("case", "turn"), turns("one worker", "claims and faults", all_of="one worker"))
def test_a_worker_may_die_at_any_point_of_a_bake_into_a_store(expected, case, turn):
    """The next worker ends the set."""
    undisturbed = upload(shards := int(case == "one worker"))
    assert undisturbed.files == expected
    for point in range(1 + turn, undisturbed.count + 1, EVERY):
        assert upload(shards, point).files == expected, point
