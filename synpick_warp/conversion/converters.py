"""Converters: for each format, how an episode of a baked data set becomes this format's files.

A converter commits an episode as its exporter does: staged in `PARTIAL`, renamed when it is complete, so that a conversion can be resumed.
"""

from __future__ import annotations

import functools
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import ClassVar

from synpick_warp.configs.schema import CLASSIC, Config
from synpick_warp.configs.splits import bop_folder
from synpick_warp.conversion.scenes import SceneContent, SceneSource, place_shards, write_coco, write_scene, write_shards, write_video_group
from synpick_warp.conversion.source import Source, SourceEpisode
from synpick_warp.dataset.object_names import object_names
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.bop.coco import annotation_files as coco
from synpick_warp.exporters.bop.coco.exporter import CocoExporter
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.keypoints import Keypoints, make_category_keys, sample_keypoints
from synpick_warp.exporters.bop.scene import SceneSettings, commit_scenes
from synpick_warp.exporters.bop.scene_exporter import CONSTANTS, SceneExporter
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from synpick_warp.exporters.bop.shards.tar_files import find_shards
from synpick_warp.exporters.registry import Exporters
from synpick_warp.exporters.writing.files import PARTIAL, output_error
from synpick_warp.exporters.writing.notes import write_notes
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.scenes.types import Catalog, EnvironmentMap

Done = Callable[[], None]


class Converter(ABC):
    """How episodes become files of one format."""

    def __init__(self, source: Source, out: Path, config: Config, pool: WriterPool) -> None:
        """
        Args:
            source: The data set that is converted.
            out: Folder of the converted data set.
            config: Its settings.
            pool: Processes that write it.

        Raises:
            DatasetError: The source lacks what the format needs.
        """
        self.source, self.out, self.config, self.pool = source, out, config, pool

    def write_constants(self) -> list[Path]:
        """See `Exporter`."""
        return []

    @abstractmethod
    def files(self, episode: int) -> list[Path]:
        """See `Exporter`."""

    @abstractmethod
    def convert(self, episode: SourceEpisode, on_committed: Done) -> None:
        """Submit the tasks that write an episode, and call `on_committed` when all of its files are in place."""

    def write_notes(self, names: Mapping[int, str]) -> list[Path]:
        """Write camera.json and dataset_info.md where the format's exporter does; `names`: obj_id -> name. Returns their paths."""
        from synpick_warp.scenes.cameras import make_cameras

        try:
            return write_notes(self.out, self.config, names, make_cameras(self.config.cameras))
        except OSError as error:
            raise output_error(self.out, error) from error

    def require_images(self) -> None:
        """Check that the source has views."""
        if not self.source.has_images:
            raise DatasetError(f"{self.source.folder} has no images; bake it with --formats bop or shards")

    def stage(self, format_name: str, episode: SourceEpisode) -> Path:
        """Create the staging folder of an episode."""
        folder = self.out / PARTIAL / format_name / f"{episode.end.episode:06d}"
        try:
            folder.parent.mkdir(exist_ok=True)
            folder.mkdir()
        except OSError as error:
            raise output_error(folder, error) from error
        return folder

    def submit_all(self, tasks: Sequence[tuple[Callable[..., None], tuple[object, ...], Path]], then: Done) -> None:
        """Submit tasks (function, arguments, path), and call `then` after the last of them is done."""
        pending = [len(tasks)]

        def count_down() -> None:
            pending[0] -= 1
            if not pending[0]:
                then()

        for function, arguments, path in tasks:
            self.pool.submit(function, (), arguments, path=path, on_done=count_down)


