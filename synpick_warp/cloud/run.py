"""Distributed bake into an object store: episodes are baked in a temporary folder and uploaded meanwhile; the last worker finalizes:
it makes the indices over all episodes in a local folder from the episodes' index files."""

import contextlib
import gc
import heapq
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from synpick_warp.cloud.claims import CLAIMS, LEASE, Chunk, Chunks, Claims, LeaseLostError, open_claims, plan_chunks
from synpick_warp.cloud.delivery import FILES_AT_ONCE, MAX_BUNDLE, Delivery, WatchedProgress, send_file, unpack_bundle
from synpick_warp.cloud.ledger import FINISHED, FINISHING, INDEX, Ledger
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.files.load import config_to_toml
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit.manifest import CONFIG_FILE, CONSTANTS, ENTRIES, INDICES, MANIFEST_FILE, read_checksums
from synpick_warp.dataset.commit.writing import finalize_data_set
from synpick_warp.errors import OutputError, StoreError, SynpickError
from synpick_warp.exporters.formats import indexed_files
from synpick_warp.exporters.registry import Needs, shared_files
from synpick_warp.exporters.writing.files import LINES, parse_checksums
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.factory.episodes import BakeSummary, EpisodeSource, count_writers, measured
from synpick_warp.system import clock
from synpick_warp.system.inputs.files import MAX_JSON, make_folder
from synpick_warp.system.progress import ForwardingProgress, Progress
from synpick_warp.system.stores.store import SMALL, open_store, probe

AHEAD = 256
"""Index files that are requested together, and then unpacked in the order of their episodes."""


def finalize_store(ledger: Ledger, folder: Path) -> int:
    """Finalize a data set: writes the indices over all episodes, if all are done and the indices do not cover them yet. Returns the number
    of episodes that are not done; 0: the data set is finished. `folder`: an empty one, for temporary files. Raises DatasetError: an index
    file is damaged; OutputError: the temporary folder cannot be written; StoreError: an object was deleted that the indices are made of,
    another plan was finalized at once, or the store does not answer."""
    if ledger.finished():
        return 0
    if missing := sum(map(len, ledger.remaining(ledger.layout.plan()))):
        return missing
    work = folder / "set"
    try:
        episodes, needs = _gather(ledger, work), Needs.of(ledger.config)
        with WriterPool(count_writers(ledger.config.bake.writers, needs.slot_bytes), needs.slot_bytes) as pool:
            finalize_data_set(work, ExportSettings.of(ledger.config), needs.classes, pool, episodes)
    except FileNotFoundError as error:
        said = (str(error).splitlines() or ["an object"])[0]
        advice = "restore it, or delete the done mark of its episode, manifest/NUMBER.json, and resume the bake without --claim"
        raise StoreError(f"what the indices of {ledger.store.url} are made of is missing: {said}; {advice}") from None
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}; set TMPDIR to a folder with more space") from None
    if not ledger.finished():  # Else another bake of these episodes, or of more, has ended meanwhile.
        _put_indices(ledger, work)
    return 0


def _put_indices(ledger: Ledger, work: Path) -> None:
    """Upload the indices. The announcement of the plan is the first write and the last read: who finds another's may have mixed with it.
    Raises StoreError: another plan was finalized at once."""
    store, plan = ledger.store, ledger.plan
    store.put(FINISHING, plan)
    for name, digest in read_checksums(work, INDICES).items():
        send_file(store, work / name, name, digest)
    for suffix in (".sha256", ".json"):
        store.put(f"{INDICES}{suffix}", (work / f"{INDICES}{suffix}").read_bytes())
    store.put(FINISHED, plan)
    if store.get(FINISHING, SMALL) != plan:
        store.put(FINISHING, b"")  # The other one fails too, if it has not read this object yet; else `finished` goes after its write.
        store.delete(FINISHED)
        raise StoreError(f"another bake finalized {store.url} for other episodes at the same time; when it has ended, run the larger again")


