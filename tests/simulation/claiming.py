"""Simulated schedules of claiming workers: real claims, work queue, ledger and finalization; generating an episode only takes virtual time.

Workers start together, die and are replaced, freeze, and their requests fail; what must hold is checked at each write.
"""

from __future__ import annotations

import functools
import itertools
import random
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from synpick_warp.cloud import ledger, run
from synpick_warp.cloud.claims import CLAIMS, Claims, LeaseLostError
from synpick_warp.cloud.ledger import ENTRY, FINISHED, INDEX, Ledger
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.files.load import config_to_toml
from synpick_warp.dataset.commit.manifest import encode_manifest, make_manifest
from synpick_warp.system import clock
from synpick_warp.system.progress import SilentProgress
from synpick_warp.system.stores import store
from synpick_warp.system.stores.store import Probe, Store
from tests.harness.scripted_bake import tiny
from tests.simulation.faulty_store import DELAYED, LOST, REFUSED, FaultyStore, Write
from tests.simulation.scheduler import START, Process, Simulation

EPISODES, WORKERS = 4, 3
LEASE = 10.0
"""Time to live of a claim [s], longer than DELAYED requests take to arrive."""
LONGEST_EPISODE = 15.0
"""Longest time to make an episode [s]: only heartbeats keep its lease."""
SKEW = 0.2
"""Largest error of what a worker knows of the store's clock [s]; the margin of a claim is 1 s."""
FAULTS = {REFUSED: 0.02, LOST: 0.02, DELAYED: 0.005}
DEATHS, FREEZES = 5, 2
"""Most deaths, and freezes, of a schedule."""
DEATH, FREEZE = 0.005, 0.1
"""Probability of a death at a scheduling point, and of a freeze at an episode."""
CONFIG = tiny(EPISODES)
MANIFEST, SETTINGS = make_manifest(CONFIG), config_to_toml(CONFIG)
MANIFEST_FILE, LAYOUT = encode_manifest(MANIFEST), DataLayout.of(CONFIG)


class Report(NamedTuple):
    """What happened in a schedule."""

    points: int
    """Scheduling points."""
    deaths: int
    freezes: int
    faults: int
    trace: int
    """Hash of all writes, with their virtual times."""


def without_formats(patch: pytest.MonkeyPatch) -> None:
    """Finalize by marks alone; make and read manifest, layout, settings and messages once: tested elsewhere, they take most of the time."""
    decode = Ledger._decode
    patch.setattr(store, "describe_fault", str)
    patch.setattr(run, "finalize_store", _finalize)
    patch.setattr(ledger.manifests, "make_manifest", lambda config: MANIFEST)
    patch.setattr(ledger.DataLayout, "of", lambda config: LAYOUT)
    patch.setattr(Ledger, "_decode", lambda self, data: MANIFEST if data == MANIFEST_FILE else decode(self, data))
    patch.setattr(ledger, "config_to_toml", lambda config: SETTINGS)
    patch.setattr(ledger.manifests, "describe_differences", lambda ours, theirs: "" if ours == theirs else "all")


def _finalize(log: Ledger, folder: Path) -> int:
    """As `run.finalize_store`, of one index."""
    if log.finished():
        return 0
    if missing := sum(map(len, log.remaining(log.layout.plan()))):
        return missing
    clock.sleep(1.0)
    if not log.finished():
        for key, data in ((run.FINISHING, log.plan), ("episodes.jsonl", b"rows"), (FINISHED, log.plan)):
            log.store.put(key, data)
    return 0


NAMES = "train/{0}/rgb", "train/{0}/depth", f"{INDEX}/{{0}}.tar.gz", "manifest/{0}.sha256", "manifest/{0}.json"
OBJECTS = [[name.format(f"{episode:06d}") for name in NAMES] for episode in range(EPISODES)]
"""Keys of the objects of each episode, in upload order; the content of an object is its key."""


