"""Data set reader: episodes, views with ground truth, pick attempts and trajectories of what a bake wrote, all loaded lazily.

    data = synpick_warp.open("DATA")
    view = data[0].view(frame=12, camera=1)
    view.rgb, view.depth, view.masks, view.object_to_camera
    track = data[0].tracks[view.instance_ids[0]]
    track.object_to_world, track.visibility, track.boxes

Views come from BOP folders (format bop) or webdataset shards (format shards), arrays by name from the zarr store (format zarr). Reading
needs no simulator; zarr, NumPy and OpenCV are imported when arrays or images are read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from synpick_warp.configs.dataset import DataLayout, episode_range
from synpick_warp.dataset import trajectory
from synpick_warp.dataset.annotations import ADVICE, EpisodeEntry, EpisodeRow, Key, ModelInfo, check_content, read_checked
from synpick_warp.dataset.commit.manifest import CONFIG_FILE, CONSTANTS, ENTRIES, MANIFEST_FILE, check_frames, episode_entry, read_checksums
from synpick_warp.dataset.picks import PickTables
from synpick_warp.dataset.scene_index import SceneIndex, numbered
from synpick_warp.errors import DatasetError, format_value
from synpick_warp.exporters.formats import PartFiles, part_files
from synpick_warp.exporters.trajectory.arrays import EPISODE_GROUPS, EPISODES, STORE
from synpick_warp.system.inputs.files import decode_json
from synpick_warp.system.inputs.urls import parse_place

if TYPE_CHECKING:
    import numpy as np

    from synpick_warp.configs.schema import Config
    from synpick_warp.dataset.bop.foreign import ForeignScenes
    from synpick_warp.dataset.view import Track, Tracks, View
    from synpick_warp.dataset.view_files import SceneFiles
    from synpick_warp.scenes.types import Camera

USD = Path("usd")
"""Folder of USD episodes in a data set."""
UNKNOWN = "unknown"
"""Mode and ending of an episode that no bake has described."""


class Episode(PickTables):
    """One episode: row of the episode list, pick attempts, views, and arrays of the trajectory."""

    def __init__(self, data_set: DataSet, index: int) -> None:
        """Episode `index` of a data set, which has it."""
        self._data_set, self.folder = data_set, data_set.folder
        self.group = data_set.folder / STORE / EPISODES / f"{index:06d}"
        """Folder of its group in the trajectory store, if there is one."""
        self._scenes: dict[int, SceneFiles] = {}
        self.index = index

    @property
    def number(self) -> int:
        """Index of the episode, the same as `index`."""
        return self.index

    @cached_property
    def _record(self) -> dict[str, Any] | None:
        """Entry of the episode in the manifest; None: the data set has none."""
        path = self._data_set.folder / f"{episode_entry(self.index)}.json"
        return read_checked(path, EpisodeEntry) if path.exists() else None

    @cached_property
    def _context(self) -> trajectory.GroupContext:
        return trajectory.GroupContext(lambda: self._sizes, lambda: self._files)

    @cached_property
    def _sizes(self) -> dict[str, int]:
        """Sizes of the dimensions of the episode's arrays, by name."""
        store = check_content(self._data_set.attributes, trajectory.StoreAttributes, self._data_set.folder / STORE)
        attempts = {} if self._record is None else {"attempt": len(self.attempts)}
        return {"tick": len(self), "step": len(self) * store.steps_per_tick} | attempts

    @cached_property
    def _files(self) -> frozenset[Path]:
        return self._data_set.listed_files(episode_entry(self.index))

    def _arrays(self, name: str) -> trajectory.Arrays:
        """Arrays of a group of the episode in the zarr store."""
        return trajectory.Arrays(self.group / name, EPISODE_GROUPS[name], self._context)

    @cached_property
    def row(self) -> dict[str, Any]:
        """The episode's line of episodes.jsonl: mode, ending, frames, seconds, counts of objects and attempts; or what is known of it."""
        if self._data_set.found is not None:
            return {"episode": self.index, "frames": len(self.image_ids), "mode": UNKNOWN, "ending": UNKNOWN}
        row = self.attributes if self._record is None else self._record["row"]
        frames = check_content(row, EpisodeRow, self.group / trajectory.GROUP_FILE).frames
        data = self._data_set
        check_frames(data.folder, DataLayout.of(data.config) if (data.folder / CONFIG_FILE).exists() else None, self.index, frames)
        return row

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """Attributes in the trajectory store: as `row`, and light. Raises DatasetError if the data set has no trajectories."""
        self._data_set.require_store()
        return trajectory.read_attributes(self.group)

    @property
    def ticks(self) -> trajectory.Arrays:
        """Arrays with one row per frame; empty without trajectories, as are the following."""
        return self._arrays("ticks")

    @property
    def steps(self) -> trajectory.Arrays:
        """Arrays with one row per physics step; empty if steps were not recorded."""
        return self._arrays("steps")

    @property
    def arrangement(self) -> trajectory.Arrays:
        """Arrays of the drawn objects and how they were dropped."""
        return self._arrays("arrangement")

    @property
    def attempt_arrays(self) -> trajectory.Arrays:
        """Attempts of the episode as arrays of the zarr store, one row per attempt."""
        return self._arrays("attempts")

    @cached_property
    def image_ids(self) -> Sequence[int]:
        """BOP's im_id of each frame: the frame's index; in a data set from another source, numbers that may have gaps."""
        if self._data_set.found is None:
            return range(len(self))
        return sorted({image for camera in self.cameras for image in self._files_of(camera).frames()})

    @property
    def cameras(self) -> Sequence[int]:
        """Indices of the cameras that have recorded the episode: all; in a data set from another source, possibly fewer."""
        found = self._data_set.found
        return range(self._data_set.camera_count) if found is None else found.cameras_of(self.index)

    @cached_property
    def attempts(self) -> tuple[dict[str, Any], ...]:
        """Pick attempts in order; each is a line of attempts.jsonl. Empty for a data set from another source."""
        if self._data_set.found is not None:
            return ()
        if self._record is not None:
            return tuple(self._record.get("attempts", ()))
        if "record" not in self.attempt_arrays:
            raise DatasetError(f"{self.group} has no array attempts/record; {ADVICE}")
        lines = trajectory.read_array(self.attempt_arrays["record"]).tobytes().splitlines()
        source = self.group / "attempts" / "record"
        return tuple(decode_json(line, dict[str, Any], f"{source}, line {row},", DatasetError, ADVICE) for row, line in enumerate(lines, 1))

    @cached_property
    def tracks(self) -> Tracks:
        """Every instance over cameras and time: poses, visibility and boxes as arrays, by instance id. Raises DatasetError if the data set
        has no images."""
        from synpick_warp.dataset.view import Tracks

        return Tracks(self.views(), self._data_set.camera_count, len(self))

    @property
    def usd(self) -> Path:
        """The episode's USD file; it exists if the data set has the format usd."""
        return self._data_set.folder / USD / f"{self.index:06d}.usdc"

    def frames(self, camera: int) -> range:
        """Frames of which a camera has pictures: all, or with `every` in its settings each n-th."""
        return range(0, len(self), 1 if self._data_set.found is not None else self._data_set.config.rig.every[camera])

    def images(self, camera: int) -> Sequence[int]:
        """BOP's im_id of each of a camera's pictures."""
        return self.image_ids[:: self.frames(camera).step]

    def view(self, frame: int, camera: int = 0) -> View:
        """View of a frame and camera."""
        from synpick_warp.dataset.view import View

        frames, cameras = len(self), self._data_set.camera_count
        if camera not in range(cameras):
            raise IndexError(f"there is no camera {camera}; there are {cameras} cameras")
        if frame not in range(-frames, frames):
            raise IndexError(f"episode {self.index} has no frame {frame}; it has {frames} frames")
        if frame % frames not in (own := self.frames(camera)):
            raise IndexError(f"episode {self.index} has no picture of camera {camera} in frame {frame}; it has one every {own.step} frames")
        return View(self._files_of(camera), self.index, camera, frame % frames, self.image_ids[frame % frames], self)

    def _files_of(self, camera: int) -> SceneFiles:
        """Files of the scene that a camera recorded."""
        if camera not in self._scenes:
            self._scenes[camera] = self._data_set.scene_files(self.index, camera)
        return self._scenes[camera]

    def views(self, camera: int | None = None) -> Iterator[View]:
        """Iterate over the views frame by frame, of one camera or of all."""
        cameras = self.cameras if camera is None else (camera,)
        for frame in range(len(self)):
            yield from (self.view(frame, each) for each in cameras if frame in self.frames(each))

    def __len__(self) -> int:
        """Number of frames."""
        return int(self.row["frames"])

    def __repr__(self) -> str:
        return f"Episode({self.index}: {self.row['frames']} frames, {self.row['ending']})"


