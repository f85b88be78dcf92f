"""Bake without simulation: episodes of scripted views and ticks go through output folder, exporters, commit and lists, in this process."""

import dataclasses
import functools
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from synpick_warp.codes import Ending
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import FORMATS, Config
from synpick_warp.dataset.commit.manifest import episode_entry, read_entry
from synpick_warp.dataset.commit.writing import OutputFolder, commit_episode, finalize_data_set
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.registry import Exporters, Needs
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.factory.episodes import BakeSummary, EpisodeOutcome, EpisodeSource
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.system.progress import Progress
from synpick_warp.testing import box_views
from synpick_warp.testing.box_views import pick_batch
from synpick_warp.views.frames import EpisodeEnd
from tests.worlds import trajectories
from tests.worlds.trajectories import seen_object

FRAMES = 2
EPISODES = 4
INPUTS = {"objects": 64 * "0", "lights": 64 * "1"}
SEEN = {"visible": 5, "centroid": [1.0, 1.5], "midpoint": [1.0, 1.25], "distances": [1.0, 0.5, 0.75], "depth": 1.9, "ancestors": [3]}
ATTEMPT = trajectories.ATTEMPT | {
    "observation": {"resolution": [4, 3], "instances": [seen_object(2, 7, (1.0, 1.0), **SEEN)], "votes": [[2, 3, 0.5]]}
}
_LENSES, _CATALOG = box_views.cameras(16, 12), box_views.catalog()
_ticks = functools.cache(lambda episode: tuple(trajectories.ticks((episode,), FRAMES)))


def settings(episodes: int = 2, formats: tuple[str, ...] = FORMATS) -> Config:
    """Settings with tiny images."""
    config = trajectories.config()
    bake = dataclasses.replace(config.bake, formats=formats, episodes=episodes, mode="pick", writers=1)
    cameras = dataclasses.replace(config.cameras, resolution=(16, 12), positions=config.cameras.positions[: len(_LENSES)])
    return dataclasses.replace(config, bake=bake, cameras=cameras)


def tiny(episodes: int = EPISODES, formats: tuple[str, ...] = ("bop", "shards")):
    """Settings of a few small files an episode."""
    return settings(episodes, formats).with_values({"bop.split": "train", "bop.color_format": "png", "bop.masks": False, "bop.coco": False})


def small_settings() -> Config:
    """Settings of two episodes of one camera as scenes and shards, of few files."""
    config = settings(2, ("bop", "shards"))
    cameras = dataclasses.replace(config.cameras, positions=config.cameras.positions[:1], ups=config.cameras.ups[:1])
    bop = dataclasses.replace(config.bop, split="train", color_format="png", masks=False, coco=False)
    return dataclasses.replace(config, bop=bop, cameras=cameras)


def bake(out: Path, config: Config, shard: tuple[int, int] = (0, 1), stop_after: int | None = None, picks: bool = False) -> BakeSummary:
    """Write a data set, or the remaining episodes of one, as `factory.pipeline.run_bake` does; `stop_after` episodes it is stopped. With
    `picks`, grasps are tried from both frames."""
    episodes = [index for part in DataLayout.of(config).plan((), shard) for index in part]
    return bake_episodes(config, out, None, episodes, stop_after=stop_after, picks=picks)


def bake_episodes(
    config: Config,
    out: Path,
    progress: Progress | None,
    episodes: Sequence[int],
    devices: Sequence[str] = (),
    deliver: Callable[[], None] | None = None,
    stop_after: int | None = None,
    picks: bool = False,
    grows: bool = False,
) -> BakeSummary:
    """Write these episodes as `factory.pipeline.bake_episodes` does; of the observer's methods, `stage` is called before each. With
    `grows`, the episodes are an `EpisodeSource`, which is asked for others after each one."""
    needs = Needs.of(config)
    with OutputFolder(out, config, episodes) as output:
        summary = BakeSummary(len(output.episodes))
        for episode in output.committed:
            summary.take_record(read_entry(out, episode_entry(episode)) or {})
        if not output.is_finished:
            fill(output, episodes if grows else (), needs, (), summary, progress, deliver, stop_after=stop_after, picks=picks)
    return summary


def fill(
    output: OutputFolder,
    source: object,
    needs: Needs,
    _: Sequence[str],
    summary: BakeSummary,
    progress: Progress | None,
    deliver: Callable[[], None] | None = None,
    *__: object,
    stop_after: int | None = None,
    picks: bool = False,
) -> None:
    """Write the remaining episodes, and those of the source, in place of `factory.pipeline._fill`."""
    settings = ExportSettings.of(output.config)
    with WriterPool(0, needs.slot_bytes, output.lock) as pool:
        lenses = _LENSES[: len(output.config.cameras.positions)]
        exporters = Exporters(needs.classes, ExportContext(output.out, settings, _CATALOG, lenses, skies(), pool))
        output.prepare(exporters, INPUTS, pool)
        queue = output.remaining[:stop_after]
        while queue:
            episode = queue.pop(0)
            if progress is not None:
                progress.stage(f"episode {episode}")
            summary.episodes.append(_write_episode(output, exporters, pool, episode, picks))
            if isinstance(source, EpisodeSource):
                found = source.more(not queue)
                queue += found
                summary.total += len(found)
        pool.wait()
        exporters.close()
        if deliver is not None:
            deliver()
        elif stop_after is None:
            finalize_data_set(output.out, settings, needs.classes, pool)


def _write_episode(output: OutputFolder, exporters: Exporters, pool: WriterPool, episode: int, picks: bool) -> EpisodeOutcome:
    lenses = _LENSES[: len(output.config.cameras.positions)]
    for batch in _ticks(episode):
        exporters.write_ticks(batch)
    for batch in box_views.batches(len(lenses), (episode,), FRAMES, lenses):
        exporters.write_views(batch)
    if picks:
        exporters.write_picks(pick_batch(episode, (0, 1), own=False))
    split = DataLayout.of(output.config).split_of(episode)
    row = EpisodeOutcome(episode, 0, Ending.FINISHED, FRAMES, 0.5, "pick", 3, 1, 1, 0, 2, split.name if split else "")
    end = EpisodeEnd(episode, 0, FRAMES, int(Ending.FINISHED), row.as_json(), (json.dumps(ATTEMPT | {"episode": episode}) + "\n",))
    exporters.end_episode(end, lambda: commit_episode(output.out, exporters, pool, end))
    return row


def snapshot(folder: Path) -> dict[str, tuple[str, bytes]]:
    """Everything below a folder: type and content of files, target of links."""
    found = {}
    for root, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(root, name)
            kind = "link" if path.is_symlink() else "folder" if path.is_dir() else "file" if path.is_file() else "other"
            content = os.readlink(path).encode() if kind == "link" else path.read_bytes() if kind == "file" else b""
            found[str(path.relative_to(folder))] = (kind, content)
    return found


def make_victim(folder: Path) -> Path:
    """Make a folder beside a data set that nothing may touch."""
    victim = folder / "victim"
    (victim / "train").mkdir(parents=True)
    (victim / "thesis.txt").write_text("ten years")
    return victim
