"""Soak test (leak check) of the writers of all formats: memory and open files over many ticks.

    python -m tests.harness.soak --ticks 10000

prints progress lines, and at the end JSON: samples of memory [B] and of open files, each summed over the bake and its writers.
"""

import argparse
import dataclasses
import json
import os
import shutil
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.codes import Ending
from synpick_warp.configs.dataset import ExportSettings
from synpick_warp.configs.schema import FORMATS, Config
from synpick_warp.dataset.commit.manifest import episode_entry, read_entry
from synpick_warp.dataset.commit.writing import OutputFolder, commit_episode
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.registry import Exporters, Needs
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.factory.episodes import EpisodeOutcome
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.testing import box_views
from synpick_warp.views.frames import EpisodeEnd, FrameBatch, TickBatch
from tests.worlds import trajectories

WORLDS = 2
FRAMES = 10
"""Number of frames of an episode."""
REPEATED = 8
"""Number of distinct frames, which repeat."""
SAMPLES = 50
KEPT = 4
"""Number of latest episodes whose files are kept, so that the disk does not fill up."""


def settings() -> tuple[Config, tuple]:
    """Settings with small images and all formats, and the cameras."""
    lenses = box_views.cameras(48, 36)
    config = trajectories.config(chunk_ticks=8, shard_chunks=4)
    bake = dataclasses.replace(config.bake, formats=FORMATS, episodes=1)
    return dataclasses.replace(config, bake=bake, cameras=dataclasses.replace(config.cameras, resolution=(48, 36))), lenses


def relabel(batch: Any, episodes: np.ndarray, frame: int) -> Any:
    """Copy of a batch with other episode and frame indices."""
    index = np.repeat(episodes, len(batch.episode) // len(episodes)).astype(np.int32)
    return dataclasses.replace(batch, episode=index, frame=np.full(len(index), frame, np.int32))


def sample(pool: WriterPool) -> tuple[int, int]:
    """Measure resident memory [B] and number of open files of the bake and its writers."""
    memory = files = 0
    for process in (os.getpid(), *pool.pids()):
        memory += int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        files += len(os.listdir(f"/proc/{process}/fd"))
    return memory, files


def soak(ticks: int, writers: int, out: Path) -> tuple[list[int], list[int]]:
    """Run the writers; returns samples of memory and of open files."""
    config, lenses = settings()
    needs, worlds = Needs.of(config), tuple(range(WORLDS))
    views = box_views.batches(WORLDS * len(lenses), worlds, REPEATED, lenses)
    frames: list[tuple[FrameBatch, TickBatch]] = list(zip(views, trajectories.ticks(worlds, REPEATED), strict=True))
    memory, files = [], []
    with OutputFolder(out, config, ()) as output, WriterPool(writers, needs.slot_bytes, output.lock) as pool:
        exporters = Exporters(needs.classes, ExportContext(out, ExportSettings.of(config), box_views.catalog(), lenses, skies(), pool))
        output.prepare(exporters, {}, pool)
        for tick in range(ticks):
            first, frame = divmod(tick, FRAMES)
            episodes = np.arange(WORLDS) + WORLDS * first
            view_batch, tick_batch = frames[frame % REPEATED]
            exporters.write_ticks(relabel(tick_batch, episodes, frame))
            exporters.write_views(relabel(view_batch, episodes, frame))
            if frame == FRAMES - 1:
                for episode in episodes.tolist():
                    row = EpisodeOutcome(episode, 0, Ending.FINISHED, FRAMES, 1.0, "pick", 3, 1, 1, 0, 2)
                    attempt = json.dumps(trajectories.ATTEMPT | {"episode": episode}) + "\n"
                    end = EpisodeEnd(episode, 0, FRAMES, int(Ending.FINISHED), row.as_json(), (attempt,))
                    exporters.end_episode(end, partial(commit_episode, output.out, exporters, pool, end))
                _remove_old(out, exporters, WORLDS * (first - KEPT))
            if (tick + 1) % max(1, ticks // SAMPLES) == 0:
                pool.wait()
                for values, value in zip((memory, files), sample(pool), strict=True):
                    values.append(value)
                print(f"{tick + 1:6d} ticks  {memory[-1] / 1e6:8.2f} MB  {files[-1]} files", file=sys.stderr, flush=True)
        exporters.close()
    return memory, files


def _remove_old(out: Path, exporters: Exporters, before: int) -> None:
    for episode in range(max(0, before - WORLDS), before):
        assert read_entry(out, episode_entry(episode))
        for path in (*exporters.files(episode), *(Path(f"{episode_entry(episode)}{suffix}") for suffix in (".json", ".sha256"))):
            shutil.rmtree(out / path) if (out / path).is_dir() else (out / path).unlink()


def main() -> None:
    """Command line; see the module's docstring."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--ticks", type=int, default=10_000)
    parser.add_argument("--writers", type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        memory, files = soak(options.ticks, options.writers, Path(folder) / "set")
    late = memory[len(memory) // 5 :]
    print(json.dumps({"memory": memory, "files": files, "growth": max(late) / min(late) - 1.0}))


if __name__ == "__main__":
    main()
