"""Run of a conversion: output folder, processes, episodes, commits, indices; resumed by running it again. And conversion of a BOP data set
from another source to data set formats of single images.

Of another source's set, scene and image ids are kept; image files are copied without decoding where the format has the same file type;
annotations are written as they were read. Like the source, the result has no settings and no manifest. It is written to a temporary folder
and renamed when it is complete.
"""

import dataclasses
import re
import shutil
import tempfile
from collections.abc import Collection, Sequence
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from synpick_warp.apps.conversion.source import ConversionSource, StoredContext, StoredSceneFiles, StoredViewFiles
from synpick_warp.apps.validation.comparison import MEASURED_DEPTH, DepthPatch, ObjectRenderer
from synpick_warp.codes import Ending
from synpick_warp.configs.calibration.lens import read_lens
from synpick_warp.configs.dataset import ExportSettings
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import CLASSIC
from synpick_warp.dataset.bop.foreign import ForeignScenes, measure_info
from synpick_warp.dataset.bop.layout import TARGETS, Layout, models_folder, object_names
from synpick_warp.dataset.commit.writing import OutputFolder, commit_episode, finalize_data_set
from synpick_warp.dataset.reading import DataSet, open_data_set
from synpick_warp.dataset.view_files import SceneFiles, SceneFolder
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.bop.shared import MODEL_FOLDERS
from synpick_warp.exporters.formats import FORMAT_TABLE, Content, contents_of, convertible, find_format, format_names
from synpick_warp.exporters.registry import Exporters, finalize, load_exporter_classes
from synpick_warp.exporters.writing.files import PARTIAL, Buffer, check_output_folder, output_error, output_errors, write_atomically
from synpick_warp.exporters.writing.notes import CAMERA_FILE, NOTES_FILE
from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.exporters.writing.rle import Masks, Runs, find_runs
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.types import Catalog
from synpick_warp.system.codecs.jpeg import encode_jpeg
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.inputs.files import make_folder
from synpick_warp.system.inputs.image_files import MAX_IMAGE_FILE, TEXTURE_KINDS
from synpick_warp.system.progress import Report
from synpick_warp.views.frames import EpisodeEnd

REMARK = (
    "Masks are rendered from models and poses, since the source has none: visible is where no annotated object and, by more than"
    f" {MEASURED_DEPTH:.0f} mm, no measured depth is nearer."
)
_IMAGES = {"views", "masks"}
"""Kinds of `formats.Content` that these data sets have."""
_NEEDS = {"gt": "ground truth (scene_gt.json)", "rgb": "colour images"}
_NEEDS_OF_MASKS = {"mask_visib": "masks of visible parts (mask_visib), nor models and cameras to render them"}
_NEEDS_OF_DEPTH = {"camera": "cameras (scene_camera.json)", "depth": "depth images"}
"""What formats need of a scene, by the names of `SceneFiles.has`."""
_WITH_INFO = ("bop", "shards")
"""Formats that write scene_gt_info.json."""
_BAKED = (CAMERA_FILE, "README.md")
"""Files that exporters write about the camera and licence of a bake: removed, since they are not true of the source's images."""
_CAMERA = re.compile(r"camera(_\w+)?\.json")
"""Cameras of a split or a sensor."""
_JPEG_QUALITY = 95
"""JPEG quality of colour images that are encoded again: they are neither PNG nor JPEG, or differ in type from the first one."""


