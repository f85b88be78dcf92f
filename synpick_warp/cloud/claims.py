"""Distributed leases on chunks of episodes: taken by conditional writes, extended by a heartbeat, taken over after they have expired.

Workers coordinate through the store alone. See README.md.
"""

import contextlib
import hashlib
import itertools
import os
import random
import socket
import uuid
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import msgspec

from synpick_warp.cloud.ledger import Ledger
from synpick_warp.errors import StoreError, SynpickError
from synpick_warp.system import clock
from synpick_warp.system.stores.store import CONTROL, SMALL, Store

CLAIMS = f"{CONTROL}/claims"
LEASE = 120.0
"""Time to live of a lease without heartbeat [s]: a worker's death costs the others as much; one that hangs longer loses its chunk."""
BEATS = 4
"""Heartbeats per lease time."""
MARGIN = 0.1
"""Safety margin: last part of a lease in which its owner takes it for lost."""
FIRST_WAIT = 0.5
"""First pause of the exponential back-off of a worker that waits for others [s]. Pauses grow up to the interval of heartbeats."""
GROWTH = 1.25
"""Growth factor of these pauses: the end of a wait is noticed late by at most a quarter of it."""
CHECKS = 8
"""Leases that a worker tries to take after each listing: thousands of workers that wait then ask for less than the store answers."""
CHUNK_WORLDS = 2
"""Default size of a whole chunk [episodes per world]: keeps all worlds busy for longer than it takes to start them."""
AUTO_WORLDS = 256
"""Number of worlds that a chunk is sized for if the settings leave it to the device."""
LEAST_CHUNKS = 32
"""Minimum number of chunks, as far as the episodes suffice, so that several workers find some in a small plan."""
TAIL, HALVINGS = 0.25, 3
"""Tapering of the chunks: last part of the plan that has smaller ones, and how often they are halved in it."""


class LeaseLostError(SynpickError):
    """A lease has expired, or another worker has taken it over."""


class _Lease(msgspec.Struct):
    """Record of a lease: owner, time of expiry, heartbeats."""

    owner: str
    until: float
    """Time of expiry by the store's clock [s since 1970]."""
    beat: int = 0
    """Number of heartbeats. It makes all records differ, and so their tags."""


class Claim:
    """Lease on a key that this worker owns, extended by a heartbeat thread until `stop` or `release`."""

    def __init__(self, store: Store, key: str, owner: str, tag: str, until: float, offset: float, lease: float) -> None:
        self._store, self._key, self._owner, self._tag = store, key, owner, tag
        self._until, self._offset, self._lease = until, offset, lease
        self._lost, self._ending, self._beat = False, clock.Event(), 0
        self._thread = clock.Thread(target=self._keep, name="heartbeat", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Check the lease locally, without a request: raises LeaseLostError if another worker has it, or may have taken it over."""
        if self._lost or clock.time() + self._offset > self._until - MARGIN * self._lease:
            raise LeaseLostError(f"the claim {self._key} ran out, since this worker was too slow, and others may have it")

    def _keep(self) -> None:
        """Heartbeat thread: extends the lease until it is stopped or lost. A failed heartbeat is left to the next one; expiry decides."""
        while not self._ending.wait(self._lease / BEATS):
            self._beat += 1
            with contextlib.suppress(StoreError):
                if not self._replace(clock.time() + self._offset + self._lease):
                    self._lost = True
                    return

    def _replace(self, until: float) -> bool:
        """Compare-and-swap of the record; returns whether the lease is still ours."""
        data = msgspec.json.encode(_Lease(self._owner, until, self._beat))
        tag = self._store.replace(self._key, data, self._tag)
        if tag is None:  # Perhaps by an attempt of ours whose answer was lost, at this heartbeat or one that failed.
            found = self._store.get_tagged(self._key)
            if found is None or _read(found[0]).owner != self._owner:
                return False
            tag = found[1] if found[0] == data else self._store.replace(self._key, data, found[1])
            if tag is None:
                return False
        self._tag, self._until = tag, until
        return True

    def stop(self) -> None:
        """End the heartbeat thread; the lease then expires by itself."""
        self._ending.set()
        self._thread.join()

    def release(self) -> None:
        """Release the lease: ends the heartbeat, and lets the lease expire at once, so that no worker has to wait for it."""
        self.stop()
        self._beat += 1
        with contextlib.suppress(StoreError):
            if not self._lost:
                self._replace(0.0)


class Claims:
    """Lease manager of one worker: takes leases in a store under the worker's unique name."""

    def __init__(self, store: Store, offset: float, lease: float = LEASE) -> None:
        """Store with conditional writes, its clock less this machine's [s], and time to live of a lease without heartbeat [s]."""
        self.store, self.offset, self.lease = store, offset, lease
        self.seen: dict[str, float] = {}
        """When leases of other workers will expire, as of their last look, by key [s since 1970, by the store's clock]."""
        self.owner = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:12]}"

    def pauses(self) -> Iterator[float]:
        """Yield the pauses of exponential back-off with jitter [s], at most the interval of heartbeats."""
        pause = FIRST_WAIT
        while True:
            yield (pause := min(pause, self.lease / BEATS)) * random.uniform(0.5, 1.0)
            pause *= GROWTH

    def take(self, key: str) -> Claim | None:
        """Acquire the lease on a key: creates it, or takes over one that has expired. None: another worker has it."""
        store, until = self.store, clock.time() + self.offset + self.lease
        data = msgspec.json.encode(_Lease(self.owner, until))
        tag = store.create(key, data)
        if tag is None:
            found = store.get_tagged(key)
            if found is None:
                return None
            if found[0] == data:  # Created by an attempt of ours whose answer was lost.
                tag = found[1]
            elif (ends := _read(found[0]).until) > clock.time() + self.offset:
                self.seen[key] = ends
                return None
            else:
                tag = store.replace(key, data, found[1])
                if tag is None and (now := store.get_tagged(key)) is not None and now[0] == data:
                    tag = now[1]
        return None if tag is None else Claim(store, key, self.owner, tag, until, self.offset, self.lease)


