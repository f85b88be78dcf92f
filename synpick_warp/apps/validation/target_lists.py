"""Target lists of a data set, as subjects of rules, and their records by scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

from synpick_warp.dataset.annotations import TargetEntry
from synpick_warp.dataset.bop.layout import TARGETS, Layout, is_index
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.json import MAX_JSON, decode_json


@dataclass(frozen=True)
class TargetList:
    """Target list: its records of single images, by scene and image, and what is wrong with the file."""

    scenes: dict[int, dict[int, list[TargetEntry]]] = field(default_factory=dict)
    """Records by scene and image. Those of several images (multi-view lists) are dropped; their scene stays, with what else it has."""
    fault: str = ""
    """What is wrong with the file; empty: nothing."""


@dataclass(frozen=True, eq=False)
class TargetLists:
    """Subject of rules about all target lists of a data set."""

    layout: Layout
    place: str = "."

    @cached_property
    def lists(self) -> dict[str, TargetList]:
        """Target lists by file name. Cached."""
        return {name: self._read(name) for name in sorted(filter(TARGETS.fullmatch, self.layout.listing.files))}

    def _read(self, name: str) -> TargetList:
        """Read a target list; one that does not fit the schema has a fault instead of records."""
        try:
            records = decode_json(self.layout.listing.read(name, MAX_JSON), list[TargetEntry], name, DatasetError)
        except DatasetError as error:
            return TargetList(fault=str(error))
        scenes: dict[int, dict[int, list[TargetEntry]]] = {}
        for record in records:
            images = scenes.setdefault(record.scene_id, {})
            if isinstance(record.im_id, int):
                images.setdefault(record.im_id, []).append(record)
        return TargetList(scenes)

    def splits(self, name: str) -> list[str]:
        """Splits that a target list refers to: `PREFIX` and `PREFIX_*` of a file `PREFIX_targets*`, else `val` and `val_*`, else all.

        Splits with scene folders come first: others count only if no split has any.
        """
        prefix = name.split("_targets")[0]
        with_scenes = [split for split, listing in self.layout.splits.items() if any(map(is_index, listing.folders))]
        names = with_scenes or list(self.layout.splits) or list(self.layout.keyed)
        for start in (prefix, "val"):
            found = [split for split in names if split == start or split.startswith(f"{start}_")]
            if found:
                return found
        return names

    def scene_ids(self, name: str) -> set[int]:
        """Indices of the scenes in the splits that a list is about; without scene folders (shards, imagewise), those that it names."""
        splits = self.splits(name)
        if not self.layout.splits:
            return set(self.lists[name].scenes)
        return {int(folder) for split in splits for folder in self.layout.splits[split].folders if folder.isdecimal()}

    def of_scene(self, split: str, scene: int) -> dict[str, dict[int, list[TargetEntry]]]:
        """Records about a scene: by list and image."""
        return {name: found.scenes[scene] for name, found in self.lists.items() if scene in found.scenes and split in self.splits(name)}
