"""Claims of chunks of episodes: leases in the store, taken by conditional writes, kept by a heartbeat, taken over when they ran out.

The store is the ledger; workers know nothing of each other. See README.md.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import socket
import threading
import time
import uuid
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import msgspec

from synpick_warp.cloud.ledger import Ledger
from synpick_warp.errors import StoreError, SynpickError
from synpick_warp.system.stores.base import Store
from synpick_warp.system.stores.opening import CONTROL

CLAIMS = f"{CONTROL}/claims"
LEASE = 120.0
"""Time for which a claim holds without a heartbeat [s]: a worker that dies costs as much; one that hangs longer loses its chunk."""
BEATS = 4
"""Heartbeats a lease."""
MARGIN = 0.1
"""Last part of a lease in which its owner does not rely on it."""
MAX_WAIT = 10.0
"""Longest pause between two looks at what others have [s]."""
CHUNK_WORLDS = 2
"""Episodes of a whole chunk for each world: enough to keep all worlds busy for longer than it takes to start them."""
AUTO_WORLDS = 256
"""Worlds that a chunk is meant for where the settings leave their number to the device."""
LEAST_CHUNKS = 32
"""Chunks of a small plan, so that several workers find some."""
TAIL, HALVINGS = 0.25, 3
"""Last part of the plan that has smaller chunks, and how often they are halved in it."""


class LeaseLostError(SynpickError):
    """Another worker has taken a chunk over."""


class _Lease(msgspec.Struct):
    """Content of a lease."""

    owner: str
    until: float
    """Time of the store at which it runs out [s since 1970]."""
    beat: int = 0
    """Number of heartbeats: no two leases are equal, nor are their tags."""


class Claim:
    """Lease of a key that this worker owns, kept by a thread. `check` raises when it may have been lost."""

    def __init__(self, store: Store, key: str, owner: str, tag: str, until: float, offset: float, lease: float) -> None:
        self._store, self._key, self._owner, self._tag = store, key, owner, tag
        self._until, self._offset, self._lease = until, offset, lease
        self._lost, self._ending, self._beat = False, threading.Event(), 0
        self._thread = threading.Thread(target=self._keep, name="heartbeat", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raise LeaseLostError if another worker has the lease, or may have taken it by now."""
        if self._lost or time.time() + self._offset > self._until - MARGIN * self._lease:
            raise LeaseLostError(f"the claim {self._key} ran out, since this worker was too slow, and others may have it")

    def _keep(self) -> None:
        """Thread: extend the lease until it is released or lost. What fails is tried again: time decides."""
        while not self._ending.wait(self._lease / BEATS):
            self._beat += 1
            with contextlib.suppress(StoreError):
                if not self._replace(time.time() + self._offset + self._lease):
                    self._lost = True
                    return

    def _replace(self, until: float) -> bool:
        """Compare-and-swap of the lease; returns whether it is ours."""
        data = msgspec.json.encode(_Lease(self._owner, until, self._beat))
        tag = self._store.replace(self._key, data, self._tag)
        if tag is None:  # Perhaps by an attempt of ours whose answer was lost.
            found = self._store.get_tagged(self._key)
            if found is None or found[0] != data:
                return False
            tag = found[1]
        self._tag, self._until = tag, until
        return True

    def stop(self) -> None:
        """End the heartbeat; the lease then runs out by itself."""
        self._ending.set()
        self._thread.join()

    def release(self) -> None:
        """Give the lease back, so that another worker need not wait."""
        self.stop()
        self._beat += 1
        with contextlib.suppress(StoreError):
            if not self._lost:
                self._replace(0.0)


class Claims:
    """Claims of one worker in a store."""

    def __init__(self, store: Store, offset: float, lease: float = LEASE) -> None:
        """
        Args:
            store: With conditional writes.
            offset: The store's clock less this machine's [s].
            lease: Time for which a claim holds without a heartbeat [s].
        """
        self.store, self.offset, self.lease = store, offset, lease
        self.owner = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:12]}"

    def take(self, key: str) -> Claim | None:
        """Claim a key: create its lease, or take over one that ran out. None: another worker has it."""
        store, until = self.store, time.time() + self.offset + self.lease
        data = msgspec.json.encode(_Lease(self.owner, until))
        tag = store.create(key, data)
        if tag is None:
            found = store.get_tagged(key)
            if found is None:
                return None
            if found[0] == data:  # Created by an attempt of ours whose answer was lost.
                tag = found[1]
            elif _until(found[0]) > time.time() + self.offset:
                return None
            else:
                tag = store.replace(key, data, found[1])
                if tag is None and (now := store.get_tagged(key)) is not None and now[0] == data:
                    tag = now[1]
        return None if tag is None else Claim(store, key, self.owner, tag, until, self.offset, self.lease)


