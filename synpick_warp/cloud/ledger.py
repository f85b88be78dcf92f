"""Commit log of a data set in a store: which episodes are committed, by done marks and batched marks. See README.md."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import msgspec

from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit.manifest import (
    CONFIG_FILE,
    ENTRIES,
    INPUTS,
    MANIFEST_FILE,
    describe_differences,
    episode_entry,
    make_manifest,
)
from synpick_warp.errors import ConfigError, OutputError, StoreError
from synpick_warp.system.stores.base import Store
from synpick_warp.system.stores.opening import CONTROL, Probe, open_store

BLOCK = 1000
"""Indices that a block, and so a batched mark, spans: as many as a page of a listing has keys."""
DONE, INDEX, FINISHED = f"{CONTROL}/done", f"{CONTROL}/index", f"{CONTROL}/finished"
_MARK = re.compile(rf"{re.escape(DONE)}/([0-9]{{6,9}})-([0-9]{{1,4}})")
_ENTRY = re.compile(rf"{ENTRIES}/([0-9]{{6,12}})\.json")
_ADVICE = "resume with the same, or name another prefix with --out"


class Ledger:
    """Commit log of a data set in a store: reads and writes its marks, for the episodes that the settings plan."""

    def __init__(self, store: Store, config: Config, probe: Probe) -> None:
        """Validate the prefix against the settings.

        Args:
            store: Opened at the prefix.
            config: All settings.
            probe: What the store can do.

        Raises:
            ConfigError: The prefix was started with other settings.
            OutputError: It holds something else, or lies in another data set.
        """
        self.store, self.config, self.probe = store, config, probe
        self.layout = DataLayout.of(config)
        self.manifest = self._read_manifest()

    def _read_manifest(self) -> bytes | None:
        """Read the manifest, and compare it with the settings; None: the prefix is empty. Raises as the constructor."""
        url = self.store.url
        try:
            data = self.store.get(MANIFEST_FILE)
        except FileNotFoundError:
            first = next(self.store.list("", f"{CONTROL}/~"), None)
            if first is not None:
                raise OutputError(
                    f"{url} is not empty: it has {first[0]} and no manifest; name a new prefix, or a data set to resume"
                ) from None
            self._check_outside()
            return None
        try:
            known: dict[str, Any] = msgspec.json.decode(data, type=dict[str, Any])
        except (ValueError, RecursionError):  # msgspec's errors are ValueErrors.
            raise OutputError(f"{url}/{MANIFEST_FILE} is damaged; restore it, or name another prefix with --out") from None
        said = describe_differences(make_manifest(self.config), {name: known[name] for name in known if name != INPUTS})
        if said:
            raise ConfigError(f"{url} was started with other settings: {said}; {_ADVICE}")
        return data

    def _check_outside(self) -> None:
        """Check that no outer prefix is a data set, as far as it may be read; raises OutputError."""
        scheme, _, place = self.store.url.partition("://")
        parts = place.split("/")
        for count in range(len(parts) - 1, 1 if place.startswith("/") else 0, -1):
            outer = f"{scheme}://{'/'.join(parts[:count])}"
            with contextlib.suppress(StoreError):  # Nobody has to have rights outside of the prefix.
                if scheme != "memory" and open_store(outer).stat(MANIFEST_FILE) is not None:
                    raise OutputError(f"--out is {self.store.url}, in the data set {outer}; name a prefix outside of it")

    # ---- blocks ----

    def planned(self, block: int, ranges: Sequence[range] | None = None) -> list[int]:
        """Planned episodes of a block, sorted; of `ranges` only, if given."""
        found: set[int] = set()
        for each in self.layout.plan() if ranges is None else ranges:
            first = max(0, -(-(block * BLOCK - each.start) // each.step))
            end = max(first, -(-((block + 1) * BLOCK - each.start) // each.step))
            found.update(each[first:end])
        return sorted(found)

    def blocks(self) -> Iterator[int]:
        """Yield the blocks that have planned episodes, ascending."""
        last = -1
        for each in self.layout.plan():
            for block in range(each.start // BLOCK, (each.stop - 1) // BLOCK + 1) if each else ():
                if block > last:
                    last = block
                    yield block

    def open_blocks(self) -> Iterator[int]:
        """Yield the blocks that have no batched mark of as many episodes as are planned, ascending."""
        marks = self.marks()
        return (block for block in self.blocks() if marks.get(block) != len(self.planned(block)))

    def marks(self) -> Mapping[int, int]:
        """List the batched marks: block -> most episodes of its marks. Empty ones, of an interrupted write, do not count."""
        found: dict[int, int] = {}
        for key, size in self.store.list(DONE):
            if size and (match := _MARK.fullmatch(key)):
                block, count = int(match[1]), int(match[2])
                found[block] = max(count, found.get(block, 0))
        return found

    def mark_key(self, block: int) -> str:
        """Key of a block's batched mark, with the number of its planned episodes."""
        return f"{DONE}/{block:06d}-{len(self.planned(block))}"

    def done(self, block: int) -> set[int]:
        """List the episodes of a block that have a done mark. Empty marks, of an interrupted write, do not count."""
        first, end, found = block * BLOCK, (block + 1) * BLOCK, set()
        stop = f"{ENTRIES}/{end - 1:06d}.~"
        for key, size in self.store.list(str(ENTRIES), f"{ENTRIES}/{first:06d}"):
            if key > stop:
                break
            if size and (match := _ENTRY.fullmatch(key)) and first <= int(match[1]) < end:
                found.add(int(match[1]))
        return found

    def blocks_of(self, episodes: Iterable[int]) -> list[int]:
        """Blocks that contain these episodes, sorted."""
        return sorted({episode // BLOCK for episode in episodes})

    def remaining(self, ranges: Sequence[range]) -> Iterator[list[int]]:
        """Yield the episodes of these ranges that have no done mark, one sorted list per block, without empty lists."""
        for block in self.open_blocks():
            wanted = self.planned(block, ranges)
            if wanted and (left := sorted(set(wanted) - self.done(block))):
                yield left

    # ---- what is written once ----

    def put_manifest(self, data: bytes) -> None:
        """Create the manifest if absent, and compare it with the one that is there. Without conditional writes, two workers that create it
        within the same second may both pass.

        Raises:
            ConfigError: Another worker has started the data set with other settings, objects or lights.
        """
        if self.manifest is None:
            if self.probe.conditional:
                self.store.create(MANIFEST_FILE, data)
            elif self.store.stat(MANIFEST_FILE) is None:  # Another worker may have started meanwhile.
                self.store.put(MANIFEST_FILE, data)
            self.manifest = self.store.get(MANIFEST_FILE)
        if self.manifest != data:
            raise ConfigError(f"{self.store.url} was started with other settings, objects or lights by another worker; {_ADVICE}")

    def put_settings(self) -> None:
        """Write the settings of this bake, unless the same are there; those of an earlier bake are replaced."""
        text = config_to_toml(self.config).encode()
        try:
            if self.store.get(CONFIG_FILE) == text:
                return
        except FileNotFoundError:
            pass
        self.store.put(CONFIG_FILE, text)

    def commit(self, episode: int, checksums: bytes, entry: bytes) -> None:
        """Commit an episode whose files are uploaded: writes its checksum list, then its done mark, the manifest entry."""
        place = episode_entry(episode)
        self.store.put(f"{place}.sha256", checksums)
        self.store.put(f"{place}.json", entry)

    def finished(self) -> int:
        """Number of episodes that the indices cover; 0: there are no indices."""
        try:
            text = self.store.get(FINISHED)
        except FileNotFoundError:
            return 0
        return int(text) if text.isdigit() and len(text) <= 12 else 0