def _gather(ledger: Ledger, work: Path) -> list[int]:
    """Gather the inputs of the indices in a local data set: manifest, settings, indexed constants, and the content of all index files;
    returns the episodes, sorted."""
    store, layout = ledger.store, ledger.layout
    indexed = indexed_files(layout.formats)
    for name in (ENTRIES, Path(LINES), *shared_files(Needs.of(ledger.config).classes, layout).folders):
        if not name.name.endswith("*"):
            make_folder(work / name)
    (work / MANIFEST_FILE).write_bytes(store.get(MANIFEST_FILE, MAX_JSON))
    (work / CONFIG_FILE).write_text(config_to_toml(ledger.config))
    constants = parse_checksums(store.get(f"{CONSTANTS}.sha256", MAX_JSON), work, work / f"{CONSTANTS}.sha256", "resume the bake")
    for name in filter(indexed.fullmatch, constants):
        make_folder((work / name).parent)
        (work / name).write_bytes(store.get(name, MAX_JSON))
    episodes = list(heapq.merge(*layout.plan()))
    with clock.Executor(FILES_AT_ONCE, "index") as pool:
        for first in range(0, len(episodes), AHEAD):
            names = [f"{INDEX}/{episode:06d}.tar.gz" for episode in episodes[first : first + AHEAD]]
            for name, bundle in zip(names, pool.map(lambda name: store.get(name, MAX_BUNDLE), names), strict=True):
                unpack_bundle(bundle, work, indexed, f"{store.url}/{name}")
    return episodes


MAX_CHUNK = 10_000
"""Chunk size of a bake without claims [episodes], to within a block; each chunk starts the worlds anew."""
HELD_CHUNKS = 3
"""Prefetch limit of a claiming worker [chunks]: while it holds the episodes of this many, it claims no other, which leaves work for workers
that start later. If the number of workers is known, the limit is at least a worker's share of the plan."""

Baker = Callable[..., BakeSummary]
"""Function that bakes episodes into a folder, with the arguments of `pipeline.bake_episodes`."""


@dataclass(frozen=True)
class Job:
    """Bake of a data set into an object store: what all of its workers share, and what a worker has for itself."""

    config: Config
    url: str
    """Prefix of the data set: new, or of an earlier bake with the same settings."""
    splits: tuple[str, ...] = ()
    """Only episodes of these splits; empty: all."""
    bake: Baker | None = None
    """Bakes episodes into a folder; None: `pipeline.bake_episodes`."""
    lease: float = LEASE
    """Time to live of a claim without heartbeat [s]."""
    own: Mapping[str, object] = field(default_factory=dict)
    """Full key -> value of settings of a worker alone: device, writers."""


@dataclass
class Crew:
    """Claiming workers of a command, with what they have cost."""

    price: float = 0.0
    """Price of a worker an hour."""
    alive: int = 0
    seconds: float = 0.0
    """Accumulated running time of all workers [s]."""

    def __str__(self) -> str:
        cost = f" · cost {self.price * self.seconds / 3600.0:,.2f}" if self.price else ""
        return f"{self.alive} worker{'s' * (self.alive != 1)}{cost}"


class PlanProgress(ForwardingProgress):
    """Observer of all of a command's claiming workers: passes on their counts as part of the plan, with the remaining time by their mean
    rate, and adds the time of its `alive` workers to their `Crew`."""

    def __init__(self, progress: Progress, chunks: Chunks, crew: Crew) -> None:
        super().__init__(progress)
        self._chunks, self._planned, self._before = chunks, chunks.sizes.episodes, chunks.count_over()
        self._crew, self._started = crew, clock.monotonic()
        self._now = self._started

    def update(self, *, episodes_done: int, episodes: int, worlds_active: int, seconds_left: float | None, **views: Any) -> None:
        """Pass on counts since the workers' start; running episodes count as half done. See `Progress`."""
        del episodes, seconds_left
        before, self._now = self._now, clock.monotonic()
        self._crew.seconds += self._crew.alive * (self._now - before)
        done, begun = self._before + episodes_done, episodes_done + 0.5 * worlds_active
        left = max(0.0, self._planned - self._before - begun) * (self._now - self._started) / begun if episodes_done else None
        shown = {"episodes_done": min(self._planned, done), "episodes": self._planned, "worlds_active": worlds_active}
        super().update(**shown, **views, seconds_left=left)

    def count(self, alive: int) -> None:
        """Report the episodes of the chunks that have ended, for workers that report nothing themselves, `alive` of which run."""
        self._crew.alive = alive
        done = self._chunks.count_over() - self._before
        self.update(episodes_done=done, episodes=0, worlds_active=0, views=0, views_per_s=0.0, seconds_left=None)


def open_ledger(job: Job) -> Ledger:
    """Commit log of a job's data set; its store is opened and probed. Raises SynpickError as these do."""
    store = open_store(job.url)
    return Ledger(store, job.config, probe(store))


