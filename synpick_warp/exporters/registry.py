"""Exporters by the names of their formats, and all that a bake writes with at once."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from pathlib import Path

from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError
from synpick_warp.exporters.base import ExportContext, Exporter
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.frames import EpisodeEnd, FrameBatch, TickBatch

EXPORTERS = {
    "bop": ("bop.exporter", "BopExporter"),
    "shards": ("bop.shards", "ShardsExporter"),
    "usd": ("usd.exporter", "UsdExporter"),
    "zarr": ("trajectory.exporter", "TrajectoryExporter"),
}
"""Format -> (module in this package, class in it). Modules are imported when their format is asked for."""


def load_exporter_classes(names: Iterable[str]) -> tuple[type[Exporter], ...]:
    """The classes that write these formats, each once, in the order of EXPORTERS.

    Raises:
        ConfigError: A format's module, or a package that it needs, is not installed.
    """
    asked = set(names)
    return tuple(_kind(name) for name in EXPORTERS if name in asked)


def _kind(name: str) -> type[Exporter]:
    module, kind = EXPORTERS[name]
    try:
        return getattr(importlib.import_module(f"{__package__}.{module}"), kind)
    except ImportError as error:
        raise ConfigError(f"bake.formats names {name}, but its writer cannot be loaded: {error}; name other formats") from None


class Exporters:
    """All exporters of a bake as one; see `Exporter`."""

    def __init__(self, kinds: Iterable[type[Exporter]], context: ExportContext) -> None:
        self._all = tuple(kind(context) for kind in kinds)
        self.needs_physics = any(exporter.needs_physics for exporter in self._all)
        self.needs_views = any(exporter.needs_views for exporter in self._all)

    def write_constants(self) -> list[Path]:
        """See `Exporter`; formats may share constants, which then are the same."""
        return list(dict.fromkeys(path for exporter in self._all for path in exporter.write_constants()))

    def write_views(self, batch: FrameBatch) -> None:
        """See `Exporter`."""
        for exporter in self._all:
            exporter.write_views(batch)

    def write_ticks(self, batch: TickBatch) -> None:
        """See `Exporter`."""
        for exporter in self._all:
            exporter.write_ticks(batch)

    def end_episode(self, end: EpisodeEnd, whole: Callable[[], None]) -> None:
        """See `Exporter`; `whole` is called when the last exporter is done with the episode."""
        left = [len(self._all)]

        def count() -> None:
            left[0] -= 1
            if left[0] == 0:
                whole()

        for exporter in self._all:
            exporter.end_episode(end, count)

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


def slot_bytes(kinds: Iterable[type[Exporter]], config: Config) -> int:
    """Most room that the images of any task take in the pool's shared memory [B]."""
    return max(kind.slot_bytes(config) for kind in kinds)


def finalize(kinds: Iterable[type[Exporter]], out: Path, config: Config, pool: WriterPool) -> list[Path]:
    """Have every format's lists that span episodes written; returns these files, relative to the data set."""
    return sorted(path for kind in kinds for path in kind.finalize(out, config, pool))
