"""Registry of dataset formats, and all exporters of a bake as one.

How to add a format:

1. Write a class that implements `Exporter` (`base.py`) in a module or subpackage of this package. Write episodes' files through the
   writer pool, stage them in `PARTIAL`, and commit them by rename; `usd/exporter.py` is the shortest example.
2. Add a line to EXPORTERS: the format's name, the module and the class.
3. Allow the name as a value of the setting `bake.formats`: `FORMATS` in configs/schema.py. Settings must not import exporters, so
   the name stands there once more; a test compares both.
4. Add the names of its files to `dataset/file_names.py`: `merge`, `convert` and `verify` take no others.
5. Let its test class inherit `ExporterContract` (tests/harness/exporter_contract.py): determinism, atomic commits, resuming.

That makes a format that is baked. For `convert`, it also needs a converter in `CONVERTERS` (conversion/converters.py); packages of its own
stand in `FORMAT_PACKAGES` (dataset/manifest.py) and in `_EXTRAS` here; views are read from it where `dataset/scene_index.py` finds them.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError
from synpick_warp.exporters.base import ExportContext, Exporter, SharedFiles
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.frames import EpisodeEnd, FrameBatch, TickBatch

EXPORTERS = {
    "bop": ("bop.exporter", "BopExporter"),
    "shards": ("bop.shards.exporter", "ShardsExporter"),
    "usd": ("usd.exporter", "UsdExporter"),
    "zarr": ("trajectory.exporter", "TrajectoryExporter"),
    "lerobot": ("lerobot.exporter", "LerobotExporter"),
    "coco": ("bop.coco.exporter", "CocoExporter"),
}
"""Format -> (module in this package, class in it). Modules are imported when their format is used."""

_EXTRAS = {"lerobot": "install it by pip install 'synpick-warp[lerobot]'"}
"""Formats that need packages which a plain installation lacks, and how to get them."""


def load_exporter_classes(names: Iterable[str]) -> tuple[type[Exporter], ...]:
    """Import the classes that write these formats, each once, in the order of EXPORTERS.

    Raises:
        ConfigError: A format's module, or a package that it needs, is not installed.
    """
    wanted = set(names)
    return tuple(_load(name) for name in EXPORTERS if name in wanted)


def _load(name: str) -> type[Exporter]:
    module, class_name = EXPORTERS[name]
    try:
        return getattr(importlib.import_module(f"{__package__}.{module}"), class_name)
    except ImportError as error:
        raise ConfigError(
            f"bake.formats names {name}, but its writer cannot be loaded: {error}; {_EXTRAS.get(name, 'name other formats')}"
        ) from None


class Exporters:
    """Composite of all exporters of a bake; see `Exporter` for its methods."""

    def __init__(self, classes: Iterable[type[Exporter]], context: ExportContext) -> None:
        self._all = tuple(exporter_class(context) for exporter_class in classes)
        self.needs_physics = any(exporter.needs_physics for exporter in self._all)
        self.needs_views = any(exporter.needs_views for exporter in self._all)

    def write_constants(self) -> list[Path]:
        """See `Exporter`. Formats may share files, which are then identical."""
        return list(dict.fromkeys(path for exporter in self._all for path in exporter.write_constants()))

    def write_views(self, batch: FrameBatch) -> None:
        """See `Exporter`."""
        for exporter in self._all:
            exporter.write_views(batch)

    def write_ticks(self, batch: TickBatch) -> None:
        """See `Exporter`."""
        for exporter in self._all:
            exporter.write_ticks(batch)

    def end_episode(self, end: EpisodeEnd, on_committed: Callable[[], None]) -> None:
        """See `Exporter`; `on_committed` is called when the last exporter has committed the episode."""
        pending = [len(self._all)]

        def count_down() -> None:
            pending[0] -= 1
            if pending[0] == 0:
                on_committed()

        for exporter in self._all:
            exporter.end_episode(end, count_down)

    def shared_files(self, config: Config) -> SharedFiles:
        """See `Exporter`."""
        return shared_files(map(type, self._all), config)

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`."""
        return sorted(path for exporter in self._all for path in exporter.files(episode))

    def close(self) -> None:
        """See `Exporter`."""
        for exporter in self._all:
            exporter.close()

    def abort(self) -> None:
        """See `Exporter`."""
        for exporter in self._all:
            exporter.abort()


@contextlib.contextmanager
def aborting(pool: WriterPool, exporters: Exporters) -> Iterator[None]:
    """End writers and exporters after an error."""
    try:
        yield
    except BaseException:
        pool.abort()
        exporters.abort()
        raise


def slot_bytes(classes: Iterable[type[Exporter]], config: Config) -> int:
    """Maximum size of the images of any task in the pool's shared memory [B]."""
    return max(exporter_class.slot_bytes(config) for exporter_class in classes)


def shared_files(classes: Iterable[type[Exporter]], config: Config) -> SharedFiles:
    """Names of constants, indices and folders of every format, each once."""
    all_names = [exporter_class.shared_files(config) for exporter_class in classes]
    constants, indices, folders = (
        tuple(dict.fromkeys(name for names in group for name in names)) for group in zip(*all_names, strict=True)
    )
    return SharedFiles(constants, indices, folders)


def finalize(classes: Iterable[type[Exporter]], out: Path, config: Config, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
    """Write the index files over the committed episodes, of every format; returns them, relative to the data set."""
    return sorted(path for exporter_class in classes for path in exporter_class.finalize(out, config, pool, episodes))
