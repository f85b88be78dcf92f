"""Exporter of physics trajectories to zarr: poses, velocities, forces and attempts, one group per episode."""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.codes import Ending, Mode
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.exporters.base import ExportContext, SharedFiles
from synpick_warp.exporters.staging import EpisodeExporter, StagedEpisode
from synpick_warp.exporters.trajectory.arrays import CONSTANT_FILES, EPISODES, STORE
from synpick_warp.exporters.trajectory.episode import SpooledEpisode, write_episode
from synpick_warp.exporters.trajectory.spool import SPOOL_ROWS, batch_type, make_rows, spool_bytes, write_rows
from synpick_warp.exporters.trajectory.store import write_constants
from synpick_warp.exporters.writing.files import output_errors
from synpick_warp.exporters.writing.pool import WriteTask
from synpick_warp.system.processes.shared_memory import shared_bytes
from synpick_warp.views.frames import EpisodeEnd, TickBatch

_Staged = StagedEpisode[SpooledEpisode]


class TrajectoryExporter(EpisodeExporter[SpooledEpisode]):
    """`Exporter` of zarr. Episode k becomes the group `episodes/k` of one store.

    Ticks are spooled to a hidden file, from which a writer process makes the group when the episode has ended. A task spools one tick of
    many episodes, so that the bake's work grows with the arrays of a tick more than with its worlds.
    """

    needs_physics = True
    staging = "trajectory"

    def __init__(self, context: ExportContext) -> None:
        super().__init__(context)
        self._masses = {body.obj_id: body.mass for body in context.catalog.bodies}

    @staticmethod
    def slot_bytes(settings: ExportSettings) -> int:
        size = spool_bytes(settings.objects, settings.physics.steps_per_tick, settings.trajectory.steps)
        return shared_bytes((size,))

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        return SharedFiles(CONSTANT_FILES, (), (STORE / EPISODES, STORE))

    def write_constants(self) -> list[Path]:
        with output_errors(self._context.out / STORE):
            write_constants(self._context)
        return list(CONSTANT_FILES)

    def write_ticks(self, batch: TickBatch) -> None:
        indices = batch.episode.tolist()
        episodes = [self._staged(index, partial(self._make_content, batch, world)) for world, index in enumerate(indices)]
        self._context.pool.submit_all(self._spool(batch, episodes))

    def places(self, episode: int) -> tuple[Path]:
        return (STORE / EPISODES / f"{episode:06d}",)

    def _make_content(self, batch: TickBatch, world: int, _: Path) -> SpooledEpisode:
        """What the first tick of an episode tells, that of a world of a batch."""
        present = np.flatnonzero(batch.object_id[world] != -1)
        instances = int(present[-1]) + 1 if present.size else 0
        light = int(batch.light[world])
        initial: dict[str, Any] = {
            "light": {
                "map": light,
                "name": self._context.lights[light].name,
                "yaw": float(batch.light_yaw[world]),
                "exposure": float(batch.light_exposure[world]),
                "units": {"yaw": "rad", "exposure": "EV"},
            }
        }
        if "mode" in batch.tick:
            initial["mode"] = Mode(int(batch.tick["mode"][world])).name.lower()
        if "redrops" in batch.tick:
            initial["redrops"] = int(batch.tick["redrops"][world])
        drop_pose = batch.tick["drop_pose"][world, :instances].copy() if "drop_pose" in batch.tick else None
        object_id = batch.object_id[world, :instances].copy()
        if drop_pose is not None:
            drop_pose[object_id == -1] = np.nan
        row = batch_type(batch, instances, self._context.settings.physics.steps_per_tick)
        return SpooledEpisode(row, initial, object_id, drop_pose)

    def _spool(self, batch: TickBatch, episodes: Sequence[_Staged]) -> Iterator[WriteTask]:
        """Tasks that spool a batch, each the frames of at most SPOOL_ROWS of its `episodes` (frame) whose rows have the same type."""
        groups: dict[int, list[int]] = {}
        for frame, episode in enumerate(episodes):
            groups.setdefault(len(episode.content.object_id), []).append(frame)
        for instances, frames in groups.items():
            for first in range(0, len(frames), SPOOL_ROWS):
                part = frames[first : first + SPOOL_ROWS]
                owners = [episodes[frame] for frame in part]
                rows = make_rows(batch.select(np.array(part)), owners[0].content.row, instances)
                places = [(episode.folder.name, episode.content.count * rows.itemsize) for episode in owners]
                for episode in owners:
                    episode.content.count += 1
                image = rows.view(np.uint8).reshape(len(rows), rows.itemsize)
                yield self._task(owners, write_rows, (image,), (self._staging, places), self._staging)

    def _commit(self, episode: _Staged, end: EpisodeEnd) -> WriteTask:
        kept = episode.content
        if kept.count != end.frames:
            raise ValueError(f"episode {end.episode} ended with {end.frames} frames, but {kept.count} came")
        ending = Ending(end.ending)
        kept.attributes = {
            "episode": end.episode,
            "arrangement": end.arrangement,
            "frames": end.frames,
            "ending": ending.name.lower(),
            "sentence": ending.sentence,
            "seed": self._context.settings.bake.seed,
            **end.row,
            **kept.attributes,
        }
        place = self._context.out / self.places(end.episode)[0]
        return WriteTask(write_episode, (), (episode.folder, kept, end.attempts, place, self._masses, self._context.settings), place)
