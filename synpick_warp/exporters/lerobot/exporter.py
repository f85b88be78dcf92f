"""Exporter of LeRobot v3 data sets: videos a camera and episode, states, actions and task sentences a frame, for robot learning."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from synpick_warp.codes import Task
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.exporters.base import EpisodeExporter, ExportContext, SharedFiles, StagedEpisode, StoredScene
from synpick_warp.exporters.lerobot import layout as lerobot
from synpick_warp.exporters.lerobot.episode import TICK, commit_episode, frame_path, group_path
from synpick_warp.exporters.lerobot.index import write_indices
from synpick_warp.exporters.lerobot.video import GROUP, write_frame, write_spooled_group, write_stored_group
from synpick_warp.exporters.writing.files import output_errors
from synpick_warp.exporters.writing.notes import note_files, write_notes
from synpick_warp.exporters.writing.pool import WriterPool, WriteTask
from synpick_warp.system.processes.shared_memory import shared_bytes
from synpick_warp.views.frames import EpisodeEnd, FrameBatch, TickBatch

_CUP = 2
"""Index of the cup in `TickBatch.fixture_pose`."""


@dataclass(eq=False)
class _LerobotContent:
    """What is kept of an episode whose frames are being spooled and encoded."""

    ticks: bytearray = field(default_factory=bytearray)
    """Rows of `TICK`: 50 bytes a frame."""
    spooled: Counter[tuple[int, int]] = field(default_factory=Counter)
    """Spooled frames of each (camera, group) that is not encoded yet."""


_Staged = StagedEpisode[_LerobotContent]


class LerobotExporter(EpisodeExporter[_LerobotContent]):
    """`Exporter` of LeRobot v3. Episode k becomes a video a camera and a part, from which the tables of all episodes are made at the end.

    Views are spooled as planes; GROUP of them are encoded together, so that little disk space is used twice.
    """

    needs_physics = True
    needs_views = True
    needs_images = True
    staging = lerobot.FOLDER.name

    def __init__(self, context: ExportContext) -> None:
        super().__init__(context)
        self._rig, self._rate, self._names = context.settings.rig, lerobot.video_rate(context.settings.physics), context.names

    @staticmethod
    def slot_bytes(settings: ExportSettings) -> int:
        width, height = settings.rig.largest
        return shared_bytes((height * width * 3,))

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        videos = lerobot.video_folders(layout.names)
        between = (lerobot.EPISODES.parent, lerobot.EPISODES.parent.parent, lerobot.META, lerobot.DATA.parent, lerobot.DATA.parent.parent)
        return SharedFiles(
            note_files(layout),
            (lerobot.INFO, lerobot.STATS, lerobot.TASKS, lerobot.EPISODES, lerobot.DATA, lerobot.CARD),
            (lerobot.PARTS, *videos, *between, lerobot.FOLDER),
        )

    @staticmethod
    def finalize(out: Path, settings: ExportSettings, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
        with output_errors(out / lerobot.FOLDER):
            return write_indices(out, settings, episodes)

    def write_constants(self) -> list[Path]:
        context = self._context
        with output_errors(context.out):
            return write_notes(context.out, context.settings, self._names, context.cameras)

    def write_views(self, batch: FrameBatch) -> None:
        tasks = []
        for view in range(len(batch)):
            index, camera, frame = (int(column[view]) for column in (batch.episode, batch.camera, batch.frame))
            episode = self._episode(index)
            path = frame_path(episode.folder, camera, frame)
            then = partial(self._frame_spooled, episode, camera, frame // GROUP)
            tasks.append(self._task((episode,), write_frame, (batch.color[view],), (path,), path, then))
        self._context.pool.submit_all(tasks)

    def write_stored(self, episode: int, scenes: Sequence[StoredScene]) -> None:
        """A task for each group of pictures. Videos of JPEG images differ from a bake's, as they were compressed before."""
        staged, tasks = self._episode(episode), []
        for camera, scene in enumerate(scenes):
            for group in range(-(-scene.frames // GROUP)):
                path = group_path(staged.folder, camera, group)
                tasks.append(self._task((staged,), write_stored_group, (), (scene, group * GROUP, self._rate, path), path))
        self._context.pool.submit_all(tasks)

    def write_ticks(self, batch: TickBatch) -> None:
        for index, row in zip(batch.episode.tolist(), make_ticks(batch), strict=True):
            self._episode(index).content.ticks += row.tobytes()

    def _episode(self, index: int) -> _Staged:
        return self._staged(index, lambda _: _LerobotContent())

    def places(self, episode: int) -> list[Path]:
        return [lerobot.part_path(episode), *(lerobot.video_path(camera, episode) for camera in self._rig.names)]

    def _finish(self, episode: _Staged, end: EpisodeEnd) -> None:
        for camera, group in list(episode.content.spooled):
            self._encode_if_complete(episode, camera, group)

    def _frame_spooled(self, episode: _Staged, camera: int, group: int) -> None:
        episode.content.spooled[camera, group] += 1
        self._encode_if_complete(episode, camera, group)

    def _encode_if_complete(self, episode: _Staged, camera: int, group: int) -> None:
        """Submit a group whose frames are all spooled; the last one of an episode may be shorter."""
        size = GROUP if episode.end is None else min(GROUP, episode.end.frames - group * GROUP)
        if episode.content.spooled[camera, group] != size or (episode.end is not None and not episode.delivers):
            return
        del episode.content.spooled[camera, group]
        frames = [frame_path(episode.folder, camera, frame) for frame in range(group * GROUP, group * GROUP + size)]
        path = group_path(episode.folder, camera, group)
        arguments = (frames, self._rig.sizes[camera], self._rate, path)
        self._context.pool.submit_all((self._task((episode,), write_spooled_group, (), arguments, path),))

    def _commit(self, episode: _Staged, end: EpisodeEnd) -> WriteTask:
        count = len(episode.content.ticks) // TICK.itemsize
        if count != end.frames:
            raise ValueError(f"episode {end.episode} ended with {end.frames} frames, but {count} came")
        if groups := len(episode.content.spooled):
            raise ValueError(f"episode {end.episode} ended, but views of {groups} groups of pictures are missing")
        out = self._context.out
        arguments = (episode.folder, end, bytes(episode.content.ticks), self._names, out, self._context.settings)
        return WriteTask(commit_episode, (), arguments, out / lerobot.part_path(end.episode))


def make_ticks(batch: TickBatch) -> np.ndarray:
    """Rows of `TICK`, one per frame of a batch (frame)."""
    rows = np.zeros(len(batch), TICK)
    rows["pose"] = batch.fixture_pose[:, _CUP]
    rows["setpoint"] = batch.steps["setpoint"][:, -1] if "setpoint" in batch.steps else np.nan
    rows["suction"] = "task" in batch.tick and batch.tick["task"] == Task.LIFT
    rows["attached"] = "attached" in batch.tick and np.any(batch.tick["attached"], axis=1)
    return rows