class _SceneConverter(Converter):
    """Base of the converters to BOP scenes."""

    def __init__(self, source: Source, out: Path, config: Config, pool: WriterPool) -> None:
        super().__init__(source, out, config, pool)
        self.require_images()
        bop = config.bop
        self.content = SceneContent(bop.masks, bop.coco, config.render.layers, self.sample_keypoints())

    def sample_keypoints(self) -> dict[int, Keypoints]:
        """Keypoints that the format's annotations have, by obj_id: those of the bake, from the vertices of its objects."""
        return {}

    exporter: ClassVar[type[SceneExporter]]
    """The format's exporter, which names the folders of scenes."""

    def folder(self, episode: int) -> Path:
        """Folder of the scenes of an episode's split."""
        return self.out / self.exporter.folder_name(bop_folder(self.config, episode))

    def write_constants(self) -> list[Path]:
        """See `Exporter`: copies of models, camera and notes."""
        try:
            for folder in self.exporter.folders(self.config):
                (self.out / folder).mkdir(exist_ok=True)
            self.source.copy_constants(CONSTANTS, self.out)
        except OSError as error:
            raise output_error(self.out, error) from error
        return list(CONSTANTS)

    def scene_ids(self, episode: int) -> range:
        """BOP scene_ids of an episode's cameras."""
        cameras = len(self.config.cameras.positions)
        return range(cameras * episode, cameras * (episode + 1))


class ShardsConverter(_SceneConverter):
    """Converter to webdataset shards; images are copied."""

    exporter = ShardsExporter

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`."""
        split = self.folder(episode)
        return sorted(path.relative_to(self.out) for scene in self.scene_ids(episode) for path in find_shards(scene, split))

    def convert(self, episode: SourceEpisode, on_committed: Done) -> None:
        """See base class."""
        folder, split = self.stage("shards", episode), self.folder(episode.end.episode)
        staged: list[tuple[Path, int]] = []
        tasks: list[tuple[Callable[..., None], tuple[object, ...], Path]] = []
        for scene in episode.scenes():
            place = folder / f"{scene.scene:06d}"
            place.mkdir()
            staged.append((place, scene.scene))
            tasks.append((write_shards, (scene, self.content, place), split))
        arguments = (tuple(staged), split, episode.frames)
        self.submit_all(tasks, lambda: self.pool.submit(place_shards, (), arguments, path=split, on_done=on_committed))


def _sample_keypoints(source: Source) -> dict[int, Keypoints]:
    """Keypoints of the objects, by obj_id. Objects are loaded again, since model files are rounded to millimetres in single precision."""
    count = source.config.bop.keypoints
    entries = load_assets(source)[0].entries if count else ()
    return {entry.obj_id: sample_keypoints(entry.mesh.vertices, count) for entry in entries}


def _read_names(source: Source) -> dict[int, str]:
    """Names of the objects (obj_id -> name) from the store; without one from models and settings, where some may have none."""
    data = source.data
    if data.has_store:
        return {item.object_id: item.name for item in data.objects}
    known = object_names(source.folder, source.config, set(data.models_info))
    return {index: known.get(index, f"obj_{index:06d}") for index in data.models_info}


class BopConverter(_SceneConverter):
    """Converter to BOP scene folders; images are copied, masks are decoded from run lengths (RLE)."""

    exporter = BopExporter

    def __init__(self, source: Source, out: Path, config: Config, pool: WriterPool) -> None:
        super().__init__(source, out, config, pool)
        if config.bop.coco and not config.bop.masks:
            raise DatasetError(f"{source.folder} has no masks, which bop.coco needs; bake it with bop.masks = true")
        names = {obj_id: {"id": obj_id, "name": name, "supercategory": "synpick"} for obj_id, name in sorted(_read_names(source).items())}
        points = {obj_id: make_category_keys(keypoints) for obj_id, keypoints in self.content.keypoints.items()}
        self._categories = tuple(category | points.get(obj_id, {}) for obj_id, category in names.items())

    def sample_keypoints(self) -> dict[int, Keypoints]:
        """See base class."""
        return _sample_keypoints(self.source) if self.config.bop.coco else {}

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`."""
        places = (self.folder(episode) / f"{scene:06d}" for scene in self.scene_ids(episode))
        return [place.relative_to(self.out) for place in places if os.path.lexists(place)]

    def convert(self, episode: SourceEpisode, on_committed: Done) -> None:
        """See base class."""
        folder, split = self.stage("bop", episode), self.folder(episode.end.episode)
        width, height = self.config.cameras.resolution
        suffix = f".{self.config.bop.color_format}"
        settings = SceneSettings(split.name, episode.frames, width, height, suffix, self.config.bop.coco, categories=self._categories)
        scenes = episode.scenes()
        moves = tuple((folder / f"{scene.scene:06d}", split / f"{scene.scene:06d}") for scene in scenes)
        tasks = [(write_scene, (scene, self.content, move[0]), move[1]) for scene, move in zip(scenes, moves, strict=True)]
        self.submit_all(tasks, lambda: self.pool.submit(commit_scenes, (), (moves, settings), path=split, on_done=on_committed))


class CocoConverter(_SceneConverter):
    """Converter to COCO; images are copied."""

    exporter = CocoExporter

    def __init__(self, source: Source, out: Path, config: Config, pool: WriterPool) -> None:
        super().__init__(source, out, config, pool)
        if not config.bop.masks:
            raise DatasetError(f"{source.folder} has no masks, which COCO needs; bake it with bop.masks = true")

    def sample_keypoints(self) -> dict[int, Keypoints]:
        """See base class."""
        return _sample_keypoints(self.source)

    def write_constants(self) -> list[Path]:
        """See base class."""
        names = _read_names(self.source)
        coco.write_categories(self.out, names, self.content.keypoints)
        return [coco.CATEGORIES, *self.write_notes(names)]

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`."""
        return coco.scene_files(self.out, self.scene_ids(episode))

    def convert(self, episode: SourceEpisode, on_committed: Done) -> None:
        """See base class."""
        folder = self.stage("coco", episode)
        scenes = episode.scenes()
        staged = tuple((folder / f"{scene.scene:06d}", scene.scene) for scene in scenes)
        tasks = [(write_coco, (scene, self.content, place), place) for scene, (place, _) in zip(scenes, staged, strict=True)]
        arguments = (staged, self.out, episode.frames)
        self.submit_all(tasks, lambda: self.pool.submit(coco.commit_scenes, (), arguments, path=folder, on_done=on_committed))


