"""Finalization of a data set in a store: batched marks of complete blocks, then the indices over all episodes, made in a local folder."""

from __future__ import annotations

import contextlib
import heapq
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from synpick_warp.cloud.bundles import MAX_BUNDLE, join_bundles, split_bundles, unpack_bundle
from synpick_warp.cloud.delivery import FILES_AT_ONCE, send_file
from synpick_warp.cloud.ledger import BLOCK, DONE, FINISHED, FINISHING, INDEX, MARK_SPANS, Ledger, merge_spans, spell_spans
from synpick_warp.configs.dataset.export import ExportSettings
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.dataset.commit.manifest import (
    CONFIG_FILE,
    CONSTANTS,
    ENTRIES,
    INDICES,
    MANIFEST_FILE,
    read_checksums,
)
from synpick_warp.dataset.commit.writing import finalize_data_set
from synpick_warp.errors import OutputError, StoreError
from synpick_warp.exporters.formats import indexed_files
from synpick_warp.exporters.registry import Needs, shared_files
from synpick_warp.exporters.writing.checksums import parse_checksums
from synpick_warp.exporters.writing.files import LINES
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.factory.sizes import count_writers
from synpick_warp.system.folders import make_folder
from synpick_warp.system.inputs.json import MAX_JSON
from synpick_warp.system.stores.store import SMALL


def close_blocks(ledger: Ledger, folder: Path, only: Sequence[int] | None = None) -> int:
    """Compact complete blocks: writes batched marks of each block whose episodes all have done marks, of those that are in none.

    Args:
        ledger: Ledger of the data set.
        folder: Folder for a temporary file of a block.
        only: Blocks to look at; None: all.

    Returns:
        Number of planned episodes without done mark, in these blocks.

    Raises:
        OutputError: The temporary folder cannot be written.
        StoreError: An index file was deleted.
    """
    missing = 0
    with _clear_errors(ledger, folder):
        for block, unmarked in ledger.open_blocks(only):
            if left := len(set(unmarked) - ledger.done(block)):
                missing += left
                continue
            path, spans = folder / "block", merge_spans(range(episode, episode + 1) for episode in unmarked)
            for start in range(0, len(spans), MARK_SPANS):
                marked = spans[start : start + MARK_SPANS]
                names = [f"{INDEX}/{episode:06d}.tar.gz" for span in marked for episode in span]
                with path.open("wb") as file, ThreadPoolExecutor(FILES_AT_ONCE, "index") as pool:
                    join_bundles(pool.map(lambda name: ledger.store.get(name, MAX_BUNDLE), names), file)
                ledger.store.put_file(f"{DONE}/{block:06d}_{spell_spans(marked)}", path)
    return missing


@contextlib.contextmanager
def _clear_errors(ledger: Ledger, folder: Path) -> Iterator[None]:
    """Convert errors of missing objects to StoreError, and those of the temporary folder to OutputError."""
    try:
        yield
    except FileNotFoundError as error:
        said = (str(error).splitlines() or ["an object"])[0]
        advice = "restore it, or delete the done mark of its episode, manifest/NUMBER.json, and resume the bake without --claim"
        raise StoreError(f"what the indices of {ledger.store.url} are made of is missing: {said}; {advice}") from None
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}; set TMPDIR to a folder with more space") from None


def finalize_store(ledger: Ledger, folder: Path) -> int:
    """Finalize a data set: writes the indices over all episodes, if all are done and the indices do not cover them yet.

    Args:
        ledger: Ledger of the data set.
        folder: An empty folder, for temporary files.

    Returns:
        Number of episodes that are not done; 0: the data set is finished.

    Raises:
        DatasetError: A batched mark is damaged.
        OutputError: The temporary folder cannot be written.
        StoreError: An object was deleted that the indices are made of, another plan was finalized at once, or the store does not answer.
    """
    if ledger.finished():
        return 0
    if missing := close_blocks(ledger, folder):
        return missing
    work = folder / "set"
    with _clear_errors(ledger, folder):
        episodes, needs = _gather(ledger, work), Needs.of(ledger.config)
        with WriterPool(count_writers(ledger.config.bake.writers, needs.slot_bytes), needs.slot_bytes) as pool:
            finalize_data_set(work, ExportSettings.of(ledger.config), needs.classes, pool, episodes)
    if not ledger.finished():  # Else another bake of these episodes, or of more, has ended meanwhile.
        _put_indices(ledger, work)
    return 0


def _put_indices(ledger: Ledger, work: Path) -> None:
    """Upload the indices. The announcement of the plan is the first write and the last read: who finds another's may have mixed with it.

    Raises:
        StoreError: Another plan was finalized at once.
    """
    store, plan = ledger.store, spell_spans(ledger.plan).encode()
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
        (work / name).parent.mkdir(parents=True, exist_ok=True)
        (work / name).write_bytes(store.get(name, MAX_JSON))
    episodes: list[int] = []
    for episode, source, bundle in _bundles(ledger):
        episodes.append(episode)
        unpack_bundle(bundle, work, indexed, source)
    return episodes


def _bundles(ledger: Ledger) -> Iterator[tuple[int, str, bytes]]:
    """Yield (episode, URL of its batched mark, index file) of all planned episodes, sorted by episode.

    Raises:
        StoreError: A planned episode is in no batched mark.
    """
    marks = ledger.marks()
    for block in ledger.blocks():
        wanted = set(ledger.planned(block))
        found = [_read_mark(ledger, key, spans) for key, spans in marks.get(block, {}).items() if not all(map(wanted.isdisjoint, spans))]
        for episode, source, bundle in heapq.merge(*found, key=lambda each: each[0]):
            if episode in wanted:
                wanted.remove(episode)
                yield episode, source, bundle
        if wanted:
            raise StoreError(f"{ledger.store.url} has no batched mark of episode {min(wanted)}; the same command resumes")


def _read_mark(ledger: Ledger, key: str, spans: Sequence[range]) -> Iterator[tuple[int, str, bytes]]:
    """Lazily yield the items of `_bundles` for the episodes of one batched mark, sorted by episode."""
    source = f"{ledger.store.url}/{key}"
    for episode, bundle in split_bundles(
        ledger.store.blocks(key, BLOCK * MAX_BUNDLE), [episode for span in spans for episode in span], source
    ):
        yield episode, source, bundle
