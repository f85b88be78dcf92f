"""Tick batches with physics arrays of pseudo-random values seeded by episode and frame, zarr stores made of them, and records of attempts,
as attempts.jsonl has them."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.apps.viz.explain_record import SeenAttempt
from synpick_warp.codes import Ending
from synpick_warp.configs.schema import Config, Trajectory
from synpick_warp.dataset.annotations import InstanceObservation, RecordedObservation
from synpick_warp.exporters.trajectory.arrays import STEPS, TICKS, TrajectoryArray
from synpick_warp.exporters.trajectory.exporter import TrajectoryExporter
from synpick_warp.testing import box_views
from synpick_warp.testing.exporters import exporting, finish
from synpick_warp.views.frames import EpisodeEnd, TickBatch


def seen_object(instance: int, object_id: int, suction: tuple[float, float], **other: Any) -> dict[str, Any]:
    """An entry of perception.instances; its three candidates lie beside each other, the suction point is the pole."""
    column, row = suction
    entry = {
        "instance": instance,
        "object_id": object_id,
        "visible": 100,
        "visible_fraction": 0.5,
        "pole": [column, row],
        "centroid": [column + 8.0, row],
        "midpoint": [column + 4.0, row],
        "distances": [6.0, 3.0, 5.1],
        "grasp_pixel": [round(column), round(row)],
        "depth": 1.4,
        "above": [],
        "ancestors": [],
    }
    return entry | other


def record(seen: list[dict[str, Any]], **other: Any) -> dict[str, Any]:
    """A line of attempts.jsonl: attempt 0 of episode 0, from image 0, that picked the first object of those given."""
    target = seen[0]["instance"] if seen else None
    line = {
        "episode": 0,
        "attempt": 0,
        "mode": "pick",
        "frame": 0,
        "end_frame": 4,
        "outcome": "target_picked",
        "sentence": "the target hung on the cup after the lift",
        "target": target,
        "object_id": seen[0]["object_id"] if seen else None,
        "point": [0.0, 0.0, 0.1],
        "normal": [0.0, 0.0, 1.0],
        "yaw": 0.0,
        "tilt": 0.2,
        "rays": 10,
        "hits": 10 if seen else 0,
        "good_seal": bool(seen),
        "engaged": [target] if seen else [],
        "picked": [target] if seen else [],
        "peak_force": [0.0, 20.0, 20.0, 20.0] if seen else [],
        "observation": {"resolution": [96, 72], "instances": seen, "votes": []},
    }
    return line | other


def nothing_seen(**other: Any) -> dict[str, Any]:
    """The line of an attempt that ended before it began."""
    gone = {
        "sentence": "no object in the tote is visible",
        "outcome": "nothing_seen",
        "point": None,
        "normal": None,
        "yaw": None,
        "tilt": None,
    }
    return record([]) | gone | other


def attempt(
    seen: tuple[InstanceObservation, ...], votes: dict[tuple[int, int], float], target: int | None = None, **other: Any
) -> SeenAttempt:
    """An attempt as `read_attempts` returns it, with the graph that is given."""
    observation = RecordedObservation((96, 72), list(seen), [(*edge, number) for edge, number in votes.items()])
    values: dict[str, Any] = {"sentence": "s", "target": target, "tilt": None, "hits": 10, "good_seal": True}
    return SeenAttempt(**record([], **values | other, observation=observation))


def seen(instance: int, above: frozenset[int] = frozenset(), ancestors: frozenset[int] | None = None, **other: Any) -> InstanceObservation:
    """A seen object as `read_attempts` returns it; its obj_id is its instance plus 1."""
    graph = {"above": sorted(above), "ancestors": sorted(above if ancestors is None else ancestors)}
    return InstanceObservation(**seen_object(instance, instance + 1, (10.0, 10.0)) | graph | other)


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
