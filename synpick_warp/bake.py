"""A bake from settings to files: the one place that knows the order of the stages."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import warp as wp

from synpick_warp.arrays import memory_table
from synpick_warp.attempts import AttemptLog, EpisodeRecord
from synpick_warp.configs.modes import may_pick
from synpick_warp.configs.schema import FAST, Config
from synpick_warp.configs.write import config_to_toml
from synpick_warp.device import pick_device
from synpick_warp.exporters.bop import BopExporter, view_bytes
from synpick_warp.exporters.files import output_error, write_whole
from synpick_warp.exporters.pool import WriterPool
from synpick_warp.frames import EpisodeEnd
from synpick_warp.kernels import phases
from synpick_warp.outcome import ATTEMPTS_FILE, Ending, Outcome
from synpick_warp.progress import Progress
from synpick_warp.scenes import build
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.gripper import cup_fixture, finger_fixture
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.shapes import Camera, Catalog
from synpick_warp.scenes.tote import tote_fixture
from synpick_warp.stages.bodies import BodyArrays, HitArrays, body_sizes
from synpick_warp.stages.buffers import LastFrame, LayerBuffers, Snapshot, ViewBuffers
from synpick_warp.stages.develop import SpreadArrays, has_spread
from synpick_warp.stages.fast import FAST_SCRATCH, cell_sizes
from synpick_warp.stages.layers import MOVING, MotionArrays
from synpick_warp.stages.perceive import SCRATCH, count_views, sight_sizes
from synpick_warp.stages.plan import CycleArrays, VoteArrays, plan_sizes
from synpick_warp.stages.render import PictureArrays, Renderer
from synpick_warp.stages.render_scene import build_render_scene
from synpick_warp.stages.sight import Plan, Sighting
from synpick_warp.stages.simulate import RECORDS, Simulation
from synpick_warp.stages.stream import RING, FrameStream, TickReader, TickReport, name_lights, view_sizes
from synpick_warp.stages.worlds import AttemptState, SealState, WorldState, WorldStatus, world_sizes

CONFIG_FILE = "config.toml"
"""The resolved settings, in the data set."""
EPISODES_FILE = "episodes.jsonl"
"""How every episode ended, in the data set."""


class EpisodeRow(NamedTuple):
    """One line of the summary."""

    episode: int
    redraw: int
    """How often the episode was drawn again before."""
    ending: Ending
    frames: int
    seconds: float
    """Simulated time from the first frame to the last [s]."""
    mode: str
    """What follows is 0 if the episode delivered nothing."""
    objects: int
    """At the first frame."""
    attempts: int
    picked: int
    """Objects."""
    lost: int
    """Objects that left the scene otherwise."""
    left: int
    """Objects at the last frame."""


@dataclass
class BakeSummary:
    """What a bake made."""

    episodes: list[EpisodeRow] = field(default_factory=list)
    views: int = 0
    wall_seconds: float = 0.0
    """From the first tick to the last file [s]."""
    redraws: int = 0
    """Arrangements that ended in a way that delivers nothing, and were drawn again."""
    redrawn: dict[Ending, int] = field(default_factory=dict)
    """The same, by ending."""
    outcomes: Counter[Outcome] = field(default_factory=Counter)
    """Attempts, by outcome."""
    attempts: dict[int, tuple[str, ...]] = field(default_factory=dict)
    """Lines of ATTEMPTS_FILE, by episode."""


@dataclass(frozen=True, eq=False)
class Factory:
    """Everything that a bake holds on the device."""

    catalog: Catalog
    cameras: tuple[Camera, ...]
    simulation: Simulation
    stream: FrameStream
    log: AttemptLog


def build_factory(config: Config, progress: Progress) -> Factory:
    """Load what the settings name and put it on the device.

    Raises:
        SynpickError: Device, models, lights, tote or cameras cannot be used.
    """
    device = pick_device(config.bake.device)
    progress.stage("loading objects and lights")
    cameras = make_cameras(config.cameras)
    fixtures = (tote_fixture(config.tote), finger_fixture(config.gripper), cup_fixture(config.gripper))
    catalog = load_catalog(config, report=progress.note)
    lights = load_lights(config.bake.lights)
    progress.stage(f"building {config.bake.worlds} worlds of {len(catalog)} objects on {device.alias}")
    scene = build_render_scene(config, catalog, fixtures, cameras, lights, device)
    simulation = Simulation(config, catalog, len(lights), device, render_scene=scene)
    renderer = Renderer(config, scene, config.arrangement.max_objects, view_sizes(config, device)["view"])
    object_ids = np.array([entry.obj_id for entry in catalog.entries], dtype=np.int32)
    table = name_lights([light.name for light in lights], scene.lights)
    stream = FrameStream(config, renderer, object_ids, table, device)
    return Factory(catalog, cameras, simulation, stream, AttemptLog(config, object_ids))


def run_bake(config: Config, out: Path, progress: Progress) -> BakeSummary:
    """Simulate, render and write a data set.

    Args:
        config: All settings.
        out: Folder of the data set: new, or empty.
        progress: Told what happens.

    Raises:
        SynpickError: Something a user can mend; no half-written scene stays.
    """
    factory = build_factory(config, progress)
    writers = config.bake.writers or len(os.sched_getaffinity(0))
    with WriterPool(writers, view_bytes(factory.cameras[0])) as pool:
        exporter = BopExporter(out, config, factory.catalog, factory.cameras, config.bake.episodes, pool)
        try:
            summary = BakeSummary()
            started = time.perf_counter()
            _run(config, factory, exporter, summary, progress)
            progress.stage("finishing files")
            exporter.close()
            _write_records(config, out, summary)
            summary.wall_seconds = time.perf_counter() - started
        except BaseException:
            exporter.abort()
            raise
    return summary


def _run(config: Config, factory: Factory, exporter: BopExporter, summary: BakeSummary, progress: Progress) -> None:
    """Tick until no episode is left. The device already works on the next tick while the host reads and renders this one."""
    simulation = factory.simulation
    readers = [TickReader(record) for record in simulation.records]
    meter = _Meter(config, summary, progress)
    progress.stage("compiling kernels, dropping objects")
    simulation.tick(simulation.records[0])
    readers[0].start()
    current = 0
    while True:
        following = (current + 1) % RECORDS
        simulation.tick(simulation.records[following])
        readers[following].start()
        report = readers[current].wait()
        for batch in factory.stream.render(simulation.records[current].snapshot, report):
            exporter.write(batch)
            summary.views += len(batch)
        records = factory.log.see(report)
        for end in _ends(report):
            exporter.end(end)
            _count(config, summary, end, records[end.episode], progress)
        phase = report.column("phase")
        meter.show(int(np.isin(phase, (phases.SETTLE, phases.ACT)).sum()))
        if (phase == phases.IDLE).all():
            return
        current = following


def _ends(report: TickReport) -> Iterator[EpisodeEnd]:
    for world in np.flatnonzero(report.column("phase") == phases.OVER):
        episode, redraw, frame, ending = (int(report.column(name)[world]) for name in ("episode", "redraw", "frame", "ending"))
        yield EpisodeEnd(episode, redraw, frame + 1, ending)


def _count(config: Config, summary: BakeSummary, end: EpisodeEnd, record: EpisodeRecord, progress: Progress) -> None:
    """Enter an episode's end into the summary."""
    ending = Ending(end.ending)
    if not ending.delivers and end.redraw + 1 < config.settle.tries:
        summary.redraws += 1
        summary.redrawn[ending] = summary.redrawn.get(ending, 0) + 1
        progress.note(f"episode {end.episode}, arrangement {end.redraw + 1}: {ending.sentence}")
        return
    tick = config.physics.step * config.physics.steps_per_tick
    summary.episodes.append(EpisodeRow(
        end.episode, end.redraw, ending, end.frames, max(0, end.frames - 1) * tick,
        record.mode, record.objects, len(record.attempts), record.picked, record.lost, record.left,
    ))  # fmt: skip
    summary.episodes.sort()
    summary.outcomes.update(attempt.outcome for attempt in record.attempts)
    summary.attempts[end.episode] = tuple(attempt.line() for attempt in record.attempts)


