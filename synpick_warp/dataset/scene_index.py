"""Where the scenes of a data set's episodes are: BOP scene folders in either layout, and webdataset shards."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from synpick_warp.configs.cell.cameras import Size
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.dataset.commit.manifest import CONFIG_FILE
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import path_inside

if TYPE_CHECKING:
    from synpick_warp.dataset.view_files import SceneFiles


class SceneIndex:
    """Scene folders and shards of a data set by episode and camera; `sizes`: width and height of each camera's images [px]."""

    def __init__(self, folder: Path, layout: DataLayout, sizes: tuple[Size, ...]) -> None:
        self._folder, self._sizes, self._layout = folder, sizes, layout

    @cached_property
    def _folders(self) -> dict[str, tuple[Path, Path]]:
        """BOP name of each split -> folders of its scenes and of its webdataset shards, which need not exist."""
        places = {name: path_inside(self._folder, name, self._folder / CONFIG_FILE, DatasetError) for name in self._layout.folders}
        return {name: (place, place.with_name(f"{place.name}_web")) for name, place in places.items()}

    def files(self, episode: int, camera: int) -> SceneFiles:
        """Files of the scene of a camera and episode: a folder, or else shards. Raises DatasetError if the data set has no images of it."""
        from synpick_warp.dataset.view_files import SceneFolder, SceneShards
        from synpick_warp.exporters.bop.shards import find_shards

        folder, web = self._folders[self._layout.folder(episode)]
        index, suffix = self._layout.scene(episode, camera)
        if (folder / f"{index:06d}").is_dir():
            return SceneFolder(folder / f"{index:06d}", self._sizes[camera], suffix)
        scene = self._layout.cameras * episode + camera
        if shards := list(find_shards(scene, web)):
            return SceneShards(shards, scene, self._sizes[camera])
        raise DatasetError(f"{self._folder} has no images of episode {episode}; bake with --formats bop or shards")

    def has(self, episode: int) -> bool:
        """Whether an episode has a scene folder or a shard."""
        folder, web = self._folders[self._layout.folder(episode)]
        scene = folder / f"{self._layout.scene(episode, 0)[0]:06d}"
        return scene.exists() or (web / f"shard-{self._layout.cameras * episode:06d}.tar").exists()

    def episodes(self) -> Iterator[int]:
        """Indices of the episodes that have scenes; an index can occur several times."""
        for folder, web in self._folders.values():
            yield from (self._layout.scene_episode(scene) for scene in numbered(folder.glob("[0-9]*")))
            yield from (scene // self._layout.cameras for scene in numbered(web.glob("shard-??????.tar")))


def numbered(paths: Iterable[Path]) -> Iterator[int]:
    """Indices in file names such as 000012 and shard-000012.tar; other names, such as those of notes, are passed over."""
    for path in paths:
        name = path.stem.removeprefix("shard-")
        if name.isascii() and name.isdecimal() and f"{int(name):06d}" == name:
            yield int(name)
