"""Exporter of USD scenes: one file per episode, and an asset library that all episodes reference."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

from synpick_warp.codes import Ending
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.base import ExportContext, SharedFiles
from synpick_warp.exporters.usd.episode import discard_episode, write_episode
from synpick_warp.exporters.usd.lights import make_stage_light
from synpick_warp.exporters.usd.spool import TickSpool, tick_rows
from synpick_warp.exporters.usd.types import EpisodeMetadata, EpisodeSettings
from synpick_warp.exporters.writing.files import PARTIAL, output_error
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.frames import EpisodeEnd, FrameBatch, TickBatch

FOLDER = Path("usd")
"""Folder in the data set."""
LIBRARY = FOLDER / "assets"


class UsdExporter:
    """`Exporter` of USD. Episode k becomes usd/k.usdc, which references usd/assets.

    An episode's ticks are spooled to a hidden file, from which a writer process makes the episode's file when it has ended.
    """

    needs_physics = False
    needs_views = False
    needs_images = False
    writes_depth = False

    def __init__(self, context: ExportContext) -> None:
        """See `Exporter`."""
        self._context = context
        self._staging = context.out / PARTIAL / FOLDER
        self._spools: dict[int, TickSpool] = {}
        self._arrangements = 0

    @staticmethod
    def slot_bytes(config: Config) -> int:
        """See `Exporter`: tasks have no images."""
        return 0

    @staticmethod
    def shared_files(config: Config) -> SharedFiles:
        """See `Exporter`."""
        return SharedFiles((LIBRARY,), (), (FOLDER,))

    @staticmethod
    def finalize(out: Path, config: Config, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
        """See `Exporter`: no index files."""
        return []

    def write_constants(self) -> list[Path]:
        """See `Exporter`: the asset library."""
        from synpick_warp.exporters.usd.assets import write_library  # pxr loads slowly, and only this method needs it.

        context = self._context
        library = context.out / LIBRARY
        try:
            for folder in (library.parent, library):
                folder.mkdir(exist_ok=True)
            write_library(library, context.config, context.catalog, context.lights)
        except OSError as error:
            raise output_error(library, error) from error
        return [LIBRARY]

    def write_views(self, batch: FrameBatch) -> None:
        """See `Exporter`: USD holds no images."""

    def write_ticks(self, batch: TickBatch) -> None:
        """See `Exporter`."""
        for index, row in zip(batch.episode.tolist(), tick_rows(batch), strict=True):
            spool = self._spools.get(index) or self._stage_episode(index, batch.object_id.shape[1])
            try:
                spool.add(row)
            except OSError as error:
                raise output_error(spool.path, error) from error

    def end_episode(self, end: EpisodeEnd, on_committed: Callable[[], None]) -> None:
        """See `Exporter`."""
        pool, spool = self._context.pool, self._spools.pop(end.episode, None)
        if spool is None:
            on_committed()
        elif not Ending(end.ending).delivers:
            pool.submit(discard_episode, (), (spool.path,), path=spool.path, on_done=on_committed)
        else:
            try:
                spool.flush()
            except OSError as error:
                raise output_error(spool.path, error) from error
            place = self._place(end.episode)
            arguments = (spool.path, spool.instances, place, EpisodeMetadata.from_end(end), self._settings)
            pool.submit(write_episode, (), arguments, path=place, on_done=on_committed)
        pool.poll()

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`: the one file."""
        place = self._place(episode)
        return [place.relative_to(self._context.out)] if os.path.lexists(place) else []

    def close(self) -> None:
        """See `Exporter`."""
        self._spools.clear()

    def abort(self) -> None:
        """See `Exporter`."""
        self._spools.clear()

    def _stage_episode(self, index: int, instances: int) -> TickSpool:
        # A suffix unique to each arrangement: the discarded one's file may not be removed yet.
        self._arrangements += 1
        try:
            self._staging.mkdir(exist_ok=True)
        except OSError as error:
            raise output_error(self._staging, error) from error
        spool = self._spools[index] = TickSpool(self._staging / f"{index:06d}-{self._arrangements}", instances)
        return spool

    def _place(self, episode: int) -> Path:
        return self._context.out / FOLDER / f"{episode:06d}.usdc"

    @cached_property
    def _settings(self) -> EpisodeSettings:
        context = self._context
        config = context.config
        return EpisodeSettings(
            tick_rate=1.0 / (config.physics.step * config.physics.steps_per_tick),
            gravity=config.physics.gravity,
            cameras=context.cameras,
            lights=tuple(make_stage_light(index, light, config.render.exposure) for index, light in enumerate(context.lights)),
            names={entry.obj_id: entry.name for entry in context.catalog.entries},
        )
