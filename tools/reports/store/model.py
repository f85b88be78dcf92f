"""Discrete-event simulation of claiming workers on one object store: rates, waste, requests, throttling, losses of spot machines.

Policies and their constants are those of `synpick_warp.cloud`: partition into chunks, order of attempts, leases, heartbeats, takeover,
batched marks. A worker is a generator that yields pauses [s]; events are kept in a heap. Uploads are a flow: above the store's limit of
writes, all workers slow down in proportion, and each request is repeated until it is answered.
"""

from __future__ import annotations

import heapq
import itertools
import json
import math
import random
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from synpick_warp.cloud.claims import BEATS, CHECKS, FIRST_WAIT, GROWTH, LEASE, Sizes, default_chunk
from synpick_warp.cloud.delivery import FILES_AT_ONCE, WHOLE_BYTES
from synpick_warp.cloud.ledger import BLOCK
from synpick_warp.system.stores.store import PAGE, PART_BYTES
from tools.figures import RESULTS

DAY = 86_400.0
"""[s]"""
ENDS = 0.6
"""Length of the shortest episode as a fraction of the longest; those between end evenly, so that a lost machine has delivered some."""


class Limits(NamedTuple):
    """Object store: requests per second of one partition, latency, price."""

    writes: float = 3500.0
    """PUT, POST, LIST as documented by AWS for each partitioned prefix [1/s]; beyond it the answer is 503."""
    reads: float = 5500.0
    """GET and HEAD, as above [1/s]."""
    partitions: int = 1
    """Partitions into which the store has split the prefix: 1 for a new bucket; S3 adds some under load, by the first parts of keys."""
    latency: float = 0.03
    """Time of a small request, assumed [s]."""
    write_price: float = 5e-6
    """Price of a PUT, POST or LIST, S3 Standard in us-east-1, assumed [USD]."""
    read_price: float = 4e-7
    """Price of a GET or HEAD, as above [USD]."""


class Machine(NamedTuple):
    """Worker: what a chunk takes, what a view weighs, what it costs, how often it is lost."""

    start: float
    """Time of a bake beyond its views: worlds start, and few are left at its end [s]."""
    rate: float
    """Views while all worlds are busy [1/s]."""
    views: float
    """Views of an episode."""
    view_bytes: float = 425_700.0
    """Size of a view on disk, 10 instances (tools/results/growth_instances.json) [B]."""
    files: int = 3
    """Files of an episode: its shards, one for each of three cameras."""
    boot: float = 45.0
    """Start of a worker with cold caches (tools/results/speed_start_cold.json) [s]."""
    worlds: int = 256
    link: float = 1.5e9
    """Network of a GPU's share of its host, assumed [B/s]."""
    losses: float = 0.0
    """Losses of a spot machine a day."""
    replacement: float = 300.0
    """Time until another machine takes the place of a lost one, assumed [s]."""
    price: float = 2.0
    """Spot price of a GPU with its share of the host, assumed [USD/h]."""
    drains: bool = True
    """Whether each chunk is a bake of its own; False: a bake takes chunks until none is free, each before the one before has drained."""

    def file_requests(self) -> int:
        """Requests that write a file: one, or as many as it has parts and two more."""
        size = self.views * self.view_bytes / self.files
        return 1 if size <= max(WHOLE_BYTES, PART_BYTES) else 2 + math.ceil(size / PART_BYTES)

    def episode_requests(self) -> Counter[str]:
        """Requests that deliver an episode: files, each looked up after it, index file, checksum list and done mark."""
        return Counter(write=self.files * self.file_requests() + 3, read=self.files)

    def upload_rate(self, latency: float) -> float:
        """Views that a worker can upload [1/s], by latency of its requests, FILES_AT_ONCE at a time, and by its link."""
        requests = self.files * (1 + self.file_requests())
        return min(self.link / self.view_bytes, FILES_AT_ONCE * self.views / (requests * latency))


def measured_machine(folder: Path = RESULTS) -> Machine:
    """Worker fitted to two measured bakes, of 48 and of 150 episodes: a constant time of a bake, and a time per view."""
    runs = [json.loads((folder / f"speed_bake_{count}.json").read_text()) for count in (48, 150)]
    (views, seconds), (more, longer) = ([_value(run, name) for name in ("views", "start to exit")] for run in runs)
    rate = (more - views) / (longer - seconds)
    return Machine(start=seconds - views / rate, rate=rate, views=more / 150, drains=False)


