"""The contract of all exporters: views and ticks in, whole episodes on disk out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

from synpick_warp.configs.schema import Config
from synpick_warp.exporters.writing.pool import WriterPool, shared_bytes
from synpick_warp.frames import EpisodeEnd, FrameBatch, TickBatch
from synpick_warp.scenes.types import Camera, Catalog, EnvironmentMap

PIXEL_BYTES = (3, 2, 1, 4)
"""Of `FrameBatch`'s color, depth, instance and amodal."""
LAYER_BYTES = 12
"""Of a pixel of the largest layer."""


@dataclass(frozen=True, eq=False)
class ExportContext:
    """What every exporter of a bake is given."""

    out: Path
    """Folder of the data set; it exists, and `PARTIAL` in it."""
    config: Config
    catalog: Catalog
    cameras: tuple[Camera, ...]
    lights: tuple[EnvironmentMap, ...]
    pool: WriterPool
    """Writes all files of episodes. An exporter neither closes nor aborts it."""


class Exporter(Protocol):
    """Takes every view and every tick of a bake. Calls come from one thread; each may raise `OutputError` for what failed since the last.

    What an exporter writes depends on settings, episode number and frames alone: not on the time, the machine, the order in which
    episodes end, or the number of worlds and writers. Files of an episode grow in `PARTIAL`, in a folder that is new for each
    arrangement, and are renamed to their place when they are whole: a bake may be killed at any time, and is then resumed by others.
    No folder is made with its parents: if somebody removes the data set, the bake must fail.
    """

    records: ClassVar[bool]
    """Whether ticks must come with their arrays `tick` and `steps`."""
    views: ClassVar[bool]
    """Whether there must be views; where no exporter asks for any, none are rendered."""

    def __init__(self, context: ExportContext) -> None:
        """Writes nothing yet."""
        ...

    @staticmethod
    def slot_bytes(config: Config) -> int:
        """Most room that the images of one task take in the pool's shared memory [B]."""
        ...

    @staticmethod
    def finalize(out: Path, config: Config, pool: WriterPool) -> list[Path]:
        """Write the lists that span episodes, from the whole episodes that are there, and wait for them.

        Returns:
            These files, relative to the data set.
        """
        ...

    def write_constants(self) -> list[Path]:
        """Write what the data set says once, such as models, in place of what may be there of a killed bake.

        Called at most once, before all that follows. Needs no rename: the bake notes when all constants are there.

        Returns:
            These files, or folders of nothing else, relative to the data set.
        """
        ...

    def write_views(self, batch: FrameBatch) -> None:
        """Take views; copies what it needs. Waits while the writers are behind.

        The frames of an episode come in order, all before its end.
        """
        ...

    def write_ticks(self, batch: TickBatch) -> None:
        """Take the frames of a tick; copies what it needs. Waits while the writers are behind.

        The frames of an episode come in order, all before its end; whether a frame's views come before is open.
        """
        ...

    def end_episode(self, end: EpisodeEnd, whole: Callable[[], None]) -> None:
        """Finish the episode's files, or drop them if its ending delivers nothing: it may then come again from frame 0.

        Args:
            whole: To be called once, now or from a later call of the pool, when all is in its place or has been dropped.
        """
        ...

    def files(self, episode: int) -> list[Path]:
        """Files and folders in their place that hold the episode and nothing else, relative to the data set, sorted.

        Those that are there: none, some (left by a killed bake) or all. Looks at nothing but names.
        """
        ...

    def close(self) -> None:
        """All episodes that ended are whole, and the pool has nothing to do: let go of what is left."""
        ...

    def abort(self) -> None:
        """Stop at once; the pool has been ended, and others remove what is not whole. Never raises."""
        ...


def view_bytes(config: Config) -> int:
    """Room that a view's images, or one of its layers, take at most in the pool's shared memory [B]."""
    width, height = config.cameras.resolution
    layer = (height * width * LAYER_BYTES,) if config.render.layers else ()
    return max(shared_bytes(height * width * size for size in PIXEL_BYTES), shared_bytes(layer))