class _Meter:
    """Rates and remaining time for whoever watches."""

    def __init__(self, config: Config, summary: BakeSummary, progress: Progress) -> None:
        self.config, self.summary, self.progress = config, summary, progress
        self.started: float | None = None
        self.cameras = len(config.cameras.positions)

    def show(self, active: int) -> None:
        """Report after a tick in which `active` worlds were busy. The clock starts with the first view, when all is compiled."""
        summary, now = self.summary, time.perf_counter()
        if self.started is None and summary.views:
            self.started = now
        elapsed = now - self.started if self.started is not None else 0.0
        done = [row for row in summary.episodes if row.ending.delivers]
        left = None
        if done and elapsed > 0.0:
            # Short episodes end first: those that run may already be longer than the mean of those that ended.
            frames = max(sum(row.frames for row in done) / len(done), summary.views / self.cameras / (len(done) + active))
            share = summary.views / (self.config.bake.episodes * self.cameras * frames)
            left = (1.0 / share - 1.0) * elapsed if share < 1.0 else None
        self.progress.update(
            episodes_done=len(summary.episodes), episodes=self.config.bake.episodes, worlds_active=active, views=summary.views,
            views_per_s=summary.views / elapsed if elapsed > 0.0 else 0.0, seconds_left=left,
        )


