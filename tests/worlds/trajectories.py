"""Tick batches with physics arrays of pseudo-random values seeded by episode and frame, and zarr stores made of them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.codes import Ending
from synpick_warp.configs.schema import Config, Trajectory
from synpick_warp.exporters.trajectory.arrays import STEPS, TICKS, TrajectoryArray
from synpick_warp.exporters.trajectory.exporter import TrajectoryExporter
from synpick_warp.testing import box_views
from synpick_warp.testing.exporters import exporting, finish
from synpick_warp.views.frames import EpisodeEnd, TickBatch
from tests.worlds.attempt_records import nothing_seen, record

STEP_COUNT = 4
COMPUTED = ("time",)
PICKED = {"target": 2, "object_id": 7, "hits": 9, "engaged": [2], "picked": [2, 3], "peak_force": [0.0, 3.25]}
GRASP = {"point": [0.1, 0.2, 0.3], "yaw": 0.25, "tilt": -0.5}
OBSERVATION = {"resolution": [4, 3], "instances": [], "votes": []}
ATTEMPT = record([], frame=1, end_frame=5, sentence="the target hung", observation=OBSERVATION, **PICKED, **GRASP)
UNSEEN = nothing_seen(attempt=1, frame=6, end_frame=7, sentence="the target hung", observation=OBSERVATION)


def config(**trajectory: Any) -> Config:
    """Settings with small chunks, so that a few frames fill several files."""
    base = box_views.config()
    physics = dataclasses.replace(base.physics, steps_per_tick=STEP_COUNT)
    arrangement = dataclasses.replace(base.arrangement, max_objects=box_views.ROOM)
    return dataclasses.replace(
        base, physics=physics, arrangement=arrangement, trajectory=Trajectory(**({"chunk_ticks": 2, "shard_chunks": 3} | trajectory))
    )


def ticks(episodes: tuple[int, ...], frames: int, steps: bool = True) -> Iterator[TickBatch]:
    """Like `box_views.ticks` for all episodes in parallel, with physics arrays."""
    yield from (with_physics(batch, steps) for batch in box_views.ticks(len(episodes), episodes, frames))


def with_physics(batch: TickBatch, steps: bool = True) -> TickBatch:
    """A batch with physics arrays."""
    room, names = batch.pose.shape[1], zip(batch.episode, batch.frame, strict=True)
    rows = [_physics(int(episode), int(frame), steps, room) for episode, frame in names]
    parts = [{name: np.stack([row[part][name] for row in rows]) for name in rows[0][part]} for part in range(2)]
    return dataclasses.replace(batch, tick=parts[0], steps=parts[1])


def _physics(episode: int, frame: int, steps: bool, room: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    numbers = np.random.default_rng((episode, frame))
    own = {item.name for item in dataclasses.fields(TickBatch)}
    tick = {name: _random_array(numbers, spec, room) for name, spec in TICKS.arrays.items() if name not in own}
    drops = np.random.default_rng(episode).normal(size=(room, 7)).astype(np.float32)
    tick |= {"mode": np.int32(1), "redrops": np.int32(episode), "drop_pose": drops}
    stepped = {name: _random_array(numbers, spec, room) for name, spec in STEPS.arrays.items() if name not in COMPUTED} if steps else {}
    return tick, stepped


def _random_array(numbers: np.random.Generator, spec: TrajectoryArray, room: int) -> np.ndarray:
    shape = spec.shape({"tick": 1, "step": STEP_COUNT, "instance": room})
    shape = shape[1:] if spec.dims[0] == "tick" else shape
    kind = np.dtype(spec.dtype)
    if kind.kind == "f":
        return numbers.normal(size=shape).astype(kind)
    return numbers.integers(0, 2, shape).astype(np.uint8 if kind.kind == "b" else kind)


def ends(episodes: tuple[int, ...], frames: int) -> list[EpisodeEnd]:
    """Ends of episodes, each with two attempts, the second without a visible object."""
    result = []
    for episode in episodes:
        lines = tuple(json.dumps(record | {"episode": episode}) + "\n" for record in (ATTEMPT, UNSEEN))
        result.append(EpisodeEnd(episode, 1, frames, int(Ending.EMPTIED), {"episode": episode, "mode": "pick", "picked": 2}, lines))
    return result


def write_set(out: Path, settings: Config, episodes: tuple[int, ...], frames: int, processes: int = 0, steps: bool = True) -> Path:
    """Write a complete data set."""
    with exporting(TrajectoryExporter, out, settings, processes) as exporter:
        exporter.write_constants()
        for batch in ticks(episodes, frames, steps):
            exporter.write_ticks(batch)
        for end in ends(episodes, frames):
            exporter.end_episode(end, lambda: None)
        finish(exporter)
    return out
