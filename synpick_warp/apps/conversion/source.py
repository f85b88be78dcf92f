"""Source of a conversion: a baked data set with its manifest, episodes, scenes and trajectories, and the context of its exporters."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

from synpick_warp.apps.conversion.scenes import StoredSceneFiles
from synpick_warp.apps.conversion.trajectories import check_trajectory, read_ticks
from synpick_warp.codes import Ending
from synpick_warp.configs.dataset.export import ExportSettings
from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.annotations import ADVICE, check_content
from synpick_warp.dataset.bop.models import names_of
from synpick_warp.dataset.commit.manifest import (
    CONSTANTS,
    INPUTS,
    committed_episodes,
    describe_inputs,
    episode_entry,
    read_checksums,
    read_entry,
    read_manifest,
    read_settings,
)
from synpick_warp.dataset.commit.plausibility import check_file_names, check_frames
from synpick_warp.dataset.reading import DataSet
from synpick_warp.dataset.trajectory import GROUP_FILE, StoreAttributes
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.formats import Content
from synpick_warp.exporters.trajectory.arrays import STORE
from synpick_warp.exporters.writing.checksums import open_regular
from synpick_warp.exporters.writing.files import remove_folder
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import Catalog, EnvironmentMap
from synpick_warp.views.frames import EpisodeEnd, TickBatch
from synpick_warp.views.picks import PickBatch

_COPY_BYTES = 1 << 20
"""Size of a copy block [B]."""


class ConversionSource:
    """A baked data set that is converted. Reads its manifest and settings, and checks them."""

    def __init__(self, folder: Path) -> None:
        """
        Args:
            folder: Folder of the data set.

        Raises:
            DatasetError: It is not a data set, or has no episode.
        """
        self.folder = folder
        self._manifest = read_manifest(folder)
        self.config: Config = read_settings(folder, self._manifest)
        self.data = DataSet(folder)
        self.episodes = committed_episodes(folder)
        if not self.episodes:
            raise DatasetError(f"{folder} has no committed episode; finish its bake")

    @property
    def inputs(self) -> dict[str, str]:
        """Content digests of objects and lights, as the manifest records them."""
        return self._manifest.get(INPUTS, {})

    def check_contents(self, needed: Collection[Content]) -> None:
        """Check that it has what formats are made of: all attributes and arrays of the trajectories, but of images only that there are any.

        Raises:
            DatasetError: It lacks something, or that is damaged.
        """
        if "poses" in needed:
            self.check_trajectories(gripper="gripper" in needed)
        if "views" in needed and not {"bop", "shards"} & set(self.config.bake.formats):
            raise DatasetError(f"{self.folder} has no images; bake it with --formats bop or shards")
        if "masks" in needed and not self.config.bop.masks:
            raise DatasetError(f"{self.folder} has no masks, which COCO annotations need; bake it with bop.masks = true")

    def check_trajectories(self, *, gripper: bool) -> None:
        """Check that the trajectories of all episodes have what a format needs; `gripper`: states and commands of the gripper, too.

        Raises:
            DatasetError: There are none, or an attribute or array is missing or damaged.
        """
        self.data.require_store()
        place = self.data.folder / STORE / GROUP_FILE
        store = check_content(self.data.attributes, StoreAttributes, place)
        steps = self.config.physics.steps_per_tick
        if store.steps_per_tick != steps:
            there = f"steps_per_tick is {store.steps_per_tick}, the settings have {steps}"
            raise DatasetError(f"{place} is damaged: {there}; {ADVICE}")
        for end in map(self.episode_end, self.episodes):
            if Ending(end.ending).delivers:
                check_trajectory(self.data[end.episode], end, len(store.lights), gripper=gripper)

    def scenes(self, end: EpisodeEnd) -> list[StoredSceneFiles]:
        """Files of the scene of each camera in an episode, in the order of cameras."""
        data, count = self.data, self.data.camera_count
        images = [end.images[:: self.config.rig.every[one]] for one in range(count)]
        return [StoredSceneFiles(data.scene_files(end.episode, one), count * end.episode + one, images[one]) for one in range(count)]

    def ticks(self, end: EpisodeEnd) -> Iterator[TickBatch]:
        """Yield the ticks of an episode's stored trajectory. See `trajectories.read_ticks`."""
        return read_ticks(self.data[end.episode], self.config.physics.steps_per_tick, self.config.cell.recorded)

    def picks(self, index: int) -> PickBatch | None:
        """Grasp trials of an episode; None: the data set has none. Raises DatasetError if a table is damaged."""
        if "picks" not in self.config.bake.formats:
            return None
        trials, states = self.data[index].picks, self.data[index].pick_states
        return PickBatch(index, *({name: table[name] for name in table.dtype.names or ()} for table in (trials, states)))

    def episode_end(self, index: int) -> EpisodeEnd:
        """How a committed episode ended.

        Raises:
            DatasetError: Its manifest entry is missing or damaged.
        """
        entry = read_entry(self.folder, episode_entry(index))
        if entry is None:
            raise DatasetError(f"{self.folder / episode_entry(index)}.json is missing; resume the bake")
        row: dict[str, Any] = entry["row"]
        check_frames(self.folder, DataLayout.of(self.config), index, row["frames"])
        lines = tuple(json.dumps(attempt) + "\n" for attempt in entry["attempts"])
        return EpisodeEnd(index, row["arrangement"], row["frames"], int(Ending[row["ending"].upper()]), row, lines)

    def copy_constants(self, names: tuple[Path, ...], out: Path) -> None:
        """Copy files that all episodes share, and those in folders of these names, to another data set; replaces what is there.

        Raises:
            DatasetError: A file is missing or no regular file, or the source has none of a name.
            OSError: A file cannot be written.
        """
        known = read_checksums(self.folder, CONSTANTS)
        check_file_names(self.folder, CONSTANTS, known, DataLayout.of(self.config))
        listed = [Path(name) for name in known]
        for name in names:
            files = [path for path in listed if path == name or name in path.parents]
            if not files:
                raise DatasetError(f"{self.folder} has no {name}; bake it with --formats bop or shards")
            remove_folder(out / name)
            for path in files:
                (out / path).parent.mkdir(exist_ok=True)
                self._copy(path, out / path)

    def _copy(self, path: Path, target: Path) -> None:
        """Copy a regular file of the data set to `target`; raises DatasetError if it cannot be read."""
        try:
            handle = open_regular(self.folder / path)
        except OSError as error:
            raise DatasetError(f"{self.folder / path} cannot be read: {error.strerror}; run `synpick-warp verify`") from None
        with os.fdopen(handle, "rb") as source, target.open("wb") as file:
            shutil.copyfileobj(source, file, _COPY_BYTES)


