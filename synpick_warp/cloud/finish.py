"""Finalization of a data set in a store: the indices over all episodes, made in a local folder from the episodes' index files."""

import heapq
from pathlib import Path

from synpick_warp.cloud.bundles import MAX_BUNDLE, unpack_bundle
from synpick_warp.cloud.delivery import FILES_AT_ONCE, send_file
from synpick_warp.cloud.ledger import FINISHED, FINISHING, INDEX, Ledger
from synpick_warp.configs.dataset import ExportSettings
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.dataset.commit.manifest import CONFIG_FILE, CONSTANTS, ENTRIES, INDICES, MANIFEST_FILE, read_checksums
from synpick_warp.dataset.commit.writing import finalize_data_set
from synpick_warp.errors import OutputError, StoreError
from synpick_warp.exporters.formats import indexed_files
from synpick_warp.exporters.registry import Needs, shared_files
from synpick_warp.exporters.writing.checksums import parse_checksums
from synpick_warp.exporters.writing.files import LINES
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.factory.sizes import count_writers
from synpick_warp.system import clock
from synpick_warp.system.inputs.files import MAX_JSON, make_folder
from synpick_warp.system.stores.store import SMALL

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
