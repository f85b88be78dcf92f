"""Zarr: all that physics knows and pictures do not show, one group an episode."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.codes import Ending, Mode
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.trajectory.arrays import EPISODES, STORE
from synpick_warp.exporters.trajectory.episode import ROWS, EpisodeFacts, EpisodeSettings, drop_episode, write_episode
from synpick_warp.exporters.trajectory.spool import SPOOL_TICKS, batch_type, fill_row, present, spool_bytes, write_rows
from synpick_warp.exporters.trajectory.store import write_constants
from synpick_warp.exporters.writing.files import PARTIAL, output_error
from synpick_warp.exporters.writing.pool import WriterPool, shared_bytes
from synpick_warp.frames import EpisodeEnd, FrameBatch, TickBatch

_FOLDER = "trajectory"
"""In `PARTIAL`."""


@dataclass(eq=False)
class _Episode:
    """An arrangement of an episode whose ticks are being gathered."""

    folder: Path
    rows: np.ndarray
    """Room for SPOOL_TICKS ticks, used again and again."""
    start: dict[str, Any]
    """Attributes that its first tick tells of."""
    object_id: np.ndarray
    drop_pose: np.ndarray | None
    count: int = 0
    """Ticks so far."""
    pending: int = 0
    """Tasks that are not done yet."""
    end: EpisodeEnd | None = field(default=None)
    whole: Callable[[], None] | None = None
    """Comes with the end."""


class TrajectoryExporter:
    """An `Exporter`. Episode k becomes the group `episodes/k` of one zarr store.

    Ticks gather in a hidden file a few at a time, out of which a writer process makes the group when the episode has ended.
    """

    needs_physics = True
    needs_views = False

    def __init__(self, context: ExportContext) -> None:
        """See `Exporter`."""
        config = context.config
        self._context = context
        self._hidden = context.out / PARTIAL / _FOLDER
        self._episodes: dict[int, _Episode] = {}
        self._begun = 0
        self._settings = EpisodeSettings(
            trajectory=config.trajectory,
            step=config.physics.step,
            steps_per_tick=config.physics.steps_per_tick,
            masses={entry.obj_id: entry.mass for entry in context.catalog.entries},
        )

    @staticmethod
    def slot_bytes(config: Config) -> int:
        """See `Exporter`: some ticks of an episode."""
        return shared_bytes((spool_bytes(config),))

    @staticmethod
    def finalize(out: Path, config: Config, pool: WriterPool) -> list[Path]:
        """See `Exporter`: nothing spans episodes."""
        return []

    def write_constants(self) -> list[Path]:
        """See `Exporter`: the store, with objects and cameras."""
        context, store = self._context, self._context.out / STORE
        try:
            store.mkdir(exist_ok=True)
            (store / EPISODES).mkdir(exist_ok=True)
            written = write_constants(store, context.config, context.catalog, context.cameras, context.lights)
        except OSError as error:
            raise output_error(store, error) from error
        return [path.relative_to(context.out) for path in written]

    def write_views(self, batch: FrameBatch) -> None:
        """See `Exporter`: pictures are not for trajectories."""

    def write_ticks(self, batch: TickBatch) -> None:
        """See `Exporter`."""
        for world in range(len(batch)):
            number = int(batch.episode[world])
            episode = self._episodes.get(number) or self._begin(number, batch, world)
            fill_row(episode.rows[episode.count % SPOOL_TICKS], batch, world)
            episode.count += 1
            if episode.count % SPOOL_TICKS == 0:
                self._spool(number, episode, SPOOL_TICKS)

    def end_episode(self, end: EpisodeEnd, whole: Callable[[], None]) -> None:
        """See `Exporter`."""
        episode = self._episodes.pop(end.episode, None)
        if episode is None:
            whole()
        else:
            if episode.count % SPOOL_TICKS:
                self._spool(end.episode, episode, episode.count % SPOOL_TICKS)
            episode.end, episode.whole = end, whole
            self._finish_if_spooled(end.episode, episode)
        self._context.pool.poll()

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`: the group."""
        place = self._place(episode)
        return [place.relative_to(self._context.out)] if os.path.lexists(place) else []

    def close(self) -> None:
        """See `Exporter`."""
        self._episodes.clear()

    def abort(self) -> None:
        """See `Exporter`."""
        self._episodes.clear()

    def _begin(self, number: int, batch: TickBatch, world: int) -> _Episode:
        # A number of its own for every arrangement: the last one's folder may not be removed yet.
        self._begun += 1
        folder = self._hidden / f"{number:06d}-{self._begun}"
        try:
            self._hidden.mkdir(exist_ok=True)
            folder.mkdir()
        except OSError as error:
            raise output_error(folder, error) from error
        instances = present(batch, world)
        light = int(batch.light[world])
        start: dict[str, Any] = {
            "light": {
                "map": light,
                "name": self._context.lights[light].name,
                "turn": float(batch.light_yaw[world]),
                "exposure": float(batch.light_exposure[world]),
                "units": {"turn": "rad", "exposure": "stops"},
            }
        }
        if "mode" in batch.tick:
            start["mode"] = Mode(int(batch.tick["mode"][world])).name.lower()
        if "redrops" in batch.tick:
            start["redrops"] = int(batch.tick["redrops"][world])
        drop_pose = batch.tick["drop_pose"][world, :instances].copy() if "drop_pose" in batch.tick else None
        object_id = batch.object_id[world, :instances].copy()
        if drop_pose is not None:
            drop_pose[object_id < 0] = np.nan
        rows = np.zeros(SPOOL_TICKS, batch_type(batch, instances))
        episode = self._episodes[number] = _Episode(folder, rows, start, object_id, drop_pose)
        return episode

    def _spool(self, number: int, episode: _Episode, count: int) -> None:
        """Hand over the last `count` rows."""
        episode.pending += 1
        self._context.pool.submit(
            write_rows,
            (episode.rows[:count].view(np.uint8),),
            (episode.folder / ROWS, (episode.count - count) * episode.rows.itemsize),
            path=episode.folder,
            on_done=partial(self._spooled, number, episode),
        )

    def _spooled(self, number: int, episode: _Episode) -> None:
        episode.pending -= 1
        self._finish_if_spooled(number, episode)

    def _finish_if_spooled(self, number: int, episode: _Episode) -> None:
        end, pool = episode.end, self._context.pool
        if end is None or episode.pending:
            return
        if not Ending(end.ending).delivers:
            pool.submit(drop_episode, (), (episode.folder,), path=episode.folder, on_done=episode.whole)
            return
        if episode.count != end.frames:
            raise ValueError(f"episode {number} ended with {end.frames} frames, but {episode.count} came")
        ending = Ending(end.ending)
        attributes = {
            "episode": end.episode,
            "redraw": end.redraw,
            "frames": end.frames,
            "ending": ending.name.lower(),
            "sentence": ending.sentence,
            "seed": self._context.config.bake.seed,
            **end.row,
            **episode.start,
        }
        facts = EpisodeFacts(attributes, episode.object_id, episode.drop_pose, end.attempts)
        arguments = (episode.folder, episode.rows.dtype, episode.count, self._place(number), facts, self._settings)
        pool.submit(write_episode, (), arguments, path=self._place(number), on_done=episode.whole)

    def _place(self, episode: int) -> Path:
        return self._context.out / STORE / EPISODES / f"{episode:06d}"