def _until(data: bytes) -> float:
    """When a lease runs out; one that cannot be read has."""
    try:
        return msgspec.json.decode(data, type=_Lease).until
    except msgspec.DecodeError:
        return 0.0


class Sizes(NamedTuple):
    """Cut of a plan into chunks: whole ones, then halves, quarters, ... in its last part. The same for all workers."""

    episodes: int
    """Of the plan."""
    chunk: int
    """Of a whole chunk."""

    def bounds(self) -> Iterator[tuple[int, int]]:
        """First position of each chunk in the plan, and the one after its last."""
        start, tail = 0, int(self.episodes * TAIL)
        for halving in range(HALVINGS + 1):
            end = self.episodes if halving == HALVINGS else self.episodes - (tail >> halving)
            size = max(1, self.chunk >> halving)
            while start < end:
                yield start, (start := min(start + size, self.episodes))


def default_chunk(worlds: int, episodes: int) -> int:
    """Episodes of a whole chunk, by the worlds of a device (0: as many as fit) and the episodes of the plan."""
    return max(1, min(CHUNK_WORLDS * (worlds or AUTO_WORLDS), episodes // LEAST_CHUNKS))


class Chunk(NamedTuple):
    """Chunk that this worker has claimed: its number, its episodes without done mark, its claim."""

    number: int
    episodes: list[int]
    claim: Claim


class Chunks:
    """Chunks of the plan that this worker claims, one at a time, until all are done by somebody."""

    def __init__(self, ledger: Ledger, claims: Claims, ranges: Sequence[range], chunk: int) -> None:
        """
        Args:
            ledger: Of the data set.
            claims: Of this worker.
            ranges: Episodes that the bake must deliver.
            chunk: Episodes of a whole chunk; that of the worker that starts first counts for all.
        """
        self._ledger, self._claims, self._ranges = ledger, claims, ranges
        name = hashlib.sha256(repr([(each.start, each.stop, each.step) for each in ranges]).encode()).hexdigest()[:16]
        self._place = f"{CLAIMS}/{name}"
        self.sizes = self._agree(Sizes(sum(map(len, ranges)), chunk))

    def _agree(self, sizes: Sizes) -> Sizes:
        """Cut of the worker that started first."""
        store, key = self._ledger.store, f"{self._place}/plan.json"
        store.create(key, msgspec.json.encode(sizes.chunk))
        try:
            chunk = msgspec.json.decode(store.get(key), type=int)
        except (msgspec.DecodeError, FileNotFoundError):
            chunk = 0
        if chunk < 1:
            raise StoreError(f"{store.url}/{key} is damaged; delete it, and start all workers again")
        return sizes._replace(chunk=chunk)

    def __iter__(self) -> Iterator[Chunk]:
        """Claim chunks; waits while other workers have all that are not done. The caller calls `done` or releases each claim."""
        while True:
            found = False
            over = self._over()
            for number, (start, end) in self._order():
                if number in over:
                    continue
                claim = self._claims.take(f"{self._place}/{number:06d}")
                if claim is None:
                    continue
                episodes = self._left(start, end)
                found = True
                if episodes:
                    yield Chunk(number, episodes, claim)
                else:
                    self.done(Chunk(number, [], claim))
            if not found:
                if len(self._over()) >= sum(1 for _ in self.sizes.bounds()):
                    return
                time.sleep(min(self._claims.lease / BEATS, MAX_WAIT))

    def done(self, chunk: Chunk) -> None:
        """Note that all episodes of a chunk have done marks, and end its claim."""
        self._ledger.store.put(f"{self._place}/done/{chunk.number:06d}", b"")
        chunk.claim.stop()

    def _over(self) -> set[int]:
        """Numbers of the chunks that are done."""
        place = f"{self._place}/done"
        return {int(key.rpartition("/")[2]) for key, _ in self._ledger.store.list(place)}

    def _order(self) -> Iterator[tuple[int, tuple[int, int]]]:
        """Chunks with their numbers, whole ones first: from one that follows from the worker's name, in a circle, so that few collide."""
        bounds = list(enumerate(self.sizes.bounds()))
        count = sum(1 for _, (start, end) in bounds if end - start == self.sizes.chunk) or len(bounds)
        first = int(hashlib.sha256(self._claims.owner.encode()).hexdigest(), 16) % count
        return iter([*bounds[first:count], *bounds[:first], *bounds[count:]])

    def _left(self, start: int, end: int) -> list[int]:
        """Episodes of a chunk without done mark."""
        wanted: list[int] = []
        for each in self._ranges:
            wanted += each[max(0, start) : max(0, end)]
            start, end = start - len(each), end - len(each)
        blocks = self._ledger.blocks_of(wanted)
        return sorted(set(wanted).difference(*(self._ledger.done(block) for block in blocks)))