def _write_records(config: Config, out: Path, summary: BakeSummary) -> None:
    """The settings, how every episode ended, and every attempt. Nothing in them depends on the machine or the time."""
    rows = [
        {"episode": row.episode, "redraw": row.redraw, "ending": row.ending.name.lower(), "sentence": row.ending.sentence,
         "frames": row.frames, "seconds": round(row.seconds, 6), "mode": row.mode, "objects": row.objects, "attempts": row.attempts,
         "picked": row.picked, "lost": row.lost, "left": row.left}
        for row in summary.episodes
    ]
    try:
        write_whole(out / CONFIG_FILE, config_to_toml(config).encode())
        if may_pick(config):
            write_whole(out / ATTEMPTS_FILE, "".join(line for row in summary.episodes for line in summary.attempts[row.episode]).encode())
        write_whole(out / EPISODES_FILE, "".join(json.dumps(row) + "\n" for row in rows).encode())
    except OSError as error:
        raise output_error(out, error) from error


def describe_arrays(config: Config) -> list[tuple[str, tuple[int, ...], str, int]]:
    """Rows (name, shape, unit, bytes) of every array that a bake declares on the device, all copies counted.

    Newton's own arrays come on top. Body slots are counted at their most: as many for each kind as there is room for objects.
    """
    device: wp.Device = pick_device(config.bake.device)
    room = config.arrangement.max_objects
    worlds = world_sizes(config, build.GRIPPER_BODIES + 2 * room)
    views = view_sizes(config, device)
    views |= body_sizes(room, *config.cameras.resolution)
    ring = RING if device.is_cuda else 1
    groups = [(kind, worlds, 1) for kind in (WorldState, AttemptState, SealState, LastFrame)]
    groups += [(kind, worlds, 1 + RECORDS) for kind in (Sighting, Plan)]
    groups += [(WorldStatus, worlds, RECORDS), (Snapshot, worlds, RECORDS), (ViewBuffers, views, ring)]
    groups += [(kind, views, 1) for kind in (BodyArrays, HitArrays, PictureArrays)]
    if MOVING.intersection(config.render.layers):
        groups += [(MotionArrays, views, 1)]
    if has_spread(config):
        groups += [(SpreadArrays, views, 1)]
    if may_pick(config):
        looks = count_views(config, room, device)
        groups += [(kind, sight_sizes(config, room, looks), 1) for kind in SCRATCH]
        groups += [(kind, plan_sizes(config, room, looks), 1) for kind in (VoteArrays, CycleArrays)]
    rows = [row for kind, sizes, copies in groups for row in memory_table(kind, sizes) for _ in range(copies)]
    if config.render.mode == FAST:
        cells = views | cell_sizes(config, *config.cameras.resolution)
        rows += [row for kind, copies in FAST_SCRATCH for row in memory_table(kind, cells) for _ in range(copies)]
    return rows + ring * memory_table(LayerBuffers, views, config.render.layers)
