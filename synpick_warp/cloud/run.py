"""Distributed bake into an object store: episodes are baked in a temporary folder and uploaded meanwhile; the last worker finalizes."""

from __future__ import annotations

import random
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from synpick_warp.cloud.claims import BEATS, CLAIMS, LEASE, Chunks, Claims, LeaseLostError, default_chunk
from synpick_warp.cloud.delivery import Delivery, WatchedProgress
from synpick_warp.cloud.finish import close_blocks, finalize_store
from synpick_warp.cloud.ledger import Ledger
from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit.manifest import MANIFEST_FILE
from synpick_warp.errors import StoreError, SynpickError
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.factory.kept import keeping_baker
from synpick_warp.factory.pipeline import with_measures
from synpick_warp.system.progress import Progress
from synpick_warp.system.stores.opening import open_store, probe

MAX_CHUNK = 10_000
"""Chunk size of a bake without claims [episodes], to within a block; each chunk starts the worlds anew."""


Baker = Callable[..., BakeSummary]
"""Function that bakes episodes into a folder, with the arguments of `pipeline.bake_episodes`."""


@dataclass(frozen=True)
class Job:
    """Parameters of a bake that all of its claiming workers share; as the arguments of `bake_into_store`."""

    config: Config
    url: str
    splits: tuple[str, ...] = ()
    bake: Baker | None = None
    lease: float = LEASE


def bake_into_store(
    config: Config,
    url: str,
    progress: Progress,
    shard: tuple[int, int] = (0, 1),
    splits: Sequence[str] = (),
    devices: Sequence[str] = (),
    bake: Baker | None = None,
    *,
    claim: bool = False,
    lease: float = LEASE,
) -> BakeSummary:
    """Bake a data set into an object store: simulates, renders and uploads it, or the remaining episodes of one.

    Args:
        config: All settings.
        url: Prefix of the data set: new, or of an earlier bake with the same settings.
        progress: Observer.
        shard: (i, n): only episodes with index % n == i.
        splits: Only episodes of these splits; empty: all.
        devices: As in `pipeline.run_bake`.
        bake: Bakes episodes into a folder; None: one that keeps objects, lights, worlds and kernels from chunk to chunk.
        claim: Whether this is one of several equal workers, which share the episodes out among them by claims.
        lease: Time to live of a claim without heartbeat [s].

    Returns:
        Summary of this run's episodes, without those that were done before, and those of chunks that were lost to other workers.

    Raises:
        SynpickError: An error that the user can correct; done episodes stay, and the same bake resumes.
    """
    config = with_measures(config, devices)
    ranges = DataLayout.of(config).plan_shard(splits, shard)
    store = open_store(url)
    ledger = Ledger(store, config, probe(store))
    if claim and not ledger.probe.conditional:
        raise StoreError(f"{url} has no conditional writes, which --claim needs; share the episodes out by --shard i/n instead")
    summary = BakeSummary()
    with tempfile.TemporaryDirectory(prefix="synpick-store-") as name:
        place = Path(name)
        baking = partial(_bake_chunk, ledger, place, progress=progress, devices=devices, bake=bake or keeping_baker())
        claims = Claims(store, ledger.probe.offset, lease) if claim else None
        if claims is None:
            for episodes in _chunks(ledger, ranges):
                if _take(summary, baking(episodes)):
                    return summary
        elif not ledger.finished() and _bake_claims(ledger, claims, ranges, baking, summary, progress):
            return summary
        if not summary.total:
            progress.note("all episodes are done")
        progress.stage("finishing files")
        missing = finalize_store(ledger, place) if claims is None else _finalize_once(ledger, claims, place)
        if missing:
            progress.note(f"{missing:,} episodes are not done yet: whoever ends last writes the indices")
    return summary


def _take(summary: BakeSummary, part: BakeSummary) -> bool:
    """Add the summary of a chunk to that of the run; returns whether a signal stopped the bake."""
    summary.total += part.total
    summary.take_summary(part)
    summary.wall_seconds += part.wall_seconds
    summary.stopped = part.stopped
    return summary.stopped != 0


def _bake_claims(
    ledger: Ledger,
    claims: Claims,
    ranges: Sequence[range],
    baking: Callable[..., BakeSummary],
    summary: BakeSummary,
    progress: Progress,
) -> bool:
    """Worker loop: claims and bakes chunks until all of the plan are done; returns whether a signal stopped this worker."""
    size = default_chunk(ledger.config.bake.worlds, sum(map(len, ranges)))
    chunks = Chunks(ledger, claims, ranges, size)
    for chunk in chunks:
        try:
            part = baking(chunk.episodes, permit=chunk.claim.check)
        except LeaseLostError as error:
            progress.note(str(error))
            chunk.claim.stop()
            continue
        except SynpickError:
            chunk.claim.release()
            raise
        except BaseException:
            chunk.claim.stop()
            raise
        if _take(summary, part):
            chunk.claim.release()
            return True
        chunks.done(chunk)
    return False


def _finalize_once(ledger: Ledger, claims: Claims, place: Path) -> int:
    """Finalize under a lease, one worker at a time; the others wait, and take over if it dies. Returns as `finalize_store`."""
    while not ledger.finished():
        claim = claims.take(f"{CLAIMS}/indices")
        if claim is not None:
            try:
                return finalize_store(ledger, place)
            finally:
                claim.release()
        time.sleep(claims.lease / BEATS * random.uniform(0.5, 1.0))
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


def _bake_chunk(
    ledger: Ledger,
    place: Path,
    episodes: Sequence[int],
    progress: Progress,
    devices: Sequence[str],
    bake: Baker,
    permit: Callable[[], None] = lambda: None,
) -> BakeSummary:
    """Bake and upload a chunk of episodes in a new temporary folder; messages of errors name the store in its place."""
    folder = Path(tempfile.mkdtemp(dir=place))
    if ledger.manifest is not None:  # It has the digests of objects and lights, which the bake compares.
        (folder / MANIFEST_FILE).write_bytes(ledger.manifest)
    try:
        with Delivery(ledger, folder, permit) as delivery:
            watched = WatchedProgress(progress, delivery.check)
            summary = bake(ledger.config, folder, watched, episodes, devices, delivery.finish)
        if not summary.stopped:  # So that the last worker does not read the index files of all episodes, one after the other.
            close_blocks(ledger, place, ledger.blocks_of(episodes))
        return summary
    except (StoreError, LeaseLostError):
        raise
    except SynpickError as error:
        raise type(error)(str(error).replace(str(folder), ledger.store.url)) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