def _value(run: dict[str, list[dict[str, float]]], name: str) -> float:
    """Value of a row of a published run."""
    return next(row["value"] for row in run["rows"] if row["name"] == name)


@dataclass
class Replication:
    """Output of one run of the simulation: times, views, requests."""

    seconds: float = 0.0
    """Time until the last chunk ends [s]."""
    finalization: float = 0.0
    """Time of one worker to write the indices after that [s]."""
    views: float = 0.0
    """Delivered views; duplicates are not counted."""
    wasted: float = 0.0
    """Wasted views: rendered but lost with their worker, or rendered by two workers."""
    busy: float = 0.0
    """Accumulated time of all workers from their start to the end [s]."""
    requests: Counter[str] = field(default_factory=Counter)
    """Answered requests: write, read, list, and among the writes those of claims: claim, heartbeat."""
    refused: float = 0.0
    """Answers 503, which cost time."""
    losses: int = 0

    def price(self, machine: Machine, limits: Limits) -> tuple[float, float]:
        """Cost of the workers, and of the requests [USD]."""
        writes = self.requests["write"] + self.requests["list"] + self.requests["claim"] + self.requests["heartbeat"]
        return self.busy / 3600.0 * machine.price, writes * limits.write_price + self.requests["read"] * limits.read_price


