"""Interface of all dataset writers: view and tick batches in, committed episodes on disk out."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple, Protocol

from synpick_warp.codecs.depth_png import max_data_bytes
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.frames import EpisodeEnd, FrameBatch, TickBatch
from synpick_warp.scenes.types import Camera, Catalog, EnvironmentMap
from synpick_warp.system.shared_memory import shared_bytes

PIXEL_BYTES = (3, 2, 1, 4)
"""Bytes of a pixel of `FrameBatch`'s color, depth, instance and amodal."""
LAYER_BYTES = 12
"""Bytes of a pixel of the largest layer."""


@dataclass(frozen=True, eq=False)
class ExportContext:
    """Constructor argument of every exporter: output folder, settings, scene assets and the writer pool."""

    out: Path
    """Folder of the data set. It exists and contains the folder `PARTIAL`."""
    config: Config
    catalog: Catalog
    cameras: tuple[Camera, ...]
    lights: tuple[EnvironmentMap, ...]
    pool: WriterPool
    """Writes all files of episodes. Exporters neither close nor abort it."""


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


class Exporter(Protocol):
    """Dataset writer of one format. It receives every view and tick of a bake.

    All calls come from one thread. Each may raise `OutputError` for a write that has failed since the previous call.

    Determinism: the output depends on settings, episode index and frames only, not on time, machine, the order in which episodes end,
    or the number of worlds and writers.

    Atomicity: an episode's files are staged in `PARTIAL`, in a folder that is new for every arrangement, and renamed to their final
    place when they are complete. So a bake can be killed at any time and resumed by another process. Folders are created without
    their parents (no `parents=True`): if the data set is removed during a bake, the bake must fail.
    """

    needs_physics: ClassVar[bool]
    """Whether tick batches must carry the arrays `tick` and `steps`."""
    needs_views: ClassVar[bool]
    """Whether views must be rendered; if no exporter needs them, none are."""

    needs_images: ClassVar[bool]
    """Whether it reads all images of a batch; else only those that neither encoded files nor run boundaries replace."""
    writes_depth: ClassVar[bool]
    """Whether it writes depth files, `FrameBatch.depth_idat`."""

    def __init__(self, context: ExportContext) -> None:
        """Writes nothing yet."""
        ...

    @staticmethod
    def slot_bytes(config: Config) -> int:
        """Maximum size of the images of one task in the pool's shared memory [B]."""
        ...

    @staticmethod
    def shared_files(config: Config) -> SharedFiles:
        """Names of constants, indices and folders. Looks at nothing."""
        ...

    @staticmethod
    def finalize(out: Path, config: Config, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
        """Write the index files that span episodes, and wait for them.

        Args:
            out: Folder of the data set.
            config: Its settings.
            pool: Writer processes.
            episodes: The committed episodes, sorted; those that were given up have no files. Files of others, which nobody committed, are
                in no index.

        Returns:
            These files, relative to the data set.
        """
        ...

    def write_constants(self) -> list[Path]:
        """Write the files that all episodes share, such as models; replaces what a killed bake may have left.

        Called at most once, before all other calls. Needs no atomic rename: the bake commits them with a manifest entry.

        Returns:
            These files, or folders that hold nothing else, relative to the data set.
        """
        ...

    def write_views(self, batch: FrameBatch) -> None:
        """Enqueue views; copies what it keeps. Blocks while the writers are behind (back-pressure).

        An episode's frames come in order, all before its end.
        """
        ...

    def write_ticks(self, batch: TickBatch) -> None:
        """Enqueue the frames of a tick; copies what it keeps. Blocks while the writers are behind (back-pressure).

        An episode's frames come in order, all before its end. They may come before or after the views of the same frame.
        """
        ...

    def end_episode(self, end: EpisodeEnd, on_committed: Callable[[], None]) -> None:
        """Complete and commit the episode's files, or discard them if its ending delivers nothing; it may then restart at frame 0.

        Args:
            end: Result of the episode.
            on_committed: Callback; called exactly once, now or by a later call of the pool, when all files are committed or discarded.
        """
        ...

    def files(self, episode: int) -> list[Path]:
        """List the committed files and folders that hold this episode and nothing else, relative to the data set, sorted.

        They may be none, some (left by a killed bake) or all. Looks at names only.
        """
        ...

    def close(self) -> None:
        """Release resources after success: all ended episodes are committed, and the pool is idle."""
        ...

    def abort(self) -> None:
        """Release resources after an error. The pool has been aborted, and the bake removes partial files. Never raises."""
        ...


def view_bytes(resolution: tuple[int, int], has_layers: bool) -> int:
    """Maximum size of a view's images, or of one of its layers, in the pool's shared memory [B].

    Args:
        resolution: Width and height [px].
        has_layers: Whether layers are rendered.
    """
    width, height = resolution
    layer = (height * width * LAYER_BYTES,) if has_layers else ()
    color, depth, *sources = (height * width * size for size in PIXEL_BYTES)
    return max(shared_bytes((color, max(depth, max_data_bytes(width, height)), *sources)), shared_bytes(layer))