def _read(data: bytes) -> _Lease:
    """Decode a lease; a damaged one is nobody's, and has expired."""
    try:
        return msgspec.json.decode(data, type=_Lease)
    except (ValueError, RecursionError):  # msgspec's errors are ValueErrors.
        return _Lease("", 0.0)


class Sizes(NamedTuple):
    """Partition of a plan into chunks: whole ones, then halves, quarters and eighths in its last part. The same for all workers."""

    episodes: int
    chunk: int

    def bounds(self) -> Iterator[tuple[int, int]]:
        """Yield the bounds of each chunk as positions in the plan: first, and the one after its last."""
        start, tail = 0, int(self.episodes * TAIL)
        for halving in range(HALVINGS + 1):
            end = self.episodes if halving == HALVINGS else self.episodes - (tail >> halving)
            size = max(1, self.chunk >> halving)
            while start < end:
                yield start, (start := min(start + size, self.episodes))


def default_chunk(worlds: int, episodes: int) -> int:
    """Default size of a whole chunk [episodes], by the number of worlds of a device (0: as many as fit) and of episodes in the plan."""
    return max(1, min(CHUNK_WORLDS * (worlds or AUTO_WORLDS), episodes // LEAST_CHUNKS))


class Chunk(NamedTuple):
    """Chunk of a worker: its number, its episodes without done mark, its claim (None: episodes are shared out by --shard)."""

    number: int
    episodes: list[int]
    claim: Claim | None


class Chunks:
    """Work queue in the store: iterates over the chunks that this worker claims, one at a time, until all of the plan are done."""

    def __init__(self, ledger: Ledger, claims: Claims, ranges: Sequence[range], chunk: int) -> None:
        """`ranges`: episodes that the bake must deliver; `chunk`: proposed number of episodes of a whole chunk, of which that of the worker
        that starts first counts for all."""
        self._ledger, self.claims, self._ranges = ledger, claims, ranges
        self.on_wait: Callable[[], object] = lambda: None
        """Callback, invoked when this worker begins to wait for chunks that other workers hold."""
        name = hashlib.sha256(repr([(each.start, each.stop, each.step) for each in ranges]).encode()).hexdigest()[:16]
        self._place = f"{CLAIMS}/{name}"
        self.sizes = self._agree(Sizes(sum(map(len, ranges)), chunk))
        self._order = list(self._in_order())

    def _agree(self, sizes: Sizes) -> Sizes:
        """Agree on the partition by create-if-absent: that of the worker that started first. Raises StoreError: its record is damaged."""
        store, key = self._ledger.store, f"{self._place}/plan.json"
        store.create(key, msgspec.json.encode(sizes.chunk))
        try:
            chunk = msgspec.json.decode(store.get(key, SMALL), type=int)
        except (ValueError, FileNotFoundError):  # msgspec's errors are ValueErrors.
            chunk = 0
        if chunk < 1:
            raise StoreError(f"{store.url}/{key} is damaged; delete it, and start all workers again")
        return sizes._replace(chunk=chunk)

    def __iter__(self) -> Iterator[Chunk]:
        """Yield claimed chunks; waits while other workers have the leases on all others. The caller calls `done`, or ends the claim."""
        pauses = None
        while True:
            chunk, are_over = self.take()
            if are_over:
                return
            if chunk is None:
                if pauses is None:
                    pauses = self.claims.pauses()
                    self.on_wait()
                clock.sleep(next(pauses))
                continue
            pauses = None
            if chunk.episodes:
                yield chunk
            else:
                self.done(chunk)

    def take(self) -> tuple[Chunk | None, bool]:
        """Claim a free chunk, which may have no episodes left; None: there is none at present. Second: whether all have end marks."""
        over, leased = self._state()
        open_chunks = [each for each in self._order if each[0] not in over]
        return (self._take_first(open_chunks, leased), False) if open_chunks else (None, True)

    def _take_first(self, open_chunks: Sequence[tuple[int, tuple[int, int]]], leased: set[int]) -> Chunk | None:
        """Claim the first of these chunks that is free, by its lease's absence or age; None: none is, or other workers were faster.
        `open_chunks`: number and bounds of the chunks without end mark. `leased`: numbers of those that had a lease when they were listed.
        Of those that are not known to last, CHECKS are looked at."""
        now, seen = clock.time() + self.claims.offset, self.claims.seen
        free = [each for each in open_chunks if each[0] not in leased]
        held = [each for each in open_chunks if each[0] in leased and seen.get(self._key(each[0]), 0.0) <= now]
        for number, (start, end) in free[:CHECKS] or random.sample(held, min(CHECKS, len(held))):
            claim = self.claims.take(self._key(number))
            if claim is None:
                continue
            try:
                return Chunk(number, self._left(start, end), claim)
            except BaseException:
                claim.stop()  # Its heartbeat would outlive the error, and keep others from the chunk.
                raise
        return None

    def done(self, chunk: Chunk) -> None:
        """Write the end mark of a chunk whose episodes all have done marks, and end its claim, also after an error."""
        try:
            self._ledger.store.put(f"{self._place}/done/{chunk.number:06d}", b"")
        finally:
            if chunk.claim is not None:
                chunk.claim.stop()

    def count_over(self) -> int:
        """Number of episodes in the chunks that have end marks."""
        over, _ = self._state()
        return sum(end - start for number, (start, end) in enumerate(self.sizes.bounds()) if number in over)

    def _key(self, number: int) -> str:
        return f"{self._place}/{number:06d}"

    def _state(self) -> tuple[set[int], set[int]]:
        """List the chunks that have end marks, and those that have leases, by their numbers."""
        over, leased = set[int](), set[int]()
        for key, _ in self._ledger.store.list(self._place):
            folder, _, name = key.rpartition("/")
            if name.isdecimal():
                (leased if folder == self._place else over).add(int(name))
        return over, leased

    def _in_order(self) -> Iterator[tuple[int, tuple[int, int]]]:
        """Order in which this worker tries the chunks, as (number, bounds): the larger before the smaller; those of a size cyclically from
        a hash of the worker's name, so that few workers collide."""
        first = int(hashlib.sha256(self.claims.owner.encode()).hexdigest(), 16)
        for _, group in itertools.groupby(enumerate(self.sizes.bounds()), lambda each: each[1][1] - each[1][0]):
            chunks = list(group)
            turn = first % len(chunks)
            yield from chunks[turn:] + chunks[:turn]

    def _left(self, start: int, end: int) -> list[int]:
        """Episodes of a chunk that have no done mark, sorted; arguments: its bounds in the plan."""
        wanted: list[int] = []
        for each in self._ranges:
            wanted += each[max(0, start) : max(0, end)]
            start, end = start - len(each), end - len(each)
        return list(itertools.chain.from_iterable(self._ledger.remaining([sorted(wanted)])))


def open_claims(ledger: Ledger, lease: float) -> Claims:
    """Lease manager of this process, with leases of `lease` [s]. Raises StoreError: the store has no conditional writes."""
    if not ledger.probe.conditional:
        raise StoreError(
            f"{ledger.store.url} has no conditional writes, which --claim needs; share the episodes out by --shard i/n instead"
        )
    return Claims(ledger.store, ledger.probe.offset, lease)


def plan_chunks(ledger: Ledger, claims: Claims, ranges: Sequence[range]) -> Chunks:
    """Work queue of the episodes in `ranges`, with chunks of the default size."""
    return Chunks(ledger, claims, ranges, default_chunk(ledger.config.bake.worlds, sum(map(len, ranges))))
