"""Ledger of a data set in a store: which episodes are committed, by done marks and batched marks. See README.md."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
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
"""Episodes of a batched mark: as many as a page of a listing has keys."""
DONE, INDEX, FINISHED = f"{CONTROL}/done", f"{CONTROL}/index", f"{CONTROL}/finished"
_MARK = re.compile(rf"{re.escape(DONE)}/([0-9]{{6,9}})-([0-9]{{1,4}})")
_ENTRY = re.compile(rf"{ENTRIES}/([0-9]{{6,12}})\.json")
_ADVICE = "resume with the same, or name another prefix with --out"


class Ledger:
    """Marks of a data set in a store, by the episodes that its settings plan."""

    def __init__(self, store: Store, config: Config, probe: Probe) -> None:
        """Compare the prefix with the settings.

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
        """Manifest in the store, compared with the settings; None: there is none, and nothing else."""
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
        except msgspec.DecodeError:
            raise OutputError(f"{url}/{MANIFEST_FILE} is damaged; restore it, or name another prefix with --out") from None
        said = describe_differences(make_manifest(self.config), {name: known[name] for name in known if name != INPUTS})
        if said:
            raise ConfigError(f"{url} was started with other settings: {said}; {_ADVICE}")
        return data

    def _check_outside(self) -> None:
        """Raise OutputError if the prefix lies in another data set."""
        scheme, _, place = self.store.url.partition("://")
        parts = place.split("/")
        for count in range(len(parts) - 1, 1 if place.startswith("/") else 0, -1):
            outer = f"{scheme}://{'/'.join(parts[:count])}"
            with contextlib.suppress(StoreError):  # Nobody has to have rights outside of the prefix.
                if scheme != "memory" and open_store(outer).stat(MANIFEST_FILE) is not None:
                    raise OutputError(f"--out is {self.store.url}, in the data set {outer}; name a prefix outside of it")

    # ---- blocks ----

    def planned(self, block: int, ranges: Sequence[range] | None = None) -> list[int]:
        """Planned episodes of a block, sorted; `ranges`: of these only."""
        found: set[int] = set()
        for each in self.layout.plan() if ranges is None else ranges:
            first = max(0, -(-(block * BLOCK - each.start) // each.step))
            end = max(first, -(-((block + 1) * BLOCK - each.start) // each.step))
            found.update(each[first:end])
        return sorted(found)

    def blocks(self) -> Iterator[int]:
        """Blocks that have planned episodes, in order."""
        last = -1
        for each in self.layout.plan():
            for block in range(each.start // BLOCK, (each.stop - 1) // BLOCK + 1) if each else ():
                if block > last:
                    last = block
                    yield block

    def open_blocks(self) -> Iterator[int]:
        """Blocks without batched mark, in order."""
        marks = self.marks()
        return (block for block in self.blocks() if marks.get(block) != len(self.planned(block)))

    def marks(self) -> Mapping[int, int]:
        """Batched marks: block -> most episodes that a mark of it has."""
        found: dict[int, int] = {}
        for key, _ in self.store.list(DONE):
            if match := _MARK.fullmatch(key):
                block, count = int(match[1]), int(match[2])
                found[block] = max(count, found.get(block, 0))
        return found

    def mark_key(self, block: int) -> str:
        """Key of a block's batched mark."""
        return f"{DONE}/{block:06d}-{len(self.planned(block))}"

    def done(self, block: int) -> set[int]:
        """Episodes of a block that have a done mark."""
        first, end, found = block * BLOCK, (block + 1) * BLOCK, set()
        stop = f"{ENTRIES}/{end - 1:06d}.~"
        for key, _ in self.store.list(str(ENTRIES), f"{ENTRIES}/{first:06d}"):
            if key > stop:
                break
            if (match := _ENTRY.fullmatch(key)) and first <= int(match[1]) < end:
                found.add(int(match[1]))
        return found

    def remaining(self, ranges: Sequence[range]) -> Iterator[list[int]]:
        """Episodes of these ranges without done mark, block by block; blocks that have none are left out."""
        for block in self.open_blocks():
            wanted = self.planned(block, ranges)
            if wanted and (left := sorted(set(wanted) - self.done(block))):
                yield left

    # ---- what is written once ----

    def put_manifest(self, data: bytes) -> None:
        """Write the manifest, or compare it with the one that is there.

        Raises:
            ConfigError: Another worker has started the data set with other settings, objects or lights.
        """
        if self.manifest is None:
            if not self.probe.conditional:
                self.store.put(MANIFEST_FILE, data)
            else:
                self.store.create(MANIFEST_FILE, data)
            self.manifest = self.store.get(MANIFEST_FILE)
        if self.manifest != data:
            raise ConfigError(f"{self.store.url} was started with other settings, objects or lights by another worker; {_ADVICE}")

    def put_settings(self) -> None:
        """Write the settings of this bake, if they are not there."""
        text = config_to_toml(self.config).encode()
        try:
            if self.store.get(CONFIG_FILE) == text:
                return
        except FileNotFoundError:
            pass
        self.store.put(CONFIG_FILE, text)

    def commit(self, episode: int, checksums: bytes, entry: bytes) -> None:
        """Write an episode's done mark, after its checksum list."""
        place = episode_entry(episode)
        self.store.put(f"{place}.sha256", checksums)
        self.store.put(f"{place}.json", entry)

    def finished(self) -> int:
        """Number of episodes that the indices cover; 0: there are none."""
        try:
            text = self.store.get(FINISHED)
        except FileNotFoundError:
            return 0
        return int(text) if text.isdigit() and len(text) <= 12 else 0