def bake_into_store(
    job: Job,
    progress: Progress,
    shard: tuple[int, int] = (0, 1),
    devices: Sequence[str] = (),
    *,
    claim: bool = False,
    workers: int = 0,
    summary: BakeSummary | None = None,
) -> BakeSummary:
    """Bake a data set into an object store: simulates, renders and uploads it, or the remaining episodes of one. Other arguments as of
    `synpick_warp.bake`; `workers`: number of claiming ones, which begin at about the same time, 0: unknown; `summary` receives the episodes
    bake by bake, for a caller that ends this by an exception.

    Returns the summary of this run's episodes, without those that were done before, or lost to other workers with the leases of their
    chunks. Raises SynpickError: an error that the user can correct; done episodes stay, and the same bake resumes."""
    job = replace(job, config=measured(job.config, devices))
    ranges = DataLayout.of(job.config).plan_shard(job.splits, shard)
    ledger = open_ledger(job)
    claims = open_claims(ledger, job.lease) if claim else None
    summary = BakeSummary() if summary is None else summary
    with tempfile.TemporaryDirectory(prefix="synpick-store-") as name:
        place = Path(name)
        if claims is None or not ledger.finished():
            for work in _works(ledger, place, claims, ranges, workers, progress):
                with work:
                    part = _bake(job, ledger, place, work, progress, devices, summary)
                if _take(summary, part):
                    return summary
                gc.collect()  # Frees the worlds of this bake before memory for those of the next is planned.
        if not summary.total:
            progress.note("all episodes are done")
        progress.stage("finishing files")
        missing = finalize_store(ledger, place) if claims is None else _finalize_once(ledger, claims, place)
        if missing:
            progress.note(f"{missing:,} episodes are not done yet: whoever ends last writes the indices")
    return summary


class _Work(EpisodeSource):
    """Episode source of one bake into the store: a first chunk and, with claims, further chunks whenever worlds are idle.

    A chunk gets its end mark when all of its episodes have done marks, and is dropped when its lease is lost. Leaving the context releases
    the leases of all other chunks.
    """

    def __init__(self, ledger: Ledger, place: Path, first: Chunk, chunks: Chunks | None = None, limit: int = 0) -> None:
        """Begin with the chunk `first`; others are of the work queue `chunks`, unless there is none, of which none is claimed from `limit`
        episodes without done mark on."""
        super().__init__(first.episodes, limit)
        self.lost: set[int] = set()
        """Episodes of the chunks whose leases are lost."""
        self._ledger, self._place, self._chunks, self._limit = ledger, place, chunks, limit
        self._held: dict[int, tuple[Chunk, set[int]]] = {}
        """Chunk and its episodes that have no done mark, by chunk number."""
        self._numbers: dict[int, int] = {}
        """Chunk number of each episode that has no done mark, by the episode's index."""
        self._notes: list[str] = []
        self._lock = clock.Lock()
        self._asker = clock.Executor(1, "claim")
        self._asked: Future[tuple[Chunk | None, bool]] | None = None
        self._pauses: Iterator[float] | None = None
        self._next = 0.0
        self._hold(first)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Release the leases of unfinished chunks. After an unexpected error they are left to expire."""
        held = [chunk for chunk, _ in self._held.values()]
        if self._asked is not None:
            with contextlib.suppress(BaseException):
                held += filter(None, [self._asked.result()[0]])
        self._asker.shutdown()
        for chunk in held:
            if chunk.claim is not None and (error is None or isinstance(error, SynpickError)):
                chunk.claim.release()
            elif chunk.claim is not None:
                chunk.claim.stop()

    def report(self, progress: Progress) -> None:
        """Report the leases that were lost since the last call. Called by the thread of the bake."""
        while self._notes:
            progress.note(self._notes.pop(0))

    def permit(self, episode: int) -> None:
        """Check the lease of an episode's chunk. If it is lost, drop the chunk and raise LeaseLostError."""
        with self._lock:
            chunk, left = self._held.get(self._numbers.get(episode, -1), (None, set[int]()))
            try:
                if chunk is None:
                    raise LeaseLostError(f"episode {episode} was lost with the claim of its chunk")
                if chunk.claim is not None:
                    chunk.claim.check()
                return
            except LeaseLostError as error:
                if chunk is None:
                    raise
                del self._held[chunk.number]
                self.lost |= left
                self._notes.append(str(error))
                lost = error
        assert chunk.claim is not None
        chunk.claim.stop()
        raise lost

    def delivered(self, episode: int) -> None:
        """Record that an episode has its done mark. After a chunk's last one, write the end mark."""
        with self._lock:
            chunk, left = self._held.get(self._numbers.pop(episode), (None, set[int]()))
            left.discard(episode)
            if left or chunk is None:
                return
            del self._held[chunk.number]
        if self._chunks is not None:
            self._chunks.done(chunk)

    def more(self, wait: bool) -> list[int]:
        """Claim another chunk asynchronously: returns the episodes of the claim that an earlier call began. See `EpisodeSource`."""
        if self._chunks is None:
            return []
        if self._asked is None:
            with self._lock:
                count = sum(len(left) for _, left in self._held.values())
            if not wait and (count >= self._limit or clock.monotonic() < self._next):
                return []
            self._asked = self._asker.submit(self._chunks.take)
        if not (wait or self._asked.done()):
            return []
        asked, self._asked = self._asked, None
        chunk, _ = asked.result()
        if chunk is not None and chunk.number not in self._held and self.lost.isdisjoint(chunk.episodes):
            self._pauses = None
            if chunk.episodes:
                self._hold(chunk)
            else:
                self._chunks.done(chunk)
            return chunk.episodes
        if chunk is not None and chunk.claim is not None:  # Worlds may still run episodes whose lease ran out: files have the same names.
            chunk.claim.release()
        self._pauses = self._pauses or self._chunks.claims.pauses()
        self._next = clock.monotonic() + next(self._pauses)
        return []

    def _hold(self, chunk: Chunk) -> None:
        """Add a claimed chunk."""
        with self._lock:
            self._held[chunk.number] = chunk, set(chunk.episodes)
            self._numbers |= dict.fromkeys(chunk.episodes, chunk.number)


