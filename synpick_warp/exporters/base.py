"""Interface of all dataset writers: views and ticks of a bake or of a stored data set in, committed episodes on disk out; and
staging: what all exporters do with an episode's files until it is committed or discarded."""

import dataclasses
import os
import re
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from synpick_warp.codes import Ending
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.exporters.writing.files import PARTIAL, Buffer, output_errors
from synpick_warp.exporters.writing.pool import WriterPool, WriteTask
from synpick_warp.exporters.writing.rle import Masks
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import Camera, Catalog, EnvironmentMap
from synpick_warp.system.codecs.depth_png import max_data_bytes
from synpick_warp.system.processes.shared_memory import shared_bytes
from synpick_warp.views.frames import WORD_BYTES, EpisodeEnd, FrameBatch, TickBatch, most_words
from synpick_warp.views.picks import PickBatch

PIXEL_BYTES = (3, 2, 1)
"""Bytes of a pixel of `FrameBatch`'s color, depth and instance."""
LAYER_BYTES = 12
"""Bytes of a pixel of the largest layer."""


class ExportContext:
    """Constructor argument of every exporter: output folder, settings, scene assets and the writer pool.

    This is the context of a bake; that of a conversion loads objects and lights when a format asks for them.
    """

    def __init__(
        self,
        out: Path,
        settings: ExportSettings,
        catalog: Catalog,
        cameras: tuple[Camera, ...],
        lights: tuple[EnvironmentMap, ...],
        pool: WriterPool,
        looks: Looks | None = None,
    ) -> None:
        """Context of a folder `out` that exists and contains the folder `PARTIAL`. The pool writes all files of episodes; exporters neither
        close nor abort it. `looks`: what episodes draw their looks from; None: nothing."""
        self.out, self.settings, self.cameras, self.pool = out, settings, cameras, pool
        self.layout = settings.layout
        self._catalog, self._lights, self._looks = catalog, lights, looks

    @property
    def catalog(self) -> Catalog:
        """Objects of the data set: meshes, materials, mass properties."""
        return self._catalog

    @property
    def lights(self) -> tuple[EnvironmentMap, ...]:
        """Environment maps of the data set."""
        return self._lights

    @property
    def looks(self) -> Looks | None:
        """What episodes draw their looks from, with textures; None: nothing."""
        return self._looks

    @cached_property
    def names(self) -> dict[int, str]:
        """obj_id -> name of all objects, in this order."""
        return {entry.obj_id: entry.name for entry in self.catalog.entries}

    def copy_constants(self, names: tuple[Path, ...]) -> bool:
        """Copy the files of these names, or those in folders, from the data set that is converted; returns whether there is one."""
        return False


class EncodedView(Protocol):
    """One view as files hold it. Each part is encoded, or read, when it is first used: in the process that writes it."""

    @property
    def scene(self) -> int:
        """BOP scene_id of the view."""
        ...

    @property
    def frame(self) -> int:
        """BOP im_id: index of the frame in its episode."""
        ...

    @property
    def color(self) -> tuple[str, Buffer]:
        """Suffix and content of the colour image's file."""
        ...

    @property
    def depth(self) -> Buffer:
        """PNG file of the depth image, 16 bits in counts."""
        ...

    def depth_image(self) -> np.ndarray:
        """Depth image, in units of `depth_scale` mm; 0: no surface (H, W) uint16."""
        ...

    @property
    def camera(self) -> dict[str, Any]:
        """Entry of the view in scene_camera.json."""
        ...

    @property
    def gt(self) -> list[dict[str, Any]]:
        """Entry in scene_gt.json: one per instance, with the keys of README.md; in sets of others `instance_id` may be missing."""
        ...

    @property
    def gt_info(self) -> list[dict[str, Any]]:
        """Entry in scene_gt_info.json: one per instance, in the same order; in sets of others `visib_fract` may be NaN."""
        ...

    @property
    def graph(self) -> dict[str, Any] | None:
        """Entry in scene_graph.json, if it is stored; None: it is to be made."""
        ...

    def masks(self) -> list[Masks]:
        """Run lengths of the amodal and visible mask of each instance, in the order of `gt`."""
        ...