class ForeignViewFiles(StoredViewFiles):
    """`StoredView` of any BOP scene: other file formats are encoded again, other image sizes refused, missing masks rendered."""

    def __init__(self, files: SceneFiles, scene: int, frame: int, suffix: str, size: tuple[int, int], root: Path) -> None:
        """`suffix`: of colour images; `size`: width and height [px]; `root`: folder of the data set; others as of `StoredViewFiles`."""
        super().__init__(files, scene, frame)
        self.suffix, self.size, self.root = suffix, size, root

    @property
    def gt_info(self) -> list[dict[str, Any]]:
        """Entries in scene_gt_info.json, measured where masks are rendered."""
        if self.files.has("mask_visib") or self.files.has("gt_info"):
            return super().gt_info
        return measure_info([visible for _, visible in self._rendered], [amodal for amodal, _ in self._rendered])

    @cached_property
    def _rendered(self) -> list[tuple[np.ndarray, ...]]:
        """Amodal and visible masks of a view without any."""
        return render_masks(self.root, self.files, self.frame, self.camera, self.gt)

    @property
    def color(self) -> tuple[str, Buffer]:
        """Suffix and content of the colour image's file, copied or encoded again; DatasetError if its size is not that of the first."""
        size = self.files.image_size(self.frame)
        if size != self.size:
            shown, first = (f"{width} x {height}" for width, height in (size, self.size))
            raise DatasetError(f"{self.files.place}: image {self.frame} has {shown} pixels, the first one {first}; formats have one size")
        suffix, data, _ = self.files.image_file("rgb", self.frame)
        if suffix.replace("jpeg", "jpg") == self.suffix:
            return self.suffix, data
        image = self.color_image()
        return self.suffix, encode_png(image) if self.suffix == ".png" else encode_jpeg(image, _JPEG_QUALITY)

    def layer(self, name: str) -> Buffer:
        """PNG file of a layer, as depth: copied, or encoded again with 16 bits."""
        suffix, data, _ = self.files.image_file(name, self.frame)
        return data if suffix == ".png" else encode_png(self.files.typed_image(name, self.frame, None, "uint16"))

    def masks(self) -> list[Masks]:
        """Run lengths of amodal and visible masks, rendered if the source has no visible ones. Missing amodal ones are
        given as the visible ones: the formats allowed then (coco, yolo) do not write them."""
        if not self.files.has("mask_visib"):
            return [Masks(find_runs(amodal), find_runs(visible)) for amodal, visible in self._rendered]
        visible = self._runs("mask_visib")
        return [Masks(*pair) for pair in zip(self._runs("mask") if self.files.has("mask") else visible, visible, strict=True)]

    def _runs(self, name: str) -> list[Runs]:
        return [find_runs(mask) for mask in self.files.masks(name, self.frame, len(self.gt))]


@cache
def _renderer(root: Path) -> ObjectRenderer:
    """Renderer of a data set's models, one a process."""
    return ObjectRenderer(Layout(root))


def render_masks(
    root: Path, files: SceneFiles, frame: int, camera: dict[str, Any], gt: list[dict[str, Any]]
) -> list[tuple[np.ndarray, ...]]:
    """Render the amodal and visible mask (H, W) bool of each instance of a view, with the models of the data set `root`. `camera`, `gt`:
    the view's entries in scene_camera.json and scene_gt.json. Raises DatasetError if an object has no model or the image no intrinsics, and
    CatalogError if a model cannot be read."""
    if "cam_K" not in camera:
        raise DatasetError(f"{files.place}: the camera of image {frame} has no cam_K, by which masks are rendered")
    size = files.image_size(frame)
    matrix, lens = np.reshape(np.asarray(camera["cam_K"], np.float64), (3, 3)), read_lens(camera, size)
    measured, nearest = None, np.full(size[::-1], np.inf, np.float32)
    if files.has("depth") and "depth_scale" in camera:
        measured = files.typed_image("depth", frame, None, "uint16") * np.float32(camera["depth_scale"])
    found = []
    for truth in gt:
        rotation, translation = (np.asarray(truth[name], np.float64) for name in ("cam_R_m2c", "cam_t_m2c"))
        patch = _renderer(root).render(int(truth["obj_id"]), rotation.reshape(3, 3), translation.reshape(3), matrix, size, lens)
        nearest[patch.window] = np.minimum(nearest[patch.window], patch.depth)
        found.append(patch)
    return [_make_masks(patch, nearest, measured) for patch in found]


def _make_masks(patch: DepthPatch, nearest: np.ndarray, measured: np.ndarray | None) -> tuple[np.ndarray, ...]:
    """Amodal and visible mask (H, W) bool of a rendered object. `nearest`: least depth of all objects; `measured`: depth image (None: there
    is none), in which 0 hides nothing. All in mm."""
    amodal, visible = np.zeros((2, *nearest.shape), bool)
    window, depth = patch.window, patch.depth
    amodal[window] = np.isfinite(depth)
    visible[window] = amodal[window] & (depth <= nearest[window])
    if measured is not None:
        visible[window] &= (measured[window] == 0) | (measured[window] >= depth - np.float32(MEASURED_DEPTH))
    return amodal, visible


