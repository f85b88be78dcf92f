"""Online generator: the views of a bake, batch by batch on the device, made as the consumer takes them.

    for batch in synpick_warp.stream("synpick", mode="mixed", episodes=range(10_000)):
        color = torch.from_dlpack(batch.color)

It runs in the caller's process and starts no other (but CoACD's, while concave objects are decomposed for the first time).
"""

import gc
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import warp as wp

from synpick_warp.codes import Phase
from synpick_warp.configs.check import to_index
from synpick_warp.configs.dataset import DataLayout, check_shard
from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.configs.files.load import override_config
from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError
from synpick_warp.factory.assembly import Stages, build_online, group_layers
from synpick_warp.factory.episodes import BakeSummary, is_resampled
from synpick_warp.factory.memory_plan import check_episodes, explain_shortage
from synpick_warp.scenes.bin_meshes.loading import load_settings, measure_meshes
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.online.batches import BatchRing, ViewBatch
from synpick_warp.stages.render.view_setup import pair_views
from synpick_warp.stages.stream import TickReport, describe_batches
from synpick_warp.stages.ticks import TickLoop
from synpick_warp.system.progress import Progress

ARGUMENTS = {
    "worlds": "bake.worlds",
    "device": "bake.device",
    "seed": "bake.seed",
    "mode": "bake.mode",
    "models": "bake.models",
    "lights": "bake.lights",
    "resolution": "cameras.resolution",
    "layers": "render.layers",
    "batch": "render.views_per_batch",
}
"""Full key of the setting that each keyword argument of `synpick_warp.stream` overrides."""


def resolve_settings(
    config: Config | Path | str | None, settings: Mapping[str, object], arguments: Mapping[str, object], splits: bool = False
) -> Config:
    """Resolve the settings of a stream: arguments by the keys of ARGUMENTS (None: not given) override full keys, such as "bake.mode", and
    both the configuration, or that of a preset or .toml file; None: the default preset. `splits`: whether the splits that a preset defines
    apply; those of a file always do. Raises ConfigError if a setting is unknown or not allowed."""
    given = {ARGUMENTS[name]: value for name, value in arguments.items() if value is not None}
    if given.get("bake.worlds") == "auto":  # As the command line has it.
        given["bake.worlds"] = 0
    overrides = dict(settings) | given
    if not isinstance(config, Config):
        return load_settings(config, overrides, splits=splits)
    config = override_config(config, overrides)
    return override_config(config, measure_meshes(config.bin, config.gripper))


@dataclass(frozen=True)
class Selection:
    """Subset of cameras and frames of each episode to render.

    The other views keep their poses, depth and masks. With a stride above 1 their light is not averaged over frames (`render.history`).
    """

    cameras: Sequence[int] | None = None
    """Indices of the cameras; None: all."""
    stride: int = 1
    """Every n-th frame of an episode, from the first on."""

    def resolve(self, count: int) -> "Selection":
        """Selection with its cameras named, out of `count`; raises ConfigError if there is no such camera, or a value is out of range."""
        given = range(count) if self.cameras is None else self.cameras
        cameras = tuple(to_index(camera) for camera in given) if isinstance(given, Iterable) else ()
        if not cameras or len(set(cameras)) < len(cameras) or not set(cameras) <= set(range(count)):
            raise ConfigError(f"cameras are {list(given) if cameras else given}; allowed: one or more of 0 to {count - 1}, each once")
        stride = to_index(self.stride)
        if stride is None or stride < 1:
            raise ConfigError(f"stride is {self.stride!r}; allowed: a whole number from 1 on")
        return replace(self, cameras=cameras, stride=stride)