class StoredContext(ExportContext):
    """Context of the exporters that write a converted data set."""

    def __init__(self, source: ConversionSource, out: Path, settings: ExportSettings, pool: WriterPool) -> None:
        """
        Args:
            source: The data set that is converted.
            out: See `ExportContext`.
            settings: Settings of the converted data set.
            pool: See `ExportContext`.
        """
        from synpick_warp.scenes.cameras import make_cameras

        super().__init__(out, settings, Catalog(()), make_cameras(settings.rig), (), pool)
        self._source = source

    @cached_property
    def _assets(self) -> tuple[Catalog, tuple[EnvironmentMap, ...], Looks | None]:
        """Objects, lights and textures of the source, loaded again: its models are rounded to millimetres in single precision.

        Raises:
            DatasetError: They are not those that it was baked from.
        """
        from synpick_warp.dataset.commit.writing import digest_inputs
        from synpick_warp.scenes.catalog import load_catalog
        from synpick_warp.scenes.looks import load_looks
        from synpick_warp.stages.render.lamp_variants import load_scene_lights

        source, config = self._source, self._source.config
        catalog = load_catalog(config)
        lights = load_scene_lights(config.bake.lights, config.randomize, config.bake.seed, lambda line: None)
        looks = load_looks(config.randomize, lambda line: None)
        if said := describe_inputs(digest_inputs(catalog, lights, looks), source.inputs):
            raise DatasetError(f"{said} of {source.folder} have changed since its bake, but are needed; restore them")
        return catalog, lights, looks

    @property
    def catalog(self) -> Catalog:
        """Objects of the data set, loaded on first use."""
        return self._assets[0]

    @property
    def lights(self) -> tuple[EnvironmentMap, ...]:
        """Environment maps of the data set, loaded on first use."""
        return self._assets[1]

    @property
    def looks(self) -> Looks | None:
        """What episodes draw their looks from, loaded on first use."""
        return self._assets[2]

    @property
    def names(self) -> dict[int, str]:
        """Names by obj_id, sorted: from the zarr store; without one from models and settings, else "obj_NNNNNN"."""
        found = names_of(self._source.data)
        return dict(sorted(found.items()))

    def copy_constants(self, names: tuple[Path, ...]) -> bool:
        """Copy these files and folders from the source to the output folder; returns True."""
        self._source.copy_constants(names, self.out)
        return True
