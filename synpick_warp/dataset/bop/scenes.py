"""Scenes of BOP data sets from other sources: there is no config.toml, so splits, scenes and sensors are found from folder and file names.

They are read leniently: annotations, images and instance ids may be missing, and only what is asked for must be there.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

from synpick_warp.dataset.bop.images import FolderImages, KeyedImages
from synpick_warp.dataset.bop.keyed import KeyedFolder
from synpick_warp.dataset.bop.layout import Layout, NoLayoutError, SceneRef
from synpick_warp.dataset.view_files import SceneFiles, SceneFolder, SceneShards
from synpick_warp.errors import DatasetError

_SCENE_OFFSET = 10**6
"""Added to the episodes of each further split, where splits have scenes of the same index, so that every episode has its own."""


class FoundScenes:
    """Scenes of a BOP folder by episode and camera: an episode is a scene, a camera one of its sensors.

    Episodes have the indices of their scenes. Where two splits have scenes of the same index, those of each later split, by name, have a
    million more, whichever splits are shown.
    """

    def __init__(self, folder: Path, split: str | None = None) -> None:
        """
        Args:
            folder: The data set.
            split: Only this split; None: all.

        Raises:
            DatasetError: There are no scenes.
        """
        self._folder, self._split = folder, split
        self.layout = Layout(folder)
        if not self.layout.keyed and not self.layout.scenes():
            raise NoLayoutError(f"{folder} is not a BOP data set: its splits ({', '.join(self.layout.splits)}) have no scenes")

    @cached_property
    def _scenes(self) -> dict[int, dict[str, SceneRef]]:
        """Scenes of the chosen split, or all, by episode (scene_id, plus an offset for each split if some clash) and sensor suffix."""
        by_split: dict[str, list[SceneRef]] = {}
        for ref in self.refs():
            by_split.setdefault(ref.split, []).append(ref)
        indices = [ref.scene for refs in by_split.values() for ref in {ref.scene: ref for ref in refs}.values()]
        step = _SCENE_OFFSET if len(set(indices)) < len(indices) else 0
        found: dict[int, dict[str, SceneRef]] = {}
        for number, name in enumerate(sorted(by_split)):
            for ref in by_split[name] if self._split in (None, name) else ():
                found.setdefault(ref.scene + number * step, {})[ref.sensor] = ref
        return dict(sorted(found.items()))

    def refs(self) -> list[SceneRef]:
        """All scenes of all sensors; where a split has both scene folders and shards, which show the same views, those of the folders."""
        folders = self.layout.scenes()
        splits = {ref.split for ref in folders}
        return [*folders, *(ref for ref in self._keyed() if ref.split.removesuffix("_web") not in splits)]

    def _keyed(self) -> Iterator[SceneRef]:
        """Yield the scenes of shards and of the imagewise layout; raises DatasetError if a shard cannot be read."""
        for folder in map(KeyedFolder, self.layout.keyed.values()):
            if fault := next((keys for keys in folder.members.values() if isinstance(keys, str)), None):
                raise DatasetError(fault)
            yield from (ref for ref, _ in folder.scenes())

    @cached_property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors; empty: the classic layout, of one camera a scene."""
        names = {suffix[1:] for refs in self._scenes.values() for suffix in refs if suffix}
        return tuple(sorted(names))

    @property
    def cameras(self) -> int:
        """Number of cameras of an episode."""
        return max(1, len(self.sensors))

    @cached_property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits that have scenes."""
        return tuple(sorted({ref.split for refs in self._scenes.values() for ref in refs.values()}))

    def scene(self, episode: int) -> int:
        """BOP scene_id of an episode."""
        return next(iter(self._scenes[episode].values())).scene

    def split(self, episode: int) -> str:
        """Name of the split of an episode."""
        return next(iter(self._scenes[episode].values())).split

    def cameras_of(self, episode: int) -> list[int]:
        """Indices of the cameras that have recorded an episode."""
        names = self._scenes[episode]
        return [0] if "" in names else [camera for camera, sensor in enumerate(self.sensors) if f"_{sensor}" in names]

    def has(self, episode: int) -> bool:
        """Whether there is such an episode."""
        return episode in self._scenes

    def episodes(self) -> Iterator[int]:
        """Indices of the episodes, in order."""
        yield from self._scenes

    def files(self, episode: int, camera: int) -> SceneFiles:
        """Files of the scene that a camera recorded.

        Raises:
            DatasetError: The scene has no such sensor.
        """
        refs = self._scenes[episode]
        suffix = f"_{self.sensors[camera]}" if self.sensors else ""
        # Scenes of one camera stand beside scenes of several sensors in no data set that is known; if they do, they are the first camera's.
        ref = refs.get(suffix) or (refs.get("") if camera == 0 else None)
        if ref is None:
            raise DatasetError(f"{self._folder / next(iter(refs.values())).place} has no sensor {suffix[1:]}")
        return self.open(ref)

    def open(self, ref: SceneRef) -> SceneFiles:
        """Open the files of a scene: of a folder, or of shards or key names."""
        if ref.name:
            listing = self.layout.splits[ref.split].enter(ref.name)
            return SceneFolder(listing.path(""), None, ref.sensor, FolderImages(listing, ref.sensor))
        keyed = self.layout.keyed[ref.split]
        return SceneShards([keyed.path(name) for name in ref.shards or ("",)], ref.scene, None, KeyedImages(keyed, ref))