class StoredView(EncodedView, Protocol):
    """Encoded view of a data set that is converted: also gives the decoded colour image, and layers as PNG files."""

    def color_image(self) -> np.ndarray:
        """Colour image, sRGB, RGB order (H, W, 3) uint8."""
        ...

    def layer(self, name: str) -> Buffer:
        """PNG file of a layer, by its name."""
        ...


class StoredScene(Protocol):
    """All views of one camera in an episode that is converted. Small when pickled; files are read by the task that asks for views."""

    @property
    def frames(self) -> int:
        """Number of frames of the scene."""
        ...

    def views(self, frames: range) -> Iterator[StoredView]:
        """Views of these frames (indices), in order."""
        ...


class SharedFiles(NamedTuple):
    """Names that a format gives to what it writes beside episodes, relative to the data set.

    They follow from the settings: a bake that removes partial files takes the names from here and from `Exporter.files`, never from lists
    in the data set, which may have been edited.
    """

    constants: tuple[Path, ...] = ()
    """Files that all episodes share, or folders that hold nothing else."""
    indices: tuple[Path, ...] = ()
    """Files that span episodes."""
    folders: tuple[Path, ...] = ()
    """Folders that hold episodes or constants, each after the folders within it. A last part that ends in `*` stands for all folders whose
    names go on with a number: how many there are may follow from the number of episodes, which a file of settings can overstate."""


def list_folders(out: Path, folders: Iterable[Path]) -> list[Path]:
    """Names of `SharedFiles.folders`; in place of one with `*`, those that exist in the data set."""
    found: list[Path] = []
    for name in folders:
        if not name.name.endswith("*"):
            found.append(name)
            continue
        numbered = re.compile(re.escape(name.name.removesuffix("*")) + "[0-9]+").fullmatch
        found += sorted(path.relative_to(out) for path in (out / name.parent).glob(name.name) if numbered(path.name))
    return found


