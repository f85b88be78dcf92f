"""Exporter of LeRobot v3 data sets: videos a camera and episode, states, actions and task sentences a frame, for robot learning; and tables
over all episodes: data, episodes, tasks, statistics, info.json and dataset card, from the parts.

Parts are read one after the other, so memory does not grow with the number of frames; only the list of episodes is held. Statistics of
numbers are merged as LeRobot does it: quantiles of all are means of the episodes', weighted by frames. Those of colours follow from
histograms, which add up exactly.
"""

import json
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from synpick_warp.codes import Outcome, Task, names
from synpick_warp.configs.cell.cameras import Size
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.base import EpisodeExporter, ExportContext, SharedFiles, StagedEpisode, StoredScene
from synpick_warp.exporters.lerobot import layout as lerobot
from synpick_warp.exporters.lerobot.episode import TICK, LerobotPart, commit_episode, frame_path, group_path, make_folders
from synpick_warp.exporters.lerobot.video import GROUP, write_frame, write_spooled_group, write_stored_group
from synpick_warp.exporters.writing.files import PARTIAL, output_errors, sync_file, sync_folder
from synpick_warp.exporters.writing.notes import describe_lenses, note_files, write_notes
from synpick_warp.exporters.writing.pool import WriterPool, WriteTask
from synpick_warp.system.inputs.files import path_inside, read_json
from synpick_warp.system.linear_algebra import dot
from synpick_warp.system.processes.shared_memory import shared_bytes
from synpick_warp.views.frames import EpisodeEnd, FrameBatch, TickBatch

ROW_GROUP = 20_000
"""Frames of a row group of the data: about 2 MB."""
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""LeRobot's names and values."""
_WHITE = 255.0
Statistics = dict[str, np.ndarray]
_ADVICE = "remove it, its episode's videos and two files in manifest/, and resume the bake"


@dataclass(eq=False)
class _Totals:
    """Totals over all episodes read so far."""

    tasks: dict[str, int] = field(default_factory=dict)
    """Sentence -> index, in order of appearance."""
    statistics: dict[str, Statistics] = field(default_factory=dict)
    levels: dict[str, np.ndarray] = field(default_factory=dict)
    """Histogram of the channels of each camera, by its name."""
    frames: int = 0
    rows: list[dict[str, Any]] = field(default_factory=list)
    """Rows of the table of episodes."""


def write_indices(out: Path, settings: ExportSettings, episodes: Iterable[int]) -> list[Path]:
    """Write the tables over the committed episodes, sorted; returns them, relative to the data set. Raises DatasetError if a part is
    damaged, and OSError if a file cannot be written."""
    rig, rate, totals = settings.rig, lerobot.frame_rate(settings.physics), _Totals()
    totals.levels = {name: np.zeros((3, 256), np.int64) for name in rig.names}
    with pq.ParquetWriter(out / PARTIAL / "data.parquet", _data_schema(), compression="zstd") as writer:
        for batch in _batch_tables(_read_tables(out, totals, rig.sizes, rate, settings.layout, episodes)):
            writer.write_table(batch)
    _place(out, lerobot.DATA, lambda path: (out / PARTIAL / "data.parquet").replace(path))
    _place(
        out,
        lerobot.EPISODES,
        lambda path: pq.write_table(pa.Table.from_pylist(totals.rows, _episode_schema(rig.names)), path, compression="zstd"),
    )
    _place(out, lerobot.TASKS, lambda path: pq.write_table(_task_table(totals.tasks), path))
    videos = {lerobot.camera_key(name): describe_levels(levels, totals.frames) for name, levels in totals.levels.items() if levels.any()}
    statistics = {name: to_json(values) for name, values in (totals.statistics | videos).items()}
    splits = [row["source/split"] for row in totals.rows]
    info = lerobot.make_info(rig, rate, splits, totals.frames, len(totals.tasks))
    info["features"]["attempt.outcome"]["info"] = {"codes": list(names(Outcome))}
    for place, content in ((lerobot.STATS, statistics), (lerobot.INFO, info)):
        text = json.dumps(content, indent=2) + "\n"
        _place(out, place, lambda path, text=text: path.write_text(text, encoding="ascii"))
    _place(out, lerobot.CARD, lambda path: path.write_text(_make_card(settings, totals), encoding="utf-8"))
    return [lerobot.INFO, lerobot.STATS, lerobot.TASKS, lerobot.EPISODES, lerobot.DATA, lerobot.CARD]


