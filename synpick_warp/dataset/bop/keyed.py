"""Folders in which a file name begins with a key that names the view, SCENE_IMAGE, such as 000001_000042.rgb.jpg.

BOP has two: webdataset shards (tar files of such files, with a key_to_shard.json that says which), and the imagewise layout (the files
themselves, all in one folder).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

from synpick_warp.dataset.bop.folders import Listing
from synpick_warp.dataset.bop.layout import KEYED, KEYS, SHARD, SceneRef
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.json import MAX_JSON, decode_json
from synpick_warp.system.inputs.tar_files import list_members

KEY = re.compile(r"([0-9]{6,9})_([0-9]{6,9})")
"""Key of a view: scene, image."""


@dataclass(frozen=True, eq=False)
class KeyedFolder:
    """A folder of shards, or of files in the imagewise layout."""

    listing: Listing

    @property
    def place(self) -> str:
        """Path relative to the data set."""
        return self.listing.place

    @cached_property
    def shards(self) -> list[str]:
        """Names of the tar files."""
        return sorted(filter(SHARD.fullmatch, self.listing.files))

    @cached_property
    def keys(self) -> tuple[dict[str, int] | None, str]:
        """What key_to_shard.json says, the number of the shard by key, or None; and why it is None, or ""."""
        if KEYS not in self.listing.files:
            return None, f"there is no {KEYS}" if self.shards else ""
        try:
            return decode_json(self.listing.read(KEYS, MAX_JSON), dict[str, int], self.listing.name(KEYS), DatasetError), ""
        except DatasetError as error:
            return None, str(error)

    @cached_property
    def members(self) -> dict[str, set[str] | str]:
        """Keys in each shard, or the reason why it cannot be read."""
        found: dict[str, set[str] | str] = {}
        for shard in self.shards:
            try:
                matches = (KEYED.fullmatch(name) for name, _, _ in list_members(self.listing.path(shard), extended=True))
                found[shard] = {f"{match[1]}_{match[2]}" for match in matches if match}
            except DatasetError as error:
                found[shard] = str(error)
        return found

    def scenes(self) -> list[tuple[SceneRef, list[int]]]:
        """Scenes with their images, by index; those in shards that cannot be read are left out."""
        images: dict[int, set[int]] = {}
        shards: dict[int, set[str]] = {}
        for shard, keys in self.members.items():
            for key in keys if isinstance(keys, set) else ():
                scene, image = map(int, key.split("_"))
                images.setdefault(scene, set()).add(image)
                shards.setdefault(scene, set()).add(shard)
        for name in self.listing.files if not self.shards else ():
            if match := KEYED.fullmatch(name):
                images.setdefault(int(match[1]), set()).add(int(match[2]))
        return [
            (SceneRef(self.place, scene, "", "", tuple(sorted(shards.get(scene, ())))), sorted(images[scene])) for scene in sorted(images)
        ]
