"""Bake into a store: episodes are baked in a temporary folder, delivered meanwhile, and finalized by whoever ends last."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

from synpick_warp.cloud.delivery import Delivery, WatchedProgress
from synpick_warp.cloud.finish import finalize_store
from synpick_warp.cloud.ledger import Ledger
from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit.manifest import MANIFEST_FILE
from synpick_warp.errors import StoreError, SynpickError
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.factory.pipeline import bake_episodes, with_measures
from synpick_warp.system.progress import Progress
from synpick_warp.system.stores.opening import open_store, probe

MAX_CHUNK = 10_000
"""Most episodes of a bake without claims from one start of the worlds to the next."""


class Baker(Protocol):
    """Function that bakes episodes into a folder, such as `pipeline.bake_episodes`."""

    def __call__(
        self,
        config: Config,
        out: Path,
        progress: Progress,
        episodes: Sequence[int],
        devices: Sequence[str] = (),
        deliver: Callable[[], None] | None = None,
    ) -> BakeSummary: ...


def bake_into_store(
    config: Config,
    url: str,
    progress: Progress,
    shard: tuple[int, int] = (0, 1),
    splits: Sequence[str] = (),
    devices: Sequence[str] = (),
    bake: Baker = bake_episodes,
) -> BakeSummary:
    """Simulate, render and upload a data set, or the remaining episodes of one.

    Args:
        config: All settings.
        url: Prefix of the data set: new, or of an earlier bake with the same settings.
        progress: Observer.
        shard: (i, n): only episodes with index % n == i.
        splits: Only episodes of these splits; empty: all.
        devices: As in `pipeline.run_bake`.
        bake: Bakes episodes into a folder.

    Returns:
        Summary of the episodes of this run; those that were done before are not in it.

    Raises:
        SynpickError: An error that the user can correct; done episodes stay, and the same bake resumes.
    """
    config = with_measures(config, devices)
    ranges = DataLayout.of(config).plan_shard(splits, shard)
    store = open_store(url)
    ledger = Ledger(store, config, probe(store))
    summary = BakeSummary()
    with tempfile.TemporaryDirectory(prefix="synpick-store-") as place:
        for number, episodes in enumerate(_chunks(ledger, ranges)):
            folder = Path(place, f"{number:06d}")
            part = _bake_chunk(ledger, folder, episodes, progress, devices, bake)
            summary.total += part.total
            summary.take_summary(part)
            summary.wall_seconds += part.wall_seconds
            if part.stopped:
                summary.stopped = part.stopped
                return summary
        if not summary.total:
            progress.note("all episodes are done")
        progress.stage("finishing files")
        if missing := finalize_store(ledger, Path(place)):
            progress.note(f"{missing:,} episodes are not done yet: whoever ends last writes the indices")
    return summary


def _chunks(ledger: Ledger, ranges: Sequence[range]) -> Iterator[list[int]]:
    """Remaining episodes, in lists of at most MAX_CHUNK and a block."""
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
    folder: Path,
    episodes: Sequence[int],
    progress: Progress,
    devices: Sequence[str],
    bake: Baker,
    permit: Callable[[], None] = lambda: None,
) -> BakeSummary:
    """Bake episodes in a new folder, and deliver them; errors name the store in its place."""
    folder.mkdir()
    if ledger.manifest is not None:  # It has the digests of objects and lights, which the bake compares.
        (folder / MANIFEST_FILE).write_bytes(ledger.manifest)
    try:
        with Delivery(ledger, folder, permit) as delivery:
            watched = WatchedProgress(progress, delivery.check)
            return bake(ledger.config, folder, watched, episodes, devices, partial(_finish, delivery))
    except StoreError:
        raise
    except SynpickError as error:
        raise type(error)(str(error).replace(str(folder), ledger.store.url)) from error


def _finish(delivery: Delivery) -> None:
    delivery.finish()