def choose_episodes(
    layout: DataLayout, episodes: int | range | None, shard: tuple[int, int], splits: Sequence[str]
) -> tuple[int, list[int]]:
    """Choose the episode indices of a stream, in order; returns `bake.episodes` of settings that plan these episodes, and the indices.

    `episodes` are how many, from 0 on, or their indices, None: those that the settings plan; `shard` (i, n): only indices with index % n ==
    i; `splits`: only their episodes, empty: all. Raises ConfigError if there is no such split, an index is out of range, or `episodes` are
    given beside splits."""
    check_shard(shard)
    index, count = shard
    if episodes is None:
        return layout.episodes, [episode for each in layout.plan(splits, shard) for episode in each]
    if splits or layout.splits:
        raise ConfigError("episodes are given beside splits, which name their episodes; give one of both")
    chosen = range(episodes) if isinstance(episodes, int) else episodes
    # The ends of a range: min and max would go through all of it.
    if not isinstance(chosen, range) or not chosen or min(chosen[0], chosen[-1]) < 0 or max(chosen[0], chosen[-1]) >= INT32_MAX:
        raise ConfigError(f"episodes are {episodes!r}; allowed: how many, or a range of indices from 0 to {INT32_MAX - 1}")
    planned = max(chosen[0], chosen[-1]) + 1
    check_episodes(-(-len(chosen) // count), planned)
    return planned, [episode for episode in chosen if episode % count == index]


class ViewStream:
    """Iterator over batches of views. Each batch is valid until the next one is requested.

    On a GPU the batch after the one handed out is queued already, and physics is ahead as `TickLoop` has it, on a stream of its own beside
    the rendering, so that the GPU is busy while the consumer works; nothing else is made ahead. On the CPU a batch is made on request.

    A stream that is left early, by `break`, an error or `close`, frees its worlds and buffers; arrays that another library has imported
    live on as long as that library keeps them.

    Attributes:
        config: The settings.
        cameras: Cameras of the views, by camera index.
        object_names: Name of each object, by obj_id.
        summary: How the episodes so far ended, as `bake` returns it; `views` counts those handed out.
    """

    def __init__(self, producer: "Producer") -> None:
        stages = producer.stages
        self.config, self.cameras, self.summary = stages.config, stages.cameras, producer.summary
        self.object_names = {entry.obj_id: entry.name for entry in stages.catalog.entries}
        self.device = stages.simulation.device
        # The generator must not refer to this object: without a cycle, the last reference frees the device's memory at once.
        self._batches: Iterator[ViewBatch] | None = _batches(producer)
        self._simulation = weakref.ref(stages.simulation)
        self._rings: tuple[BatchRing, ...] | None = producer.rings
        self._stream = self.device.stream if self.device.is_cuda else None
        self._current: ViewBatch | None = None
        self._ahead: ViewBatch | None = None
        producer.progress.stage("loading kernels, dropping objects")

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> ViewBatch:
        if self._batches is None:
            raise StopIteration
        if self._current is not None:
            self._current.expire()
            self._current = None
        try:
            with wp.ScopedStream(self._stream, sync_enter=False):
                batch = self._ahead if self._ahead is not None else next(self._batches, None)
                self._ahead = next(self._batches, None) if self._stream is not None and batch is not None else None
        except BaseException:
            self.close()
            raise
        if batch is None:
            self.close()
            raise StopIteration
        self._current = batch
        self.summary.views += len(batch)
        return batch

    def close(self) -> None:
        """End the stream and free its worlds and buffers; the current batch expires. May be called again."""
        batches, self._batches = self._batches, None
        if batches is None:
            return
        for batch in (self._current, self._ahead):
            if batch is not None:
                batch.expire()
        self._current = self._ahead = None
        if self._stream is not None:
            # Consumers' queues may still read the buffers, and freed memory goes to whoever asks next.
            wp.synchronize_device(self.device)
        self._rings = None
        batches.close()  # type: ignore[attr-defined]
        if self._simulation() is not None:
            # Warp's code generation catches exceptions in cycles with their frames, and these hold all callers' variables: the worlds of
            # a stream that compiled kernels. A full collection, which may be minutes away, frees them.
            gc.collect()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def __del__(self) -> None:
        try:
            self.close()
        except Exception:  # At the interpreter's end, modules may be gone.
            self._batches = self._rings = None


class Producer:
    """Producer of a stream's batches: takes ticks from a `TickLoop`, renders the selected views, and logs ended episodes."""

    def __init__(
        self, stages: Stages, rings: tuple[BatchRing, ...], selection: Selection, summary: BakeSummary, progress: Progress
    ) -> None:
        self.stages, self.rings, self.selection, self.summary, self.progress = stages, rings, selection, summary, progress
        self.log = stages.make_log()
        self.object_ids = np.append(stages.object_ids, -1).astype(np.int32)

    def batches(self) -> Iterator[ViewBatch]:
        """Yield batches until no episode remains; each must have expired before the ring reuses its slot.

        A GPU simulates the following ticks while this one is rendered.
        """
        with TickLoop(self.stages.simulation) as ticks:
            while True:
                report, snapshot = ticks.advance()
                for batch in self.render(report, snapshot):
                    ticks.enqueue()
                    yield batch
                self._end_episodes(report)
                if (report.column("phase") == Phase.IDLE).all():
                    return

    def render(self, report: TickReport, snapshot: Snapshot) -> Iterator[ViewBatch]:
        """Render the selected views of a tick, group by group of cameras, world by world and camera by camera."""
        frame = report.column("frame")
        for ring in self.rings:
            shown = report.column("live").astype(bool) & (frame % self.selection.stride == 0) & (frame % ring.group.every == 0)
            cameras = [camera for camera in self.selection.cameras or () if camera in ring.group.cameras]
            world, camera = pair_views(np.flatnonzero(shown), np.array(cameras, np.int32))
            known = (self.stages.tick_time, self.object_ids, self.stages.light_table, self.stages.config.cell.recorded)
            batches = describe_batches(ring.group, report, world, camera, *known, cameras=self.stages.episode_cameras)
            for part, wide, (host, last) in batches:
                host["arrangement"] = report.column("arrangement")[world[part]]
                yield ring.render(snapshot, world[part], camera[part], host, last, wide)

    def _end_episodes(self, report: TickReport) -> None:
        """Add the episodes that ended in a tick to the summary."""
        config, records = self.stages.config, self.log.update(report)
        for world in np.flatnonzero(report.column("phase") == Phase.OVER).tolist():
            record = records[int(report.column("episode")[world])]
            row = self.stages.episode_row(report, world, record)
            self.summary.take_end(row, record, config)
            if is_resampled(row, config.settle.tries):
                self.progress.note(f"episode {row.episode}, arrangement {row.arrangement + 1}: {row.sentence}")


def open_stream(
    config: Config,
    progress: Progress,
    *,
    episodes: int | range | None = None,
    shard: tuple[int, int] = (0, 1),
    splits: Sequence[str] = (),
    selection: Selection,
) -> ViewStream:
    """Build worlds and renderer, and open a stream of their views; arguments and errors as of `synpick_warp.stream`."""
    planned, indices = choose_episodes(DataLayout.of(config), episodes, shard, splits)
    config = config.with_values({"bake.episodes": planned})
    if not indices:
        raise ConfigError(f"shard {shard[0]}/{shard[1]} has no episode; give more episodes, or fewer parts")
    check_episodes(len(indices), config.bake.episodes)
    selection = selection.resolve(len(config.rig))
    if selection.stride > 1:
        # A history holds the frame before, which is not rendered.
        config = config.with_values({"render.history": 0})
    stages = build_online(config, progress, indices)
    with explain_shortage(stages.config):
        scale = config.bop.depth_scale
        rings = tuple(BatchRing(group, group_layers(config.rig, config.render, index), scale) for index, group in enumerate(stages.groups))
    return ViewStream(Producer(stages, rings, selection, BakeSummary(len(indices)), progress))


def _batches(producer: Producer) -> Iterator[ViewBatch]:
    """Iterate over a producer's batches; an out-of-memory error becomes a ConfigError with advice."""
    with explain_shortage(producer.stages.config):
        yield from producer.batches()
