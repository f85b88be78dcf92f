"""Exporter of LeRobot v3 data sets: videos a camera and episode, states, actions and task sentences a frame, for robot learning."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np

from synpick_warp.codes import Ending, Task
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.base import ExportContext, SharedFiles
from synpick_warp.exporters.lerobot.episode import (
    EpisodeContent,
    EpisodeSettings,
    commit_episode,
    discard_episode,
    frame_path,
    group_path,
)
from synpick_warp.exporters.lerobot.index import write_indices
from synpick_warp.exporters.lerobot.layout import (
    CARD,
    DATA,
    EPISODES,
    FOLDER,
    INFO,
    META,
    PARTS,
    STATS,
    TASKS,
    frame_rate,
    part_path,
    video_folders,
    video_path,
)
from synpick_warp.exporters.lerobot.part import TICK
from synpick_warp.exporters.lerobot.video import GROUP, write_frame, write_spooled_group
from synpick_warp.exporters.writing.files import PARTIAL, output_error
from synpick_warp.exporters.writing.notes import note_files, write_notes
from synpick_warp.exporters.writing.pool import WriterPool, WriteTask
from synpick_warp.frames import EpisodeEnd, FrameBatch, TickBatch
from synpick_warp.system.shared_memory import shared_bytes

_CUP = 2
"""Index of the cup in `TickBatch.fixture_pose`."""
_MAX_DENOMINATOR = 100_000
"""Frame rates are taken for fractions of at most this denominator, such as 500/33 Hz."""


@dataclass(eq=False)
class _Episode:
    """An arrangement of an episode whose frames are being spooled and encoded."""

    folder: Path
    """Staging folder."""
    ticks: bytearray = field(default_factory=bytearray)
    """Rows of `TICK`: 50 bytes a frame."""
    spooled: Counter[tuple[int, int]] = field(default_factory=Counter)
    """Spooled frames of each (camera, group) that is not encoded yet."""
    pending: int = 0
    """Number of unfinished tasks."""
    end: EpisodeEnd | None = None
    on_committed: Callable[[], None] | None = None
    """Set together with `end`."""
    is_over: bool = False
    """Whether the task that commits or discards it has been submitted."""


class LerobotExporter:
    """`Exporter` of LeRobot v3. Episode k becomes a video a camera and a part, from which the tables of all episodes are made at the end.

    Views are spooled as planes; GROUP of them are encoded together, so that little disk space is used twice.
    """

    needs_physics = True
    needs_views = True
    needs_images = True
    writes_depth = False

    def __init__(self, context: ExportContext) -> None:
        """See `Exporter`."""
        self._context = context
        self._staging = context.out / PARTIAL / FOLDER.name
        self._episodes: dict[int, _Episode] = {}
        self._arrangements = 0
        objects = {entry.obj_id: entry.name for entry in context.catalog.entries}
        self._settings = episode_settings(context.config, context.out, objects)

    @staticmethod
    def slot_bytes(config: Config) -> int:
        """See `Exporter`: a colour image."""
        width, height = config.cameras.resolution
        return shared_bytes((height * width * 3,))

    @staticmethod
    def shared_files(config: Config) -> SharedFiles:
        """See `Exporter`."""
        videos = video_folders(len(config.cameras.positions))
        between = (EPISODES.parent, EPISODES.parent.parent, META, DATA.parent, DATA.parent.parent)
        return SharedFiles(note_files(config), (INFO, STATS, TASKS, EPISODES, DATA, CARD), (PARTS, *videos, *between, FOLDER))

    @staticmethod
    def finalize(out: Path, config: Config, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
        """See `Exporter`: the tables over all episodes."""
        try:
            return write_indices(out, config, episodes)
        except OSError as error:
            raise output_error(out / FOLDER, error) from error

    def write_constants(self) -> list[Path]:
        """See `Exporter`: camera and notes."""
        context = self._context
        try:
            return write_notes(context.out, context.config, self._settings.objects, context.cameras)
        except OSError as error:
            raise output_error(context.out, error) from error

    def write_views(self, batch: FrameBatch) -> None:
        """See `Exporter`."""
        tasks = []
        for view in range(len(batch)):
            index, camera, frame = (int(column[view]) for column in (batch.episode, batch.camera, batch.frame))
            episode = self._episodes.get(index) or self._stage_episode(index)
            episode.pending += 1
            path = frame_path(episode.folder, camera, frame)
            done = partial(self._frame_spooled, index, episode, camera, frame // GROUP)
            tasks.append(WriteTask(write_frame, (batch.color[view],), (path,), path, done))
        self._context.pool.submit_all(tasks)

    def write_ticks(self, batch: TickBatch) -> None:
        """See `Exporter`."""
        for index, row in zip(batch.episode.tolist(), make_ticks(batch), strict=True):
            episode = self._episodes.get(index) or self._stage_episode(index)
            episode.ticks += row.tobytes()

    def end_episode(self, end: EpisodeEnd, on_committed: Callable[[], None]) -> None:
        """See `Exporter`."""
        episode = self._episodes.pop(end.episode, None)
        if episode is None:
            on_committed()
        else:
            episode.end, episode.on_committed = end, on_committed
            for camera, group in list(episode.spooled):
                self._encode_if_complete(end.episode, episode, camera, group)
            self._commit_if_complete(end.episode, episode)
        self._context.pool.poll()

    def files(self, episode: int) -> list[Path]:
        """See `Exporter`: part and videos."""
        return episode_files(self._context.out, episode, self._settings.cameras)

    def close(self) -> None:
        """See `Exporter`."""
        self._episodes.clear()

    def abort(self) -> None:
        """See `Exporter`."""
        self._episodes.clear()

    def _stage_episode(self, index: int) -> _Episode:
        # A suffix unique to each arrangement: the discarded one's folder may not be removed yet.
        self._arrangements += 1
        episode = _Episode(self._staging / f"{index:06d}-{self._arrangements}")
        try:
            self._staging.mkdir(exist_ok=True)
            episode.folder.mkdir()
        except OSError as error:
            raise output_error(episode.folder, error) from error
        self._episodes[index] = episode
        return episode

    def _frame_spooled(self, index: int, episode: _Episode, camera: int, group: int) -> None:
        episode.pending -= 1
        episode.spooled[camera, group] += 1
        self._encode_if_complete(index, episode, camera, group)
        self._commit_if_complete(index, episode)

    def _encode_if_complete(self, index: int, episode: _Episode, camera: int, group: int) -> None:
        """Submit a group whose frames are all spooled; the last one of an episode may be shorter."""
        size = GROUP if episode.end is None else min(GROUP, episode.end.frames - group * GROUP)
        if episode.spooled[camera, group] != size or (episode.end is not None and not Ending(episode.end.ending).delivers):
            return
        del episode.spooled[camera, group]
        episode.pending += 1
        frames = [frame_path(episode.folder, camera, frame) for frame in range(group * GROUP, group * GROUP + size)]
        path = group_path(episode.folder, camera, group)
        arguments = (frames, self._settings.size, self._settings.rate, path)
        done = partial(self._group_encoded, index, episode)
        self._context.pool.submit(write_spooled_group, (), arguments, path=path, on_done=done)

    def _group_encoded(self, index: int, episode: _Episode) -> None:
        episode.pending -= 1
        self._commit_if_complete(index, episode)

    def _commit_if_complete(self, index: int, episode: _Episode) -> None:
        end, pool = episode.end, self._context.pool
        if end is None or episode.pending or episode.is_over:
            return
        if Ending(end.ending).delivers and episode.spooled:
            return
        episode.is_over = True
        if not Ending(end.ending).delivers:
            pool.submit(discard_episode, (), (episode.folder,), path=episode.folder, on_done=episode.on_committed)
            return
        count = len(episode.ticks) // TICK.itemsize
        if count != end.frames:
            raise ValueError(f"episode {index} ended with {end.frames} frames, but {count} came")
        content = make_content(end, bytes(episode.ticks))
        pool.submit(
            commit_episode,
            (),
            (episode.folder, content, self._settings),
            path=self._context.out / part_path(index),
            on_done=episode.on_committed,
        )


def episode_settings(config: Config, out: Path, objects: Mapping[int, str]) -> EpisodeSettings:
    """Settings of the tasks of all episodes; `objects`: obj_id -> name."""
    return EpisodeSettings(out, len(config.cameras.positions), config.cameras.resolution, video_rate(config), objects)


def episode_files(out: Path, episode: int, cameras: int) -> list[Path]:
    """Committed files of an episode: part and videos, relative to the data set, sorted."""
    places = [part_path(episode), *(video_path(camera, episode) for camera in range(cameras))]
    return sorted(place for place in places if os.path.lexists(out / place))


def make_content(end: EpisodeEnd, ticks: bytes) -> EpisodeContent:
    """What the part of an episode is made of."""
    row = end.row
    return EpisodeContent(
        end.episode, str(row.get("mode", "")), Ending(end.ending).name.lower(), int(row.get("picked", 0)), ticks, end.attempts
    )


def make_ticks(batch: TickBatch) -> np.ndarray:
    """Rows of `TICK`, one per frame of a batch (frame)."""
    rows = np.zeros(len(batch), TICK)
    rows["pose"] = batch.fixture_pose[:, _CUP]
    rows["setpoint"] = batch.steps["setpoint"][:, -1] if "setpoint" in batch.steps else np.nan
    rows["suction"] = "task" in batch.tick and batch.tick["task"] == Task.LIFT
    rows["attached"] = "attached" in batch.tick and np.any(batch.tick["attached"], axis=1)
    return rows


def video_rate(config: Config) -> Fraction:
    """Frames per second as a fraction."""
    return Fraction(frame_rate(config)).limit_denominator(_MAX_DENOMINATOR)