class _Context(ExportContext):
    """Context of the exporters. Objects are those that have a model or occur in the ground truth, named as in the models folder or else by
    number; model files are copied."""

    def __init__(self, data: DataSet, out: Path, settings: ExportSettings, pool: WriterPool) -> None:
        super().__init__(out, settings, Catalog(()), make_cameras(settings.rig), (), pool)
        self._data = data

    @cached_property
    def names(self) -> dict[int, str]:
        """Names by obj_id, sorted."""
        folder = self._data.folder
        found = {int(index) for view in self._data.views() for index in view.object_ids} | set(_found(self._data).layout.model_files)
        named = object_names(folder, found) if (folder / models_folder(folder) / "models_info.json").is_file() else {}
        return {index: named.get(index, f"obj_{index:06d}") for index in sorted(found)}

    def copy_constants(self, names: tuple[Path, ...]) -> bool:
        """Copy the files of models that exist, whichever `names` are given; True: exporters write no others. See `ExportContext`."""
        layout = _found(self._data).layout
        for name in MODEL_FOLDERS:
            source = layout.models.get(name if name in layout.models else models_folder(layout.root))
            for file in sorted(source.files) if source is not None else ():
                if source is not None and file.rpartition(".")[2].lower() in ("ply", "json", *TEXTURE_KINDS):
                    make_folder(self.out / name)
                    (self.out / name / file).write_bytes(source.read(file, MAX_IMAGE_FILE))
        return True


def _found(data: DataSet) -> ForeignScenes:
    """Scenes and layout of a data set from another source."""
    assert data.found is not None
    return data.found


def convert_foreign(data: DataSet, out: Path, formats: Sequence[str], processes: int, report: Report) -> tuple[int, str]:
    """Convert all scenes of a data set from another source; returns their number, and a remark if masks were rendered (else empty).
    Arguments and errors: `run.convert`, but `out` must be new or empty."""
    _renderer.cache_clear()  # Another data set may have stood in this folder before.
    index = next((index for index, episode in data.items() if len(episode)), None)
    if index is None:
        raise DatasetError(f"{data.folder} has no images")
    firsts = [data.scene_files(index, camera) for camera in range(data.camera_count)]
    for first in firsts:
        _check_formats(data, first, formats)
    check_output_folder(out)
    if out.is_dir() and any(out.iterdir()):
        raise ConfigError(f"--out is {out}, which is not empty; name a new folder: data sets from other sources are converted as a whole")
    settings = _make_settings(data, firsts, formats)
    with output_errors(out):
        make_folder(out.parent)
        work = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        contents = {content for name in formats for content in contents_of(name, settings.bop)}
        remark = REMARK if "masks" in contents and not all(first.has("mask_visib") for first in firsts) else ""
        count = _write(data, work, settings, processes, report, remark)
        work.chmod(0o755)
        work.rename(out)
    except OSError as error:
        raise output_error(out, error) from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return count, remark


def _check_formats(data: DataSet, first: SceneFiles, formats: Sequence[str]) -> None:
    """Refuse several splits, and formats that are unknown, stored already, or need what `first`, a sensor's first scene, lacks."""
    found = _found(data)
    if len(found.splits) > 1:
        raise ConfigError(f"{data.folder} has the splits {', '.join(found.splits)}; choose one by --split")
    bop = dataclasses.replace(load_config().bop, coco=False)
    # Of formats of other packages, only those asked for are loaded.
    contents = {name: set(contents_of(name, bop)) for name in convertible() if name in FORMAT_TABLE or name in formats}
    for name in formats:
        if name not in contents:
            raise ConfigError(f"--to names {name}; allowed: {', '.join(each for each in contents if contents[each] <= _IMAGES)}")
        if not contents[name] <= _IMAGES:
            raise ConfigError(f"--to names {name}, which is made of trajectories; {data.folder} is from another source and has none")
        if (name == "bop" and isinstance(first, SceneFolder)) or (name == "shards" and first.place.suffix == ".tar"):
            raise ConfigError(f"--to names {name}, which {data.folder} has already; copy the folder")
        (kind,) = load_exporter_classes([name])
        masks = _NEEDS_OF_MASKS if found.layout.model_files == {} or not first.has("camera") else {}
        needs = _NEEDS | (masks if "masks" in contents[name] else {}) | (_NEEDS_OF_DEPTH if kind.writes_depth else {})
        for part, what in needs.items():
            if not first.has(part):
                raise ConfigError(f"--to names {name}, but {first.place} has no {what}, which it needs")
        if name in _WITH_INFO and not (first.has("gt_info") or _has_masks(first)):
            raise ConfigError(f"--to names {name}, but {first.place} has neither scene_gt_info.json nor amodal masks, of which it is made")


