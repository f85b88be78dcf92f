"""Source of a conversion: a baked data set with its manifest, episodes, scenes and trajectories."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.codes import Ending
from synpick_warp.configs.schema import Config
from synpick_warp.conversion.scenes import SceneSource
from synpick_warp.dataset.file_names import check_file_names
from synpick_warp.dataset.frame_counts import check_frames
from synpick_warp.dataset.manifest import (
    CONSTANTS,
    INPUTS,
    committed_episodes,
    episode_entry,
    read_checksums,
    read_entry,
    read_manifest,
    read_settings,
)
from synpick_warp.dataset.reading import DataSet, Episode
from synpick_warp.dataset.trajectory import read_array
from synpick_warp.dataset.view_files import SceneFolder, SceneShards
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.writing.checksums import open_regular
from synpick_warp.exporters.writing.files import remove_folder
from synpick_warp.frames import EpisodeEnd, TickBatch

_COPY_BYTES = 1 << 20
"""Size of a copy block [B]."""


@dataclass(frozen=True, eq=False)
class SourceEpisode:
    """A committed episode of the source."""

    source: Source
    end: EpisodeEnd

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.end.frames

    @property
    def data(self) -> Episode:
        """The episode as `synpick_warp.open` gives it."""
        return self.source.data[self.end.episode]

    def scenes(self) -> list[SceneSource]:
        """The scene of each camera."""
        found, data, size = [], self.source.data, self.source.config.cameras.resolution
        for camera in range(data.camera_count):
            scene = data.camera_count * self.end.episode + camera
            files = data.scene_files(self.end.episode, camera)
            folder = files.folder if isinstance(files, SceneFolder) else None
            shards = files.shards if isinstance(files, SceneShards) else ()
            found.append(SceneSource(folder, shards, scene, size, self.frames))
        return found

    def ticks(self) -> Iterator[TickBatch]:
        """The frames as they came from the simulation, with gripper state and setpoints; poses of absent instances are NaN."""
        data = self.data
        arrays = {name: read_array(data.ticks[name]) for name in ("time", "object_id", "pose", "fixture_pose", "fixture_visible")}
        state = {name: read_array(data.ticks[name]) for name in ("task", "attached") if name in data.ticks}
        steps = self.source.steps_per_tick
        setpoint = read_array(data.steps["setpoint"]).reshape(self.frames, steps, 3) if "setpoint" in data.steps else None
        light = data.attributes["light"]
        columns = {"light": light["map"], "light_yaw": light["yaw"], "light_exposure": light["exposure"]}
        kinds = {"light": np.int32, "light_yaw": np.float32, "light_exposure": np.float32}
        for frame in range(self.frames):
            row = slice(frame, frame + 1)
            yield TickBatch(
                episode=np.array([self.end.episode], np.int32),
                frame=np.array([frame], np.int32),
                **{name: values[row] for name, values in arrays.items()},
                **{name: np.array([columns[name]], kind) for name, kind in kinds.items()},
                tick={name: values[row] for name, values in state.items()},
                steps={} if setpoint is None else {"setpoint": setpoint[row]},
            )


class Source:
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
        """Content digests of objects and lights."""
        return self._manifest.get(INPUTS, {})

    @property
    def has_images(self) -> bool:
        """Whether it has views."""
        return bool({"bop", "shards"} & set(self.config.bake.formats))

    @property
    def steps_per_tick(self) -> int:
        """Physics steps of a frame."""
        return self.config.physics.steps_per_tick

    def episode(self, index: int) -> SourceEpisode:
        """A committed episode.

        Raises:
            DatasetError: Its manifest entry is missing or damaged.
        """
        entry = read_entry(self.folder, episode_entry(index))
        if entry is None:
            raise DatasetError(f"{self.folder / episode_entry(index)}.json is missing; resume the bake")
        row: dict[str, Any] = entry["row"]
        check_frames(self.folder, self.config, index, row["frames"])
        lines = tuple(json.dumps(attempt) + "\n" for attempt in entry["attempts"])
        return SourceEpisode(self, EpisodeEnd(index, row["arrangement"], row["frames"], int(Ending[row["ending"].upper()]), row, lines))

    def copy_constants(self, names: tuple[Path, ...], out: Path) -> None:
        """Copy files that all episodes share, and those in folders of these names, to another data set; replaces what is there.

        Raises:
            DatasetError: A file is missing or no regular file, or the source has none of a name.
            OSError: A file cannot be written.
        """
        known = read_checksums(self.folder, CONSTANTS)
        check_file_names(self.folder, CONSTANTS, known, self.config)
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
        try:
            handle = open_regular(self.folder / path)
        except OSError as error:
            raise DatasetError(f"{self.folder / path} cannot be read: {error.strerror}; run `synpick-warp verify`") from None
        with os.fdopen(handle, "rb") as source, target.open("wb") as file:
            shutil.copyfileobj(source, file, _COPY_BYTES)
