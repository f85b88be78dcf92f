"""Source of a conversion: a baked data set with its manifest, episodes, scenes and trajectories, and the context of its exporters.

Exporters take image files byte for byte, annotations unchanged, and masks as run lengths. Attributes and arrays of trajectories that a
format needs are checked before any of them is converted.
"""

import json
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from synpick_warp._version import __version__
from synpick_warp.codes import Ending
from synpick_warp.configs.cell.cameras import MASKS
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.annotations import ADVICE, Index, check_content
from synpick_warp.dataset.bop.layout import names_of
from synpick_warp.dataset.commit import manifest
from synpick_warp.dataset.reading import DataSet, Episode
from synpick_warp.dataset.trajectory import GROUP_FILE, Arrays, StoreAttributes, read_array
from synpick_warp.dataset.view_files import SceneFiles, ViewRecords
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.formats import Content
from synpick_warp.exporters.trajectory.arrays import STORE
from synpick_warp.exporters.writing.files import Buffer, open_regular, remove_folder
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.exporters.writing.rle import Masks, Runs, find_runs
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import Catalog, EnvironmentMap
from synpick_warp.views.frames import EpisodeEnd, TickBatch
from synpick_warp.views.picks import PickBatch


class StoredViewFiles:
    """Files of one stored view as a `StoredView`: bytes, records, images and run lengths of masks."""

    def __init__(self, files: SceneFiles, scene: int, frame: int) -> None:
        """`scene` is the BOP scene_id, `frame` the im_id."""
        self.files, self.scene, self.frame = files, scene, frame

    @cached_property
    def _records(self) -> ViewRecords:
        """Annotation records of the view: camera, gt, gt_info. Cached."""
        return self.files.records(self.frame)

    @property
    def camera(self) -> dict[str, Any]:
        return self._records.camera

    @property
    def gt(self) -> list[dict[str, Any]]:
        return self._records.gt

    @property
    def gt_info(self) -> list[dict[str, Any]]:
        return self._records.gt_info

    @property
    def graph(self) -> dict[str, Any] | None:
        return self.files.graph(self.frame)

    @property
    def color(self) -> tuple[str, Buffer]:
        return self.files.image_file("rgb", self.frame)[:2]

    @property
    def depth(self) -> Buffer:
        return self.layer("depth")

    def layer(self, name: str) -> Buffer:
        """Bytes of a layer's file, as stored; raises DatasetError if it is no PNG."""
        suffix, data, _ = self.files.image_file(name, self.frame)
        if suffix != ".png":
            raise DatasetError(f"{name} of image {self.frame} in {self.files.place} is a {suffix} file, expected: .png; {ADVICE}")
        return data

    def color_image(self) -> np.ndarray:
        """Decoded colour image, sRGB, RGB order (H, W, 3) uint8."""
        return np.ascontiguousarray(self.files.typed_image("rgb", self.frame, 3, "uint8")[..., ::-1])

    def depth_image(self) -> np.ndarray:
        return self.files.typed_image("depth", self.frame, None, "uint16")

    def masks(self) -> list[Masks]:
        """Run lengths of the amodal and visible mask of each instance; decoded within its box where that suffices."""
        return [
            Masks(
                self._read_runs("mask", index, info["bbox_obj"], info["px_count_valid"]),
                self._read_runs("mask_visib", index, info["bbox_visib"], info["px_count_visib"]),
            )
            for index, info in enumerate(self.gt_info)
        ]

    def _read_runs(self, name: str, index: int, box: list[int], count: int) -> Runs:
        """Runs of a mask, decoded within its box; if that has not exactly `count` pixels, as annotated, the whole mask is decoded."""
        width, height = self.files.image_size(self.frame)
        left, top = max(0, box[0]), max(0, box[1])
        rows, columns = slice(top, max(top, min(height, box[1] + box[3] + 1))), slice(left, max(left, min(width, box[0] + box[2] + 1)))
        if box[2] >= 0 and rows.stop > rows.start and columns.stop > columns.start:
            runs = find_runs(self.files.mask_crop(name, self.frame, index, rows, columns), top, left)
            if runs.count == count:
                return runs
        return find_runs(self.files.mask(name, self.frame, index))