def _place(out: Path, name: Path, write: Callable[[Path], object]) -> None:
    """Write a file atomically: beside its place, synced, then renamed."""
    place = out / name
    make_folders(out, place.parent)
    temporary = out / PARTIAL / "lerobot-index"
    temporary.unlink(missing_ok=True)
    write(temporary)
    sync_file(temporary)
    temporary.replace(place)
    sync_folder(place.parent)


def _read_tables(
    out: Path, totals: _Totals, sizes: tuple[Size, ...], rate: float, layout: DataLayout, episodes: Iterable[int]
) -> Iterator[pa.Table]:
    """Yield the tables of the episodes' frames, in order, and add them to the totals; episodes that were given up have no part."""
    period = 1.0 / rate
    for source in (episode for episode in episodes if os.path.lexists(out / lerobot.part_path(episode))):
        name = lerobot.part_path(source)
        part = read_json(path_inside(out, str(name), out / lerobot.PARTS, DatasetError), LerobotPart, DatasetError, _ADVICE)
        if len(part.levels) != len(totals.levels):
            raise DatasetError(f"{out / name} has {len(part.levels)} cameras, the settings {len(totals.levels)}; {_ADVICE}")
        for levels, pixels in zip(part.levels, (part.frames * math.prod(size) for size in sizes), strict=True):
            if not all(part.frames <= sum(channel) <= pixels for channel in levels):
                raise DatasetError(f"{out / name} has a histogram of no pixel a frame, or of more than {pixels:,} pixels; {_ADVICE}")
        columns = _make_columns(part, totals, period)
        _add_episode(source, part, columns, totals, period)
        totals.rows[-1]["source/split"] = lerobot.split_name(layout, source)
        yield pa.table({name: _to_array(columns[name], feature) for name, feature in lerobot.FRAME_FEATURES.items()}, _data_schema())


def _make_columns(part: LerobotPart, totals: _Totals, period: float) -> dict[str, np.ndarray]:
    """Columns of an episode's frames, with their indices in the whole data set."""
    rows = np.frombuffer(part.rows, lerobot.ROW)
    frames = np.arange(part.frames)
    tasks = np.array([totals.tasks.setdefault(sentence, len(totals.tasks)) for sentence in part.sentences])
    columns = {
        "observation.state": rows["state"],
        "action": rows["action"],
        "next.reward": rows["reward"],
        "next.success": rows["success"],
        "next.done": frames == part.frames - 1,
        "attempt.index": rows["attempt"],
        "attempt.outcome": rows["outcome"],
        "timestamp": frames * period,
        "frame_index": frames,
        "episode_index": np.full(part.frames, len(totals.rows)),
        "index": totals.frames + frames,
        "task_index": tasks[rows["task"]],
    }
    return {name: columns[name].astype(feature.dtype) for name, feature in lerobot.FRAME_FEATURES.items()}


