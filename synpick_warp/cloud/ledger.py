"""Commit log of a data set in a store: which episodes are committed, by their done marks. See README.md."""

import contextlib
import heapq
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.files.load import config_to_toml
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.annotations import Manifest
from synpick_warp.dataset.commit import manifest as manifests
from synpick_warp.errors import ConfigError, OutputError, StoreError
from synpick_warp.system.inputs.files import MAX_JSON, MAX_TOML, decode_json
from synpick_warp.system.stores.store import CONTROL, SMALL, Probe, Store, open_store

BLOCK = 1000
"""Episodes whose done marks are listed at a time, from the first key to the last: within a block all numbers have as many digits."""
INDEX = f"{CONTROL}/index"
FINISHING, FINISHED = f"{CONTROL}/finishing", f"{CONTROL}/finished"
ENTRY = re.compile(rf"{manifests.ENTRIES}/([0-9]{{6}}|[1-9][0-9]{{6,11}})\.json")
"""Keys of done marks."""
_ADVICE = "resume with the same, or name another prefix with --out"


class Ledger:
    """Commit log of a data set in a store: reads and writes its marks, for the episodes that the settings plan."""

    def __init__(self, store: Store, config: Config, probe: Probe) -> None:
        """Validate the prefix of the store against the settings. Raises ConfigError: the prefix was started with other settings;
        OutputError: it holds something else, or lies in another data set."""
        self.store, self.config, self.probe = store, config, probe
        self.layout = DataLayout.of(config)
        self.manifest = self._read_manifest()

    def _read_manifest(self) -> bytes | None:
        """Read the manifest, and compare it with the settings; None: the prefix is empty. Raises as the constructor."""
        url, data = self.store.url, self._stored_manifest()
        if data is None:
            first = next(self.store.list(""), None)
            if first is not None and first[0].startswith(f"{CONTROL}/"):
                first = next(self.store.list("", f"{CONTROL}/~"), None)
            if first is not None:
                data = self._stored_manifest()  # Another worker may have started the data set since the first look.
                if data is None:
                    raise OutputError(f"{url} is not empty: it has {first[0]} and no manifest; name a new prefix, or a data set to resume")
        if data is None:
            self._check_outside()
            return None
        if said := manifests.describe_differences(manifests.make_manifest(self.config), self._decode(data)):
            raise ConfigError(f"{url} was started with other settings: {said}; {_ADVICE}")
        return data

    def _stored_manifest(self) -> bytes | None:
        """Read the manifest; None: there is none."""
        try:
            return self.store.get(manifests.MANIFEST_FILE, MAX_JSON)
        except FileNotFoundError:
            return None

    def _decode(self, manifest: bytes) -> dict[str, Any]:
        """Parse the manifest of the store; raises OutputError if it is damaged."""
        place, advice = f"{self.store.url}/{manifests.MANIFEST_FILE}", "restore it, or name another prefix with --out"
        decode_json(manifest, Manifest, place, OutputError, advice)
        return decode_json(manifest, dict[str, Any], place, OutputError, advice)

    def _check_outside(self) -> None:
        """Check that no outer prefix is a data set, as far as it may be read; raises OutputError."""
        scheme, _, place = self.store.url.partition("://")
        parts = place.split("/")
        for count in range(len(parts) - 1, 0, -1):
            outer = f"{scheme}://{'/'.join(parts[:count])}"
            with contextlib.suppress(StoreError):  # Nobody has to have rights outside of the prefix.
                if open_store(outer).stat(manifests.MANIFEST_FILE) is not None:
                    raise OutputError(f"--out is {self.store.url}, in the data set {outer}; name a prefix outside of it")

    def done(self, block: int) -> set[int]:
        """List the episodes of a block that have a done mark. Empty marks, of an interrupted write, do not count."""
        first, end, found = block * BLOCK, (block + 1) * BLOCK, set()
        stop = f"{manifests.ENTRIES}/{end - 1:06d}.~"
        for key, size in self.store.list(str(manifests.ENTRIES), f"{manifests.ENTRIES}/{first:06d}"):
            if key > stop:
                break
            if size and (match := ENTRY.fullmatch(key)) and first <= int(match[1]) < end:
                found.add(int(match[1]))
        return found

    def remaining(self, ranges: Iterable[Sequence[int]]) -> Iterator[list[int]]:
        """Yield the episodes of these ascending ranges that have no done mark, one sorted list per block, without empty lists."""
        for block, wanted in itertools.groupby(heapq.merge(*ranges), lambda episode: episode // BLOCK):
            if left := sorted(set(wanted) - self.done(block)):
                yield left

    # ---- what is written once ----

    def put_manifest(self, data: bytes) -> None:
        """Create the manifest if absent, and compare it with the one that is there. Without conditional writes, two workers at the same
        time may both pass. Raises ConfigError: another worker has started the data set with other settings, objects or lights."""
        if self.manifest is None:
            if self.probe.conditional:
                self.store.create(manifests.MANIFEST_FILE, data)
            elif self.store.stat(manifests.MANIFEST_FILE) is None:  # Another worker may have started meanwhile.
                self.store.put(manifests.MANIFEST_FILE, data)
            self.manifest = self.store.get(manifests.MANIFEST_FILE, MAX_JSON)
        ours, theirs = self._decode(data), self._decode(self.manifest)
        if said := manifests.describe_differences(ours, theirs) or manifests.describe_inputs(
            ours.get(manifests.INPUTS, {}), theirs.get(manifests.INPUTS, {})
        ):
            raise ConfigError(f"{self.store.url} was started by another worker with other settings, objects or lights: {said}; {_ADVICE}")

    def put_settings(self) -> None:
        """Write the settings of this bake, unless the same are there; those of an earlier bake are replaced."""
        text = config_to_toml(self.config).encode()
        try:
            if self.store.get(manifests.CONFIG_FILE, MAX_TOML) == text:
                return
        except FileNotFoundError:
            pass
        self.store.put(manifests.CONFIG_FILE, text)

    def commit(self, episode: int, checksums: bytes, entry: bytes) -> None:
        """Commit an episode whose files are uploaded: writes its checksum list, then its done mark, the manifest entry."""
        place = manifests.episode_entry(episode)
        self.store.put(f"{place}.sha256", checksums)
        self.store.put(f"{place}.json", entry)

    @property
    def plan(self) -> bytes:
        """Record of the planned episodes, first and last of each range: "000000-000499_000600-000999"."""
        return "_".join(f"{each.start:06d}-{each.stop - 1:06d}" for each in self.layout.plan() if each).encode()

    def finished(self) -> bool:
        """Whether the indices cover all planned episodes. A damaged record covers none."""
        try:
            pairs = [pair.split("-") for pair in self.store.get(FINISHED, SMALL).decode().split("_")]
            covered = [range(int(first), int(last) + 1) for first, last in pairs]
        except (FileNotFoundError, ValueError):
            return False
        return all(any(span.start <= each.start and each.stop <= span.stop for span in covered) for each in self.layout.plan() if each)