class Exporter(ABC):
    """Dataset writer of one format. It receives every view and tick of a bake; what a format does not override, it does not read or write.

    All calls come from one thread. Each may raise `OutputError` for a write that has failed since the previous call.

    Determinism: the output depends on settings, episode index and frames only, not on time, machine, the order in which episodes end,
    or the number of worlds and writers.

    Atomicity: an episode's files are staged in `PARTIAL`, in a folder that is new for every arrangement, and renamed to their final
    place when they are complete. So a bake can be killed at any time and resumed by another process. Folders are created without
    their parents (no `parents=True`): if the data set is removed during a bake, the bake must fail.
    """

    needs_physics: ClassVar[bool] = False
    """Whether tick batches must carry the arrays `tick` and `steps`."""
    needs_views: ClassVar[bool] = False
    """Whether views must be rendered; if no exporter needs them, none are."""
    needs_images: ClassVar[bool] = False
    """Whether it reads all images of a batch; else only those that neither encoded files nor run boundaries replace."""
    writes_depth: ClassVar[bool] = False
    """Whether it writes depth files, `FrameBatch.depth_idat`."""

    def __init__(self, context: ExportContext) -> None:
        """Writes nothing yet."""
        self._context = context

    @staticmethod
    def slot_bytes(settings: ExportSettings) -> int:
        """Maximum size of the images of one task in the pool's shared memory [B]; 0: tasks have none."""
        return 0

    @staticmethod
    @abstractmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        """Names of constants, indices and folders, from the settings alone; no file is looked at."""

    @staticmethod
    def finalize(out: Path, settings: ExportSettings, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
        """Write the index files that span the committed episodes, sorted, and wait for them; returns these files, relative to the data set.

        Episodes that were given up have no files. Files of others, which nobody committed, are in no index.
        """
        return []

    @staticmethod
    def index_lines(out: Path, settings: ExportSettings, names: Sequence[str]) -> Iterator[tuple[str, bytes]]:
        """Yield the lines that a committed episode adds to index files, (path relative to LINES, complete lines), by the names of its files
        of all formats, relative to `out`; `finalize` concatenates them where `out` has the folder LINES.

        Lines of the same path are appended to one file, in order of the episodes.
        """
        return iter(())

    @abstractmethod
    def write_constants(self) -> list[Path]:
        """Write the files that all episodes share, such as models; replaces what a killed bake may have left. Returns these files, or
        folders that hold nothing else, relative to the data set.

        Called at most once, before all other calls. Needs no atomic rename: the bake commits them with a manifest entry. Formats of views
        without BOP's notes write those of `writing/notes.py`.
        """

    def write_views(self, batch: FrameBatch) -> None:
        """Enqueue views; copies what it keeps. Blocks while the writers are behind (back-pressure).

        An episode's frames come in order, all before its end.
        """

    def write_stored(self, episode: int, scenes: Sequence[StoredScene]) -> None:
        """Enqueue all views of an episode of a data set that is converted, the scene of each camera, in place of `write_views`.

        Files are those of a bake: images are copied where the format holds such, and annotations written as a bake writes them.
        """

    def write_ticks(self, batch: TickBatch) -> None:
        """Enqueue the frames of a tick; copies what it keeps. Blocks while the writers are behind (back-pressure).

        An episode's frames come in order, all before its end. They may come before or after the views of the same frame.
        """

    def write_picks(self, batch: PickBatch) -> None:
        """Enqueue the grasp trials of states of an episode, before its end; states may come in any order, each once."""

    @abstractmethod
    def end_episode(self, end: EpisodeEnd, on_committed: Callable[[], None]) -> None:
        """Complete and commit the episode's files, or discard them if its ending delivers nothing; it may then restart at frame 0.

        `on_committed` is called exactly once, now or by a later call of the pool, when all files are committed or discarded.
        """

    @abstractmethod
    def files(self, episode: int) -> list[Path]:
        """List the committed files and folders that hold this episode and nothing else, relative to the data set, sorted.

        They may be none, some (left by a killed bake) or all. Looks at names only.
        """

    @abstractmethod
    def close(self) -> None:
        """Release resources after success: all ended episodes are committed, and the pool is idle."""

    @abstractmethod
    def abort(self) -> None:
        """Release resources after an error. The pool has been aborted, and the bake removes partial files. Never raises."""


def view_bytes(resolution: tuple[int, int], objects: int, has_layers: bool) -> int:
    """Maximum size of a view's images, or of one of its layers, in the pool's shared memory [B]; `objects`: most of an episode."""
    width, height = resolution
    layer = (height * width * LAYER_BYTES,) if has_layers else ()
    color, depth, instance = (height * width * size for size in PIXEL_BYTES)
    masks = objects * most_words(width, height) * WORD_BYTES
    return max(shared_bytes((color, max(depth, max_data_bytes(width, height)), instance, masks)), shared_bytes(layer))


_Content = TypeVar("_Content")


@dataclass(eq=False)
class StagedEpisode(Generic[_Content]):
    """Arrangement of an episode whose files are being written."""

    index: int
    folder: Path
    """Staging folder, of this arrangement only."""
    content: _Content
    """What the format keeps of it."""
    pending: int = 0
    """Number of unfinished tasks."""
    end: EpisodeEnd | None = None
    """None: it is still running."""
    on_committed: Callable[[], None] | None = None
    """Set together with `end`."""

    @property
    def delivers(self) -> bool:
        """Whether the episode has ended and becomes part of the data set."""
        return self.end is not None and Ending(self.end.ending).delivers


class EpisodeExporter(Exporter, Generic[_Content]):
    """`Exporter` that stages: each arrangement of an episode has a staging folder, which one task commits after all others are done.

    A format makes its content of an episode (`_staged`), counts the tasks that write to its folder (`_task`), names the task that commits
    it (`_commit`), and the places of its files (`places`).
    """

    staging: ClassVar[str]
    """Name of the format's folder in `PARTIAL`."""

    def __init__(self, context: ExportContext) -> None:
        super().__init__(context)
        self._staging = context.out / PARTIAL / self.staging
        self._episodes: dict[int, StagedEpisode[_Content]] = {}
        self._arrangements = 0

    @abstractmethod
    def _commit(self, episode: StagedEpisode[_Content], end: EpisodeEnd) -> WriteTask:
        """Task that completes an episode and renames its files to their places; the staging folder is removed after it."""

    def _finish(self, episode: StagedEpisode[_Content], end: EpisodeEnd) -> None:
        """Submit the tasks that wait for the end of an episode."""

    def end_episode(self, end: EpisodeEnd, on_committed: Callable[[], None]) -> None:
        """Commit or discard an episode once all its tasks are done; at once if nothing was staged of it. See `Exporter`."""
        episode = self._episodes.pop(end.episode, None)
        if episode is None:
            on_committed()
        else:
            episode.end, episode.on_committed = end, on_committed
            episode.pending += 1
            if episode.delivers:
                self._finish(episode, end)
            self._task_done((episode,), None)
        self._context.pool.poll()

    @abstractmethod
    def places(self, episode: int) -> Iterable[Path]:
        """Files and folders that hold an episode and nothing else, relative to the data set, whether they are there or not."""

    def files(self, episode: int) -> list[Path]:
        """Those of `places` that exist. See `Exporter`."""
        return sorted(place for place in set(self.places(episode)) if os.path.lexists(self._context.out / place))

    def close(self) -> None:
        """Forget all episodes in progress; their staged files remain. See `Exporter`."""
        self._episodes.clear()

    abort = close

    def _staged(self, index: int, make_content: Callable[[Path], _Content]) -> StagedEpisode[_Content]:
        """Current arrangement of an episode; a new one gets a staging folder, and its content by `make_content` of that folder."""
        episode = self._episodes.get(index)
        if episode is None:
            # A suffix unique to each arrangement: the discarded one's folder may not be removed yet.
            self._arrangements += 1
            folder = self._staging / f"{index:06d}-{self._arrangements}"
            with output_errors(folder):
                self._staging.mkdir(exist_ok=True)
                folder.mkdir()
                episode = self._episodes[index] = StagedEpisode(index, folder, make_content(folder))
        return episode

    def _task(
        self,
        episodes: Sequence[StagedEpisode[_Content]],
        function: Callable[..., None],
        images: Sequence[np.ndarray],
        arguments: tuple[Any, ...],
        path: Path,
        then: Callable[[], None] | None = None,
        affinity: int | None = None,
    ) -> WriteTask:
        """A task that writes to the staging folders of episodes, which are committed after it; `then` runs first, and may submit others."""
        for episode in episodes:
            episode.pending += 1
        return WriteTask(function, images, arguments, path, partial(self._task_done, episodes, then), affinity)

    def _task_done(self, episodes: Sequence[StagedEpisode[_Content]], then: Callable[[], None] | None) -> None:
        """Count a finished task of these episodes, after calling `then`; commits or discards those that have ended and wait for none."""
        if then is not None:
            then()
        for episode in episodes:
            episode.pending -= 1
            if episode.end is not None and not episode.pending:
                self._commit_or_discard(episode, episode.end)

    def _commit_or_discard(self, episode: StagedEpisode[_Content], end: EpisodeEnd) -> None:
        if episode.delivers:
            task = self._commit(episode, end)
            task = dataclasses.replace(task, function=commit_staged, arguments=(episode.folder, task.function, *task.arguments))
        else:
            task = WriteTask(shutil.rmtree, (), (episode.folder,), episode.folder)
        self._context.pool.submit_all((dataclasses.replace(task, on_done=episode.on_committed),))


def commit_staged(folder: Path, commit: Callable[..., None], *arguments: Any) -> None:
    """Task: commit an episode, and remove its staging folder."""
    commit(*arguments)
    shutil.rmtree(folder)