class Schedule:
    """Simulation of a plan from its first worker to its end, drawn by a seed."""

    def __init__(self, seed: object, faults: dict[str, float] | None = None, death: Callable[[int], bool] | None = None) -> None:
        """`faults`: of requests, by default FAULTS; `death`: whether a worker dies at the scheduling point of this number, by default
        drawn. With either nothing freezes."""
        self._drawn = faults is None and death is None
        self.simulation = Simulation(seed)
        self.store = FaultyStore(self.simulation, FAULTS if faults is None else faults)
        self.store.observe = self._check
        self.simulation.at_point = self._at_point
        draw = self.simulation.draw
        self._death, self._most = death or (lambda _: draw.random() < DEATH), draw.randrange(DEATHS + 1) if death is None else 1
        self._deaths = self._freezes = self._trace = self._workers = 0
        self._marked: dict[str, Process] = {}
        self.made = 0
        """Episodes that were made, some of them again."""

    def run(self) -> Report:
        """Run all workers, then one more, undisturbed, which ends what they left. Raises AssertionError: a promise is broken."""
        with self.simulation as simulation:
            simulation.run(*(self._start() for _ in range(WORKERS)))
            points = simulation.points
            self._most, self.store.faults, self._drawn = 0, {}, False
            simulation.run(self._start())
            assert not simulation.errors, simulation.errors
        self._check_end()
        return Report(points, self._deaths, self._freezes, sum(self.store.injected.values()), self._trace)

    def _start(self) -> tuple[Process, Callable[[], None]]:
        process = Process(f"worker {self._workers}")
        self._workers += 1
        return process, functools.partial(self._work, self.store.open(process), process)

    def _at_point(self, process: Process) -> None:
        if self._deaths < self._most and process.name.startswith("worker") and self._death(self.simulation.points):
            self._deaths += 1
            process.dead = True

    def _work(self, store: Store, process: Process) -> None:
        """Claim, make and commit episodes as `run.bake_into_store` and `delivery.Delivery` do."""
        offset = self.simulation.draw.uniform(-SKEW, SKEW)
        log, claims = Ledger(store, CONFIG, Probe(offset, True)), Claims(store, offset, LEASE)
        claims.owner = process.name
        log.put_manifest(MANIFEST_FILE)
        log.put_settings()
        for work in run._works(log, Path(), claims, [range(EPISODES)], 0, SilentProgress()):
            with work:
                queue = list(work)
                while queue:
                    self._make(log, work, queue.pop(0), process)
                    queue += work.more(not queue)
        run._finalize_once(log, claims, Path())

    def _make(self, log: Ledger, work: run._Work, episode: int, process: Process) -> None:
        """Simulate the generation of an episode, which may exceed the lease time, then commit the episode unless the lease was lost."""
        self.made += 1
        clock.sleep(random.uniform(0.0, LONGEST_EPISODE))
        if self._drawn and self._freezes < FREEZES and self.simulation.draw.random() < FREEZE:
            self._freezes += 1
            process.frozen = self.simulation.now + 2.0 * LEASE
            clock.sleep(0.0)
        try:
            work.permit(episode)
            *files, checksums, mark = OBJECTS[episode]
            for name in files:
                log.store.put(name, name.encode())
            work.permit(episode)
            log.commit(episode, checksums.encode(), mark.encode())
            work.delivered(episode)
        except LeaseLostError:
            return

    def _check(self, write: Write) -> None:
        """Check what must hold at a write: that what it announces is there, and that no other worker announced it."""
        self._trace = hash((self._trace, self.simulation.now, write.key, write.data))
        there = self.store.objects
        if match := ENTRY.fullmatch(write.key):
            *before, _ = OBJECTS[int(match[1])]
            assert all(map(there.__contains__, before)), f"{write.key} before its files"
            assert self._marked.setdefault(write.key, write.process) is write.process, f"{write.key} by two workers"
        elif "/done/" in write.key:
            *_, mark = OBJECTS[int(write.key[-6:])]  # A chunk has one episode.
            assert mark in there, f"{write.key} before its episode"
        elif write.key == FINISHED:
            assert all(mark in there for *_, mark in OBJECTS), "finished before the last episode"

    def _check_end(self) -> None:
        found = {key: data for key, (data, _) in self.store.objects.items() if not key.startswith(CLAIMS)}
        lost = [name for name in itertools.chain.from_iterable(OBJECTS) if found.get(name) != name.encode()]
        assert not lost, f"lost: {lost}"
        assert FINISHED in found, "not finished"
        wasted = self.made - EPISODES
        assert wasted <= self._deaths + self._freezes + 1, (
            f"{wasted} episodes made again for {self._deaths} deaths, {self._freezes} freezes"
        )
        assert self.simulation.now - START < 60.0 * LEASE, "others wait too long"