def _has_masks(scene: SceneFiles) -> bool:
    """Whether a scene has both amodal and visible masks."""
    return scene.has("mask") and scene.has("mask_visib")


def _make_settings(data: DataSet, firsts: Sequence[SceneFiles], formats: Sequence[str]) -> ExportSettings:
    """Settings by which exporters name and lay out files, with a camera for each sensor (`firsts`: their first scenes). The result does not
    contain them. Mode move has no picks; SPLIT_web is BOP's name of a split in shards."""
    base, masks = load_config(), all(map(_has_masks, firsts))
    suffixes = {first.image_file("rgb", first.frames()[0])[0] for first in firsts}
    config = dataclasses.replace(
        base,
        bake=dataclasses.replace(base.bake, formats=tuple(formats), mode="move"),
        bop=dataclasses.replace(
            base.bop,
            split=_found(data).splits[0].removesuffix("_web"),
            masks=masks,
            coco="bop" in formats and masks,
            keypoints=0,
            color_format="jpg" if suffixes <= {".jpg", ".jpeg"} else "png",
        ),
        cameras=dataclasses.replace(
            base.cameras, positions=len(firsts) * base.cameras.positions[:1], ups=len(firsts) * base.cameras.ups[:1]
        ),
        splits=(),
        render=dataclasses.replace(base.render, layers=()),
    )
    settings = ExportSettings.of(config)
    sizes = (first.image_size(first.frames()[0]) for first in firsts)
    rows = tuple(dataclasses.replace(row, resolution=size) for row, size in zip(settings.rig.rows, sizes, strict=True))
    return dataclasses.replace(settings, rig=dataclasses.replace(settings.rig, rows=rows))


def _write(data: DataSet, work: Path, settings: ExportSettings, processes: int, report: Report, remark: str) -> int:
    """Write a data set into a new folder, with a remark in its notes; returns the number of scenes."""
    classes = load_exporter_classes(settings.bake.formats)
    scenes = [_found(data).scene(index) for index in data]
    done: list[int] = []

    def commit(scene: int) -> None:
        done.append(scene)
        report("scenes", len(done), len(scenes))

    (work / PARTIAL).mkdir()
    with WriterPool(processes or count_cores(), 0) as pool:
        context = _Context(data, work, settings, pool)
        exporters = Exporters(classes, context)
        exporters.write_constants()
        for (index, episode), scene in zip(data.items(), scenes, strict=True):
            images = tuple(episode.image_ids)
            suffix, sizes = f".{settings.bop.color_format}", settings.rig.sizes
            stored = [
                StoredSceneFiles(
                    data.scene_files(index, camera),
                    data.scene_id(index, camera),
                    images,
                    partial(ForeignViewFiles, suffix=suffix, size=size, root=data.folder),
                )
                for camera, size in enumerate(sizes)
            ]
            exporters.write_stored(scene, stored)
            end = EpisodeEnd(scene, 0, len(images), int(Ending.FINISHED), image_ids=images)
            exporters.end_episode(end, lambda scene=scene: commit(scene))
        pool.wait()
        exporters.close()
        finalize(classes, work, settings, pool, sorted(done))
    shutil.rmtree(work / PARTIAL)
    for name in _BAKED:
        (work / name).unlink(missing_ok=True)
    listing = _found(data).layout.listing
    for name in sorted(
        name for name in listing.files if _CAMERA.fullmatch(name) or ("bop" in settings.bake.formats and TARGETS.fullmatch(name))
    ):
        (work / name).write_bytes(listing.read(name, MAX_IMAGE_FILE))
    sensors = _found(data).sensors
    ids = (
        f"; those of scene s and its sensors {', '.join(sensors)} are {len(sensors)} s and following"
        if len(sensors) > 1
        else " with their own ids"
    )
    text = f"Converted by synpick-warp from the BOP data set {data.folder.resolve().name}: {len(scenes):,} scenes{ids}.\n"
    text += f"{remark}\n" if remark else ""
    write_atomically(work / NOTES_FILE, text.encode())
    return len(scenes)


