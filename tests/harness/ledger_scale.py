"""Benchmark of resume and finalization against the number of done episodes: time, requests, peak memory. The store is in memory.

python -m tests.harness.ledger_scale --episodes 10000,100000,1000000 --finalize 1000,10000,100000 --json FILE
"""

from __future__ import annotations

import gzip
import io
import re
import resource
import sys
import tarfile
import tempfile
import time
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest

from synpick_warp.cloud import finish
from synpick_warp.cloud.bundles import MAX_BUNDLE, join_bundles
from synpick_warp.cloud.ledger import BLOCK, DONE, FINISHED, INDEX, Ledger
from synpick_warp.cloud.run import bake_into_store
from synpick_warp.exporters.writing.files import LINES
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from synpick_warp.system.stores.opening import Probe, open_store
from synpick_warp.system.stores.store import Store
from tests.cloud.conftest import keep_in_memory, tiny
from tests.harness import scripted_bake
from tools.figures import finish_report
from tools.options import Row, make_parser, positive_count

FRAMES = 504
"""Typical number of frames of an episode of mode pick or move."""
LEFT = 1000
"""Number of remaining episodes of a resume."""


def peak() -> float:
    """Peak resident memory of this process [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def open_with_marks(episodes: int, kind: str, make: bool) -> Store:
    """Make a store with the records of a data set of format `kind`, and batched marks of `episodes` episodes. `make`: with index files."""
    url = keep_in_memory(pytest.MonkeyPatch())
    store = open_store(url)
    with mock.patch.object(scripted_bake, "FRAMES", FRAMES if make else 1):
        bake_into_store(tiny(1, (kind,)), url, SilentProgress(), bake=scripted_bake.bake_episodes)
    for key in (FINISHED, *(key for key, _ in list(store.list(DONE)))):
        store.delete(key)
    with tarfile.open(fileobj=io.BytesIO(gzip.decompress(store.get(f"{INDEX}/000000.tar.gz", MAX_BUNDLE)))) as archive:
        members = [(info.name, file.read()) for info in archive if (file := archive.extractfile(info)) is not None]
    for first in range(0, episodes, BLOCK):
        last, data = min(first + BLOCK, episodes) - 1, io.BytesIO(b"mark")
        if make:
            join_bundles((_renumber(members, episode) for episode in range(first, last + 1)), data)
        store.put(f"{DONE}/{first // BLOCK:06d}_{first:06d}-{last:06d}", data.getvalue())
    return store


def _renumber(members: list[tuple[str, bytes]], episode: int) -> bytes:
    """Index file of `episode`: that of episode 0 with the numbers changed."""
    first = len(tiny().rig) * episode
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for name, data in members:
            if name.startswith(f"{LINES}/"):
                data = re.sub(rb'"00000(\d)_', lambda found: b'"%06d_' % (first + int(found[1])), data)
                data = re.sub(rb'"episode": 0\b', b'"episode": %d' % episode, data)
                data = re.sub(rb'"scene_id": (\d)\b', lambda found: b'"scene_id": %d' % (first + int(found[1])), data)
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return gzip.compress(packed.getvalue(), 1, mtime=0)


def measure_resume(episodes: int) -> Iterator[Row]:
    """Measure the search for the remaining episodes of a data set with `episodes` done ones."""
    store, part, counts = open_with_marks(episodes, "shards", make=False), f"{episodes:,} episodes", Counter[str]()
    real = store._obs.list  # type: ignore[attr-defined]

    def resume() -> float:
        started = time.perf_counter()
        ledger = Ledger(store, tiny(episodes + LEFT, ("shards",)), Probe(0.0, True))
        if sum(map(len, ledger.remaining([range(episodes + LEFT)]))) != LEFT:
            raise RuntimeError("the wrong episodes are left")
        return time.perf_counter() - started

    with mock.patch.object(store._obs, "list", lambda *given, **named: counts.update(["list"]) or real(*given, **named)):  # type: ignore[attr-defined]
        yield Row("resume", resume(), "s", part=part)
    yield Row("resume: listings", counts["list"], part=part)
    tracemalloc.start()
    resume()
    yield Row("resume: peak memory", 1e-6 * tracemalloc.get_traced_memory()[1], "MB", part=part)
    tracemalloc.stop()


def measure_finalization(episodes: int, kind: str) -> Iterator[Row]:
    """Measure the finalization of `episodes` episodes of a format, without the upload of the indices."""
    store, part, before = open_with_marks(episodes, kind, make=True), f"{episodes:,} episodes", peak()
    with tempfile.TemporaryDirectory() as name, mock.patch.object(finish, "_put_indices"):
        started = time.perf_counter()
        finish.finalize_store(Ledger(store, tiny(episodes, (kind,)), Probe(0.0, True)), Path(name))
        yield Row(f"finalization of {kind}", time.perf_counter() - started, "s", part=part)
        yield Row(f"finalization of {kind}: peak memory", peak() - before, "MB", part=part)
        size = sum(path.stat().st_blocks * 512 for path in Path(name).rglob("*"))
        yield Row(f"finalization of {kind}: temporary folder", 1e-6 * size, "MB", part=part)


def main() -> int:
    """Run the command line; returns the exit code."""
    counts = {"type": lambda text: sorted(map(positive_count, text.split(",")))}
    own = {
        "episodes": counts | {"default": [10_000, 100_000, 1_000_000], "help": "numbers for the resume"},
        "finalize": counts | {"default": [1_000, 10_000, 100_000], "help": "numbers for the finalization"},
    }
    options = make_parser(__doc__, "json", own=own).parse_args()
    rows = [row for count in options.episodes for row in measure_resume(count)]
    rows += [row for count in options.finalize for kind in ("bop", "shards") for row in measure_finalization(count, kind)]
    return finish_report("tests.harness.ledger_scale", options.json, pick_device("cpu"), "", "many episodes", rows)


if __name__ == "__main__":
    sys.exit(main())