@dataclass(frozen=True, eq=False)
class StoredSceneFiles:
    """`StoredScene` of a scene folder or of shards."""

    files: SceneFiles
    """Files of the scene; none has been read yet, so that this is small when pickled."""
    scene: int
    """BOP scene_id."""
    images: Sequence[int]
    """BOP im_id of each frame."""
    view: Callable[[SceneFiles, int, int], StoredViewFiles] = StoredViewFiles
    """Opens a view, by the scene's files, scene_id and im_id."""

    @property
    def frames(self) -> int:
        return len(self.images)

    def views(self, frames: range) -> Iterator[StoredViewFiles]:
        """Views of these frames (indices, not im_ids)."""
        return (self.view(self.files, self.scene, self.images[frame]) for frame in frames)


class ConversionSource:
    """A baked data set that is converted. Reads its manifest and settings, and checks them."""

    def __init__(self, folder: Path) -> None:
        """Open a data set; raises DatasetError if it is none, or has no episode."""
        self.folder = folder
        self._manifest = manifest.read_manifest(folder)
        self.config: Config = manifest.read_settings(folder, self._manifest)
        self.data = DataSet(folder)
        self.episodes = manifest.committed_episodes(folder)
        if not self.episodes:
            raise DatasetError(f"{folder} has no committed episode; finish its bake")

    @property
    def inputs(self) -> dict[str, str]:
        """Content digests of objects and lights, as the manifest records them."""
        return self._manifest.get(manifest.INPUTS, {})

    @property
    def version(self) -> str:
        """Version of synpick-warp that baked it; others may digest the same objects and lights otherwise."""
        return self._manifest["versions"]["synpick-warp"]

    def check_contents(self, needed: Collection[Content]) -> None:
        """Check that it has what formats are made of: all attributes and arrays of the trajectories, but of images only that there are any.
        Raises DatasetError if it lacks something, or that is damaged."""
        if "poses" in needed:
            self.check_trajectories(gripper="gripper" in needed)
        if "views" in needed and not {"bop", "shards"} & set(self.config.bake.formats):
            raise DatasetError(f"{self.folder} has no images; bake it with --formats bop or shards")
        if "masks" in needed and not self.config.bop.masks:
            raise DatasetError(f"{self.folder} has no masks, which a format needs; bake it with bop.masks = true")
        rig = self.config.rig
        if "masks" in needed and (bare := [index for index in range(len(rig.names)) if not rig.writes(index, MASKS)]):
            raise DatasetError(f"{self.folder} has no masks of {rig.label(bare[0])}, which a format needs; bake it with these")

    def check_trajectories(self, *, gripper: bool) -> None:
        """Check that the trajectories of all episodes have what a format needs; `gripper`: states and commands of the gripper, too. Raises
        DatasetError if there are none, or an attribute or array is missing or damaged."""
        self.data.require_store()
        place = self.data.folder / STORE / GROUP_FILE
        store = check_content(self.data.attributes, StoreAttributes, place)
        steps = self.config.physics.steps_per_tick
        if store.steps_per_tick != steps:
            there = f"steps_per_tick is {store.steps_per_tick}, the settings have {steps}"
            raise DatasetError(f"{place} is damaged: {there}; {ADVICE}")
        for end in map(self.episode_end, self.episodes):
            if Ending(end.ending).delivers:
                check_trajectory(self.data[end.episode], len(store.lights), gripper=gripper)

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
        """How a committed episode ended; raises DatasetError if its manifest entry is missing or damaged."""
        entry = manifest.read_entry(self.folder, manifest.episode_entry(index))
        if entry is None:
            raise DatasetError(f"{self.folder / manifest.episode_entry(index)}.json is missing; resume the bake")
        row: dict[str, Any] = entry["row"]
        manifest.check_frames(self.folder, DataLayout.of(self.config), index, row["frames"])
        lines = tuple(json.dumps(attempt) + "\n" for attempt in entry["attempts"])
        return EpisodeEnd(index, row["arrangement"], row["frames"], int(Ending[row["ending"].upper()]), row, lines)