AHEAD = 2
"""Episodes in work for each process: enough to keep all busy, few enough to need little memory and disk space."""


class Converted(NamedTuple):
    """Result of a conversion: numbers of episodes of the converted data set and of those that earlier runs had converted, and a remark."""

    episodes: int
    resumed: int
    remark: str = ""
    """What was made that the source does not have."""


def convert(folder: Path, out: Path, formats: Sequence[str], processes: int, report: Report, split: str | None = None) -> Converted:
    """Convert the committed episodes of a data set to other formats, into a data set of its own; the scenes of one from another source. As
    `synpick_warp.convert`, whose errors are ConfigError if a format cannot be converted to, or `out` was started with other settings,
    DatasetError if the source is no data set, is damaged, or lacks what a format needs, and OutputError if a file cannot be written."""
    data = open_data_set(folder)
    if data.found is not None:
        _check_apart(folder, out)
        count, remark = convert_foreign(data if split is None else data.split(split), out, formats, processes, report)
        return Converted(count, 0, remark)
    if split is not None:
        raise ConfigError("--split is for data sets from other sources; those of synpick-warp bake are converted as a whole")
    source = ConversionSource(folder)
    check_formats(formats, source.config.bop.layout, source.config.bake.formats, folder)
    contents: set[Content] = {content for name in formats for content in contents_of(name, source.config.bop)}
    source.check_contents(contents)
    _check_apart(folder, out)
    config = source.config.with_values({"bake.formats": tuple(formats)})
    classes = load_exporter_classes(formats)
    with OutputFolder(out, config, source.episodes) as output:
        resumed = len(output.committed)
        if output.is_finished:
            return Converted(resumed, resumed)
        with WriterPool(processes or count_cores(), 0, output.lock) as pool:
            settings = ExportSettings.of(config)
            exporters = Exporters(classes, StoredContext(source, out, settings, pool))
            output.prepare(exporters, source.inputs, pool)
            _convert_episodes(source, output, exporters, pool, contents, report)
            pool.wait()
            exporters.close()
            finalize_data_set(out, settings, classes, pool)
    return Converted(len(source.episodes), resumed)


def _convert_episodes(
    source: ConversionSource, output: OutputFolder, exporters: Exporters, pool: WriterPool, contents: Collection[Content], report: Report
) -> None:
    """Pass what formats are made of, the views and ticks of all remaining episodes, to their exporters."""
    total, working = len(output.episodes), [0]
    done = [len(output.committed)]
    limit = AHEAD * max(1, len(pool.pids()))

    def commit(end: EpisodeEnd) -> None:
        commit_episode(output.out, exporters, pool, end)
        working[0] -= 1
        done[0] += 1
        report("episodes", done[0], total)

    for index in output.remaining:
        pool.wait_until(lambda: working[0] < limit)
        end = source.episode_end(index)
        working[0] += 1
        if Ending(end.ending).delivers:
            if "views" in contents:
                exporters.write_stored(index, source.scenes(end))
                if (picks := source.picks(index)) is not None:
                    exporters.write_picks(picks)
            for batch in source.ticks(end) if "poses" in contents else ():
                exporters.write_ticks(batch)
        exporters.end_episode(end, partial(commit, end))


def check_formats(names: Sequence[str], layout: str, present: Collection[str], folder: Path) -> None:
    """Raise ConfigError unless a data set with this `bop.layout` and the formats `present` can be converted to formats of these names: they
    are known, follow from others, and are not there already."""
    if layout != CLASSIC:
        raise ConfigError(f'{folder} has bop.layout = "{layout}", which convert does not read; bake the other formats')
    for name in names:
        if name not in convertible() or find_format(name).sources is None:
            why = f"; no other format has the physics of {name}" if name in format_names() else ""
            raise ConfigError(f"--to names {name}; allowed: {', '.join(convertible())}{why}")
        if name in present:
            raise ConfigError(f"--to names {name}, which {folder} has already; copy the folder")


def _check_apart(folder: Path, out: Path) -> None:
    """Raise DatasetError if the data set and the output folder are the same, or one lies in the other."""
    try:
        source, target = folder.resolve(), out.resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise DatasetError(f"the data set or --out cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if target.is_relative_to(source) or source.is_relative_to(target):
        raise DatasetError(f"--out is {out}, which is, holds or lies in {folder}; name a folder outside of it")