class Simulation:
    """Bake of one plan by equal workers, until each chunk has its end mark."""

    def __init__(
        self, workers: int, episodes: int, machine: Machine, limits: Limits, *, chunk: int = 0, seed: int = 0, finalization: float = 0.0
    ) -> None:
        """
        Args:
            workers: Number of workers, each of one GPU; lost ones are replaced.
            episodes: Episodes of the plan.
            machine: Each worker.
            limits: The store.
            chunk: Episodes of a whole chunk; 0: the default of a bake.
            seed: Of losses and pauses.
            finalization: Time of the indices for each episode [s].
        """
        self.machine, self.limits, self.workers, self.episodes = machine, limits, workers, episodes
        self.sizes = Sizes(episodes, chunk or default_chunk(machine.worlds, episodes))
        bounds = np.array(list(self.sizes.bounds()))
        self.length = bounds[:, 1] - bounds[:, 0]
        self.left = self.length.astype(float)
        """Episodes of each chunk without done mark."""
        self.until = np.full(len(bounds), -1.0)
        """Expiry time of each chunk's lease [s]; negative: the chunk is not leased."""
        self.owner = np.full(len(bounds), -1)
        self.over = np.zeros(len(bounds), bool)
        self.out, self.now, self.active = Replication(), 0.0, 0
        self._finalization, self._draw = finalization, random.Random(seed)
        self._groups = [list(group) for _, group in itertools.groupby(range(len(bounds)), lambda each: self.length[each])]

    def run(self) -> Replication:
        """Simulate until the last chunk is done."""
        events = [(0.0, number, self._work(number)) for number in range(self.workers)]
        order = itertools.count(self.workers)
        while events:
            self.now, _, worker = heapq.heappop(events)
            pause = next(worker, None)
            if pause is not None:
                heapq.heappush(events, (self.now + pause, next(order), worker))
        out = self.out
        out.seconds, out.busy = self.now, self.workers * self.now
        out.finalization = self._finalization * self.episodes
        out.requests["write"] += -(-self.episodes // BLOCK)
        out.requests["read"] += self.episodes
        return out

    def _slowdown(self) -> float:
        """Time of uploads by that without a limit: requested writes by those that the store answers, at least 1."""
        machine = self.machine
        rate = min(machine.rate, machine.upload_rate(self.limits.latency))
        asked = self.active * machine.episode_requests()["write"] * rate / machine.views
        return max(1.0, asked / (self.limits.writes * self.limits.partitions))

    def _ask(self, kind: str, count: int = 1) -> float:
        """Count requests one after the other; returns their time, with repetitions while the store is busy [s]."""
        slow = self._slowdown()
        self.out.requests[kind] += count
        self.out.refused += count * (slow - 1.0)
        return count * self.limits.latency * slow

    def _work(self, number: int) -> Iterator[float]:
        """A worker, and those that replace it: boots, then claims chunk after chunk."""
        while True:
            life = self._draw.expovariate(self.machine.losses / DAY) if self.machine.losses else math.inf
            end = self.now + life
            yield self.machine.boot + self._ask("write", 4) + self._ask("read", 7) + self._ask("claim")  # Probe, marks, plan.
            lived = yield from self._claim_chunks(number, end)
            if lived:
                self._ask("read")
                return
            self.out.losses += 1
            yield self.machine.replacement

    def _claim_chunks(self, number: int, end: float) -> Iterator[float]:
        """The worker loop of `claims.Chunks`; returns whether the worker has lived until all was done."""
        turn, seen, pause, begins = self._draw.getrandbits(64), np.full(len(self.until), -1.0), 0.0, True
        order = np.concatenate([np.roll(group, -(turn % len(group))) for group in self._groups])
        while self.now < end:
            over, leased = self.over.copy(), self.until >= 0.0
            yield self._ask("list", 1 + int(leased.sum() + over.sum()) // PAGE)
            if over.all():
                return True
            free, held = order[~(over | leased)[order]], np.flatnonzero(leased & ~over & (seen <= self.now))
            tried = free[:CHECKS] if len(free) else self._draw.sample(held.tolist(), min(CHECKS, len(held)))
            for chunk in tried:
                yield self._ask("claim")
                if self.until[chunk] < 0.0:
                    break
                yield self._ask("read")
                if self.until[chunk] <= self.now and not self.over[chunk]:
                    yield self._ask("claim")
                    break
                seen[chunk] = self.until[chunk]
            else:
                pause = min(GROWTH * pause or FIRST_WAIT, LEASE / BEATS)
                yield pause * self._draw.uniform(0.5, 1.0)
                begins = True
                continue
            pause = 0.0
            self.until[chunk], self.owner[chunk] = self.now + LEASE, number
            yield from self._bake(int(chunk), number, end, begins or self.machine.drains)
            begins = False
        return False

    def _bake(self, chunk: int, number: int, end: float, begins: bool) -> Iterator[float]:
        """Bake and deliver a chunk in rounds of one episode a world; a lost machine leaves what it has not delivered, and its lease.
        `begins`: with the chunk a bake begins, so that worlds start, and once drain."""
        machine, out = self.machine, self.out
        start, began = machine.start * begins, self.now
        self.active += 1
        yield self._ask("list", self._block_pages(chunk)) + self._ask(
            "read", 3 * begins
        )  # Done marks; settings and constants, which are there.
        while self.left[chunk] > 0.0:
            count = min(float(machine.worlds), self.left[chunk])
            views = count * machine.views
            seconds = start + max(views / machine.rate, views / machine.upload_rate(self.limits.latency)) * self._slowdown()
            start = 0.0
            if self.now + seconds > end:
                done = max(0.0, (end - self.now) / seconds)
                delivered = count * min(1.0, max(0.0, (done - ENDS) / (1.0 - ENDS)))
                out.wasted += max(0.0, done * count - delivered) * machine.views
                self._deliver(chunk, delivered)
                self.until[chunk] = end + LEASE
                self.active -= 1
                yield end - self.now
                return
            self.until[chunk] = self.now + seconds + LEASE
            yield seconds
            self._deliver(chunk, count)
        self.active -= 1
        self.out.requests["heartbeat"] += int((self.now - began) / (LEASE / BEATS))
        yield self._ask("list", 1 + self._block_pages(chunk)) + self._ask("claim")  # Batched and done marks; its own end mark.
        self.over[chunk] = True

    def _block_pages(self, chunk: int) -> int:
        """Pages of the done marks, two keys an episode, of the blocks that a chunk has episodes of."""
        return (1 + int(self.length[chunk]) // BLOCK) * (1 + 2 * min(BLOCK, self.episodes) // PAGE)

    def _deliver(self, chunk: int, count: float) -> None:
        """Count the requests and views of delivered episodes."""
        slow = self._slowdown()
        for kind, each in self.machine.episode_requests().items():
            self.out.requests[kind] += round(count * each)
            self.out.refused += count * each * (slow - 1.0) * (kind == "write")
        self.left[chunk] = max(0.0, self.left[chunk] - count)
        self.out.views += count * self.machine.views