class StoredContext(ExportContext):
    """Context of the exporters that write a converted data set."""

    def __init__(self, source: ConversionSource, out: Path, settings: ExportSettings, pool: WriterPool) -> None:
        """`settings` are those of the converted data set; `out` and `pool` as of `ExportContext`."""
        from synpick_warp.scenes.cameras import make_cameras

        super().__init__(out, settings, Catalog(()), make_cameras(settings.rig), (), pool)
        self._source = source

    @cached_property
    def _assets(self) -> tuple[Catalog, tuple[EnvironmentMap, ...], Looks | None]:
        """Objects, lights and textures of the source, loaded again, as its models are rounded to millimetres in single precision; raises
        DatasetError if they are not those that it was baked from."""
        from synpick_warp.dataset.commit.writing import digest_inputs
        from synpick_warp.scenes.catalog import load_catalog
        from synpick_warp.scenes.looks import load_looks
        from synpick_warp.stages.render.looks import load_scene_lights

        source, config = self._source, self._source.config
        catalog = load_catalog(config)
        lights = load_scene_lights(config.bake.lights, config.randomize, config.bake.seed, lambda line: None)
        looks = load_looks(config.randomize, lambda line: None)
        if said := manifest.describe_inputs(digest_inputs(catalog, lights, looks), source.inputs):
            if source.version != __version__:
                other = f"were digested by synpick-warp {source.version}, this is {__version__}; convert with that version"
                raise DatasetError(f"{said} of {source.folder} are needed, but {other}")
            raise DatasetError(f"{said} of {source.folder} have changed since its bake, but are needed; restore them")
        return catalog, lights, looks

    @property
    def catalog(self) -> Catalog:
        return self._assets[0]

    @property
    def lights(self) -> tuple[EnvironmentMap, ...]:
        return self._assets[1]

    @property
    def looks(self) -> Looks | None:
        return self._assets[2]

    @cached_property
    def names(self) -> dict[int, str]:
        """Names by obj_id, sorted: from the zarr store; without one from models and settings, else "obj_NNNNNN"."""
        return dict(sorted(names_of(self._source.data).items()))

    def copy_constants(self, names: tuple[Path, ...]) -> bool:
        """Copy these files, and those in these folders, from the source to the output folder, replacing what is there; returns True. Raises
        DatasetError if a file is missing or no regular file, or the source has none of a name, and OSError if a file cannot be written."""
        folder = self._source.folder
        known = manifest.read_checksums(folder, manifest.CONSTANTS)
        manifest.check_file_names(folder, manifest.CONSTANTS, known, DataLayout.of(self._source.config))
        listed = [Path(name) for name in known]
        for name in names:
            files = [path for path in listed if path == name or name in path.parents]
            if not files:
                raise DatasetError(f"{folder} has no {name}; bake it with --formats bop or shards")
            remove_folder(self.out / name)
            for path in files:
                (self.out / path).parent.mkdir(exist_ok=True)
                try:
                    handle = open_regular(folder / path)
                except OSError as error:
                    raise DatasetError(f"{folder / path} cannot be read: {error.strerror}; run `synpick-warp verify`") from None
                with os.fdopen(handle, "rb") as source, (self.out / path).open("wb") as file:
                    shutil.copyfileobj(source, file)
        return True


POSES = ("time", "object_id", "pose", "fixture_pose", "fixture_visible")
"""Arrays of `ticks` that every format needs."""
GRIPPER = ("task", "attached")
"""Arrays of `ticks` that a format with states and commands of the gripper needs, too."""
SETPOINT = "setpoint"
"""Array of `steps` that such a format needs."""