def _add_episode(source: int, part: LerobotPart, columns: dict[str, np.ndarray], totals: _Totals, period: float) -> None:
    """Add a row of the table of episodes, and the episode's statistics."""
    numbers = {name: describe_numbers(values.reshape(part.frames, -1)) for name, values in columns.items()}
    levels = {name: np.array(own) for name, own in zip(totals.levels, part.levels, strict=True)}
    statistics = numbers | {lerobot.camera_key(name): describe_levels(own, part.frames) for name, own in levels.items()}
    row: dict[str, Any] = {
        "episode_index": len(totals.rows),
        "tasks": part.sentences,
        "length": part.frames,
        "dataset_from_index": totals.frames,
        "dataset_to_index": totals.frames + part.frames,
        **dict.fromkeys(("data/chunk_index", "data/file_index", "meta/episodes/chunk_index", "meta/episodes/file_index"), 0),
        "source/episode": source,
        "source/mode": part.mode,
        "source/ending": part.ending,
        "source/attempts": part.attempts,
        "source/picked": part.picked,
    }
    for camera, own in levels.items():
        place = f"videos/{lerobot.camera_key(camera)}"
        row |= {f"{place}/chunk_index": source // lerobot.CHUNK, f"{place}/file_index": source % lerobot.CHUNK}
        row |= {f"{place}/from_timestamp": 0.0, f"{place}/to_timestamp": part.frames * period}
        totals.levels[camera] += own
    for name, values in statistics.items():
        row |= {f"stats/{name}/{key}": value for key, value in to_json(values).items()}
    for name, values in numbers.items():
        totals.statistics[name] = merge_numbers(totals.statistics[name], values) if name in totals.statistics else values
    totals.rows.append(row)
    totals.frames += part.frames


def describe_numbers(values: np.ndarray) -> Statistics:
    """Statistics of each component of values (frame, component), over frames."""
    numbers = values.astype(np.float64)
    quantiles = np.quantile(numbers, list(QUANTILES.values()), axis=0)
    return {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([len(numbers)]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def merge_numbers(total: Statistics, more: Statistics) -> Statistics:
    """Statistics of two sets of frames together; quantiles are weighted means."""
    count = total["count"] + more["count"]
    share = more["count"] / count
    mean = total["mean"] + share * (more["mean"] - total["mean"])
    spread = total["std"] ** 2 * (1 - share) + more["std"] ** 2 * share + share * (1 - share) * (more["mean"] - total["mean"]) ** 2
    return {
        "min": np.minimum(total["min"], more["min"]),
        "max": np.maximum(total["max"], more["max"]),
        "mean": mean,
        "std": np.sqrt(spread),
        "count": count,
        **{name: (1 - share) * total[name] + share * more[name] for name in QUANTILES},
    }


def describe_levels(levels: np.ndarray, frames: int) -> Statistics:
    """Statistics of a video's channels, from 0 to 1 and of shape (3, 1, 1), from their histograms (3, 256); quantiles are levels."""
    values = np.arange(levels.shape[1]) / _WHITE
    weights = levels / levels.sum(axis=1, keepdims=True)
    mean = dot(weights, values)
    reached = np.cumsum(levels, axis=1)
    channels = {
        "min": values[np.argmax(levels > 0, axis=1)],
        "max": values[levels.shape[1] - 1 - np.argmax(levels[:, ::-1] > 0, axis=1)],
        "mean": mean,
        "std": np.sqrt(np.sum(weights * (values - mean[:, None]) ** 2, axis=1)),
        **{name: values[np.argmax(reached >= fraction * reached[:, -1:], axis=1)] for name, fraction in QUANTILES.items()},
    }
    return {**{name: value.reshape(-1, 1, 1) for name, value in channels.items()}, "count": np.array([frames])}


def to_json(statistics: Statistics) -> dict[str, Any]:
    """Statistics as lists, for JSON."""
    return {name: value.tolist() for name, value in statistics.items()}


def _batch_tables(tables: Iterator[pa.Table]) -> Iterator[pa.Table]:
    """Join tables to row groups of at least ROW_GROUP rows, but the last."""
    waiting: list[pa.Table] = []
    for table in tables:
        waiting.append(table)
        if sum(map(len, waiting)) >= ROW_GROUP:
            yield pa.concat_tables(waiting).combine_chunks()
            waiting = []
    if waiting:
        yield pa.concat_tables(waiting).combine_chunks()


def _to_array(values: np.ndarray, feature: lerobot.Feature) -> pa.Array:
    """Arrow array of a feature's column: scalars, or fixed-size lists for vectors."""
    flat = pa.array(np.ascontiguousarray(values).ravel())
    return pa.FixedSizeListArray.from_arrays(flat, len(feature.names)) if feature.names else flat


def _data_schema() -> pa.Schema:
    fields = []
    for name, feature in lerobot.FRAME_FEATURES.items():
        kind = pa.from_numpy_dtype(np.dtype(feature.dtype))
        fields.append((name, pa.list_(kind, len(feature.names)) if feature.names else kind))
    return pa.schema(fields)


def _episode_schema(cameras: Sequence[str]) -> pa.Schema:
    integers = ("episode_index", "length", "dataset_from_index", "dataset_to_index", "data/chunk_index", "data/file_index")
    fields: dict[str, pa.DataType] = dict.fromkeys(integers, pa.int64()) | {"tasks": pa.list_(pa.string())}
    fields |= dict.fromkeys(("meta/episodes/chunk_index", "meta/episodes/file_index"), pa.int64())
    fields |= dict.fromkeys(("source/episode", "source/attempts", "source/picked"), pa.int64())
    fields |= dict.fromkeys(("source/mode", "source/ending", "source/split"), pa.string())
    numbers = pa.list_(pa.float64())
    kinds = dict.fromkeys(lerobot.FRAME_FEATURES, numbers)
    for camera in cameras:
        place = f"videos/{lerobot.camera_key(camera)}"
        fields |= dict.fromkeys((f"{place}/chunk_index", f"{place}/file_index"), pa.int64())
        fields |= dict.fromkeys((f"{place}/from_timestamp", f"{place}/to_timestamp"), pa.float64())
        kinds[lerobot.camera_key(camera)] = pa.list_(pa.list_(numbers))
    keys = tuple(describe_numbers(np.zeros((1, 1))))
    fields |= {f"stats/{name}/{key}": pa.list_(pa.int64()) if key == "count" else kind for name, kind in kinds.items() for key in keys}
    return pa.schema(list(fields.items()))


def _task_table(tasks: dict[str, int]) -> pa.Table:
    """Table of sentences, which pandas reads with the sentence as index, as LeRobot expects."""
    strings = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    numbers = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
    notes = {
        "index_columns": ["task"],
        "column_indexes": [{"name": None, "field_name": None, **strings, "metadata": {"encoding": "UTF-8"}}],
        "columns": [
            {"name": "task_index", "field_name": "task_index", **numbers},
            {"name": "task", "field_name": "task", **strings},
        ],
        "creator": {"library": "synpick-warp", "version": ""},
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array(list(tasks.values()), pa.int64()), "task": pa.array(list(tasks), pa.string())})
    return table.replace_schema_metadata({"pandas": json.dumps(notes)})


def _make_card(settings: ExportSettings, totals: _Totals) -> str:
    """Dataset card for the Hugging Face hub, whose visualizer of LeRobot data sets goes by the tag."""
    bake, has_splits = settings.bake, bool(settings.layout.splits)
    licence = "unknown" if bake.models or bake.lights else "mit"
    names = list(dict.fromkeys(row["source/split"] for row in totals.rows))
    only = "validation" if names == ["val"] else names[0] if names else "train"
    files = " data/*/*.parquet" if has_splits else f"\n  - split: {only}\n    path: data/*/*.parquet"
    splits = f"\nSplits (ranges of episodes in `meta/info.json`): {', '.join(names)}.\n" if has_splits else ""
    return f"""---
license: {licence}
task_categories: [robotics]
tags: [LeRobot, bin-picking, suction, synthetic]
configs:
- config_name: default
  data_files:{files}
---
# Bin picking with a suction gripper
{describe_lenses(settings)}
{len(totals.rows):,} episodes of {totals.frames:,} frames, simulated by synpick-warp, in LeRobot's format {lerobot.VERSION}.
State: cup pose in the tote's frame (x, y, z [m], quaternion x, y, z, w), whether the suction is on, whether an object hangs on the cup.
Action: setpoint of the wrist [m] and suction command. Tasks name the object that each attempt picks.
{splits}"""


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