def _take(summary: BakeSummary, part: BakeSummary) -> bool:
    """Accumulate the summary of a bake in that of the run. Returns whether a signal stopped the bake."""
    seconds = summary.wall_seconds + part.wall_seconds
    summary.total += part.total
    summary.take_summary(part)
    summary.wall_seconds = seconds
    summary.stopped = part.stopped
    return summary.stopped != 0


def _works(
    ledger: Ledger, place: Path, claims: Claims | None, ranges: Sequence[range], workers: int, progress: Progress
) -> Iterator[_Work]:
    """Yield the episode source of each bake; arguments as of `bake_into_store`. With claims, ends when the whole plan is done."""
    if claims is None:
        for number, episodes in enumerate(_chunks(ledger, ranges)):
            yield _Work(ledger, place, Chunk(number, episodes, None))
        return
    planned = sum(map(len, ranges))
    chunks = plan_chunks(ledger, claims, ranges)
    chunks.on_wait = partial(progress.stage, "waiting for episodes that other workers have claimed")
    limit = max(HELD_CHUNKS * chunks.sizes.chunk, -(-planned // workers) if workers else 0)
    for chunk in chunks:
        yield _Work(ledger, place, chunk, chunks, min(limit, planned))


def _finalize_once(ledger: Ledger, claims: Claims, place: Path) -> int:
    """Finalize under a lease, one worker at a time; the others wait, and take over if it dies. Returns as `finalize_store`."""
    pauses = claims.pauses()
    while not ledger.finished():
        claim = claims.take(f"{CLAIMS}/indices")
        if claim is not None:
            try:
                return finalize_store(ledger, place)
            finally:
                claim.release()
        clock.sleep(next(pauses))
    return 0


def _chunks(ledger: Ledger, ranges: Sequence[range]) -> Iterator[list[int]]:
    """Yield the remaining episodes in chunks of about MAX_CHUNK: whole blocks, so up to BLOCK - 1 more."""
    held: list[int] = []
    for left in ledger.remaining(ranges):
        held += left
        if len(held) >= MAX_CHUNK:
            yield held
            held = []
    if held:
        yield held


def _bake(
    job: Job, ledger: Ledger, place: Path, work: _Work, progress: Progress, devices: Sequence[str], ended: BakeSummary
) -> BakeSummary:
    """Bake and upload episodes in a new temporary folder, after those of `ended`; messages of errors name the store in its place."""
    bake = job.bake or import_module("synpick_warp.factory.pipeline").bake_episodes  # The simulator, which who starts workers needs not.
    folder = Path(tempfile.mkdtemp(dir=place))
    if ledger.manifest is not None:  # It has the digests of objects and lights, which the bake compares.
        (folder / MANIFEST_FILE).write_bytes(ledger.manifest)

    def check() -> None:
        work.report(progress)
        delivery.check()

    def deliver() -> None:
        progress.stage("uploading finished episodes")
        delivery.finish()

    try:
        with Delivery(ledger, folder, work.permit, work.delivered) as delivery:
            summary = bake(job.config.with_values(job.own), folder, WatchedProgress(progress, check, ended), work, devices, deliver)
        work.report(progress)
        summary.total -= len(work.lost)
        summary.episodes = [row for row in summary.episodes if row.episode not in work.lost]
        return summary
    except (StoreError, LeaseLostError):
        raise
    except SynpickError as error:
        raise type(error)(str(error).replace(str(folder), ledger.store.url)) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