class _Light(msgspec.Struct):
    """Schema of an episode's light: index of the environment map, yaw [rad], exposure compensation [EV]."""

    map: Index
    yaw: float
    exposure: float


class _Bin(msgspec.Struct):
    """Schema of an episode's bin: its name."""

    name: str


class _Attributes(msgspec.Struct):
    """Schema of the attributes of an episode's group, as far as they are converted."""

    light: _Light
    bin: _Bin | None = None


def check_trajectory(data: Episode, lights: int, *, gripper: bool) -> None:
    """Check that an episode's trajectory has what a format needs; `lights`: number of environment maps, `gripper`: whether states and
    commands of the gripper are needed. Raises DatasetError if an attribute or array is missing or damaged."""
    light = check_content(data.attributes, _Attributes, data.group / GROUP_FILE).light
    if light.map >= lights:
        raise DatasetError(f"{data.group / GROUP_FILE} is damaged: light.map is {light.map}, the store has {lights} maps; {ADVICE}")
    _require(data, data.ticks, "ticks", (*POSES, *(GRIPPER if gripper else ())))
    shapes = {name: data.ticks[name].shape[1] for name in ("object_id", "pose", *(GRIPPER[1:] if gripper else ()))}
    if len(set(shapes.values())) > 1:
        counts = ", ".join(f"{name} {count}" for name, count in shapes.items())
        raise DatasetError(f"{data.group / 'ticks'} is damaged: its arrays differ in the number of instances ({counts}); {ADVICE}")
    if gripper:
        if not len(data.steps):
            raise DatasetError(
                f"{data.group} has no steps, whose setpoints are the actions of lerobot; bake zarr with trajectory.steps = true"
            )
        _require(data, data.steps, "steps", (SETPOINT,))


def _require(data: Episode, arrays: Arrays, group: str, wanted: tuple[str, ...]) -> None:
    """Check that a group has these arrays, of the schema's types and shapes."""
    for name in wanted:
        if name not in arrays:
            raise DatasetError(f"{data.group / group} has no array {name}; {ADVICE}")


def read_ticks(data: Episode, steps_per_tick: int, bins: Sequence[str]) -> Iterator[TickBatch]:
    """Yield the frames of an episode, as they came from the simulation, with gripper state and setpoints if there are any; poses of absent
    instances are NaN. `bins`: as `Cell.recorded`. Raises DatasetError if the episode's bin is none of them."""
    arrays = {name: read_array(data.ticks[name]) for name in POSES}
    state = {name: read_array(data.ticks[name]) for name in GRIPPER if name in data.ticks}
    setpoint = read_array(data.steps[SETPOINT]).reshape(len(data), steps_per_tick, 3) if SETPOINT in data.steps else None
    attributes = check_content(data.attributes, _Attributes, data.group / GROUP_FILE)
    light, own = attributes.light, attributes.bin.name if attributes.bin else ""
    if bins and own not in bins:
        raise DatasetError(f"{data.group / GROUP_FILE} is damaged: its bin is {own!r}, the settings have {', '.join(bins)}; {ADVICE}")
    columns: dict[str, Any] = {
        "bin": np.array([bins.index(own) if bins else 0], np.int32),
        "light": np.array([light.map], np.int32),
        "light_yaw": np.array([light.yaw], np.float32),
        "light_exposure": np.array([light.exposure], np.float32),
    }
    for frame in range(len(data)):
        row = slice(frame, frame + 1)
        yield TickBatch(
            episode=np.array([data.index], np.int32),
            frame=np.array([frame], np.int32),
            **{name: values[row] for name, values in arrays.items()},
            **columns,
            tick={name: values[row] for name, values in state.items()},
            steps={} if setpoint is None else {SETPOINT: setpoint[row]},
        )