class DataSet(Mapping[int, Episode]):
    """Episodes of a data set by index, and what they share. Episodes that another bake commits meanwhile appear on the next access.

    In a BOP data set from another source, an episode is a scene, with the scene's index, and a camera is a sensor; see `ForeignScenes`.
    """

    def __init__(self, folder: Path, episodes: range | None = None, split: str | None = None) -> None:
        """Open a folder, to show these episodes, or of a data set from another source this split; None: all."""
        self.folder = folder
        self._store = folder / STORE
        self._only, self._found_split = episodes, split

    @cached_property
    def found(self) -> ForeignScenes | None:
        """Scenes that were found in the folder of a data set from another source; None: the data set is of a bake. Raises DatasetError if
        neither did a bake write it nor has it BOP scenes."""
        if (self.folder / MANIFEST_FILE).is_file() or self.has_store:
            return None
        from synpick_warp.dataset.bop.foreign import ForeignScenes
        from synpick_warp.dataset.bop.layout import NoLayoutError

        try:
            return ForeignScenes(self.folder, self._found_split)
        except NoLayoutError:
            has = f"has neither {MANIFEST_FILE} nor {STORE} nor BOP scenes, such as test/000001 with a scene_camera.json"
            why = f"it {has if self.folder.exists() else 'does not exist'}"
            raise DatasetError(f"{self.folder} is not a data set: {why}; name the folder of one") from None

    @cached_property
    def config(self) -> Config:
        """All settings of the bake. Raises ConfigError if they are missing or unreadable, and DatasetError if others made the data set."""
        if self.found is not None:
            raise DatasetError(f"{self.folder} has no settings: it is from another source than synpick-warp bake")
        from synpick_warp.configs.files.load import load_config

        return load_config(str(self.folder / CONFIG_FILE), {})

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the trajectory store: seed, step, names of light maps. Raises DatasetError if the data set has no trajectories."""
        self.require_store()
        return trajectory.read_attributes(self._store)

    @cached_property
    def objects(self) -> tuple[trajectory.ObjectInfo, ...]:
        """Object table with physical properties, by catalog index; of the trajectory store. Raises DatasetError if the data set has no
        trajectories; `models_info` has sizes."""
        self.require_store()
        return trajectory.read_objects(self._store, self._constants)

    @cached_property
    def _constants(self) -> trajectory.GroupContext:
        """What the store's tables are checked against: the files that the manifest lists."""
        return trajectory.GroupContext(files=lambda: self.listed_files(CONSTANTS))

    def listed_files(self, entry: Path) -> frozenset[Path]:
        """Files of the trajectory store that a manifest entry lists; none without it. Raises DatasetError if the list is damaged."""
        if not (self.folder / f"{entry}.json").exists():
            return frozenset()
        return frozenset(self.folder / name for name in read_checksums(self.folder, entry) if name.startswith(f"{STORE}/"))

    @cached_property
    def models_info(self) -> dict[int, dict[str, Any]]:
        """Object id -> its entry of BOP's models_info.json: diameter, box and symmetries [mm]. Raises DatasetError if the data set has no
        models, as it has neither the format bop nor shards."""
        from synpick_warp.dataset.bop.layout import INFO, models_folder

        return read_checked(self.folder / models_folder(self.folder) / INFO, dict[Key, ModelInfo])

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras by index. Raises DatasetError for a data set from another source, whose views have cameras of their own."""
        if self.has_store:
            return trajectory.read_cameras(
                self._store, self.camera_count if (self.folder / CONFIG_FILE).exists() else None, self._constants
            )
        from synpick_warp.scenes.cameras import make_cameras

        return make_cameras(self.config.rig)

    def intrinsics(self, convention: str = "synpick") -> np.ndarray:
        """Camera matrices (camera, 3, 3) [px] in the first frame, as of `View.intrinsics`: "opencv" has pixel centres at integers."""
        import numpy as np

        first = next(iter(self.values()))
        return np.stack([first.view(0, camera).intrinsics(convention) for camera in first.cameras])

    @cached_property
    def sensors(self) -> tuple[str, ...]:
        """Names of the cameras as sensors of their scenes (BOP-Industrial); empty: each camera has scenes of its own."""
        if self.found is not None:
            return self.found.sensors
        return DataLayout.of(self.config).sensors

    @cached_property
    def period(self) -> float | None:
        """Time from frame to frame [s]; None: unknown, in a data set from another source."""
        return None if self.found is not None else self.config.physics.tick_time

    def scene_id(self, episode: int, camera: int) -> int:
        """BOP scene_id of a camera's images of an episode, as in result files: each (episode, camera) pair has its own id."""
        return self.camera_count * (episode if self.found is None else self.found.scene(episode)) + camera

    def split_of(self, episode: int) -> str:
        """Name of the split of an episode."""
        if self.found is not None:
            return self.found.split(episode)
        split = DataLayout.of(self.config).split_of(episode)
        return self.config.bop.split if split is None else split.name

    @cached_property
    def split_folders(self) -> dict[str, str]:
        """Name of each split -> its folder of BOP scenes, such as "train_pbr"."""
        if self.found is not None:
            return {name: name for name in self.found.splits}
        return {split.name: split.folder for split in self.config.splits} or {self.config.bop.split: self.config.bop.split}

    @cached_property
    def camera_count(self) -> int:
        """Number of cameras: found in files, or of the settings."""
        if self.found is not None:
            return self.found.cameras
        return len(self.config.rig)

    @property
    def attempts(self) -> Iterator[dict[str, Any]]:
        """Yield the attempts to pick of all episodes, in order: dictionaries with the keys of attempts.jsonl."""
        return (attempt for episode in self.values() for attempt in episode.attempts)

    @property
    def tracks(self) -> Iterator[tuple[Episode, Track]]:
        """Tracks of all instances of all episodes, in order; one episode at a time is in memory."""
        return ((episode, track) for episode in self.values() for track in episode.tracks.values())

    def views(self, camera: int | None = None) -> Iterator[View]:
        """Iterate over the views of all episodes, of one camera or of all."""
        return (view for episode in self.values() for view in episode.views(camera))

    @property
    def has_store(self) -> bool:
        """Whether there is a trajectory store."""
        return (self._store / EPISODES / trajectory.GROUP_FILE).is_file()

    def require_store(self) -> None:
        """Raise DatasetError unless there is a trajectory store."""
        if not self.has_store:
            raise DatasetError(f"{self.folder} has no {STORE}; bake with --formats zarr, which can be combined with others, as in bop,zarr")

    @cached_property
    def splits(self) -> dict[str, DataSet]:
        """Splits by name, each a data set of its episodes. Without [splits] in the settings, the one of the name `bop.split`; none
        without settings, as in a lone trajectory store."""
        if self.found is not None:
            return {name: DataSet(self.folder, split=name) for name in self.found.splits}
        if not (self.folder / CONFIG_FILE).exists():
            return {}
        named = {split.name: DataSet(self.folder, episode_range(split)) for split in self.config.splits}
        return named or {self.config.bop.split: self}

    def split(self, name: str) -> DataSet:
        """Data set reduced to the episodes of one split. Raises DatasetError if there is no such split."""
        if name not in self.splits:
            raise DatasetError(f"{self.folder} has no split {format_value(name)}; splits: {', '.join(self.splits) or 'none'}")
        return self.splits[name]

    @cached_property
    def planned(self) -> int:
        """Number of episodes that the settings plan, or that were found in a data set from another source."""
        if self.found is not None:
            return len(self)
        return sum(len(each) for each in DataLayout.of(self.config).plan() if self._only in (None, each))

    @cached_property
    def _scenes(self) -> SceneIndex | ForeignScenes | None:
        """Locations of the scenes' files; None: without settings they are not known."""
        if self.found is not None:
            return self.found
        return self._index() if (self.folder / CONFIG_FILE).exists() else None

    def _index(self) -> SceneIndex:
        return SceneIndex(self.folder, DataLayout.of(self.config), self.config.rig.sizes)

    @property
    def _parts(self) -> list[PartFiles]:
        """File patterns of formats that the reader lists but does not open; without settings, only those with one file per episode."""
        return [] if self.found is not None else part_files(None if self._scenes is None else self.camera_count)

    def scene_files(self, episode: int, camera: int) -> SceneFiles:
        """Files of the scene of a camera and episode: a folder, or else shards. Raises DatasetError if the data set has no images."""
        return self._index().files(episode, camera) if self._scenes is None else self._scenes.files(episode, camera)

    def _has_files(self, index: int) -> bool:
        """Whether an episode has files in any format."""
        paths = [self._store / EPISODES / f"{index:06d}" / trajectory.GROUP_FILE, *(self.folder / part.file(index) for part in self._parts)]
        return any(path.exists() for path in paths) or (self._scenes is not None and self._scenes.has(index))

    def _names(self) -> Iterator[int]:
        """Indices of the episodes that have files in some format; an index can occur several times."""
        yield from numbered((self._store / EPISODES).glob("[0-9]*"))
        for part in self._parts:
            yield from (part.episode(number) for number in numbered(self.folder.glob(part.pattern)))
        if self._scenes is not None:
            yield from self._scenes.episodes()

    def _is_committed(self, index: int) -> bool:
        """Whether an episode belongs to this selection and has a manifest entry; always, without manifest, as in a lone store."""
        if not hasattr(index, "__index__") or (self._only is not None and index not in self._only):
            return False
        return self.found is not None or not (self.folder / ENTRIES).is_dir() or (self.folder / f"{episode_entry(index)}.json").is_file()

    def __getitem__(self, index: int) -> Episode:
        if self._is_committed(index) and self._has_files(index):
            return Episode(self, index)
        raise KeyError(f"{self.folder} has no episode {index}")

    def __iter__(self) -> Iterator[int]:
        return iter(sorted(index for index in set(self._names()) if self._is_committed(index)))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def length(self, index: int) -> int:
        """Number of frames of an episode."""
        return len(self[index])

    def __repr__(self) -> str:
        return f"DataSet({str(self.folder)!r}, {len(self)} episodes)"


def open_data_set(folder: Path | str) -> DataSet:
    """Open a data set; reads nothing yet, but the names of splits and scenes where there is no manifest.

    Raises DatasetError if the folder is neither one that a bake wrote, or is still writing, nor another BOP data set.
    """
    if isinstance(place := parse_place(folder), str):
        raise DatasetError(f"{place} is in an object store; open it by synpick_warp.open")
    data_set = DataSet(place)
    data_set.found  # noqa: B018
    return data_set
