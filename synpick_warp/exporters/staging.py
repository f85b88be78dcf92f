"""Staging of episodes: what all exporters do with an episode's files until it is committed or discarded."""

import dataclasses
import os
import shutil
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from synpick_warp.codes import Ending
from synpick_warp.exporters.base import ExportContext, Exporter
from synpick_warp.exporters.writing.files import PARTIAL, output_errors
from synpick_warp.exporters.writing.pool import WriteTask
from synpick_warp.views.frames import EpisodeEnd

_Content = TypeVar("_Content")


@dataclass(eq=False)
class StagedEpisode(Generic[_Content]):
    """Arrangement of an episode whose files are being written."""

    index: int
    folder: Path
    """Staging folder, of this arrangement only."""
    content: _Content
    """What the format keeps of it."""
    pending: int = 0
    """Number of unfinished tasks."""
    end: EpisodeEnd | None = None
    """None: it is still running."""
    on_committed: Callable[[], None] | None = None
    """Set together with `end`."""

    @property
    def delivers(self) -> bool:
        """Whether the episode has ended and becomes part of the data set."""
        return self.end is not None and Ending(self.end.ending).delivers


class EpisodeExporter(Exporter, Generic[_Content]):
    """`Exporter` that stages: each arrangement of an episode has a staging folder, which one task commits after all others are done.

    A format makes its content of an episode (`_staged`), counts the tasks that write to its folder (`_task`), names the task that commits
    it (`_commit`), and the places of its files (`places`).
    """

    staging: ClassVar[str]
    """Name of the format's folder in `PARTIAL`."""

    def __init__(self, context: ExportContext) -> None:
        super().__init__(context)
        self._staging = context.out / PARTIAL / self.staging
        self._episodes: dict[int, StagedEpisode[_Content]] = {}
        self._arrangements = 0

    @abstractmethod
    def _commit(self, episode: StagedEpisode[_Content], end: EpisodeEnd) -> WriteTask:
        """Task that completes an episode and renames its files to their places; the staging folder is removed after it."""

    def _finish(self, episode: StagedEpisode[_Content], end: EpisodeEnd) -> None:
        """Submit the tasks that wait for the end of an episode."""

    def end_episode(self, end: EpisodeEnd, on_committed: Callable[[], None]) -> None:
        """Commit or discard an episode once all its tasks are done; at once if nothing was staged of it. See `Exporter`."""
        episode = self._episodes.pop(end.episode, None)
        if episode is None:
            on_committed()
        else:
            episode.end, episode.on_committed = end, on_committed
            episode.pending += 1
            if episode.delivers:
                self._finish(episode, end)
            self._task_done((episode,), None)
        self._context.pool.poll()

    @abstractmethod
    def places(self, episode: int) -> Iterable[Path]:
        """Files and folders that hold an episode and nothing else, relative to the data set, whether they are there or not."""

    def files(self, episode: int) -> list[Path]:
        """Those of `places` that exist. See `Exporter`."""
        return sorted(place for place in set(self.places(episode)) if os.path.lexists(self._context.out / place))

    def close(self) -> None:
        """Forget all episodes in progress; their staged files remain. See `Exporter`."""
        self._episodes.clear()

    abort = close

    def _staged(self, index: int, make_content: Callable[[Path], _Content]) -> StagedEpisode[_Content]:
        """Current arrangement of an episode; a new one gets a staging folder, and its content by `make_content` of that folder."""
        episode = self._episodes.get(index)
        if episode is None:
            # A suffix unique to each arrangement: the discarded one's folder may not be removed yet.
            self._arrangements += 1
            folder = self._staging / f"{index:06d}-{self._arrangements}"
            with output_errors(folder):
                self._staging.mkdir(exist_ok=True)
                folder.mkdir()
                episode = self._episodes[index] = StagedEpisode(index, folder, make_content(folder))
        return episode

    def _task(
        self,
        episodes: Sequence[StagedEpisode[_Content]],
        function: Callable[..., None],
        images: Sequence[np.ndarray],
        arguments: tuple[Any, ...],
        path: Path,
        then: Callable[[], None] | None = None,
        affinity: int | None = None,
    ) -> WriteTask:
        """A task that writes to the staging folders of episodes, which are committed after it; `then` runs first, and may submit others."""
        for episode in episodes:
            episode.pending += 1
        return WriteTask(function, images, arguments, path, partial(self._task_done, episodes, then), affinity)

    def _task_done(self, episodes: Sequence[StagedEpisode[_Content]], then: Callable[[], None] | None) -> None:
        """Count a finished task of these episodes, after calling `then`; commits or discards those that have ended and wait for none."""
        if then is not None:
            then()
        for episode in episodes:
            episode.pending -= 1
            if episode.end is not None and not episode.pending:
                self._commit_or_discard(episode, episode.end)

    def _commit_or_discard(self, episode: StagedEpisode[_Content], end: EpisodeEnd) -> None:
        """Commit or discard an episode whose tasks are all done."""
        if episode.delivers:
            task = self._commit(episode, end)
            task = dataclasses.replace(task, function=commit_staged, arguments=(episode.folder, task.function, *task.arguments))
        else:
            task = WriteTask(shutil.rmtree, (), (episode.folder,), episode.folder)
        self._context.pool.submit_all((dataclasses.replace(task, on_done=episode.on_committed),))


def commit_staged(folder: Path, commit: Callable[..., None], *arguments: Any) -> None:
    """Task: commit an episode, and remove its staging folder."""
    commit(*arguments)
    shutil.rmtree(folder)
