"""Exporters of the formats in `formats.FORMAT_TABLE`, and all exporters of a bake as one."""

import contextlib
import importlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError
from synpick_warp.exporters.base import ExportContext, Exporter, SharedFiles, StoredScene
from synpick_warp.exporters.formats import find_format, format_names
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.views.frames import EpisodeEnd, FrameBatch, TickBatch
from synpick_warp.views.picks import PickBatch


def load_exporter_classes(names: Iterable[str]) -> tuple[type[Exporter], ...]:
    """Import the classes that write these formats, each once, in the order of FORMAT_TABLE; raises ConfigError if a format's module, or a
    package that it needs, is not installed."""
    wanted = set(names)
    return tuple(_load(name) for name in format_names() if name in wanted)


def _load(name: str) -> type[Exporter]:
    """Import the exporter class of a format; raises ConfigError with a remedy if a package is missing."""
    row = find_format(name)
    try:
        return getattr(importlib.import_module(row.module, __package__), row.exporter)
    except ImportError as error:
        raise ConfigError(f"bake.formats names {name}, but its writer cannot be loaded: {error}; {row.remedy}") from None


@dataclass(frozen=True)
class Needs:
    """Needs of a bake's formats."""

    classes: tuple[type[Exporter], ...]
    """Their exporters, in the order of FORMAT_TABLE."""
    slot_bytes: int
    """Maximum size of the images of any task in the pool's shared memory [B]."""

    @classmethod
    def of(cls, config: Config) -> "Needs":
        """Needs by the settings of a bake. Errors: see `load_exporter_classes`."""
        classes = load_exporter_classes(config.bake.formats)
        settings = ExportSettings.of(config)
        return cls(classes, max((kind.slot_bytes(settings) for kind in classes), default=0))

    @property
    def physics(self) -> bool:
        """Whether a format needs physics of ticks."""
        return any(each.needs_physics for each in self.classes)

    @property
    def views(self) -> bool:
        """Whether a format needs rendered views."""
        return any(each.needs_views for each in self.classes)

    @property
    def images(self) -> bool:
        """Whether a format reads all images of a batch."""
        return any(each.needs_images for each in self.classes)

    @property
    def depth_files(self) -> bool:
        """Whether a format writes depth files."""
        return any(each.writes_depth for each in self.classes)


class Exporters:
    """Composite of all exporters of a bake; see `Exporter` for its methods."""

    def __init__(self, classes: Iterable[type[Exporter]], context: ExportContext) -> None:
        self._all = tuple(exporter_class(context) for exporter_class in classes)

    def write_constants(self) -> list[Path]:
        """Write the constant files of all formats; files that formats share are identical and listed once. See `Exporter`."""
        return list(dict.fromkeys(path for exporter in self._all for path in exporter.write_constants()))

    def write_views(self, batch: FrameBatch) -> None:
        for exporter in self._all:
            exporter.write_views(batch)

    def write_stored(self, episode: int, scenes: Sequence[StoredScene]) -> None:
        for exporter in self._all:
            exporter.write_stored(episode, scenes)

    def write_ticks(self, batch: TickBatch) -> None:
        for exporter in self._all:
            exporter.write_ticks(batch)

    def write_picks(self, batch: PickBatch) -> None:
        for exporter in self._all:
            exporter.write_picks(batch)

    def end_episode(self, end: EpisodeEnd, on_committed: Callable[[], None]) -> None:
        """End an episode in all formats; `on_committed` is called when the last one has committed it. See `Exporter`."""
        pending = [len(self._all)]

        def count_down() -> None:
            pending[0] -= 1
            if pending[0] == 0:
                on_committed()

        for exporter in self._all:
            exporter.end_episode(end, count_down)

    def files(self, episode: int) -> list[Path]:
        return sorted(path for exporter in self._all for path in exporter.files(episode))

    def close(self) -> None:
        for exporter in self._all:
            exporter.close()

    def abort(self) -> None:
        for exporter in self._all:
            exporter.abort()


@contextlib.contextmanager
def aborting(pool: WriterPool, exporters: Exporters) -> Iterator[None]:
    """Context manager that ends writers and exporters if an error leaves it."""
    try:
        yield
    except BaseException:
        pool.abort()
        exporters.abort()
        raise


def shared_files(classes: Iterable[type[Exporter]], layout: DataLayout) -> SharedFiles:
    """Names of constants, indices and folders of every format, each once."""
    all_names = [exporter_class.shared_files(layout) for exporter_class in classes]
    constants, indices, folders = (
        tuple(dict.fromkeys(name for names in group for name in names)) for group in zip(*all_names, strict=True)
    )
    return SharedFiles(constants, indices, folders)


def finalize(
    classes: Iterable[type[Exporter]], out: Path, settings: ExportSettings, pool: WriterPool, episodes: Sequence[int]
) -> list[Path]:
    """Write the index files over the committed episodes, of every format; returns them, relative to the data set."""
    return sorted(path for exporter_class in classes for path in exporter_class.finalize(out, settings, pool, episodes))