class UsdConverter(Converter):
    """Converter to USD, from trajectories. Objects and lights are loaded again, and compared with the digests of the source."""

    def __init__(self, source: Source, out: Path, config: Config, pool: WriterPool) -> None:
        super().__init__(source, out, config, pool)
        from synpick_warp.exporters.usd.exporter import UsdExporter
        from synpick_warp.scenes.cameras import make_cameras

        source.data.require_store()
        catalog, lights = load_assets(source)
        self._exporter = UsdExporter(ExportContext(out, config, catalog, make_cameras(config.cameras), lights, pool))

    def write_constants(self) -> list[Path]:
        """See `Exporter`: the asset library."""
        return self._exporter.write_constants()

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`."""
        return self._exporter.files(episode)

    def convert(self, episode: SourceEpisode, on_committed: Done) -> None:
        """See base class."""
        for batch in episode.ticks():
            self._exporter.write_ticks(batch)
        self._exporter.end_episode(episode.end, on_committed)


class LerobotConverter(Converter):
    """Converter to LeRobot, from views and trajectories. Videos of JPEG images differ from a bake's, since the images were compressed
    before."""

    def __init__(self, source: Source, out: Path, config: Config, pool: WriterPool) -> None:
        super().__init__(source, out, config, pool)
        from synpick_warp.exporters.lerobot.exporter import episode_settings

        self.require_images()
        source.data.require_store()
        self._settings = episode_settings(config, out, {item.object_id: item.name for item in source.data.objects})

    def write_constants(self) -> list[Path]:
        """See base class."""
        return self.write_notes(self._settings.objects)

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`."""
        from synpick_warp.exporters.lerobot.exporter import episode_files

        return episode_files(self.out, episode, self._settings.cameras)

    def convert(self, episode: SourceEpisode, on_committed: Done) -> None:
        """See base class."""
        from synpick_warp.exporters.lerobot.episode import commit_episode, group_path
        from synpick_warp.exporters.lerobot.exporter import make_content, make_ticks
        from synpick_warp.exporters.lerobot.layout import part_path
        from synpick_warp.exporters.lerobot.video import GROUP

        folder, rate = self.stage("lerobot", episode), self._settings.rate
        tasks: list[tuple[Callable[..., None], tuple[SceneSource, int, Fraction, Path], Path]] = []
        for camera, scene in enumerate(episode.scenes()):
            for group in range(-(-episode.frames // GROUP)):
                path = group_path(folder, camera, group)
                tasks.append((write_video_group, (scene, group * GROUP, rate, path), path))
        content = make_content(episode.end, b"".join(make_ticks(batch).tobytes() for batch in episode.ticks()))
        place = self.out / part_path(episode.end.episode)
        arguments = (folder, content, self._settings)
        self.submit_all(tasks, lambda: self.pool.submit(commit_episode, (), arguments, path=place, on_done=on_committed))


@functools.lru_cache(maxsize=1)
def load_assets(source: Source) -> tuple[Catalog, tuple[EnvironmentMap, ...]]:
    """Load the objects and lights of a data set again.

    Raises:
        DatasetError: They are not those that it was baked from.
    """
    from synpick_warp.dataset.digests import digest_inputs
    from synpick_warp.scenes.catalog import load_catalog
    from synpick_warp.scenes.lights import load_lights

    catalog, lights = load_catalog(source.config), load_lights(source.config.bake.lights)
    if digest_inputs(catalog, lights) != source.inputs:
        raise DatasetError(f"the objects or lights of {source.folder} have changed since its bake, but are needed; restore them")
    return catalog, lights


CONVERTERS: dict[str, type[Converter]] = {
    "bop": BopConverter,
    "shards": ShardsConverter,
    "usd": UsdConverter,
    "lerobot": LerobotConverter,
    "coco": CocoConverter,
}
"""Format -> converter."""


class Converters(Exporters):
    """Composite of the converters of all target formats, with the methods of `Exporters` that an output folder calls."""

    def __init__(self, source: Source, out: Path, config: Config, pool: WriterPool) -> None:
        """See `Converter`."""
        self._converters = [CONVERTERS[name](source, out, config, pool) for name in dict.fromkeys(config.bake.formats)]

    def write_constants(self) -> list[Path]:
        """See `Exporter`."""
        return list(dict.fromkeys(path for converter in self._converters for path in converter.write_constants()))

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`."""
        return sorted(path for converter in self._converters for path in converter.files(episode))

    def convert(self, episode: SourceEpisode, on_committed: Done) -> None:
        """Convert an episode to every format; `on_committed` is called when the last one is committed."""
        pending = [len(self._converters)]

        def count_down() -> None:
            pending[0] -= 1
            if not pending[0]:
                on_committed()

        for converter in self._converters:
            converter.convert(episode, count_down)


def check_trajectories(names: Sequence[str], source: Source) -> None:
    """Check that the source has the trajectories that formats are made of.

    Raises:
        DatasetError: There are none, or an attribute or array is missing or damaged.
    """
    if {"usd", "lerobot"} & set(names):
        source.check_trajectories(gripper="lerobot" in names)


def check_formats(names: Sequence[str], config: Config, folder: Path) -> None:
    """Check that a data set can be converted to these formats.

    Args:
        names: Names of formats.
        config: Settings of the data set.
        folder: Its folder.

    Raises:
        ConfigError: A format is unknown, cannot be converted to, or is there already; or the settings are those of a bake only.
    """
    if config.bop.layout != CLASSIC:
        raise ConfigError(f'{folder} has bop.layout = "{config.bop.layout}", which convert does not read; bake the other formats')
    for name in names:
        if name not in CONVERTERS:
            why = "; no other format has the physics of zarr" if name == "zarr" else ""
            raise ConfigError(f"--to names {name}; allowed: {', '.join(CONVERTERS)}{why}")
        if name in config.bake.formats:
            raise ConfigError(f"--to names {name}, which {folder} has already; copy the folder")
